"""Reports of runs that send frames to single vehicles: packet delivery ratios are those of broadcasts."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import emulator
from emulator.cells.cells import judged_figures
from emulator.records.radio_metrics import radio_metrics, unicast_figures
from emulator.records.recorded_run import RecordedRun
from emulator.report.comparison import Comparison, _delivered
from emulator.report.index import index_page
from emulator.report.radio_figures import radio_section
from emulator.report.source import Source
from emulator.report.write import report_page
from vnet import Node

pytestmark = pytest.mark.slow


async def send_and_broadcast(node: Node) -> None:
    """Have `a` broadcast, then send to a vehicle out of range and to one in range."""
    async for _ in node.gnss:
        if node.id == "a":
            await node.radio.broadcast(b"to all")
            await node.radio.send("far", b"to nobody in range")
            await node.radio.send("b", b"to b")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of three vehicles, one of them out of range, and a link that loses every third frame."""
    folder = tmp_path_factory.mktemp("unicasts")
    (folder / "n.csv").write_text("id,x_m,y_m,heading_rad\na,0,0,0\nb,50,0,0\nfar,50000,0,0\n")
    scenario: dict[str, Any] = {
        "run": {"duration_s": 1.0, "settle_s": 0.0},
        "network": {"kind": "file", "path": str(folder / "n.csv")},
        "world": {"lateral": {"sigma_m": 0.0}},
        "radio": {"path_loss": {"kind": "log_distance"}, "mac": {}, "loss": 0.35},
    }
    emulator.simulate(scenario, program=send_and_broadcast, out=folder / "run")
    return folder / "run"


def test_the_report_tells_broadcasts_from_frames_to_one_vehicle(run: Path) -> None:
    whole = RecordedRun.open(run)
    assert (whole.attempt > 1).any() and whole.outcome_is("duplicate").any() and whole.outcome_is("delivered").any()
    source = Source(run)
    assert source.attempt.tolist() == whole.attempt.tolist()
    assert source.acked.tolist() == whole.acked.tolist()
    ratio = radio_metrics(whole).totals["delivery_ratio"]
    assert ratio is not None
    section = radio_section(source)
    assert not isinstance(section, str)
    assert section.totals["packet delivery ratio"] == f"{100 * ratio:.1f} %"
    assert section.totals["frames to one vehicle"] == str(unicast_figures(whole))
    page = re.sub(r"<[^>]*>|\s+", " ", report_page(source))
    assert f"{ratio:.2%}" in page, "key figures and the section agree"
    assert whole.record.packet_delivery_ratio == ratio != whole.record.share_of("delivered")
    assert f"{100 * ratio:.2f}" in index_page(run.parent)
    shown = next(row for row in Comparison.of(run, run).figures if row["figure"] == "packet delivery ratio (%)")
    (line, *_) = _delivered(Comparison.of(run, run)).canvas.axes.get_lines()
    drawn = np.asarray(line.get_ydata(), dtype=float)
    assert np.nanmean(drawn) == pytest.approx(100 * ratio, abs=1e-6), "a broadcast a period, of one link"
    assert shown["A"] == f"{100 * ratio:.2f}" and shown["B − A"] == "+0.00"
    verdict = json.loads((run / "verdict.json").read_text())
    assert judged_figures(verdict)["packet_delivery_ratio"] == ratio, "a row of a sweep has it, too"


def test_a_run_without_broadcasts_has_its_frames_to_one_vehicle(tmp_path: Path) -> None:
    async def send(node: Node) -> None:
        await node.radio.send("v02" if node.id == "v01" else "v01", b"hello")

    scenario = {"network": {"vehicles": 2}, "run": {"duration_s": 0.2, "settle_s": 0.0}}
    radio = {"range_m": 9000.0, "mac": {}, "loss": 0.0}
    emulator.simulate({**scenario, "radio": radio}, program=send, out=tmp_path / "run")
    section = radio_section(Source(tmp_path / "run"))
    assert not isinstance(section, str), section
    assert section.totals["frames to one vehicle"].startswith("2 sent, 2 acknowledged")
