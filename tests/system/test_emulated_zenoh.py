"""Zenoh on virtual time against Zenoh: the same programs are told the same."""

import json
import threading
from collections.abc import Iterator, Sequence
from contextlib import closing
from functools import partial
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
import zenoh
from hypothesis import given, settings
from hypothesis import strategies as st

import emulator
from tests.support.paths import ROOT
from tests.support.zenoh_examples import EXAMPLES
from tests.support.zenoh_steps import Step, interpret
from tests.system.conftest import Vnet
from vnet.transport.session import router_endpoint

SESSIONS = 3
REPEAT_S = 1.0
"""Wait for an answer before the question is repeated."""

PROGRAM = f"""
import json, sys, time, zenoh
sys.path.insert(0, {str(ROOT)!r})
from tests.support.zenoh_steps import interpret
with open(sys.argv[1]) as file:
    steps = json.load(file)
sessions = [zenoh.open(zenoh.Config()) for _ in range({SESSIONS})]
for line in interpret(zenoh, sessions, steps, lambda: time.sleep(0.01)):
    print("told", repr(line))
"""


class Network:
    """Sessions of Zenoh itself at one router, on loopback."""

    def __init__(self) -> None:
        patient = {"drop": {"wait_before_drop": 10_000_000}}  # in µs: a slow machine loses nothing
        transport: dict[str, Any] = {"link": {"tx": {"queue": {"congestion_control": patient}}}}
        transport["shared_memory"] = {"enabled": False}  # its descriptors outlive sessions
        config = {
            "mode": "router",
            "transport": transport,
            "listen": {"endpoints": ["tcp/127.0.0.1:0"]},
            "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}, "delay": 0},
            "adminspace": {"enabled": True, "permissions": {"read": True, "write": False}},
        }
        self._router = zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
        client: dict[str, Any] = {"mode": "client", "connect": {"endpoints": [router_endpoint(self._router)]}}
        client["transport"] = transport
        client["scouting"] = {"multicast": {"enabled": False}}
        self.sessions = [zenoh.open(zenoh.Config.from_json5(json.dumps(client))) for _ in range(SESSIONS)]
        self._numbers = count()
        self._arrived = threading.Condition()
        self._seen: dict[str, int] = {}
        for receiver, session in enumerate(self.sessions):
            session.declare_subscriber("@barrier/*", partial(self._see, receiver))
        self._reach()

    def _see(self, receiver: int, sample: zenoh.Sample) -> None:
        with self._arrived:
            self._seen[f"{receiver} {sample.key_expr}"] = int(bytes(sample.payload))
            self._arrived.notify_all()

    def _reach(self) -> None:
        """Wait until each session is heard by each."""
        number = next(self._numbers)
        wanted = {f"{receiver} @barrier/{sender}" for sender in range(SESSIONS) for receiver in range(SESSIONS)}

        def reached() -> bool:
            return all(self._seen.get(each, -1) >= number for each in wanted)

        with self._arrived:
            while not reached():  # the first time before all have heard of the subscribers
                for sender, session in enumerate(self.sessions):
                    session.put(f"@barrier/{sender}", str(number), congestion_control=zenoh.CongestionControl.BLOCK)
                self._arrived.wait_for(reached, REPEAT_S)

    def settle(self) -> None:
        """Wait until what was done has taken effect at all sessions: it goes before what follows on each link."""
        for _ in range(3):
            self._reach()

    def close(self) -> None:
        for session in (*self.sessions, self._router):
            session.close()  # type: ignore[no-untyped-call]


@pytest.fixture(scope="module")
def network() -> Iterator[Network]:
    with closing(Network()) as network:
        yield network


def emulated(program: str, steps: Sequence[Step] = ()) -> list[str]:
    """Return what the sessions of one vehicle are told by a program, which may read steps."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "program.py").write_text(program)
        (folder / "steps.json").write_text(json.dumps(steps))
        command = ["python", str(folder / "program.py"), str(folder / "steps.json")]
        scenario = {
            "run": {"duration_s": 60.0, "settle_s": 0.0},
            "network": {"vehicles": 1},
            "radio": {"keys": ["none"]},
            "program": {"kind": "zenoh", "command": command},
        }
        run = emulator.simulate(scenario, out=folder / "run")
        lines = (run.folder / "logs/v01.log").read_text().splitlines()
        assert "v01 finished" in lines, lines
        return [line.removeprefix("told ") for line in lines if line.startswith("told ")]


KEYS = st.sampled_from(["a", "a/b", "a/b/c", "a/c", "b/c", "b/@x/c"])
EXPRESSIONS = st.sampled_from(
    ["a", "a/b", "a/*", "a/**", "**", "*/b", "**/c", "a/b$*/c", "b/@x/*", "b/@x/**", "a/$*c"]
)
SESSION = st.integers(0, SESSIONS - 1)
ORIGINS = st.sampled_from(["ANY", "SESSION_LOCAL", "REMOTE"])
NAMES = st.sampled_from(["one", "two", "three"])
TEXTS = st.sampled_from(["", "x", "payload"])
STEPS = st.one_of(
    st.tuples(st.just("subscribe"), SESSION, NAMES.map("sub {}".format), EXPRESSIONS, ORIGINS),
    st.tuples(
        st.just("queryable"),
        SESSION,
        NAMES.map("queryable {}".format),
        EXPRESSIONS,
        st.booleans(),
        ORIGINS,
        st.lists(KEYS, max_size=3, unique=True),
    ),
    st.tuples(st.just("token"), SESSION, NAMES.map("token {}".format), KEYS),
    st.tuples(st.just("watch"), SESSION, NAMES.map("watch {}".format), EXPRESSIONS, st.booleans()),
    st.tuples(
        st.just("undeclare"),
        SESSION,
        st.tuples(st.sampled_from(["sub", "queryable", "token", "watch"]), NAMES).map(" ".join),
    ),
    st.tuples(st.just("put"), SESSION, KEYS | EXPRESSIONS, TEXTS, ORIGINS, st.booleans()),
    st.tuples(st.just("delete"), SESSION, KEYS, ORIGINS),
    st.tuples(st.just("publish"), SESSION, KEYS, TEXTS),
    st.tuples(
        st.just("get"),
        SESSION,
        EXPRESSIONS | KEYS.map("{}?x=1;y".format),
        st.sampled_from(["BEST_MATCHING", "ALL", "ALL_COMPLETE"]),
        st.sampled_from(["AUTO", "NONE", "MONOTONIC", "LATEST"]),
        ORIGINS,
        st.none() | TEXTS,
    ),
    st.tuples(st.just("tokens"), SESSION, EXPRESSIONS),
)


@given(st.lists(STEPS, max_size=12))
@settings(max_examples=40, deadline=None, derandomize=True)
def test_sessions_are_told_the_same(network: Network, steps: list[Step]) -> None:
    told = [repr(line) for line in interpret(zenoh, network.sessions, steps, network.settle)]
    network.settle()
    assert emulated(PROGRAM, steps) == told


EXAMPLE = f"""
import sys, time, zenoh, zenoh.ext
sys.path.insert(0, {str(ROOT)!r})
from tests.support.zenoh_examples import EXAMPLES
for name, example in EXAMPLES.items():
    sessions = []
    def open_session():
        sessions.append(zenoh.open(zenoh.Config()))
        return sessions[-1]
    print("told", name, example(zenoh, open_session, lambda: time.sleep(0.01)))
    for session in sessions:
        session.close()
"""


def test_examples_are_told_the_same() -> None:
    told = dict(line.split(" ", 1) for line in emulated(EXAMPLE))
    for name, example in EXAMPLES.items():
        with closing(Network()) as network:
            sessions = iter(network.sessions)
            assert told[name] == repr(example(zenoh, sessions.__next__, network.settle)), name


TALK = """
import sys, threading, time, zenoh

def count(sample):
    print("heard", sample.key_expr, sample.payload.to_string(), time.time())

session = zenoh.open(zenoh.Config.from_env())
session.declare_subscriber("car/*/pose", count)
session.declare_queryable("state", lambda query: query.reply("state", sys.argv[1]))
token = session.liveliness().declare_token(f"alive/{sys.argv[1]}")

def ask():
    while True:
        time.sleep(0.3)
        for reply in session.get("state", timeout=0.25):
            print("state", reply.ok and reply.ok.payload.to_string())

threading.Thread(target=ask, daemon=True).start()
for number in range(20):
    session.put(f"car/{sys.argv[1]}/pose", str(number))
    time.sleep(0.1)
"""


@pytest.mark.parametrize("order", ["fifo", "shuffle"])
def test_live_and_simulated_runs_are_the_same(vnet: Vnet, tmp_path: Path, order: str) -> None:
    (tmp_path / "talk.py").write_text(TALK)
    text = f"""
        [run]
        duration_s = 2.5
        settle_s = 0.0
        order = "{order}"
        [network]
        vehicles = 3
        [radio]
        range_m = 100000.0
        loss = 0.2
        [program]
        kind = "zenoh"
        command = ["python", "{tmp_path}/talk.py", "{{id}}"]
        zenoh = {{ query_s = 0.2 }}
        [[fault]]
        kind = "restart"
        at_s = 1.0
        duration_s = 0.4
        nodes = ["v02"]
        """
    (tmp_path / "talk.toml").write_text(text)
    live, simulated = (vnet(command, str(tmp_path / "talk.toml")) for command in ("run", "simulate"))
    apart = vnet("simulate", str(tmp_path / "talk.toml"), "--processes", "2")
    assert live.fingerprint == simulated.fingerprint == apart.fingerprint
    for node in ("v01", "v02", "v03"):
        logs = [(each.folder / f"logs/{node}.log").read_text() for each in (live, simulated, apart)]
        heard = [[line for line in text.splitlines() if line.startswith(("heard", "state"))] for text in logs]
        assert heard[0] == heard[1] == heard[2] != []


def test_gateway_and_virtual_time_have_the_same_receptions(vnet: Vnet, tmp_path: Path) -> None:
    (tmp_path / "put.py").write_text("""
import sys, time, zenoh
with zenoh.open(zenoh.Config.from_env()) as session:
    session.declare_subscriber("**", lambda sample: None)
    for number in range(15):
        session.put(f"car/{sys.argv[1]}", str(number), congestion_control=zenoh.CongestionControl.BLOCK)
        time.sleep(0.05)
    time.sleep(60)
""")
    (tmp_path / "put.toml").write_text(f"""
        [run]
        duration_s = 4.0
        settle_s = 0.0
        [network]
        vehicles = 3
        [radio]
        range_m = 100000.0
        loss = 0.3
        [program]
        kind = "zenoh"
        command = ["python", "{tmp_path}/put.py", "{{id}}"]
        """)
    received = []
    for command, pacing in (("run", "realtime"), ("simulate", "lockstep")):
        done = vnet(command, str(tmp_path / "put.toml"), "--set", f"run.pacing={pacing}")
        rows = [row for row in done.trace() if row["outcome"] in ("delivered", "lost")]
        received.append({(row["sender"], row["seq"], row["receiver"]): row["outcome"] for row in rows})
    real, emulated = received
    assert len(emulated) == 3 * 15 * 2
    assert real.items() <= emulated.items(), "what is put before a run in real time begins is no frame"
    assert set(real.values()) == {"delivered", "lost"}


HOLDER = """
import sys, time, zenoh

def main():
    session = zenoh.open(zenoh.Config())
    subscriber = session.liveliness().declare_subscriber("alive/*", print)
    token = session.liveliness().declare_token(f"alive/{sys.argv[1]}")
    while True:
        time.sleep(0.1)

main()
"""


def test_what_a_killed_program_holds_ends_without_a_word(vnet: Vnet, tmp_path: Path) -> None:
    (tmp_path / "holder.py").write_text(HOLDER)
    (tmp_path / "holder.toml").write_text(
        """
run = { name = "holder", duration_s = 2.0, settle_s = 0.5 }
network.vehicles = 2
radio.range_m = 100000.0
program = { kind = "zenoh", command = ["python", "HOLDER", "{id}"] }
[[fault]]
kind = "kill"
at_s = 0.5
duration_s = 0.5
nodes = ["v02"]
""".replace("HOLDER", str(tmp_path / "holder.py"))
    )
    done = vnet("simulate", str(tmp_path / "holder.toml"), "--quiet")
    assert (done.status, "Exception ignored" in done.stdout + done.stderr) == (0, False)
