"""Agents that are forked from a zygote: whose children they are, what they get, and a zygote that ends."""

import _posixsubprocess
import os
import signal
import socket
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import cast

import pytest

from emulator.drivers import launch as zygotes
from emulator.drivers.launch import MOST_ZYGOTES, Exit, ForkedProcess, Launcher, Zygote, ZygoteGoneError, can_fork
from tests.support.processes import has_ended, wait_until
from vnet.errors import VnetError
from vnet.runtime import forking
from vnet.transport.access import Access

pytestmark = pytest.mark.slow

MANY = [f"v{number:063d}" for number in range(1000)]
"""As many vehicles as a process may have, with ids as long as they may be."""
ACCESS = Access.create("town", [["v01"], ["v02"], ["v03", "v04"], MANY])
REFUSED = "tls/127.0.0.1:1"
"""An endpoint at which an agent without a certificate ends at once, with status 3."""
LINE = "vnet-agent: cannot connect to tls/127.0.0.1:1: the credentials have no certificate"


@pytest.fixture(scope="module")
def zygote() -> Iterator[Zygote]:
    zygote = Zygote(["agents.beacon", "tests.not_one_of_vnet"])
    zygote.start()
    yield zygote
    zygote.close()


@pytest.fixture
def launcher(zygote: Zygote, tmp_path: Path) -> Launcher:
    return Launcher(tmp_path, zygote=zygote)


@pytest.fixture
def silent() -> Iterator[str]:
    """An endpoint that accepts connections and says nothing: agents wait there for seconds."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield f"tcp/127.0.0.1:{server.getsockname()[1]}"


def end_of(launcher: Launcher, name: str) -> Exit:
    assert has_ended(launcher.pids[name], 60)
    return launcher.ended()[name]


def status_of(pid: int) -> dict[str, str]:
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return {name: value.strip() for name, _, value in (line.partition(":") for line in lines)}


def test_exit_statuses_and_logs_are_those_of_the_agents(launcher: Launcher) -> None:
    launcher.start_agents(REFUSED, ACCESS, [["v01"], ["v03", "v04"], MANY])
    assert all(has_ended(pid, 60) for pid in launcher.pids.values())
    assert launcher.ended() == {"v01": Exit(3, LINE), "v03": Exit(3, LINE), MANY[0]: Exit(3, LINE)}
    assert launcher.pids == {}


def test_an_agent_is_a_child_of_the_emulator_in_a_group_of_its_own(launcher: Launcher, silent: str) -> None:
    launcher.start_agents(silent, ACCESS, [["v01"], ["v02"]], nice=3)
    for name, pid in launcher.pids.items():
        assert status_of(pid)["PPid"] == str(os.getpid())
        assert os.getpriority(os.PRIO_PROCESS, pid) == os.getpriority(os.PRIO_PROCESS, 0) + 3
        assert os.getsid(pid) == os.getsid(0)
        launcher.signal(name, signal.SIGKILL)
        assert end_of(launcher, name).status == -signal.SIGKILL


def test_an_agent_is_waited_for_and_killed_like_any_child(launcher: Launcher, silent: str) -> None:
    launcher.start_agents(silent, ACCESS, [["v01"], ["v02"]])
    pids = list(launcher.pids.values())
    process = ForkedProcess(pids[0])
    with pytest.raises(subprocess.TimeoutExpired):
        process.wait(0.0)
    launcher.kill("v01")
    launcher.detach("v02")(0.0)
    assert launcher.pids == {}
    assert not [pid for pid in pids if Path(f"/proc/{pid}").exists()], "they have been reaped"


def test_the_zygote_has_no_thread_and_no_connection(zygote: Zygote, launcher: Launcher) -> None:
    launcher.start_agents(REFUSED, ACCESS, [["v01"]])
    assert status_of(zygote.pid or 0)["Threads"] == "1"
    links = [str(path.readlink()) for path in Path(f"/proc/{zygote.pid}/fd").iterdir()]
    assert len([link for link in links if link.startswith("socket:")]) == 1, "to the emulator"
    assert [link for link in links if link.startswith("pipe:")] == [], "credentials of an agent"
    end_of(launcher, "v01")


def test_what_a_program_imports_when_first_asked_for_is_imported_before_agents_are_forked() -> None:
    with closing(Zygote(["agents.cooperative"])) as zygote:
        zygote.start()
        wait_until(zygote.is_ready)
        assert "/osqp" in Path(f"/proc/{zygote.pid}/maps").read_text()


def test_an_agent_that_gets_no_credentials_ends_and_does_nothing(zygote: Zygote, tmp_path: Path) -> None:
    """So none is there twice if a zygote ends before it has answered."""
    read_end, write_end = os.pipe()
    with (tmp_path / "log").open("wb") as log:
        reply = zygote.fork(
            forking.ForkRequest([["--connect", REFUSED, "--run", "town", "--node", "v01"]]),
            [read_end, log.fileno()],
        )
    os.close(read_end)
    (pid,) = reply.pids
    process = ForkedProcess(pid)
    assert process.poll() is None
    os.close(write_end)
    assert process.wait(60) == 0
    assert (tmp_path / "log").read_bytes() == b""


def test_a_zygote_that_is_gone_is_started_again_and_its_agents_go_on(
    zygote: Zygote, launcher: Launcher, silent: str
) -> None:
    launcher.start_agents(silent, ACCESS, [["v01"]])
    pid = launcher.pids["v01"]
    former = zygote.pid or 0
    os.kill(former, signal.SIGKILL)
    assert has_ended(former, 60)
    launcher.start_agents(REFUSED, ACCESS, [["v02"]])  # finds out by itself
    assert zygote.pid not in (None, former)
    assert end_of(launcher, "v02").status == 3
    former = zygote.pid or 0
    os.kill(former, signal.SIGKILL)
    assert has_ended(former, 60)
    assert launcher.ended() == {}  # a child has ended, and v01 has not
    assert zygote.pid != former
    assert status_of(pid)["PPid"] == str(os.getpid())
    launcher.kill("v01")


def test_orphans_are_adopted_only_while_a_zygote_is_in_use(launcher: Launcher) -> None:
    def adopts() -> bool:
        command = ["sh", "-c", "sleep 60 >/dev/null 2>&1 & echo $!"]
        child = subprocess.run(command, capture_output=True, text=True, check=True)
        orphan = int(child.stdout)
        parent = status_of(orphan)["PPid"]
        os.kill(orphan, signal.SIGKILL)
        if parent == str(os.getpid()):
            os.waitpid(orphan, 0)
            return True
        return False

    assert adopts()
    other = Zygote([])
    other.start()
    other.close()
    assert adopts(), "another one is in use still"


class Failing(Zygote):
    """A zygote that answers with what it is given."""

    def __init__(self, answers: Sequence[forking.ForkReply | None]) -> None:
        super().__init__([])
        self.answers = list(answers)
        self.starts = 0

    def start(self) -> None:
        self.starts += 1

    def fork(self, request: forking.ForkRequest, descriptors: Sequence[int]) -> forking.ForkReply:
        answer = self.answers.pop(0)
        if answer is None:
            raise ZygoteGoneError("AssertionError: it has threads")
        return answer


def test_a_system_without_room_for_more_processes_is_one_line(tmp_path: Path) -> None:
    launcher = Launcher(tmp_path, zygote=Failing([forking.ForkReply([], "Resource temporarily unavailable")]))
    with pytest.raises(VnetError, match="cannot start the process of v01: Resource temporarily unavailable"):
        launcher.start_agents(REFUSED, ACCESS, [["v01"]])


def test_zygotes_that_never_stay_are_one_line(tmp_path: Path) -> None:
    failing = Failing([None] * MOST_ZYGOTES)
    with pytest.raises(VnetError, match=r"process of v01: 3 zygotes in a row have ended: .*: it has threads"):
        Launcher(tmp_path, zygote=failing).start_agents(REFUSED, ACCESS, [["v01"]])
    assert failing.starts == MOST_ZYGOTES


def test_a_zygote_that_ends_when_it_is_asked_says_why() -> None:
    with closing(Zygote([])) as zygote:
        zygote.start()
        wait_until(zygote.is_ready)
        with pytest.raises(ZygoteGoneError, match=r"^msgspec\.\w+Error: "):
            zygote.fork(cast("forking.ForkRequest", forking.ForkReply([], "")), [])


def test_no_agent_is_forked_where_a_debugger_follows_new_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    """It starts itself in each, with threads, and may only stop in agents that are interpreters of their own."""
    assert can_fork()
    start = _posixsubprocess.fork_exec
    monkeypatch.setattr("_posixsubprocess.fork_exec", lambda *arguments: start(*arguments))
    assert not can_fork()


def test_a_zygote_that_cannot_import_says_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "agents.py").touch()
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    zygote = Zygote([])
    with closing(zygote):
        zygote.start()
        assert has_ended(zygote.pid or 0, 60)
        with pytest.raises(VnetError, match=r"ended before the start \(status 1\): .*'agents.zygote'"):
            zygote.is_ready()


def test_a_zygote_that_does_not_answer_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(zygotes, "START_TIMEOUT_S", 0.001)
    zygote = Zygote([])
    with closing(zygote):
        zygote.start()
        with pytest.raises(VnetError, match=r"does not answer within 0\.001 s"):
            zygote.fork(forking.ForkRequest([]), [])


def test_requests_hold_what_a_packet_holds() -> None:
    small = {f"v{number}": ["--node", f"v{number}"] for number in range(120)}
    assert [len(names) for names in forking.split(small)] == [50, 50, 20]
    large = {f"v{number}": ["x" * 70_000] for number in range(3)}
    assert list(forking.split(large)) == [["v0", "v1"], ["v2"]]
    assert list(forking.split({})) == []
