"""Agents that learn to drive on a ring: docs/how-to/learning.md."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
from gymnasium.spaces import Box

import emulator
from vnet import Fix, Node

SCENARIO = {
    "network": {
        "kind": "driven",
        "vehicles": 10,
        "driven": {"road": "ring", "length_m": 400.0, "gap_m": 20.0, "speed_mps": 8.0},
    },
    "world": {"ranging": {"range_m": 200.0}},
    "radio": {"loss": 0.1},
    "run": {"duration_s": 10.0, "settle_s": 0.0},
}


def observe(node: Node, fix: Fix, packets: Any) -> Any:
    """Return the vehicle's speed, the gap ahead, and the mean speed that others have broadcast."""
    gap_m = 200.0 if fix.gap_m is None else fix.gap_m
    heard = [struct.unpack("<f", packet.payload)[0] for packet in packets]
    return np.array([fix.speed_m_s, gap_m, np.mean(heard) if heard else fix.speed_m_s], np.float32)


async def act(node: Node, action: Any) -> None:
    """Accelerate as the agent asks, and broadcast the speed that it tells."""
    acceleration_m_s2, speed_m_s = action.tolist()
    node.drive(acceleration_m_s2=acceleration_m_s2)
    await node.radio.broadcast(struct.pack("<f", speed_m_s))


def reward(agent: str, moment: emulator.Moment) -> float:
    """Return the true speed, less 100 for a collision of any two."""
    crashed = any(event.kind == "collision" for event in moment.events)
    return float(moment.speed_m_s[agent]) - 100.0 * crashed


def make() -> Any:
    """Return the environment."""
    return emulator.environment(
        SCENARIO,
        observe=observe,
        act=act,
        reward=reward,
        observation_space=Box(-np.inf, np.inf, (3,), np.float32),
        action_space=Box(np.array([-8, 0], np.float32), np.array([3, 50], np.float32)),
    )


def policy(observation: Any, headway_s: float, share: float) -> Any:
    """Return acceleration and speed to tell: keep a headway, and by a share the others' mean speed."""
    speed, gap, speed_of_others = observation.tolist()
    wanted = (1 - share) * (gap - 2.0) / headway_s + share * speed_of_others
    return np.array([np.clip(wanted - speed, -8.0, 3.0), np.clip(speed, 0.0, 50.0)])


def main() -> None:
    """Print the mean reward of three policies on the same seeds."""
    env = make()
    for headway_s, share in ((2.5, 0.0), (2.5, 0.5), (1.5, 0.0)):
        rewards = []
        for seed in (1, 2):
            observations, _ = env.reset(seed=seed)
            while env.agents:
                actions = {agent: policy(observations[agent], headway_s, share) for agent in env.agents}
                observations, earned, *_ = env.step(actions)
                rewards.append(np.mean(list(earned.values())))
        print(f"headway {headway_s} s, share {share}: {np.mean(rewards):.1f} a step")
    env.close()


if __name__ == "__main__":
    main()
