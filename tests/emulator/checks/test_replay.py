"""Two runs are compared row by row, and the first that differs is shown; also as users ask for it."""

import inspect
import json
import subprocess
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest
from rich.console import Console

from emulator.checks.judge import CheckResult, NotExercised, RecordedRun, Verdict, check_run, judge
from emulator.checks.replay import compare, events_table
from emulator.records.events import Event
from emulator.records.tables import STATES
from emulator.terminal.summary import print_checks, print_offending
from tests.emulator.checks.test_faults import with_cells
from tests.emulator.checks.test_judge import first, four, result, with_names
from tests.support.forked_commands import VNET, run
from tests.support.paths import ROOT
from vnet.node import Node

pytestmark = pytest.mark.slow


async def sends_a_set_of_objects(node: Node) -> None:
    """Send, from the third fix of v02 on, in the order of a set of objects, which is that of their addresses."""
    async for fix in node.gnss:
        first, second = object(), object()
        objects = {first, second} if node.id == "v02" and fix.time_ns >= 300_000_000 else [first, second]
        for each in objects:
            await node.radio.broadcast(b"1" if each is first else b"2")


async def sends_a_set_of_texts(node: Node) -> None:
    """Send in the order of a set of texts, which the hash seed decides."""
    async for _ in node.gnss:
        for text in {"a", "b", "c", "d"}:
            await node.radio.broadcast(text.encode())


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> RecordedRun:
    return four(tmp_path_factory.mktemp("replay"))


def compared(recorded: RecordedRun, **again: pa.Table) -> CheckResult:
    tables = {name: getattr(recorded, name) for name in ("trace", "states", "metrics")} | {
        "events": events_table(recorded.events)
    }
    found = compare([(name, table, again.get(name, table)) for name, table in tables.items()])
    assert isinstance(found, CheckResult)
    return found


def test_programs_that_tell_other_events_are_invalid(recorded: RecordedRun) -> None:
    first, again = (
        [Event(10**9, "event", "v02", {"name": "braked", "details": {"force": force}})] for force in (0.1, 0.2)
    )
    assert compared(replace(recorded, events=first), events=events_table(first)).verdict is Verdict.VALID
    found = compared(replace(recorded, events=first), events=events_table(again))
    assert found.verdict is Verdict.INVALID and "row 0 of the events: values" in found.text
    assert [row["name"] for row in found.figures["rows"]] == ["braked", "braked"]
    assert compared(recorded, events=events_table(first)).verdict is Verdict.INVALID


def test_runs_that_agree_are_valid_though_a_number_is_none(recorded: RecordedRun) -> None:
    rows = recorded.states.to_pylist()
    rows[3]["fix_m"] = [float("nan"), 1.0]
    with_nan = replace(recorded, states=pa.Table.from_pylist(rows, schema=STATES.schema))
    assert compared(with_nan, states=pa.Table.from_pylist(rows, schema=STATES.schema)).verdict is Verdict.VALID


@pytest.mark.parametrize(("column", "value"), [("arrival_ns", 1), ("payload_digest", 1), ("outcome", "lost")])
def test_the_first_row_that_differs_is_shown_from_both_runs(
    recorded: RecordedRun, column: str, value: object
) -> None:
    row = first(recorded, "delivered")
    found = compared(recorded, trace=with_cells(recorded.trace, column, [row, len(recorded.trace) - 1], value))
    assert found.verdict is Verdict.INVALID
    assert (found.figures["table"], found.figures["row"]) == ("trace", row)
    assert column in found.figures["differing"]
    assert [shown["run"] for shown in found.figures["rows"]] == ["first", "again"]


def test_a_row_that_only_one_run_has_is_a_difference(recorded: RecordedRun) -> None:
    found = compared(recorded, trace=recorded.trace.slice(0, len(recorded.trace) - 1))
    assert found.figures["row"] == len(recorded.trace) - 1
    assert "no such row" in found.text


def test_a_state_that_differs_is_found_where_the_traces_agree(recorded: RecordedRun) -> None:
    rows = recorded.states.to_pylist()
    rows[7]["estimate_m"] = [0.0, 0.0]
    found = compared(recorded, states=pa.Table.from_pylist(rows, schema=recorded.states.schema))
    assert (found.figures["table"], found.figures["row"]) == ("states", 7)
    assert found.figures["differing"] == ["estimate_m"]


def test_a_run_that_was_had_once_does_not_say_whether_it_replays(recorded: RecordedRun) -> None:
    assert isinstance(result(recorded, "replay"), NotExercised)


def test_a_failed_check_prints_its_rows_and_the_command(recorded: RecordedRun) -> None:
    forged = with_names(recorded.trace, "receiver", first(recorded, "lost"), "v0")
    printed = StringIO()
    console = Console(file=printed, width=200)
    print_checks(judge(replace(recorded, trace=forged)), console, "vnet simulate here/scenario.toml")
    lines = printed.getvalue().splitlines()
    start = lines.index(next(line for line in lines if line.startswith("conservation: the first offending rows")))
    assert lines[start + 1].split()[:4] == ["sent_ns", "sender", "seq", "receiver"]
    narrow = StringIO()
    row = {"sent_ns": 10**9, "payload_digest": 10**18, "cause": None, "sender": "v01"}
    print_offending([row] * 2, Console(file=narrow, width=36))
    told = ["sent_ns 1000000000, payload_digest", "1000000000000000000, sender v01"]
    assert [line.strip() for line in narrow.getvalue().splitlines()] == told * 2
    assert lines[-1].startswith("to see this again: ")
    assert lines[-1].endswith("vnet simulate here/scenario.toml")


ASKED = "--check-determinism"
WAYS = ("2 processes", "without windows", "at other addresses")


def replayed(command: str, program: str, folder: Path, asked: str = ASKED) -> dict[str, Any]:
    """Return the check `replay` of a run of a program, which is also made again; the verdicts agree."""
    few = ("--set", "network.vehicles=3", "--duration", "1")
    done = vnet(command, *few, "--program", program, "--out", str(folder), asked)
    written = json.loads((folder / "verdict.json").read_text())
    assert written["reproduce"].endswith(asked)
    assert done.returncode == check_run(folder).exit_status, done.stderr
    replay: dict[str, Any] = next(check for check in written["checks"] if check["name"] == "replay")
    assert (written["verdict"] == "invalid") == (replay["verdict"] == "invalid")
    return replay


def vnet(command: str, *options: str) -> subprocess.CompletedProcess[str]:
    return run([*VNET, command, "scenarios/beacon.toml", *options], cwd=ROOT, capture_output=True, timeout=300)


def test_a_deterministic_live_program_agrees_in_all_layouts(tmp_path: Path) -> None:
    replay = replayed("run", f"{__name__}:sends_a_set_of_texts", tmp_path / "run")
    assert replay["verdict"] == "valid"
    assert all(way in replay["text"] for way in WAYS) and "live" not in replay["text"]


def test_another_hash_seed_is_a_note_and_no_verdict(tmp_path: Path) -> None:
    """Here a simulated program differs, which agrees in all layouts."""
    replay = replayed("simulate", f"{__name__}:sends_a_set_of_texts", tmp_path / "run", f"{ASKED}=portable")
    assert replay["verdict"] == "valid"
    assert all(way in replay["text"] for way in (*WAYS, "live", "hash seed", "two runs differ"))


def test_a_nondeterministic_program_is_found_with_frame_vehicle_and_line(tmp_path: Path) -> None:
    replay = replayed("simulate", f"{__name__}:sends_a_set_of_objects", tmp_path / "run")
    assert replay["verdict"] == "invalid"
    lines, first = inspect.getsourcelines(sends_a_set_of_objects)
    sends = first + next(i for i, line in enumerate(lines) if "broadcast" in line)
    assert f"test_replay.py:{sends}" in replay["figures"]["call"]
    assert replay["figures"]["frame"].endswith("v02") and replay["figures"]["vehicle"] == "v02"


def test_in_real_time_no_two_runs_are_compared(tmp_path: Path) -> None:
    done = vnet("run", "--pacing", "realtime", "--out", str(tmp_path / "run"), "--check-determinism")
    assert done.returncode == 2
    assert "use --pacing lockstep" in done.stderr
