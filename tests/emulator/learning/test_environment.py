"""`emulator.environment`: PettingZoo's own tests, what agents see and do, and how episodes end."""

import importlib
import pickle
import threading
from collections.abc import Sequence
from contextlib import suppress
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium.spaces import Box
from pettingzoo.test import parallel_api_test, parallel_seed_test

import emulator
from emulator import Moment
from vnet import Fix, Node, Packet
from vnet.errors import VnetError
from vnet.units import NS_PER_S

ROAD = {"road": "ring", "length_m": 1000.0, "gap_m": 40.0, "speed_mps": 10.0}


def see(node: Node, fix: Fix, packets: Sequence[Packet]) -> Any:
    """Observe the receiver's speed, and the number of packets."""
    assert fix.speed_m_s is not None
    return np.array([fix.speed_m_s, len(packets)], np.float32)


async def drive_and_tell(node: Node, action: Any) -> None:
    """Accelerate, and say so."""
    node.drive(acceleration_m_s2=float(action[0]))
    await node.radio.broadcast(b"driving")


def speed_of(agent: str, moment: Moment) -> float:
    """Reward for speed."""
    return moment.speed_m_s[agent]


def make(road: dict[str, Any] | None = None, duration_s: float = 2.0, **more: Any) -> Any:
    """Return an environment of four driven vehicles."""
    scenario = {
        "network": {"kind": "driven", "vehicles": 4, "driven": ROAD | (road or {})},
        "run": {"duration_s": duration_s, "settle_s": 0.0},
        **more.pop("sections", {}),
    }
    given: dict[str, Any] = {"observe": see, "act": drive_and_tell, "reward": speed_of} | more
    given["observation_space"] = Box(-np.inf, np.inf, (2,), np.float32)
    given["action_space"] = Box(-3, 3, (1,), np.float32)
    return emulator.environment(scenario, **given)


def threads() -> int:
    """Return the number of episodes whose thread is there."""
    return sum(thread.name == "vnet episode" for thread in threading.enumerate())


def play(env: Any, acceleration: float = 1.0, seed: int = 1) -> list[Any]:
    """Play an episode with one action for all; returns what each step has returned."""
    steps = [env.reset(seed=seed)]
    while env.agents:
        steps.append(env.step({agent: np.array([acceleration]) for agent in env.agents}))
    return steps


@pytest.mark.slow
def test_it_passes_pettingzoo_s_test_of_parallel_environments(capsys: pytest.CaptureFixture[str]) -> None:
    env = make()
    parallel_api_test(env, num_cycles=40)
    env.close()
    assert "Passed Parallel API test" in capsys.readouterr().out
    assert env.render_mode is None, "as wrappers ask"
    assert threads() == 0


@pytest.mark.slow
def test_it_passes_pettingzoo_s_test_of_seeds() -> None:
    parallel_seed_test(make, num_cycles=30)


def test_actions_drive_vehicles_and_frames_are_heard() -> None:
    steps = play(make(duration_s=3.0))
    assert len(steps) == 1 + 30
    last, rewards, terminated, truncated, infos = steps[-1]
    for agent in ("v01", "v02", "v03", "v04"):
        speed, heard = last[agent].tolist()
        assert speed == pytest.approx(10 + 2.6, abs=0.5)  # 2.9 s of 1 m/s², less a lag of 0.3 s
        assert heard == 3
        assert rewards[agent] == pytest.approx(speed, abs=0.5)
        assert (terminated[agent], truncated[agent], infos[agent]) == (False, True, {})


@pytest.mark.slow
def test_each_episode_has_the_next_seed() -> None:
    env = make()
    first, second, third = (env.reset(seed=seed)[0]["v01"].tolist() for seed in (5, None, 5))
    other = make(set={"run.seed": 6})
    assert first == third != second == other.reset()[0]["v01"].tolist()
    env.close()
    other.close()


@pytest.mark.slow
def test_a_vehicle_that_leaves_is_terminated() -> None:
    road = {"road": "straight", "length_m": 200.0, "start_m": [195.0, 100.0, 60.0, 20.0]}
    steps = play(make(road), acceleration=0.0)
    left = next(step for step in steps[1:] if step[2]["v01"])
    assert [step is left for step in steps].index(True) == 6  # 195 m and 0.6 s of 10 m/s
    assert "v01" not in steps[-1][0]
    assert all(steps[-1][3][agent] for agent in ("v02", "v03", "v04"))


def test_an_episode_goes_on_while_nobody_is_there_and_others_will_enter(tmp_path: Path) -> None:
    times_s = (("a", 0), ("a", 1), ("b", 2), ("b", 3))
    rows = [f"{name},{time_s},{10 * time_s},0" for name, time_s in times_s]
    (tmp_path / "trips.csv").write_text("\n".join(["id,time_s,x_m,y_m", *rows]))
    network = {"kind": "trips", "path": str(tmp_path / "trips.csv")}
    env = make(duration_s=4.0, act=lambda node, action: None, sections={"network": network})
    steps = play(env)
    alone = next(step for step in steps[1:] if step[2].get("a"))
    assert "b" in alone[0] and not alone[2]["b"]
    assert next(step for step in steps if "b" in step[0]) is alone
    assert steps[-1][2]["b"] and threads() == 0
    assert alone[1]["b"] == 0.0, "the speed of one that enters"


@pytest.mark.slow
def test_a_killed_program_s_agent_is_terminated_and_not_revived() -> None:
    fault = {"kind": "kill", "nodes": ["v02"], "at_s": 0.5, "duration_s": 0.3}
    steps = play(make(sections={"fault": [fault]}))
    assert ["v02" in step[0] for step in steps] == [True] * 6 + [False] * (len(steps) - 6)
    assert steps[5][2]["v02"]


@pytest.mark.slow
def test_an_episode_with_a_kill_that_ends_is_valid_and_one_that_is_left_early_is_not_judged(tmp_path: Path) -> None:
    fault = {"kind": "kill", "nodes": ["v02"], "at_s": 0.5, "duration_s": 0.3}
    env = make(sections={"fault": [fault]}, out=tmp_path)
    play(env)
    for steps in (1, 5, 8):  # as a fault begins, and as it ends
        env.reset(seed=2)
        for _ in range(steps):
            env.step({})
    env.close()
    folders = sorted(path for path in tmp_path.iterdir() if path.is_dir())
    verdicts = [emulator.Run.open(folder).verdict for folder in folders]
    assert [verdict.value for verdict in verdicts] == ["valid", "unknown", "unknown", "unknown"]


def test_an_order_whose_decisions_nobody_can_count_is_refused() -> None:
    with pytest.raises(VnetError, match="order_steps"):
        make(set={"run.order": "pct"})
    env = make(set={"run.order": "pct", "run.order_steps": 50})
    assert len(play(env)) == 21


def test_what_the_user_imports_between_steps_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "own_policy.py").write_text("class Policy: ...\n")
    env = make()
    env.reset(seed=1)
    policy = importlib.import_module("own_policy").Policy()
    env.reset(seed=2)
    env.close()
    assert isinstance(pickle.loads(pickle.dumps(policy)), importlib.import_module("own_policy").Policy)


FAULTS: dict[str, dict[str, Any]] = {
    "pause of one": {"kind": "pause", "nodes": ["v02"], "duration_s": 0.5},
    "pause of all": {"kind": "pause", "duration_s": 0.5},
    "outage of all": {"kind": "gnss_outage", "duration_s": 0.5},
    "a clock set forward": {"kind": "skew", "nodes": ["v01"], "duration_s": 0.5, "offset_ms": 3000.0},
}


@pytest.mark.parametrize("name", FAULTS)
@pytest.mark.parametrize("at_s", [0.0, 0.5, 0.55])
def test_a_step_is_a_period_whatever_fails(name: str, at_s: float) -> None:
    moments: list[Moment] = []

    def see_time(node: Node, fix: Fix, packets: Sequence[Packet]) -> Any:
        return np.array([fix.time_ns / NS_PER_S, len(packets)], np.float32)

    def reward(agent: str, moment: Moment) -> float:
        moments.extend([moment] if agent == "v01" else [])
        return 1.0

    steps = play(make(observe=see_time, reward=reward, sections={"fault": [FAULTS[name] | {"at_s": at_s}]}))
    begun = 2.0 - (at_s + 0.5 if at_s == 0.0 and name in ("pause of all", "outage of all") else 0.0)
    assert len(steps) == 1 + round(10 * begun)
    times = [moment.time_s for moment in moments]
    assert times[:-1] == pytest.approx([2.0 - begun + 0.1 * (1 + step) for step in range(len(times) - 1)])
    for step, time_s in zip(steps[1:], times[:-1], strict=False):
        fix_s = {agent: float(seen[0]) for agent, seen in step[0].items()}
        assert max(fix_s.values()) <= time_s + 1e-6
        failing = at_s <= time_s < at_s + 0.5 - 1e-6
        if not failing or name == "a clock set forward":
            assert fix_s == pytest.approx(dict.fromkeys(fix_s, time_s), abs=1e-6)


@pytest.mark.parametrize("left", ["close", "terminated", "error"])
def test_an_episode_may_be_left_while_all_vehicles_are_paused(left: str) -> None:
    def reward(agent: str, moment: Moment) -> float:
        if left == "error" and moment.time_s > 0.65:
            raise ValueError("left")
        return 0.0

    ends: Any = {"terminated": lambda agent, moment: moment.time_s > 0.65} if left == "terminated" else {}
    env = make(reward=reward, sections={"fault": [{"kind": "pause", "at_s": 0.5, "duration_s": 0.5}]}, **ends)
    env.reset(seed=1)
    with suppress(ValueError):
        for _ in range(7):
            env.step({})
    env.close()
    assert threads() == 0


def test_an_agent_that_gets_no_fix_has_its_last_observation_and_does_not_act() -> None:
    moments: list[Moment] = []

    def reward(agent: str, moment: Moment) -> float:
        moments.extend([moment] if agent == "v01" else [])
        return 0.0

    fault = {"kind": "pause", "nodes": ["v02"], "at_s": 0.5, "duration_s": 0.3}
    steps = play(make(reward=reward, sections={"fault": [fault]}))
    assert all("v02" in step[0] for step in steps)
    assert steps[5][0]["v02"].tolist() == steps[6][0]["v02"].tolist() != steps[9][0]["v02"].tolist()
    assert ["v02" not in moment.actions for moment in moments] == [False] * 5 + [True] * 3 + [False] * 12


@pytest.mark.parametrize("nodes", [["v01"], ["v01", "v02", "v03", "v04"]], ids=len)
@pytest.mark.parametrize(("at_s", "duration_s", "step"), [(0.5, 0.3, 5), (0.55, 0.01, 6)])
def test_whoever_is_killed_is_terminated_in_that_step(
    nodes: list[str], at_s: float, duration_s: float, step: int
) -> None:
    fault = {"kind": "kill", "nodes": nodes, "at_s": at_s, "duration_s": duration_s}
    steps = play(make(sections={"fault": [fault]}))
    for node in nodes:
        assert [taken[2].get(node, True) for taken in steps[1:]] == [False] * (step - 1) + [True] * (
            len(steps) - step
        )
    assert len(steps) == (1 + step if len(nodes) == 4 else 21)


def test_a_function_may_end_an_agent_s_episode() -> None:
    env = make({"start_m": [40.0, 30.0, 200.0, 300.0]}, terminated=collided)
    env.reset(seed=1)
    over: dict[str, bool] = {}
    for _ in range(15):
        given = {agent: np.array([3.0 if agent == "v02" else -8.0]) for agent in env.agents}
        over |= {agent: True for agent, ended in env.step(given)[2].items() if ended}
    assert env.agents == ["v01", "v03", "v04"]
    assert over == {"v02": True}
    env.close()


def collided(agent: str, moment: Moment) -> bool:
    """Tell whether the agent's vehicle has run into another."""
    return any(event.kind == "collision" and event.node == agent for event in moment.events)


@pytest.mark.slow
def test_nothing_is_kept_but_in_the_folder_that_is_given(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    play(make())
    assert list(tmp_path.iterdir()) == []
    env = make(out="episodes")
    play(env)
    play(env)
    runs = [emulator.Run.open(tmp_path / "episodes" / number) for number in ("1", "2")]
    assert [run.trace.num_rows for run in runs] == [4 * 3 * 20] * 2
    (why,) = [each.reason for each in runs[0].not_applicable if each.name == "replay"]
    assert why == "not warranted: what vehicles did was decided outside of the run"


def test_an_error_of_the_user_s_function_is_raised_and_ends_the_episode() -> None:
    def stumble(node: Node, fix: Fix, packets: Sequence[Packet]) -> Any:
        return {0: 0}[fix.time_ns]

    env = make(observe=stumble)
    env.reset(seed=1)
    with pytest.raises(KeyError, match="100000000"):
        env.step({})
    assert threads() == 0
    with pytest.raises(VnetError, match=r"step: the episode is over, or has not begun: reset\(\)"):
        env.step({})


@pytest.mark.slow
@pytest.mark.parametrize("step", [3, 5], ids=["on the way", "at the end"])
@pytest.mark.parametrize("which", ["reward", "terminated"])
def test_an_error_in_a_reward_ends_the_episode_too(which: str, step: int) -> None:
    steps = count(1)

    def stumble(agent: str, moment: Moment) -> float:
        return 0.0 / (agent != "v01" or next(steps) != step)

    functions: dict[str, Any] = {which: stumble}
    env = make(duration_s=0.5, **functions)
    env.reset(seed=1)
    with pytest.raises(ZeroDivisionError):
        while env.agents:
            env.step({})
    assert env.agents == [] and threads() == 0
    with pytest.raises(VnetError, match=r"step: the episode is over, or has not begun: reset\(\)"):
        env.step({})
    assert sorted(env.reset()[0]) == ["v01", "v02", "v03", "v04"]
    env.close()


@pytest.mark.parametrize("name", ["observe", "act", "reward"])
def test_what_is_no_function_or_space_is_refused(name: str) -> None:
    with pytest.raises(VnetError, match=f"environment: {name} = 3: a function is needed"):
        make(None, 1.0, **{name: 3})
    with pytest.raises(VnetError, match="environment: action_space = None: a space of gymnasium, or a function"):
        space: Any = None
        emulator.environment(
            "beacon",
            observe=see,
            act=drive_and_tell,
            reward=speed_of,
            observation_space=Box(0, 1),
            action_space=space,
        )


def test_an_environment_that_is_dropped_ends_its_episode() -> None:
    env = make()
    env.reset()
    assert threads() == 1
    del env
    assert threads() == 0
