"""`report.html`: a run on one page, made from the run's files alone.

The verdict and the checks that are not valid first, then results, all checks, events, the scenario, and how to
reproduce the run. This module gathers what the page shows; `report.html.j2` lays it out.
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from emulator.pages.page import Table, put_page, render, table
from emulator.records.costs import HEADS, SLOWEST
from emulator.records.events import SAID, SAMPLES, Event
from emulator.records.run_folder import REPORT, RUNS, SCENARIO_FILE
from emulator.records.samples import key_figures as sample_figures
from emulator.records.tables import on_backbone
from emulator.records.verdicts import WORST_FIRST, Record, Verdict
from emulator.report.figures import draw
from emulator.report.index import write_index
from emulator.report.radio_figures import radio_section
from emulator.report.source import Source, maybe, why_not
from emulator.report.timeline import timeline
from vnet.errors import VnetError, counted, first_names

MOST_EVENTS = 200
MOST_SAID = 2000
"""Lines of logs and events of programs that are shown."""
MOST_SCENARIO = 50_000
"""Characters of a scenario that are shown; one with a matrix of links may have millions."""
MOST_ROWS = 50
"""Rows of a check's figures that are shown."""
MOST_TEXTS = 3
"""Texts of several lines, as tracebacks, that are shown of a check's rows."""
MOST_KEYS = 100
"""Keys of Zenoh programs that are shown."""


def write_report(source: Source) -> Path:
    """Write RUN/report.html, and the index of `runs/` if the run lies there; returns the report's path.

    Raises VnetError if the source's folder is not a run's, is of a later format, or cannot be written.
    """
    folder = source.folder
    source.refuse_later_format()
    known = [maybe(read) is not None for read in (lambda: source.scenario_text, lambda: source.record)]
    if not any(known):
        raise VnetError(f"{folder}: not a run's folder: neither scenario.toml nor verdict.json can be read")
    path = put_page(folder / REPORT, report_page(source))
    if folder.resolve().parent.name == RUNS.name:
        write_index(folder.resolve().parent)
    return path


def report_page(source: Source) -> str:
    """Return the whole page."""
    record = maybe(lambda: source.record)
    checks = _checks(record) if record else []
    return render(
        "report.html.j2",
        name=source.folder.resolve().name,
        verdict=record.verdict if record and not source.damages else None,
        facts=list(_facts(source, record)),
        note=_note(source, record),
        summary=_summary(source, record),
        checks=checks,
        problems=[check for check in checks if check["verdict"] is not Verdict.VALID],
        not_applicable=record.judgement.not_applicable if record else {},
        key_figures=key_figures(record) if record else {},
        has_errors=bool(record and record.shown_figures),
        reported=_reported(record) if record else None,
        charts=draw(source),
        timeline=maybe(lambda: timeline(source)),
        radio=radio_section(source),
        keys=_keys(source),
        cost=_cost(record) if record else None,
        events=_events(source),
        log=_log(source),
        scenario=_scenario(source),
        commands=_commands(source, record),
        identity=_identity(record) if record else {},
    )


def _facts(source: Source, record: Record | None) -> Iterator[str]:
    if record is not None:
        yield counted(record.vehicles, "vehicle")
        if record.roadside_units:
            yield counted(record.roadside_units, "roadside unit")
    if scenario := maybe(lambda: source.scenario):
        emulated = f"{record.emulated_s:g} of " if record and record.emulated_s != scenario.run.duration_s else ""
        yield f"{emulated}{scenario.run.duration_s:g} s emulated"
        yield {"lockstep": "in lockstep", "realtime": "in real time"}[scenario.run.pacing]
        yield scenario.program.title
        yield f"seed {scenario.run.seed}"
    yield f"{source.when:%Y-%m-%d %H:%M}"


def _note(source: Source, record: Record | None) -> str:
    """The reason for a missing verdict or an early end; "" for a run that has both."""
    if record is not None:
        if source.damages:
            lost = "; ".join(source.damages)
            return f"The verdict, {record.verdict.value}, stood on files that cannot be read: {lost}."
        cut = source.cut
        return f"The run was {cut.kind} at {cut.time_ns / 1e9:.1f} s." if cut else ""
    if source.has_record:  # the checks' section says why
        return "The verdict of this run cannot be read. Its other files:"
    return "This run has no verdict: it is still going on, or it was ended from outside. Its other files:"


# Checks.


@dataclass(frozen=True)
class Details:
    """The figures of a check as a page shows them."""

    values: dict[str, object] = field(default_factory=dict)
    tables: list[Table] = field(default_factory=list)
    texts: list[tuple[str, str]] = field(default_factory=list)
    """Texts of several lines, each with its title."""

    @property
    def is_empty(self) -> bool:
        """True if there is nothing to show."""
        return not (self.values or self.tables or self.texts)


def _summary(source: Source, record: Record | None) -> str:
    if record is None:
        return f"No check was judged: {why_not(lambda: source.record)}."
    counts = {verdict: sum(check.verdict is verdict for check in record.checks) for verdict in Verdict}
    said = ", ".join(f"{count} {verdict.value}" for verdict, count in counts.items() if count)
    return f"{counted(len(record.checks), 'check')}: {said or 'none'}. Each opens on its figures."


def _checks(record: Record) -> list[dict[str, Any]]:
    """The checks, the worst verdict first."""
    ordered = sorted(record.checks, key=lambda check: WORST_FIRST.index(check.verdict))
    return [
        {"name": check.name, "verdict": check.verdict, "text": check.text, "details": _details(check.figures)}
        for check in ordered
    ]


def _details(figures: Mapping[str, Any]) -> Details:
    """Sort a check's figures: plain values in pairs, rows as tables, texts of several lines as they are."""
    found = Details()
    for name, value in figures.items():
        if _is_rows(value):
            short = [{key: _one_line(row[key]) for key in row if "\n" not in str(row[key])} for row in value]
            found.tables.append(table(short[:MOST_ROWS], "the first offending rows" if name == "rows" else name))
            texts = [(key, str(row[key])) for row in value for key in row if "\n" in str(row[key])]
            found.texts.extend(texts[:MOST_TEXTS])
        elif "\n" in str(value):
            found.texts.append((name, str(value)))
        elif value is not None:
            found.values[name] = _one_line(value)
    return found


def _is_rows(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(isinstance(row, dict) for row in value)


def _one_line(value: Any) -> Any:
    if isinstance(value, float):
        return float(f"{value:.6g}")
    if isinstance(value, bool) or not isinstance(value, (int, str, type(None))):
        return json.dumps(value)
    return f"{value:,}" if isinstance(value, int) and abs(value) < 10**9 else value


def key_figures(record: Record) -> dict[str, str]:
    """Return the figures that sum up a run, by title."""
    found = {each.title: each.text(value) for each, value in record.shown_figures}
    if (delivered := record.packet_delivery_ratio) is not None:
        found["packet delivery ratio"] = f"{delivered:.2%}"
    if record.in_range:
        found["receptions in range"] = f"{record.in_range:,}"
    if record.driving:
        found["collisions"] = f"{record.driving.get('collisions') or 0:g}"
    if record.backbone:
        found["messages on the backbone"] = on_backbone(record.backbone)
    found["emulated time"] = f"{record.emulated_s:.1f} s"
    found["wall-clock time"] = f"{record.wall_s:.1f} s"
    if record.real_time_factor is not None:
        found["real-time factor"] = f"{record.real_time_factor:.2f}"
    if record.start_up_s:
        found["start of the processes"] = f"{record.start_up_s:.1f} s"
    return found


def _reported(record: Record) -> Table | None:
    """The figures of what the program reports; None without any."""
    heads = ("figure", "mean", "5 – 95 %", "at the end")
    rows = [dict(zip(heads, figure.words(name), strict=True)) for name, figure in record.reported.items()]
    return table(rows, "all reports of all vehicles; at the end: the mean of each vehicle's last") if rows else None


def _keys(source: Source) -> dict[str, Any] | None:
    """The number of keys of Zenoh programs and the figures of those with the most messages; None without any."""
    found = maybe(lambda: sample_figures(source))
    if not found:
        return None
    has_nodes = any(each.nodes for each in found)
    rows = [
        {
            "key": each.key,
            "kind": each.kind,
            **({"from": first_names(sorted(each.nodes)) if each.nodes else ""} if has_nodes else {}),
            "messages": f"{each.messages:,}",
            "frames": f"{each.frames:,}",
            "payload": f"{each.payload_bytes:,} bytes",
            "arrived": f"{each.arrived:,}",
            "lost": ", ".join(f"{count:,} {outcome}" for outcome, count in each.lost.most_common()) or "0",
        }
        for each in found[:MOST_KEYS]
    ]
    return {"count": len(found), "rows": table(rows, "arrived and lost: at each receiver in range")}


def _cost(record: Record) -> dict[str, Any] | None:
    """The costs of the run in a line, and a table of its slowest vehicles; None if nothing is known."""
    if record.cost is None or not (line := record.cost.line()):
        return None
    rows = [dict(zip(HEADS, vehicle.words(), strict=True)) for vehicle in record.cost.vehicles[:SLOWEST]]
    caption = f"CPU time of each vehicle's {record.cost.measured}, the slowest first"
    return {"line": f"{line[0].upper()}{line[1:]}.", "rows": table(rows, caption)}


# Events, the scenario, and how to reproduce the run.


def _events(source: Source) -> dict[str, Any] | str:
    """The number of events and the rows that are shown; or a sentence where there are none."""
    try:
        events = [event for event in source.events if not event.has(SAMPLES | SAID)]
    except VnetError as error:
        return str(error)
    if not events:
        return "None."
    half = MOST_EVENTS // 2
    shown = events[:half] + events[max(half, len(events) - half) :]
    return {"count": len(events), "rows": table(list(map(_event, shown)))}


def _log(source: Source) -> dict[str, Any] | None:
    """The number of lines and events of programs, and the rows that are shown; None if there are none."""
    said = [event for event in maybe(lambda: source.events) or () if event.has(SAID)]
    return {"count": len(said), "rows": table(list(map(_said, said[:MOST_SAID])))} if said else None


def _said(event: Event) -> dict[str, Any]:
    """A row of the table of log lines and events of programs."""
    level = str(event.details.get("level", event.kind))
    return {"time (s)": f"{event.time_ns / 1e9:.3f}", "node": event.node or "", "level": level, "text": event.what}


def _event(event: Event) -> dict[str, Any]:
    """A row of the table of events."""
    who = event.node or event.details.get("fault", "")
    return {"time (s)": f"{event.time_ns / 1e9:.3f}", "event": event.kind, "of": who, "details": event.said}


def _scenario(source: Source) -> dict[str, Any]:
    try:
        text = source.scenario_text
    except VnetError as error:
        return {"text": None, "problem": str(error)}
    note = "" if len(text) <= MOST_SCENARIO else f" Its first {MOST_SCENARIO:,} characters:"
    return {"text": text, "note": note, "longest": MOST_SCENARIO}


def _commands(source: Source, record: Record | None) -> list[str]:
    """Commands that reproduce the run, its verdict and this page, from any folder of the machine."""
    folder = shlex.quote(str(source.folder.absolute()))
    first = record.reproduce if record else f"vnet run {shlex.quote(str(source.folder.absolute() / SCENARIO_FILE))}"
    return [first, f"vnet check {folder}", f"vnet report {folder}"]


def _identity(record: Record) -> dict[str, object]:
    """Hashes, seed and versions, by which two runs are told apart."""
    own = {
        "trace sha256": record.trace_sha256,
        "metrics sha256": record.metrics_sha256,
        "seed": record.seed,
    }
    return own | dict(record.versions)
