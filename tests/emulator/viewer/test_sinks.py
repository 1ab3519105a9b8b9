"""Destinations of recordings: what may be chosen, what is listened at, and that all sinks get everything."""

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import rerun as rr

from emulator.viewer import sinks as sinks_module
from emulator.viewer.recorder import Recorder
from emulator.viewer.sinks import (
    Sinks,
    choose_sinks,
    is_closed,
    open_recording,
    place_to_serve,
    repair,
    repair_command,
    viewer_command,
)
from emulator.viewer.watch import Inbox, _record_all, _Taker
from tests.support.paths import ROOT
from tests.support.recordings import descendants, listening_addresses, read_back, rrd
from vnet.errors import TransportError, VnetError
from vnet.transport import wire

TIMEOUT_S = 60


@contextmanager
def listening(port: int = 0) -> Iterator[int]:
    """Something that listens at a port of the loopback interface."""
    with socket.create_server(("127.0.0.1", port)) as server:
        yield server.getsockname()[1]


def wait_for(condition: object) -> None:
    deadline = time.monotonic() + TIMEOUT_S
    while not condition():  # type: ignore[operator]
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_what_may_be_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DISPLAY", ":0")
    assert choose_sinks([]) is None
    assert choose_sinks(["off"]) is None
    assert choose_sinks(["save"]) == Sinks(Path("recording.rrd"))
    served = choose_sinks(["serve"])
    assert served is not None
    assert (served.save, served.spawn) == (Path("recording.rrd"), False)
    assert served.serve is not None
    assert served.serve.address == "127.0.0.1"
    spawned = choose_sinks(["save,spawn", "serve"], vehicle="v02")
    assert spawned is not None
    assert (spawned.save, spawned.spawn, spawned.vehicle) == (Path("recording.rrd"), True, "v02")
    assert spawned.serve is not None
    assert spawned.inside(Path("runs/x")).save == Path("runs/x/recording.rrd")


def test_a_port_that_is_taken_is_passed_by_or_said() -> None:
    with listening() as port, pytest.raises(VnetError, match=f"--rerun-port {port}: .*already in use"):
        place_to_serve(port=port)
    first = place_to_serve()
    with listening(first.port + 1):
        assert place_to_serve().port > first.port


@pytest.mark.slow
def test_two_processes_do_not_choose_the_same_port() -> None:
    program = "from emulator.viewer.sinks import place_to_serve; print(place_to_serve().port)"
    own = place_to_serve().port
    other = subprocess.run([sys.executable, "-P", "-c", program], capture_output=True, text=True, check=True)
    assert int(other.stdout) not in (own, own + 1)
    assert place_to_serve().port == own  # nobody listens there yet


def test_a_port_that_another_program_took_in_between_is_said_in_one_line() -> None:
    place = place_to_serve()
    with (
        listening(place.port),
        pytest.raises(VnetError, match=f"^--rerun-port {place.port}: cannot listen at 127.0.0.1 any more"),
        open_recording(Sinks(serve=place), "late"),
    ):
        raise AssertionError("it was opened")


def draw(recording: rr.RecordingStream, count: int) -> None:
    for number in range(count):
        recording.set_time("emulated time", duration=number)
        recording.log("line", rr.Scalars(number))


@pytest.mark.slow
def test_all_sinks_get_everything_and_none_listens_beyond_the_loopback_interface(tmp_path: Path) -> None:
    place = place_to_serve()
    with open_recording(Sinks(tmp_path / "saved.rrd", place), "both") as recording:
        draw(recording, 5)
        recording.flush(timeout_sec=TIMEOUT_S)
        # someone who comes when it has begun
        command = viewer_command("--port", "auto", "--save", str(tmp_path / "served.rrd"), "--connect", place.url)
        viewer = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            wait_for(lambda: _numbers(tmp_path / "served.rrd"))
            draw(recording, 50)
            recording.flush(timeout_sec=TIMEOUT_S)
            wait_for(lambda: len(_numbers(tmp_path / "served.rrd")) == 50)
            wait_for(lambda: f"127.0.0.1:{place.web_port}" in everything_of_ours())
            mine = everything_of_ours()
        finally:
            viewer.kill()
            viewer.wait()
    assert {f"127.0.0.1:{place.port}", f"127.0.0.1:{place.web_port}"} <= mine
    assert {address for address in mine if not address.startswith("127.0.0.1:")} == set()
    assert _numbers(tmp_path / "saved.rrd") == {float(number): [float(number)] for number in range(50)}
    assert _numbers(tmp_path / "served.rrd") == _numbers(tmp_path / "saved.rrd")
    wait_for(lambda: not everything_of_ours() & mine)  # nothing is left that listens
    assert is_closed(tmp_path / "saved.rrd")


def everything_of_ours() -> set[str]:
    found = set()
    for pid in descendants(os.getpid()):
        try:
            found |= listening_addresses(pid)
        except OSError:
            continue
    return found


def _numbers(path: Path) -> dict[float, list[float]]:
    """Return what has been drawn so far; none while the last message is half written or the file is not there."""
    try:
        drawn = read_back(path)
    except (ValueError, RuntimeError):
        return {}
    return dict(drawn["/line"].at["Scalars:scalars"]) if "/line" in drawn else {}


@pytest.mark.slow
def test_a_viewer_is_opened_on_what_is_served_and_outlives_the_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    noted = tmp_path / "noted"
    noting = "import pathlib, sys; pathlib.Path(sys.argv[1]).write_text(' '.join(sys.argv[2:]))"

    def command(*arguments: str, bind: str = "127.0.0.1") -> list[str]:
        name = "web" if "--serve-web" in arguments else "native"
        return [sys.executable, "-c", noting, f"{noted}-{name}", "--bind", bind, *arguments]

    monkeypatch.setattr(sinks_module, "viewer_command", command)
    place = place_to_serve()
    with open_recording(Sinks(serve=place, spawn=True), "spawned"):
        wait_for(Path(f"{noted}-native").exists)
        wait_for(Path(f"{noted}-web").exists)
    wait_for(lambda: Path(f"{noted}-native").read_text() != "")
    assert Path(f"{noted}-native").read_text().startswith(f"--bind 127.0.0.1 --connect {place.url} ")
    assert Path(f"{noted}-web").read_text().startswith("--bind 127.0.0.1 --serve-web ")


KILLED = """
import os, signal, sys
from pathlib import Path
import rerun as rr
from emulator.viewer.sinks import Sinks, open_recording
with open_recording(Sinks(Path(sys.argv[1])), "killed") as recording:
    for number in range(200):
        recording.set_time("emulated time", duration=number)
        recording.log("line", rr.Scalars(number))
        if number % 20 == 0:
            recording.flush(timeout_sec=60)
    recording.flush(timeout_sec=60)
    os.kill(os.getpid(), signal.SIGKILL)
"""


ON_A_FULL_DISK = """
import resource, sys
from pathlib import Path
import rerun as rr
from emulator.viewer import sinks
sinks.CLOSE_TIMEOUT_S = 0.5
with sinks.open_recording(sinks.Sinks(Path(sys.argv[1])), "full") as recording:
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, 10_000))
    for number in range(100):
        recording.log(f"a{number}", rr.TextLog(1000 * "a"))
"""


@pytest.mark.slow
def test_a_recording_that_cannot_be_written_any_more_says_so_and_ends(tmp_path: Path) -> None:
    path = tmp_path / "full.rrd"
    command = [sys.executable, "-c", ON_A_FULL_DISK, str(path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=TIMEOUT_S)
    assert done.returncode == 0
    assert f"vnet: {path}: cannot write the recording: " in done.stderr


RECORDED_ON_A_FULL_DISK = """
import resource, sys
from contextlib import nullcontext
from pathlib import Path
from unittest.mock import MagicMock
import rerun as rr
from emulator.viewer import sinks, watch
from vnet.errors import VnetError
sinks.CLOSE_TIMEOUT_S = 0.5
watch.open_client = lambda *_: nullcontext(MagicMock())
def draw(inbox, recorder, run):
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, 10_000))
    for number in range(100):
        recorder._recording.log(f"a{number}", rr.TextLog(1000 * "a"))
watch._record_all = draw
try:
    watch.record_run("tcp/127.0.0.1:1", "run", None, sinks.Sinks(Path(sys.argv[1])))
except VnetError as error:
    sys.exit(f"failed: {error}")
"""


@pytest.mark.slow
def test_who_records_a_run_is_told_that_the_recording_could_not_be_written(tmp_path: Path) -> None:
    command = [sys.executable, "-c", RECORDED_ON_A_FULL_DISK, str(tmp_path / "full.rrd")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=TIMEOUT_S)
    assert done.returncode == 1, done.stderr
    assert f"failed: {tmp_path}/full.rrd: cannot write the recording: " in done.stderr


@pytest.mark.slow
def test_a_recording_whose_writer_was_killed_can_be_read_and_repaired(tmp_path: Path) -> None:
    path = tmp_path / "torn.rrd"
    done = subprocess.run([sys.executable, "-c", KILLED, str(path)], cwd=ROOT)
    assert done.returncode == -9
    assert not is_closed(path)
    with path.open("r+b") as file:
        file.truncate(path.stat().st_size - 7)  # a write that was cut short
    program, *arguments = repair_command(path).split()
    assert program == "rerun"
    assert rrd(*arguments[1:]).returncode == 0
    repaired = path.with_name("torn-repaired.rrd")
    assert is_closed(repaired)
    assert rrd("verify", str(repaired)).returncode == 0
    assert len(_numbers(repaired)) >= 180


@pytest.mark.slow
@pytest.mark.parametrize("left", [20, 100, 150, 600, 1400])
def test_a_recording_of_nothing_but_its_name_is_not_shown(tmp_path: Path, left: int) -> None:
    path = tmp_path / "recording.rrd"
    with open_recording(Sinks(path), "cut") as recording:
        draw(recording, 5)
    assert path.stat().st_size > 3000
    with path.open("r+b") as file:
        file.truncate(left)
    with pytest.raises(VnetError, match=f"nothing in it: vnet render {tmp_path} rebuilds it"):
        repair(path)
    assert list(tmp_path.iterdir()) == [path]


def all_of(inbox: Inbox) -> list[tuple[str, bytes]]:
    return [inbox.take() for _ in range(inbox.gather(0))]


def test_an_inbox_is_bounded_and_counts_what_it_drops() -> None:
    inbox = Inbox(limit_bytes=100)
    for number in range(10):
        inbox.put("period", bytes([number]) * 30)
    inbox.put("end")
    assert inbox.dropped == 7
    assert all_of(inbox) == [*(("period", bytes([number]) * 30) for number in range(3)), ("end", b"")]
    assert all_of(inbox) == []
    inbox.put("period", b"x" * 100)
    assert all_of(inbox) == [("period", b"x" * 100)]


FOR_EVER_S = 2 * TIMEOUT_S


@pytest.mark.parametrize("urgent", [("end", b""), ("scene", b"s"), ("lost", b""), ("period", b"x" * 60)])
def test_an_inbox_gathers_periods_until_something_comes_that_must_not_wait(urgent: tuple[str, bytes]) -> None:
    inbox = Inbox(limit_bytes=100)
    with ThreadPoolExecutor() as pool:
        gathered = pool.submit(inbox.gather, None, FOR_EVER_S)
        for _ in range(3):
            inbox.put("period", b"a")
        inbox.put(*urgent)
        assert gathered.result(TIMEOUT_S) == 4
    assert all_of(inbox) == [*[("period", b"a")] * 3, urgent]
    inbox.put("period", b"b")
    assert inbox.gather(0, 0.0) == 1, "what was urgent is no longer"


@pytest.mark.parametrize("waiting", [0, 3])
def test_an_inbox_that_is_closed_waits_for_nothing(waiting: int) -> None:
    inbox = Inbox()
    for _ in range(waiting):
        inbox.put("period", b"a")
    with ThreadPoolExecutor() as pool:
        gathered = pool.submit(inbox.gather, None, FOR_EVER_S)
        inbox.close()
        assert gathered.result(TIMEOUT_S) == waiting


class Drawn(Recorder):
    """Notes what it has drawn, and is ended by a signal when it takes a period for the third time."""

    def __init__(self, inbox: Inbox) -> None:
        self.missed = 0
        self.taken: list[int] = []
        self.drawn: list[int] = []
        self._inbox = inbox

    def take(self, stream: str, message: Mapping[str, Any]) -> None:
        self.taken.append(message["period"])
        if len(self.taken) == 3:
            signal.raise_signal(signal.SIGTERM)

    def draw(self) -> None:
        self.drawn = self.taken.copy()


def test_what_waits_is_drawn_by_an_observer_that_a_signal_ends() -> None:
    inbox = Inbox()
    recorder = Drawn(inbox)
    for number in range(5):
        inbox.put("period", wire.encode_observation({"period": number}))
    before = signal.signal(signal.SIGTERM, lambda *_: inbox.close())
    try:
        _record_all(inbox, recorder, "run")
    finally:
        signal.signal(signal.SIGTERM, before)
    assert recorder.drawn == [0, 1, 2, 3, 4]


def test_what_a_lost_emulator_said_last_does_not_make_it_be_waited_for() -> None:
    inbox = Inbox()
    recorder = Drawn(inbox)
    taker = _Taker(inbox, recorder)
    period = ("period", wire.encode_observation({"period": 1}))
    for stream, data, is_there in (("lost", b"", False), (*period, False), ("found", b"", True), (*period, True)):
        inbox.put(stream, data)
        taker.take(inbox.gather(0))
        assert (taker.left_s is None) == is_there, stream
    assert recorder.drawn == [1, 1]


def test_an_emulator_that_never_comes_is_not_awaited_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    recorder = Drawn(Inbox())
    assert _Taker(Inbox(), recorder).left_s is not None
    monkeypatch.setattr("emulator.viewer.watch.FIRST_SIGN_S", 0.0)
    with pytest.raises(TransportError, match=r"^run nobody: .* is it running"):
        _record_all(Inbox(), recorder, "nobody")
    inbox = Inbox()
    inbox.close()
    with pytest.raises(KeyboardInterrupt):  # which a script must not take for a recording
        _record_all(inbox, recorder, "nobody")
