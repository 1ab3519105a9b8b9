"""Records of a run and their judgement: damage to a trace is found by the check whose business it is."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest

from emulator.checks.judge import CheckResult, Judgement, NotExercised, Verdict, check_run, judge
from emulator.drivers.conclude import conclude
from emulator.drivers.emulation import Emulation
from emulator.drivers.simulate import simulate
from emulator.radio.trace import sha256_of_table
from emulator.records.events import Event, EventKind
from emulator.records.metrics import Metrics, summarize
from emulator.records.recorded_run import RecordedRun
from emulator.records.run_folder import RunFolder
from emulator.scenario.program import Program
from emulator.scenario.scenario import Scenario
from emulator.world.world import Instant, build_world
from vnet.errors import VnetError
from vnet.reports import Report

COOPERATIVE = Program(entry="agents.cooperative:main")


def beacons(folder: Path, **radio: float) -> RecordedRun:
    """A small simulated run."""
    scenario = Scenario.model_validate(
        {"run": {"duration_s": 2.0}, "network": {"vehicles": 6, "layout": "dense"}, "radio": radio}
    )
    emulation = Emulation(scenario, build_world(scenario), RunFolder.create(folder, scenario))
    wall_s, _ = simulate(emulation)
    conclude(emulation, wall_s, "simulate")
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


def only_invalid(recorded: RecordedRun, trace: pa.Table) -> set[str]:
    return {name for name, verdict in verdicts(recorded, trace=trace).items() if verdict is Verdict.INVALID}


def outcome_set(table: pa.Table, mask: np.ndarray, outcome: str) -> pa.Table:
    names = np.array(table["outcome"].cast(pa.string()).to_pylist(), dtype=object)
    names[mask] = outcome
    column = pa.array(names.tolist(), pa.string()).dictionary_encode()
    table = table.set_column(table.column_names.index("outcome"), "outcome", column)
    arrived = pc.is_in(column.cast(pa.string()), pa.array(["delivered", "receiver_down", "transport"]))
    usual_ns = pc.add(table["sent_ns"], 3_020_000)
    arrival_ns = pc.if_else(arrived, pc.coalesce(table["arrival_ns"], usual_ns), pa.scalar(None, pa.int64()))
    return table.set_column(table.column_names.index("arrival_ns"), "arrival_ns", arrival_ns)


def is_outcome(table: pa.Table, outcome: str) -> np.ndarray:
    return np.array(pc.equal(table["outcome"].cast(pa.string()), outcome).to_pylist())


def test_an_honest_run_is_valid(recorded: RecordedRun) -> None:
    assert set(verdicts(recorded).values()) == {Verdict.VALID}
    assert {"conservation", "range", "peer_cap", "loss_rate", "transport", "agents_alive", "finite"} <= set(
        verdicts(recorded)
    )


def test_a_missing_row_breaks_conservation(recorded: RecordedRun) -> None:
    assert only_invalid(recorded, recorded.trace.slice(1)) == {"conservation"}


def test_a_repeated_row_breaks_conservation(recorded: RecordedRun) -> None:
    assert "conservation" in only_invalid(recorded, pa.concat_tables([recorded.trace, recorded.trace.slice(0, 1)]))


def test_a_missing_frame_breaks_conservation(recorded: RecordedRun) -> None:
    first = recorded.trace.slice(0, 1).to_pylist()[0]
    same = pc.and_(
        pc.equal(recorded.trace["sender"].cast(pa.string()), first["sender"]),
        pc.equal(recorded.trace["seq"], first["seq"]),
    )
    assert only_invalid(recorded, recorded.trace.filter(pc.invert(same))) == {"conservation"}


def test_an_undecided_pair_breaks_conservation(recorded: RecordedRun) -> None:
    mask = np.arange(len(recorded.trace)) == 3
    assert "conservation" in only_invalid(recorded, outcome_set(recorded.trace, mask, "pending"))


def test_a_delivery_beyond_the_cap_is_found(recorded: RecordedRun) -> None:
    capped = np.flatnonzero(is_outcome(recorded.trace, "peer_cap"))[:1]
    mask = np.isin(np.arange(len(recorded.trace)), capped)
    assert only_invalid(recorded, outcome_set(recorded.trace, mask, "delivered")) == {"peer_cap"}


def test_a_delivery_beyond_the_range_is_found(recorded: RecordedRun) -> None:
    narrow = recorded.scenario.model_copy(
        update={"radio": recorded.scenario.radio.model_copy(update={"range_m": 500.0})}
    )
    assert verdicts(recorded, scenario=narrow)["range"] is Verdict.INVALID


def test_too_much_loss_is_found(recorded: RecordedRun) -> None:
    mask = is_outcome(recorded.trace, "delivered") & (np.arange(len(recorded.trace)) % 3 == 0)
    assert only_invalid(recorded, outcome_set(recorded.trace, mask, "lost")) == {"loss_rate"}


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
        "conservation",
        "range",
        "peer_cap",
        "loss_rate",
        "latency",
        "isolation",
    }


def test_a_cap_that_cannot_act_is_left_out_with_its_reason(tmp_path: Path) -> None:
    judgement = judge(beacons(tmp_path / "run"))
    assert judgement.verdict is Verdict.VALID
    assert NotExercised("peer_cap", "no receiver has more than 30 senders in range (at most 5)") in (
        judgement.not_exercised
    )


@pytest.mark.parametrize(
    ("verdicts", "together", "status"),
    [
        (["valid"], "valid", 0),
        (["valid", "unknown"], "unknown", 3),
        (["unknown", "invalid", "valid"], "invalid", 1),
    ],
)
def test_invalid_wins_over_unknown_over_valid(verdicts: list[str], together: str, status: int) -> None:
    judgement = Judgement([CheckResult("x", Verdict(v), "") for v in verdicts], [], "")
    assert (judgement.verdict, judgement.exit_status) == (together, status)


def test_a_folder_judges_itself_again_and_notices_tampering(tmp_path: Path) -> None:
    recorded = beacons(tmp_path / "run", loss=0.1)
    assert check_run(tmp_path / "run").verdict is Verdict.VALID
    table = recorded.trace
    digest = pa.array([0] * len(table), pa.uint64())
    pq.write_table(
        table.set_column(table.column_names.index("payload_digest"), "payload_digest", digest),
        tmp_path / "run" / "trace.parquet",
    )
    judgement = check_run(tmp_path / "run")
    assert judgement.verdict is Verdict.INVALID
    assert {check.name for check in judgement.checks if check.verdict is Verdict.INVALID} == {
        "trace_sha256",
        "files",
    }


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


def instant(position: np.ndarray, common: list[float]) -> Instant:
    count = len(position)
    fix = position + np.array(common)
    return Instant(0, 0, position, np.zeros(count), np.array(common), fix, np.zeros(count))


def test_metrics_are_the_figures_by_hand() -> None:
    position = np.array([[0.0, 0.0], [10.0, 0.0], [500.0, 0.0]])
    metrics = Metrics(["a", "b", "c"], np.array([0, 0, 1]), 100_000_000, COOPERATIVE)
    estimates = {"a": [1.0, 0.0], "b": [3.0, 0.0], "c": [2.0, 2.0]}
    unit = [1.0, 0.0, 0.0, 1.0]
    reports = [
        Report(0, node, (x + 1.0, 0.0), (1.0, 0.0, 0.0, 1.0), {
            "common_error_m": estimates[node], "common_error_covariance_m2": unit, "mean_m": [2.0, 0.0],
        })
        for node, x in (("a", 0.0), ("b", 10.0), ("c", 500.0))
    ]  # fmt: skip
    metrics.record(instant(position, [2.0, 0.0]), reports)
    figures = metrics.rows[-1]
    assert figures.common_error_rmse_m == pytest.approx(np.sqrt((1 + 1 + 4) / 3))
    mean = np.array([2.0, 2 / 3])
    assert figures.bias_m == pytest.approx(2 / 3)
    spread = [np.sum((np.array(e) - mean) ** 2) for e in estimates.values()]
    assert figures.deviation_m == pytest.approx(np.sqrt(np.mean(spread)))
    assert figures.component_rmse_m == pytest.approx([1.0, 2.0])
    assert figures.component_deviation_m == pytest.approx([1.0, 0.0])
    assert figures.consensus_error_m == pytest.approx(np.sqrt((0 + 0 + 4) / 3))
    assert figures.position_rmse_m == pytest.approx(1.0)
    assert figures.fix_rmse_m == pytest.approx(2.0)
    assert figures.common_error_anees == pytest.approx(6 / 3 / 2)
    assert figures.not_finite == 0
    assert summarize(metrics.rows)["bias_m"] == pytest.approx(2 / 3)


def test_who_reports_nothing_leaves_nulls_and_nan_is_counted() -> None:
    position = np.array([[0.0, 0.0], [10.0, 0.0]])
    metrics = Metrics(["a", "b"], np.array([0, 0]), 100_000_000, COOPERATIVE)
    metrics.record(instant(position, [2.0, 0.0]), [])
    figures = metrics.rows[-1]
    assert figures.common_error_rmse_m is None
    assert figures.position_rmse_m is None
    assert figures.reporting == 0
    broken = Report(0, "a", (float("nan"), 0.0), None, {"x": [float("inf")], "common_error_m": [1.0]})
    metrics.record(instant(position, [2.0, 0.0]), [broken])
    assert metrics.rows[-1].not_finite == 1
    assert metrics.states_table().num_rows == 4
    assert metrics.metrics_table()["not_finite"].to_pylist() == [0, 1]


def test_a_run_folder_never_takes_anothers_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    scenario = Scenario()
    first, second = (RunFolder.create(None, scenario) for _ in range(2))
    assert first.path != second.path
    assert (tmp_path / "runs" / "latest").resolve() == second.path.resolve()
    with pytest.raises(VnetError, match="is not an empty folder"):
        RunFolder.create(first.path, scenario)
    (tmp_path / "file").touch()
    with pytest.raises(VnetError, match="cannot write"):
        RunFolder.create(tmp_path / "file" / "run", scenario)


def test_events_are_on_disk_at_once_and_a_torn_line_is_no_harm(tmp_path: Path) -> None:
    folder = RunFolder.create(tmp_path / "run", Scenario())
    folder.event(5, EventKind.died, "v01", how="SIGKILL")
    with (folder.path / "events.jsonl").open("a") as file:
        file.write('{"time_ns": 6, "ki')
    assert RecordedRun.open(folder.path).events == [Event(5, "died", "v01", {"how": "SIGKILL"})]
    assert json.loads((folder.path / "events.jsonl").read_text().splitlines()[0])["kind"] == "died"
