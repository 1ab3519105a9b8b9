"""Checks of a user's own: functions of a `Run` that yield results, which stand in the verdict beside vnet's.

`[program] checks` and `--check` name them; programs declare others. They run in the emulator's process once the
tables are written. A function that raises, or answers nonsense, makes a check *unknown* that bears its name and
says how; it stops nothing else.
"""

from __future__ import annotations

import json
import re
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import chdir
from itertools import islice
from typing import Any, NamedTuple

import numpy as np

from emulator.records.events import Event, EventKind
from emulator.records.recorded_run import RecordedRun
from emulator.records.run import Run
from emulator.records.verdicts import (
    MOST_ROWS,
    CheckResult,
    Finding,
    NotExercised,
    Record,
    Verdict,
    invalid,
    named,
    not_exercised,
    unknown,
    valid,
)
from emulator.scenario.faults import OwnRule
from emulator.scenario.own_functions import declared_checks, in_words, line_of, load_entry, load_function, outside
from emulator.scenario.program import Program
from vnet.errors import VnetError, counted, printable, shown
from vnet.runtime.programs import search_programs_in
from vnet.units import NS_PER_S

PREFIX = "own:"
"""Names of own checks begin with it, so that none is taken for one of vnet's."""
NOT_APPLICABLE = "not applicable"
VERDICTS = (*(verdict.value for verdict in Verdict), NOT_APPLICABLE)
MOST_RESULTS = 1000
"""Results of one function; a generator that yields without end is stopped."""
LONGEST_TEXT = 2000
INTEGERS = 2**63
"""Bound of integers, which are columns of tables in sweeps."""
LARGEST_FIGURES_BYTES = 1_000_000
"""Size of one result's figures in verdict.json."""
_NAME = re.compile(r"[A-Za-z]\w{0,63}", re.ASCII)


class Result(NamedTuple):
    """One result of a check; a plain tuple of the same values does as well."""

    name: str
    """Name of the check: letters, digits and _; the verdict calls it `own:NAME`."""
    verdict: str
    """Verdict: "valid", "invalid", "unknown" or "not applicable"."""
    text: str
    """Text in one line: the observation, or the reason of a check that is not applicable."""
    figures: Mapping[str, Any] = {}
    """Figures by name: finite numbers, booleans, texts, None, and lists and tables of these. `rows`, a list of
    tables, are the offending rows, of which the first ten are shown."""


CheckFunction = Callable[[Run], Any]


class _NonsenseError(VnetError):
    """An answer that is no result."""


def load_checks(program: Program) -> dict[str, CheckFunction]:
    """Import a scenario's own checks, by entry. Raises VnetError for one that cannot be imported."""
    search_programs_in(program.folders)
    usage = "of a run: def {}(run)"
    return {entry: load_function("program.checks", entry, program, usage) for entry in program.checks}


def own_findings(program: Program, run: Run) -> list[Finding]:
    """Judge a run by the checks that its programs declare, and by its own.

    Ctrl-C ends them; those that are left are unknown.
    """
    findings: dict[str, Finding] = {}
    interrupted = False
    for entry in dict.fromkeys([*declared_checks(program), *program.checks]):
        try:
            if interrupted:
                raise KeyboardInterrupt
            with chdir("."):  # afterwards here again, wherever it has gone
                for finding in _findings_of(entry, program, run):
                    if finding.name in findings:
                        name = finding.name.removeprefix(PREFIX)
                        raise _NonsenseError(f"yields {name!r}, which is there already")
                    findings[finding.name] = finding
        except KeyboardInterrupt:
            interrupted = True
            findings[_broken(entry)] = named(_broken(entry), unknown("interrupted"))
        except (Exception, SystemExit) as error:
            findings[_broken(entry)] = _unknown(entry, error)
    return list(findings.values())


def _broken(entry: str) -> str:
    """Name of the check that tells of a function that failed; a dot tells it from the name of a result."""
    return f"{PREFIX}{entry.replace(':', '.')}"


def _unknown(entry: str, error: BaseException) -> CheckResult:
    """Say how a function failed, and where in its own module."""
    if isinstance(error, _NonsenseError):
        return named(_broken(entry), unknown(str(error)))
    said = str(error) if isinstance(error, VnetError) else f"raises {in_words(error)}"
    frames = outside(error, __file__)
    if frames is None:
        return named(_broken(entry), unknown(said))
    where = "".join(traceback.format_exception(error.with_traceback(frames)))
    return named(_broken(entry), unknown(f"{said} ({line_of(frames)})", where=where))


def _findings_of(entry: str, program: Program, run: Run) -> Iterator[Finding]:
    if entry.endswith(":CHECKS"):  # what a program declares, and no entries
        raise VnetError(f'{entry} = {shown(load_entry(entry))}: a list of "module:function" is needed')
    check = load_checks(program.model_copy(update={"checks": (entry,)}))[entry]
    answer = check(run)
    if isinstance(answer, tuple) and answer and isinstance(answer[0], str):
        answer = [answer]
    if not isinstance(answer, Iterable) or isinstance(answer, (str, bytes, Mapping)):
        raise _NonsenseError(f"answers {shown(answer)}: results are needed, as (name, verdict, text)")
    count, nonsense = 0, None
    for count, result in enumerate(islice(answer, MOST_RESULTS + 1), start=1):
        if count > MOST_RESULTS:
            raise _NonsenseError(f"yields more than {MOST_RESULTS} results")
        try:
            finding = finding_of(result)
        except _NonsenseError as error:  # the results after it count all the same
            nonsense = nonsense or error
            continue
        yield finding
    if nonsense is not None:
        raise nonsense
    if not count:
        raise _NonsenseError("yields no result")


def finding_of(answer: Any) -> Finding:
    """Return a result as a finding. Raises VnetError for one that is none."""
    if not isinstance(answer, (tuple, list)) or not 3 <= len(answer) <= 4:
        raise _NonsenseError(f"yields {shown(answer)}: a result is (name, verdict, text) or has figures besides")
    result = Result(*answer)
    if not isinstance(result.name, str) or not _NAME.fullmatch(result.name):
        raise _NonsenseError(f"yields the name {shown(result.name)}: letters, digits and _, at most 64")
    if not isinstance(result.verdict, str) or result.verdict not in VERDICTS:
        raise _NonsenseError(
            f"{result.name}: yields verdict = {shown(result.verdict)}: must be one of {', '.join(VERDICTS)}"
        )
    if not isinstance(result.text, str):
        raise _NonsenseError(f"{result.name}: yields text = {shown(result.text)}: must be a text")
    name, text = PREFIX + result.name, printable(result.text, LONGEST_TEXT)
    if result.verdict == NOT_APPLICABLE:
        return NotExercised(name, text or "says no reason")
    return CheckResult(name, Verdict(result.verdict), text, _figures(result))


def _figures(result: Result) -> dict[str, Any]:
    """Return the figures as JSON holds them. Raises _NonsenseError."""
    if not isinstance(result.figures, Mapping):
        raise _NonsenseError(f"{result.name}: yields figures = {shown(result.figures)}: a table is needed")
    figures = {
        str(name): _plain(f"{result.name}: figures[{name!r}]", each) for name, each in result.figures.items()
    }
    if (size := len(json.dumps(figures))) > LARGEST_FIGURES_BYTES:
        raise _NonsenseError(f"{result.name}: yields {size:,} bytes of figures: {LARGEST_FIGURES_BYTES:,} at most")
    if isinstance(rows := figures.get("rows"), list):
        if not all(isinstance(row, dict) for row in rows):
            raise _NonsenseError(
                f"{result.name}: figures['rows'] holds what is no table: a list of tables is needed"
            )
        figures["rows"] = rows[:MOST_ROWS]
    return figures


def _plain(what: str, value: Any) -> Any:
    """Return a figure as numbers, booleans, texts, None, and lists and tables of these. Raises _NonsenseError."""
    if isinstance(value, (np.generic, np.ndarray)):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {str(name): _plain(f"{what}[{name!r}]", each) for name, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(what, each) for each in value]
    if isinstance(value, float) and not np.isfinite(value):
        raise _NonsenseError(f"{what} = {value}: must be finite, or None")
    if isinstance(value, int) and not -INTEGERS <= value < INTEGERS:
        raise _NonsenseError(f"{what} = {shown(value)}: an integer must be within ±2**63; float(…) may be larger")
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    raise _NonsenseError(f"{what} = {shown(value)}: must be a number, a boolean, a text, None, or a list or table")


def recorded_findings(record: Record) -> list[Finding]:
    """Return the findings of own checks that a folder's verdict holds."""
    findings: list[Finding] = [*record.checks, *record.not_exercised]
    return [finding for finding in findings if finding.name.startswith(PREFIX)]


def check_own_rules(recorded: RecordedRun) -> Finding:
    """Check that no rule of the user's own raised, answered nonsense, or did not answer at all."""
    rules = [fault for fault in recorded.scenario.fault if isinstance(fault, OwnRule)]
    failed = recorded.event(EventKind.rule_failed)
    sensors = recorded.scenario.world.sensor
    if not rules and not sensors and not failed:
        return not_exercised("no rule and no sensor of your own")
    answered = [f"{counted(len(rules), 'rule')} of your own answered every frame"] if rules else []
    answered += [f"{counted(len(sensors), 'sensor')} of your own answered every period"] if sensors else []
    text = " and ".join(answered)
    if not failed:
        return valid(text, failed=0)
    return invalid("; ".join(map(_told, failed)), failed=len(failed), rows=list(map(_row, failed))[:MOST_ROWS])


def _told(event: Event) -> str:
    said = event.details
    when = f"at {event.time_ns / NS_PER_S:.3f} s"
    if (sender := said.get("sender")) is not None:
        when += f", on a frame of {sender}"
    return f"{said.get('fault')} ({said.get('rule')}) {said.get('error')}, {when}"


def _row(event: Event) -> dict[str, Any]:
    return {"time_ns": event.time_ns, **event.details}
