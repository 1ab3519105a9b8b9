"""The process of a host, without Zenoh and without agents: what it does with orders, and what it tells."""

import queue
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from emulator.drivers.hosts import host as host_module
from emulator.drivers.hosts import messages
from emulator.drivers.hosts.host import Event, HostProcess
from emulator.drivers.hosts.messages import Call, Calls
from emulator.drivers.launch import Exit
from emulator.records.run_folder import RunFolder
from tests.emulator.drivers.live.fakes import FakeLauncher
from vnet.errors import TransportError, VnetError
from vnet.transport import wire
from vnet.transport.access import Access

PROCESSES = [["v01", "v02"], ["v03"]]
YIELD = b"\x96\xa5Yield, and whatever else is in it"
FINAL = wire.encode(wire.Final(b"n", wire.Traffic()))


class HostLauncher(FakeLauncher):
    """A launcher of which a test says who ends, or that it can start nobody."""

    def __init__(self) -> None:
        super().__init__()
        self.ends: dict[str, Exit] = {}
        self.failure = ""

    def start_agents(self, *arguments: Any, **more: Any) -> None:
        if self.failure:
            raise VnetError(self.failure)
        super().start_agents(*arguments, **more)

    def ended(self) -> dict[str, Exit]:
        ends, self.ends = self.ends, {}
        for name in ends:
            del self.pids[name]
        return ends

    def stop(self, patience_s: float) -> dict[str, Exit]:
        self.pids.clear()
        self.done.append(("stop", str(patience_s)))
        return {}


class Sides:
    """Both connections of a host: bundles that go up, messages that go down."""

    nonce = b"1"
    endpoint = "tcp/here:1"
    access = Access.create("r", PROCESSES)

    def __init__(self) -> None:
        self.bundles: list[list[Any]] = []
        self.down: list[tuple[str, bytes]] = []
        self.emulator: list[bool] = []

    def put(self, *arguments: Any) -> None:
        if len(arguments) == 1:
            self.bundles.append(list(arguments[0]))
        else:
            self.down.append(arguments)

    @property
    def agents(self) -> "Sides":
        return self

    def show_emulator(self, there: bool) -> None:
        self.emulator.append(there)


class Play:
    """A host of three nodes in two processes. A step is an event, or what happens between events."""

    def __init__(self, folder: Path) -> None:
        self.launcher = HostLauncher()
        self.sides = Sides()
        self.folder = RunFolder(folder)
        self.folder.logs.mkdir()
        self.steps: list[Event | Callable[[], None]] = []
        welcome = messages.HostWelcome(b"1", PROCESSES, "fork", [], False, 0.0, 1000, 1.0)
        parts: list[Any] = [self.sides, self.sides, self.launcher, folder, self]
        self.host = HostProcess("a", welcome, *parts)

    def get(self, timeout: float | None) -> Event:
        """Take the next step, as the queue of a host would; each event comes by itself."""
        while self.steps and callable(self.steps[0]):
            self.steps.pop(0)()  # type: ignore[operator]
        if self.steps:
            return self.steps.pop(0)  # type: ignore[return-value]
        assert timeout is not None, "it waits for nothing that will come"
        time.sleep(0)
        raise queue.Empty

    def get_nowait(self) -> Event:
        raise queue.Empty

    def work(self, *steps: Event | Callable[[], None]) -> list[list[Any]]:
        """Start both processes, take these steps and leave; returns the bundles that have gone up."""
        begin = orders(("start", ["v01", "v03"], [1, 2], 0))
        self.steps = [begin, *steps, orders(("leave",))]
        self.host.work()
        return self.sides.bundles


@pytest.fixture
def play(tmp_path: Path) -> Play:
    return Play(tmp_path)


def orders(*those: Call, nonce: bytes = b"1") -> Event:
    return "rx", "", messages.encode(Calls(nonce, those))


def grant(*process_ids: str) -> Event:
    return orders(*(("to_node", process_id, b"grant", True) for process_id in process_ids))


def test_a_barrier_is_a_message_down_for_each_process_and_one_up(play: Play) -> None:
    bundles = play.work(grant("v01", "v03"), ("message", "v03", YIELD), ("message", "v01", YIELD))
    assert play.sides.down == [("v01", b"grant"), ("v03", b"grant")]
    assert bundles == [[("message", "v03", YIELD), ("message", "v01", YIELD)]]
    assert (play.host.grants, play.host.barriers) == (2, 1)


def test_last_messages_tokens_and_ends_go_at_once(play: Play) -> None:
    def end() -> None:
        play.launcher.ends = {"v03": Exit(-9, "its last line")}

    steps = [grant("v01", "v03"), ("message", "v01", YIELD), ("token", "v03", False), end, ("children", "", None)]
    assert play.work(*steps) == [  # type: ignore[arg-type]
        [("message", "v01", YIELD), ("token", "v03", False)],
        [("ended", "v03", 2, -9, "its last line", None)],
    ]


def test_a_process_that_is_not_there_is_not_waited_for(play: Play) -> None:
    bundles = play.work(orders(("kill", "v03")), grant("v01", "v03"), ("message", "v01", YIELD))
    assert bundles == [[("message", "v01", YIELD)]]
    assert ("kill", "v03") in play.launcher.done


def test_whoever_is_asked_for_stacks_does_not_keep_the_yields_of_others(
    play: Play, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(host_module, "STACKS_WRITTEN_S", 0.0)
    ask = orders(("to_node", "v03", b"stacks", False), ("signal", "v03", signal.SIGUSR1))
    bundles = play.work(grant("v01", "v03"), ("message", "v01", YIELD), ask)
    items = [item for bundle in bundles for item in bundle]
    assert items == [("message", "v01", YIELD), ("log_tail", "v03", "the log of v03")]
    assert ("SIGUSR1", "v03") in play.launcher.done


def test_only_signals_that_agents_know_are_sent(play: Play) -> None:
    play.work(*(orders(("signal", "v01", number)) for number in (signal.SIGTERM, signal.SIGSTOP)))
    assert [done for done in play.launcher.done if done[0].startswith("SIG")] == [("SIGSTOP", "v01")]


def test_a_process_that_cannot_be_started_has_ended(play: Play) -> None:
    play.launcher.failure = "cannot start the process of v01: no memory"
    assert play.work() == [
        [("ended", name, n, 1, play.launcher.failure, None) for name, n in (("v01", 1), ("v03", 2))]
    ]


def test_a_process_starts_again_once_the_one_before_has_gone(play: Play) -> None:
    again = orders(("detach", "v03", 1.0), ("start", ["v03"], [3], 0))
    play.work(again)
    assert play.launcher.done == [("start", "v01", "v02"), ("start", "v03"), ("wait for", "v03"), ("start", "v03")]


def test_at_the_end_everything_is_handed_in(play: Play) -> None:
    (play.folder.logs / "v01.log").write_text("hello\n")
    (play.folder.disks / "v02").mkdir(parents=True)
    (play.folder.disks / "v02" / "data").write_bytes(b"left")
    bundles = play.work(("message", "v01", FINAL), orders(("hand_in", 2.0)))
    assert ("stop", "2.0") in play.launcher.done
    items = [item for bundle in bundles for item in bundle]
    assert items[:4] == [
        ("message", "v01", FINAL),
        ("handing_in",),
        ("part", "log", "v01", "", b"hello\n"),
        ("part", "file", "v02", "data", b"left"),
    ]
    assert items[4][0] == "figures" and items[5:] == [("handed_in",)]


def test_orders_of_another_and_nonsense_change_nothing(play: Play, capsys: pytest.CaptureFixture[str]) -> None:
    play.work(orders(("kill", "v01"), nonce=b"2"), ("rx", "", b"nonsense"), orders(("to_node", "v09", b"x", False)))
    assert play.launcher.pids.keys() == {"v01", "v03"}
    assert "a message of the emulator is dropped" in capsys.readouterr().err


def test_without_the_emulator_agents_learn_it_and_the_host_ends(
    play: Play, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(host_module, "SHUT_DOWN_S", 0.0)
    with pytest.raises(TransportError, match="host a: the emulator has been gone for"):
        play.work(("emulator", "", False))
    assert play.sides.emulator == [False]


def test_an_absence_that_was_announced_is_waited_for(play: Play) -> None:
    play.work(orders(("be_patient", 3600.0)), ("emulator", "", False), ("emulator", "", True))
    assert play.sides.emulator == [False, True]
