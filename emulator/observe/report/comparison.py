"""Two runs side by side: what was asked of them, what became of it, and where they first differ."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
from rich.console import Console
from rich.table import Table
from rich.text import Text

from emulator.observe.checks.replay import compare, read_tables
from emulator.observe.checks.verdicts import CheckResult, Finding, Verdict
from emulator.observe.report.record import Record
from emulator.observe.report.source import Source
from emulator.observe.summary import FIGURES, STYLE, offending
from vnet.errors import VnetError
from vnet.scenario import Scenario

Row = tuple[str, str, str, str]
"""What is compared, of the first run, of the second, and the difference."""


@dataclass(frozen=True)
class Comparison:
    """Two finished runs. `first_difference` says in which row of which table they part."""

    first: Source
    second: Source
    first_difference: Finding

    @classmethod
    def of(cls, first: Path, second: Path) -> Comparison:
        """Compare the runs in two folders. Raises VnetError if one is not a finished run's."""
        sources = Source(first), Source(second)
        for source in sources:
            _ = source.record, source.scenario
        try:
            tables = read_tables(first, second)
        except (OSError, pa.ArrowException) as error:
            raise VnetError(f"{first}, {second}: a table cannot be read: {error}") from None
        return cls(*sources, compare(tables, (str(first), str(second))))

    @property
    def records(self) -> tuple[Record, Record]:
        """Both verdict.json."""
        return self.first.record, self.second.record

    @property
    def same_trace(self) -> bool:
        """Whether every frame had the same fate in both."""
        return self.records[0].trace_sha256 == self.records[1].trace_sha256

    def scenario_rows(self) -> list[Row]:
        """The keys of the scenarios that differ."""
        ours, theirs = _flat(self.first.scenario), _flat(self.second.scenario)
        keys = [key for key in {**ours, **theirs} if ours.get(key) != theirs.get(key)]
        return [(key, _told(ours.get(key)), _told(theirs.get(key)), "") for key in keys]

    def check_rows(self) -> list[Row]:
        """The checks whose verdicts differ, and the runs' verdicts."""
        ours, theirs = ({check.name: check.verdict.value for check in record.checks} for record in self.records)
        one, other = self.records
        rows = [("the run", one.verdict.value, other.verdict.value, "")]
        for name in {**ours, **theirs}:
            if ours.get(name) != theirs.get(name):
                rows.append((name, ours.get(name, "left out"), theirs.get(name, "left out"), ""))
        return rows

    def figure_rows(self) -> list[Row]:
        """Errors, shares of outcomes and speed, with the second's less the first's."""
        return [*self._errors(), *self._shares(), *self._speed()]

    def _errors(self) -> Iterator[Row]:
        one, other = self.records
        for name, title in FIGURES.items():
            a, b = one.figures.get(name), other.figures.get(name)
            if a is not None or b is not None:
                change = f"{b - a:+.3f} m" if a is not None and b is not None else ""
                yield title, _metres(a), _metres(b), change

    def _shares(self) -> Iterator[Row]:
        one, other = self.records
        for outcome in {**one.frames_by_outcome, **other.frames_by_outcome}:
            if outcome == "out_of_range":
                continue
            a, b = one.share_of(outcome), other.share_of(outcome)
            if a or b:
                change = f"{100 * (b - a):+.2f} points" if a is not None and b is not None else ""
                yield f"pairs {outcome}", _share(a), _share(b), change

    def _speed(self) -> Iterator[Row]:
        a, b = (record.real_time_factor for record in self.records)
        if a and b:
            yield "real-time factor", f"{a:.2f}", f"{b:.2f}", f"× {b / a:.2f}"


def print_comparison(comparison: Comparison, console: Console) -> None:
    """All of it, for a terminal."""
    names = comparison.first.folder, comparison.second.folder
    sections = {
        "scenario, where it differs": comparison.scenario_rows(),
        "verdicts, where they differ": comparison.check_rows(),
        "figures (means after the first fifth of each run)": comparison.figure_rows(),
    }
    for title, rows in sections.items():
        if rows:
            console.print(_table(title, (str(names[0]), str(names[1])), rows))
    for source in (comparison.first, comparison.second):
        console.print(
            f"trace sha256 {source.record.trace_sha256}  {source.folder}", highlight=False, soft_wrap=True
        )
    difference = comparison.first_difference
    assert isinstance(difference, CheckResult), difference
    console.print(Text(difference.text, style=STYLE[difference.verdict]), soft_wrap=True)
    if differing := difference.figures.get("rows"):
        console.print(offending(differing))


def _table(title: str, names: tuple[str, str], rows: list[Row]) -> Table:
    table = Table(title=title, title_justify="left")
    table.add_column("")
    for name in names:
        table.add_column(name, overflow="fold")
    with_change = any(change for *_, change in rows)
    if with_change:
        table.add_column("change", justify="right")
    for name, a, b, change in rows:
        cells = [Text(value, style=_style(value)) for value in (a, b)]
        table.add_row(name, *cells, *([change] if with_change else []))
    return table


def _style(value: str) -> str:
    return STYLE[Verdict(value)] if value in {verdict.value for verdict in Verdict} else ""


def _flat(scenario: Scenario) -> dict[str, Any]:
    """A scenario's values by their dotted keys; faults by number."""
    flat: dict[str, Any] = {}

    def walk(prefix: str, value: Any) -> None:
        if isinstance(value, dict):
            for key, inner in value.items():
                walk(f"{prefix}.{key}" if prefix else key, inner)
        elif isinstance(value, list) and value and all(isinstance(inner, dict) for inner in value):
            for number, inner in enumerate(value):
                walk(f"{prefix}.{number}", inner)
        else:
            flat[prefix] = value

    walk("", scenario.model_dump(mode="json", exclude_none=True))
    return flat


def _told(value: Any) -> str:
    text = "–" if value is None else str(value)
    return text if len(text) <= 60 else text[:59] + "…"


def _metres(value: float | None) -> str:
    return "–" if value is None else f"{value:.3f} m"


def _share(value: float | None) -> str:
    return "–" if value is None else f"{value:.2%}"
