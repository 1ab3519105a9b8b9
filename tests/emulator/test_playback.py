"""Playback of a run's files gives the messages of the live run, or one line about what is missing."""

import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from emulator.drivers.conclude import conclude
from emulator.drivers.emulation import PeriodView
from emulator.drivers.observers import Messages
from emulator.drivers.simulate import simulate
from emulator.radio.outcomes import Outcome
from emulator.records.recorded_run import RecordedRun
from emulator.records.tables import mean_busy
from emulator.scenario.scenario import Scenario
from emulator.stream import LATENCY_BIN_NS, LATENCY_BINS, messages, unpack, unpack_pairs
from tests.support.paths import ROOT
from tests.support.recorded import prepared
from vnet.errors import VnetError
from vnet.transport import wire

FAULTS = [
    {"kind": "kill", "at_s": 0.95, "duration_s": 0.65, "nodes": {"count": 1}},
    {"kind": "kill", "at_s": 2.0, "duration_s": 0.3, "nodes": {"count": 2}},
    {"kind": "loss", "at_s": 0.5, "duration_s": 1.0, "probability": 0.5},
    {"kind": "delay", "at_s": 1.0, "duration_s": 0.777, "delay_ms": 130.0},
    {"kind": "duplicate", "at_s": 1.2, "duration_s": 0.5, "copies": 2},
    {"kind": "gnss_jump", "at_s": 0.7, "duration_s": 0.5, "nodes": {"count": 2}, "offset_m": [30.0, -5.0]},
    {"kind": "gnss_outage", "at_s": 1.5, "duration_s": 0.4, "nodes": {"count": 1}},
    {"kind": "DoS", "at_s": 2.2, "duration_s": 0.1, "nodes": {"count": 1}},
]
OPTIONS = {"particles": 60}
NODES = 6
PERIODS = 30


@dataclass(frozen=True)
class Watched:
    """A run that has been watched: its folder, and what was told live."""

    folder: Path
    told: list[tuple[str, dict[str, Any]]]

    @property
    def periods(self) -> list[dict[str, Any]]:
        return [message for stream, message in self.told if stream == "period"]


def crossed(message: dict[str, Any]) -> dict[str, Any]:
    return wire.decode_observation(wire.encode_observation(message))


def watch(scenario: Scenario | dict[str, Any], folder: Path) -> Watched:
    emulation = prepared(scenario, folder)
    live = Messages(emulation)
    told = [("scene", crossed(live.scene()))]
    emulation.watch(lambda view: told.append(("period", crossed(live.period(view)))))
    wall_s, _ = simulate(emulation)
    told.append(("end", crossed(live.end())))
    conclude(emulation, wall_s, "simulate")
    return Watched(folder, told)


@pytest.fixture(scope="module")
def watched(tmp_path_factory: pytest.TempPathFactory) -> Watched:
    """A simulated cooperative run, with faults at the edges of periods and within them."""
    scenario = {
        "run": {"duration_s": PERIODS / 10 + 0.05, "settle_s": 0.5, "name": "watched"},
        "network": {"vehicles": NODES},
        "radio": {"loss": 0.1, "max_peers": 4},
        "program": {"entry": "agents.cooperative:main", "options": OPTIONS},
        "fault": FAULTS,
    }
    return watch(scenario, tmp_path_factory.mktemp("playback") / "run")


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Watched:
    """A simulated run of beacons that share a medium, which fades and is congested by rule."""
    pauses = {"kind": "etsi", "pause_ms": (150,) * 5}
    physical = {"path_loss": {"kind": "log_distance"}, "fading": {}, "mac": {}, "congestion": pauses}
    scenario = {
        "run": {"duration_s": 1.55, "settle_s": 0.5, "name": "shared"},
        "network": {"vehicles": NODES, "layout": "dense"},
        "radio": physical,
        "program": {"entry": "agents.beacon:main"},
    }
    return watch(scenario, tmp_path_factory.mktemp("shared") / "run")


@pytest.mark.slow
def test_the_files_tell_what_was_told_live(watched: Watched) -> None:
    played = list(messages(watched.folder))
    assert [stream for stream, _ in played] == [stream for stream, _ in watched.told]
    assert len(watched.periods) == PERIODS
    for (_, live), (stream, again) in zip(watched.told, map(_crossed_pair, played), strict=True):
        if stream == "end":  # what concluded the run came after it
            assert again["events"][: len(live["events"])] == live["events"]
        else:
            assert again.keys() == live.keys()
            differing = {key: (live[key], again[key]) for key in live if live[key] != again[key]}
            assert differing == {}, (stream, live.get("period"))


def _crossed_pair(pair: tuple[str, dict[str, Any]]) -> tuple[str, dict[str, Any]]:
    return pair[0], crossed(pair[1])


@pytest.mark.slow
def test_the_files_of_a_shared_medium_tell_the_same(shared: Watched) -> None:
    played = list(messages(shared.folder))
    for (_, live), (stream, again) in zip(shared.told, map(_crossed_pair, played), strict=True):
        differing = [key for key in live if live[key] != again[key]]
        assert stream == "end" or differing == [], (stream, live.get("period"))
    busy = np.array([unpack(message["busy_ratio"])[:, 0] for message in shared.periods])
    assert (busy.max(axis=0) > 0).all() and busy.max() < 1
    outcomes = {name for message in shared.periods for name in message["outcomes"]}
    assert outcomes >= {"delivered", "faded", "held_back"}


def test_busy_ratios_are_those_of_the_windows_that_ended_in_a_period() -> None:
    windows = np.array([[0.1, 0.2], [0.3, 0.4], [0.5, 0.9]])
    ms = 1_000_000
    assert mean_busy(windows, 2, 100 * ms, 300 * ms).tolist() == [0.4, 0.65]
    assert mean_busy(windows, 2, 210 * ms, 260 * ms).tolist() == [0.3, 0.4], "none ended in it: the last before"
    assert mean_busy(windows, 2, 0, 1000 * ms).tolist() == pytest.approx([0.3, 0.5]), "the run was over before"
    assert np.isnan(mean_busy(windows, 2, 0, 99 * ms)).all()
    assert np.isnan(mean_busy([], 2, 0, 500 * ms)).all(), "no medium is shared"


@pytest.mark.slow
def test_what_was_told_is_worth_comparing(watched: Watched) -> None:
    """Each field says something at some time: two messages of nothing are equal as well."""
    told = watched.periods
    outcomes = {name for message in told for name in message["outcomes"]}
    assert outcomes >= {"delivered", "lost", "peer_cap", "fault", "receiver_down"}
    assert {len(message["faults"]) for message in told} >= {0, 1, 3}
    assert {bytes(message["up"]).count(0) for message in told} == {0, 1, 2}
    assert any(message["lists"].get("cloud_m") for message in told)
    assert any(message["peers"].get("weight") for message in told)
    assert any(message["events"] for message in told)
    assert np.isnan(unpack(told[16]["fix_m"], 2)).any()
    late = [np.frombuffer(message["latency_counts"], "<i4")[-1] for message in told]
    assert max(late) > 0, "delays take some over the last edge of the histogram"


@pytest.mark.slow
def test_a_fault_acts_in_the_periods_that_it_touches(watched: Watched) -> None:
    acting = [message["period"] for message in watched.periods if "kill-0" in message["faults"]]
    assert acting == list(range(9, 16))  # from 0.95 s to 1.6 s
    down = [message["period"] for message in watched.periods[:20] if 0 in message["up"]]
    assert down == list(range(9, 16)), "up is of the end of a period"
    kinds = [(e["time_ns"], e["kind"]) for message in watched.periods[20:21] for e in message["events"]]
    assert (2_000_000_000, "fault_started") in kinds, "what happens as a period starts is told with it"


@pytest.mark.slow
def test_every_row_of_the_trace_is_told_once(watched: Watched) -> None:
    """Against the trace, counted another way."""
    trace = pq.read_table(watched.folder / "trace.parquet")
    rows, ids = trace.to_pylist(), watched.told[0][1]["node_ids"]
    for message in watched.periods:
        start_ns, end_ns = message["time_ns"], message["time_ns"] + 100_000_000
        decided = [r for r in rows if start_ns <= (r["arrival_ns"] or r["sent_ns"]) < end_ns]
        delivered = [r for r in decided if r["outcome"] == "delivered"]
        pairs = unpack_pairs(message)
        assert pairs[:, 3].sum() == len(decided) == sum(message["outcomes"].values())
        assert pairs[pairs[:, 2] == Outcome.delivered, 3].sum() == len(delivered)
        received = sum(row["size_bytes"] for row in delivered)
        assert unpack(message["received_bytes"]).sum() == received
        sent = {
            (r["sender"], r["seq"], r["copy"]): r["size_bytes"] for r in rows if start_ns <= r["sent_ns"] < end_ns
        }
        assert unpack(message["sent_bytes"]).sum() == sum(sent.values())
        ages_ms: dict[tuple[str, str], float] = {}
        for row in delivered:
            link = row["sender"], row["receiver"]
            ages_ms[link] = min(ages_ms.get(link, np.inf), (end_ns - row["sent_ns"]) / 1e6)
        told = {
            (ids[sender], ids[receiver]): age_ms
            for (sender, receiver, outcome, _), age_ms in zip(
                pairs, unpack(message["pairs_age_ms"])[:, 0], strict=True
            )
            if outcome == Outcome.delivered
        }
        assert told == pytest.approx(ages_ms)
        bins = [min((r["arrival_ns"] - r["sent_ns"]) // LATENCY_BIN_NS, LATENCY_BINS - 1) for r in delivered]
        assert np.frombuffer(message["latency_counts"], "<i4").tolist() == [
            bins.count(k) for k in range(LATENCY_BINS)
        ]


@pytest.mark.slow
def test_who_comes_late_is_told_of_whole_periods(watched: Watched, tmp_path: Path) -> None:
    network, program = {"vehicles": NODES}, {"entry": "agents.beacon:main"}
    scenario = {"run": {"duration_s": 1.0}, "network": network, "program": program}
    emulation = prepared(scenario, tmp_path / "run")
    always, late = Messages(emulation), Messages(emulation)
    told: list[tuple[dict[str, Any], dict[str, Any]]] = []

    def look(view: PeriodView) -> None:
        message = always.period(view)
        if view.instant.period < 4:
            return
        if view.instant.period == 4:
            late.begin()
            return
        told.append((message, late.period(view)))

    emulation.watch(look)
    simulate(emulation)
    assert [message["period"] for message, _ in told] == [5, 6, 7, 8, 9]
    for message, from_late in told:
        assert {**message, "events": []} == {**from_late, "events": []}


# What cannot be played.


@pytest.fixture
def copied(watched: Watched, tmp_path: Path) -> Path:
    """A copy of the run's folder, to be spoilt."""
    return Path(shutil.copytree(watched.folder, tmp_path / "copy"))


def refused(folder: Path) -> str:
    with pytest.raises(VnetError) as caught:
        list(messages(folder))
    text = str(caught.value)
    assert "\n" not in text
    return text


def test_a_folder_that_is_no_runs(tmp_path: Path) -> None:
    assert "not a run's folder" in refused(tmp_path)
    assert "not a run's folder" in refused(tmp_path / "nowhere")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["trace", "states", "metrics"])
def test_a_table_that_is_not_there(copied: Path, name: str) -> None:
    (copied / f"{name}.parquet").unlink()
    assert refused(copied).endswith(f"there is no {name}.parquet in it")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["trace", "states", "metrics"])
def test_a_table_that_is_none(copied: Path, name: str) -> None:
    path = copied / f"{name}.parquet"
    path.write_bytes(path.read_bytes()[:1000])
    assert f"{name}.parquet: cannot be read" in refused(copied)
    pq.write_table(pa.table({"x": [1]}), path)
    assert f"{name}.parquet: has no column" in refused(copied)


@pytest.mark.slow
def test_tables_that_do_not_fit_together(copied: Path, watched: Watched) -> None:
    rewrite = {name: pq.read_table(copied / f"{name}.parquet") for name in ("trace", "states", "metrics")}

    def spoil(name: str, table: pa.Table) -> str:
        pq.write_table(table, copied / f"{name}.parquet")
        text = refused(copied)
        pq.write_table(rewrite[name], copied / f"{name}.parquet")
        return text

    trace, states, metrics = rewrite["trace"], rewrite["states"], rewrite["metrics"]
    assert "more periods than the 20 of metrics.parquet" in spoil("metrics", metrics.slice(0, 20))
    assert "fewer periods than the 30" in spoil("states", states.slice(0, 20 * NODES))
    assert "not those of one period after the other" in spoil("metrics", metrics.slice(1))
    assert "its first period is not of the vehicles of world.npz" in spoil("states", states.slice(NODES))
    assert "not those of one period after the other" in spoil("states", states.slice(0, 10 * NODES + 1))
    swapped = states.take(pa.array([1, 0, *range(2, len(states))]))
    assert "first period is not" in spoil("states", swapped)
    later = [*range(NODES), NODES + 1, NODES, *range(NODES + 2, len(states))]
    assert "not those of one period after the other" in spoil("states", states.take(pa.array(later)))
    backwards = trace.take(pa.array(range(len(trace) - 1, -1, -1)))
    assert "not in the order in which frames were sent" in spoil("trace", backwards)
    stranger = trace.set_column(1, "sender", pa.array(["v99"] * len(trace)).dictionary_encode())
    assert "'v99'" in spoil("trace", stranger)
    outcome = trace.set_column(
        trace.column_names.index("outcome"), "outcome", pa.array(["eaten"] * len(trace)).dictionary_encode()
    )
    assert "'eaten'" in spoil("trace", outcome)
    world = RecordedRun.open(copied).world
    fewer = replace(world, node_ids=world.node_ids[:5], position_m=world.position_m[:5])
    fewer.write(copied / "world.npz")
    assert "its first period is not of the vehicles of world.npz" in refused(copied)


@pytest.mark.slow
def test_a_run_without_a_period_has_a_scene_and_an_end(tmp_path: Path) -> None:
    run, program = {"duration_s": 0.05, "settle_s": 0.0}, {"entry": "agents.beacon:main"}
    scenario = {"run": run, "network": {"vehicles": 2}, "program": program}
    emptied = watch(scenario, tmp_path / "run")
    assert [stream for stream, _ in messages(emptied.folder)] == ["scene", "end"]


@pytest.mark.slow
def test_the_documentation_names_every_field_and_outcome(watched: Watched) -> None:
    text = (ROOT / "docs" / "messages.md").read_text()
    scene, period = watched.told[0][1], watched.periods[0]
    assert [field for field in [*scene, *period] if f"`{field}`" not in text] == []
    numbered = [outcome for outcome in Outcome if outcome not in (Outcome.pending, Outcome.out_of_range)]
    assert [o for o in numbered if f"{o.value} `{o.name}`" not in " ".join(text.split())] == []
