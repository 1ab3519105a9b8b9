"""The picture of a run: drawn of its files alone, without a display and without Rerun."""

import struct
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from emulator.pages.canvas import BLUE
from emulator.records.events import SAID, SAMPLES
from emulator.report.drawing import Line, time_figure
from emulator.report.picture import (
    COLUMNS,
    CURVE_PX,
    MAP_PX,
    MOST_EVENTS,
    _events,
    _heading,
    _picture,
    write_picture,
)
from emulator.report.program_figures import program_charts
from emulator.report.source import Source
from tests.support.recorded import recorded
from vnet.errors import VnetError
from vnet.node import Node

pytestmark = pytest.mark.slow


async def tell(node: Node) -> None:
    """Tell that it has begun, and report a value."""
    node.event("begun")
    async for fix in node.gnss:
        node.report(fix.position_m, fix.covariance_m2, neighbours=2)
        await node.radio.broadcast(b"here")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    fault = {"kind": "partition", "at_s": 0.3, "duration_s": 0.3, "groups": [["v01"], ["v02", "v03"]]}
    scenario = {
        "program": {"entry": f"{__name__}:tell"},
        "run": {"name": "r", "duration_s": 1.0, "settle_s": 0.2},
        "network": {"vehicles": 3},
        "fault": [fault],
    }
    return recorded(scenario, tmp_path_factory.mktemp("picture") / "run")


def test_a_picture_has_map_and_curves_without_a_display(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.setitem(sys.modules, "rerun", None)
    before = sorted(path.name for path in run.iterdir())
    write_picture(run, tmp_path / "run.png")
    head = (tmp_path / "run.png").read_bytes()[:24]
    width, height = struct.unpack(">II", head[16:])
    assert head[:8] == b"\x89PNG\r\n\x1a\n" and width > MAP_PX + COLUMNS * CURVE_PX and height > 500
    assert sorted(path.name for path in run.iterdir()) == before


def test_a_picture_has_what_programs_report_and_tell(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[str] = []
    monkeypatch.setattr(Figure, "text", lambda self, x, y, text, **look: drawn.append(text))
    _picture(Source(run))
    assert "neighbours" in drawn and any("0.00 s   event   v01   begun" in text for text in drawn)


def test_charts_that_do_not_fit_are_counted(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[str] = []
    monkeypatch.setattr(Figure, "text", lambda self, x, y, text, **look: drawn.append(text))
    monkeypatch.setattr("emulator.report.picture.ROWS", 1)
    (chart,) = program_charts(Source(run)).values()
    monkeypatch.setattr("emulator.report.picture.program_charts", lambda source: dict.fromkeys("abc", chart))
    _picture(Source(run))
    assert drawn.count("neighbours") == COLUMNS, "the first ones in any case"
    assert "and 1 chart more of the program: see report.html" in drawn


def test_a_heading_ends_with_a_whole_figure(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("emulator.report.picture.LONGEST_HEADING", 60)
    assert _heading(Source(run))[1] == "packet delivery ratio 80.00% · receptions in range 60 · …"


def test_zeros_are_gaps_on_a_logarithmic_axis() -> None:
    value = np.array([0.0, 100.0, 0.0, 1.0])
    made = time_figure([Line("error", np.arange(4.0), value, BLUE)], "m", 4.0)
    assert made.axes.get_yscale() == "log"
    np.testing.assert_array_equal(made.axes.lines[0].get_ydata(), [np.nan, 100.0, np.nan, 1.0])


def test_what_cannot_be_a_picture_is_one_line(run: Path, tmp_path: Path) -> None:
    with pytest.raises(VnetError, match=r"--png .*run\.jpg: a name that ends with \.png"):
        write_picture(run, tmp_path / "run.jpg")
    with pytest.raises(VnetError, match="not a run's folder"):
        write_picture(tmp_path, tmp_path / "run.png")
    with pytest.raises(VnetError, match="cannot write"):
        write_picture(run, tmp_path / "none" / "run.png")
    assert list(tmp_path.iterdir()) == []


def test_events_that_are_left_out_are_counted(run: Path) -> None:
    event = next(event for event in Source(run).events if not event.has(SAID) and not event.has(SAMPLES))
    source: Any = SimpleNamespace(events=[event] * (MOST_EVENTS + 3))
    assert _events(source)[MOST_EVENTS:] == ["and 3 events more: see report.html"]
