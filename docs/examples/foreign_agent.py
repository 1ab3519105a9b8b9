"""An agent that imports no vnet: one vehicle of a run, with Zenoh and msgpack alone, in either pacing.

It broadcasts each fix as the msgpack map {"position_m": [east, north]} and reports its position. All messages are
in docs/messages.md. Exit status: 0 the run is over, 1 refused, or without emulator.
"""

import argparse
import base64
import contextlib
import json
import math
import os
import queue
import secrets
import socket
import sys
import time
from pathlib import Path
from typing import Any

import msgpack
import zenoh

VERSION = 2  # of the messages; an emulator of another version refuses the hello
HELLO_PERIOD_S, SIGN_OF_LIFE_S = 0.5, 1.0  # the latter in real time: longest silence towards the emulator
HEAD_START_NS = 200_000_000  # real time: time 0 is this long after the first batch
LATENESS_BINS, LIMIT_BIN, LIMIT_NS = 80, 44, 20_000_000  # that bin begins at what counts against the run


class EndOfRun(Exception):
    """The emulator has ended the run."""


def unpack(data: bytes) -> Any:
    """Decode msgpack; None where that is impossible: what is malformed is dropped."""
    try:
        return msgpack.unpackb(data)
    except ValueError:
        return None


class Vehicle:
    """The program: what the vehicle does with packets and fixes. Times are nanoseconds from the start."""

    def __init__(self, node: str, runs: bool) -> None:
        self.node, self.runs, self.beacons = node, runs, 0
        self.clock: list[Any] = [node, 0, 0, 0.0]

    def step(self, time_ns: int, packets: list[Any], fixes: list[Any], clocks: list[Any]) -> list[Any]:
        """Take what is due at `time_ns`, and return the traffic: frames, reports and endings."""
        self.clock = clocks[-1] if clocks else self.clock
        _node, since_ns, offset_ns, rate, *_ = self.clock  # the vehicle's own clock, which faults can make wrong
        now_ns = max(time_ns + offset_ns + round(rate * (time_ns - since_ns)), 0)
        for _node, _sender, _sent_ns, _received_ns, payload, *_ in packets:
            message = unpack(payload)  # the radio may bring anything
            self.beacons += isinstance(message, dict) and "position_m" in message
        frames, reports = [], []
        for _node, _time_ns, position_m, covariance_m2, *_ in fixes if self.runs else ():
            frames.append([self.node, msgpack.packb({"position_m": position_m})])
            report = {"time_ns": now_ns, "node": self.node, "values": {"beacons": self.beacons}}
            reports.append({**report, "estimate_m": position_m, "covariance_m2": covariance_m2})
        return [frames, reports, []]


class Agent:
    """The vehicle's keys on the router, and the protocol on them. Methods `on_…` run on threads of Zenoh's."""

    def __init__(self, session: zenoh.Session, run: str, node: str) -> None:
        key = f"vnet/{run}/node/{node}"
        self.node, self.nonce, self.frames_said = node, secrets.token_bytes(16), 0
        self.orphan_timeout_s, self.patience_until_s, self.lost_s = 5.0, 0.0, math.inf
        self.inbox: queue.SimpleQueue[tuple[list[Any], int]] = queue.SimpleQueue()
        block = zenoh.CongestionControl.BLOCK
        self.tx = session.declare_publisher(f"{key}/tx", congestion_control=block, express=True)
        self.rx = session.declare_subscriber(f"{key}/rx", self.on_rx)
        liveliness = session.liveliness()
        self.token = liveliness.declare_token(f"{key}/alive")
        self.emulator = liveliness.declare_subscriber(f"vnet/{run}/emulator/alive", self.on_emulator, history=True)

    def on_rx(self, sample: zenoh.Sample) -> None:
        """Queue a message with the instant of its arrival."""
        message = unpack(sample.payload.to_bytes())
        if message == ["StackRequest"]:  # answered here: the main thread may be busy
            self.say("StackDump", self.nonce, "", None, self.frames_said)
        elif isinstance(message, list) and message:  # anything else is malformed, and dropped
            self.inbox.put((message, time.monotonic_ns()))

    def on_emulator(self, sample: zenoh.Sample) -> None:
        """Note that the emulator has come or gone."""
        self.lost_s = math.inf if sample.kind == zenoh.SampleKind.PUT else time.monotonic()
        self.inbox.put((["Wake"], 0))

    def say(self, *fields: Any) -> None:
        """Put a message on the vehicle's `tx`."""
        self.tx.put(msgpack.packb(fields))

    def next(self, timeout_s: float) -> tuple[list[Any], int]:
        """Return the next message and its arrival on the monotonic clock; `["Wake"]` if none came in time."""
        gone_s = max(self.lost_s + self.orphan_timeout_s, self.patience_until_s)
        if time.monotonic() > gone_s:
            sys.exit(f"{self.node}: the emulator is gone")
        try:
            message, arrived_ns = self.inbox.get(timeout=max(min(timeout_s, gone_s - time.monotonic() + 0.01), 0))
        except queue.Empty:
            return ["Wake"], 0
        if message[0] == "Await":
            self.patience_until_s = time.monotonic() + message[1]
        if message[0] == "End" and message[1] in (None, self.nonce):
            raise SystemExit(f"{self.node}: refused: {message[2]}") if message[3] else EndOfRun(message[2])
        return message, arrived_ns

    def join(self, timeout_s: float) -> list[Any]:
        """Repeat hello until the welcome comes, then say that the program can start."""
        hello: list[Any] = ["Hello", self.node, self.node, self.nonce, os.getpid(), socket.gethostname()]
        deadline_s = time.monotonic() + timeout_s
        while time.monotonic() < deadline_s:
            self.say(*hello, False, None, VERSION)
            message, _ = self.next(HELLO_PERIOD_S)
            if message[0] == "Welcome" and message[2] == self.nonce:
                self.say(*hello, True, None, VERSION)
                return message
        sys.exit(f"{self.node}: no welcome within {timeout_s:g} s: is the emulator running?")

    def run_lockstep(self, vehicle: Vehicle) -> None:
        """Answer each grant with a yield. The vehicle acts at fixes alone: at the first instant of a window."""
        mail: list[Any] = []  # packets; those that arrive later in a window are for the next one
        while True:
            message, _ = self.next(60.0)
            if message[0] == "Grant":
                _, seq, time_ns, _end_ns, packets, fixes, clocks, *_ = message
                mail += packets
                steps = [[time_ns, vehicle.step(time_ns, [p for p in mail if p[3] <= time_ns], fixes, clocks)]]
                mail = [packet for packet in mail if packet[3] > time_ns]
                self.say("Yield", self.nonce, seq, None, [], [self.node] * vehicle.runs, steps, 1)

    def run_realtime(self, vehicle: Vehicle, same_clock: bool) -> None:
        """Send frames at each fix, acknowledge batches at least once a second, and mark the last message."""
        expected, origin_ns, said_s = 0, 0, math.inf  # nothing is said before batch 0
        missed, lateness = list[list[int]](), [0] * LATENESS_BINS
        while True:
            traffic: list[Any] = [[], [], []]
            try:
                message, arrived_ns = self.next(min(said_s + SIGN_OF_LIFE_S - time.monotonic(), 60.0))
            except EndOfRun:
                return self.say("Frames", self.nonce, self.frames_said, expected, missed, traffic, [lateness], True)
            if message[0] == "Batch":
                _, fixes, batch, packets, start_origin_ns, start_ns, held, clocks, *_ = message
                if start_origin_ns is not None:
                    here_ns = arrived_ns - start_ns + (HEAD_START_NS if start_ns == 0 else 0)
                    origin_ns, said_s = min(start_origin_ns, here_ns) if same_clock else here_ns, 0.0
                missed += [[expected, batch - 1]] if batch > expected else []
                expected = batch + 1
                now_ns = max(arrived_ns - origin_ns, 0)
                for packet in [] if held else packets:  # a bin of lateness for each quarter of a power of two
                    late = max(abs(now_ns - packet[3]), 1) / LIMIT_NS
                    lateness[min(max(LIMIT_BIN + math.floor(4 * math.log2(late)), 0), LATENESS_BINS - 1)] += 1
                traffic = vehicle.step(now_ns, packets, fixes, clocks)
            if traffic[0] or time.monotonic() - said_s >= SIGN_OF_LIFE_S:
                self.say("Frames", self.nonce, self.frames_said, expected, missed, traffic, [lateness], False)
                self.frames_said, missed, said_s = self.frames_said + 1, [], time.monotonic()


def client_config(endpoint: str, credentials: dict[str, Any]) -> zenoh.Config:
    """A client of the emulator's router: user and password, and a certificate where the router asks for one."""
    login = {name: credentials[name] for name in ("user", "password")}
    link: dict[str, Any] = {"tx": {"lease": 3_600_000}}  # who is paused or starved must not look dead
    if tls := credentials.get("tls"):
        pem = {"root_ca_certificate": tls["authority"], "connect_certificate": tls["own"]["certificate"]}
        pem["connect_private_key"] = tls["own"]["private_key"]
        link["tls"] = {f"{name}_base64": base64.b64encode(text.encode()).decode() for name, text in pem.items()}
        link["tls"] |= {"enable_mtls": True, "verify_name_on_connect": True}
    config = {
        "mode": "client",
        "connect": {"endpoints": [endpoint], "timeout_ms": 5000, "exit_on_failure": True},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {"shared_memory": {"enabled": False}, "link": link, "auth": {"usrpwd": login}},
    }
    return zenoh.Config.from_json5(json.dumps(config))


def main() -> None:
    """Join a run as one vehicle, and take part until its end."""
    parser = argparse.ArgumentParser()
    for option in ("--connect", "--run", "--node", "--credentials"):
        parser.add_argument(option, required=True)
    given = parser.parse_args()
    with zenoh.open(client_config(given.connect, json.loads(Path(given.credentials).read_text()))) as session:
        agent = Agent(session, given.run, given.node)
        welcome = agent.join(60.0)
        pacing, agent.orphan_timeout_s, boot_id, runs = welcome[4], welcome[11], welcome[13], welcome[14]
        vehicle = Vehicle(given.node, runs)
        is_first = os.path.realpath("/proc/self/ns/time").endswith(("/time", ":[4026531834]"))  # or the only one
        same_clock = is_first and boot_id == Path("/proc/sys/kernel/random/boot_id").read_text().strip()
        with contextlib.suppress(EndOfRun):
            agent.run_lockstep(vehicle) if pacing == "lockstep" else agent.run_realtime(vehicle, same_clock)


if __name__ == "__main__":
    main()
