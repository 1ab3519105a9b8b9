"""Networks of the user's own: a function says where vehicles are."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

import emulator
from emulator.cli.folders import check
from emulator.scenario.loading import load_scenario
from emulator.scenario.program import Program
from emulator.world.trips.drive import drive
from emulator.world.world import build_world
from tests.support.answers import answers
from tests.support.cli import command_app
from vnet.errors import ScenarioError

CIRCLE = """
import math


def network(seed, vehicles, duration_s):
    times_s = [0.5 * step for step in range(int(2 * duration_s) + 1)]
    return {
        f"c{number}": [place(t, number + seed + t / 20) for t in times_s]
        for number in range(vehicles)
    }


def place(time_s, angle):
    return time_s, 300 * math.cos(angle), 300 * math.sin(angle)


def stands_and_enters(seed, vehicles, duration_s):
    return {"unit": [(0, 1, 2, 0.5), (duration_s, 1, 2, 0.5)], "late": [(1, 50, 0), (2, 70, 0)]}


def leaves(seed, vehicles, duration_s):
    raise SystemExit(3)

def stumbles(seed, vehicles, duration_s):
    return {"c0": 1 / 0}
"""
SCENARIO = """
[run]
duration_s = 2.0
settle_s = 0.0

[network]
kind = "{}"
vehicles = 3
"""


@pytest.fixture
def scenario(tmp_path: Path) -> Path:
    (tmp_path / "shapes.py").write_text(CIRCLE)
    path = tmp_path / "own.toml"
    path.write_text(SCENARIO.format("shapes.py"))
    return path


def test_vehicles_are_where_the_function_says(scenario: Path) -> None:
    world = build_world(load_scenario(scenario))
    assert world.node_ids == ("c0", "c1", "c2")
    for period in (0, 5, 20):
        angle = np.arange(3) + 1 + period / 10 / 20
        expected = 300 * np.column_stack([np.cos(angle), np.sin(angle)])
        assert world.position_m(period) == pytest.approx(expected, abs=0.01)  # the chord of half a second


def test_its_seed_is_that_of_the_network(scenario: Path) -> None:
    scenario.write_text(SCENARIO.format("shapes.py:network") + "seed = 2\n")
    angle = math.atan2(*build_world(load_scenario(scenario)).position_m(0)[0][::-1])
    assert angle == pytest.approx(2)


def test_two_samples_stand_for_all_between_and_others_enter_leave_and_need_no_heading(scenario: Path) -> None:
    loaded = load_scenario(scenario, ["network.kind=shapes.py:stands_and_enters", "run.duration_s=30"])
    world = build_world(loaded)
    there = np.array([world.present(period) for period in range(300)])
    assert there[:, world.node_ids.index("unit")].all()
    assert np.flatnonzero(there[:, world.node_ids.index("late")]).tolist() == list(range(10, 21))
    heading_rad = world.at(15).heading_rad
    assert [heading_rad[world.node_ids.index(node)] for node in ("unit", "late")] == pytest.approx([0.5, 0.0])


@answers("network")
def test_a_wrong_answer_is_one_line(scenario: Path, kind: str, answer: str, said: str, request: Any) -> None:
    name = f"answers_{request.node.callspec.indices['answer']}"
    (scenario.parent / f"{name}.py").write_text(f"def network(seed, vehicles, duration_s):\n    return {answer}\n")
    loaded = load_scenario(scenario, [f"network.kind={name}.py"])
    with pytest.raises(ScenarioError) as refused:
        drive(loaded.network, Program(folders=(scenario.parent,)), 21, 10**8)
    assert str(refused.value).startswith(f"network.kind = '{name}:network': {said}")


def test_a_function_that_raises_or_is_not_there_is_named(scenario: Path) -> None:
    for function, problem in (
        (
            "shapes.py:stumbles",
            r"network.kind = 'shapes:stumbles': ZeroDivisionError: division by zero \(shapes.py:",
        ),
        ("shapes.py:leaves", r"network.kind = 'shapes:leaves': SystemExit: 3 \(shapes.py:"),
        ("shapes.py:missing", r"network.kind = 'shapes:missing': module shapes .* has no 'missing'"),
        ("circles.py", r"network.function = 'circles.py': no such file"),
        ("circles", r"network.kind = 'circles': must be"),
    ):
        with pytest.raises(ScenarioError, match=problem):
            build_world(load_scenario(scenario, [f"network.kind={function}"]))
    with pytest.raises(ScenarioError, match='function goes with kind = "own", and is required there'):
        load_scenario(scenario, ["network.kind=own"])


@pytest.mark.slow
def test_a_finished_run_needs_the_function_only_to_run_again(scenario: Path) -> None:
    run = emulator.simulate(scenario, out=scenario.parent / "run")
    again = emulator.simulate(scenario.parent / "run" / "scenario.toml", out=scenario.parent / "again")
    assert again.trace == run.trace
    (scenario.parent / "shapes.py").unlink()
    assert emulator.Run.open(scenario.parent / "run").trace.num_rows == run.trace.num_rows
    judged = CliRunner().invoke(command_app(check), [str(scenario.parent / "run")])
    assert judged.exit_code == 0, judged.output
