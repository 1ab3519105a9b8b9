"""`emulator.environment`: a scenario as a PettingZoo environment; `emulator.radio_for`: a radio for any other."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from emulator.learning.episode import ENTRY, Act, Behaviour, Ends, Observe, Reward
from emulator.scenario.loading import Source, hinting, scenario_of
from emulator.scenario.sections import DAY_S
from vnet.errors import VnetError, shown
from vnet.extras import require
from vnet.units import NS_PER_S

if TYPE_CHECKING:
    from gymnasium.spaces import Space
    from pettingzoo import ParallelEnv

    from emulator.learning.environment_classes import PositionM, Receive, Send


@hinting
def environment(
    scenario: Source,
    *,
    observe: Observe,
    act: Act,
    reward: Reward,
    observation_space: Space[Any] | Callable[[str], Space[Any]],
    action_space: Space[Any] | Callable[[str], Space[Any]],
    terminated: Ends | None = None,
    set: Mapping[str, Any] | None = None,
    out: str | Path | None = None,
) -> ParallelEnv[str, Any, Any]:
    """Return a scenario as a `pettingzoo.ParallelEnv` (experimental): a step is a period, an agent a vehicle.

    Each vehicle but those of `[[program.exceptions]]` runs a program that gives each fix, and the packets received
    since the one before, to `observe(node, fix, packets)`, awaits its agent's action, and hands that to
    `act(node, action)`, which may be async: `node.drive(…)`, `await node.radio.broadcast(…)`. After each step
    `reward(agent, moment)` is called with the truth, an `emulator.Moment`. Spaces are one for all, or functions of
    the agent's id.

    An agent is terminated when its vehicle leaves, when its program has ended, or when `terminated(agent, moment)`
    is true; all are truncated at the end of the run. `reset(seed=…)` sets the scenario's seed for an episode; each
    further one takes the next.

    `scenario` and `set` are those of `emulator.simulate`. No files are kept, except with `out`, the folder of the
    episodes: `out/1`, `out/2`, …. Raises VnetError, in one line, for input that cannot be used, and if the extra
    `rl` is not installed.
    """
    require("an environment", "pettingzoo", "gymnasium")
    from gymnasium import spaces

    from emulator.learning.environment_classes import VehicleEnvironment

    for name, given in {"observe": observe, "act": act, "reward": reward}.items():
        _check(name, given, callable(given), "a function is needed")
    for name, space in {"observation_space": observation_space, "action_space": action_space}.items():
        _check(
            name, space, callable(space) or isinstance(space, spaces.Space), "a space of gymnasium, or a function"
        )
    loaded = scenario_of(scenario, {**(set or {}), "program.entry": ENTRY, "run.pacing": "lockstep"})
    if loaded.run.order == "pct" and loaded.run.order_steps is None:
        raise VnetError('environment: run.order = "pct" needs run.order_steps: a run without actions counts none')
    say = Behaviour(observe, act, reward, terminated or (lambda agent, moment: False))
    return VehicleEnvironment(loaded, say, observation_space, action_space, None if out is None else Path(out))


@hinting
def radio_for(
    env: ParallelEnv[str, Any, Any],
    scenario: Source,
    *,
    position_m: PositionM,
    send: Send,
    receive: Receive,
    observation_space: Space[Any] | Callable[[str], Space[Any]] | None = None,
    step_s: float = 0.1,
    set: Mapping[str, Any] | None = None,
) -> ParallelEnv[str, Any, Any]:
    """Return a `pettingzoo.ParallelEnv` whose agents send each other messages over vnet's radio (experimental).

    At the beginning of a step `position_m(agent)` returns where an agent is, two numbers in m, and
    `send(agent, observation, action)` the bytes that it broadcasts with its action, or None. The environment steps.
    `receive(agent, observation, packets)` returns what the agent observes: the environment's observation, changed
    by the packets that have arrived by the end of the step, `step_s` later. After `reset` there are none. With
    another shape it needs `observation_space`, one for all or a function of the agent's id. Rewards, ends and infos
    are the environment's own.

    `scenario` and `set` are those of `emulator.simulate`; `[radio]` and `run.seed` are used. `reset(seed=…)` seeds
    the radio too; without it each episode takes the next seed. `outcomes` of what is returned has the number of
    receptions of the episode by outcome. Raises VnetError, in one line, for input that cannot be used, for
    faults and roadside units, and if the extra `rl` is not installed.
    """
    require("an environment", "pettingzoo", "gymnasium")
    from gymnasium import spaces
    from pettingzoo import ParallelEnv

    from emulator.learning.environment_classes import RadioEnvironment

    _check("env", env, isinstance(env, ParallelEnv), "a ParallelEnv of pettingzoo is needed", "radio_for")
    has_agents = bool(getattr(env, "possible_agents", None))
    _check("env", env, has_agents, "its possible_agents are needed", "radio_for")
    for name, given in {"position_m": position_m, "send": send, "receive": receive}.items():
        _check(name, given, callable(given), "a function is needed", "radio_for")
    is_space = (
        observation_space is None or callable(observation_space) or isinstance(observation_space, spaces.Space)
    )
    _check("observation_space", observation_space, is_space, "a space of gymnasium, or a function", "radio_for")
    is_length = isinstance(step_s, (int, float)) and 1e-6 <= step_s <= DAY_S
    _check("step_s", step_s, is_length, f"a number of seconds from 1e-06 to {DAY_S:g} is needed", "radio_for")
    loaded = scenario_of(scenario, set or {})
    for name, section in {"fault": loaded.fault, "roadside": loaded.roadside}.items():
        if section:
            raise VnetError(f"radio_for: the scenario has [[{name}]], which acts in emulator.environment alone")
    step_ns = round(step_s * NS_PER_S)
    return RadioEnvironment(env, loaded, position_m, send, receive, observation_space, step_ns)


def _check(name: str, given: object, is_right: bool, needed: str, function: str = "environment") -> None:
    """Raise VnetError unless an argument of a function is of the kind that is needed."""
    if not is_right:
        raise VnetError(f"{function}: {name} = {shown(given)}: {needed}")
