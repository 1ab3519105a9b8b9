"""Destinations of a recording: a file, a server for viewers elsewhere, a window on this machine.

Nothing of it listens on more than the loopback interface unless that is asked for. A slow or stopped viewer
holds nothing up: what waits for it is bounded, and it is dropped when it no longer answers.
"""

from __future__ import annotations

import contextlib
import ctypes
import importlib.util
import ipaddress
import os
import shlex
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

from emulator.records.run_folder import RECORDING, check_is_finished
from vnet.errors import VnetError
from vnet.extras import require
from vnet.runtime.die_with_parent import TIED

if TYPE_CHECKING:  # Rerun is slow to import, and only those who open a recording need it
    import rerun

CHOICES = ("spawn", "serve", "save", "off")
LOOPBACK = "127.0.0.1"
DEFAULT_PORT = 9876
PORTS_TRIED = 50
SERVER_MEMORY = "256MiB"
"""Memory of the server for viewers that come late; the oldest data go first, static data stay."""
VIEWER_MEMORY = "2GiB"
CLOSE_TIMEOUT_S = 10.0
_END_OF_A_CLOSED_FILE = b"RRF2FOOT"
_ITS_NAME = "/__properties"


@dataclass(frozen=True)
class ServeAt:
    """Address of a served recording: viewers connect to `port` of `address`, browsers to the next port."""

    address: str = LOOPBACK
    port: int = DEFAULT_PORT

    @property
    def web_port(self) -> int:
        """URL of the viewer for browsers."""
        return self.port + 1

    @property
    def host(self) -> str:
        """Name of this machine for others, as it stands in a URL."""
        address = ipaddress.ip_address(self.address)
        if address.is_unspecified:
            return socket.gethostname()
        return f"[{self.address}]" if address.version == 6 else self.address

    @property
    def url(self) -> str:
        """For the native viewer."""
        return f"rerun+http://{self.host}:{self.port}/proxy"

    @property
    def web_url(self) -> str:
        """For a browser."""
        return f"http://{self.host}:{self.web_port}/?url={quote(self.url, safe='')}"

    @property
    def origin(self) -> str:
        """The pages that may read what is served, as a pattern."""
        host = "*" if ipaddress.ip_address(self.address).is_unspecified else self.host
        return f"http://{host}:{self.web_port}"

    def announcement(self) -> str:
        """Both addresses, for people; with a warning where others than this machine can reach them."""
        text = f"viewer: rerun --connect {self.url}\nbrowser: {self.web_url}"
        if not ipaddress.ip_address(self.address).is_loopback:
            text += f"\nwhoever can reach port {self.port} of this machine can watch"
        return text


@dataclass(frozen=True)
class Sinks:
    """Destinations of a recording: `save` into a file, `serve` to viewers, `spawn` a viewer on this machine.

    A spawned viewer looks at what is served. `vehicle` is the one that is looked at closely, by default the first.
    """

    save: Path | None = None
    serve: ServeAt | None = None
    spawn: bool = False
    vehicle: str | None = None

    def inside(self, folder: Path) -> Sinks:
        """The same, saved in a run's folder."""
        return self if self.save is None else replace(self, save=folder / self.save)

    @property
    def arguments(self) -> list[str]:
        """These sinks as options of `vnet record`."""
        words = [] if self.vehicle is None else ["--rerun-vehicle", self.vehicle]
        if self.serve is not None:
            words += ["--rerun", "spawn" if self.spawn else "serve"]
            words += ["--rerun-bind", self.serve.address, "--rerun-port", str(self.serve.port)]
        return words


def choose_sinks(
    words: Sequence[str],
    address: str | None = None,
    port: int | None = None,
    vehicle: str | None = None,
    live: bool = True,
) -> Sinks | None:
    """Return the sinks that `--rerun` and its companions ask for; None for nothing. Saved as `recording.rrd`.

    Raises VnetError for what is not among the choices (or cannot be had of what is not `live`), where there is no
    display for `spawn`, and where `address` and `port` cannot be listened at; without `port` the first that is
    free is taken.
    """
    chosen = _chosen(words)
    served = "serve" in chosen or "spawn" in chosen
    if served and not live:
        raise VnetError(
            f"--rerun {','.join(chosen)}: a simulation is not watched: save it, and look at it with vnet view"
        )
    if "spawn" in chosen and not has_display():
        raise VnetError(
            "--rerun spawn: there is no display here (neither DISPLAY nor WAYLAND_DISPLAY is set); "
            "use --rerun serve, and look from a browser"
        )
    if not served and (address is not None or port is not None):
        raise VnetError("--rerun-bind and --rerun-port are for --rerun serve")
    if not chosen:
        return None
    require(f"--rerun {','.join(chosen)}", "rerun")
    place = place_to_serve(address, port) if served else None
    return Sinks(Path(RECORDING), place, "spawn" in chosen, vehicle)


def _chosen(words: Sequence[str]) -> list[str]:
    """Split values that may be repeated or separated by commas; empty for `off`."""
    chosen = [word.strip() for several in words for word in several.split(",")]
    for word in chosen:
        if word not in CHOICES:
            raise VnetError(f"--rerun {word}: one or more of {', '.join(CHOICES)} are allowed")
    if "off" not in chosen:
        return chosen
    if set(chosen) != {"off"}:
        raise VnetError(f"--rerun {','.join(chosen)}: off excludes the others")
    return []


def place_to_serve(address: str | None = None, port: int | None = None) -> ServeAt:
    """Return the address at which a recording can be served; see `choose_sinks`. Raises VnetError."""
    address = address or LOOPBACK
    try:
        ipaddress.ip_address(address)
    except ValueError:
        raise VnetError(
            f"--rerun-bind {address}: an IP address of this machine is wanted (0.0.0.0 for all)"
        ) from None
    wanted = range(DEFAULT_PORT, DEFAULT_PORT + 2 * PORTS_TRIED, 2) if port is None else [port]
    reason = ""
    for first in wanted:
        reason = _why_not(address, first) or _why_not(address, first + 1)
        if not reason and (port is not None or _reserve(address, first)):
            return ServeAt(address, first)
    raise VnetError(
        f"--rerun-port {wanted[-1]}: cannot listen at {address}, this port and the next: "
        f"{reason or 'other commands of vnet are about to serve there'}"
    )


_reserved: set[tuple[str, int]] = set()
"""Addresses and ports that this process has chosen by itself, until it ends."""


def _reserve(address: str, port: int) -> bool:
    """Keep other commands from choosing this port before it is listened at; False if one has chosen it.

    What marks it is the UDP port of the same number, which nobody else needs and the system frees.
    """
    if (address, port) not in _reserved:
        mark = socket.socket(socket.AF_INET6 if ":" in address else socket.AF_INET, socket.SOCK_DGRAM)
        try:
            mark.bind((address, port))
        except OSError:
            mark.close()
            return False
        mark.detach()  # open until this process ends
        _reserved.add((address, port))
    return True


def _why_not(address: str, port: int) -> str:
    """Why this port cannot be listened at; empty if it can."""
    if not 0 < port < 65536:
        return f"{port} is no port"
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    try:
        with socket.socket(family) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((address, port))
            probe.listen()
    except OSError as error:
        return error.strerror or str(error)
    return ""


def has_display() -> bool:
    """Return True if a window can be opened on this machine."""
    if sys.platform in ("darwin", "win32"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


@contextmanager
def open_recording(sinks: Sinks, name: str) -> Iterator[rerun.RecordingStream]:
    """A recording called `name` that goes to all of `sinks`; closed cleanly at the end of the block.

    The server of web pages ends with it; a spawned viewer stays, it is the user's. Raises VnetError if the file
    cannot be written, or another program listens at the port by now.
    """
    import rerun

    with ExitStack() as stack:
        recording = rerun.RecordingStream("vnet", recording_id=os.urandom(16).hex())
        try:
            recording.set_sinks(*_rerun_sinks(sinks))
        except RuntimeError as error:
            raise VnetError(f"{sinks.save}: cannot write the recording: {error}") from None
        recording.set_log_time_enabled(False)  # emulated time is all that counts
        stack.callback(_finish, recording, sinks)
        recording.send_recording_name(name)
        if sinks.serve is not None:
            _wait_until_served(recording, sinks.serve)
            stack.enter_context(_looked_at(sinks.serve, sinks.spawn))
        yield recording


_broken: list[rerun.RecordingStream] = []
"""Recordings that could not be written: to disconnect one, or to forget it, would wait for ever."""


def written(recording: rerun.RecordingStream, sinks: Sinks) -> None:
    """Wait until what has been recorded is where it goes. Raises VnetError if it cannot be written."""
    import rerun

    try:
        recording.flush(timeout_sec=CLOSE_TIMEOUT_S)
    except RuntimeError as error:
        _broken.append(recording)
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(recording.inner))  # not forgotten at the process's end, either
        rerun.unregister_shutdown()
        raise VnetError(f"{sinks.save or 'Rerun'}: cannot write the recording: {error}") from None


def _finish(recording: rerun.RecordingStream, sinks: Sinks) -> None:
    """Write the rest of a recording; where that fails, say so, because the run's other files are worth keeping."""
    if any(recording is broken for broken in _broken):
        return
    try:
        written(recording, sinks)
    except VnetError as error:
        print(f"vnet: {error}", file=sys.stderr)
    else:
        recording.disconnect()


def _wait_until_served(recording: rerun.RecordingStream, place: ServeAt) -> None:
    """Raise VnetError if Rerun's server could not listen, which it tells to whom next waits for it alone."""
    try:
        recording.flush(timeout_sec=CLOSE_TIMEOUT_S)
    except RuntimeError as error:
        raise VnetError(f"--rerun-port {place.port}: cannot listen at {place.address} any more: {error}") from None


def _rerun_sinks(sinks: Sinks) -> Iterator[rerun.FileSink | rerun.GrpcServerSink]:
    import rerun

    if sinks.save is not None:
        yield rerun.FileSink(sinks.save)
    if sinks.serve is not None:
        yield rerun.GrpcServerSink(
            bind_ip=sinks.serve.address,
            port=sinks.serve.port,
            server_memory_limit=SERVER_MEMORY,
            cors_allow_origin=[sinks.serve.origin],
        )


_outliving: list[subprocess.Popen[bytes]] = []
"""Viewers that stay open after the recording, and after this process: kept here, as nobody waits for their end."""


@contextmanager
def _looked_at(place: ServeAt, spawn: bool) -> Iterator[None]:
    """The web viewer for as long as the block lasts, and a native one if `spawn`."""
    if spawn:
        local = replace(place, address=LOOPBACK) if ipaddress.ip_address(place.address).is_unspecified else place
        native = viewer_command("--connect", local.url, "--memory-limit", VIEWER_MEMORY, "--hide-welcome-screen")
        _outliving.append(subprocess.Popen(native, stdin=subprocess.DEVNULL, start_new_session=True))
    pages = viewer_command(
        *("--serve-web", "--web-viewer-port", str(place.web_port), place.url), bind=place.address
    )
    with _running(pages):
        yield


def viewer_command(*arguments: str, bind: str = LOOPBACK) -> list[str]:
    """Rerun's own program with these arguments; what it listens at by itself is bound to `bind`."""
    return [_program(), "--bind", bind, *arguments]


def _program() -> str:
    """Rerun's own program. Its Python front end is passed by: ended by a signal, that would leave it behind."""
    spec = importlib.util.find_spec("rerun_cli")
    assert spec is not None and spec.submodule_search_locations, "rerun-sdk brings rerun_cli along"
    folder = Path(spec.submodule_search_locations[0])
    bundled = folder / "Rerun.app" / "Contents" / "MacOS" / "Rerun"
    return str(bundled if bundled.exists() else folder / "rerun")


def serve_file(path: Path, place: ServeAt) -> None:
    """Serve a finished recording until Ctrl-C or SIGTERM."""
    ports = ("--port", str(place.port), "--web-viewer-port", str(place.web_port))
    origin = ("--cors-allow-origin", place.origin)
    command = viewer_command("--serve-web", *ports, *origin, str(path), bind=place.address)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with contextlib.suppress(KeyboardInterrupt), _running(command) as served:
        served.wait()


@contextmanager
def _running(command: Sequence[str]) -> Iterator[subprocess.Popen[bytes]]:
    """A command for as long as the block lasts; of Rerun's only warnings are seen. Ctrl-C does not reach it."""
    process = subprocess.Popen(
        [*TIED, *command],
        stdin=subprocess.DEVNULL,
        env={**os.environ, "RUST_LOG": "warn"},
        start_new_session=True,
    )
    try:
        yield process
    finally:
        process.terminate()
        try:
            process.wait(CLOSE_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def is_closed(path: Path) -> bool:
    """Return True if a recording was closed cleanly; the viewer opens no other."""
    with path.open("rb") as file:
        file.seek(0, os.SEEK_END)
        file.seek(max(0, file.tell() - 16))
        return _END_OF_A_CLOSED_FILE in file.read()


def repaired_path(path: Path) -> Path:
    """Path of the repaired copy of a recording that was not closed."""
    return path.with_name(f"{path.stem}-repaired{path.suffix}")


def repair_command(path: Path) -> str:
    """Command that repairs a recording that was not closed, as one types it."""
    return f"rerun {shlex.join(_mending(path))}"


def repair(path: Path) -> Path:
    """Make a whole recording of one that was not closed, and return where it is.

    Raises VnetError if it cannot be repaired, or there is nothing in it.
    """
    done = subprocess.run([_program(), *_mending(path)], capture_output=True, text=True)
    if done.returncode:
        last = (done.stderr.strip() or "nothing was said").splitlines()[-1]
        raise VnetError(f"{path}: was not closed, and cannot be repaired: {last}")
    repaired = repaired_path(path)
    if _is_empty(repaired):
        repaired.unlink()
        check_is_finished(path.parent)
        raise VnetError(
            f"{path}: was not closed, and there is nothing in it: vnet render {path.parent} rebuilds it"
        )
    return repaired


def _is_empty(path: Path) -> bool:
    """Return True if a closed recording holds nothing but its name."""
    from rerun.chunk import RrdReader

    reader = RrdReader(str(path))
    if not reader.recordings():
        return True
    return all(str(chunk.entity_path).startswith(_ITS_NAME) for chunk in reader.stream())


def _mending(path: Path) -> list[str]:
    return ["rrd", "optimize", "--continue-on-error", str(path), "-o", str(repaired_path(path))]
