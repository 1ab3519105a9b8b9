"""The repetition of a run in other ways, each of which gives the same trace unless the program is nondeterministic.

The ways differ in what is likely to change a trace: live or simulated, the division into processes, windows, and
the addresses of objects. Another hash seed is tried on request, and never judged: vnet fixes it.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from emulator.checks.judge import Judgement, Verdict
from emulator.checks.replay import CALLS, check_replay, compare_runs
from emulator.drivers.conclude import judge_further
from emulator.drivers.emulation import Emulation
from emulator.records.recorded_run import RecordedRun
from emulator.records.run_folder import AGAIN
from emulator.records.verdicts import CheckResult, Finding, named, unknown
from vnet.errors import VnetError
from vnet.runtime.replay_probes import CALLS_VARIABLE, SCATTER_VARIABLE

MOST_LIVE = 100
"""Vehicles of a simulation above which it is not repeated live: each is a process."""
LAYOUTS, PORTABLE = "layouts", "portable"
"""Comparisons: of layouts of processes and addresses, and beyond them with another hash seed."""
OTHER_HASH_SEED = "1"
_MODULE = ("-m", "emulator")
_AS_IT_IS = (
    "-c",
    "import sys; from emulator.cli.application import build_app; from emulator.terminal.console import run_app; "
    "sys.exit(run_app(build_app(), sys.argv[1:]))",
)
"""The command `vnet` in an interpreter that keeps its hash seed."""


@dataclass(frozen=True)
class Repetition:
    """One repetition of a run: its name in messages, its command line, and its own variables of the environment."""

    name: str
    arguments: tuple[str, ...]
    environment: Mapping[str, str] = field(default_factory=dict)
    interpreter: tuple[str, ...] = _MODULE

    def run(self, scenario: Path, folder: Path, options: Sequence[str]) -> int:
        """Make the repetition in a process of its own; returns its exit status."""
        command, *arguments = self.arguments
        arguments = [command, str(scenario), "--out", str(folder), "--no-report", *arguments, *options]
        environment = {**os.environ, CALLS_VARIABLE: str((folder / CALLS).absolute()), **self.environment}
        # A process of its own: nothing that a program has left in this one may help it to agree with itself.
        return subprocess.run(
            [sys.executable, "-P", *self.interpreter, *arguments], stdout=subprocess.DEVNULL, env=environment
        ).returncode


def repetitions(command: str, emulation: Emulation) -> Iterator[Repetition]:
    """Yield the repetitions of a run that `vnet COMMAND` has made, the cheapest first."""
    yield Repetition(
        "simulated in 2 processes, without windows, at other addresses",
        ("simulate", "--processes", "2", "--set", "run.windows=false"),
        {SCATTER_VARIABLE: "1"},
    )
    if command == "run":
        yield Repetition("simulated in one process, at other addresses", ("simulate",), {SCATTER_VARIABLE: "2"})
    elif len(emulation.world.node_ids) <= MOST_LIVE:
        kinds = {fault.kind for fault in emulation.scenario.fault}
        router = ("--router", "separate") if "router_restart" in kinds else ()
        yield Repetition("live, at other addresses", ("run", *router), {SCATTER_VARIABLE: "2"})


@contextmanager
def _set(variable: str, value: str) -> Iterator[None]:
    os.environ[variable] = value
    try:
        yield
    finally:
        del os.environ[variable]


def calls_recorded(folder: Path, asked: bool) -> AbstractContextManager[None]:
    """Have the programs of a run write down from which lines they send and report, if asked."""
    return _set(CALLS_VARIABLE, str((folder / CALLS).absolute())) if asked else nullcontext()


def scattered() -> AbstractContextManager[None]:
    """Have objects of programs get other addresses in this process and those forked from it."""
    return _set(SCATTER_VARIABLE, "1")


def run_again(
    emulation: Emulation,
    judgement: Judgement,
    verdict: dict[str, Any],
    command: str,
    compared: str,
    options: Sequence[str] = (),
) -> dict[str, Any]:
    """Repeat a concluded run until a repetition differs, and add to its verdict how they compare.

    The last repetition stays in the folder `again`. Returns the new contents of verdict.json.
    """
    path = emulation.folder.path
    agreeing: list[str] = []
    finding: Finding = named("replay", unknown("was not repeated"))
    alive = next((check for check in judgement.checks if check.name == "agents_alive"), finding)
    gone = alive.figures.get("gone", ()) if isinstance(alive, CheckResult) else ()
    if ended := [each["node"] for each in gone if each["kind"] == "died" and "where" not in each]:
        why = f"the process of {ended[0]} ended, at an instant that depends on processes and windows"
        finding = named("replay", unknown(f"was not repeated: {why}"))
    for repetition in () if ended else repetitions(command, emulation):
        shutil.rmtree(path / AGAIN, ignore_errors=True)
        status = repetition.run(emulation.folder.scenario_path, path / AGAIN, options)
        finding = _compared(path, repetition, status, agreeing)
        if not isinstance(finding, CheckResult) or finding.verdict is not Verdict.VALID:
            break
        agreeing.append(repetition.name)
    else:
        if compared == PORTABLE and not ended:
            finding = _with_note(finding, _other_hash_seed(emulation, options))
    asked = "" if compared == LAYOUTS else f"={compared}"
    verdict = {**verdict, "reproduce": f"{verdict['reproduce']} --check-determinism{asked}"}
    return judge_further(emulation, judgement, verdict, [finding])


def _compared(path: Path, repetition: Repetition, status: int, agreeing: Sequence[str]) -> Finding:
    """Return the finding on the repetition in a run's folder `again`; `agreeing` are those before it."""
    if status not in {each.exit_status for each in Verdict}:
        return named("replay", unknown(f"the run {repetition.name} ended with status {status}"))
    finding = check_replay(path)
    if not isinstance(finding, CheckResult):
        return finding
    if finding.verdict is Verdict.VALID:
        return _with_note(finding, f"repeated {'; '.join([*agreeing, repetition.name])}")
    return _with_note(finding, f"again: {repetition.name}")


def _with_note(finding: Finding, note: str) -> Finding:
    if not isinstance(finding, CheckResult):
        return finding
    return CheckResult(finding.name, finding.verdict, f"{finding.text}; {note}", finding.figures)


def _other_hash_seed(emulation: Emulation, options: Sequence[str]) -> str:
    """Simulate the run with another hash seed; returns a note on how it compares."""
    name = f"with another hash seed (PYTHONHASHSEED={OTHER_HASH_SEED})"
    other = Repetition(name, ("simulate",), {"PYTHONHASHSEED": OTHER_HASH_SEED}, _AS_IT_IS)
    with TemporaryDirectory(prefix="vnet-hash-seed-") as place:
        folder = Path(place) / "run"
        status = other.run(emulation.folder.scenario_path, folder, options)
        if status not in {each.exit_status for each in Verdict}:
            return f"note: {name} it ended with status {status}"
        try:
            finding = compare_runs(*map(RecordedRun.open, (emulation.folder.path, folder)))
        except VnetError as error:
            return f"note: {name} it cannot be compared: {error}"
    if finding.verdict is Verdict.VALID:
        return f"note: {name} it agrees, too"
    return f"note: {name}, which vnet fixes at 0, {finding.text}"
