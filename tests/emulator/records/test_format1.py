"""A folder of format 1, written by vnet 0.1.0: it is read, with its inputs where the world is needed.

`format1/` is such a folder, of three beacons with a network and a matrix of links in files, which are in `inputs/`.
"""

import shutil
from pathlib import Path

import pytest

from emulator.checks.judge import Verdict, check_run
from emulator.records.recorded_run import RecordedRun
from emulator.report.source import Source
from emulator.report.write import report_page
from emulator.stream import messages
from tests.support.folders import READERS, readings
from vnet.errors import VnetError

FOLDER = Path(__file__).parent / "format1"


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A copy whose inputs are not there."""
    copy = Path(shutil.copytree(FOLDER, tmp_path / "run"))
    shutil.rmtree(copy / "inputs")
    return copy


@pytest.mark.slow
def test_with_its_inputs_every_reader_reads_it(run: Path, tmp_path: Path) -> None:
    scenario = run / "scenario.toml"
    scenario.write_text(scenario.read_text().replace("/nowhere/", f"{FOLDER}/inputs/"))
    judgement = check_run(run)
    assert judgement.verdict is Verdict.VALID
    assert judgement.trace_sha256 == RecordedRun.open(run).record.trace_sha256
    streams = [stream for stream, _ in messages(run)]
    assert streams == ["scene", *["period"] * 10, "end"]
    assert readings(run, run, tmp_path / "scratch").keys() == set(READERS)


def test_without_them_one_line_says_what_is_needed(run: Path) -> None:
    for read in (lambda: check_run(run), lambda: list(messages(run))):
        with pytest.raises(VnetError, match=r"of format 1 \(vnet 0\.1\.0\), which needs .*network\.csv") as refused:
            read()
        assert "\n" not in str(refused.value)


@pytest.mark.slow
def test_what_needs_no_world_is_read_without_them(run: Path) -> None:
    recorded = RecordedRun.open(run)
    assert (recorded.record.format, recorded.record.vehicles, recorded.node_ids) == (1, 3, ["a", "b", "c"])
    assert recorded.record.frames_by_outcome["receiver_down"] and recorded.record.packet_delivery_ratio is None
    assert len(recorded.metrics) == recorded.periods == 10
    assert [event.kind for event in recorded.event("restarted")] == ["restarted"]
    assert "of format 1" in report_page(Source(run)), "the figures that need links are not drawn"


def test_checks_have_their_present_names(run: Path) -> None:
    names = [check.name for check in RecordedRun.open(run).record.checks]
    assert "effect:kill-0" in names and not any(name.startswith("bit:") for name in names)
