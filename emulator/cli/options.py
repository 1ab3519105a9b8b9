"""Options that several commands share, and the scenario that they load."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from emulator.scenario.scenario import Scenario, load_scenario
from emulator.terminal.console import LogFormat


class Pacing(StrEnum):
    """The pacings of a run."""

    LOCKSTEP = "lockstep"
    REALTIME = "realtime"


ScenarioArgument = Annotated[
    Path, typer.Argument(metavar="SCENARIO", help="A scenario file (TOML), or the name of one that is shipped.")
]
ProgramOption = Annotated[
    str | None, typer.Option(metavar="MODULE:FUNCTION", help="Program of every vehicle, as hello:main.")
]
PacingOption = Annotated[
    Pacing | None,
    typer.Option(
        help="lockstep: virtual time, the same on every machine. realtime: the wall clock. Default: the scenario's."
    ),
]
SeedOption = Annotated[int | None, typer.Option(metavar="N", help="Random seed: same seed, same run.")]
DurationOption = Annotated[float | None, typer.Option(metavar="SECONDS", help="Emulated length of the run.")]
OutOption = Annotated[
    Path | None, typer.Option(metavar="FOLDER", help="Folder of the run's files. Default: runs/NAME-SEED.")
]
SetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="KEY=VALUE", help="Change a key of the scenario: radio.loss=0.3. May be repeated."
    ),
]
RerunOption = Annotated[
    list[str] | None,
    typer.Option(
        metavar="WHAT",
        help="save: recording.rrd in the run's folder. serve: to viewers and browsers as well. spawn: open a "
        "viewer here as well. off. Several as serve,save.",
    ),
]
DeterminismOption = Annotated[
    bool,
    typer.Option("--check-determinism", metavar="", help="Run it twice, and show the first row that differs."),
]
LogFormatOption = Annotated[
    LogFormat, typer.Option(help="json: an object a line on stderr, and verdict.json in one line on stdout.")
]
QuietOption = Annotated[bool, typer.Option("--quiet", metavar="", help="Only errors, and the verdict in one line.")]


def load(
    path: Path,
    overrides: list[str] | None,
    program: str | None = None,
    pacing: Pacing | None = None,
    seed: int | None = None,
    duration: float | None = None,
) -> Scenario:
    options = {
        "program.entry": program and f'"{program}"',
        "run.pacing": pacing and f'"{pacing.value}"',
        "run.seed": seed,
        "run.duration_s": duration,
    }
    given = [f"{key}={value}" for key, value in options.items() if value is not None]
    return load_scenario(path, [*(overrides or []), *given])
