"""The experiment of vehicles that drive: its cells, its table, its pictures, and that it goes on."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

from studies import city
from tests.emulator.world.maps.test_city_map import driving
from tests.support.cells import compute_here
from tests.support.command_line import app
from vnet.errors import VnetError

pytestmark = pytest.mark.slow


def run_small(monkeypatch: pytest.MonkeyPatch, folder: Path, *options: str) -> str:
    monkeypatch.setenv("PYTHONHASHSEED", "0")
    files = ["--trips", str(folder / "trips.csv"), "--map", str(folder / "cross.npz")]
    result = CliRunner().invoke(
        app,
        ["experiment", "city", *files, "--seeds", "1", "--duration", "2", "--out", str(folder / "out"), *options],
    )
    assert result.exit_code == 0, result.output
    return (folder / "out" / "city.md").read_text()


@pytest.fixture
def files(tmp_path: Path) -> Path:
    """Trips and a map, both in metres."""
    driving(tmp_path)
    both = [str(tmp_path / f"cross.{kind}") for kind in ("geojson", "npz")]
    result = CliRunner().invoke(app, ["map", "convert", *both, "--origin", "42.28,-83.74"])
    assert result.exit_code == 0, result.output
    return tmp_path


def test_every_mechanism_drives_once_and_leaves_a_table_and_pictures(
    files: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    compute_here(monkeypatch)
    monkeypatch.setattr(city, "MECHANISMS", {name: city.MECHANISMS[name] for name in ("optimized", "none")})
    text = run_small(monkeypatch, files)
    for name in ("centralized", "optimized", "none", "raw fixes"):
        assert f"| {name}" in text
    rows = {row["mechanism"]: row for row in pq.read_table(files / "out" / "city.parquet").to_pylist()}
    assert rows["none"]["metrics_sha256"] != rows["optimized"]["metrics_sha256"]
    assert rows["optimized"]["position_rmse_m"] > 0
    for name in ("city_against_time.png", "city_errors.png"):
        assert (files / "out" / name).read_bytes().startswith(b"\x89PNG")
    monkeypatch.setattr("matplotlib.figure.Figure.savefig", lambda *_, **__: None)  # nobody looks at it again
    monkeypatch.setattr("emulator.cells.cells.each_done", lambda missing, *_: iter([1 / 0] if missing else []))
    assert run_small(monkeypatch, files) == text, "what is finished is not run again"


def test_options_of_trips_and_their_map_are_refused_without_them() -> None:
    assert city.place(None, None, {"sigma_m": 0.0}) == {"network": {"kind": "city", "vehicles": city.VEHICLES}}
    for section, impossible in ({"sigma_m": 3.0}, "leave_out"), ({}, "refuse"):
        with pytest.raises(VnetError, match="need --trips and --map"):
            city.place(None, None, section, impossible)


def test_errors_are_those_of_the_place() -> None:
    position = [[10.0, 10.0], [20.0, 20.0], [130.0, 10.0], None]
    estimate = [[13.0, 14.0], [20.0, 20.0], [130.0, 12.0], [0.0, 0.0]]
    point = pa.list_(pa.float64(), 2)
    states = pa.table({"position_m": pa.array(position, point), "estimate_m": pa.array(estimate, point)})
    corner, error = city.errors_by_place(states)
    assert corner.tolist() == [[0.0, 0.0], [100.0, 0.0]]
    assert error == pytest.approx([np.sqrt(25 / 2), 2.0])
