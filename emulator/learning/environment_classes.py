"""The environments themselves: `pettingzoo.ParallelEnv` over episodes, and a radio for one of somebody else.

`emulator.environment` makes the one, and `emulator.radio_for` the other. A step of a wrapped environment takes
`step_s` of emulated time. What agents send with their actions is enqueued at the beginning of a step, from where
they then are; an agent observes what has arrived by the step's end.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from copy import deepcopy
from operator import index
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from gymnasium.spaces import Space
from numpy.typing import ArrayLike
from pettingzoo import ParallelEnv
from pettingzoo.utils import BaseParallelWrapper

from emulator.learning.episode import Behaviour, Episode, Moment, Scenes, Turn
from emulator.radio.engine import Engine
from emulator.radio.outcomes import Outcome
from emulator.scenario.scenario import Scenario
from emulator.world.radio_inputs import RadioInputs, load_buildings, load_links
from emulator.world.world import build_world
from vnet.errors import PayloadTooLargeError, VnetError, shown
from vnet.radio import Packet
from vnet.types import Array

Of = dict[str, Any]
Stepped = tuple[Of, Of, Of, Of, Of]
"""By agent: observations, rewards, terminated, truncated, infos."""
Spaces = Space[Any] | Callable[[str], Space[Any]]
SEEDS = 2**63
"""Number of seeds, from 0 on, that a scenario can have."""

PositionM = Callable[[str], ArrayLike]
Send = Callable[[str, Any, Any], bytes | None]
Receive = Callable[[str, Any, Sequence[Packet]], Any]
EVERYWHERE_M = np.array([[-np.inf, -np.inf], [np.inf, np.inf]])
"""Box of all positions: nobody says before an episode where agents will be."""


class VehicleEnvironment(ParallelEnv[str, Any, Any]):
    """See `emulator.environment`. One episode is on at a time; `close` ends it."""

    metadata: ClassVar[dict[str, Any]] = {"name": "vnet", "render_modes": []}
    render_mode = None

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
        self._asked: set[str] = set()  # who has observed at the beginning of this step
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
        with self._ended_by_an_error():
            turn = self._episode.next_turn()
        self._scenes.moment(turn, {})
        self._observed, self._asked = dict(turn.observed), {*turn.observed}
        self.agents = [agent for agent in self.possible_agents if agent in turn.observed]
        if turn.over:
            self.close()
        return dict(turn.observed), {agent: {} for agent in self.agents}

    def step(self, actions: dict[str, Any]) -> Stepped:
        """Let agents act, and one period pass; return observations, rewards, terminated, truncated and infos.

        If nobody is left it lasts until somebody enters. An agent without an action does nothing. One that gets no
        fix, as in an outage of its receiver, has its last observation again, and does not act. Raises VnetError
        before the first `reset`, and for an action of no living agent.
        """
        if self._episode is None:
            raise VnetError("step: the episode is over, or has not begun: reset()")
        if unknown := sorted(set(actions) - set(self.agents)):
            raise VnetError(f"step: {unknown[0]} is no living agent; there are: {', '.join(self.agents)}")
        self._episode.answer(actions)
        episode, done = self._episode, {each: action for each, action in actions.items() if each in self._asked}
        with self._ended_by_an_error():
            turn = episode.next_turn()
            result = self._step(episode, turn, self._scenes.moment(turn, done))
            while not (self.agents or turn.over or episode.finished.issuperset(self.possible_agents)):
                episode.answer({})  # nobody is there: on to who enters next
                turn = episode.next_turn()
                later = self._step(episode, turn, self._scenes.moment(turn, {}))
                for known, more in zip(result, later, strict=True):
                    known.update(more)
        if not self.agents:
            self.close()
        return result

    def _step(self, episode: Episode, turn: Turn, moment: Moment) -> Stepped:
        """Return what a step returns, that ends with this turn and this moment."""
        self._observed |= turn.observed
        self._asked = {*turn.observed}
        entered = [agent for agent in turn.observed if agent not in {*self.agents, *episode.finished}]
        at_end = [*self.agents, *entered]
        rewards = {agent: float(self._behaviour.reward(agent, moment)) for agent in at_end}
        # Without a fix, and not up: the vehicle is gone, or its program has ended.
        gone = {agent for agent in at_end if agent not in turn.observed and not episode.emulation.up[agent]}
        gone = set() if turn.over else gone
        ended = {agent: agent in gone or self._behaviour.terminated(agent, moment) for agent in at_end}
        truncated = {agent: turn.over and not ended[agent] for agent in at_end}
        episode.finished |= {agent for agent in at_end if ended[agent] or turn.over}
        self.agents = [agent for agent in at_end if agent not in episode.finished]
        observations = {agent: self._observed[agent] for agent in at_end}
        return observations, rewards, ended, truncated, {agent: {} for agent in at_end}

    @contextmanager
    def _ended_by_an_error(self) -> Iterator[None]:
        """End the episode if there is an error in the block."""
        try:
            yield
        except BaseException:
            self.agents = []
            self.close()
            raise

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


class RadioEnvironment(BaseParallelWrapper):
    """See `emulator.radio_for`. What it does not define is the wrapped environment's."""

    def __init__(
        self,
        env: Any,
        scenario: Scenario,
        position_m: PositionM,
        send: Send,
        receive: Receive,
        observations: Spaces | None,
        step_ns: int,
    ) -> None:
        super().__init__(env)
        self._scenario, self._seed, self._step_ns = scenario, scenario.run.seed, step_ns
        self._position_of, self._send, self._receive = position_m, send, receive
        self._observations = observations
        self._space_of: dict[str, Space[Any]] = {}
        self._node_ids = tuple(env.possible_agents)
        links = load_links(scenario.radio, self._node_ids)
        self._inputs = RadioInputs(links, load_buildings(scenario, None, EVERYWHERE_M))
        self._engine: Engine | None = None
        self._frames = 0

    @property
    def outcomes(self) -> dict[str, int]:
        """Number of receptions of the episode so far, by outcome; those out of range are among them.

        Those of a frame that still waits to be sent are `pending`, each other agent's.
        """
        counts = {} if self._engine is None else dict(self._engine.counts)
        waiting = self._frames * (len(self._node_ids) - 1) - sum(counts.values())
        counts[Outcome.pending] = counts.get(Outcome.pending, 0) + waiting
        return {outcome.name: count for outcome, count in counts.items() if count}

    def observation_space(self, agent: str) -> Any:
        """Return the space of an agent's observations, always the same object."""
        if self._observations is None:
            return self.env.observation_space(agent)
        if agent not in self._space_of:
            given = self._observations
            self._space_of[agent] = deepcopy(given) if isinstance(given, Space) else given(agent)
        return self._space_of[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
        """Begin an episode, the radio's with this seed too, or with the one after its last; nobody has sent yet."""
        if seed is not None:
            self._seed = whole_seed(seed)
        observations, infos = self.env.reset(seed=seed, options=options)
        self._time_ns = self._frames = 0
        self._position_m = np.zeros((len(self._node_ids), 2))
        self._engine = Engine(self._node_ids, self._scenario.radio, self._seed, self._position_m, self._inputs)
        self._seed += 1
        self._observed = {agent: self._receive(agent, seen, ()) for agent, seen in observations.items()}
        return dict(self._observed), infos

    def step(self, actions: dict[str, Any]) -> Stepped:
        """Send what goes with these actions, step the environment, and let agents receive what has arrived."""
        if self._engine is None:
            raise VnetError("step: no episode has begun: reset()")
        self._place(self._engine, self.env.agents)
        payloads = {}
        for number, agent in enumerate(self._node_ids):
            if agent not in actions or agent not in self.env.agents:
                continue
            if agent not in self._observed:
                raise VnetError(f"step: {shown(agent)} acts, and env has given no observation of it")
            payload = self._send(agent, self._observed[agent], actions[agent])
            if payload is not None and not isinstance(payload, bytes):
                raise VnetError(f"send({agent!r}) = {shown(payload)}: bytes are needed, or None")
            if payload is not None and len(payload) > (most := self._scenario.radio.max_payload_bytes):
                raise PayloadTooLargeError(len(payload), most)
            if payload is not None:
                payloads[number] = payload
        observations, *rest = self.env.step(actions)
        for number, payload in payloads.items():  # a step that env refuses has sent nothing
            self._engine.transmit(self._time_ns, number, [payload])
            self._frames += 1
        self._time_ns += self._step_ns
        packets: dict[str, list[Packet]] = {agent: [] for agent in self._node_ids}
        for delivery in self._engine.advance(self._time_ns):
            packets[self._node_ids[delivery.receiver]].append(delivery.packet)
        self._observed |= {
            agent: self._receive(agent, seen, packets[agent]) for agent, seen in observations.items()
        }
        return {agent: self._observed[agent] for agent in observations}, *rest

    def _place(self, engine: Engine, agents: Sequence[str]) -> None:
        """Have living agents where they are now; the others neither send nor receive."""
        position_m = self._position_m.copy()
        if foreign := {*agents} - {*self._node_ids}:
            raise VnetError(f"step: {shown(min(foreign))} is an agent, but not one of env.possible_agents")
        for number, agent in enumerate(self._node_ids):
            engine.set_up(number, agent in agents)
            if agent in agents:
                position_m[number] = _position(agent, self._position_of(agent))
        self._position_m = position_m
        engine.set_positions(position_m)


def _position(agent: str, given: ArrayLike) -> Array:
    try:
        position_m = np.asarray(given, float)
    except (TypeError, ValueError):
        position_m = np.empty(0)
    if position_m.shape != (2,) or not np.isfinite(position_m).all():
        raise VnetError(f"position_m({agent!r}) = {shown(given)}: two finite numbers in m are needed")
    return position_m
