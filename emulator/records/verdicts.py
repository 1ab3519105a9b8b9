"""The result of a check: valid, invalid or unknown, in words, figures and offending rows."""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ValidationError

from emulator.records.costs import RunCost
from emulator.records.period_figures import POSITION_FIGURES, KeyFigure, Views, shown_figures
from emulator.records.reported import ReportedFigure
from emulator.scenario.sections import first_problem, validated
from vnet.bounded import read_regular
from vnet.errors import VnetError
from vnet.units import title_of

MOST_ROWS = 10
"""Offending rows that a failed check shows."""
NO_FAULTS = "the scenario has no faults"


class Verdict(StrEnum):
    """Verdict of a check, or of a run."""

    VALID = "valid"
    INVALID = "invalid"
    UNKNOWN = "unknown"

    @property
    def exit_status(self) -> int:
        """The exit status of a command that ends with this verdict."""
        return {Verdict.VALID: 0, Verdict.INVALID: 1, Verdict.UNKNOWN: 3}[self]


WORST_FIRST = (Verdict.INVALID, Verdict.UNKNOWN, Verdict.VALID)


@dataclass(frozen=True)
class CheckResult:
    """One check's verdict, in words and figures. `figures["rows"]` of one that failed are its first offenders."""

    name: str
    verdict: Verdict
    text: str
    figures: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class NotExercised:
    """A check that this run could not exercise, and why."""

    name: str
    reason: str


Finding = CheckResult | NotExercised
F = TypeVar("F", CheckResult, NotExercised, Finding)


@dataclass(frozen=True)
class Judgement:
    """All checks of a run and what they come to together: invalid wins over unknown, unknown over valid."""

    checks: list[CheckResult]
    not_exercised: list[NotExercised]
    trace_sha256: str

    @property
    def verdict(self) -> Verdict:
        """The verdict of the run."""
        verdicts = {check.verdict for check in self.checks}
        for verdict in (Verdict.INVALID, Verdict.UNKNOWN):
            if verdict in verdicts:
                return verdict
        return Verdict.VALID

    @property
    def not_applicable(self) -> dict[str, list[str]]:
        """Names of the checks that the run could not exercise, by reason."""
        names: dict[str, list[str]] = {}
        for left in self.not_exercised:
            names.setdefault(left.reason, []).append(left.name)
        return names

    @property
    def exit_status(self) -> int:
        """The exit status of a command that ends with this judgement."""
        return self.verdict.exit_status

    def put(self, finding: Finding) -> None:
        """Add a finding, in place of what was found under its name."""
        self.checks[:] = [check for check in self.checks if check.name != finding.name]
        self.not_exercised[:] = [left for left in self.not_exercised if left.name != finding.name]
        if isinstance(finding, CheckResult):
            self.checks.append(finding)
        else:
            self.not_exercised.append(finding)


# Findings are made without the name of their check, which whoever lists the check gives them.


def named(name: str, finding: F) -> F:
    """Return a finding as that of the check of this name."""
    return replace(finding, name=name)


def valid(text: str, /, **figures: Any) -> CheckResult:
    """A check that has found nothing wrong."""
    return CheckResult("", Verdict.VALID, text, figures)


def invalid(text: str, /, **figures: Any) -> CheckResult:
    """A check that has found something wrong."""
    return CheckResult("", Verdict.INVALID, text, figures)


def unknown(text: str, /, **figures: Any) -> CheckResult:
    """A check that should have seen something, and did not."""
    return CheckResult("", Verdict.UNKNOWN, text, figures)


def not_exercised(reason: str) -> NotExercised:
    """A check that this run could not exercise, and why."""
    return NotExercised("", reason)


def result(
    broken: int, text: str, broken_text: str, rows: list[dict[str, Any]] | None = None, /, **figures: Any
) -> CheckResult:
    """Invalid with its offending rows where anything is broken, else valid."""
    return invalid(broken_text, **figures, rows=(rows or [])[:MOST_ROWS]) if broken else valid(text, **figures)


LARGEST_BYTES = 64 * 2**20
FIRST_WITH_RATIO = 5
"""The first format whose packet delivery ratio is at receivers that are up."""
RENAMED_CHECKS = {"bit:": "effect:"}
"""Prefixes of the names of checks: that of format 1, and today's."""


@dataclass(frozen=True)
class Record:
    """The fields of `verdict.json`; lengths in metres, times in seconds."""

    format: int
    verdict: Verdict
    checks: list[CheckResult]
    not_exercised: list[NotExercised]
    trace_sha256: str
    emulated_s: float
    wall_s: float
    seed: int
    vehicles: int
    frames_by_outcome: dict[str, int]
    figures: dict[str, float | None]
    reproduce: str
    real_time_factor: float | None = None
    start_up_s: float | None = None
    metrics_sha256: str = ""
    packet_delivery_ratio: float | None = None
    reported: dict[str, ReportedFigure] = field(default_factory=dict)
    driving: dict[str, float | None] = field(default_factory=dict)
    backbone: dict[str, int] = field(default_factory=dict)
    roadside_units: int = 0
    cost: RunCost | None = None
    order: dict[str, Any] | None = None
    versions: dict[str, str] = field(default_factory=dict)
    key_figures: list[KeyFigure] = field(default_factory=list)
    """Those of `figures` that sum the run up, as its program declares them."""
    views: Views | None = None
    """Its program's declarations for views; None in folders of an earlier vnet."""

    @property
    def judgement(self) -> Judgement:
        """The checks as they were judged."""
        return Judgement(self.checks, self.not_exercised, self.trace_sha256)

    @property
    def shown_figures(self) -> list[tuple[KeyFigure, float]]:
        """The key figures that the run has."""
        return shown_figures(self.key_figures, self.figures)

    @property
    def in_range(self) -> int:
        """Number of attempted receptions: one frame at one receiver in range."""
        return sum(count for outcome, count in self.frames_by_outcome.items() if outcome != "out_of_range")

    def share_of(self, outcome: str) -> float | None:
        """Share of the attempted receptions with this outcome, copies and retries included; None without any."""
        return self.frames_by_outcome.get(outcome, 0) / self.in_range if self.in_range else None


def read_record(path: Path) -> Record:
    """Read a verdict.json. Raises OSError, and VnetError where it is not what vnet writes."""
    try:
        data = json.loads(read_regular(path, LARGEST_BYTES))
        record = validated(Record, data)
    except ValidationError as error:
        raise VnetError(f"{path}: {first_problem(error, Record)}") from None
    except (ValueError, RecursionError) as error:
        raise VnetError(f"{path}: not JSON: {error}") from None
    if "key_figures" not in data:  # of an earlier vnet, whose figures have no titles
        own = [each.name for each in POSITION_FIGURES]
        others = [
            KeyFigure(name, title_of(name)) for name in record.figures if name[-2:] == "_m" and name not in own
        ]
        record = replace(record, key_figures=[*others, *POSITION_FIGURES])
    if record.format < FIRST_WITH_RATIO:  # which also counted receivers that were down, or left the ratio out
        ratio = data.get("packet_delivery_ratio", record.share_of("delivered"))
        down = record.frames_by_outcome.get("receiver_down")
        record = replace(record, packet_delivery_ratio=None if down else ratio)
    return replace(
        record,
        checks=[replace(check, name=_new_name(check.name)) for check in record.checks],
        not_exercised=[replace(check, name=_new_name(check.name)) for check in record.not_exercised],
    )


def _new_name(check: str) -> str:
    """The name that a check has now."""
    for old, new in RENAMED_CHECKS.items():
        if check.startswith(old):
            return new + check.removeprefix(old)
    return check
