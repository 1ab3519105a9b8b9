"""The figures that a user sees while a run is on are those of the run."""

from dataclasses import asdict
from pathlib import Path

import pytest

from emulator.drivers.emulation import Emulation, PeriodView
from emulator.drivers.simulate import simulate
from emulator.drivers.status import BINS, Course, Snapshot
from tests.support.recorded import prepared

KILLED = {"kind": "kill", "at_s": 1.0, "duration_s": 1.0, "nodes": {"ids": ["v02"]}}
PERIOD_WALL_S = 0.05


class Clock:
    """A wall clock that goes on by `PERIOD_WALL_S` a period."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s

    def tick(self, view: PeriodView) -> None:
        self.now_s += PERIOD_WALL_S


def emulate(folder: Path, **sections: object) -> Emulation:
    """A run to be, of six beacons in range of each other."""
    run = {"duration_s": 4.0, "settle_s": 1.0}
    network = {"vehicles": 6, "layout": "dense"}
    scenario = {"run": run, "network": network, "radio": {"loss": 0.2, "range_m": 1e5}, **sections}
    return prepared(scenario, folder)


@pytest.fixture(scope="module")
def shots(tmp_path_factory: pytest.TempPathFactory) -> list[Snapshot]:
    """Snapshots before the run, and after each of its periods."""
    emulation = emulate(tmp_path_factory.mktemp("course") / "run", fault=[KILLED])
    clock = Clock()
    emulation.watch(clock.tick)
    course = Course(emulation, clock)
    found = [course.snapshot()]
    emulation.watch(lambda view: found.append(course.snapshot()))
    simulate(emulation)
    found.append(course.snapshot())
    return found


@pytest.mark.slow
def test_time_and_speed(shots: list[Snapshot]) -> None:
    assert [shot.emulated_s for shot in shots[:3]] == pytest.approx([0.0, 0.1, 0.2])
    assert (shots[0].phase, shots[0].real_time_factor) == ("starting", None)
    assert (shots[1].phase, shots[1].real_time_factor) == ("running", None), "in it the programs start"
    for shot in shots[2:]:
        assert shot.real_time_factor == pytest.approx(0.1 / PERIOD_WALL_S)
        assert shot.remaining_s == pytest.approx((4.0 - shot.emulated_s) * PERIOD_WALL_S / 0.1)
        assert shot.wall_s == pytest.approx(shot.emulated_s * PERIOD_WALL_S / 0.1)
        assert shot.idle_s == 0.0


@pytest.mark.slow
def test_the_speed_is_that_of_late(tmp_path: Path) -> None:
    emulation = emulate(tmp_path / "run", run={"duration_s": 30.0})
    clock = Clock()
    emulation.watch(lambda view: setattr(clock, "now_s", clock.now_s + (1.0 if view.instant.period < 100 else 0.1)))
    course = Course(emulation, clock)
    simulate(emulation)
    assert course.snapshot().real_time_factor == pytest.approx(1.0)
    clock.now_s += 7.0
    assert course.snapshot().idle_s == pytest.approx(7.0)


@pytest.mark.slow
def test_frames_and_their_rates(shots: list[Snapshot]) -> None:
    for shot, earlier in zip(shots[11:], shots[1:], strict=False):
        before = {name: earlier.frames_by_outcome.get(name, 0) for name in shot.frames_per_s}
        change = {name: shot.frames_by_outcome[name] - count for name, count in before.items()}
        if shot.emulated_s < 4.0:
            assert shot.frames_per_s == pytest.approx(change)
    assert set(shots[-1].frames_by_outcome) == {"delivered", "lost", "receiver_down"}
    assert sum(shots[-1].frames_by_outcome.values()) == 40 * 6 * 5 - 10 * 5, "six send 40 times, one of them 30"


def test_vehicles_faults_and_events(shots: list[Snapshot]) -> None:
    states = {shot.emulated_s: (shot.down, shot.faults[0].state) for shot in shots}
    assert states[0.5] == ((), "to come")
    assert states[1.5] == (("v02",), "acting")
    assert states[4.0] == ((), "ended")
    fault = shots[0].faults[0]
    assert (fault.fault, fault.start_s, fault.end_s, fault.nodes) == ("kill-0", 1.0, 2.0, ("v02",))
    kinds = [event.kind for event in shots[-1].events]
    assert kinds == ["started", "fault_started", "fault_ended", "restarted"]


def test_a_fault_that_was_healed_before_it_began_is_not_to_come(tmp_path: Path) -> None:
    emulation = emulate(tmp_path / "run", fault=[KILLED])
    assert Course(emulation, Clock()).snapshot(500_000_000).faults[0].state == "to come"
    emulation.heal("kill-0", 500_000_000)
    assert Course(emulation, Clock()).snapshot(600_000_000).faults[0].state == "ended"


def test_figures_over_time_are_in_equal_parts_of_the_run(shots: list[Snapshot]) -> None:
    half = next(shot for shot in shots if shot.emulated_s == 2.0)
    assert len(half.over_time["position_rmse_m"]) == BINS / 2
    assert not half.never_reported("position_rmse_m")
    figures = [shot.figures["position_rmse_m"] for shot in shots[1:-1]]
    assert shots[-1].over_time["position_rmse_m"][:: BINS // 40] == tuple(figures), "a period takes three parts"
    assert asdict(half)["over_time"]["fix_rmse_m"] == half.over_time["fix_rmse_m"]


@pytest.mark.slow
def test_many_periods_share_a_part(tmp_path: Path) -> None:
    emulation = emulate(tmp_path / "run", run={"duration_s": 24.0})
    course = Course(emulation)
    figures: list[float] = []
    emulation.watch(lambda view: figures.append(view.figures.fix_rmse_m or 0.0))
    simulate(emulation)
    means = course.snapshot().over_time["fix_rmse_m"]
    assert len(means) == BINS
    assert means == pytest.approx([(a + b) / 2 for a, b in zip(figures[::2], figures[1::2], strict=True)])


def test_who_is_awaited(tmp_path: Path) -> None:
    course = Course(emulate(tmp_path / "run"))
    course.awaits(["v03"])
    shot = course.snapshot()
    assert (shot.phase, shot.missing, shot.join_timeout_s) == ("joining", ("v03",), 60.0)
    course.awaits([])
    assert (course.snapshot().phase, course.snapshot().missing) == ("running", ())
    course.judging()
    assert course.snapshot().phase == "judging"
