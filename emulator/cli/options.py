"""Options that several commands share, and the scenario that they load."""

from __future__ import annotations

import json
import math
import re
import sys
from collections.abc import Callable
from dataclasses import MISSING, dataclass, fields
from functools import wraps
from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import Annotated, Any, Literal, get_type_hints

import typer

from emulator.scenario.loading import load_scenario
from emulator.scenario.program import from_here
from emulator.scenario.scenario import Scenario
from emulator.terminal.console import LogFormat
from vnet.errors import OverrideError, ScenarioError, VnetError, printable
from vnet.runtime.debug_target import DebugTarget, resolve

DEFAULT_ADDRESS = "127.0.0.1:7447"
DEFAULT_LISTEN = f"tcp/{DEFAULT_ADDRESS}"
LATEST = Path("runs/latest")
Pacing = Literal["lockstep", "realtime"]
Order = Literal["fifo", "shuffle", "pct"]


def path_of(text: str | Path) -> Path:
    """Return a path that an option or an argument names. Raises BadParameter for an empty one and for a URL."""
    if not text:
        raise typer.BadParameter("'': a path is needed")
    if isinstance(text, Path):  # a default
        return text
    if re.match(r"[A-Za-z][A-Za-z0-9+.-]*://", text):
        raise typer.BadParameter(f"{printable(text)!r}: a path of this machine is needed, not a URL")
    return Path(text)


def pair(option: str, text: str | None) -> tuple[float, float] | None:
    """Return two numbers that `option` gives, with a comma between them. Raises ScenarioError for anything else."""
    if text is None:
        return None
    try:
        first, second = (float(part) for part in text.split(","))
    except ValueError:
        first = second = float("nan")
    if not (math.isfinite(first) and math.isfinite(second)):
        raise ScenarioError(f"{option} {text}: two numbers with a comma between them are needed")
    if option == "--origin" and not (abs(first) <= 90 and abs(second) <= 180):
        raise ScenarioError(f"{option} {text}: latitudes are within ±90, longitudes within ±180")
    return first, second


ScenarioArgument = Annotated[
    Path,
    typer.Argument(
        parser=path_of, metavar="SCENARIO", help="A scenario file (TOML), or the name of one that is shipped."
    ),
]
ProgramOption = Annotated[
    str | None,
    typer.Option(
        metavar="PROGRAM", help="Program of every vehicle: hello.py, hello.py:main or package.hello:main."
    ),
]
ProgramOptionsOption = Annotated[
    list[str] | None,
    typer.Option(
        "--option", metavar="KEY=VALUE", help="Option of the program: short for --set program.options.KEY=VALUE."
    ),
]
ChecksOption = Annotated[
    list[str] | None,
    typer.Option("--check", metavar="CHECK", help="Check of your own, as my_checks.py:check. May be repeated."),
]
PacingOption = Annotated[
    Pacing | None,
    typer.Option(
        help="lockstep: virtual time, the same on every machine. realtime: the wall clock. Default: the scenario's."
    ),
]
OrderOption = Annotated[
    Order | None,
    typer.Option(
        help="In which order a vehicle is shown what happens at one instant. Default: the scenario's, or fifo."
    ),
]
OrderSeedOption = Annotated[int | None, typer.Option(metavar="N", help="Seed of the order: another, other orders.")]
TapeOption = Annotated[
    Path | None,
    typer.Option(parser=path_of, metavar="FILE", help="Deviations from FIFO to follow: tape.jsonl of another run."),
]
SeedOption = Annotated[int | None, typer.Option(metavar="N", help="Random seed: same seed, same run.")]
DurationOption = Annotated[float | None, typer.Option(metavar="SECONDS", help="Emulated length of the run.")]
OutOption = Annotated[
    Path | None,
    typer.Option(parser=path_of, metavar="FOLDER", help="Folder of the run's files. Default: runs/NAME-SEED."),
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
    Literal["layouts", "portable"] | None,
    typer.Option(
        "--check-determinism",
        metavar="[=portable]",
        help="Run it again live or simulated, in other processes, without windows and at other addresses, and show "
        "the first frame, vehicle and line that differ. portable: note, too, how it is with another hash seed.",
    ),
]
LogFormatOption = Annotated[
    LogFormat, typer.Option(help="json: an object a line on stderr, and verdict.json in one line on stdout.")
]
VerboseOption = Annotated[
    bool, typer.Option("--verbose", "-v", metavar="", help="List all checks, not only those that are not valid.")
]
QuietOption = Annotated[bool, typer.Option("--quiet", metavar="", help="Only errors, and the verdict in one line.")]
DebugOption = Annotated[
    str | None,
    typer.Option(
        metavar="ID",
        help="Stop a debugger (pdb) in this vehicle's program, at its first line, or as v03:hello.py:12.",
    ),
]
AgentOption = Annotated[
    str | None,
    typer.Option(
        metavar="COMMAND",
        help="Have each vehicle be this command in place of vnet-agent. It must have {endpoint}, {run}, {node} and "
        "{credentials}.",
    ),
]
ProcessesOption = Annotated[
    str,
    typer.Option(
        metavar="N|auto",
        help="Run the programs in so many processes, side by side; auto: as many as there are cores.",
    ),
]
ReportOption = Annotated[
    bool, typer.Option("--report/--no-report", help="Write report.html into the run's folder at the end.")
]
HostsOption = Annotated[
    str | None,
    typer.Option(
        metavar="NAMES",
        help="Hosts of the vehicles, in equal parts (experimental): a,b,c. On each: vnet host --name NAME.",
    ),
]
RunArgument = Annotated[Path, typer.Argument(parser=path_of, metavar="RUN", help="A run's folder.")]
RerunBindOption = Annotated[
    str | None, typer.Option(metavar="ADDRESS", help="Where to serve; the default is 127.0.0.1, this machine only.")
]
RerunPortOption = Annotated[
    int | None, typer.Option(help="Viewers connect here, browsers to the next port; by default 9876, if free.")
]
RerunVehicleOption = Annotated[
    str | None, typer.Option(metavar="ID", help="The vehicle that has a tab of its own; by default the first.")
]


@dataclass(frozen=True)
class RunOptions:
    """Options of each command that runs one scenario."""

    scenario: ScenarioArgument
    program: ProgramOption = None
    seed: SeedOption = None
    duration: DurationOption = None
    order: OrderOption = None
    order_seed: OrderSeedOption = None
    tape: TapeOption = None
    out: OutOption = None
    overrides: SetOption = None
    option: ProgramOptionsOption = None
    checks: ChecksOption = None
    rerun: RerunOption = None
    rerun_vehicle: RerunVehicleOption = None
    log_format: LogFormatOption = LogFormat.TEXT
    quiet: QuietOption = False
    verbose: VerboseOption = False
    report: ReportOption = True

    @property
    def only_the_result(self) -> bool:
        """True if standard output is for the result alone, and not for what programs print."""
        return self.quiet or self.log_format is LogFormat.JSON

    def load(self, pacing: Pacing | None) -> Scenario:
        """Load the scenario as these options change it. Raises VnetError."""
        return load(
            self.scenario,
            self.overrides,
            program=self.program,
            pacing=pacing,
            seed=self.seed,
            duration=self.duration,
            program_options=self.option,
            checks=self.checks,
            order=self.order,
            order_seed=self.order_seed,
            tape=self.tape,
        )


@dataclass(frozen=True)
class LiveOptions(RunOptions):
    """Those of each command that runs it live."""

    pacing: PacingOption = None
    rerun_bind: RerunBindOption = None
    rerun_port: RerunPortOption = None


def spread(command: Callable[..., None]) -> Callable[..., None]:
    """Return a command that takes the fields of its first parameter, a dataclass, as options of its own."""
    options, *others = signature(command, eval_str=True).parameters.values()
    hints = get_type_hints(options.annotation, include_extras=True)
    defaults = {
        each.name: Parameter.empty if each.default is MISSING else each.default
        for each in fields(options.annotation)
    }

    @wraps(command)
    def spread_out(**given: Any) -> None:
        own = {each.name: given.pop(each.name) for each in others if each.name in given}
        command(options.annotation(**given), **own)

    kind = Parameter.KEYWORD_ONLY
    shared = [Parameter(name, kind, default=default, annotation=hints[name]) for name, default in defaults.items()]
    every = [*shared, *(each.replace(kind=kind) for each in others)]
    spread_out.__signature__ = Signature(every)  # type: ignore[attr-defined]
    spread_out.__annotations__ = {each.name: each.annotation for each in every}
    return spread_out


def host_names(names: str | None) -> list[str]:
    """Return the names in `--hosts a,b,c`. Raises ScenarioError for an empty one."""
    found = [] if names is None else [name.strip() for name in names.split(",")]
    if not all(found):
        raise ScenarioError(f"--hosts {printable(names or '')!r}: write names as a,b,c")
    return found


def load(
    path: Path,
    overrides: list[str] | None,
    program: str | None = None,
    pacing: Pacing | None = None,
    seed: int | None = None,
    duration: float | None = None,
    program_options: list[str] | None = None,
    checks: list[str] | None = None,
    order: Order | None = None,
    order_seed: int | None = None,
    tape: Path | None = None,
) -> Scenario:
    """Load a scenario as the options of a command change it. Raises VnetError."""
    options = {
        "program.entry": ("--program", program and json.dumps(from_here(program))),
        "run.pacing": ("--pacing", pacing and f'"{pacing}"'),
        "run.seed": ("--seed", seed),
        "run.duration_s": ("--duration", duration),
        "run.order": ("--order", order and f'"{order}"'),
        "run.order_seed": ("--order-seed", order_seed),
        "run.tape": ("--tape", tape and json.dumps(str(tape.absolute()))),
    }
    given = {key: pair for key, pair in options.items() if pair[1] is not None}
    own = [_program_option(option) for option in program_options or ()]
    if not all(map(str.strip, checks or ())):
        raise ScenarioError("--check '': write it as my_checks.py:check")
    try:
        scenario = load_scenario(
            path,
            [*(overrides or []), *own, *(f"{key}={value}" for key, (_, value) in given.items())],
            [from_here(each) for each in checks or ()],
        )
    except OverrideError as error:
        chosen, _ = given.get(error.key, ("--set", None))
        if any(each.startswith(f"{error.key}=") for each in own):
            chosen = "--option"
        raise ScenarioError(f"{chosen}: {error}") from None
    if order_seed is not None and scenario.run.order == "fifo" and not scenario.run.order_slack_us:
        is_fifo = scenario.run.tape is None
        kind, hint = ("FIFO", "; add --order shuffle") if is_fifo else ("that of the tape", "")
        raise ScenarioError(f"--order-seed {order_seed}: the order is {kind}, which has no seed{hint}")
    return scenario


def _program_option(option: str) -> str:
    key, equals, _ = option.partition("=")
    if not equals or not key.strip():
        raise ScenarioError(f"--option {printable(option)}: write it as KEY=VALUE, for example period_s=2")
    return f"program.options.{option}"


def debug_target(text: str | None, scenario: Scenario, only_the_result: bool) -> DebugTarget | None:
    """Return where a debugger is to stop, None for nowhere. Raises VnetError where there can be none.

    Its user needs the terminal, which `only_the_result` takes away.
    """
    if text is None:
        return None
    target = resolve(DebugTarget.parse(text), scenario.program.folders, scenario.program.kind == "zenoh")
    if only_the_result:
        raise VnetError(f"--debug {target.node}: cannot be combined with --quiet or --log-format json")
    if scenario.run.pacing != "lockstep":
        raise VnetError(f"--debug {target.node}: real time cannot be stopped; use --pacing lockstep")
    if not _at_a_terminal():
        raise VnetError(f"--debug {target.node}: needs a terminal on standard input and output")
    return target


def _at_a_terminal() -> bool:
    return sys.stdin is not None and sys.stdin.isatty() and sys.stdout.isatty()
