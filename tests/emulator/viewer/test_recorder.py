"""A recording, read back: what is in it is what was told, in the units that its names say, and it is closed."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rerun.chunk import RrdReader

from agents.cooperative.declared import paper_rmse
from emulator.drivers.observers import Messages
from emulator.drivers.simulate import simulate
from emulator.radio.outcomes import Outcome
from emulator.scenario.scenario import Scenario
from emulator.viewer.drawing import (
    OUTCOME_COLOURS,
    PeriodArrays,
    ellipses,
    in_length,
    link_states,
    nice_length,
)
from emulator.viewer.radio_scene import STROKES, delivery_by_distance
from emulator.viewer.recorder import Recorder
from emulator.viewer.sinks import Sinks, is_closed
from emulator.viewer.vehicle_scene import range_rings_m
from tests.support.recorded import prepared
from tests.support.recordings import Entity, read_back, rrd
from vnet.errors import VnetError
from vnet.transport import wire

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("strict")]

Told = list[tuple[str, dict[str, Any]]]
LATE_S = 1.5


@pytest.fixture(scope="module")
def told(tmp_path_factory: pytest.TempPathFactory) -> Told:
    """Messages of a simulated run with faults, having crossed the wire."""
    scenario = Scenario.model_validate(
        {
            "run": {"duration_s": 3.0, "name": "told", "settle_s": 0.5},
            "network": {"vehicles": 6},
            "radio": {"loss": 0.2, "max_peers": 3, "range_m": 1e5},
            "program": {"entry": "agents.cooperative:main", "options": {"particles": 50}},
            "fault": [
                {"kind": "kill", "at_s": 1.0, "duration_s": 1.0, "nodes": {"ids": ["v02"]}},
                {"kind": "partition", "at_s": 1.2, "duration_s": 0.6, "groups": "halves"},
            ],
        }
    )
    folder = tmp_path_factory.mktemp("told") / "run"
    emulation = prepared(scenario, folder)
    messages = Messages(emulation)
    told = [("scene", messages.scene())]
    emulation.watch(lambda view: told.append(("period", messages.period(view))))
    simulate(emulation)
    told.append(("end", messages.end()))
    return [(stream, wire.decode_observation(wire.encode_observation(message))) for stream, message in told]


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


@pytest.mark.parametrize(
    ("entity", "figures"),
    [
        ("/figures/common-error", ["common_error_rmse_m", "deviation_m"]),
        ("/figures/consensus", ["consensus_error_m", "bias_m"]),
        ("/figures/position", ["position_rmse_m", "fix_rmse_m"]),
    ],
)
def test_lines_have_the_figures_of_the_messages(
    told: Told, entities: dict[str, Entity], entity: str, figures: list[str]
) -> None:
    seen = 0
    for period in periods(told):
        drawn = entities[entity].array("Scalars:scalars", period.time_s)
        wanted = [np.nan if (v := period.message["figures"][f]) is None else v for f in figures]
        np.testing.assert_allclose(drawn[: len(figures)], wanted)
        seen += int(np.isfinite(wanted).sum())
    assert seen > 20
    assert len(entities[entity].static["SeriesLines:names"]) == len(drawn)


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


def test_a_vehicle_that_enters_is_not_red_any_more(told: Told, tmp_path: Path) -> None:
    def without_v02(message: dict[str, Any], until_s: float) -> dict[str, Any]:
        if "up" not in message or message["time_ns"] >= until_s * 1e9:
            return message
        up, position = bytearray(message["up"]), np.frombuffer(message["position_m"], "<f4").copy()
        up[1], position[2:4] = 0, np.nan
        return {**message, "up": bytes(up), "position_m": position.tobytes()}

    entering = [(stream, without_v02(message, 0.5)) for stream, message in told]
    write(entering, tmp_path / "recording.rrd")
    colours = read_back(tmp_path / "recording.rrd")["/map/true"].at["Points2D:colors"]
    assert colours[0.0][1] != colours[0.0][0], "it is not there yet"
    assert len(set(colours[0.5])) == 1, "it has entered, and nobody was down before or after"


def test_events_are_told_at_their_time_and_those_after_the_last_period_too(
    told: Told, entities: dict[str, Entity]
) -> None:
    events = [event for _, message in told for event in message.get("events", [])]
    logged = entities["/events"].at["TextLog:text"]
    assert {event["time_ns"] / 1e9 for event in events} == set(logged)
    assert logged[1.2] == ["partition-1 started: v01, v02, v03, v04, v05, v06"]


def test_the_weights_are_those_that_were_reported(told: Told, entities: dict[str, Entity]) -> None:
    number = {node: row for row, node in enumerate(told[0][1]["node_ids"])}
    matrix = np.full((6, 6), np.nan)
    drawn = entities["/peers/weight"].at["Tensor:data"]
    compared = 0
    for period in periods(told):
        for node, row in period.peers().get("weight", {}).items():
            matrix[number[node]] = row
        matrix[~period.up] = np.nan
        if period.time_s in drawn:
            tensor = drawn[period.time_s][0]
            assert tensor["names"] == ["reports", "of"]
            np.testing.assert_allclose(_numbers(tensor).reshape(6, 6), matrix, rtol=1e-6)
            compared += 1
    assert compared >= 2


def test_the_links_of_the_radio_are_shares_of_what_was_tried(told: Told, entities: dict[str, Entity]) -> None:
    times = list(entities["/radio/links"].at["Tensor:data"])
    before = [period for period in periods(told) if period.time_s <= times[-1]]
    tried = np.sum([period.counts()[0] for period in before], axis=0)
    delivered = np.sum([period.counts()[1] for period in before], axis=0)
    tensor = entities["/radio/links"].at["Tensor:data"][times[-1]][0]
    assert tensor["names"] == ["receiver", "sender"]
    share = np.divide(delivered, tried, out=np.full((6, 6), np.nan), where=tried > 0)
    np.testing.assert_allclose(_numbers(tensor).reshape(6, 6), share, rtol=1e-6)
    heard = _numbers(entities["/radio/heard"].at["BarChart:values"][times[-1]][0])
    np.testing.assert_allclose(heard, 100 * delivered.sum(axis=1) / tried.sum(axis=1), rtol=1e-5)


def test_ages_and_times_between_receptions_are_those_of_the_messages(
    told: Told, entities: dict[str, Entity]
) -> None:
    """Link by link, from when the newest that was received was sent."""
    sent_ms: dict[tuple[int, int], float] = {}
    gaps_ms: list[float] = []
    drawn = entities["/radio/age"].at["Scalars:scalars"]
    bars = entities["/radio/ages"].at["BarChart:values"]
    for period in periods(told):
        end_ms = period.time_s * 1e3 + 100
        for (sender, receiver, outcome, count), age_ms in zip(
            period.pairs.tolist(), period.numbers("pairs_age_ms").tolist(), strict=True
        ):
            if outcome != Outcome.delivered:
                continue
            before_ms = sent_ms.get((sender, receiver))
            if before_ms is not None and end_ms - age_ms > before_ms:
                gaps_ms += [(end_ms - age_ms - before_ms) / count] * count
            sent_ms[sender, receiver] = max(end_ms - age_ms, before_ms or 0)
        sent_ms = {link: sent for link, sent in sent_ms.items() if period.up[list(link)].all()}
        ages_ms = {link: end_ms - sent for link, sent in sent_ms.items()}
        if ages_ms and period.time_s in drawn:
            wanted = np.quantile(list(ages_ms.values()), [0.5, 0.95], method="higher")
            np.testing.assert_allclose(drawn[period.time_s][:2], wanted, rtol=1e-4)
        if gaps_ms and period.time_s in drawn:
            assert drawn[period.time_s][2] == pytest.approx(np.mean(gaps_ms), rel=1e-4)
        if period.time_s in bars:
            heard = [[age for (_, at), age in ages_ms.items() if at == node] for node in range(6)]
            wanted_ms = [float(np.mean(some)) if some else 0.0 for some in heard]
            np.testing.assert_allclose(_numbers(bars[period.time_s][0]), wanted_ms, rtol=1e-4)
    assert len(gaps_ms) > 100 and min(gaps_ms) < 150 < max(gaps_ms)


def test_latencies_and_loads_are_those_of_the_messages(told: Told, entities: dict[str, Entity]) -> None:
    times = list(entities["/radio/latency"].at["BarChart:values"])
    before = [period for period in periods(told) if period.time_s <= times[-1]]
    counts = [np.frombuffer(period.message["latency_counts"], dtype="<i4") for period in before]
    histogram = np.sum(counts, axis=0)
    drawn = _numbers(entities["/radio/latency"].at["BarChart:values"][times[-1]][0])
    np.testing.assert_array_equal(drawn, histogram[: len(drawn)])
    assert histogram[len(drawn) :].sum() == 0
    middles_ms = _numbers(entities["/radio/latency"].at["BarChart:abscissa"][0.0][0])
    assert middles_ms[:2].tolist() == [1.0, 3.0]
    for name in ("sent", "received"):
        rate = np.mean([period.numbers(f"{name}_bytes") for period in before], axis=0) / 0.1 / 1e3
        drawn = _numbers(entities[f"/radio/bytes/{name}"].at["BarChart:values"][times[-1]][0])
        np.testing.assert_allclose(drawn, rate, rtol=1e-5)


def test_the_vehicle_that_is_looked_at_closely(told: Told, entities: dict[str, Entity]) -> None:
    period = next(period for period in periods(told) if period.time_s == LATE_S)
    position, estimate = (period.points(f"{name}_m")[2] for name in ("position", "estimate"))
    common = (period.points("common_error_estimate_m") - period.points("common_error_m"))[2]
    drawn = entities["/vehicle/errors"].array("Scalars:scalars", LATE_S)
    wanted = [np.hypot(*(estimate - position)), np.hypot(*common)]
    np.testing.assert_allclose(drawn, wanted, rtol=1e-5)
    assert all(clouds <= {"Points2D:positions"} for clouds in [set(entities["/vehicle/common/cloud"].at)])
    table = list(entities["/vehicle/table"].at["TextDocument:text"].values())[-1][0]
    assert table.splitlines()[0] == "| hears | frames in 5 s | delivered | weight |"
    assert "| v03 (itself) |" in table


def test_nothing_is_drawn_of_a_vehicle_that_has_left(told: Told, tmp_path: Path) -> None:
    def without_v03(message: dict[str, Any]) -> dict[str, Any]:
        if "up" not in message or message["time_ns"] < 1.5e9:
            return message
        up, position = bytearray(message["up"]), np.frombuffer(message["position_m"], "<f4").copy()
        up[2], position[4:6] = 0, np.nan
        return {**message, "up": bytes(up), "position_m": position.tobytes()}

    write([(stream, without_v03(message)) for stream, message in told], tmp_path / "left.rrd", "v03")
    found = read_back(tmp_path / "left.rrd")
    table = found["/vehicle/table"].at["TextDocument:text"]
    assert max(table) == pytest.approx(1.5)
    assert table[max(table)] == ["v03 is not in the network: it has not entered yet, or has left."]
    assert max(found["/vehicle/errors"].at["Scalars:scalars"]) < 1.5
    for name in ("position/estimate", "common/cloud", "hears/neighbours"):
        last = found[f"/vehicle/{name}"].at["Points2D:positions"]
        assert max(last) == pytest.approx(1.5) and len(last[max(last)]) == 0, name


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


def test_lengths() -> None:
    assert [nice_length(x) for x in (1.0, 1.9, 99.0, 640.0, 5000.0)] == [1.0, 1.0, 50.0, 500.0, 5000.0]
    assert [in_length(x) for x in (0.5, 500.0, 1000.0, 2500.0)] == ["0.5 m", "500 m", "1 km", "2.5 km"]


def test_rings_around_a_vehicle_are_at_round_lengths() -> None:
    assert range_rings_m(1000.0) == [500.0, 1000.0]
    assert range_rings_m(3000.0) == [1000.0, 2000.0, 3000.0]
    assert range_rings_m(250.0) == [100.0, 200.0, 250.0]
    assert in_length(1000 / 3) == "333.3 m"


def test_delivery_by_distance() -> None:
    distance = np.array([[0.0, 10.0], [95.0, 0.0]])
    tried, delivered = np.array([[0, 4], [2, 0]]), np.array([[0, 1], [2, 0]])
    share, middles, width = delivery_by_distance(distance, tried, delivered, 100.0)
    assert (width, middles[0]) == (5.0, 2.5)
    assert np.flatnonzero(np.isfinite(share)).tolist() == [2, 19]
    assert share[[2, 19]].tolist() == [0.25, 1.0]


@pytest.mark.parametrize(
    ("network", "program", "found"),
    [
        ({}, {}, None),
        ({"path": "x/network_n3.csv"}, {}, ("the paper's RMSE: optimized, N3", 1.04)),
        ({"path": "network_n3.csv"}, {"options": {"fusion": "random"}}, ("the paper's RMSE: random, N3", 4.30)),
        ({"path": "network_n3.csv"}, {"options": {"fusion": "none"}}, None),
        ({"path": "network_n3.csv"}, {"entry": "agents.beacon:main"}, None),
        ({"path": "network_n2.csv"}, {}, None),
    ],
)
def test_the_papers_value_only_where_it_applies(
    network: dict[str, Any], program: dict[str, Any], found: tuple[str, float] | None
) -> None:
    import tomli_w

    program = {"entry": "agents.cooperative:main", "options": {}, **program}
    scenario = tomli_w.dumps({"network": network, "program": program})
    scene = {"scenario": scenario, "node_ids": ["v"] * 24, "range_m": 3000.0}
    assert paper_rmse(scene).get("common_error_rmse_m") == found
    assert paper_rmse({**scene, "range_m": 500.0}) == {}


def _numbers(tensor: dict[str, Any]) -> np.ndarray:
    """The numbers of a tensor as it was read back."""
    buffer = tensor["buffer"]
    return np.array(buffer, dtype=float)
