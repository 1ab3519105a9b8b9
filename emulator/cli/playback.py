"""`vnet render` and `vnet play`: a finished run, drawn again from its files alone."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.progress import track

from emulator.cli.options import LATEST, RerunBindOption, RerunPortOption, RerunVehicleOption, RunArgument
from emulator.records.run_folder import RECORDING, RunFolder
from emulator.stream.playback import Message, messages, schedule
from emulator.stream.playback import play as play_scheduled
from emulator.terminal.console import one_line_errors
from emulator.terminal.safe_console import SafeConsole
from emulator.viewer.sinks import Sinks, has_display, place_to_serve
from vnet.errors import VnetError
from vnet.units import NS_PER_S

SEEN_APART_S = 0.2
"""Periods that are so far apart are shown each when it is due; closer ones some at a time, which costs less."""

if TYPE_CHECKING:  # Rerun is slow to import, and only those who draw need it
    from emulator.viewer.recorder import Recorder


def render(
    run: RunArgument = LATEST,
    out: Annotated[
        Path | None, typer.Option(help=f"The recording to write; the default is RUN/{RECORDING}.")
    ] = None,
    rerun_vehicle: RerunVehicleOption = None,
) -> None:
    """Rebuild a run's recording (and its report, where the recording is the run's own) from its files alone."""
    from emulator.report.write import write_report  # matplotlib is slow to import

    with one_line_errors():
        played = messages(run)
        recording = out or run / RECORDING
        if not recording.parent.is_dir():
            raise VnetError(f"{recording}: there is no folder {recording.parent}")
        RunFolder(recording.parent).put(
            recording.name, lambda part: _write_recording(played, Sinks(part, vehicle=rerun_vehicle))
        )
        print(recording)
        if out is None:
            print(write_report(run))


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


def play(
    run: RunArgument = LATEST,
    speed: Annotated[float, typer.Option(help="How many times as fast as real time.")] = 1.0,
    start: Annotated[float, typer.Option("--from", min=0.0, help="Emulated second to begin at.")] = 0.0,
    end: Annotated[float | None, typer.Option("--to", help="Emulated second to stop at.")] = None,
    serve: Annotated[bool, typer.Option("--serve", help="Serve it even where there is a display.")] = False,
    rerun_bind: RerunBindOption = None,
    rerun_port: RerunPortOption = None,
    rerun_vehicle: RerunVehicleOption = None,
) -> None:
    """Play a run into a viewer here, or serve it as it plays, until Ctrl-C."""
    with one_line_errors():
        if not speed > 0:
            raise VnetError(f"--speed {speed:g}: more than 0 is needed")
        if end is not None and not end > start:
            raise VnetError(f"--to {end:g}: must come after --from {start:g}")
        played = messages(run)
        stream, scene = next(played)
        if start >= (over_s := scene["duration_ns"] / NS_PER_S):
            raise VnetError(f"--from {start:g}: the run is over at {over_s:g} s")
        scheduled = schedule(played, speed, round(start * NS_PER_S), None if end is None else round(end * NS_PER_S))
        place = place_to_serve(rerun_bind, rerun_port)
        sinks = Sinks(serve=place, spawn=has_display() and not serve, vehicle=rerun_vehicle)
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        with contextlib.suppress(KeyboardInterrupt), _recorder(sinks, scene["name"]) as recorder:
            recorder.take(stream, scene)
            print(f"playing {run} at {speed:g}× real time\n{place.announcement()}", flush=True)
            apart_s = scene["period_ns"] / NS_PER_S / speed

            def show(message: Message) -> None:
                recorder.take(*message)
                if apart_s >= SEEN_APART_S:
                    recorder.draw()

            if play_scheduled(scheduled, show) == 0:
                raise VnetError(f"{run}: there is nothing to play from {start:g} s on")
            print("played; it can be looked at until Ctrl-C", flush=True)
            signal.pause()


def _recorder(sinks: Sinks, name: str) -> Recorder:
    from emulator.viewer.recorder import Recorder

    return Recorder(sinks, name)
