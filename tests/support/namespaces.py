"""Hosts of a network on one machine: Linux network namespaces, joined by a bridge in a namespace of its own."""

import os
import signal
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass

LINK = "eth0"
"""The link of each host to the network."""


@dataclass(frozen=True)
class NetworkHost:
    """A namespace with one address and loopback."""

    namespace: str
    address: str

    def command(self, *words: str) -> list[str]:
        """Return the command that runs `words` on this host; its process id is that of `words`."""
        return ["ip", "netns", "exec", self.namespace, *words]


def why_impossible() -> str:
    """Return why this process cannot make network namespaces; "" if it can."""
    if os.geteuid() != 0:
        return "network namespaces need root"
    name = f"vnet-{os.getpid()}-try"
    try:
        _ip("netns", "add", name)
        _ip("netns", "del", name)
    except FileNotFoundError:
        return "network namespaces need ip (iproute2)"
    except subprocess.CalledProcessError as error:
        return f"network namespaces cannot be made: {error.stderr.strip()}"
    return ""


@contextmanager
def network(count: int) -> Iterator[list[NetworkHost]]:
    """Make so many hosts that reach each other at 10.77.0.1, 10.77.0.2, …; end all processes on them at the end."""
    with ExitStack() as stack:
        hub = _namespace("hub", stack)
        _ip("-n", hub, "link", "add", "bridge", "type", "bridge")
        _ip("-n", hub, "link", "set", "bridge", "up")
        hosts = [NetworkHost(_namespace(str(number), stack), f"10.77.0.{number}") for number in range(1, count + 1)]
        for number, host in enumerate(hosts):
            there = f"to-{number}"
            _ip("-n", hub, "link", "add", there, "type", "veth", "peer", "name", LINK, "netns", host.namespace)
            _ip("-n", hub, "link", "set", there, "master", "bridge", "up")
            _ip("-n", host.namespace, "addr", "add", f"{host.address}/24", "dev", LINK)
            for link in (LINK, "lo"):
                _ip("-n", host.namespace, "link", "set", link, "up")
        yield hosts


def _namespace(name: str, stack: ExitStack) -> str:
    full = f"vnet-{os.getpid()}-{name}"
    _ip("netns", "add", full)
    stack.callback(_delete, full)
    return full


def _delete(namespace: str) -> None:
    for pid in _ip("netns", "pids", namespace).split():
        with suppress(ProcessLookupError):
            os.kill(int(pid), signal.SIGKILL)
    _ip("netns", "del", namespace)


def _ip(*words: str) -> str:
    done = subprocess.run(["ip", *words], check=True, capture_output=True, text=True)
    return done.stdout
