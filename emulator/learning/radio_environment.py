"""A radio for an environment of somebody else: the wrapper that `emulator.radio_for` makes.

A step of the environment takes `step_s` of emulated time. What agents send with their actions is enqueued at the
beginning of a step, from where they then are; an agent observes what has arrived by the step's end.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import deepcopy
from typing import Any

import numpy as np
from gymnasium.spaces import Space
from numpy.typing import ArrayLike
from pettingzoo.utils import BaseParallelWrapper

from emulator.learning.vehicle_environment import Spaces, whole_seed
from emulator.radio.engine import Engine
from emulator.radio.outcomes import Outcome
from emulator.scenario.scenario import Scenario
from emulator.world.radio_inputs import RadioInputs, load_buildings, load_links
from vnet.errors import PayloadTooLargeError, VnetError, shown
from vnet.radio import Packet
from vnet.types import Array

PositionM = Callable[[str], ArrayLike]
Send = Callable[[str, Any, Any], bytes | None]
Receive = Callable[[str, Any, Sequence[Packet]], Any]
EVERYWHERE_M = np.array([[-np.inf, -np.inf], [np.inf, np.inf]])
"""Box of all positions: nobody says before an episode where agents will be."""


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

    def step(
        self, actions: dict[str, Any]
    ) -> tuple[dict[str, Any], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """Send what goes with these actions, step the environment, and let agents receive what has arrived."""
        if self._engine is None:
            raise VnetError("step: no episode has begun: reset()")
        self._place(self._engine, self.env.agents)
        for number, agent in enumerate(self._node_ids):
            if agent not in actions or agent not in self.env.agents:
                continue
            payload = self._send(agent, self._observed[agent], actions[agent])
            if payload is not None and not isinstance(payload, bytes):
                raise VnetError(f"send({agent!r}) = {shown(payload)}: bytes are needed, or None")
            if payload is not None and len(payload) > (most := self._scenario.radio.max_payload_bytes):
                raise PayloadTooLargeError(len(payload), most)
            if payload is not None:
                self._engine.transmit(self._time_ns, number, [payload])
                self._frames += 1
        observations, *rest = self.env.step(actions)
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
