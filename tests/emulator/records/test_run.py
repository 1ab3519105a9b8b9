"""`emulator.Run`: a finished run as its user sees it, from its folder and within a check."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import emulator
from emulator.records.recorded_run import RecordedRun
from tests.emulator.checks.test_judge import run as simulate_in
from vnet.errors import VnetError

FAULTS: Any = [{"kind": "kill", "at_s": 0.3, "duration_s": 0.4, "nodes": {"ids": ["v02"]}}]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run of five vehicles, one of which is down from 0.3 to 0.7 s."""
    path = tmp_path_factory.mktemp("runs") / "run"
    simulate_in(path, radio={"range_m": 3000.0}, fault=FAULTS, run={"duration_s": 1.0, "settle_s": 0.0})
    return path


@pytest.mark.slow
def test_a_folder_is_opened_as_a_run(folder: Path) -> None:
    run = emulator.Run.open(folder)
    assert run.folder == folder
    assert run.verdict == "valid"
    assert "conservation" in [check.name for check in run.checks]
    assert {left.name: left.reason for left in run.not_applicable}["kept_up"] == "lockstep: nothing can be late"
    assert run.figures["fix_rmse_m"] is not None
    assert run.reproduce.endswith("scenario.toml")
    assert run.scenario.radio.range_m == 3000.0
    assert run.nodes == ["v01", "v02", "v03", "v04", "v05"]
    assert len(run.states) == 5 * len(run.metrics) == 50
    assert set(run.trace["outcome"].to_pylist()) <= {"delivered", "receiver_down"}
    assert run.events[0].kind == "started"
    assert repr(run) == f"<Run {str(folder)!r}: valid>"


@pytest.mark.slow
def test_positions_and_ranges_are_those_of_the_period_that_holds_the_instant(folder: Path) -> None:
    run = emulator.Run.open(folder)
    np.testing.assert_allclose(run.times_s, np.arange(10) / 10)
    states = run.states.to_pylist()
    third = [row["position_m"] for row in states if row["period"] == 3]
    np.testing.assert_array_equal(run.positions(0.3), third)
    np.testing.assert_array_equal(run.positions(0.3999), third)
    offset_m = run.positions(0)[:, None] - run.positions(0)[None, :]
    near = (np.hypot(offset_m[..., 0], offset_m[..., 1]) <= 3000.0) & ~np.eye(5, dtype=bool)
    np.testing.assert_array_equal(run.in_range(0.5), near)


@pytest.mark.parametrize("time_s", [-0.1, 1.0, 1e6])
def test_an_instant_outside_the_run_is_refused(folder: Path, time_s: float) -> None:
    run = emulator.Run.open(folder)
    for ask in (run.positions, run.in_range):
        with pytest.raises(VnetError, match=r"time_s = .*: the run has periods from 0 s to 1 s"):
            ask(time_s)


def test_a_vehicle_is_up_but_while_a_fault_has_taken_it(folder: Path) -> None:
    run = emulator.Run.open(folder)
    second = [bool(run.up(time_s)[run.index("v02")]) for time_s in (0.0, 0.25, 0.3, 0.65, 0.7, 0.95)]
    assert second == [True, True, False, False, True, True]
    assert run.up(0.5).sum() == 4
    assert run.last_fault_s == pytest.approx(0.7)


def test_what_programs_report_is_an_array_over_periods_and_vehicles(folder: Path) -> None:
    run = emulator.Run.open(folder)
    neighbours = run.reported("neighbours")
    assert neighbours.shape == (10, 5)
    assert np.isnan(neighbours[4, 1])
    assert np.nansum(neighbours) > 0
    assert np.isnan(run.reported("nothing")).all()


def test_an_unknown_vehicle_is_named(folder: Path) -> None:
    with pytest.raises(VnetError, match=r"'v9': no such vehicle.*; there are v01, v02"):
        emulator.Run.open(folder).index("v9")


def test_within_a_check_there_is_no_verdict_yet(folder: Path) -> None:
    run = emulator.Run(RecordedRun.open(folder), folder)
    assert repr(run).endswith("not judged yet>")
    for name in ("verdict", "checks", "not_applicable", "figures", "reproduce"):
        with pytest.raises(VnetError, match="has no verdict yet"):
            getattr(run, name)


def test_what_is_no_run_is_refused_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(VnetError, match="not a run's folder"):
        emulator.Run.open(tmp_path)


def test_other_names_are_not_public() -> None:
    assert "Run" in dir(emulator)
    with pytest.raises(AttributeError, match="no attribute 'Runs'"):
        emulator.Runs  # noqa: B018


@pytest.mark.slow
@pytest.mark.parametrize(
    ("radio", "labels"), [({}, [0, 0, 1]), ({"fading": {}}, [0, 0, 0])], ids=["steady", "fading"]
)
def test_vehicles_that_never_hear_each_other_are_in_different_components(
    tmp_path: Path, radio: dict[str, Any], labels: list[int]
) -> None:
    """Without fading no frame below `min_rssi_dbm` is detected, which is more than `floor_dbm`."""
    path = tmp_path / "places.csv"
    path.write_text("id,x_m,y_m,heading_rad\na,0,0,0\nb,150,0,0\nc,75,415,0\n")
    run = emulator.simulate(
        {
            "run": {"duration_s": 1.0, "settle_s": 0.0},
            "network": {"kind": "file", "path": str(path)},
            "radio": {"path_loss": {"kind": "dual_slope"}, **radio},
        },
        program="agents.beacon:main",
    )
    assert run.components(0.5, np.ones(3, dtype=bool)).tolist() == labels
