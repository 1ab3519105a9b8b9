"""A radio for an environment of others, PettingZoo's simple_speaker_listener: docs/how-to/learning.md.

The speaker names one of three landmarks, and the listener goes to the landmark that it heard of last.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from mpe2 import simple_speaker_listener_v4

import emulator

RADIOS: tuple[dict[str, Any], ...] = ({}, {"loss": 0.5}, {"loss": 0.9}, {"range_m": 60.0})


def with_radio(radio: dict[str, Any]) -> Any:
    """Return the environment, in which the speaker's word is a broadcast, and a unit of length is 100 m."""
    env = simple_speaker_listener_v4.parallel_env()
    places = {agent.name: agent.state for agent in env.unwrapped.world.agents}
    return emulator.radio_for(
        env,
        {"radio": radio},
        position_m=lambda agent: 100 * places[agent].p_pos,
        send=lambda agent, observation, action: bytes([action]) if agent == "speaker_0" else None,
        receive=hear,
    )


def hear(agent: str, observation: Any, packets: Any) -> Any:
    """Return what an agent observes: the word is the listener's last three figures."""
    if agent == "listener_0":
        observation[-3:] = np.eye(3)[packets[-1].payload[0]] if packets else 0
    return observation


def listen(observation: Any, word: int) -> int:
    """Return the action that brings the listener nearer to a landmark."""
    landmark = observation[2:8].reshape(3, 2)[word]
    axis = int(np.argmax(np.abs(landmark)))
    return 1 + 2 * axis + int(landmark[axis] > 0)  # 1, 2: west, east; 3, 4: south, north


def mean_reward(radio: dict[str, Any], episodes: int = 20) -> float:
    """Return the listener's mean reward a step."""
    env, rewards = with_radio(radio), []
    for seed in range(episodes):
        observations, _ = env.reset(seed=seed)
        word = None
        while env.agents:
            heard = observations["listener_0"][-3:]
            word = int(heard.argmax()) if heard.any() else word
            listener = 0 if word is None else listen(observations["listener_0"], word)
            speaker = int(observations["speaker_0"].argmax())
            observations, reward, *_ = env.step({"speaker_0": speaker, "listener_0": listener})
            rewards.append(reward["listener_0"])
    return float(np.mean(rewards))


if __name__ == "__main__":
    for each in RADIOS:
        print(f"{each}: {mean_reward(each):.2f} a step")
