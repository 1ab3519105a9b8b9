"""Random schedules fit their scenario, and hypothesis shrinks them to what was planted."""

import tomllib
from typing import Any

import pytest
from hypothesis import HealthCheck, Phase, find, given, settings
from hypothesis.errors import NoSuchExample

from emulator.fault_plan import FaultPlan, Nodes
from emulator.scenario.faults import KINDS, Kill, Loss, Partition, Pause, Selector
from emulator.scenario.scenario import Scenario
from emulator.testing.campaign import schedule_toml
from emulator.testing.campaign_plan import Plan, ScheduleConstraints, known_kinds, simulated_kinds
from emulator.testing.strategies import faults
from emulator.testing.trial import Schedule, shrink
from emulator.world.world import build_world
from vnet.errors import ScenarioError

pytestmark = pytest.mark.slow

SMALL: dict[str, dict[str, Any]] = {"run": {"duration_s": 6.0, "settle_s": 1.0}, "network": {"vehicles": 6}}
QUIET = settings(
    deadline=None,
    derandomize=True,
    database=None,
    max_examples=400,
    phases=[Phase.generate, Phase.shrink],
    suppress_health_check=list(HealthCheck),
)


def planned(schedule: Schedule, groups: int = 1) -> FaultPlan:
    """The plan of a schedule in the small scenario. Raises ScenarioError if it does not fit."""
    data = SMALL | {"run": SMALL["run"] | {"nodes_per_process": groups}, "fault": schedule}
    scenario = Scenario.model_validate(data)
    world = build_world(scenario)
    start = world.at(0)
    return FaultPlan(scenario, Nodes(world.node_ids, start.position_m, (start.position_m < 0).sum(axis=1)))


@given(schedule=faults(SMALL))
@settings(QUIET, max_examples=100)
def test_what_is_drawn_fits_the_scenario(schedule: Schedule) -> None:
    assert len(schedule) <= 4
    for fault in planned(schedule).faults:
        assert fault.end_ns <= 5e9
        assert fault.end_ns - fault.start_ns == round(fault.fault.duration_s * 1e9)


@given(schedule=faults(SMALL, kinds=["kill", "pause"], **{"run.nodes_per_process": 2}))
@settings(QUIET, max_examples=40)
def test_the_vehicles_of_a_process_are_hit_together(schedule: Schedule) -> None:
    planned(schedule, groups=2)


def test_a_pause_in_a_crowd_shrinks_to_the_shortest_of_one_vehicle() -> None:
    def falls(schedule: Schedule) -> bool:
        return any(
            isinstance(f, Pause) and f.duration_s >= 0.7 and f.at_s >= 1 and "v03" in (f.nodes.ids or ())
            for f in schedule
        )

    smallest = find(faults(SMALL), falls, settings=settings(QUIET, max_examples=5000))
    assert smallest == (Pause(kind="pause", at_s=1.0, duration_s=0.7, nodes=Selector(ids=("v03",))),)


def test_two_faults_that_only_fail_together_both_stay() -> None:
    def falls(schedule: Schedule) -> bool:
        return {"loss", "partition"} <= {fault.kind for fault in schedule}

    smallest = find(faults(SMALL, kinds=["partition", "loss"]), falls, settings=QUIET)
    assert sorted(fault.kind for fault in smallest) == ["loss", "partition"]
    assert all((fault.at_s, fault.duration_s) == (0.0, 0.1) for fault in smallest)


def test_what_fails_without_faults_shrinks_to_none() -> None:
    assert find(faults(SMALL), lambda schedule: True, settings=QUIET) == ()


def test_only_the_kinds_that_were_asked_for_are_drawn() -> None:
    with pytest.raises(NoSuchExample):
        find(faults(SMALL, kinds=["kill"]), lambda s: any(fault.kind != "kill" for fault in s), settings=QUIET)
    with pytest.raises(ScenarioError, match="fault 'rain': must be one of block, "):
        faults(SMALL, kinds=["rain"])
    not_drawn = {"emulator_restart", "router_restart", "custom", "custom_sender"}
    assert set(KINDS) - set(simulated_kinds()) == not_drawn
    assert known_kinds(None) == simulated_kinds()


def test_no_time_for_faults_is_said() -> None:
    with pytest.raises(ScenarioError, match="leaves no time for faults"):
        ScheduleConstraints.of(Scenario.model_validate({"run": {"duration_s": 3.0}}))


def test_a_campaign_draws_the_same_for_a_seed_and_every_kind_at_last() -> None:
    scenario = Scenario.model_validate(SMALL)
    plan = Plan.of(scenario, "random", 120, 5)
    drawn = [plan.draw(number) for number in range(120)]
    assert [plan.draw(number).fault for number in range(5)] == [run.fault for run in drawn[:5]]
    assert Plan.of(scenario, "random", 1, 9).draw(0) == drawn[4], "a failure is reproduced by its seed alone"
    assert {fault.kind for run in drawn for fault in run.fault} == set(simulated_kinds())
    assert {len(run.fault) for run in drawn} == {1, 2, 3, 4}


EVERYBODY = Selector(ids=("v01", "v02", "v03", "v04"))
CROWD: Schedule = (
    Kill(kind="kill", at_s=1.0, duration_s=4.0, nodes=EVERYBODY),
    Loss(kind="loss", at_s=0.5, duration_s=3.2, probability=0.5, senders=EVERYBODY),
    Partition(kind="partition", at_s=2.0, duration_s=2.0, groups=(("v01", "v02", "v03"),)),
)


@pytest.mark.parametrize(("ids", "duration_s"), [(("v03",), 0.5), (("v01", "v03"), 1.3), (EVERYBODY.ids, 2.9)])
def test_shrinking_leaves_what_is_needed(ids: tuple[str, ...], duration_s: float) -> None:
    def falls(schedule: Schedule) -> bool:
        return any(
            isinstance(fault, Loss) and fault.duration_s >= duration_s and {*ids} <= {*(fault.senders.ids or ())}
            for fault in schedule
        )

    smallest, steps = shrink(CROWD, falls)
    assert smallest == (CROWD[1].model_copy(update={"senders": Selector(ids=ids), "duration_s": duration_s}),)
    assert steps <= 40


def test_a_fault_of_many_vehicles_is_shortened_though_all_are_needed() -> None:
    many = Selector(ids=tuple(f"v{number}" for number in range(60)))
    schedule: Schedule = (Loss(kind="loss", at_s=0.5, duration_s=8.0, probability=0.5, senders=many),)

    def falls(some: Schedule) -> bool:
        return bool(some) and some[0].duration_s >= 0.5 and isinstance(some[0], Loss) and some[0].senders == many

    (smallest,), _ = shrink(schedule, falls)
    assert smallest.duration_s == 0.5


def test_a_fault_that_is_left_keeps_its_random_draws_if_they_matter() -> None:
    def falls(schedule: Schedule) -> bool:
        return any(isinstance(each.fault, Loss) and each.draws_of == 1 for each in planned(schedule).faults)

    smallest, _ = shrink(CROWD, falls)
    assert [(fault.kind, fault.draws_of) for fault in smallest] == [("loss", 1)]
    assert [each.draws_of for each in planned((smallest[0], CROWD[0])).faults] == [1, 2]
    with pytest.raises(ScenarioError, match="loss-1: draws_of = 1: loss-0 has these draws"):
        planned((smallest[0], smallest[0]))


def test_shrinking_stops_after_so_many_steps() -> None:
    asked: list[Schedule] = []

    def falls(schedule: Schedule) -> bool:
        asked.append(schedule)
        return False

    smallest, steps = shrink(CROWD, falls, most=3)
    assert (smallest, steps, len(asked)) == (CROWD, 3, 3)


def test_a_group_of_a_partition_shrinks_too() -> None:
    def falls(schedule: Schedule) -> bool:
        return any(isinstance(fault, Partition) and "v03" in fault.groups[0] for fault in schedule)

    smallest, _ = shrink(CROWD[2:], falls)
    assert [fault.groups for fault in smallest if isinstance(fault, Partition)] == [(("v03",),)]


def test_a_schedule_is_printed_as_a_scenario_states_it() -> None:
    text = schedule_toml(CROWD)
    assert Scenario.model_validate({"run": {"duration_s": 20.0}} | tomllib.loads(text)).fault == CROWD
    assert 'nodes.ids = ["v01", "v02", "v03", "v04"]' in text
    assert schedule_toml(()) == ""
