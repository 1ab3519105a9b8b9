"""`vnet view`, `vnet record` and `vnet render`: a run in Rerun, while it is on or from its files."""

from __future__ import annotations

import contextlib
import socket
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.progress import track

from emulator.cli.options import (
    LATEST,
    RerunBindOption,
    RerunOption,
    RerunPortOption,
    RerunVehicleOption,
    RunArgument,
)
from emulator.drivers.control import read_control_file
from emulator.records.run_folder import RECORDING, RunFolder, check_is_finished, check_is_run
from emulator.stream import Message, messages
from emulator.terminal.console import one_line_errors
from emulator.terminal.live import SafeConsole
from emulator.viewer.sinks import (
    Sinks,
    choose_sinks,
    has_display,
    is_closed,
    place_to_serve,
    repair,
    serve_file,
    viewer_command,
)
from vnet.errors import VnetError
from vnet.extras import require
from vnet.transport.access import OBSERVER
from vnet.transport.credentials import Credentials
from vnet.transport.keys import SEGMENTS, is_segment

if TYPE_CHECKING:
    from emulator.viewer.recorder import Recorder


def render(
    run: RunArgument = LATEST,
    out: Annotated[
        Path | None, typer.Option(help=f"The recording to write; the default is RUN/{RECORDING}.")
    ] = None,
    rerun_vehicle: RerunVehicleOption = None,
) -> None:
    """Rebuild a run's recording (and its report, where the recording is the run's own) from its files alone."""
    from emulator.report.source import Source
    from emulator.report.write import write_report  # slow to import

    with one_line_errors():
        require("vnet render", "rerun")
        played = messages(run)
        recording = out or run / RECORDING
        if not recording.parent.is_dir():
            raise VnetError(f"{recording}: there is no folder {recording.parent}")
        RunFolder(recording.parent).put(
            recording.name, lambda part: _write_recording(played, Sinks(part, vehicle=rerun_vehicle))
        )
        print(recording)
        if out is None:
            print(write_report(Source(run)))


def _write_recording(played: Iterator[Message], sinks: Sinks) -> None:
    stream, scene = next(played)
    with _recorder(sinks, scene["name"]) as recorder:
        recorder.take(stream, scene)
        console = SafeConsole(stderr=True)
        total = scene["duration_ns"] / scene["period_ns"]
        for stream, message in track(
            played, "drawing", total, console=console, transient=True, disable=not console.is_terminal
        ):
            recorder.take(stream, message)
        recorder.finish()


def _recorder(sinks: Sinks, name: str) -> Recorder:
    from emulator.viewer.recorder import Recorder

    return Recorder(sinks, name)


def view(
    run: RunArgument = LATEST,
    serve: Annotated[bool, typer.Option("--serve", help="Serve it even where there is a display.")] = False,
    png: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write a picture instead, which needs no display.")
    ] = None,
    rerun_bind: RerunBindOption = None,
    rerun_port: RerunPortOption = None,
) -> None:
    """Look at a run: opens its recording, or serves it until Ctrl-C; says where one that is on can be watched."""
    with one_line_errors():
        if png is not None:
            from emulator.report.picture import write_picture  # slow to import

            write_picture(run, png)
            print(png)
            return
        if _is_on(run):
            _tell_where(run)
            return
        check_is_run(run)
        recording = run / RECORDING
        if not recording.exists() or not recording.stat().st_size:
            check_is_finished(run)
            raise VnetError(f"{run}: has no {RECORDING}: make one of its files with vnet render {run}")
        require("vnet view", "rerun")
        if not is_closed(recording):
            recording = repair(recording)
            print(f"the recording was not closed: what it has is in {recording}", flush=True)
        if has_display() and not serve and rerun_bind is None and rerun_port is None:
            with contextlib.suppress(KeyboardInterrupt):
                subprocess.run(viewer_command("--new", str(recording)))
            return
        place = place_to_serve(rerun_bind, rerun_port)
        print(f"serving {recording} until Ctrl-C\n{place.announcement()}", flush=True)
        serve_file(recording, place)


def _is_on(run: Path) -> bool:
    """Return True if the run of this folder is on."""
    way = read_control_file(run)
    if way is None:
        return False
    host, _, port = way[0].partition("/")[2].rpartition(":")
    with contextlib.suppress(OSError), socket.create_connection((host.strip("[]"), int(port)), 2.0):
        return True
    return False  # it was killed


def _tell_where(run: Path) -> None:
    way = read_control_file(run)
    if way is None or way[2] is None:
        raise VnetError(f"{run}: the run is on, and is not served: only vnet run --rerun serve can be watched")
    print(f"the run is on\n{way[2].announcement()}")


def record(
    connect: Annotated[str, typer.Option(metavar="ENDPOINT", help="Of the emulator, or of its router.")],
    run: Annotated[str, typer.Option(metavar="NAME", help="The name of the run: run.name of its scenario.")],
    out: Annotated[Path, typer.Option(metavar="FILE", help="The recording to write.")] = Path("recording.rrd"),
    credentials: Annotated[
        Path | None, typer.Option(metavar="FILE", help="The observer's: access/credentials/observer.json.")
    ] = None,
    rerun: RerunOption = None,
    rerun_bind: RerunBindOption = None,
    rerun_port: RerunPortOption = None,
    rerun_vehicle: RerunVehicleOption = None,
) -> None:
    """Watch a run from outside and write a Rerun recording of it."""
    with one_line_errors():
        require("vnet record", "rerun")
        from emulator.viewer.watch import record_run  # Rerun is slow to import, and only this command needs it

        if not is_segment(run):
            raise VnetError(f"{run!r}: {SEGMENTS}")
        login = None if credentials is None else Credentials.load(credentials)
        if login is not None and login.user != OBSERVER:
            raise VnetError(f"credentials {credentials}: of the user {login.user}, and not of the {OBSERVER}")
        sinks = choose_sinks(rerun or ["save"], rerun_bind, rerun_port, rerun_vehicle)
        if sinks is None:
            raise VnetError("--rerun off: there is nothing to do")
        if sinks.serve is not None:
            print(sinks.serve.announcement(), file=sys.stderr, flush=True)
        record_run(connect, run, login, replace(sinks, save=out))
