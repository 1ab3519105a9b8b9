"""Orders of events: the same however vehicles are divided into processes, and again from their tape."""

from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from emulator.drivers.emulation import Emulation, NodeState
from emulator.drivers.session import with_order_steps
from emulator.records.tape import MediumOrder, TapeEntry, dump_tape, first_left, read_tape
from emulator.scenario.scenario import Scenario
from tests.emulator.drivers.test_windows import fingerprint, same, scenarios
from tests.support.multi_loop_driver import run_apart, run_forked, run_together, scenario_of
from vnet.errors import VnetError
from vnet.transport.wire import Deviation

pytestmark = pytest.mark.slow

IMPROVISES = "tests.support.window_programs:improvises"


def ordered(scenario: Scenario, **run: Any) -> Scenario:
    """The scenario with another order of events."""
    data = scenario.model_dump(exclude_none=True)
    return Scenario.model_validate({**data, "run": {**data["run"], **run}})


def taped(scenario: Scenario, run: Emulation, folder: Path) -> Scenario:
    """The scenario in FIFO order but for the deviations that a run has made."""
    path = folder / "tape.jsonl"
    path.write_text(dump_tape(run.orders.in_order()))
    return ordered(scenario, order="fifo", tape=path)


@settings(max_examples=6, deadline=None)
@given(
    scenario=scenarios(),
    kind=st.sampled_from(["shuffle", "pct"]),
    seed=st.integers(0, 1000),
    slack_us=st.sampled_from([0, 100, 2000, 20_000]),
)
def test_an_order_is_the_same_in_any_division_into_processes_and_from_its_tape(
    scenario: Scenario, kind: str, seed: int, slack_us: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
    scenario = ordered(scenario, order_slack_us=slack_us, order_seed=seed)
    explored = ordered(scenario, order=kind, order_steps=500)
    reference = run_together(explored)
    apart = run_apart(explored)
    assert same(fingerprint(apart)[:3], fingerprint(reference)[:3])
    assert apart.orders.in_order() == reference.orders.in_order()
    forked = run_forked(explored)
    assert same(fingerprint(forked), fingerprint(reference))
    assert forked.orders.in_order() == reference.orders.in_order()
    assert forked.orders.steps == reference.orders.steps
    again = run_together(taped(scenario, reference, tmp_path_factory.mktemp("tape")))
    assert same(fingerprint(again), fingerprint(reference))
    assert again.orders.left() is None
    assert again.orders.in_order() == reference.orders.in_order()


@pytest.mark.parametrize("kind", ["shuffle", "pct"])
def test_a_timer_that_was_cancelled_is_no_option_wherever_a_vehicle_runs(kind: str) -> None:
    """A loop that vehicles share meets a cancelled timer behind another one's; a loop of its own drops it."""
    scenario = scenario_of([], "tests.support.window_programs:cancels_timers", 3, run={"duration_s": 2.0})
    explored = ordered(scenario, order=kind, order_seed=3, order_steps=500)
    together, apart = run_together(explored), run_apart(explored)
    assert together.orders.in_order() == apart.orders.in_order() != []


@settings(max_examples=2, deadline=None)
@given(scenario=scenarios())
def test_an_empty_tape_is_fifo(scenario: Scenario, tmp_path_factory: pytest.TempPathFactory) -> None:
    """All decisions are made, each as FIFO makes it, whatever vehicles do with executors, timers and mail."""
    path = tmp_path_factory.mktemp("tape") / "tape.jsonl"
    path.touch()
    run = run_together(ordered(scenario, tape=path))
    assert same(fingerprint(run), fingerprint(run_together(scenario)))
    assert sum(run.orders.steps.values()) > 0
    assert run.orders.made == []


def test_frames_of_one_instant_come_to_the_medium_in_another_order() -> None:
    """Vehicles that send with their fixes send at the same instant; who is first changes with the seed."""
    radio = {"access_jitter_ms": 0.0, "loss": 0.0}
    scenario = scenario_of([], "agents.beacon:main", 4, run={"duration_s": 1.0, "settle_s": 0.0}, radio=radio)
    firsts = set()
    for seed in range(8):
        run = run_together(ordered(scenario, order="shuffle", order_seed=seed))
        firsts |= {entry.medium[0] for entry in run.orders.made if isinstance(entry, MediumOrder)}
    assert firsts == {"v01", "v02", "v03", "v04"}


def test_the_order_changes_no_other_draw() -> None:
    """Frames are lost, and delayed, as in FIFO order: what a vehicle sends at an instant does not change."""
    scenario = scenario_of([], "agents.beacon:main", 4, run={"duration_s": 1.0, "settle_s": 0.0})
    fifo = run_together(scenario)
    assert run_together(ordered(scenario, order="shuffle")).engine.counts == fifo.engine.counts


@pytest.mark.parametrize("after_s", [0.0015, 0.0025, 0.0055])
def test_a_slack_swaps_a_timer_and_a_packet_that_are_nearly_simultaneous(after_s: float) -> None:
    sections = {
        "run": {"duration_s": 1.0, "settle_s": 0.0},
        "radio": {"jitter_ms": 0.0, "access_jitter_ms": 0.0, "loss": 0.0},
        "program": {"options": {"after_s": after_s}},
    }
    scenario = scenario_of([], "tests.support.window_programs:races", 2, **sections)

    def failures(**order: Any) -> int:
        runs = [run_together(ordered(scenario, order_seed=seed, **order)) for seed in range(8)]
        return sum(1 for run in runs for node in run.up if run.presence.state(node) is NodeState.ENDED)

    assert failures(order="shuffle") == 0
    assert (failures(order="shuffle", order_slack_us=1000) > 0) == (abs(after_s - 0.002) < 0.001)


def test_decisions_are_counted_in_fifo_order_where_pct_needs_their_number() -> None:
    run, radio = {"duration_s": 1.0, "settle_s": 0.0}, {"jitter_ms": 0.0, "access_jitter_ms": 0.0, "loss": 0.0}
    scenario = ordered(scenario_of([], IMPROVISES, 4, run=run, radio=radio), order="pct")
    steps = with_order_steps(scenario).run.order_steps
    assert steps is not None and steps > 1
    known = ordered(scenario, order_steps=7)
    assert with_order_steps(known) is known


def test_a_tape_is_read_as_it_was_written(tmp_path: Path) -> None:
    entries: list[TapeEntry] = [
        MediumOrder(5, ("v02", "v01")),
        Deviation("v01", 1, 7, 0, "timer of main", "packet from v02"),
    ]
    path = tmp_path / "tape.jsonl"
    path.write_text(dump_tape(entries))
    assert read_tape(path) == entries


@pytest.mark.parametrize("line", ["x", "[]", '{"node": "v01"}', '{"time_ns": -1, "medium": []}'])
def test_a_file_that_is_no_tape_is_refused_with_its_line(line: str, tmp_path: Path) -> None:
    path = tmp_path / "tape.jsonl"
    path.write_text(dump_tape([MediumOrder(5, ("v02", "v01"))]) + line + "\n")
    with pytest.raises(VnetError, match=r"tape.jsonl: line 2: .*: a line of tape.jsonl is needed"):
        read_tape(path)


def test_a_run_says_where_it_left_a_tape_that_does_not_fit() -> None:
    made = [Deviation("v01", 0, 7, 0, "fix", "packet from v02")]
    later = Deviation("v02", 0, 9, 1, "timer of f", "fix")
    earlier = Deviation("v02", 0, 8, 1, "timer of f", "fix")
    assert first_left([*made, later, earlier], made) == earlier
    assert first_left(made, made) is None
