"""`vnet view`: looking at runs, in a window where there is a display, else from a browser."""

from __future__ import annotations

import contextlib
import socket
import subprocess
from pathlib import Path
from typing import Annotated

import typer

from emulator.drivers.control import read_control_file
from emulator.records.run_files import check_is_run
from emulator.terminal.console import one_line_errors
from emulator.viewer.sinks import (
    RECORDING,
    has_display,
    is_closed,
    mend,
    place_to_serve,
    serve_file,
    viewer_command,
)
from vnet.errors import VnetError

RunArgument = Annotated[Path, typer.Argument(metavar="RUN", help="A run's folder.")]
RerunBindOption = Annotated[
    str | None, typer.Option(metavar="ADDRESS", help="Where to serve; the default is 127.0.0.1, this machine only.")
]
RerunPortOption = Annotated[
    int | None, typer.Option(help="Viewers connect here, browsers to the next port; by default 9876, if free.")
]
RerunVehicleOption = Annotated[
    str | None, typer.Option(metavar="ID", help="The vehicle that has a tab of its own; by default the first.")
]
LATEST = Path("runs/latest")


def view(
    run: RunArgument = LATEST,
    serve: Annotated[bool, typer.Option("--serve", help="Serve it even where there is a display.")] = False,
    rerun_bind: RerunBindOption = None,
    rerun_port: RerunPortOption = None,
) -> None:
    """Look at a run: opens its recording, or serves it until Ctrl-C; says where one that is on can be watched."""
    with one_line_errors():
        if _is_on(run):
            _tell_where(run)
            return
        check_is_run(run)
        recording = run / RECORDING
        if not recording.exists() or not recording.stat().st_size:
            raise VnetError(f"{run}: has no {RECORDING}: make one of its files with vnet render {run}")
        if not is_closed(recording):
            recording = mend(recording)
            print(f"the recording was not closed: what it has is in {recording}", flush=True)
        if has_display() and not serve and rerun_bind is None and rerun_port is None:
            with contextlib.suppress(KeyboardInterrupt):
                subprocess.run(viewer_command("--new", str(recording)))
            return
        place = place_to_serve(rerun_bind, rerun_port)
        print(f"serving {recording} until Ctrl-C\n{place.announcement()}", flush=True)
        serve_file(recording, place)


def _is_on(run: Path) -> bool:
    """Return whether a run is going on in this folder."""
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
