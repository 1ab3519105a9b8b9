"""`vnet`: run, simulate, emulator, access, check, record, view, render, play, report, compare and others.

Exit status: 0 valid, 1 invalid, 2 wrong usage or a wrong scenario, 3 unknown, 130 interrupted.
"""

from __future__ import annotations

import asyncio
import io
import json
import shlex
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import typer
from rich.console import Console

from emulator.checks.judge import check_run, recorded_verdict
from emulator.cli.experiment import app as experiment_app
from emulator.cli.export import export, radio
from emulator.cli.fault import app as fault_app
from emulator.cli.fault import status
from emulator.cli.map import app as map_app
from emulator.cli.playback import play, render
from emulator.cli.report import ReportOption, compare, report, report_at_end
from emulator.cli.viewing import RerunBindOption, RerunPortOption, RerunVehicleOption, view
from emulator.drivers.attachment import LiveOptions
from emulator.drivers.conclude import conclude, run_again
from emulator.drivers.emulation import Emulation
from emulator.drivers.join import split_into_processes
from emulator.drivers.live import run_live
from emulator.drivers.observers import Messages
from emulator.drivers.router import SeparateRouter
from emulator.drivers.signals import signals_ignored
from emulator.drivers.simulate import simulate as run_simulation
from emulator.records.run_folder import RunFolder
from emulator.scenario.scenario import Scenario, load_scenario
from emulator.terminal.console import LogFormat, one_line_errors, run_app
from emulator.terminal.progress import Progress, show_progress
from emulator.terminal.summary import print_checks, print_summary
from emulator.viewer.sinks import Sinks, choose_sinks
from emulator.world.world import World, build_world
from vnet.errors import ScenarioError, TransportError, VnetError
from vnet.runtime.environment import fix_hash_seed
from vnet.transport.access import Access, is_tls
from vnet.transport.certificates import certifier
from vnet.transport.credentials import Credentials
from vnet.transport.session import quiet_zenoh


class Panel(StrEnum):
    """Under what commands are listed."""

    RUNS = "Run a scenario"
    LIVE = "While a run is on"
    AFTER = "Afterwards"
    STUDIES = "Studies"
    APART = "Apart from the emulator"


app = typer.Typer(
    add_completion=False,
    pretty_exceptions_enable=False,
    no_args_is_help=True,
    help="An asyncio message-passing emulator for connected vehicles over Zenoh.",
)
app.add_typer(experiment_app, name="experiment", rich_help_panel=Panel.STUDIES)
app.add_typer(fault_app, name="fault", rich_help_panel=Panel.LIVE)
app.add_typer(map_app, name="map", rich_help_panel=Panel.STUDIES)
app.command(rich_help_panel=Panel.AFTER)(view)
app.command(rich_help_panel=Panel.AFTER)(render)
app.command(rich_help_panel=Panel.AFTER)(play)
app.command(rich_help_panel=Panel.AFTER)(radio)
app.command(rich_help_panel=Panel.AFTER)(export)
app.command(rich_help_panel=Panel.AFTER)(report)
app.command(rich_help_panel=Panel.AFTER)(compare)


class Pacing(StrEnum):
    """The pacings of a run."""

    LOCKSTEP = "lockstep"
    REALTIME = "realtime"


class RouterKind(StrEnum):
    """Who routes a run that `vnet run` starts."""

    EMBEDDED = "embedded"
    SEPARATE = "separate"


DEFAULT_ADDRESS = "127.0.0.1:7447"
DEFAULT_LISTEN = f"tcp/{DEFAULT_ADDRESS}"

ScenarioArgument = Annotated[Path, typer.Argument(metavar="SCENARIO", help="A scenario file (TOML).")]
ProgramOption = Annotated[
    str | None, typer.Option(metavar="MODULE:FUNCTION", help="What every vehicle runs, as hello:main.")
]
PacingOption = Annotated[
    Pacing | None,
    typer.Option(help="Virtual time, the same on every machine; or the wall clock. Default: the scenario's."),
]
SeedOption = Annotated[
    int | None, typer.Option(metavar="N", help="Of all that is drawn at random: same seed, same run.")
]
DurationOption = Annotated[float | None, typer.Option(metavar="SECONDS", help="Emulated length of the run.")]
OutOption = Annotated[
    Path | None, typer.Option(metavar="FOLDER", help="For the run's files. Default: runs/NAME-SEED.")
]
SetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="KEY=VALUE", help="Change a key of the scenario: radio.loss=0.3. As often as need be."
    ),
]
TlsNameOption = Annotated[
    list[str] | None,
    typer.Option(
        "--tls-name", metavar="NAME", help="A further name or address of the router, for its certificate."
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


@dataclass(frozen=True)
class OutputOptions:
    """What was asked for beside the run itself."""

    log_format: LogFormat
    quiet: bool
    check_determinism: bool = False
    report: bool = True


@app.command(rich_help_panel=Panel.RUNS)
def run(
    scenario: ScenarioArgument,
    program: ProgramOption = None,
    pacing: PacingOption = None,
    seed: SeedOption = None,
    duration: DurationOption = None,
    out: OutOption = None,
    overrides: SetOption = None,
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
    with one_line_errors(log_format):
        loaded = _load(scenario, overrides, program, pacing, seed, duration)
        if check_determinism and loaded.run.pacing == Pacing.REALTIME.value:
            raise VnetError("--check-determinism: in real time no two runs are alike; use --pacing lockstep")
        _check_restarts(loaded, router is RouterKind.SEPARATE)
        sinks = choose_sinks(rerun or (), rerun_bind, rerun_port, rerun_vehicle)
        world = build_world(loaded)
        _check_vehicle(sinks, world)
        access = _create_access(loaded, world)
        with ExitStack() as stack:
            separate = None
            if router is RouterKind.SEPARATE:
                private = stack.enter_context(TemporaryDirectory(prefix="vnet-"))
                separate = SeparateRouter(access, Path(private))
            options = LiveOptions(access, router=separate, record=sinks)
            asked = OutputOptions(log_format, quiet, check_determinism, report)
            _run_live(loaded, world, RunFolder.create(out, loaded), options, asked)


@app.command(rich_help_panel=Panel.RUNS)
def simulate(
    scenario: ScenarioArgument,
    program: ProgramOption = None,
    seed: SeedOption = None,
    duration: DurationOption = None,
    out: OutOption = None,
    overrides: SetOption = None,
    rerun: RerunOption = None,
    rerun_vehicle: RerunVehicleOption = None,
    check_determinism: DeterminismOption = False,
    log_format: LogFormatOption = LogFormat.TEXT,
    quiet: QuietOption = False,
    report: ReportOption = True,
) -> None:
    """Run a scenario in this one process, in lockstep and without Zenoh: the same trace, sooner."""
    fix_hash_seed("emulator.cli")
    with one_line_errors(log_format):
        loaded = _load(scenario, overrides, program, Pacing.LOCKSTEP, seed, duration)
        sinks = choose_sinks(rerun or (), vehicle=rerun_vehicle, live=False)
        world = build_world(loaded)
        _check_vehicle(sinks, world)
        sys.path.append(str(Path.cwd()))
        emulation = Emulation(loaded, world, RunFolder.create(out, loaded))
        with show_progress(emulation, log_format, quiet) as progress:
            with ExitStack() as stack:
                if sinks is not None:
                    _record_here(emulation, sinks, stack)
                wall_s, interrupted = run_simulation(emulation)
            asked = OutputOptions(log_format, quiet, check_determinism, report)
            _finish(emulation, progress, wall_s, interrupted, "simulate", asked)


def _record_here(emulation: Emulation, sinks: Sinks, stack: ExitStack) -> None:
    """Record a simulation from within its own process."""
    from emulator.viewer.recorder import Recorder  # Rerun is slow to import, and only recordings need it

    name = emulation.scenario.run.name
    recorder = stack.enter_context(Recorder(sinks.inside(emulation.folder.path), name))
    messages = Messages(emulation)
    recorder.take("scene", messages.scene())
    emulation.watch(lambda view: recorder.take("period", messages.period(view)))
    stack.callback(lambda: recorder.take("end", messages.end()))


@app.command(rich_help_panel=Panel.RUNS)
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
    rerun: RerunOption = None,
    rerun_bind: RerunBindOption = None,
    rerun_port: RerunPortOption = None,
    rerun_vehicle: RerunVehicleOption = None,
    log_format: LogFormatOption = LogFormat.TEXT,
    quiet: QuietOption = False,
    report: ReportOption = True,
) -> None:
    """Run a scenario for agents that are started by hand, here or on other machines."""
    with one_line_errors(log_format):
        if listen is not None and connect is not None:
            raise VnetError("--listen and --connect exclude each other")
        loaded = _load(scenario, overrides, program, pacing, seed, duration)
        _check_restarts(loaded, own_router=False)
        sinks = choose_sinks(rerun or (), rerun_bind, rerun_port, rerun_vehicle)
        world = build_world(loaded)
        _check_vehicle(sinks, world)
        folder = RunFolder.create(out, loaded)
        access = access or folder.path / "access"
        users = _load_or_create_access(loaded, world, access, listen or DEFAULT_LISTEN, connect is not None)
        listen = listen or (DEFAULT_LISTEN if users.tls is None else f"tls/{DEFAULT_ADDRESS}")
        options = LiveOptions(users, listen, connect, launch=False, record=sinks)
        where = f"credentials of the agents: {access}/credentials/NODE.json"
        _run_live(loaded, world, folder, options, OutputOptions(log_format, quiet, report=report), where)


app.command(rich_help_panel=Panel.LIVE)(status)


@app.command("access", rich_help_panel=Panel.APART)
def write_access(
    scenario: ScenarioArgument,
    out: Annotated[Path, typer.Option(metavar="FOLDER", help="For the files.")] = Path("access"),
    listen: Annotated[
        str,
        typer.Option(
            metavar="ENDPOINT",
            help="Where the zenohd is to listen; at tls/HOST:PORT everybody gets a certificate.",
        ),
    ] = DEFAULT_LISTEN,
    tls_name: TlsNameOption = None,
    router_folder: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="Where the zenohd sees --out, if elsewhere (in a container)."),
    ] = None,
    overrides: SetOption = None,
) -> None:
    """Write the configuration of a separate router (zenohd) and everybody's credentials."""
    with one_line_errors():
        loaded = _load(scenario, overrides)
        users = _create_access(loaded, build_world(loaded), listen, tls_name or ())
        users.save(out, listen, router_folder or out.resolve())
        print(f"{len(users.processes)} agent processes, and the emulator, in {out}/credentials")
        print(f"start the router with: zenohd -c {shlex.quote(str(out / 'zenohd.json5'))}")


@app.command(rich_help_panel=Panel.AFTER)
def check(folder: Annotated[Path, typer.Argument(metavar="RUN", help="A run's folder.")]) -> None:
    """Judge a run again, from its files alone."""
    with one_line_errors():
        judgement = check_run(folder)
        print_checks(judgement, Console(), recorded_verdict(folder)["reproduce"])
        raise typer.Exit(judgement.exit_status)


@app.command(rich_help_panel=Panel.STUDIES)
def analyze(
    scenario: ScenarioArgument,
    run: Annotated[
        Path | None, typer.Option(metavar="RUN", help="Folder of a run: set beside what its filters did.")
    ] = None,
    overrides: SetOption = None,
) -> None:
    """What the graph says without a run: components, degrees, how well each rule of weights mixes."""
    from emulator.experiments.analyze import analysis_table
    from emulator.experiments.analyze import analyze as analyze_scenario

    with one_line_errors():
        Console().print(analysis_table(analyze_scenario(_load(scenario, overrides), run)))


@app.command(rich_help_panel=Panel.STUDIES)
def campaign(
    scenario: ScenarioArgument,
    runs: Annotated[int, typer.Option(min=1, metavar="N", help="How many runs.")] = 200,
    faults: Annotated[
        str, typer.Option(metavar="KINDS", help="random, or the kinds to draw from: kill,partition.")
    ] = "random",
    program: ProgramOption = None,
    seed: SeedOption = None,
    duration: DurationOption = None,
    out: Annotated[Path | None, typer.Option(metavar="FOLDER", help="For the campaign's files.")] = None,
    overrides: SetOption = None,
    jobs: Annotated[
        int | None, typer.Option(min=1, metavar="N", help="Runs at once. Default: as many as there are cores.")
    ] = None,
    shrink_steps: Annotated[
        int, typer.Option(min=0, max=50, metavar="N", help="Runs to shrink a failure with.")
    ] = 50,
    time_limit: Annotated[
        float, typer.Option(min=1.0, metavar="SECONDS", help="Wall clock that a run may take.")
    ] = 300.0,
) -> None:
    """Run a scenario many times under random faults, and shrink what fails to the least that still does."""
    fix_hash_seed("emulator.cli")
    from emulator.testing.campaign import Plan, run_campaign

    with one_line_errors():
        sys.path.append(str(Path.cwd()))
        loaded = _load(scenario, overrides, program, Pacing.LOCKSTEP, seed, duration)
        options = {"jobs": jobs} if jobs else {}
        plan = Plan.of(
            loaded, faults, runs, loaded.run.seed, limit_s=time_limit, shrink_steps=shrink_steps, **options
        )
        raise typer.Exit(run_campaign(plan, out, Console(stderr=True)))


@app.command(rich_help_panel=Panel.APART)
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
    from emulator.viewer.watch import record_run  # Rerun is slow to import, and only this command needs it

    with one_line_errors():
        login = None if credentials is None else Credentials.load(credentials)
        sinks = choose_sinks(rerun or ["save"], rerun_bind, rerun_port, rerun_vehicle)
        if sinks is None:
            raise VnetError("--rerun off: there is nothing to do")
        if sinks.serve is not None:
            print(sinks.serve.announcement(), file=sys.stderr, flush=True)
        record_run(connect, run, login, replace(sinks, save=out))


def _load(
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


def _create_access(scenario: Scenario, world: World, listen: str = "", tls_names: Sequence[str] = ()) -> Access:
    """New users of a run; with certificates where the router listens at tls/HOST:PORT."""
    groups = split_into_processes(world.node_ids, scenario.run.nodes_per_process)
    return Access.create(scenario.run.name, groups, certifier(listen, tls_names) if is_tls(listen) else None)


def _load_or_create_access(scenario: Scenario, world: World, folder: Path, listen: str, separate: bool) -> Access:
    """The users of a run whose agents are started by hand; written where they are not there yet."""
    if (folder / "access.json").exists() or separate:
        access = Access.load(folder)
        nodes = {node for process in access.processes for node in process}
        if access.run != scenario.run.name or nodes != set(world.node_ids):
            raise TransportError(
                f"access folder {folder} was made for another scenario; write a new one with: vnet access"
            )
        return access
    access = _create_access(scenario, world, listen)
    access.save(folder, listen, folder.resolve())
    return access


def _run_live(
    scenario: Scenario,
    world: World,
    folder: RunFolder,
    options: LiveOptions,
    asked: OutputOptions,
    first_of_all: str | None = None,
) -> None:
    """A live run from its folder to its summary; exits with the verdict's status."""
    quiet_zenoh()
    emulation = Emulation(scenario, world, folder)
    sinks = None if options.record is None else options.record.inside(folder.path)
    options = replace(options, record=sinks)
    with show_progress(emulation, asked.log_format, asked.quiet) as progress:
        if first_of_all is not None:
            progress.state(first_of_all)
        if sinks is not None and sinks.serve is not None:
            progress.state(sinks.serve.announcement())
        with signals_ignored():  # a second Ctrl-C must not lose the records
            running = run_live(emulation, options, progress.state, on_missing=progress.awaits)
            wall_s, interrupted = asyncio.run(running)
            _finish(emulation, progress, wall_s, interrupted, "run", asked)


def _check_vehicle(sinks: Sinks | None, world: World) -> None:
    """The vehicle to be looked at closely must be there."""
    if sinks is not None and sinks.vehicle is not None and sinks.vehicle not in world.node_ids:
        raise VnetError(f"--rerun-vehicle {sinks.vehicle}: no vehicle is called so")


def _check_restarts(scenario: Scenario, own_router: bool) -> None:
    """Only a router that the run itself has started can be restarted."""
    kinds = {fault.kind for fault in scenario.fault}
    if "router_restart" in kinds and not own_router:
        raise ScenarioError("fault router_restart: needs a router of its own: vnet run --router separate")


def _finish(
    emulation: Emulation, progress: Progress, wall_s: float, interrupted: bool, command: str, asked: OutputOptions
) -> None:
    """Judge a run and print its summary; exits with the verdict's status."""
    progress.judging()
    judgement, verdict = conclude(emulation, wall_s, command)
    progress.close()
    if asked.check_determinism and not interrupted:
        again = ["--quiet"] if asked.quiet or asked.log_format is LogFormat.JSON else []
        verdict = run_again(emulation, judgement, verdict, command, again)
    status = 130 if interrupted else judgement.exit_status
    folder = emulation.folder.path
    progress.ended(verdict, str(folder), status)
    if asked.log_format is LogFormat.JSON:
        print(json.dumps(verdict))
    elif asked.quiet:
        print(f"verdict: {judgement.verdict}  {folder}")
    else:
        print_summary(judgement, verdict, folder, Console(), asked.report)
    if asked.report:
        report_at_end(folder)
    raise typer.Exit(status)


def main() -> None:
    """The console script."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # a sign that a terminal does not know is no reason to fail
    sys.exit(run_app(app, sys.argv[1:]))
