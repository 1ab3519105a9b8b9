"""`emulator.environment`: a scenario as an environment of PettingZoo."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from emulator.learning.episode import ENTRY, Act, Behaviour, Ends, Observe, Reward
from emulator.scenario.loading import Source, hinting, scenario_of
from vnet.errors import VnetError, shown
from vnet.extras import require

if TYPE_CHECKING:
    from gymnasium.spaces import Space
    from pettingzoo import ParallelEnv


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

    from emulator.learning.vehicle_environment import VehicleEnvironment

    for name, given in {"observe": observe, "act": act, "reward": reward}.items():
        _check(name, given, callable(given), "a function is needed")
    for name, space in {"observation_space": observation_space, "action_space": action_space}.items():
        _check(
            name, space, callable(space) or isinstance(space, spaces.Space), "a space of gymnasium, or a function"
        )
    loaded = scenario_of(scenario, {**(set or {}), "program.entry": ENTRY, "run.pacing": "lockstep"})
    say = Behaviour(observe, act, reward, terminated or (lambda agent, moment: False))
    return VehicleEnvironment(loaded, say, observation_space, action_space, None if out is None else Path(out))


def _check(name: str, given: object, is_right: bool, needed: str) -> None:
    """Raise VnetError unless an argument is of the kind that is needed."""
    if not is_right:
        raise VnetError(f"environment: {name} = {shown(given)}: {needed}")
