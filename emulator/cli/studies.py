"""`vnet sweep`, `vnet campaign` and `vnet analyze`: many runs, and what a network's graph says."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from emulator.cli.options import (
    ChecksOption,
    DeterminismOption,
    DurationOption,
    OrderOption,
    ProgramOption,
    ProgramOptionsOption,
    ScenarioArgument,
    SeedOption,
    SetOption,
    load,
)
from emulator.scenario.loading import parse_values
from emulator.terminal.console import one_line_errors, result_only, tell
from emulator.terminal.live import SafeConsole
from vnet.errors import VnetError, printable
from vnet.extras import require

INTERRUPTED = 130
RUNS_ON_DASK = 64
"""Runs of a campaign that wait for Dask's workers at once: more than most clusters have."""


def sweep(
    scenario: ScenarioArgument,
    vary: Annotated[
        list[str] | None,
        typer.Option(metavar="KEY=VALUES", help="Values of a key: radio.loss=0,0.1,0.3. May be repeated."),
    ] = None,
    seeds: Annotated[int, typer.Option(min=1, metavar="N", help="Seeds 1 … N of each combination.")] = 1,
    program: Annotated[
        str | None,
        typer.Option(
            metavar="PROGRAM[,…]",
            help="Program of every vehicle: hello.py, hello.py:main or package.hello:main. Several as a.py,b.py: "
            "each is run, and compared with the first on the same seeds.",
        ),
    ] = None,
    duration: DurationOption = None,
    overrides: SetOption = None,
    option: ProgramOptionsOption = None,
    checks: ChecksOption = None,
    out: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="For the results; a sweep goes on there. Default: runs/sweep-NAME."),
    ] = None,
    jobs: Annotated[
        int | None, typer.Option(min=1, metavar="N", help="Runs at once. Default: as many as there are cores.")
    ] = None,
    executor: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Run on the workers of Dask: dask://HOST:PORT.")
    ] = None,
    shard: Annotated[
        str | None, typer.Option(metavar="I/N", help="Only the i-th of n parts: 1/4. Each may run elsewhere.")
    ] = None,
) -> None:
    """Run a scenario over values of its keys and over seeds: a table with a row a run, and a page with curves.

    All combinations of values are run, with each seed, which draws a generated network too unless network.seed is
    set or varied. Finished runs are kept: after Ctrl-C the same command goes on. Ends with status 0 when all runs
    are there, whatever their verdicts, which the table has.
    """
    from emulator.cells.cells import open_executor, run_cells
    from emulator.cells.sweep import (
        SweepPlan,
        default_folder,
        missing_cells,
        parse_shard,
        write_sweep,
    )
    from emulator.records.verdicts import WORST_FIRST
    from emulator.report.index import SWEEP_PAGE, SWEEP_TABLE
    from emulator.report.sweep_page import PROGRAM, too_few

    with one_line_errors():
        if program is not None and "," in program:
            vary, program = [f"{PROGRAM}={program}", *(vary or ())], None
        plain = load(scenario, overrides, program, "lockstep", None, duration, option, checks)
        plan = SweepPlan.of(plain, _all_varied(vary or ()), range(1, seeds + 1))
        cells = plan.cells if shard is None else plan.shard(*parse_shard(shard))
        folder = out or default_folder(plan)
        if note := too_few(seeds):
            tell(note)
        try:
            with open_executor(executor, tell) as pool:
                run_cells(cells, folder, title="sweep", executor=pool, jobs=jobs)
        except KeyboardInterrupt:
            done = len(plan.cells) - missing_cells(plan, folder)
            print(f"interrupted: {done} of {len(plan.cells)} runs are in {folder}; the same command goes on")
            raise typer.Exit(INTERRUPTED) from None
        if missing := missing_cells(plan, folder):
            print(f"shard {shard}: {len(cells)} runs are in {folder}; {missing} of {len(plan.cells)} are missing")
            return
        table = write_sweep(plan, folder)
        verdicts = table["verdict"].to_pylist()
        counts = ", ".join(f"{verdicts.count(name)} {name}" for name in sorted(set(verdicts)))
        lines = [f"{len(table)} runs: {counts}"]
        if worst := next((each for each in WORST_FIRST[:-1] if each in verdicts), None):
            (row,) = table.slice(verdicts.index(worst), 1).to_pylist()
            where = ", ".join(f"{key} {row[key]}" for key in (*plan.varied, "seed"))
            lines.append(f"first {worst}: {where}: {row['failed'].partition(', ')[0]}: {row['failure']}")
        SafeConsole().print("\n".join(lines), highlight=False, soft_wrap=True)
        print(folder / SWEEP_TABLE)
        print(folder / SWEEP_PAGE)


def _all_varied(texts: Sequence[str]) -> dict[str, list[object]]:
    varied: dict[str, list[object]] = {}
    for key, values in map(_varied, texts):
        if key in varied:
            raise VnetError(f"--vary {key}: is given twice; write all values behind one, separated by commas")
        varied[key] = values
    return varied


def _varied(text: str) -> tuple[str, list[object]]:
    key, equals, values = text.partition("=")
    if not equals:
        raise VnetError(f"--vary {printable(text)}: write it as KEY=VALUES, for example radio.loss=0,0.1,0.3")
    return key.strip(), parse_values(key.strip(), values)


def analyze(
    scenario: ScenarioArgument,
    run: Annotated[
        Path | None, typer.Option(metavar="RUN", help="Folder of a run: set beside what its filters did.")
    ] = None,
    overrides: SetOption = None,
) -> None:
    """Analyze the network without a run: components, degrees, convergence of each rule of weights."""
    with one_line_errors():
        require("vnet analyze", "scipy")
        from emulator.analyze import analysis_table
        from emulator.analyze import analyze as analyze_scenario

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
    from emulator.cells.cells import open_executor
    from emulator.testing.campaign import run_campaign
    from emulator.testing.campaign_plan import Plan, parse_ranges

    with one_line_errors(), result_only(True):
        loaded = load(scenario, overrides, program, "lockstep", seed, duration, option, checks, order)
        if check_determinism == "portable":
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
        with open_executor(executor, tell) as pool:
            raise typer.Exit(run_campaign(plan, out, SafeConsole(stderr=True), pool, before))
