"""The verdict is never better than what was observed: missing evidence is unknown, impossible evidence invalid."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pytest

from emulator.checks.judge import CheckResult, NotExercised, Verdict, check_run, judge
from emulator.records.distributions import binomial_interval
from emulator.records.events import Event
from emulator.records.recorded_run import RecordedRun
from emulator.scenario.scenario import Scenario
from tests.support.recorded import recorded as record_run
from vnet.errors import VnetError
from vnet.node import Node


async def first_only(node: Node) -> None:
    """A program in which one vehicle talks and the others listen."""
    async for _ in node.gnss:
        if node.id == "v01":
            await node.radio.broadcast(b"hello")


def run(
    folder: Path, program: str = "agents.beacon:main", vehicles: int = 5, **sections: dict[str, Any]
) -> RecordedRun:
    """Simulate a small dense network and keep it in `folder`."""
    settings = {"network": {"vehicles": vehicles, "layout": "dense"}, "program": {"entry": program}}
    return run_scenario(folder, Scenario.model_validate({"run": {"duration_s": 1.0}, **settings, **sections}))


def run_scenario(folder: Path, scenario: Scenario) -> RecordedRun:
    record_run(scenario, folder)
    run = RecordedRun.open(folder)
    return RecordedRun(scenario, run.trace, run.states, run.metrics, run.events, world=run.world)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> RecordedRun:
    return run(tmp_path_factory.mktemp("checks") / "run", radio={"loss": 0.2})


def result(recorded: RecordedRun, name: str) -> CheckResult | NotExercised:
    judgement = judge(recorded)
    findings: list[CheckResult | NotExercised] = [*judgement.checks, *judgement.not_exercised]
    return next(check for check in findings if check.name == name)


def checked(recorded: RecordedRun, name: str) -> CheckResult:
    """The result of a check that the run exercises."""
    found = result(recorded, name)
    assert isinstance(found, CheckResult)
    return found


def verdict(recorded: RecordedRun, name: str) -> Verdict:
    return checked(recorded, name).verdict


def with_names(table: pa.Table, column: str, row: int, name: str) -> pa.Table:
    """The trace with another name in one row; with another outcome, its time of arrival fits."""
    names = table[column].cast(pa.string()).to_pylist()
    names[row] = name
    changed = table.set_column(table.column_names.index(column), column, pa.array(names).dictionary_encode())
    return timely(changed) if column == "outcome" else changed


def timely(table: pa.Table) -> pa.Table:
    """The trace with an arrival, of usual latency, for just those rows whose outcome wants one."""
    arrived = pc.is_in(table["outcome"].cast(pa.string()), pa.array(["delivered", "receiver_down", "transport"]))
    usual_ns = pc.add(table["sent_ns"], 3_020_000)
    arrival_ns = pc.if_else(arrived, pc.coalesce(table["arrival_ns"], usual_ns), pa.scalar(None, pa.int64()))
    return table.set_column(table.column_names.index("arrival_ns"), "arrival_ns", arrival_ns)


def figures(check: CheckResult) -> dict[str, Any]:
    """The figures of a check, without the rows that it shows."""
    return {name: figure for name, figure in check.figures.items() if name != "rows"}


@pytest.mark.slow
def test_without_events_nothing_is_known_of_the_course_of_a_run(recorded: RecordedRun) -> None:
    silent = replace(recorded, events=[])
    assert verdict(silent, "agents_alive") is Verdict.UNKNOWN
    assert verdict(silent, "progress") is Verdict.UNKNOWN
    assert verdict(replace(recorded, events=[Event(0, "started", None, {})]), "progress") is Verdict.UNKNOWN
    refused = Event(5, "stalled", "v02", {"error": "no yield", "where": "", "refused": "wrong number"})
    told = checked(replace(recorded, events=[*recorded.events, refused]), "progress").text
    assert "refused: wrong number" in told and "hangs" not in told


@pytest.mark.parametrize("table", ["states", "metrics"])
def test_a_run_that_kept_half_its_periods_is_unknown(recorded: RecordedRun, table: str) -> None:
    rows = getattr(recorded, table)
    half = replace(recorded, **{table: rows.slice(0, len(rows) // 2)})
    assert verdict(half, "progress") is Verdict.UNKNOWN


@pytest.mark.slow
def test_a_run_shorter_than_a_period_is_unknown_and_not_a_crash(tmp_path: Path) -> None:
    judgement = judge(run(tmp_path / "run", run={"duration_s": 0.05}))
    unknown = {check.name for check in judgement.checks if check.verdict is Verdict.UNKNOWN}
    assert unknown == {"conservation", "range", "peer_cap", "loss_rate"}
    assert check_run(tmp_path / "run").exit_status == 3


@pytest.mark.slow
def test_one_vehicle_alone_has_no_radio_to_judge(tmp_path: Path) -> None:
    judgement = judge(run(tmp_path / "run", vehicles=1))
    assert judgement.verdict is Verdict.VALID
    assert {"conservation", "range", "peer_cap", "loss_rate"} <= {left.name for left in judgement.not_exercised}


@pytest.mark.slow
def test_a_cap_that_could_act_and_never_did_is_unknown(tmp_path: Path) -> None:
    radio = {"max_peers": 2}
    recorded = run(tmp_path / "run", program=f"{__name__}:first_only", vehicles=6, radio=radio)
    assert verdict(recorded, "peer_cap") is Verdict.VALID
    uncapped = recorded.trace.filter(pa.array(~recorded.outcome_is("peer_cap")))
    assert verdict(replace(recorded, trace=uncapped), "peer_cap") is Verdict.UNKNOWN


def test_an_outcome_outside_the_closed_set_breaks_conservation(recorded: RecordedRun) -> None:
    for word in ("vanished", "out_of_range", "pending"):
        forged = replace(recorded, trace=with_names(recorded.trace, "outcome", 3, word))
        assert verdict(forged, "conservation") is Verdict.INVALID


def test_a_row_of_a_receiver_that_was_not_in_range_breaks_conservation(recorded: RecordedRun) -> None:
    row = int(np.flatnonzero(recorded.outcome_is("lost"))[0])
    sender = recorded.trace["sender"].cast(pa.string()).to_pylist()[row]
    forged = checked(replace(recorded, trace=with_names(recorded.trace, "receiver", row, sender)), "conservation")
    assert forged.verdict is Verdict.INVALID
    assert forged.figures["not_in_range"] == 1


def test_a_trace_of_another_run_is_refused_in_one_line(recorded: RecordedRun) -> None:
    with pytest.raises(VnetError, match="'ghost'"):
        judge(replace(recorded, trace=with_names(recorded.trace, "receiver", 0, "ghost")))


def test_deliveries_that_were_never_timed_leave_real_time_unknown(recorded: RecordedRun) -> None:
    settings = recorded.scenario.run.model_copy(update={"pacing": "realtime"})
    scenario = recorded.scenario.model_copy(update={"run": settings})
    for count, total, expected in (
        (0, 0, Verdict.UNKNOWN),
        (1, 776, Verdict.VALID),
        (9, 776, Verdict.UNKNOWN),
        (9, 5000, Verdict.VALID),
        (30, 5000, Verdict.UNKNOWN),
        (1100, 1_000_000, Verdict.UNKNOWN),
    ):
        late = Event(0, "late_deliveries", None, {"count": count, "total": total, "p99_ms": 1.0})
        timed = replace(recorded, scenario=scenario, events=[*recorded.events, late])
        assert verdict(timed, "kept_up") is expected


@pytest.mark.slow
@pytest.mark.parametrize("pacing", ["realtime", "lockstep"])
def test_lateness_of_the_machine_is_not_the_radios(tmp_path: Path, pacing: str) -> None:
    recorded = four(tmp_path, "agents.cooperative:main")
    settings = recorded.scenario.run.model_copy(update={"pacing": pacing})
    late_ns = np.where(recorded.outcome_is("delivered"), 150_000_000, 0)
    arrival = pa.array(recorded.arrival_ns + late_ns, mask=recorded.arrival_ns < 0)
    index = recorded.trace.column_names.index("arrival_ns")
    trace = recorded.trace.set_column(index, "arrival_ns", arrival).append_column("late_ns", pa.array(late_ns))
    scenario = recorded.scenario.model_copy(update={"run": settings})
    late = replace(recorded, scenario=scenario, trace=trace)
    expected = Verdict.VALID if pacing == "realtime" else Verdict.INVALID
    assert verdict(late, "latency") is expected
    assert verdict(late, "isolation") is expected


HEADER = "id,x_m,y_m,heading_rad"


def four(folder: Path, program: str = "agents.beacon:main", **sections: dict[str, Any]) -> RecordedRun:
    """Four vehicles on a line, a kilometre apart; with a range of 2.1 km the ends do not hear each other."""
    lines = [HEADER, *(f"v{number},{1000 * number},0,1.5" for number in range(4))]
    (folder / "four.csv").write_text("\n".join(lines) + "\n")
    network = {"kind": "file", "path": str(folder / "four.csv")}
    radio = {"range_m": 2100.0, "loss": 0.2, **sections.pop("radio", {})}
    settings = {"run": {"duration_s": 1.0}, "network": network, "radio": radio, "program": {"entry": program}}
    return run_scenario(folder / "run", Scenario.model_validate({**settings, **sections}))


@pytest.fixture(scope="module")
def line(tmp_path_factory: pytest.TempPathFactory) -> RecordedRun:
    return four(tmp_path_factory.mktemp("line"))


def damaged(recorded: RecordedRun, trace: pa.Table) -> dict[str, CheckResult]:
    """The checks that a changed trace turns away from valid."""
    checks = judge(replace(recorded, trace=trace)).checks
    return {check.name: check for check in checks if check.verdict is not Verdict.VALID}


def first(recorded: RecordedRun, outcome: str) -> int:
    return int(np.flatnonzero(recorded.outcome_is(outcome))[0])


def without(table: pa.Table, row: int) -> pa.Table:
    return pa.concat_tables([table.slice(0, row), table.slice(row + 1)])


def with_lost(recorded: RecordedRun, count: int) -> pa.Table:
    """The trace with exactly `count` of the pairs that came as far as the loss lost."""
    drawn = np.flatnonzero(recorded.outcome_is("lost", "delivered"))
    names = np.array(recorded.trace["outcome"].cast(pa.string()).to_pylist(), dtype=object)
    names[drawn] = "delivered"
    names[drawn[:count]] = "lost"
    index = recorded.trace.column_names.index("outcome")
    column = pa.array(names.tolist(), pa.string()).dictionary_encode()
    return timely(recorded.trace.set_column(index, "outcome", column))


@pytest.mark.slow
def test_an_honest_line_of_four_is_valid_with_its_figures(line: RecordedRun) -> None:
    assert damaged(line, line.trace) == {}
    assert checked(line, "conservation").figures == {
        "frames": 40,
        "pairs": 40 * 10 // 4,  # of 12 ordered pairs all but v0–v3 and v3–v0 are in range
        "repeated": 0,
        "wrong_count": 0,
        "not_in_range": 0,
        "undecided": 0,
        "orphans": 0,
        "disordered": 0,
        "mistimed": 0,
        "missing_frames": 0,
    }
    assert checked(line, "range").figures == {"delivered": int(line.outcome_is("delivered").sum()), "beyond": 0}


@pytest.mark.parametrize("outcome", ["lost", "delivered"])
def test_a_dropped_row_is_a_frame_with_too_few_pairs(line: RecordedRun, outcome: str) -> None:
    found = damaged(line, without(line.trace, first(line, outcome)))
    assert {name: check.verdict for name, check in found.items()} == {"conservation": Verdict.INVALID}
    assert found["conservation"].figures["wrong_count"] == 1
    assert found["conservation"].figures["pairs"] == len(line.trace) - 1


def test_a_repeated_row_is_one_too_many(line: RecordedRun) -> None:
    row = first(line, "lost")
    found = damaged(line, pa.concat_tables([line.trace, line.trace.slice(row, 1)]))
    assert set(found) == {"conservation", "row_order"}
    assert found["conservation"].figures["repeated"] == 1


def test_a_delivery_to_someone_out_of_range_breaks_range_and_conservation(line: RecordedRun) -> None:
    senders = line.nodes("sender")
    row = int(np.flatnonzero(line.outcome_is("delivered") & (senders == 0))[0])
    found = damaged(line, with_names(line.trace, "receiver", row, "v3"))
    assert set(found) == {"conservation", "range", "row_order"}
    assert figures(found["range"]) == {"delivered": int(line.outcome_is("delivered").sum()), "beyond": 1}
    assert found["range"].text == "1 delivery beyond range"
    assert found["conservation"].figures["not_in_range"] == 1


def test_the_loss_rate_is_valid_up_to_the_border_of_its_band_and_invalid_beyond(line: RecordedRun) -> None:
    drawn = int(line.outcome_is("lost", "delivered").sum())
    low, high = binomial_interval(1 - 1e-6, drawn, 0.2)
    assert damaged(line, with_lost(line, low)) == damaged(line, with_lost(line, high)) == {}
    for lost in (low - 1, high + 1):
        found = damaged(line, with_lost(line, lost))
        assert {name: check.verdict for name, check in found.items()} == {"loss_rate": Verdict.INVALID}
        assert figures(found["loss_rate"]) == {
            "lost": lost,
            "pairs": drawn,
            "rate": lost / drawn,
            "expected": 0.2,
            "low": low,
            "high": high,
        }


@pytest.mark.slow
@pytest.mark.parametrize(("loss", "wrong"), [(0.0, 1), (1.0, -1)])
def test_without_chance_a_single_pair_decides(tmp_path: Path, loss: float, wrong: int) -> None:
    recorded = four(tmp_path, radio={"loss": loss})
    lost = int(recorded.outcome_is("lost").sum())
    assert verdict(recorded, "loss_rate") is Verdict.VALID
    assert damaged(recorded, with_lost(recorded, lost + wrong))["loss_rate"].verdict is Verdict.INVALID


@pytest.mark.slow
def test_when_everything_is_lost_nothing_is_known_of_the_range(tmp_path: Path) -> None:
    recorded = four(tmp_path, radio={"loss": 1.0})
    assert damaged(recorded, recorded.trace).keys() == {"range", "latency", "isolation"}
    assert verdict(recorded, "range") is Verdict.UNKNOWN
    assert check_run(tmp_path / "run").exit_status == judge(recorded).exit_status == 3


async def dies_early(node: Node) -> None:
    """All talk; the second vehicle fails at its sixth fix."""
    count = 0
    async for _ in node.gnss:
        count += 1
        if node.id == "v1" and count == 6:
            raise RuntimeError("tired")
        await node.radio.broadcast(b"hello")


@pytest.mark.slow
def test_a_death_makes_room_under_the_cap_and_is_told_with_its_figures(tmp_path: Path) -> None:
    recorded = four(tmp_path, f"{__name__}:dies_early", radio={"max_peers": 1, "loss": 0.0})
    assert verdict(recorded, "peer_cap") is Verdict.VALID
    alive = checked(recorded, "agents_alive")
    assert alive.verdict is Verdict.INVALID
    assert [(gone["node"], gone["time_ns"], gone["kind"]) for gone in alive.figures["gone"]] == [
        ("v1", 500_000_000, "crashed")
    ]
    assert judge(recorded).exit_status == check_run(tmp_path / "run").exit_status == 1
    # v0 hears v1 as long as v1 lives, and then v2: without the death v2 would be beyond the cap for ever.
    wrong = checked(replace(recorded, events=[e for e in recorded.events if e.kind != "crashed"]), "peer_cap")
    assert wrong.verdict is Verdict.INVALID
    assert wrong.figures["wrong"] > 0


@pytest.mark.slow
def test_each_pair_on_the_wrong_side_of_the_cap_is_counted(tmp_path: Path) -> None:
    recorded = four(tmp_path, radio={"max_peers": 1, "loss": 0.0})
    capped, heard = first(recorded, "peer_cap"), first(recorded, "delivered")
    forged = with_names(with_names(recorded.trace, "outcome", capped, "delivered"), "outcome", heard, "peer_cap")
    found = damaged(recorded, forged)
    assert {name: check.verdict for name, check in found.items()} == {"peer_cap": Verdict.INVALID}
    assert figures(found["peer_cap"]) == {
        "cap": 1,
        "largest_in_range": 3,
        "capped": int(recorded.outcome_is("peer_cap").sum()),
        "wrong": 2,
    }


def test_deliveries_that_the_machine_lost_are_unknown_and_not_the_radio(line: RecordedRun) -> None:
    found = damaged(line, with_names(line.trace, "outcome", first(line, "delivered"), "transport"))
    assert {name: check.verdict for name, check in found.items()} == {"transport": Verdict.UNKNOWN}
    assert found["transport"].figures == {"gaps": 0, "lost": 1}


async def reports_nan(node: Node) -> None:
    """Talks like the others, but believes nonsense."""
    async for fix in node.gnss:
        await node.radio.broadcast(b"hello")
        node.report(fix.position_m, fix.covariance_m2, x=float("nan") if node.id == "v2" else 0.0)


@pytest.mark.slow
def test_numbers_that_are_none_are_counted(tmp_path: Path) -> None:
    found = checked(four(tmp_path, f"{__name__}:reports_nan"), "finite")
    assert found.verdict is Verdict.INVALID
    assert figures(found) == {"reports": 40, "not_finite": 10}
    assert found.text == "10 reports with NaN or infinity: x of v2"


@pytest.mark.slow
def test_programs_that_report_nothing_have_nothing_to_be_finite(tmp_path: Path) -> None:
    recorded = four(tmp_path, f"{__name__}:dies_early")
    assert result(recorded, "finite") == NotExercised("finite", "the program reports nothing")


def test_invalid_wins_over_unknown_over_valid_in_a_run(line: RecordedRun) -> None:
    unknown = with_names(line.trace, "outcome", first(line, "delivered"), "transport")
    both = without(unknown, first(line, "lost"))
    statuses = [judge(replace(line, trace=trace)).exit_status for trace in (line.trace, unknown, both)]
    assert statuses == [0, 3, 1]


FORK = [[0, 0, 0, 0], [1, 0, 0, 0], [0, 1, 0, 0], [1, 1, 1, 0]]  # 0 → 1 → 2, and 3 hears them all


@pytest.mark.slow
@pytest.mark.parametrize("written", [True, False])
def test_a_matrix_run_is_judged_by_its_matrix(tmp_path: Path, written: bool) -> None:
    """Vehicles 0 and 3 are out of range, 1 and 0 well within it: only the matrix explains who heard whom."""
    path = tmp_path / "links.csv"
    path.write_text("\n".join(",".join(map(str, row)) for row in FORK))
    recorded = four(tmp_path, radio={"links": path if written else FORK, "max_peers": 2})
    assert damaged(recorded, recorded.trace) == {}
    assert verdict(recorded, "peer_cap") is Verdict.VALID, "the cap of 2 acts on vehicle 3"
    assert check_run(tmp_path / "run").verdict is Verdict.VALID
    pairs = set(zip(recorded.nodes("sender").tolist(), recorded.nodes("receiver").tolist(), strict=True))
    assert pairs == {(0, 1), (1, 2), (0, 3), (1, 3), (2, 3)}
    disc = recorded.scenario.radio.model_copy(update={"links": None})
    by_range = replace(recorded, scenario=recorded.scenario.model_copy(update={"radio": disc}))
    assert verdict(by_range, "conservation") is Verdict.INVALID


@pytest.mark.slow
def test_a_delivery_against_the_matrix_breaks_range_and_conservation(tmp_path: Path) -> None:
    recorded = four(tmp_path, radio={"links": FORK, "loss": 0.0})
    row = int(np.flatnonzero((recorded.nodes("sender") == 1) & (recorded.nodes("receiver") == 2))[0])
    found = damaged(recorded, with_names(recorded.trace, "receiver", row, "v0"))  # within range, but deaf to v1
    verdicts = {name: check.verdict for name, check in found.items()}
    assert verdicts == {"conservation": Verdict.INVALID, "range": Verdict.INVALID}
    assert found["range"].figures["beyond"] == found["conservation"].figures["not_in_range"] == 1


@pytest.mark.slow
def test_a_capped_pair_that_was_delivered_is_found_in_a_matrix_run(tmp_path: Path) -> None:
    recorded = four(tmp_path, radio={"links": FORK, "loss": 0.0, "max_peers": 2})
    forged = with_names(recorded.trace, "outcome", first(recorded, "peer_cap"), "delivered")
    assert set(damaged(recorded, forged)) == {"peer_cap"}


@pytest.mark.slow
def test_a_matrix_in_which_nobody_hears_leaves_no_radio_to_judge(tmp_path: Path) -> None:
    judgement = judge(four(tmp_path, radio={"links": [[0] * 4] * 4}))
    assert judgement.verdict is Verdict.VALID
    assert {"conservation", "range", "peer_cap", "loss_rate"} <= {left.name for left in judgement.not_exercised}


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["trace.parquet", "states.parquet", "metrics.parquet", "verdict.json", "events.jsonl"]
)
def test_a_folder_without_one_of_its_files_is_refused_in_one_line(name: str, tmp_path: Path) -> None:
    four(tmp_path)
    (tmp_path / "run" / name).unlink()
    with pytest.raises(VnetError, match=r"not the folder of a finished run") as refused:
        check_run(tmp_path / "run")
    assert "\n" not in str(refused.value)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["trace.parquet", "states.parquet", "metrics.parquet", "verdict.json"])
def test_a_file_that_was_cut_short_is_refused(name: str, tmp_path: Path) -> None:
    four(tmp_path)
    path = tmp_path / "run" / name
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(VnetError, match=rf"{name}: (cannot be read|not JSON)"):
        check_run(tmp_path / "run")


def test_a_cap_that_acts_first_in_a_period_that_the_run_does_not_complete_is_not_judged(tmp_path: Path) -> None:
    rows = ["a,0,0,0", "a,5,0,0", "b,0,50,0", "b,5,50,0", "c,0,160,0", "c,5,10,0"]
    (tmp_path / "trips.csv").write_text("\n".join(["id,time_s,x_m,y_m", *rows]))
    scenario = {
        "run": {"duration_s": 2.5, "settle_s": 0.0},
        "network": {"kind": "trips", "path": str(tmp_path / "trips.csv")},
        "world": {"gnss": {"rate_hz": 0.5}},
        "radio": {"range_m": 100.0, "max_peers": 1},
        "program": {"entry": "tests.emulator.checks.test_faults:talks_on"},
    }
    recorded = run_scenario(tmp_path / "run", Scenario.model_validate(scenario))
    assert recorded.outcome_is("peer_cap").any()
    assert isinstance(result(recorded, "peer_cap"), NotExercised)
