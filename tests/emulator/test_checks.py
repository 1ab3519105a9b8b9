"""The verdict is never better than what was observed: missing evidence is unknown, impossible evidence invalid."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from emulator.observe.checks import CheckResult, Evidence, NotExercised, Verdict, check_run, judge
from emulator.observe.run_folder import Event, RunFolder, read_events
from emulator.observe.trace import read_trace
from emulator.run.conclude import conclude
from emulator.run.emulation import Emulation
from emulator.run.simulate import simulate
from emulator.world.world import build_world
from vnet.errors import VnetError
from vnet.link.node import Node
from vnet.scenario import Scenario


async def first_only(node: Node) -> None:
    """A program in which one vehicle talks and the others listen."""
    async for _ in node.gnss:
        if node.id == "v01":
            await node.radio.broadcast(b"hello")


def run(folder: Path, program: str = "agents.beacon:main", vehicles: int = 5, **sections: dict) -> Evidence:
    """Simulate a small dense network and keep it in `folder`."""
    settings = {"network": {"vehicles": vehicles, "layout": "dense"}, "program": {"entry": program}}
    scenario = Scenario.model_validate({"run": {"duration_s": 1.0}, **settings, **sections})
    emulation = Emulation(scenario, build_world(scenario), RunFolder.create(folder, scenario))
    wall_s, _ = simulate(emulation)
    conclude(emulation, wall_s, "simulate")
    tables = (pq.read_table(folder / f"{name}.parquet") for name in ("states", "metrics"))
    return Evidence(scenario, read_trace(folder / "trace.parquet"), *tables, read_events(folder))


@pytest.fixture(scope="module")
def evidence(tmp_path_factory: pytest.TempPathFactory) -> Evidence:
    return run(tmp_path_factory.mktemp("checks") / "run", radio={"loss": 0.2})


def result(evidence: Evidence, name: str) -> CheckResult | NotExercised:
    judgement = judge(evidence)
    return next(check for check in [*judgement.checks, *judgement.not_exercised] if check.name == name)


def verdict(evidence: Evidence, name: str) -> Verdict:
    found = result(evidence, name)
    assert isinstance(found, CheckResult)
    return found.verdict


def with_names(table: pa.Table, column: str, row: int, name: str) -> pa.Table:
    names = table[column].cast(pa.string()).to_pylist()
    names[row] = name
    return table.set_column(
        table.column_names.index(column), column, pa.array(names, pa.string()).dictionary_encode()
    )


def test_without_events_nothing_is_known_of_the_course_of_a_run(evidence: Evidence) -> None:
    silent = replace(evidence, events=[])
    assert verdict(silent, "agents_alive") is Verdict.UNKNOWN
    assert verdict(silent, "progress") is Verdict.UNKNOWN
    assert verdict(replace(evidence, events=[Event(0, "started", None, {})]), "progress") is Verdict.UNKNOWN


@pytest.mark.parametrize("table", ["states", "metrics"])
def test_a_run_that_kept_half_its_periods_is_unknown(evidence: Evidence, table: str) -> None:
    rows = getattr(evidence, table)
    half = replace(evidence, **{table: rows.slice(0, len(rows) // 2)})
    assert verdict(half, "progress") is Verdict.UNKNOWN


def test_a_run_shorter_than_a_period_is_unknown_and_not_a_crash(tmp_path: Path) -> None:
    judgement = judge(run(tmp_path / "run", run={"duration_s": 0.05}))
    unknown = {check.name for check in judgement.checks if check.verdict is Verdict.UNKNOWN}
    assert unknown == {"conservation", "range", "peer_cap", "loss_rate"}
    assert check_run(tmp_path / "run").exit_status == 3


def test_one_vehicle_alone_has_no_radio_to_judge(tmp_path: Path) -> None:
    judgement = judge(run(tmp_path / "run", vehicles=1))
    assert judgement.verdict is Verdict.VALID
    assert {"conservation", "range", "peer_cap", "loss_rate"} <= {left.name for left in judgement.not_exercised}


def test_a_cap_that_could_act_and_never_did_is_unknown(tmp_path: Path) -> None:
    radio = {"max_peers": 2}
    evidence = run(tmp_path / "run", program=f"{__name__}:first_only", vehicles=6, radio=radio)
    assert verdict(evidence, "peer_cap") is Verdict.VALID
    uncapped = evidence.trace.filter(pa.array(~evidence.outcome_is("peer_cap")))
    assert verdict(replace(evidence, trace=uncapped), "peer_cap") is Verdict.UNKNOWN


def test_an_outcome_outside_the_closed_set_breaks_conservation(evidence: Evidence) -> None:
    for word in ("vanished", "out_of_range", "pending"):
        forged = replace(evidence, trace=with_names(evidence.trace, "outcome", 3, word))
        assert verdict(forged, "conservation") is Verdict.INVALID


def test_a_row_of_a_receiver_that_was_not_in_range_breaks_conservation(evidence: Evidence) -> None:
    row = int(np.flatnonzero(evidence.outcome_is("lost"))[0])
    sender = evidence.trace["sender"].cast(pa.string()).to_pylist()[row]
    forged = result(replace(evidence, trace=with_names(evidence.trace, "receiver", row, sender)), "conservation")
    assert isinstance(forged, CheckResult)
    assert forged.verdict is Verdict.INVALID
    assert forged.figures["not_in_range"] == 1


def test_a_trace_of_another_run_is_refused_in_one_line(evidence: Evidence) -> None:
    with pytest.raises(VnetError, match="'ghost'"):
        judge(replace(evidence, trace=with_names(evidence.trace, "receiver", 0, "ghost")))


def test_deliveries_that_were_never_timed_leave_real_time_unknown(evidence: Evidence) -> None:
    settings = evidence.scenario.run.model_copy(update={"pacing": "realtime"})
    scenario = evidence.scenario.model_copy(update={"run": settings})
    for count, total, expected in ((0, 0, Verdict.UNKNOWN), (1, 5000, Verdict.VALID), (9, 5000, Verdict.UNKNOWN)):
        late = Event(0, "late_deliveries", None, {"count": count, "total": total, "p99_ms": 1.0})
        timed = replace(evidence, scenario=scenario, events=[*evidence.events, late])
        assert verdict(timed, "kept_up") is expected
