"""A run that `vnet run`, `vnet simulate` or `vnet emulator` has been asked for, up to its verdict.

Importing this module takes longer than reading a scenario: commands import it once they have said what they run.
"""

from __future__ import annotations

import json
import shlex
import shutil
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import typer

from emulator.checks.own import load_checks
from emulator.cli.access import create_access, load_or_create_access
from emulator.cli.folders import report_at_end
from emulator.cli.options import DEFAULT_ADDRESS, DEFAULT_LISTEN, RunOptions
from emulator.drivers.attachment import LiveOptions
from emulator.drivers.determinism import calls_recorded, run_again
from emulator.drivers.emulation import Emulation
from emulator.drivers.launch import PLACEHOLDERS
from emulator.drivers.observers import Messages
from emulator.drivers.router import SeparateRouter
from emulator.drivers.session import Local, Programs, Session
from emulator.drivers.signals import first_interrupt_told, signals_ignored
from emulator.radio.own_rules import load_rules
from emulator.records.code_digest import changed_code
from emulator.records.events import EventKind
from emulator.records.run_folder import RunFolder
from emulator.scenario.loading import recorded_code
from emulator.scenario.scenario import Scenario
from emulator.terminal.console import LogFormat, StandardOutput, say_first, tell
from emulator.terminal.live import SafeConsole
from emulator.terminal.progress import Progress, show_progress
from emulator.terminal.summary import print_summary
from emulator.viewer.sinks import Sinks
from emulator.world.world import World
from vnet.errors import VnetError, did_you_mean, printable
from vnet.runtime.debug_target import DebugTarget


def prepare_folder(
    out: Path | None, path: Path, scenario: Scenario, log_format: LogFormat, notes: Sequence[str] = ()
) -> RunFolder:
    """Prepare the folder of a run of `scenario`, which was read from `path`; its `open` makes it.

    Each of `notes` on the input is told in a line, and recorded as an event `note`.

    Where `path` is of another run's folder, and program or vnet have changed since, the run goes on: one line says
    so, and the event `code_changed` records it.
    """
    load_rules(scenario.fault, scenario.program)
    load_checks(scenario.program)  # a folder appears only once they have proved usable
    folder = RunFolder.prepare(out, scenario)
    for note in notes:
        tell(note, log_format)
        folder.event(0, EventKind.note, what=note)
    if changed := changed_code(recorded_code(path), folder.code):
        tell(f"{path}: {changed}", log_format)
        folder.event(0, EventKind.code_changed, what=changed)
    return folder


@dataclass(frozen=True)
class Request:
    """A run that was asked for: its scenario, and what is wanted of the run."""

    scenario: Scenario
    asked: RunOptions
    sinks: Sinks | None
    output: StandardOutput
    check_determinism: str | None = None
    """Compared ways of making the run: "layouts" or "portable"; None if it is made once."""
    debug: DebugTarget | None = None

    def session(self, programs: Programs, loads_programs: bool = True) -> Session:
        """Return the run, with a folder that is not made yet. Raises VnetError for what cannot be done."""
        return Session(self.scenario, self._folder, programs, loads_programs)

    def _folder(self, scenario: Scenario, world: World) -> RunFolder:
        if self.sinks is not None and self.sinks.vehicle is not None and self.sinks.vehicle not in world.node_ids:
            raise VnetError(f"--rerun-vehicle {self.sinks.vehicle}: no such vehicle")
        if (debug := self.debug) is not None and debug.node not in world.node_ids:
            meant = did_you_mean(debug.node, world.node_ids)
            raise VnetError(f"--debug {printable(debug.node)}: no such vehicle{meant}")
        return prepare_folder(self.asked.out, self.asked.scenario, scenario, self.asked.log_format, world.notes)


def run_with_processes(
    request: Request, separate_router: bool, hosts: Sequence[str], agent: str | None = None
) -> None:
    """Run the emulator, these hosts, if any, and a process a vehicle; exits with the verdict's status.

    `agent` is the command that each process is, unless it is vnet's own.
    """
    words = () if agent is None else _agent_words(agent, request.scenario)
    with ExitStack() as stack:

        def programs(emulation: Emulation) -> LiveOptions:
            access = create_access(emulation.scenario, emulation.world, hosts=hosts)
            separate = None
            if separate_router:
                private = stack.enter_context(TemporaryDirectory(prefix="vnet-"))
                separate = SeparateRouter(access, Path(private))
            return LiveOptions(
                access,
                router=separate,
                record=request.sinks,
                start_hosts=True,
                debug=request.debug,
                agent=words,
            )

        session = request.session(programs, loads_programs=not words).open()
        _run_live(session, request)


def _agent_words(command: str, scenario: Scenario) -> list[str]:
    """Return the words of `--agent`. Raises VnetError for a command that cannot be started, or cannot join."""
    if scenario.has_gateways or scenario.run.nodes_per_process > 1:
        raise VnetError('--agent: needs a process for each vehicle, and no program of kind = "zenoh"')
    try:
        words = shlex.split(command)
    except ValueError as error:
        raise VnetError(f"--agent {command!r}: {error}") from None
    for placeholder in PLACEHOLDERS:
        if placeholder not in command:
            raise VnetError(f"--agent: the command has no {placeholder}; it needs all of {' '.join(PLACEHOLDERS)}")
    if (program := shutil.which(words[0])) is None:
        raise VnetError(f"--agent {printable(words[0])!r}: no such command")
    return [program, *words[1:]]


def run_simulated(
    request: Request, processes: str, on_folder: Callable[[Path], None], apart: str | None, stalled: bool
) -> None:
    """Run the programs in this process, or in so many others, without Zenoh; exits with the verdict's status.

    `on_folder` is told the run's folder once it is made; `apart` is a vehicle that needs a process of its own, as
    it has ended that of all, or `stalled`.
    """
    session = request.session(Local(processes, request.debug, apart, stalled)).open()
    emulation = session.emulation
    on_folder(emulation.folder.path)
    request.output.keep_in(emulation.folder.logs)
    with _progress(emulation, request) as progress:
        with ExitStack() as stack:
            if request.sinks is not None:
                _record_here(emulation, request.sinks, stack)
            say = partial(_say, request, "interrupted, as soon as the programs yield; Ctrl-C again: at once")
            stack.enter_context(calls_recorded(emulation.folder.path, request.check_determinism is not None))
            session.run(on_interrupt=say)
        _finish(session, progress, request)


def _progress(emulation: Emulation, request: Request) -> Progress:
    """Return the display of a run's progress; a debugger and a picture do not share a terminal."""
    asked = request.asked
    return show_progress(emulation, asked.log_format, asked.quiet, picture=request.debug is None)


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

    def programs(emulation: Emulation) -> LiveOptions:
        place = access or emulation.folder.path / "access"
        address = listen or DEFAULT_LISTEN
        users = load_or_create_access(scenario, emulation.world, place, address, connect is not None, hosts)
        endpoint = listen or (DEFAULT_LISTEN if users.tls is None else f"tls/{DEFAULT_ADDRESS}")
        return LiveOptions(users, endpoint, connect, launch=bool(users.hosts), record=request.sinks)

    session = request.session(programs, loads_programs=False)
    assert session.live is not None
    options = session.live

    def create() -> str:
        """Make the run's folder, and the users' files if they are new."""
        session.folder.open(scenario)
        place = access or session.folder.path / "access"
        if not (place / "access.json").exists():
            options.access.save(place, options.listen, place.resolve())
        who, file = ("hosts", "host-NAME.json") if options.access.hosts else ("agents", "NODE.json")
        if scenario.has_gateways:  # whose programs have endpoints of their own
            who, file = "observers", "observer.json"
        return f"credentials of the {who}: {place}/credentials/{file}"

    _run_live(session, request, create)


def _run_live(session: Session, request: Request, create: Callable[[], str] = lambda: "") -> None:
    """A live run to its summary; exits with the verdict's status.

    `create` makes the run's folder, if it is not there yet, once the emulator's endpoint is open; it returns a line
    for the user, or "".
    """
    assert session.live is not None
    record, folder = session.live.record, session.folder
    with _progress(session.emulation, request) as progress:

        def on_open() -> None:
            if line := create():
                progress.state(line)
            request.output.keep_in(folder.logs)
            send_again()

        if record is not None and record.serve is not None:
            progress.state(record.serve.announcement())
        with signals_ignored() as send_again:  # a second Ctrl-C must not lose the records
            with calls_recorded(folder.path, request.check_determinism is not None):
                session.run(on_state=progress.state, on_missing=progress.awaits, on_open=on_open)
            _finish(session, progress, request)


def _finish(session: Session, progress: Progress, request: Request) -> None:
    """Judge a run and print its summary; exits with the verdict's status. A second Ctrl-C ends that, too."""
    asked, how = request.asked, request.check_determinism
    say = partial(_say, request, "the run is being judged and written; Ctrl-C again ends without")
    with first_interrupt_told(say) as is_told:
        progress.judging()
        judgement, verdict = session.close()
        progress.close()
        for line in session.folder.unkept:
            tell(line, asked.log_format)
        interrupted = session.interrupted or (how is not None and is_told())
        if how is not None and not interrupted:
            again = ["--quiet"] if asked.only_the_result else []
            verdict = run_again(session.emulation, judgement, verdict, session.command, how, again)
        status = 130 if interrupted else judgement.exit_status
        folder = session.folder.path
        progress.ended(verdict, str(folder), status)
        if asked.log_format is LogFormat.JSON:
            request.output.print(json.dumps(verdict))
        elif asked.quiet:
            request.output.print(f"verdict: {judgement.verdict}  {folder}")
        else:
            print_summary(judgement, verdict, session.folder, SafeConsole(), asked.report, asked.verbose)
        if asked.report:
            report_at_end(folder)
    raise typer.Exit(status)


def _say(request: Request, line: str) -> None:
    """Print a line on stderr for who has pressed Ctrl-C, with `--quiet` too: nothing else shows that it came."""
    if request.asked.log_format is not LogFormat.JSON:
        say_first(f"vnet: {line}")
