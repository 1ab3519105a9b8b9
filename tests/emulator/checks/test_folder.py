"""`vnet check` judges the whole folder: every edit is found, but for those that no reader can find."""

import json
import shlex
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import emulator
from emulator.checks.folder import check_files
from emulator.checks.judge import CheckResult, Judgement, RecordedRun, Verdict, check_run
from emulator.records.manifest import write_manifest
from emulator.records.run_folder import PROGRAMS_LOG, RunFolder
from emulator.scenario.scenario import Scenario
from tests.support.folder_edits import EDITS, Edit, forge, listing, table
from tests.support.paths import ROOT
from tests.support.recorded import recorded
from vnet import Node

pytestmark = pytest.mark.slow

SETTINGS = {
    "run": {"duration_s": 4.0, "settle_s": 1.0},
    "network": {"vehicles": 8, "layout": "dense"},
    "radio": {"max_peers": 3, "loss": 0.2},
    "program": {"entry": "agents.cooperative:main", "options": {"particles": 60}},
    "fault": [{"kind": "restart", "at_s": 1.0, "duration_s": 0.8, "nodes": {"count": 2}}],
}
OF_DIGESTS = {"files", "trace_sha256"}


def simulated(folder: Path, **changes: object) -> Path:
    scenario = Scenario.model_validate(SETTINGS | changes)
    return recorded(scenario, folder)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulated(tmp_path_factory.mktemp("folder") / "run")


@pytest.fixture
def copy(run: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(run, tmp_path / "run"))


def broken(judgement: Judgement) -> set[str]:
    return {check.name for check in judgement.checks if check.verdict is Verdict.INVALID}


def test_a_run_as_it_was_written_is_valid_and_every_check_of_its_folder_judged_it(run: Path) -> None:
    judgement = check_run(run)
    assert judgement.verdict is Verdict.VALID
    names = {check.name for check in judgement.checks}
    assert {
        *["files", "truth", "metrics", "outcomes", "verdict_file", "fault_events", "row_order", "reports"]
    } <= names


def test_forging_nothing_changes_nothing(copy: Path) -> None:
    forge(copy)
    assert check_run(copy).verdict is Verdict.VALID


@pytest.mark.parametrize("edit", EDITS, ids=[edit.what for edit in EDITS])
def test_an_edit_is_found_as_an_accident_and_as_a_forgery(copy: Path, edit: Edit) -> None:
    edit.apply(copy)
    accident = check_files(RecordedRun.open(copy))
    assert isinstance(accident, CheckResult) and accident.verdict is Verdict.INVALID
    forge(copy)
    found = broken(check_run(copy))
    assert not found & OF_DIGESTS, "the forger knows all digests"
    assert edit.found_by in found if edit.found_by else not found


def test_most_edits_are_found_and_the_page_has_the_table() -> None:
    assert len(EDITS) == len({edit.what for edit in EDITS}) == 40
    assert sum(bool(edit.found_by) for edit in EDITS) >= 28
    assert all(bool(edit.why) != bool(edit.found_by) for edit in EDITS)
    assert listing() in (ROOT / "docs" / "checks.md").read_text()


def says(key: str, value: object) -> Callable[[Path], None]:
    """Return what gives a key of verdict.json another value."""

    def apply(folder: Path) -> None:
        path = folder / "verdict.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | {key: value}))

    return apply


def reverse_events(folder: Path) -> None:
    path = folder / "events.jsonl"
    path.write_text("".join(reversed(path.read_text().splitlines(keepends=True))))


def happens(**event: object) -> Callable[[Path], None]:
    """Return what adds an event."""

    def apply(folder: Path) -> None:
        with (folder / "events.jsonl").open("a") as file:
            file.write(json.dumps(event) + "\n")

    return apply


@pytest.mark.parametrize(
    ("edit", "name"),
    [
        (says("reproduce", "rm -rf ~; vnet simulate x"), "verdict_file"),
        (says("reproduce", "vnet run --agent 'a b'; rm -rf ~ x"), "verdict_file"),
        (says("order", {"kind": "pct", "seed": 1, "deviations": 2, "left": None}), "verdict_file"),
        (reverse_events, "row_order"),
        (happens(kind="collapsed", node="v01", time_ns=1), "row_order"),
        (happens(kind="log", node="v99", time_ns=1, level="info", text="here"), "row_order"),
        (happens(kind="note", node=None, time_ns=-5), "row_order"),
        (happens(kind="note", node=None, time_ns=10**30), "row_order"),
    ],
    ids=[
        "another command",
        "one more command",
        "another order",
        "events reversed",
        "kind",
        "node",
        "before",
        "after",
    ],
)
def test_further_forgeries_are_found(copy: Path, edit: Callable[[Path], None], name: str) -> None:
    edit(copy)
    forge(copy)
    assert name in broken(check_run(copy))


@pytest.mark.parametrize("agent", ["agent", "python my_agent.py {node}", "sh -c './agent $0' {node}"])
def test_a_command_with_agents_of_the_users_own_is_no_forgery(copy: Path, agent: str) -> None:
    command = f"vnet run --agent {shlex.quote(agent)} {shlex.quote(str(copy / 'scenario.toml'))}"
    says("reproduce", command)(copy)
    forge(copy)
    assert broken(check_run(copy)) == set()


def without_manifest(folder: Path) -> None:
    (folder / "manifest.json").unlink()


def of_format(number: int) -> Callable[[Path], None]:
    def apply(folder: Path) -> None:
        path = folder / "verdict.json"
        path.write_text(path.read_text().replace('"format": 5', f'"format": {number}', 1))

    return apply


def test_a_folder_whose_manifest_is_gone_is_invalid_and_an_earlier_one_needs_none(copy: Path) -> None:
    without_manifest(copy)
    assert broken(check_run(copy)) == {"files"}
    of_format(2)(copy)
    judgement = check_run(copy)
    assert judgement.verdict is Verdict.VALID
    assert "files" in {left.name for left in judgement.not_exercised}


def test_a_folder_of_an_earlier_format_gets_no_new_invalid_and_no_pass_for_what_is_wrong(copy: Path) -> None:
    next(edit for edit in EDITS if edit.found_by == "truth").apply(copy)
    forge(copy)
    without_manifest(copy)
    of_format(2)(copy)
    judgement = check_run(copy)
    assert (broken(judgement), judgement.verdict) == (set(), Verdict.UNKNOWN)


def test_a_delivery_ratio_of_an_earlier_definition_is_neither_shown_nor_wrong(copy: Path) -> None:
    says("packet_delivery_ratio", 0.5)(copy)
    of_format(4)(copy)
    forge(copy)
    assert broken(check_run(copy)) == set()
    record = RecordedRun.open(copy).record
    assert record.frames_by_outcome["receiver_down"] and record.packet_delivery_ratio is None
    says("seed", 99)(copy)
    assert "verdict_file" in broken(check_run(copy)), "whatever else it has meant the same"


def test_a_delivery_ratio_of_an_earlier_definition_is_judged_where_it_is_the_same(tmp_path: Path) -> None:
    folder = simulated(tmp_path / "run", fault=[], program={"entry": "agents.beacon:main"})
    of_format(4)(folder)
    forge(folder)
    assert broken(check_run(folder)) == set()
    says("packet_delivery_ratio", 0.5)(folder)
    forge(folder)
    assert RecordedRun.open(folder).record.packet_delivery_ratio == 0.5
    assert broken(check_run(folder)) == {"verdict_file"}


def test_a_log_is_of_the_manifest_whatever_its_vehicle_is_called(copy: Path) -> None:
    (copy / "logs" / PROGRAMS_LOG).write_text("what programs printed\n")
    (copy / "logs" / "programs.log").write_text("of a vehicle\n")
    write_manifest(RunFolder(copy))
    assert broken(check_run(copy)) == set()
    (copy / "logs" / "programs.log").write_text("changed\n")
    assert broken(check_run(copy)) == {"files"}


@pytest.mark.parametrize("name", ["../../etc/passwd", "/etc/passwd", "nothing.parquet"])
def test_a_manifest_names_files_of_the_folder_alone(copy: Path, name: str) -> None:
    path = copy / "manifest.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {name: "0" * 64}))
    judgement = check_run(copy)
    (found,) = [check for check in judgement.checks if check.name == "files"]
    assert [row["file"] for row in found.figures["rows"]] == [name]


def test_a_run_whose_world_comes_from_a_file_says_why_it_is_not_computed_again(tmp_path: Path) -> None:
    (tmp_path / "network.csv").write_text("id,x_m,y_m,heading_rad\na,0,0,0\nb,100,0,0\n")
    network = {"kind": "file", "path": tmp_path / "network.csv"}
    folder = simulated(tmp_path / "run", network=network, fault=[], program={"entry": "agents.beacon:main"})
    judgement = check_run(folder)
    assert judgement.verdict is Verdict.VALID
    (reason,) = [left.reason for left in judgement.not_exercised if left.name == "truth"]
    assert reason.startswith("the world comes from files")


def test_a_busy_ratio_is_computed_again(tmp_path: Path) -> None:
    radio = {"path_loss": {"kind": "log_distance"}, "mac": {}, "bitrate_mbps": 6.0}
    folder = simulated(tmp_path / "run", radio=radio, fault=[], program={"entry": "agents.beacon:main"})
    assert not broken(check_run(folder))
    table("busy", lambda rows: [*rows[:-1], rows[-1] | {"busy_ratio": rows[-1]["busy_ratio"] + 0.01}])(folder)
    forge(folder)
    assert "outcomes" in broken(check_run(folder))


def test_files_that_vnet_adds_to_a_finished_run_are_no_edit(copy: Path) -> None:
    (copy / "report.html").write_text("a report")
    (copy / "recording.rrd").write_text("a recording")
    assert check_run(copy).verdict is Verdict.VALID


@pytest.mark.parametrize("name", ["busy.parquet", "logs/v77.log"])
def test_a_file_that_the_manifest_lacks_is_told(copy: Path, name: str) -> None:
    shutil.copy(copy / "states.parquet", copy / name)
    assert broken(check_run(copy)) == {"files"}
    write_manifest(RunFolder(copy))
    assert check_run(copy).verdict is Verdict.VALID


def test_payloads_are_those_of_the_trace(tmp_path: Path) -> None:
    run = {"duration_s": 1.0, "keep_payloads": True}
    folder = simulated(tmp_path / "run", run=run, fault=[], program={"entry": "agents.beacon:main"})
    path = folder / "payloads.parquet"
    assert "payloads" in {check.name for check in check_run(folder).checks}
    table = pq.read_table(path)
    changed = [b"another", *table["payload"].to_pylist()[1:]]
    for edited in (table.slice(1), table.set_column(3, "payload", pa.array(changed, pa.large_binary()))):
        pq.write_table(edited, path)
        forge(folder)
        assert "payloads" in broken(check_run(folder))
    path.unlink()
    write_manifest(RunFolder(folder))
    assert "payloads" in broken(check_run(folder))


def test_no_verdict_of_the_file_itself_excuses_its_files(copy: Path) -> None:
    verdict = json.loads((copy / "verdict.json").read_text())
    left = {"name": "files", "verdict": "valid", "text": "all kept", "figures": {"unkept": ["x"]}}
    verdict["checks"].append(left)
    (copy / "verdict.json").write_text(json.dumps(verdict))
    assert "files" in broken(check_run(copy))
    write_manifest(RunFolder(copy))
    files = next(check for check in check_run(copy).checks if check.name == "files")
    assert files.verdict is Verdict.UNKNOWN


@pytest.mark.parametrize("speed_m_s", [40.0, -40.0])
def test_a_folder_is_valid_where_vehicles_meet_or_part_in_a_period_that_the_run_does_not_complete(
    tmp_path: Path, speed_m_s: float
) -> None:
    """Links change at 2 s, and the run ends before the period does."""
    rows = [f"b,{time_s},{100 + (time_s - 1) * speed_m_s},0" for time_s in range(6)]
    (tmp_path / "trips.csv").write_text("\n".join(["id,time_s,x_m,y_m", "a,0,0,0", "a,5,0,0", *rows]))
    scenario = {
        "run": {"duration_s": 2.5, "settle_s": 0.0},
        "network": {"kind": "trips", "path": str(tmp_path / "trips.csv")},
        "world": {"gnss": {"rate_hz": 0.5}},
        "radio": {"range_m": 100.0},
        "program": {"entry": "tests.emulator.checks.test_faults:talks_on"},
    }
    assert broken(check_run(emulator.simulate(scenario, out=tmp_path / "run").folder)) == set()


async def counts_frames(node: Node) -> None:
    """Send frames that differ; `a` sends ten of them at each fix until 2.2 s, then one."""
    count = 0
    async for fix in node.gnss:
        for _ in range(10 if node.id == "a" and fix.time_ns < 2_200_000_000 else 1):
            await node.radio.broadcast(count.to_bytes(4, "little") * 200)
            count += 1


async def sends_seldom(node: Node) -> None:
    """Send a frame at every sixth fix."""
    count = 0
    async for _ in node.gnss:
        if count % 6 == 0:
            await node.radio.broadcast(bytes(200))
        count += 1


def parting(folder: Path, seed: int = 1, program: Any = counts_frames, **fault: Any) -> Path:
    """`b` is in range of `a` until 0.7 s, and from 2.3 s on; in between nobody hears what `a` sends."""
    rows = [f"b,{time_s},{90 if 1 <= time_s <= 2 else 40},0" for time_s in np.arange(0, 6.1, 0.5)]
    folder.mkdir()
    (folder / "trips.csv").write_text("\n".join(["id,time_s,x_m,y_m", "a,0,0,0", "a,6,0,0", *rows]))
    scenario = {
        "run": {"duration_s": 5.0, "settle_s": 0.0, "seed": seed},
        "network": {"kind": "trips", "path": str(folder / "trips.csv"), "longest_gap_s": 10.0},
        "world": {"gnss": {"rate_hz": 20}},
        "radio": {"range_m": 60.0, "bitrate_mbps": 0.3},
        "fault": [{"at_s": 1.2, "duration_s": 3.0, "nodes": ["a"]} | fault] if fault else [],
    }
    return emulator.simulate(scenario, program=program, out=folder / "run").folder


LONELY_FAULTS: list[dict[str, Any]] = [
    {},
    {"kind": "throttle", "bitrate_mbps": 0.02},
    {"kind": "DataReplay", "age_s": 0.9},
    {"kind": "DataReplay", "age_s": 0.9, "at_s": 0.1},
    {"kind": "StaleMessages", "age_s": 0.9},
    {"kind": "StaleMessages", "age_s": 0.9, "at_s": 0.1},
    {"kind": "DoS", "factor": 20},
    {"kind": "Sybil", "ghosts": 5},
    {"kind": "burst_loss", "enter": 0.005, "leave": 1e-6, "at_s": 0.1},
]


@pytest.mark.parametrize("fault", LONELY_FAULTS, ids=lambda fault: str(fault.get("kind", "queue")))
def test_frames_that_nobody_was_in_range_of_make_no_run_invalid(tmp_path: Path, fault: dict[str, Any]) -> None:
    """They fill the sender's queue, are sent again, and move the chain of losses, and no row tells of them."""
    for seed in range(1, 4):
        folder = parting(tmp_path / str(seed), seed, **fault)
        run = RecordedRun.open(folder)
        assert run.seq.max() + 1 > len(np.unique(run.seq[run.sender == 0])), "each frame has rows"
        assert broken(check_run(folder)) == set()


def changes_last(name: str, wanted: Callable[[dict[str, Any]], bool], change: Callable[[Any], Any]) -> Any:
    """Return what changes a column of the last row of the trace that is `wanted`."""

    def apply(rows: list[dict[str, Any]]) -> None:
        row = [row for row in rows if wanted(row)][-1]
        row[name] = change(row[name])

    return table("trace", apply)


@pytest.mark.parametrize(
    ("fault", "edit", "found_by"),
    [
        ({}, changes_last("arrival_ns", lambda row: row["arrival_ns"], lambda ns: ns + 50_000_000), "latency"),
        ({}, changes_last("arrival_ns", lambda row: row["arrival_ns"], lambda ns: ns + 1_000), "outcomes"),
        (
            LONELY_FAULTS[4] | {"at_s": 2.0, "duration_s": 1.7},
            changes_last("payload_digest", lambda row: row["cause"], lambda _: 1),
            "isolation",
        ),
        (LONELY_FAULTS[2], changes_last("seq", lambda row: row["copy"], lambda seq: 1), "copies"),
    ],
)
def test_what_such_frames_have_no_part_in_is_judged(
    tmp_path: Path, fault: dict[str, Any], edit: Callable[[Path], None], found_by: str
) -> None:
    folder = parting(tmp_path / "run", **fault)
    edit(folder)
    write_manifest(RunFolder(folder))
    assert found_by in broken(check_run(folder))


@pytest.mark.parametrize("fault", [{"kind": "DoS", "factor": 3}, {"kind": "StaleMessages", "age_s": 0.1}])
def test_a_fault_that_acts_later_does_not_lengthen_what_they_may_have_waited(
    tmp_path: Path, fault: dict[str, Any]
) -> None:
    folder = parting(tmp_path / "run", program=sends_seldom, **fault, at_s=4.5, duration_s=0.3)
    assert broken(check_run(folder)) == set()

    def after_them(row: dict[str, Any]) -> bool:
        return bool(row["sender"] == "a" and row["arrival_ns"] and 2_300_000_000 < row["sent_ns"] < 2_700_000_000)

    changes_last("arrival_ns", after_them, lambda ns: ns + 1_000_000_000)(folder)
    write_manifest(RunFolder(folder))
    assert "latency" in broken(check_run(folder))
