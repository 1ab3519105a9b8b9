"""The environment itself: `pettingzoo.ParallelEnv` over episodes. `emulator.environment` makes it."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from copy import deepcopy
from operator import index
from pathlib import Path
from typing import Any, ClassVar

from gymnasium.spaces import Space
from pettingzoo import ParallelEnv

from emulator.learning.episode import Behaviour, Episode, Moment, Scenes, Turn
from emulator.scenario.scenario import Scenario
from emulator.world.world import build_world
from vnet.errors import VnetError, shown

Spaces = Space[Any] | Callable[[str], Space[Any]]
SEEDS = 2**63
"""Number of seeds, from 0 on, that a scenario can have."""


class VehicleEnvironment(ParallelEnv[str, Any, Any]):
    """See `emulator.environment`. One episode is on at a time; `close` ends it."""

    metadata: ClassVar[dict[str, Any]] = {"name": "vnet", "render_modes": []}

    def __init__(
        self, scenario: Scenario, behaviour: Behaviour, observations: Spaces, actions: Spaces, out: Path | None
    ) -> None:
        self._scenario, self._behaviour, self._out = scenario, behaviour, out
        self._spaces = {"observation": observations, "action": actions}
        self._space_of: dict[tuple[str, str], Space[Any]] = {}
        self._episode: Episode | None = None
        self._episodes = 0
        self._seed = scenario.run.seed
        self._observed: dict[str, Any] = {}
        self.possible_agents = Episode.agents_of(scenario, build_world(scenario).node_ids)
        self.agents: list[str] = []

    def observation_space(self, agent: str) -> Space[Any]:
        """Return the space of an agent's observations, always the same object."""
        return self._space("observation", agent)

    def action_space(self, agent: str) -> Space[Any]:
        """Return the space of an agent's actions, always the same object."""
        return self._space("action", agent)

    def _space(self, kind: str, agent: str) -> Space[Any]:
        if agent not in self.possible_agents:
            raise VnetError(f"agent {agent!r}: there are {', '.join(self.possible_agents)}")
        if (kind, agent) not in self._space_of:
            given = self._spaces[kind]
            # Each agent has a space of its own, so that each samples by its own seed.
            space = given(agent) if not isinstance(given, Space) else deepcopy(given)
            self._space_of[kind, agent] = space
        return self._space_of[kind, agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
        """Begin an episode with this seed, or the next one; return the first observations and empty infos.

        `options` are taken, and change nothing. Raises VnetError for a seed that no scenario can have.
        """
        self.close()
        if seed is not None:
            self._seed = whole_seed(seed)
        run = self._scenario.run.model_copy(update={"seed": self._seed})
        self._seed += 1
        self._episodes += 1
        out = None if self._out is None else self._out / str(self._episodes)
        self._episode = Episode(self._scenario.model_copy(update={"run": run}), self._behaviour, out)
        self._scenes = Scenes(self._episode.emulation)
        turn = self._next_turn(self._episode)
        self._scenes.moment(turn.time_ns, {})
        self._observed = dict(turn.observed)
        self.agents = [agent for agent in self.possible_agents if agent in turn.observed]
        return dict(turn.observed), {agent: {} for agent in self.agents}

    def step(
        self, actions: dict[str, Any]
    ) -> tuple[dict[str, Any], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """Let agents act, and one period pass; return observations, rewards, terminated, truncated and infos.

        An agent without an action does nothing. One that gets no fix, as in an outage of its receiver, has its last
        observation again. Raises VnetError before the first `reset`, and for an action of no living agent.
        """
        if self._episode is None:
            raise VnetError("step: the episode is over, or has not begun: reset()")
        if unknown := sorted(set(actions) - set(self.agents)):
            raise VnetError(f"step: {unknown[0]} is no living agent; there are: {', '.join(self.agents)}")
        self._episode.answer(actions)
        turn = self._next_turn(self._episode)
        try:
            return self._step(self._episode, turn, self._scenes.moment(turn.time_ns, actions))
        except BaseException:
            self._give_up()
            raise

    def _step(
        self, episode: Episode, turn: Turn, moment: Moment
    ) -> tuple[dict[str, Any], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """Return what a step returns, that ends with this turn and this moment."""
        self._observed |= turn.observed
        entered = [agent for agent in turn.observed if agent not in self.agents and self._is_new(agent)]
        at_end = [*self.agents, *entered]
        rewards = {agent: float(self._behaviour.reward(agent, moment)) for agent in at_end}
        ended = {agent: self._is_gone(agent, turn) or self._behaviour.terminated(agent, moment) for agent in at_end}
        truncated = {agent: turn.over and not ended[agent] for agent in at_end}
        episode.finished |= {agent for agent in at_end if ended[agent] or turn.over}
        self.agents = [agent for agent in at_end if agent not in episode.finished]
        observations = {agent: self._observed[agent] for agent in at_end}
        if not self.agents:
            self.close()
        return observations, rewards, ended, truncated, {agent: {} for agent in at_end}

    def _next_turn(self, episode: Episode) -> Turn:
        try:
            return episode.next_turn()
        except BaseException:
            self._give_up()
            raise

    def _give_up(self) -> None:
        """End the episode after an error."""
        self.agents = []
        self.close()

    def _is_new(self, agent: str) -> bool:
        return self._episode is not None and agent not in self._episode.finished

    def _is_gone(self, agent: str, turn: Turn) -> bool:
        """Return whether an agent's vehicle is gone, or its program has ended."""
        assert self._episode is not None
        return not turn.over and agent not in turn.observed and not self._episode.emulation.up[agent]

    def close(self) -> None:
        """End the episode, if one is on."""
        episode, self._episode = self._episode, None
        if episode is not None:
            episode.close()

    def __del__(self) -> None:
        with suppress(AttributeError):  # it was never made
            self.close()


def whole_seed(seed: Any) -> int:
    """Return a seed as a plain number. Raises VnetError for one that no scenario can have."""
    with suppress(TypeError):
        if 0 <= index(seed) < SEEDS:
            return index(seed)
    raise VnetError(f"reset: seed = {shown(seed)}: a whole number from 0 to 2**63 - 1 is needed")
