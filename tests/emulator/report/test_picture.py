"""The picture of a run: drawn of its files alone, without a display and without Rerun."""

import struct
import sys
from pathlib import Path

import pytest

from emulator.drivers.session import Session
from emulator.report.picture import COLUMNS, CURVE_PX, MAP_PX, write_picture
from emulator.scenario.scenario import Scenario
from vnet.errors import VnetError

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("picture") / "run"
    fault = {"kind": "partition", "at_s": 0.3, "duration_s": 0.3, "groups": [["v01"], ["v02", "v03"]]}
    tables = {
        "run": {"name": "r", "duration_s": 1.0, "settle_s": 0.2},
        "network": {"vehicles": 3},
        "fault": [fault],
    }
    session = Session(Scenario.model_validate(tables), folder).open()
    session.run()
    session.close()
    return folder


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


def test_what_cannot_be_a_picture_is_one_line(run: Path, tmp_path: Path) -> None:
    with pytest.raises(VnetError, match=r"--png .*run\.jpg: a name that ends with \.png"):
        write_picture(run, tmp_path / "run.jpg")
    with pytest.raises(VnetError, match="not a run's folder"):
        write_picture(tmp_path, tmp_path / "run.png")
    with pytest.raises(VnetError, match="cannot write"):
        write_picture(run, tmp_path / "none" / "run.png")
    assert list(tmp_path.iterdir()) == []
