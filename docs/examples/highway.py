"""HighwayEnv's crossing with several controlled vehicles as a `pettingzoo.ParallelEnv`: docs/how-to/learning.md.

HighwayEnv (github.com/Farama-Foundation/HighwayEnv) has tuples in place of PettingZoo's dictionaries.
"""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium
import highway_env
import numpy as np
from gymnasium.spaces import Box, Discrete
from pettingzoo import ParallelEnv

FEATURES = ["presence", "x", "y", "vx", "vy", "cos_h", "sin_h"]
"""Figures of a vehicle that it observes of itself: positions in m and velocities in m/s, east and south."""


class Crossing(ParallelEnv[str, Any, Any]):
    """`vehicles` controlled ones among others; a step is a decision, `step_s` long: slower, idle or faster."""

    metadata: ClassVar[dict[str, Any]] = {"name": "crossing", "render_modes": []}
    step_s = 1.0

    def __init__(self, vehicles: int = 4) -> None:
        gymnasium.register_envs(highway_env)
        own = {"type": "Kinematics", "vehicles_count": 1, "features": FEATURES, "absolute": True}
        config = {
            "controlled_vehicles": vehicles,
            "observation": {"type": "MultiAgentObservation", "observation_config": own | {"normalize": False}},
        }
        self._cars: Any = gymnasium.make("intersection-multi-agent-v2", config=config).unwrapped
        self.possible_agents = [f"car_{number}" for number in range(vehicles)]
        self.agents: list[str] = []

    def observation_space(self, agent: str) -> Box:
        """Return the space of a vehicle's own figures."""
        return Box(-np.inf, np.inf, (len(FEATURES),), np.float32)

    def action_space(self, agent: str) -> Discrete:
        """Return the space of decisions."""
        return Discrete(3)

    def position_m(self, agent: str) -> Any:
        """Return where a vehicle is, in m."""
        return self._cars.controlled_vehicles[self.possible_agents.index(agent)].position

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Begin an episode."""
        seen, _ = self._cars.reset(seed=seed)
        self.agents = list(self.possible_agents)
        return self._of_each([row[0] for row in seen]), self._of_each([{} for _ in seen])

    def step(self, actions: dict[str, Any]) -> Any:
        """Let all decide, and a step pass; all stay until the episode is over."""
        seen, _, ended, truncated, info = self._cars.step(tuple(actions.get(car, 1) for car in self.agents))
        rows, count = [row[0] for row in seen], len(seen)
        columns: list[list[Any]] = [
            rows,
            info["agents_rewards"],
            [ended] * count,
            [truncated] * count,
            [{} for _ in seen],
        ]
        if ended or truncated:
            self.agents = []
        return tuple(self._of_each(column) for column in columns)

    def _of_each(self, values: Any) -> dict[str, Any]:
        return dict(zip(self.possible_agents, values, strict=True))
