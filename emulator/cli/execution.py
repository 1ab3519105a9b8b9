"""A run that `vnet run`, `vnet simulate` or `vnet emulator` has been asked for, up to its verdict.

Importing this module takes longer than reading a scenario: commands import it once they have said what they run.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import typer

from emulator.cli.access import create_access, load_or_create_access
from emulator.cli.new_run import prepare_folder
from emulator.cli.options import DEFAULT_ADDRESS, DEFAULT_LISTEN, OutputOptions
from emulator.cli.report import report_at_end
from emulator.drivers.attachment import LiveOptions
from emulator.drivers.conclude import conclude
from emulator.drivers.determinism import calls_recorded, run_again
from emulator.drivers.emulation import Emulation
from emulator.drivers.live import run_live
from emulator.drivers.observers import Messages
from emulator.drivers.order_length import with_order_steps
from emulator.drivers.process_count import process_count
from emulator.drivers.program_check import program_check
from emulator.drivers.router import SeparateRouter
from emulator.drivers.signals import first_interrupt_told, signals_ignored
from emulator.drivers.simulate import simulate as run_simulation
from emulator.records.code_digest import entries_of
from emulator.scenario.scenario import Scenario
from emulator.terminal.console import LogFormat, say_first, tell
from emulator.terminal.progress import Progress, show_progress
from emulator.terminal.safe_console import SafeConsole
from emulator.terminal.standard_output import StandardOutput
from emulator.terminal.summary import print_summary
from emulator.viewer.sinks import Sinks
from emulator.world.world import World, build_world
from vnet.errors import VnetError, did_you_mean, printable
from vnet.runtime.program_path import search_programs_in
from vnet.runtime.programs import load_program
from vnet.transport.session import quiet_zenoh


@dataclass(frozen=True)
class Request:
    """A run that was asked for: its scenario, the file that this was read from, and what is wanted of the run."""

    scenario: Scenario
    file: Path
    out: Path | None
    sinks: Sinks | None
    asked: OutputOptions
    output: StandardOutput

    def with_order_steps(self) -> Request:
        """Return the request with what its order of events needs to know of the run."""
        return replace(self, scenario=with_order_steps(self.scenario))

    def prepare(self, world: World) -> Emulation:
        """Return the run, with a folder that is not made yet. Raises VnetError for what cannot be done."""
        if self.sinks is not None and self.sinks.vehicle is not None and self.sinks.vehicle not in world.node_ids:
            raise VnetError(f"--rerun-vehicle {self.sinks.vehicle}: no such vehicle")
        if (debug := self.asked.debug) is not None and debug.node not in world.node_ids:
            meant = did_you_mean(debug.node, world.node_ids)
            raise VnetError(f"--debug {printable(debug.node)}: no such vehicle{meant}")
        folder = prepare_folder(self.out, self.file, self.scenario, self.asked.log_format, world.notes)
        return Emulation(self.scenario, world, folder)


def run_with_processes(request: Request, separate_router: bool, hosts: Sequence[str]) -> None:
    """Run the emulator, these hosts, if any, and a process a vehicle; exits with the verdict's status."""
    request = request.with_order_steps()
    scenario = request.scenario
    with program_check(scenario) as check:
        world = build_world(scenario)
        access = create_access(scenario, world, hosts=hosts)
        emulation = request.prepare(world)
        check.wait()
    with ExitStack() as stack:
        separate = None
        if separate_router:
            private = stack.enter_context(TemporaryDirectory(prefix="vnet-"))
            separate = SeparateRouter(access, Path(private))
        options = LiveOptions(
            access, router=separate, record=request.sinks, start_hosts=True, debug=request.asked.debug
        )
        emulation.folder.open(scenario)
        _run_live(emulation, options, request.asked, request.output)


def run_simulated(request: Request, processes: str, on_folder: Callable[[Path], None], apart: str | None) -> None:
    """Run the programs in this process, or in so many others, without Zenoh; exits with the verdict's status.

    `on_folder` is told the run's folder once it is made; `apart` is a vehicle that needs a process of its own.
    """
    request = request.with_order_steps()
    world = build_world(request.scenario)
    count = process_count(processes, len(world.node_ids))
    emulation = request.prepare(world)
    search_programs_in(request.scenario.program.folders)
    for entry in entries_of(request.scenario):
        load_program(entry)
    emulation.folder.open(request.scenario)
    on_folder(emulation.folder.path)
    request.output.keep_in(emulation.folder.logs)
    with _progress(emulation, request.asked) as progress:
        with ExitStack() as stack:
            if request.sinks is not None:
                _record_here(emulation, request.sinks, stack)
            say = partial(_say, request.asked, "interrupted, as soon as the programs yield; Ctrl-C again: at once")
            debug = request.asked.debug
            stack.enter_context(calls_recorded(emulation.folder.path, request.asked.check_determinism is not None))
            wall_s, interrupted = run_simulation(
                emulation, on_interrupt=say, debug=debug, processes=count, apart=apart
            )
        _finish(emulation, progress, wall_s, interrupted, "simulate", request.asked, request.output)


def _progress(emulation: Emulation, asked: OutputOptions) -> Progress:
    """Return the display of a run's progress; a debugger and a picture do not share a terminal."""
    return show_progress(emulation, asked.log_format, asked.quiet, picture=asked.debug is None)


def _record_here(emulation: Emulation, sinks: Sinks, stack: ExitStack) -> None:
    """Record a simulation from within its own process."""
    from emulator.viewer.recorder import Recorder  # Rerun is slow to import, and only recordings need it

    name = emulation.scenario.run.name
    recorder = stack.enter_context(Recorder(sinks.inside(emulation.folder.path), name))
    messages = Messages(emulation)
    recorder.take("scene", messages.scene())
    emulation.watch(lambda view: recorder.take("period", messages.period(view)))
    stack.callback(lambda: recorder.take("end", messages.end()))


def run_for_agents(
    request: Request, listen: str | None, connect: str | None, access: Path | None, hosts: Sequence[str]
) -> None:
    """Run the emulator for hosts, or agents that are started by hand; exits with the verdict's status."""
    scenario = request.scenario
    if scenario.run.order == "pct" and scenario.run.order_steps is None:
        raise VnetError("run.order_steps: how many decisions a vehicle makes; needed where agents start by hand")
    world = build_world(scenario)
    emulation = request.prepare(world)
    folder = emulation.folder
    place = access or folder.path / "access"
    users = load_or_create_access(scenario, world, place, listen or DEFAULT_LISTEN, connect is not None, hosts)
    endpoint = listen or (DEFAULT_LISTEN if users.tls is None else f"tls/{DEFAULT_ADDRESS}")

    def create() -> str:
        """Make the run's folder, and the users' files if they are new."""
        folder.open(scenario)
        place = access or folder.path / "access"
        if not (place / "access.json").exists():
            users.save(place, endpoint, place.resolve())
        who, file = ("hosts", "host-NAME.json") if users.hosts else ("agents", "NODE.json")
        return f"credentials of the {who}: {place}/credentials/{file}"

    options = LiveOptions(users, endpoint, connect, launch=bool(users.hosts), record=request.sinks)
    _run_live(emulation, options, request.asked, request.output, create)


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
    with _progress(emulation, asked) as progress:

        def on_open() -> None:
            if line := create():
                progress.state(line)
            output.keep_in(emulation.folder.logs)

        if options.record is not None and options.record.serve is not None:
            progress.state(options.record.serve.announcement())
        with signals_ignored():  # a second Ctrl-C must not lose the records
            running = run_live(emulation, options, progress.state, on_missing=progress.awaits, on_open=on_open)
            with calls_recorded(emulation.folder.path, asked.check_determinism is not None):
                wall_s, interrupted = asyncio.run(running)
            _finish(emulation, progress, wall_s, interrupted, "run", asked, output)


def _finish(
    emulation: Emulation,
    progress: Progress,
    wall_s: float,
    interrupted: bool,
    command: str,
    asked: OutputOptions,
    output: StandardOutput,
) -> None:
    """Judge a run and print its summary; exits with the verdict's status. A second Ctrl-C ends that, too."""
    say = partial(_say, asked, "the run is being judged and written; Ctrl-C again ends without")
    with first_interrupt_told(say):
        progress.judging()
        judgement, verdict = conclude(emulation, wall_s, command)
        progress.close()
        for line in emulation.folder.unkept:
            tell(line, asked.log_format)
        if asked.check_determinism is not None and not interrupted:
            again = ["--quiet"] if asked.only_the_result else []
            verdict = run_again(emulation, judgement, verdict, command, asked.check_determinism, again)
        status = 130 if interrupted else judgement.exit_status
        folder = emulation.folder.path
        progress.ended(verdict, str(folder), status)
        if asked.log_format is LogFormat.JSON:
            output.print(json.dumps(verdict))
        elif asked.quiet:
            output.print(f"verdict: {judgement.verdict}  {folder}")
        else:
            print_summary(judgement, verdict, folder, SafeConsole(), asked.report, asked.verbose)
        if asked.report:
            report_at_end(folder)
    raise typer.Exit(status)


def _say(asked: OutputOptions, line: str) -> None:
    """Print a line on stderr for who has pressed Ctrl-C, with `--quiet` too: nothing else shows that it came."""
    if asked.log_format is not LogFormat.JSON:
        say_first(f"vnet: {line}")
