"""`vnet trace`, and payloads that a run keeps: whole, exported, and no part of any hash."""

import base64
import io
import json
import shutil
import sys
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from emulator.drivers.conclude import conclude
from emulator.export.mcap_file import write_mcap
from emulator.export.pcapng import write_pcapng
from emulator.export.tables import write_csv
from emulator.records.recorded_run import RecordedRun
from emulator.terminal.console import run_app
from tests.support.command_line import app
from tests.support.multi_loop_driver import run_together, scenario_of
from vnet.node import Node

pytestmark = pytest.mark.slow


async def counts(node: Node) -> None:
    number = 0
    async for _ in node.gnss:
        await node.radio.broadcast(b"\xff\x00" if number == 1 else f"{node.id} says {number}".encode())
        number += 1


def run_of(keep: bool) -> tuple[Path, str]:
    corrupt = {"kind": "corrupt", "at_s": 0.7, "duration_s": 0.6, "probability": 1.0, "nodes": ["v02"]}
    emulation = run_together(
        scenario_of([corrupt], f"{__name__}:counts", vehicles=3, radio={"loss": 0.0}, run={"keep_payloads": keep})
    )
    _, verdict = conclude(emulation, 1.0, "simulate")
    return emulation.folder.path, verdict["trace_sha256"]


@pytest.fixture(scope="module")
def kept() -> Path:
    return run_of(True)[0]


@pytest.fixture(scope="module")
def bare() -> Path:
    return run_of(False)[0]


def trace(capsys: pytest.CaptureFixture[str], *arguments: str, status: int = 0) -> list[list[str]]:
    ended = run_app(app, ["trace", *arguments])
    captured = capsys.readouterr()
    assert ended == status, captured.err
    return [line.split("\t") for line in (captured.out or captured.err).splitlines()]


def test_payloads_are_kept_and_change_no_hash(kept: Path) -> None:
    without, trace_sha256 = run_of(False)
    assert json.loads((kept / "verdict.json").read_text())["trace_sha256"] == trace_sha256
    assert not (without / "payloads.parquet").exists()
    rows = pq.read_table(kept / "payloads.parquet").to_pylist()
    assert rows[0] == {"time_ns": 0, "sender": "v01", "seq": 0, "payload": b"v01 says 0"}
    assert len(rows) == 3 * 15


def test_it_shows_who_sent_what_to_whom(kept: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lines = trace(capsys, str(kept), "--node", "v02", "--to", "0.3")
    assert lines == [
        ["s", "sender", "frame", "bytes", "content", "receivers"],
        ["0.000000", "v01", "0", "10", "v01 says 0", "delivered v02"],
        ["0.000000", "v02", "0", "10", "v02 says 0", "delivered v01, v03"],
        ["0.000000", "v03", "0", "10", "v03 says 0", "delivered v02"],
        ["0.200000", "v01", "1", "2", "ff00", "delivered v02"],
        ["0.200000", "v02", "1", "2", "ff00", "delivered v01, v03"],
        ["0.200000", "v03", "1", "2", "ff00", "delivered v02"],
    ]


@pytest.mark.parametrize("end", ["inf", "1e300", "86401"])
def test_an_end_after_that_of_every_run_is_the_run_s_own(
    kept: Path, capsys: pytest.CaptureFixture[str], end: str
) -> None:
    assert trace(capsys, str(kept), "--to", end) == trace(capsys, str(kept))


@pytest.mark.parametrize(
    "words",
    [
        ["trace", "--from", "inf"],
        *(["radio", option, value] for option in ("--from", "--bin") for value in ("inf", "1e300")),
    ],
)
def test_a_beginning_or_a_bin_beyond_all_bounds_is_refused_in_one_line(
    kept: Path, capsys: pytest.CaptureFixture[str], words: list[str]
) -> None:
    assert run_app(app, [*words, str(kept)]) == 2
    captured = capsys.readouterr()
    assert not captured.out and captured.err.count("\n") == 1 and words[1] in captured.err


def decode(payload: bytes) -> list[str]:
    return payload.decode().split()


def test_a_function_decodes_and_may_fail(kept: Path, capsys: pytest.CaptureFixture[str]) -> None:
    function = f"{__name__}:decode"
    lines = trace(capsys, str(kept), "--node", "v01", "--to", "0.3", "--decode", function)
    assert lines[1][4] == "['v01', 'says', '0']"
    assert lines[-1][4].startswith("ff00 (UnicodeDecodeError: ")


def leave(payload: bytes) -> str:
    if payload == b"\xff\x00":
        sys.exit(5)
    return "stays"


def test_a_function_that_exits_ends_nothing(kept: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lines = trace(capsys, str(kept), "--node", "v01", "--decode", f"{__name__}:leave")
    assert len(lines) == len(trace(capsys, str(kept), "--node", "v01"))
    assert {line[4] for line in lines if line[2] == "1"} == {"ff00 (SystemExit: 5)"}
    assert lines[-1][4] == "stays"


async def waits(payload: bytes) -> int:
    return len(payload)


def yields(payload: bytes) -> Iterator[int]:
    yield len(payload)


async def both(payload: bytes) -> AsyncIterator[int]:
    yield len(payload)


@pytest.mark.parametrize("name", ["waits", "yields", "both"])
def test_what_returns_no_result_when_it_is_called_is_refused_in_one_line(
    name: str, kept: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (line,) = trace(capsys, str(kept), "--decode", f"{__name__}:{name}", status=2)
    assert name in line[0] and "plain function" in line[0]


def test_without_payloads_there_are_digests(bare: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lines = trace(capsys, str(bare), "--from", "0.2", "--to", "0.3")
    assert len(lines) == 4 and lines[1][4].startswith("digest ")
    (line,) = trace(capsys, str(bare), "--decode", f"{__name__}:decode", status=2)
    assert line[0].endswith("has kept no payloads; set run.keep_payloads = true")


@pytest.mark.parametrize(
    "words", [["trace", "--decode", f"{__name__}:decode"], ["export", "--to", "pcapng", "--payloads", "its"]]
)
def test_a_folder_that_has_lost_its_payloads_is_told_as_such(
    kept: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str]
) -> None:
    folder = shutil.copytree(kept, tmp_path / "run")
    (folder / "payloads.parquet").unlink()
    assert run_app(app, [*words, str(folder)]) == 2
    captured = capsys.readouterr()
    assert not captured.out and "there is no payloads.parquet in it" in captured.err.splitlines()[-1]


def test_exports_hold_what_was_kept(kept: Path, tmp_path: Path) -> None:
    recorded = RecordedRun.open(kept)
    capture, messages = io.BytesIO(), io.BytesIO()
    write_pcapng(recorded, capture)
    assert b"v01 says 2" in capture.getvalue()
    assert capture.getvalue().count(b"v01 says 5") == 2, "as sent and at v03, not where it arrived altered"
    write_mcap(recorded, messages)
    assert "payloads.csv" in write_csv(recorded, tmp_path)
    assert b"v01 says 2".hex() in (tmp_path / "payloads.csv").read_text()
    assert len(base64.b64encode(b"v01 says 2")) == 16
