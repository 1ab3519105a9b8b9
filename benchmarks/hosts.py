"""A run on three hosts, two of which are a millisecond away, against the same run on one.

The hosts are processes of this machine; a forwarder delays what passes between two of them and the emulator, in
both directions, as a network would.
"""

from __future__ import annotations

import json
import queue
import re
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

from benchmarks.__main__ import ROOT, vnet

HOSTS = ("a", "b", "c")
ONE_WAY_S = 0.001
CHUNK_BYTES = 2**20
VNET = [sys.executable, "-P", "-m", "emulator"]


class Forwarder(threading.Thread):
    """Forwards connections to `port` of this machine; what passes is delayed by `ONE_WAY_S`."""

    def __init__(self, port: int) -> None:
        super().__init__(daemon=True)
        self._to = port
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._listener.getsockname()[1])

    def run(self) -> None:
        """Take connections until the listener is closed."""
        while True:
            try:
                here, _ = self._listener.accept()
                there = socket.create_connection(("127.0.0.1", self._to))
            except OSError:
                return
            for end in (here, there):
                end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            for source, sink in ((here, there), (there, here)):
                waiting: queue.SimpleQueue[tuple[float, bytes]] = queue.SimpleQueue()
                threading.Thread(target=_receive, args=(source, waiting), daemon=True).start()
                threading.Thread(target=_send, args=(sink, waiting), daemon=True).start()

    def close(self) -> None:
        """Take no more connections."""
        self._listener.close()


def _receive(source: socket.socket, waiting: queue.SimpleQueue[tuple[float, bytes]]) -> None:
    data = b"?"
    while data:
        try:
            data = source.recv(CHUNK_BYTES)
        except OSError:
            data = b""
        waiting.put((time.monotonic() + ONE_WAY_S, data))


def _send(sink: socket.socket, waiting: queue.SimpleQueue[tuple[float, bytes]]) -> None:
    while True:
        due, data = waiting.get()
        time.sleep(max(due - time.monotonic(), 0.0))
        try:
            if not data:
                sink.shutdown(socket.SHUT_WR)
                return
            sink.sendall(data)
        except OSError:
            return


def compare(runs: int, scenario: str, *options: str) -> str:
    """Return barriers an emulated second, and the real-time factor on three hosts by that on one, in turns."""
    ratios, barriers = [], 0.0
    for _ in range(runs):
        one = float(vnet("run", scenario, *options)["real_time_factor"])
        three, barriers = _on_three_hosts(scenario, options)
        ratios.append(three / one)
    return f"{barriers:.3g}; {statistics.median(ratios):.2f}"


def _on_three_hosts(scenario: str, options: Sequence[str]) -> tuple[float, float]:
    """Return the real-time factor of one run, and the most bundles of grants of a host an emulated second."""
    with tempfile.TemporaryDirectory(prefix="vnet-bench-") as folder, ExitStack() as stack:
        with socket.create_server(("127.0.0.1", 0)) as free:
            port = int(free.getsockname()[1])
        out = Path(folder) / "run"
        words = ["emulator", scenario, "--hosts", ",".join(HOSTS), "--listen", f"tcp/127.0.0.1:{port}"]
        words += ["--out", str(out), "--no-report", *options]
        emulator = subprocess.Popen([*VNET, *words], cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
        stack.enter_context(emulator)
        stack.callback(emulator.kill)
        assert emulator.stderr is not None
        while b"waiting for" not in (line := emulator.stderr.readline()):
            assert line, "the emulator has ended"
        draining = threading.Thread(target=emulator.stderr.read)
        draining.start()
        stack.callback(draining.join)
        forwarder = Forwarder(port)
        forwarder.start()
        stack.callback(forwarder.close)
        name = json.loads((out / "access" / "access.json").read_text())["run"]
        hosts = []
        for host in HOSTS:
            at = port if host == HOSTS[0] else forwarder.port
            words = ["host", "--connect", f"tcp/127.0.0.1:{at}", "--run", name, "--credentials"]
            words.append(str(out / "access" / "credentials" / f"host-{host}.json"))
            process = subprocess.Popen([*VNET, *words], cwd=ROOT, stderr=subprocess.PIPE, text=True)
            hosts.append(stack.enter_context(process))
            stack.callback(process.kill)
        said = [host.communicate()[1] for host in hosts]
        emulator.wait()
        verdict = json.loads((out / "verdict.json").read_text())
        bundles = [
            int(found[1].replace(",", "")) for text in said if (found := re.search(r"in ([\d,]+) bun", text))
        ]
        assert len(bundles) == len(HOSTS), said
        return float(verdict["real_time_factor"]), max(bundles) / float(verdict["emulated_s"])
