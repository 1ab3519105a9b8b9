"""`emulator.radio_for`: PettingZoo's particle worlds and HighwayEnv's crossing with vnet's radio between agents."""

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import permutations
from typing import Any

import numpy as np
import pytest
from gymnasium.spaces import Box
from mpe2 import simple_reference_v3, simple_speaker_listener_v4
from pettingzoo import ParallelEnv
from pettingzoo.test import parallel_api_test, parallel_seed_test

import emulator
from docs.examples.highway import Crossing
from vnet import Packet
from vnet.errors import VnetError

pytestmark = pytest.mark.slow

WORDS = {simple_speaker_listener_v4: 3, simple_reference_v3: 10}
"""Words of each world, whose one-hot vector (for continuous actions any vector) ends a listener's observation."""
METRE = 100.0
"""Metres of a unit of length of the particle worlds, in which agents begin anywhere from -1 to 1."""
PERFECT = {"radio": {"range_m": 1e6}}


def spoken(env: Any, words: int) -> Callable[[str, Any, Any], bytes | None]:
    """Return a function that takes the message out of an action, as these worlds do."""

    def send(agent: str, observation: Any, action: Any) -> bytes | None:
        if agent.startswith("listener"):
            return None
        if isinstance(env.action_space(agent), Box):
            return np.asarray(action[-words:], np.float32).tobytes()
        moves = env.action_space(agent).n // words
        return np.eye(words, dtype=np.float32)[action // moves].tobytes()

    return send


def heard(words: int) -> Callable[[str, Any, Sequence[Packet]], Any]:
    """Return a function that puts what was received in the place of what the world lets agents hear."""

    def receive(agent: str, observation: Any, packets: Sequence[Packet]) -> Any:
        if agent.startswith("speaker"):
            return observation
        word = np.frombuffer(packets[-1].payload, np.float32) if packets else np.zeros(words, np.float32)
        return np.concatenate([observation[:-words], word])

    return receive


def particles(world: Any, scenario: Mapping[str, Any], continuous: bool = False) -> Any:
    """Return a particle world with a radio."""
    env = world.parallel_env(continuous_actions=continuous)

    def position_m(agent: str) -> Any:
        return next(each.state.p_pos for each in env.unwrapped.world.agents if each.name == agent) * METRE

    send, receive = spoken(env, WORDS[world]), heard(WORDS[world])
    return emulator.radio_for(env, scenario, position_m=position_m, send=send, receive=receive)


def both(plain: Any, radio: Any, seed: int) -> None:
    """Step both with the same actions, and expect the same of both."""
    assert_same(plain.reset(seed=seed), radio.reset(seed=seed))
    for agent in plain.possible_agents:
        plain.action_space(agent).seed(seed)
    while plain.agents:
        actions = {agent: plain.action_space(agent).sample() for agent in plain.agents}
        assert_same(plain.step(actions), radio.step(actions))
        assert plain.agents == radio.agents


def assert_same(one: Any, other: Any) -> None:
    """Expect equal results, down to the arrays in them."""
    for left, right in zip(one, other, strict=True):
        assert left.keys() == right.keys()
        for agent, value in left.items():
            np.testing.assert_array_equal(value, right[agent])


@pytest.mark.parametrize("continuous", [False, True], ids=["discrete", "continuous"])
@pytest.mark.parametrize("world", WORDS, ids=["speaker and listener", "reference"])
def test_with_a_perfect_radio_a_particle_world_is_itself(world: Any, continuous: bool) -> None:
    radio, plain = particles(world, PERFECT, continuous), world.parallel_env(continuous_actions=continuous)
    speakers = 2 if world is simple_reference_v3 else 1
    for seed in range(3):
        both(plain, radio, seed)
        assert radio.outcomes == {"delivered": 25 * speakers}


@pytest.mark.parametrize("mac", ["lte-mode4", "nr-mode2", "80211p"])
def test_a_frame_that_still_waits_at_the_end_of_an_episode_is_pending(mac: str) -> None:
    radio = {"mac": {"kind": mac}, "access_jitter_ms": 90.0, "path_loss": {"kind": "winner_b1"}}
    world = particles(simple_reference_v3, {"radio": radio})
    for seed in range(4):
        world.reset(seed=seed)
        while world.agents:
            world.step(dict.fromkeys(world.agents, 1))
        assert sum(world.outcomes.values()) == 25 * 2 and world.outcomes.get("pending", 0) <= 4


def test_it_passes_pettingzoo_s_tests(capsys: pytest.CaptureFixture[str]) -> None:
    lossy = {"radio": {"loss": 0.5}}
    parallel_api_test(particles(simple_reference_v3, lossy), num_cycles=60)
    parallel_seed_test(lambda: particles(simple_reference_v3, lossy), num_cycles=30)
    assert "Passed Parallel API test" in capsys.readouterr().out


def test_words_arrive_within_the_disc_alone() -> None:
    radio = particles(simple_reference_v3, {"radio": {"range_m": 80.0}})
    inside = outside = 0
    for seed in range(20):
        radio.reset(seed=seed)
        for agent in radio.agents:
            radio.action_space(agent).seed(seed)
        while radio.agents:
            one, other = (np.array(agent.state.p_pos) for agent in radio.unwrapped.world.agents)
            within = bool(np.hypot(*(one - other)) * METRE <= 80.0)
            actions = {agent: radio.action_space(agent).sample() for agent in radio.agents}
            observations, *_ = radio.step(actions)
            for agent, listener in permutations(actions):
                word = np.eye(10)[actions[agent] // 5] if within else np.zeros(10)
                np.testing.assert_array_equal(observations[listener][-10:], word)
            inside, outside = inside + within, outside + (not within)
    assert inside > 20 and outside > 20


def test_the_share_that_arrives_is_the_disc_s_closed_form() -> None:
    """Two points in a square of side a are within r ≤ a with probability π q² - 8/3 q³ + q⁴/2, where q = r/a."""
    range_m, loss, episodes = 120.0, 0.25, 500
    radio = particles(simple_speaker_listener_v4, {"radio": {"range_m": range_m, "loss": loss}})
    q = range_m / (2 * METRE)
    within = math.pi * q**2 - 8 / 3 * q**3 + q**4 / 2
    expected = within * (1 - loss)
    received = 0
    for seed in range(episodes):
        radio.reset(seed=seed)
        observations, *_ = radio.step({"speaker_0": 1, "listener_0": 0})
        received += int(observations["listener_0"][-2])
    assert received / episodes == pytest.approx(expected, abs=4 * math.sqrt(expected * (1 - expected) / episodes))


def test_a_message_that_is_late_arrives_in_a_later_step() -> None:
    late = particles(simple_speaker_listener_v4, {"radio": {"latency_ms": 150.0, "jitter_ms": 0.0}})
    late.reset(seed=1)
    listened = [
        late.step({"speaker_0": word, "listener_0": 0})[0]["listener_0"][-3:].tolist() for word in (0, 1, 2)
    ]
    assert listened == [[0, 0, 0], [1, 0, 0], [0, 1, 0]]


def test_episodes_have_the_seed_that_is_given_or_the_next() -> None:
    radio = particles(simple_speaker_listener_v4, {"run": {"seed": 7}, "radio": {"loss": 0.5}})

    def listen(seed: int | None) -> list[float]:
        radio.reset(seed=seed)
        steps = [radio.step({"speaker_0": 1, "listener_0": 0}) for _ in range(25)]
        return [step[0]["listener_0"][-2] for step in steps]

    first, second = listen(None), listen(None)
    assert (listen(7), listen(8)) == (first, second)
    assert first != second


def test_agents_whose_episode_is_over_neither_send_nor_receive() -> None:
    class Leaving(Crossing):
        def step(self, actions: dict[str, Any]) -> Any:
            seen, *rest = super().step(actions)
            if self.agents:
                self.agents = self.agents[:-1] or self.agents
            return seen, *rest

    env = Leaving(3)
    told: list[str] = []

    def tell(agent: str, observation: Any, action: Any) -> bytes:
        told.append(agent)
        return b"here"

    radio = emulator.radio_for(
        env, PERFECT, position_m=env.position_m, send=tell, receive=lambda agent, observation, packets: len(packets)
    )
    radio.reset(seed=1)
    assert radio.step(dict.fromkeys(env.possible_agents, 1))[0] == {"car_0": 2, "car_1": 2, "car_2": 2}
    assert radio.step(dict.fromkeys(env.possible_agents, 1))[0] == {"car_0": 1, "car_1": 1, "car_2": 0}
    assert told == ["car_0", "car_1", "car_2", "car_0", "car_1"]


def test_a_step_that_the_environment_refuses_has_sent_nothing() -> None:
    class Refusing(Crossing):
        def step(self, actions: dict[str, Any]) -> Any:
            if actions["car_0"] is None:
                raise LookupError("no such action")
            return super().step(actions)

    env = Refusing(2)
    radio = emulator.radio_for(
        env,
        PERFECT,
        position_m=env.position_m,
        send=lambda *_: b"here",
        receive=lambda agent, observation, packets: len(packets),
    )
    radio.reset(seed=1)
    with pytest.raises(LookupError):
        radio.step({"car_0": None, "car_1": 1})
    assert radio.step({"car_0": 1, "car_1": 1})[0] == {"car_0": 1, "car_1": 1}


@pytest.mark.parametrize(
    ("wrong", "line"),
    [
        ({"env": 3}, "radio_for: env = 3: a ParallelEnv of pettingzoo is needed"),
        ({"send": None}, "radio_for: send = None: a function is needed"),
        ({"observation_space": 1}, "radio_for: observation_space = 1: a space of gymnasium, or a function"),
        ({"step_s": 0}, "radio_for: step_s = 0: a number of seconds from 1e-06 to "),
        ({"scenario": {"radio": {"loss": 2}}}, r"radio.loss = 2"),
        (
            {"scenario": {"fault": [{"kind": "kill", "at_s": 1, "duration_s": 1}]}},
            r"radio_for: the scenario has \[\[fault\]\]",
        ),
    ],
)
def test_what_cannot_be_is_one_line(wrong: dict[str, Any], line: str) -> None:
    given: dict[str, Any] = {"env": Crossing(2), "scenario": PERFECT, "position_m": lambda agent: (0, 0)}
    given |= {"send": lambda *_: b"", "receive": lambda agent, observation, packets: observation} | wrong
    with pytest.raises(VnetError, match=line):
        emulator.radio_for(given.pop("env"), given.pop("scenario"), **given)


@pytest.mark.parametrize(
    ("functions", "line"),
    [
        ({"position_m": lambda agent: None}, r"position_m\('car_0'\) = None: two finite numbers in m are needed"),
        ({"position_m": lambda agent: (0, math.nan)}, r"position_m\('car_0'\) = .*: two finite numbers"),
        ({"send": lambda *_: "hello"}, r"send\('car_0'\) = 'hello': bytes are needed, or None"),
        ({"send": lambda *_: bytes(1401)}, "1401 bytes"),
    ],
)
def test_what_functions_return_is_checked(functions: dict[str, Any], line: str) -> None:
    env = Crossing(2)
    given: dict[str, Any] = {"position_m": env.position_m, "send": lambda *_: None, "receive": lambda *all: all[1]}
    radio = emulator.radio_for(env, PERFECT, **given | functions)
    with pytest.raises(VnetError, match=r"step: no episode has begun: reset\(\)"):
        radio.step({})
    radio.reset(seed=1)
    with pytest.raises(VnetError, match=line):
        radio.step(dict.fromkeys(radio.agents, 1))


def test_agents_must_be_among_the_possible_ones() -> None:
    env = Crossing(2)
    given: dict[str, Any] = {"position_m": env.position_m, "send": lambda *_: None, "receive": lambda *all: all[1]}
    radio = emulator.radio_for(env, PERFECT, **given)
    radio.reset(seed=1)
    env.agents = [*env.agents, "car_9"]
    with pytest.raises(VnetError, match="'car_9' is an agent, but not one of"):
        radio.step(dict.fromkeys(env.agents, 1))
    del env.possible_agents
    with pytest.raises(VnetError, match="its possible_agents are needed"):
        emulator.radio_for(env, PERFECT, **given)


def test_who_acts_has_an_observation() -> None:
    class Late(Crossing):
        def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
            seen, infos = super().reset(seed, options)
            return {agent: seen[agent] for agent in self.agents[:-1]}, infos

    env = Late(2)
    radio = emulator.radio_for(
        env, PERFECT, position_m=env.position_m, send=lambda *_: b"x", receive=lambda *all: all[1]
    )
    radio.reset(seed=1)
    with pytest.raises(VnetError, match="'car_1' acts, and env has given no observation of it"):
        radio.step(dict.fromkeys(env.agents, 1))
    assert radio.outcomes == {}, "of a step that is refused nothing is sent"


@pytest.mark.parametrize("agents", [[0, 1], [("car", 0), ("car", 1)]], ids=["numbers", "tuples"])
def test_agents_have_ids_of_any_kind(agents: list[Any]) -> None:
    class Motionless(ParallelEnv[Any, Any, Any]):  # type: ignore[misc]
        possible_agents = agents

        def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
            self.agents = [*agents]
            return dict.fromkeys(agents, 0), {agent: {} for agent in agents}

        def step(self, actions: dict[Any, Any]) -> Any:
            no = dict.fromkeys(agents, False)
            return dict.fromkeys(agents, 0), dict.fromkeys(agents, 0.0), no, no, {agent: {} for agent in agents}

    radio = emulator.radio_for(
        Motionless(),
        PERFECT,
        position_m=lambda agent: (0.0, 0.0),
        send=lambda *_: b"x",
        receive=lambda agent, observation, packets: [packet.sender for packet in packets],
    )
    radio.reset(seed=1)
    assert radio.step(dict.fromkeys(agents, 1))[0] == {agents[0]: [agents[1]], agents[1]: [agents[0]]}
