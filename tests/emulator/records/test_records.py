"""Records of a run and their judgement: damage to a trace is found by the check whose business it is."""

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest

from emulator.checks.judge import NotExercised, Verdict, judge
from emulator.radio.trace import sha256_of_table
from emulator.records.events import Event
from emulator.records.recorded_run import RecordedRun
from emulator.scenario.program import Program
from emulator.scenario.scenario import Scenario
from tests.support.recorded import recorded as record_run

COOPERATIVE = Program(entry="agents.cooperative:main")


def beacons(folder: Path, **radio: float) -> RecordedRun:
    """A small simulated run."""
    scenario = Scenario.model_validate(
        {"run": {"duration_s": 2.0}, "network": {"vehicles": 6, "layout": "dense"}, "radio": radio}
    )
    record_run(scenario, folder)
    return RecordedRun(
        scenario,
        pq.read_table(folder / "trace.parquet"),
        pq.read_table(folder / "states.parquet"),
        pq.read_table(folder / "metrics.parquet"),
        RecordedRun.open(folder).events,
    )


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> RecordedRun:
    return beacons(tmp_path_factory.mktemp("observe") / "run", loss=0.2, max_peers=2)


def verdicts(recorded: RecordedRun, **changes: object) -> dict[str, Verdict]:
    fields = {name: getattr(recorded, name) for name in ("scenario", "trace", "states", "metrics", "events")}
    return {check.name: check.verdict for check in judge(RecordedRun(**{**fields, **changes})).checks}


@pytest.mark.slow
def test_a_missing_frame_breaks_conservation(recorded: RecordedRun) -> None:
    first = recorded.trace.slice(0, 1).to_pylist()[0]
    same = pc.and_(
        pc.equal(recorded.trace["sender"].cast(pa.string()), first["sender"]),
        pc.equal(recorded.trace["seq"], first["seq"]),
    )
    found = verdicts(recorded, trace=recorded.trace.filter(pc.invert(same)))
    assert {name for name, verdict in found.items() if verdict is Verdict.INVALID} == {"conservation"}


@pytest.mark.parametrize(
    ("kind", "details", "check", "verdict"),
    [
        ("died", {"how": "SIGKILL"}, "agents_alive", Verdict.INVALID),
        ("crashed", {"error": "ValueError"}, "agents_alive", Verdict.INVALID),
        ("spun", {"error": "spin"}, "progress", Verdict.INVALID),
        ("stalled", {"error": "no yield"}, "progress", Verdict.UNKNOWN),
        ("interrupted", {}, "progress", Verdict.UNKNOWN),
        ("transport_gap", {"count": 2}, "transport", Verdict.UNKNOWN),
    ],
)
def test_events_decide_their_checks(
    recorded: RecordedRun, kind: str, details: dict[str, Any], check: str, verdict: Verdict
) -> None:
    event = Event(1_999_000_000, kind, "v01", details)
    assert verdicts(recorded, events=[*recorded.events, event])[check] is verdict


def test_a_program_that_sends_nothing_leaves_checks_unknown(recorded: RecordedRun) -> None:
    empty = verdicts(recorded, trace=recorded.trace.slice(0, 0))
    assert {name for name, verdict in empty.items() if verdict is Verdict.UNKNOWN} == {
        "conservation", "range", "peer_cap", "loss_rate", "latency", "isolation",
    }  # fmt: skip


@pytest.mark.slow
def test_a_cap_that_cannot_act_is_left_out_with_its_reason(tmp_path: Path) -> None:
    judgement = judge(beacons(tmp_path / "run"))
    assert judgement.verdict is Verdict.VALID
    assert NotExercised("peer_cap", "no receiver has more than 30 senders in range (at most 5)") in (
        judgement.not_exercised
    )


def test_the_hash_survives_the_file_and_sees_every_cell(recorded: RecordedRun, tmp_path: Path) -> None:
    pq.write_table(recorded.trace, tmp_path / "again.parquet", compression="none")
    assert sha256_of_table(pq.read_table(tmp_path / "again.parquet")) == sha256_of_table(recorded.trace)
    mask = np.arange(len(recorded.trace)) == 0
    for column in ("sent_ns", "seq", "size_bytes", "copy"):
        values = np.array(recorded.trace[column].to_pylist())
        values[mask] += 1
        index = recorded.trace.column_names.index(column)
        changed = recorded.trace.set_column(index, column, pa.array(values, recorded.trace[column].type))
        assert sha256_of_table(changed) != sha256_of_table(recorded.trace)
