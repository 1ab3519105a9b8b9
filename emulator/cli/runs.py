"""`vnet run`, `vnet simulate` and `vnet emulator`: a scenario from its file to its verdict."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import typer
from rich.console import Console

from emulator.cli.access import DEFAULT_ADDRESS, DEFAULT_LISTEN, create_access, load_or_create_access
from emulator.cli.new_run import prepare_folder
from emulator.cli.options import (
    ChecksOption,
    DeterminismOption,
    DurationOption,
    LogFormatOption,
    OutOption,
    Pacing,
    PacingOption,
    ProgramOption,
    ProgramOptionsOption,
    QuietOption,
    RerunOption,
    ScenarioArgument,
    SeedOption,
    SetOption,
    load,
)
from emulator.cli.report import ReportOption, report_at_end
from emulator.cli.viewing import RerunBindOption, RerunPortOption, RerunVehicleOption
from emulator.drivers.attachment import LiveOptions
from emulator.drivers.conclude import conclude, run_again
from emulator.drivers.emulation import Emulation
from emulator.drivers.live import run_live
from emulator.drivers.observers import Messages
from emulator.drivers.program_check import program_check
from emulator.drivers.router import SeparateRouter
from emulator.drivers.signals import signals_ignored
from emulator.drivers.simulate import simulate as run_simulation
from emulator.records.code_digest import entries_of
from emulator.scenario.scenario import Scenario
from emulator.terminal.console import LogFormat, one_line_errors
from emulator.terminal.progress import Progress, show_progress
from emulator.terminal.standard_output import StandardOutput, result_only
from emulator.terminal.summary import print_summary
from emulator.viewer.sinks import Sinks, choose_sinks
from emulator.world.world import World, build_world
from vnet.errors import ScenarioError, VnetError
from vnet.runtime.program_path import search_programs_in
from vnet.runtime.programs import load_program
from vnet.transport.session import quiet_zenoh


class RouterKind(StrEnum):
    """Router of a run that `vnet run` starts."""

    EMBEDDED = "embedded"
    SEPARATE = "separate"


@dataclass(frozen=True)
class OutputOptions:
    """Output that was asked for beside the run itself."""

    log_format: LogFormat
    quiet: bool
    check_determinism: bool = False
    report: bool = True

    @property
    def only_the_result(self) -> bool:
        """True if standard output is for the result alone, and not for what programs print."""
        return self.quiet or self.log_format is LogFormat.JSON


def run(
    scenario: ScenarioArgument,
    program: ProgramOption = None,
    pacing: PacingOption = None,
    seed: SeedOption = None,
    duration: DurationOption = None,
    out: OutOption = None,
    overrides: SetOption = None,
    option: ProgramOptionsOption = None,
    checks: ChecksOption = None,
    rerun: RerunOption = None,
    rerun_bind: RerunBindOption = None,
    rerun_port: RerunPortOption = None,
    rerun_vehicle: RerunVehicleOption = None,
    check_determinism: DeterminismOption = False,
    report: ReportOption = True,
    router: Annotated[
        RouterKind, typer.Option(help="The emulator is the router itself, or starts one as a separate process.")
    ] = RouterKind.EMBEDDED,
    log_format: LogFormatOption = LogFormat.TEXT,
    quiet: QuietOption = False,
) -> None:
    """Run a scenario: start the emulator and one process a vehicle, and judge what happened."""
    asked = OutputOptions(log_format, quiet, check_determinism, report)
    with one_line_errors(log_format), result_only(asked.only_the_result) as output:
        loaded = load(scenario, overrides, program, pacing, seed, duration, option, checks)
        if check_determinism and loaded.run.pacing == Pacing.REALTIME.value:
            raise VnetError("--check-determinism: in real time no two runs are alike; use --pacing lockstep")
        _check_restarts(loaded, router is RouterKind.SEPARATE)
        sinks = choose_sinks(rerun or (), rerun_bind, rerun_port, rerun_vehicle)
        with program_check(loaded) as check:
            world = build_world(loaded)
            _check_vehicle(sinks, world)
            access = create_access(loaded, world)
            emulation = Emulation(loaded, world, prepare_folder(out, scenario, loaded, log_format))
            check.wait()
        with ExitStack() as stack:
            separate = None
            if router is RouterKind.SEPARATE:
                private = stack.enter_context(TemporaryDirectory(prefix="vnet-"))
                separate = SeparateRouter(access, Path(private))
            options = LiveOptions(access, router=separate, record=sinks)
            emulation.folder.open(loaded)
            _run_live(emulation, options, asked, output)


def simulate(
    scenario: ScenarioArgument,
    program: ProgramOption = None,
    seed: SeedOption = None,
    duration: DurationOption = None,
    out: OutOption = None,
    overrides: SetOption = None,
    option: ProgramOptionsOption = None,
    checks: ChecksOption = None,
    rerun: RerunOption = None,
    rerun_vehicle: RerunVehicleOption = None,
    check_determinism: DeterminismOption = False,
    log_format: LogFormatOption = LogFormat.TEXT,
    quiet: QuietOption = False,
    report: ReportOption = True,
) -> None:
    """Run a scenario in this one process, in lockstep and without Zenoh: the same trace, faster."""
    asked = OutputOptions(log_format, quiet, check_determinism, report)
    with one_line_errors(log_format), result_only(asked.only_the_result) as output:
        loaded = load(scenario, overrides, program, Pacing.LOCKSTEP, seed, duration, option, checks)
        sinks = choose_sinks(rerun or (), vehicle=rerun_vehicle, live=False)
        world = build_world(loaded)
        _check_vehicle(sinks, world)
        emulation = Emulation(loaded, world, prepare_folder(out, scenario, loaded, log_format))
        search_programs_in(loaded.program.folders)
        for entry in entries_of(loaded):
            load_program(entry)
        emulation.folder.open(loaded)
        output.keep_in(emulation.folder.logs)
        with show_progress(emulation, log_format, quiet) as progress:
            with ExitStack() as stack:
                if sinks is not None:
                    _record_here(emulation, sinks, stack)
                wall_s, interrupted = run_simulation(emulation)
            _finish(emulation, progress, wall_s, interrupted, "simulate", asked, output)


def _record_here(emulation: Emulation, sinks: Sinks, stack: ExitStack) -> None:
    """Record a simulation from within its own process."""
    from emulator.viewer.recorder import Recorder  # Rerun is slow to import, and only recordings need it

    name = emulation.scenario.run.name
    recorder = stack.enter_context(Recorder(sinks.inside(emulation.folder.path), name))
    messages = Messages(emulation)
    recorder.take("scene", messages.scene())
    emulation.watch(lambda view: recorder.take("period", messages.period(view)))
    stack.callback(lambda: recorder.take("end", messages.end()))


def emulator(
    scenario: ScenarioArgument,
    listen: Annotated[
        str | None,
        typer.Option(
            metavar="ENDPOINT",
            help=f"Be the router, at tcp/HOST:PORT or tls/HOST:PORT. Default: {DEFAULT_LISTEN}.",
        ),
    ] = None,
    connect: Annotated[
        str | None, typer.Option(metavar="ENDPOINT", help="Be a client of the zenohd that is there.")
    ] = None,
    access: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER", help="Users, as vnet access wrote them; made if not there. Default: OUT/access."
        ),
    ] = None,
    program: ProgramOption = None,
    pacing: PacingOption = None,
    seed: SeedOption = None,
    duration: DurationOption = None,
    out: OutOption = None,
    overrides: SetOption = None,
    option: ProgramOptionsOption = None,
    checks: ChecksOption = None,
    rerun: RerunOption = None,
    rerun_bind: RerunBindOption = None,
    rerun_port: RerunPortOption = None,
    rerun_vehicle: RerunVehicleOption = None,
    log_format: LogFormatOption = LogFormat.TEXT,
    quiet: QuietOption = False,
    report: ReportOption = True,
) -> None:
    """Run a scenario for agents that are started by hand, here or on other machines."""
    asked = OutputOptions(log_format, quiet, report=report)
    with one_line_errors(log_format), result_only(asked.only_the_result) as output:
        if listen is not None and connect is not None:
            raise VnetError("--listen and --connect exclude each other")
        loaded = load(scenario, overrides, program, pacing, seed, duration, option, checks)
        _check_restarts(loaded, own_router=False)
        sinks = choose_sinks(rerun or (), rerun_bind, rerun_port, rerun_vehicle)
        world = build_world(loaded)
        _check_vehicle(sinks, world)
        emulation = Emulation(loaded, world, prepare_folder(out, scenario, loaded, log_format))
        folder = emulation.folder
        place = access or folder.path / "access"
        users = load_or_create_access(loaded, world, place, listen or DEFAULT_LISTEN, connect is not None)
        listen = listen or (DEFAULT_LISTEN if users.tls is None else f"tls/{DEFAULT_ADDRESS}")

        def create() -> str:
            """Make the run's folder, and the users' files if they are new."""
            folder.open(loaded)
            place = access or folder.path / "access"
            if not (place / "access.json").exists():
                users.save(place, listen, place.resolve())
            return f"credentials of the agents: {place}/credentials/NODE.json"

        options = LiveOptions(users, listen, connect, launch=False, record=sinks)
        _run_live(emulation, options, asked, output, create)


def _run_live(
    emulation: Emulation,
    options: LiveOptions,
    asked: OutputOptions,
    output: StandardOutput,
    create: Callable[[], str] = lambda: "",
) -> None:
    """A live run to its summary; exits with the verdict's status.

    `create` makes the run's folder, if it is not there yet, once the emulator's endpoint is open; it returns a line
    for the user, or "".
    """
    quiet_zenoh()
    with show_progress(emulation, asked.log_format, asked.quiet) as progress:

        def on_open() -> None:
            if line := create():
                progress.state(line)
            output.keep_in(emulation.folder.logs)

        if options.record is not None and options.record.serve is not None:
            progress.state(options.record.serve.announcement())
        with signals_ignored():  # a second Ctrl-C must not lose the records
            running = run_live(emulation, options, progress.state, on_missing=progress.awaits, on_open=on_open)
            wall_s, interrupted = asyncio.run(running)
            _finish(emulation, progress, wall_s, interrupted, "run", asked, output)


def _check_vehicle(sinks: Sinks | None, world: World) -> None:
    """The vehicle to be looked at closely must be there."""
    if sinks is not None and sinks.vehicle is not None and sinks.vehicle not in world.node_ids:
        raise VnetError(f"--rerun-vehicle {sinks.vehicle}: no such vehicle")


def _check_restarts(scenario: Scenario, own_router: bool) -> None:
    """Only a router that the run itself has started can be restarted."""
    kinds = {fault.kind for fault in scenario.fault}
    if "router_restart" in kinds and not own_router:
        raise ScenarioError("fault router_restart: needs a router of its own: vnet run --router separate")


def _finish(
    emulation: Emulation,
    progress: Progress,
    wall_s: float,
    interrupted: bool,
    command: str,
    asked: OutputOptions,
    output: StandardOutput,
) -> None:
    """Judge a run and print its summary; exits with the verdict's status."""
    progress.judging()
    judgement, verdict = conclude(emulation, wall_s, command)
    progress.close()
    if asked.check_determinism and not interrupted:
        again = ["--quiet"] if asked.only_the_result else []
        verdict = run_again(emulation, judgement, verdict, command, again)
    status = 130 if interrupted else judgement.exit_status
    folder = emulation.folder.path
    progress.ended(verdict, str(folder), status)
    if asked.log_format is LogFormat.JSON:
        output.print(json.dumps(verdict))
    elif asked.quiet:
        output.print(f"verdict: {judgement.verdict}  {folder}")
    else:
        print_summary(judgement, verdict, folder, Console(), asked.report)
    if asked.report:
        report_at_end(folder)
    raise typer.Exit(status)
