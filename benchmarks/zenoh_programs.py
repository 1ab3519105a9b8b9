"""Zenoh programs as vehicles: latency that the gateways add, many vehicles in real time, and on virtual time.

The clients are sessions of processes of this module, eight to a process, and measure by one monotonic clock.
"""

from __future__ import annotations

import asyncio
import json
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import zenoh
from numpy.typing import NDArray

from benchmarks.__main__ import ROOT, Figures, event, vnet
from emulator.drivers.live.gateway import Gateway
from emulator.scenario.program import ZenohSessions
from vnet.gateway.keys import RADIO_KEYS
from vnet.transport.session import open_local_router, router_endpoint

RATE_HZ = 10
PAYLOAD_BYTES = 100
CLIENTS_A_PROCESS = 8
LATENCY_MS = 1.0
"""Latency of the radio itself."""
MEASURED_S = 12.0
TALKER = """
import sys, time
import zenoh
session = zenoh.open(zenoh.Config.from_env())
session.declare_subscriber("car/*/pose", lambda sample: None)
publisher = session.declare_publisher(f"car/{sys.argv[1]}/pose")
while True:
    publisher.put(bytes(100))
    time.sleep(0.1)
"""


def scenario(folder: Path, vehicles: int, peers: int, *program: str) -> str:
    """Write a scenario without losses, in which each vehicle hears so many peers; returns its path."""
    path = folder / "clients.toml"
    path.write_text(
        f'[run]\nname = "clients"\npacing = "realtime"\nduration_s = {MEASURED_S + 3}\nsettle_s = 0.0\n'
        f"[network]\nvehicles = {vehicles}\n"
        f"[radio]\nrange_m = 1e6\nmax_peers = {peers}\nlatency_ms = {LATENCY_MS}\njitter_ms = 0.0\n"
        "access_jitter_ms = 0.0\nbitrate_mbps = 1e6\n"
        '[program]\nkind = "zenoh"\n' + "\n".join(program) + "\n"
    )
    return str(path)


def measure() -> Figures:
    """Return all figures."""
    many = {f"25_{name}": value for name, value in gateways(25, 12).items()}
    return {**gateways(10, 9), **many, **endpoints_listen(), **emulated()}


def gateways(vehicles: int, peers: int) -> Figures:
    """Return the latency from one client's put to another's callback, less the radio's, and late deliveries.

    *Added* is what it is more than that of the same clients at one router of Zenoh's, without vnet.
    """
    plain_ms = plain(vehicles)
    with tempfile.TemporaryDirectory(prefix="vnet-bench-") as name:
        folder = Path(name)
        clients: list[subprocess.Popen[bytes]] = []

        def start(pid: int) -> None:
            while not (found := list(Path(tempfile.gettempdir()).glob("vnet-bench-*/run/endpoints.json"))):
                time.sleep(0.01)
            clients.extend(start_clients(list(json.loads(found[0].read_text()).items()), folder))

        result = vnet("run", scenario(folder, vehicles, peers), watch=start)
        gateway_ms = latencies_ms(clients, folder) - LATENCY_MS
    late = event(result, "late_deliveries")
    verdicts = {"valid": 0.0, "unknown": 1.0, "invalid": 2.0}
    p50_ms, p99_ms = np.percentile(gateway_ms, (50, 99)).tolist()
    plain_p50_ms, plain_p99_ms = np.percentile(plain_ms, (50, 99)).tolist()
    return {
        "samples": float(len(gateway_ms)),
        "p50_ms": p50_ms,
        "p99_ms": p99_ms,
        "added_p50_ms": p50_ms - plain_p50_ms,
        "added_p99_ms": p99_ms - plain_p99_ms,
        "late_share": late["count"] / max(late["total"], 1),
        "verdict (0 valid, 1 unknown)": verdicts[result["verdict"]],
    }


def plain(vehicles: int) -> NDArray[np.float64]:
    """Return the latencies (ms) between so many clients of one router, which all hear each other."""
    with tempfile.TemporaryDirectory(prefix="vnet-bench-") as name:
        router = open_local_router("tcp/127.0.0.1:0", {})
        try:
            endpoint = router_endpoint(router)
            clients = start_clients([(f"v{number}", endpoint) for number in range(vehicles)], Path(name))
            return latencies_ms(clients, Path(name))
        finally:
            router.close()  # type: ignore[no-untyped-call]


def start_clients(endpoints: Sequence[tuple[str, str]], folder: Path) -> list[subprocess.Popen[bytes]]:
    """Start the processes of the clients of these vehicles (name and endpoint)."""
    clients = []
    for first in range(0, len(endpoints), CLIENTS_A_PROCESS):
        share = json.dumps(endpoints[first : first + CLIENTS_A_PROCESS])
        command = [sys.executable, "-m", "benchmarks.zenoh_programs", share, str(folder / f"{first}.json")]
        clients.append(subprocess.Popen(command, cwd=ROOT))
    return clients


def latencies_ms(clients: Sequence[subprocess.Popen[bytes]], folder: Path) -> NDArray[np.float64]:
    """Return what all clients have measured, once they have ended."""
    for client in clients:
        client.wait(60)
    return np.concatenate([json.loads(path.read_text()) for path in folder.glob("*.json")])


def endpoints_listen() -> Figures:
    """Return the seconds until all endpoints of 50 and of 200 vehicles listen."""
    return {f"{count}_listen_s": asyncio.run(_listen(count)) for count in (50, 200)}


async def _listen(count: int) -> float:
    settings = ZenohSessions()
    gateways = [Gateway(f"v{number}", 0, RADIO_KEYS, settings, lambda *_: None) for number in range(count)]
    started = time.monotonic()
    await asyncio.gather(*(asyncio.to_thread(each.open, settings.listen) for each in gateways))
    taken_s = time.monotonic() - started
    await asyncio.gather(*(each.close() for each in gateways))
    return taken_s


def emulated(vehicles: int = 50, peers: int = 12) -> Figures:
    """Return how much faster than real time so many publishers and subscribers run on virtual time."""
    with tempfile.TemporaryDirectory(prefix="vnet-bench-") as name:
        folder = Path(name)
        (folder / "talker.py").write_text(TALKER)
        path = scenario(folder, vehicles, peers, 'command = ["python", "talker.py", "{id}"]')
        result = vnet("simulate", path)
        return {"real_time_factor": (MEASURED_S + 3) / float(result["wall_s"])}


def main(endpoints: Sequence[tuple[str, str]], out: Path) -> None:
    """Be the clients of these vehicles (name and endpoint), and write the latencies of what they hear, in ms."""
    latencies_ms: list[float] = []
    sessions, publishers = [], []
    for name, endpoint in endpoints:
        config = zenoh.Config()
        config.insert_json5("mode", '"client"')
        config.insert_json5("connect/endpoints", json.dumps([endpoint]))
        session = zenoh.open(config)
        sessions.append(session)

        def hear(sample: zenoh.Sample, own: str = f"car/{name}/pose") -> None:
            now_ns = time.monotonic_ns()
            if str(sample.key_expr) != own:
                (sent_ns,) = struct.unpack_from("<q", sample.payload.to_bytes())
                latencies_ms.append((now_ns - sent_ns) / 1e6)

        session.declare_subscriber("car/*/pose", hear)
        publishers.append(session.declare_publisher(f"car/{name}/pose"))
    begin = time.monotonic()
    for tick in range(round(MEASURED_S * RATE_HZ * len(publishers))):
        time.sleep(max(0.0, begin + tick / RATE_HZ / len(publishers) - time.monotonic()))
        payload = struct.pack("<q", time.monotonic_ns()).ljust(PAYLOAD_BYTES, b"\0")
        publishers[tick % len(publishers)].put(payload)
    for session in sessions:
        session.close()  # type: ignore[no-untyped-call]
    out.write_text(json.dumps(latencies_ms))


if __name__ == "__main__":
    main(json.loads(sys.argv[1]), Path(sys.argv[2]))
