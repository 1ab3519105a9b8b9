"""A recording, read back: what is in it is what was told, in the units that its names say, and it is closed."""

from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
from rerun.chunk import RrdReader

from emulator.radio.outcomes import Outcome
from emulator.viewer.drawing import OUTCOME_COLOURS, PeriodArrays, ellipses, link_states
from emulator.viewer.recorder import Recorder
from emulator.viewer.scenes import STROKES, RadioScene, describe
from emulator.viewer.sinks import Sinks, is_closed
from tests.emulator.test_playback import watch
from tests.support.motion import along, scenario_of_trips, write_trips
from tests.support.recordings import Entity, read_back, rrd
from vnet.errors import VnetError

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("strict")]

Told = list[tuple[str, dict[str, Any]]]


@pytest.fixture(scope="module")
def told(tmp_path_factory: pytest.TempPathFactory) -> Told:
    """Messages of a simulated run with faults, having crossed the wire."""
    scenario = {
        "run": {"duration_s": 3.0, "name": "told", "settle_s": 0.5},
        "network": {"vehicles": 6},
        "radio": {"loss": 0.2, "max_peers": 3, "range_m": 1e5},
        "program": {"entry": "agents.cooperative:main", "options": {"particles": 50}},
        "fault": [
            {"kind": "kill", "at_s": 1.0, "duration_s": 1.0, "nodes": {"ids": ["v02"]}},
            {"kind": "partition", "at_s": 1.2, "duration_s": 0.6, "groups": "halves"},
        ],
    }
    return watch(scenario, tmp_path_factory.mktemp("told") / "run").told


def write(told: Told, path: Path, vehicle: str | None = None) -> Recorder:
    with Recorder(Sinks(save=path, vehicle=vehicle), "told") as recorder:
        for stream, message in told:
            recorder.take(stream, message)
    return recorder


@pytest.fixture(scope="module")
def path(told: Told, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recording") / "recording.rrd"
    recorder = write(told, path, "v03")
    assert recorder.missed == 0
    return path


@pytest.fixture(scope="module")
def entities(path: Path) -> dict[str, Entity]:
    return read_back(path)


def periods(told: Told) -> list[PeriodArrays]:
    node_ids = told[0][1]["node_ids"]
    return [PeriodArrays(message, node_ids) for stream, message in told if stream == "period"]


def test_the_file_is_whole_and_says_so(path: Path) -> None:
    assert is_closed(path)
    assert rrd("verify", str(path)).returncode == 0


def views(path: Path) -> tuple[list[str], list[str]]:
    """Names of the containers and origins of the views of the largest blueprint, which is the last."""
    reader = RrdReader(str(path))
    largest: tuple[list[str], list[str]] = ([], [])
    for store in reader.blueprints():
        names: list[str] = []
        origins: list[str] = []
        for chunk in reader.stream(store=store):
            batch = chunk.to_record_batch()
            columns = {"ContainerBlueprint:display_name": names, "ViewBlueprint:space_origin": origins}
            for column in columns.keys() & set(batch.schema.names):
                columns[column] += [text for row in batch.column(column).to_pylist() for text in row or []]
        largest = max(largest, (names, origins), key=lambda each: len(each[1]))
    return largest


def test_the_blueprint_has_four_tabs_and_shows_whatever_there_is(path: Path, entities: dict[str, Entity]) -> None:
    names, origins = views(path)
    assert {"Overview", "Radio", "Vehicle v03", "Program"} <= set(names)
    drawn = [entity for entity in entities if not entity.startswith("/__")]
    unseen = [entity for entity in drawn if not any(f"{entity}/".startswith(f"/{origin}/") for origin in origins)]
    assert unseen == [], "drawn, but in no view"
    empty = [origin for origin in origins if not any(f"{entity}/".startswith(f"/{origin}/") for entity in drawn)]
    assert empty == [], "no view is empty"


def test_nothing_that_is_always_there_hides_what_comes_with_a_time(entities: dict[str, Entity]) -> None:
    hidden = {name: set(entity.static) & set(entity.at) for name, entity in entities.items()}
    assert {name: both for name, both in hidden.items() if both} == {}


@pytest.mark.parametrize(
    ("scenario", "radio"),
    [
        ("", "radio 3000 m"),
        (
            "[radio]\npath_loss = { kind = 'winner_b1' }\nmac = { kind = 'lte-mode4' }\n",
            "radio: winner b1, lte-mode4",
        ),
    ],
)
def test_a_scenario_is_described_by_what_it_leaves_out_too(told: Told, scenario: str, radio: str) -> None:
    scene = next(message for stream, message in told if "lane_heading_rad" in message)
    assert f" · {radio}, loss 0%, at most 3 peers" in describe({**scene, "scenario": scenario})


def test_there_is_no_time_but_the_emulated(path: Path) -> None:
    timelines = {name for chunk in RrdReader(str(path)).stream() for name in chunk.timeline_names}
    assert timelines == {"emulated time"}


@pytest.mark.parametrize(
    ("entity", "name", "relative_to"),
    [
        ("/map/true", "position_m", None),
        ("/map/fix", "fix_m", None),
        ("/map/estimate", "estimate_m", None),
        ("/position/fix", "fix_m", "position_m"),
        ("/position/estimate", "estimate_m", "position_m"),
        ("/common/estimate", "common_error_estimate_m", "common_error_m"),
    ],
)
def test_points_are_where_the_messages_say_with_north_up(
    told: Told, entities: dict[str, Entity], entity: str, name: str, relative_to: str | None
) -> None:
    for period in periods(told):
        wanted = period.points(name)
        if relative_to is not None:
            wanted = wanted - period.points(relative_to)
        drawn = entities[entity].array("Points2D:positions", period.time_s)
        np.testing.assert_allclose(drawn, wanted * [1, -1], rtol=1e-6, atol=1e-4)


def test_layers_of_the_stack_are_as_thick_as_there_were_frames(told: Told, entities: dict[str, Entity]) -> None:
    seen = set()
    for period in periods(told):
        lower = 0.0
        for outcome in OUTCOME_COLOURS:
            count = period.message["outcomes"].get(outcome.name, 0)
            if count:
                lines = entities[f"/radio/frames/{outcome.name}"].at["Scalars:scalars"]
                drawn = [v for t, (v,) in sorted(lines.items()) if -1e-6 < t - period.time_s < 0.1 - 1e-6]
                assert drawn[:-1] == [lower, lower + count] * STROKES
                assert np.isnan(drawn[-1]), "no line joins it to another period"
                seen.add(outcome)
            lower += count
        assert lower == period.pairs[:, 3].sum()
    assert {Outcome.delivered, Outcome.lost, Outcome.peer_cap, Outcome.fault, Outcome.receiver_down} <= seen


def test_links_are_halves_coloured_by_their_state(told: Told, entities: dict[str, Entity]) -> None:
    links = entities["/map/links"]
    seen = set()
    for period in periods(told):
        sender, receiver, state = link_states(period)
        position = period.points("position_m") * [1, -1]
        strips = links.array("LineStrips2D:strips", period.time_s).reshape(-1, 2, 2)
        np.testing.assert_allclose(strips[:, 0], position[sender], atol=0.1)
        np.testing.assert_allclose(strips[:, 1], (position[sender] + position[receiver]) / 2, atol=0.1)
        wanted = [int.from_bytes(bytes([*OUTCOME_COLOURS[Outcome(kind)], 255])) for kind in state]
        assert links.at["LineStrips2D:colors"][period.time_s] == wanted
        seen |= set(state.tolist())
    assert {Outcome.delivered, Outcome.peer_cap, Outcome.fault, Outcome.receiver_down} <= seen


def test_a_link_is_delivered_if_a_frame_got_through_and_else_what_befell_most(told: Told) -> None:
    rows = [
        (0, 1, Outcome.lost, 3),
        (0, 1, Outcome.delivered, 1),
        (1, 0, Outcome.lost, 1),
        (1, 0, Outcome.peer_cap, 2),
    ]
    period = PeriodArrays({"pairs": np.array(rows, dtype="<i4").tobytes()}, ["a", "b"])
    sender, receiver, state = link_states(period)
    assert list(zip(sender, receiver, state, strict=True)) == [(0, 1, Outcome.delivered), (1, 0, Outcome.peer_cap)]


def test_frames_count_at_the_distance_that_they_were_sent_over(tmp_path: Path) -> None:
    """Two approach each other at 60 m/s; below 500 m they hear each other, and beyond 550 m they do not."""
    courses = {"a": [(0, 14, along(0, 30))], "b": [(0, 14, along(1200, -30, 10))]}
    steady = {"path_loss": {"kind": "log_distance"}, "loss": 0.0}
    scenario = scenario_of_trips(write_trips(tmp_path / "t.csv", courses), 14.0, radio=steady)
    told, canvas = watch(scenario, tmp_path / "run").told, MagicMock()
    scene = RadioScene(canvas, told[0][1])
    for period in periods(told):
        scene.period(period)
    drawn = [call.args[1:3] for call in canvas.bars.call_args_list if call.args[0] == "radio/distance"]
    assert {*np.concatenate([shares[m < 450] for shares, m in drawn]).tolist()} == {0.0, 100.0}


def test_faults_and_the_dead_have_their_spans(entities: dict[str, Entity]) -> None:
    spans = {name: entity.at["StateChange:state"] for name, entity in entities.items() if "/faults/" in name}
    assert spans == {
        "/faults/kill-0": {1.0: ["acting"], 2.0: [""]},
        "/faults/partition-1": {1.2: ["acting"], 1.8: [""]},
        "/faults/down": {0.0: ["none"], 1.0: ["1: v02"], 2.0: ["none"]},
    }


def test_who_is_down_is_red_on_the_map(entities: dict[str, Entity]) -> None:
    colours = entities["/map/true"].at["Points2D:colors"]
    assert list(colours) == [0.0, 1.0, 2.0]
    assert len(set(colours[0.0])) == len(set(colours[2.0])) == 1
    assert [number for number, colour in enumerate(colours[1.0]) if colour != colours[0.0][0]] == [1]


def test_events_are_told_at_their_time_and_those_after_the_last_period_too(
    told: Told, entities: dict[str, Entity]
) -> None:
    events = [event for _, message in told for event in message.get("events", [])]
    logged = entities["/events"].at["TextLog:text"]
    assert {event["time_ns"] / 1e9 for event in events} == set(logged)
    assert logged[1.2] == ["partition-1 started: v01, v02, v03, v04, v05, v06"]


def test_missing_periods_are_counted_and_told(told: Told, tmp_path: Path) -> None:
    recorder = write([*told[:5], *told[9:]], tmp_path / "gap.rrd")
    assert recorder.missed == 4
    logged = read_back(tmp_path / "gap.rrd")["/events"].at["TextLog:text"][0.8]
    assert logged == ["4 periods before this one are missing: the recording could not keep up"]


def test_what_comes_before_the_scene_and_what_is_unknown_is_left_out(told: Told, tmp_path: Path) -> None:
    write([*told[1:3], ("weather", {}), told[0], told[0], *told[3:]], tmp_path / "late.rrd")
    times = read_back(tmp_path / "late.rrd")["/map/true"].at["Points2D:positions"]
    assert min(times) == pytest.approx(0.2)


def test_a_file_that_cannot_be_written_is_one_line(told: Told, tmp_path: Path) -> None:
    with pytest.raises(VnetError, match=r"nowhere/x\.rrd: cannot write the recording"):
        write(told, tmp_path / "nowhere" / "x.rrd")


def test_ellipses_hold_95_percent() -> None:
    rng = np.random.default_rng(1)
    covariance = np.array([[4.0, 1.5], [1.5, 1.0]])
    outline = ellipses([[1.0, 2.0]], [covariance])[0] - [1.0, 2.0]
    inverse = np.linalg.inv(covariance)
    np.testing.assert_allclose(np.einsum("ki,ij,kj->k", outline, inverse, outline), 5.991, rtol=1e-3)
    sample = rng.multivariate_normal([0, 0], covariance, 20_000)
    assert np.mean(np.einsum("ki,ij,kj->k", sample, inverse, sample) < 5.991) == pytest.approx(0.95, abs=0.005)
    assert len(ellipses([[np.nan, 0.0]], [covariance])) == 0
