"""`vnet analyze` and `vnet campaign`: what a network's graph says, and many runs under random faults."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from emulator.cli.options import (
    ChecksOption,
    Compared,
    DeterminismOption,
    DurationOption,
    OrderOption,
    OrderOptions,
    Pacing,
    ProgramOption,
    ProgramOptionsOption,
    ScenarioArgument,
    SeedOption,
    SetOption,
    load,
)
from emulator.terminal.console import one_line_errors, tell
from emulator.terminal.safe_console import SafeConsole
from emulator.terminal.standard_output import result_only
from vnet.errors import VnetError

RUNS_ON_DASK = 64
"""Runs of a campaign that wait for Dask's workers at once: more than most clusters have."""


def analyze(
    scenario: ScenarioArgument,
    run: Annotated[
        Path | None, typer.Option(metavar="RUN", help="Folder of a run: set beside what its filters did.")
    ] = None,
    overrides: SetOption = None,
) -> None:
    """Analyze the network without a run: components, degrees, convergence of each rule of weights."""
    from emulator.analyze import analysis_table
    from emulator.analyze import analyze as analyze_scenario

    with one_line_errors():
        SafeConsole().print(analysis_table(analyze_scenario(load(scenario, overrides), run)))


def campaign(
    scenario: ScenarioArgument,
    runs: Annotated[int, typer.Option(min=1, metavar="N", help="How many runs.")] = 200,
    faults: Annotated[
        str,
        typer.Option(
            metavar="KINDS",
            help="random, the kinds to draw from (kill,partition), or none: the runs differ by their seeds.",
        ),
    ] = "random",
    draw: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KIND.KEY=LOW..HIGH",
            help="Draw a parameter of faults from this range: delay.delay_ms=1..2000. May be repeated.",
        ),
    ] = None,
    program: ProgramOption = None,
    seed: SeedOption = None,
    duration: DurationOption = None,
    order: OrderOption = None,
    out: Annotated[Path | None, typer.Option(metavar="FOLDER", help="For the campaign's files.")] = None,
    overrides: SetOption = None,
    option: ProgramOptionsOption = None,
    checks: ChecksOption = None,
    check_determinism: DeterminismOption = None,
    before: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="An earlier campaign: say whether what failed there is credibly fixed. Default: the last of the "
            "same name and seed in runs/, without --out.",
        ),
    ] = None,
    jobs: Annotated[
        int | None,
        typer.Option(min=1, metavar="N", help="Runs at once. Default: as many as there are cores, or 64 on Dask."),
    ] = None,
    executor: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Run on the workers of Dask: dask://HOST:PORT.")
    ] = None,
    shrink_steps: Annotated[
        int, typer.Option(min=0, max=1000, metavar="N", help="Most runs to shrink a failure with.")
    ] = 250,
    time_limit: Annotated[
        float, typer.Option(min=1.0, metavar="SECONDS", help="Wall clock that a run may take.")
    ] = 300.0,
) -> None:
    """Run a scenario many times under random faults, and shrink each failure to the least that still fails."""
    from emulator.cells.executors import open_executor
    from emulator.testing.campaign import run_campaign
    from emulator.testing.campaign_plan import Plan
    from emulator.testing.schedules import parse_ranges

    with one_line_errors(), result_only(True):
        loaded = load(
            scenario, overrides, program, Pacing.LOCKSTEP, seed, duration, option, checks, OrderOptions(order)
        )
        if check_determinism is Compared.PORTABLE:
            raise VnetError("--check-determinism=portable: is for vnet run and vnet simulate")
        jobs = jobs or (RUNS_ON_DASK if executor else None)
        options = {
            "limit_s": time_limit,
            "shrink_steps": shrink_steps,
            "ranges": parse_ranges(draw or ()),
            "check_determinism": check_determinism is not None,
            **({"jobs": jobs} if jobs else {}),
        }
        plan = Plan.of(loaded, faults, runs, loaded.run.seed, **options)
        if plan.note:
            tell(plan.note)
        with open_executor(executor) as pool:
            raise typer.Exit(run_campaign(plan, out, SafeConsole(stderr=True), pool, before))
