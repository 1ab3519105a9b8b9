"""`vnet conformance`: tell the author of an agent, in whatever language, what is wrong with it."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from emulator.scenario.loading import load_scenario
from emulator.scenario.scenario import Scenario
from emulator.terminal.console import one_line_errors
from emulator.testing.conformance.play import PATIENCE_S, SCENES, Conformance
from vnet.counted import counted

SOMETHING_WRONG = 1


def conformance(
    command: Annotated[
        list[str],
        typer.Argument(
            metavar="COMMAND...",
            help="The agent, after --, with {endpoint}, {run}, {node} and {credentials} where it needs them.",
        ),
    ],
    scene: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="Play only this scene. May be repeated. Default: all scenes."),
    ] = None,
    scenario: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="A scenario for the welcome: program, options, map, limits."),
    ] = None,
    listen: Annotated[
        str,
        typer.Option(metavar="ENDPOINT", help="Where the agent connects: tcp/HOST:PORT or tls/HOST:PORT."),
    ] = "tcp/127.0.0.1:0",
    patience: Annotated[
        float, typer.Option(min=0.1, metavar="SECONDS", help="How long the agent may take for an answer.")
    ] = PATIENCE_S,
) -> None:
    """Play the emulator against an agent, scene by scene, and check each of its answers (experimental)."""
    with one_line_errors():
        loaded = Scenario() if scenario is None else load_scenario(scenario)
        found = Conformance(command, loaded, scene or list(SCENES), listen, patience).play(_announce)
        for line in found.lines(unreached=not scene):
            print(line)
        print(f"{counted(len(found.made), 'check')}: {len(found.failed)} wrong")
        raise typer.Exit(SOMETHING_WRONG if found.failed else 0)


def _announce(scene: str) -> None:
    print(f"scene {scene}", file=sys.stderr, flush=True)
