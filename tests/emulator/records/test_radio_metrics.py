"""The radio's figures, against an implementation that goes through the trace one row at a time."""

import math
from collections import defaultdict
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

from emulator.checks.judge import RecordedRun
from emulator.records.radio_metrics import radio_metrics, rows_of_pairs, unicast_figures
from emulator.records.tables import STATES
from emulator.report import radio_figures
from emulator.report.drawing import Line
from emulator.report.source import Source
from emulator.scenario.scenario import Scenario
from tests.emulator.checks.test_judge import run_scenario
from tests.support.exchange_programs import COPYING, exchange_run
from tests.support.motion import along, scenario_of_trips, still, write_trips

PERIOD_NS = 100_000_000
Row = dict[str, Any]


def evidence_of(rows: list[Row], position_m: np.ndarray, moves: bool) -> RecordedRun:
    """Evidence of a trace of these rows, with positions (K, N, 2)."""
    names = [f"v{number}" for number in range(position_m.shape[1])]
    rows = sorted(rows, key=lambda row: (row["sent_ns"], row["sender"], row["seq"], row["receiver"], row["copy"]))

    def named(column: str, known: list[str]) -> pa.Array:
        return pa.array([row[column] for row in rows], pa.string()).dictionary_encode()

    columns = {name: pa.array([row[name] for row in rows], pa.int64()) for name in ("sent_ns", "seq", "arrival_ns")}
    columns |= {name: named(name, names) for name in ("sender", "receiver", "outcome")}
    columns |= {
        "size_bytes": pa.array([16] * len(rows), pa.int32()),
        "payload_digest": pa.array([0] * len(rows), pa.uint64()),
        "cause": pa.array([""] * len(rows)),
        "copy": pa.array([row["copy"] for row in rows], pa.int16()),
    }
    states = [{"period": 0, "time_ns": 0, "node": name} for name in names]
    network = {"kind": "trips", "path": "none"} if moves else {}
    scenario = Scenario.model_validate({"network": network})
    table = pa.Table.from_pylist(states, schema=STATES.schema)
    return RecordedRun(scenario, pa.table(columns), table, pa.table({}), [], position_m)


@st.composite
def traces(draw: st.DrawFn) -> tuple[list[Row], np.ndarray, bool]:
    """Frames of two to four vehicles over a second, that may be heard, lost, out of range, late and sent again."""
    count, moves = draw(st.integers(2, 4)), draw(st.booleans())
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    position_m = rng.uniform(0, 300, (10 if moves else 1, count, 2))
    if moves:
        position_m[1:][rng.random((9, count)) < 0.1] = np.nan
    rows = []
    for sender in range(count):
        times_ns = np.sort(rng.choice(1_000_000_000, draw(st.integers(0, 12)), replace=False))
        for seq, sent_ns in enumerate(times_ns.tolist()):
            for receiver in range(count):
                if receiver == sender or rng.random() < 0.15:
                    continue
                for copy in range(1 + (rng.random() < 0.1)):
                    outcome = str(
                        rng.choice(["delivered", "lost", "peer_cap", "receiver_down"], p=[0.6, 0.2, 0.1, 0.1])
                    )
                    late_ns = int(rng.choice([1_000, 3_000_000, 150_000_000]) + rng.integers(0, 1000))
                    arrives = outcome in ("delivered", "receiver_down")
                    rows.append(
                        {
                            "sent_ns": sent_ns,
                            "sender": f"v{sender}",
                            "seq": seq,
                            "receiver": f"v{receiver}",
                            "copy": copy,
                            "outcome": outcome,
                            "arrival_ns": sent_ns + late_ns if arrives else None,
                        }
                    )
    return rows, position_m, moves


class Plain:
    """The same figures, one row at a time."""

    def __init__(self, rows: list[Row], position_m: np.ndarray, moves: bool) -> None:
        self.position_m, self.moves = position_m, moves
        pairs = [row for row in rows if row["copy"] == 0 and row["outcome"] != "receiver_down"]
        self.links: dict[tuple[str, str], list[Row]] = defaultdict(list)
        for row in sorted(pairs, key=lambda row: row["seq"]):
            self.links[row["sender"], row["receiver"]].append(row)

    def where(self, name: str, time_ns: int) -> np.ndarray:
        return self.position_m[time_ns // PERIOD_NS if self.moves else 0, int(name[1:])]

    def distance_m(self, row: Row) -> float:
        ends = (self.where(row[end], row["sent_ns"]) for end in ("sender", "receiver"))
        return float(np.hypot(*np.subtract(*ends)))

    def contacts(self, rows: list[Row]) -> list[list[Row]]:
        contacts = [[rows[0]]]
        for before, row in pairwise(rows):
            periods = (
                range(before["sent_ns"] // PERIOD_NS + 1, row["sent_ns"] // PERIOD_NS + 1) if self.moves else ()
            )
            away = any(
                math.isnan(self.where(row[end], period * PERIOD_NS)[0])
                for period in periods
                for end in ("sender", "receiver")
            )
            if row["seq"] != before["seq"] + 1 or away:
                contacts.append([])
            contacts[-1].append(row)
        return contacts

    def figures(self, rows: list[Row]) -> dict[str, Any]:
        heard = [row for row in rows if row["outcome"] == "delivered"]
        known = [d for d in map(self.distance_m, rows) if not math.isnan(d)]
        contacts = self.contacts(rows)
        gaps, area, lasted, peak = [], 0.0, 0.0, None
        for contact in contacts:
            heard_here = [row for row in contact if row["outcome"] == "delivered"]
            arrivals = sorted((row["arrival_ns"], row["sent_ns"]) for row in heard_here)
            gaps += [later[0] - earlier[0] for earlier, later in pairwise(arrivals)]
            news = [one for n, one in enumerate(arrivals) if all(one[1] > other[1] for other in arrivals[:n])]
            if not news:
                continue
            end_ns = max(news[-1][0], contact[-1]["sent_ns"])
            for (since_ns, sent_ns), (until_ns, _) in pairwise([*news, (end_ns, 0)]):
                young, old = (since_ns - sent_ns) / 1e6, (until_ns - sent_ns) / 1e6
                area, lasted = area + (old + young) / 2 * (old - young), lasted + old - young
                peak = max(peak or 0.0, old)
        return {
            "pairs": len(rows),
            "delivered": len(heard),
            "delivery_ratio": len(heard) / len(rows),
            "distance_mean_m": sum(known) / len(known) if known else None,
            "contacts": len(contacts),
            **spread("latency", [row["arrival_ns"] - row["sent_ns"] for row in heard]),
            **spread("inter_reception", gaps),
            "age_mean_ms": area / lasted if lasted else None,
            "age_peak_ms": peak,
        }


def spread(name: str, values_ns: list[int]) -> dict[str, float | None]:
    if not values_ns:
        return {f"{name}_{what}_ms": None for what in ("mean", "p95", "max")}
    ranked = sorted(values_ns)
    p95 = ranked[math.ceil(0.95 * len(ranked)) - 1]
    return {
        f"{name}_mean_ms": sum(ranked) / len(ranked) / 1e6,
        f"{name}_p95_ms": p95 / 1e6,
        f"{name}_max_ms": ranked[-1] / 1e6,
    }


def close(one: Any, other: Any) -> bool:
    if one is None or other is None:
        return one is other
    return bool(one == pytest.approx(other, rel=1e-9, abs=1e-9))


@pytest.mark.slow
@given(traces())
def test_links_are_as_the_plain_implementation_says(trace: tuple[list[Row], np.ndarray, bool]) -> None:
    rows, position_m, moves = trace
    plain = Plain(rows, position_m, moves)
    told = {(row["sender"], row["receiver"]): row for row in radio_metrics(evidence_of(*trace)).links.to_pylist()}
    assert told.keys() == plain.links.keys()
    for link, some in plain.links.items():
        for name, expected in plain.figures(some).items():
            assert close(told[link][name], expected), (link, name, told[link][name], expected)


@pytest.mark.slow
@given(traces(), st.floats(5, 300), st.floats(0, 0.9))
def test_near_and_later_receptions_are_those_of_a_trace_without_the_others(
    trace: tuple[list[Row], np.ndarray, bool], within_m: float, from_s: float
) -> None:
    rows, position_m, moves = trace
    plain = Plain(rows, position_m, moves)
    some = [row for row in rows if row["sent_ns"] >= round(from_s * 1e9) and plain.distance_m(row) <= within_m]
    told = radio_metrics(evidence_of(*trace), within_m=within_m, from_s=from_s)
    expected = radio_metrics(evidence_of(some, position_m, moves))
    assert told.links.equals(expected.links) and told.totals == expected.totals
    assert told.vehicles.equals(expected.vehicles) and told.distances.equals(expected.distances)


@pytest.mark.slow
@given(traces(), st.floats(5, 200))
def test_vehicles_distances_and_totals_add_up(trace: tuple[list[Row], np.ndarray, bool], bin_m: float) -> None:
    rows, position_m, moves = trace
    plain, told = Plain(rows, position_m, moves), radio_metrics(evidence_of(*trace), bin_m)
    pairs = [row for some in plain.links.values() for row in some]
    assert told.totals["pairs"] == len(pairs) and told.totals["links"] == len(plain.links)
    bins: dict[int, list[Row]] = defaultdict(list)
    for row in pairs:
        if not math.isnan(distance_m := plain.distance_m(row)):
            bins[int(distance_m // bin_m)].append(row)
    assert [round(row["from_m"] / bin_m) for row in told.distances.to_pylist()] == sorted(bins)
    for row in told.distances.to_pylist():
        some = bins[round(row["from_m"] / bin_m)]
        assert row["pairs"] == len(some)
        assert row["delivered"] == sum(one["outcome"] == "delivered" for one in some)
    links = told.links.to_pylist()
    for vehicle in told.vehicles.to_pylist():
        frames = {row["seq"] for row in rows if row["sender"] == vehicle["node"] and row["copy"] == 0}
        assert vehicle["frames"] == len(frames)
        mine = [link for link in links if link["receiver"] == vehicle["node"]]
        assert vehicle["heard_pairs"] == sum(link["pairs"] for link in mine)
        assert vehicle["heard_vehicles"] == sum(link["delivered"] > 0 for link in mine)
        ages = [link["age_mean_ms"] for link in mine if link["age_mean_ms"] is not None]
        assert close(vehicle["age_mean_ms"], sum(ages) / len(ages) if ages else None)
        sent = [link for link in links if link["sender"] == vehicle["node"]]
        total = sum(link["pairs"] for link in sent)
        assert close(
            vehicle["sent_delivery_ratio"], sum(link["delivered"] for link in sent) / total if total else None
        )


@pytest.mark.slow
def test_a_beacon_that_all_hear_is_as_old_as_its_period_and_its_way(tmp_path: Path) -> None:
    """Sent each 0.2 s, 3 ms on the way: the age goes from 3 to 203 ms, and is 103 ms in the mean."""
    vehicles = {"a": [(0, 9, still(0))], "b": [(0, 9, still(100))], "c": [(3, 6, along(0, 10))]}
    steady = {"loss": 0.0, "latency_ms": 3.0, "jitter_ms": 0.0, "access_jitter_ms": 0.0}
    scenario = scenario_of_trips(write_trips(tmp_path / "t.csv", vehicles), 9.0, radio=steady)
    told = radio_metrics(run_scenario(tmp_path / "run", scenario), bin_m=50)
    for link in told.links.to_pylist():
        assert link["delivery_ratio"] == 1.0 and link["contacts"] == 1
        assert link["inter_reception_mean_ms"] == pytest.approx(200)
        assert link["age_mean_ms"] == pytest.approx(103, abs=1.5) and link["age_peak_ms"] == pytest.approx(
            203, abs=1
        )
        assert link["latency_max_ms"] == pytest.approx(3.0, abs=0.1)
    stays = {row["node"]: row["frames"] for row in told.vehicles.to_pylist()}
    assert stays == {"a": 45, "b": 45, "c": 16}
    assert [row["from_m"] for row in told.distances.to_pylist()] == [0.0, 50.0, 100.0]


def test_how_busy_a_vehicle_finds_the_medium_is_of_the_time_in_which_it_is_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    vehicles = {"a": [(0, 9, still(0))], "b": [(0, 9, still(100))], "c": [(6, 9, still(50))]}
    path = write_trips(tmp_path / "t.csv", vehicles)
    run_scenario(tmp_path / "run", scenario_of_trips(path, 9.0, radio={"mac": {"kind": "80211p"}}))
    recorded = RecordedRun.open(tmp_path / "run")
    told = {row["node"]: row["busy_ratio_mean"] for row in radio_metrics(recorded).vehicles.to_pylist()}
    assert told["c"] == pytest.approx(recorded.busy_ratio[60:90, recorded.number["c"]].mean())
    assert told["c"] > told["a"] > 0, "three send while it is there, and two before"
    drawn: list[Line] = []
    monkeypatch.setattr(radio_figures, "time_figure", lambda lines, *_, **__: drawn.extend(lines))
    radio_figures.busy(Source(tmp_path / "run"))
    assert drawn[0].value[:60] == pytest.approx(100 * recorded.busy_ratio[:60, :2].mean(axis=1))


def test_frames_that_are_lost_on_their_way_to_who_is_down_are_no_attempts(tmp_path: Path) -> None:
    fault = {"kind": "kill", "nodes": ["v03"], "at_s": 1.0, "duration_s": 2.0}
    run, radio = {"duration_s": 5.0, "settle_s": 1.0}, {"loss": 0.3, "range_m": 1e5}
    sections = {"run": run, "network": {"vehicles": 3}, "radio": radio}
    program = {"entry": "agents.beacon:main"}
    recorded = run_scenario(tmp_path, Scenario.model_validate(sections | {"program": program, "fault": [fault]}))
    links = [link for link in radio_metrics(recorded).links.to_pylist() if link["receiver"] == "v03"]
    lost = recorded.outcome_is("lost")[rows_of_pairs(recorded)]
    sent_s, to = recorded.sent_ns[rows_of_pairs(recorded)] / 1e9, recorded.receiver[rows_of_pairs(recorded)]
    assert not np.any((to == recorded.number["v03"]) & (sent_s > 1.0) & (sent_s < 3.0)) and lost.any()
    assert [link["contacts"] for link in links] == [2, 2]


def test_a_run_in_which_nothing_was_sent_has_no_links(tmp_path: Path) -> None:
    told = radio_metrics(evidence_of([], np.zeros((1, 3, 2)), moves=False))
    assert not len(told.links) and not len(told.distances) and len(told.vehicles) == 3
    assert told.totals["delivery_ratio"] is None


@pytest.mark.slow
def test_figures_of_frames_to_one_vehicle_are_what_the_program_was_told(tmp_path: Path) -> None:
    """Also of those that faults have lost or altered, and without those that faults have sent again."""
    lossy = [
        {"kind": "loss", "at_s": 0.4, "duration_s": 0.2, "probability": 1.0, "nodes": ["b"]},
        {"kind": "corrupt", "at_s": 0.0, "duration_s": 0.2, "probability": 1.0},
        {"kind": "StaleMessages", "at_s": 0.6, "duration_s": 0.2, "age_s": 0.05, "nodes": ["a"]},
    ]
    recorded = exchange_run(tmp_path, [*COPYING, *lossy])
    told = [event.details["details"] for event in recorded.event("event")]
    assert len(told) == 80 and {row["cause"] for row in recorded.trace.to_pylist()} >= {"loss-2", "corrupt-3"}
    figures = unicast_figures(recorded)
    assert figures is not None
    assert figures.sent == len(told)
    assert figures.acknowledged == sum(each["delivered"] for each in told)
    assert figures.retries == sum(each["attempts"] - 1 for each in told)
    rows = [row for row in recorded.trace.to_pylist() if row["attempt"] and not row["copy"]]
    late = unicast_figures(recorded, from_s=0.5)
    assert late is not None and late.sent < figures.sent
    assert late.sent == len({(row["sender"], row["seq"]) for row in rows if row["sent_ns"] >= 5e8})
    assert unicast_figures(recorded, within_m=0.0) is None
