"""`report.html`: a run on one page, made from the run's files alone.

Verdict and checks first, then key figures, figures, events, the scenario, and how to have the run again.
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from emulator.pages.page import badge, escape, page, pairs, put_page, table
from emulator.records.page_names import REPORT
from emulator.records.run_folder import RUNS, SCENARIO_FILE, Event
from emulator.records.verdict_file import Record
from emulator.records.verdicts import CheckResult, Verdict
from emulator.report.figures import Chart, draw
from emulator.report.index import write_index
from emulator.report.radio import radio_section
from emulator.report.source import Source, maybe, why_not
from emulator.terminal.summary import FIGURES, left_out
from vnet.errors import VnetError

MOST_EVENTS = 200
MOST_SCENARIO = 50_000
"""Characters of a scenario that are shown; one with a matrix of links may have millions."""
MOST_NAMED = 8

STYLE = """
.facts { display: flex; flex-wrap: wrap; gap: .1rem 1.1rem; margin: 0; padding: 0; list-style: none;
  color: var(--quiet); }
.checks { list-style: none; margin: .75rem 0; padding: 0; border-top: 1px solid var(--grid); }
.checks > li { border-bottom: 1px solid var(--grid); padding: .4rem 0; }
.checks summary { display: grid; grid-template-columns: 6.2rem 13rem 1fr; gap: .1rem .75rem; align-items: baseline;
  list-style: none; } .checks summary::-webkit-details-marker { display: none; }
.checks b { font-weight: 600; overflow-wrap: anywhere; }
.checks summary > span:last-child { overflow-wrap: anywhere; }
.checks .badge { justify-self: start; }
.checks summary:hover b { text-decoration: underline; text-decoration-thickness: 1px; }
.checks .more { margin: .5rem 0 .6rem 6.95rem; }
.figures { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(100%, 22rem), 1fr));
  gap: 2rem 1.75rem;
  align-items: start; }
figure { margin: 0; } figure figcaption { font-size: .85rem; line-height: 1.4; color: var(--quiet);
  margin: .3rem 0 0; }
.chart { display: block; width: 100%; height: auto; overflow: visible; stroke-linejoin: round; }
.chart text { font-family: inherit; }
@media (max-width: 44rem) {
  .checks summary { grid-template-columns: auto 1fr; } .checks summary > span:last-child { grid-column: 1 / -1; }
  .checks .more { margin-left: 0; }
  h2 { margin-top: 2rem; }
}
"""


def write_report(folder: Path) -> Path:
    """Write RUN/report.html, and the index of `runs/` if the run lies there; returns the report's path.

    Raises VnetError if `folder` is not a run's, or cannot be written.
    """
    source = Source(folder)
    known = [maybe(read) is not None for read in (lambda: source.scenario_text, lambda: source.record)]
    if not any(known):
        raise VnetError(f"{folder}: not a run's folder: neither scenario.toml nor verdict.json can be read")
    path = put_page(folder / REPORT, report_page(source))
    if folder.resolve().parent.name == RUNS.name:
        write_index(folder.resolve().parent)
    return path


def report_page(source: Source) -> str:
    """The whole page."""
    name = run_name(source)
    charts, missing = draw(source)
    record = maybe(lambda: source.record)
    body = [
        *_header(source, name, record),
        *_checks(source, record),
        *(_key_figures(record) if record else []),
        *figures_section(charts, missing),
        *radio_section(source),
        *_events(source),
        *_scenario(source),
        *_again(source, record),
    ]
    return page(f"vnet run {name}", body, STYLE)


def run_name(source: Source) -> str:
    """What the run is called: its folder, which is named after its scenario and seed."""
    return source.folder.resolve().name


def _header(source: Source, name: str, record: Record | None) -> Iterator[str]:
    yield "<header>"
    yield f"<h1>{escape(name)} {badge(record.verdict if record else None)}</h1>"
    yield f'<ul class="facts">{"".join(f"<li>{escape(fact)}</li>" for fact in _facts(source, record))}</ul>'
    if record is None:
        yield f"<p>{_why_no_verdict(source)} What it has left:</p>"
    elif source.cut is not None:
        yield f"<p>The run was {escape(source.cut.kind)} at {source.cut.time_ns / 1e9:.1f} s.</p>"
    sections = {
        "checks": "Checks",
        "key": "Key figures",
        "figures": "Figures",
        "radio": "Radio",
        "events": "Events",
        "scenario": "Scenario",
        "again": "Have it again",
    }
    links = "".join(f'<a href="#{key}">{title}</a>' for key, title in sections.items() if record or key != "key")
    yield f"<nav>{links}</nav></header>"


def _why_no_verdict(source: Source) -> str:
    if source.recorded.has_record:
        return "The verdict of this run cannot be read."  # why is told among the checks
    return "This run has no verdict: it is still going on, or it was ended from outside."


def _facts(source: Source, record: Record | None) -> Iterator[str]:
    if record is not None:
        yield f"{record.vehicles} vehicle{'s' if record.vehicles != 1 else ''}"
    if scenario := maybe(lambda: source.scenario):
        emulated = f"{record.emulated_s:g} of " if record and record.emulated_s != scenario.run.duration_s else ""
        yield f"{emulated}{scenario.run.duration_s:g} s emulated"
        yield {"lockstep": "in lockstep", "realtime": "in real time"}[scenario.run.pacing]
        yield scenario.program.entry
        yield f"seed {scenario.run.seed}"
    yield f"{source.recorded.when:%Y-%m-%d %H:%M}"


# Checks.


def _checks(source: Source, record: Record | None) -> Iterator[str]:
    yield '<section id="checks"><h2>Checks</h2>'
    if record is None:
        yield f"<p>Nothing was judged: {escape(why_not(lambda: source.record))}.</p>"
    else:
        counts = {verdict: sum(check.verdict is verdict for check in record.checks) for verdict in Verdict}
        said = ", ".join(f"{count} {verdict.value}" for verdict, count in counts.items() if count)
        yield f"<p>{len(record.checks)} checks: {said or 'none'}. Each opens on its figures.</p>"
        worst = [Verdict.INVALID, Verdict.UNKNOWN, Verdict.VALID]
        ordered = sorted(record.checks, key=lambda check: worst.index(check.verdict))
        yield f'<ul class="checks">{"".join(map(_check, ordered))}</ul>'
        reasons = left_out(record.judgement)
        if reasons:
            rows = {reason[0].upper() + reason[1:]: ", ".join(names) for reason, names in reasons.items() if reason}
            listed = "".join(_reason(*row) for row in rows.items())
            yield f'<h3>Left out, and why</h3><ul class="quiet">{listed}</ul>'
    yield "</section>"


def _reason(reason: str, names: str) -> str:
    return f"<li>{escape(reason)}: {escape(names)}</li>"


def _check(check: CheckResult) -> str:
    is_open = " open" if check.verdict is Verdict.INVALID else ""
    line = f"{badge(check.verdict)}<b>{escape(check.name)}</b><span>{escape(check.text)}</span>"
    more = "".join(_details(check.figures)) or '<p class="quiet">It has no figures.</p>'
    return f'<li><details{is_open}><summary>{line}</summary><div class="more">{more}</div></details></li>'


def _details(figures: Mapping[str, Any]) -> Iterator[str]:
    """A check's figures: plain ones in pairs, rows as tables, texts of several lines as they are."""
    plain: dict[str, object] = {}
    for name, value in figures.items():
        if _is_rows(value):
            texts = [(row, key) for row in value for key in row if "\n" in str(row[key])]
            short = [{key: _one_line(row[key]) for key in row if "\n" not in str(row[key])} for row in value]
            title = "the first offending rows" if name == "rows" else name
            yield table(short[:50], title)
            yield from (f"<pre>{escape(row[key])}</pre>" for row, key in texts[:3])
        elif "\n" in str(value):
            yield f"<p>{escape(name)}</p><pre>{escape(value)}</pre>"
        elif value is not None:
            plain[name] = _one_line(value)
    if plain:
        yield pairs(plain)


def _is_rows(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(isinstance(row, dict) for row in value)


def _one_line(value: Any) -> Any:
    if isinstance(value, float):
        return float(f"{value:.6g}")
    if isinstance(value, bool) or not isinstance(value, (int, str, type(None))):
        return json.dumps(value)
    return f"{value:,}" if isinstance(value, int) and abs(value) < 10**9 else value


# Figures.


def _key_figures(record: Record) -> Iterator[str]:
    yield '<section id="key"><h2>Key figures</h2><dl class="tiles">'
    for name, value in key_figures(record).items():
        yield f"<div><dt>{escape(name)}</dt><dd>{escape(value)}</dd></div>"
    yield '</dl><p class="quiet">Errors are means after the first fifth of the run.</p></section>'


def key_figures(record: Record) -> dict[str, str]:
    """What a run comes to, in few numbers, by name."""
    found = {
        title: f"{value:.3f} m"
        for name, title in FIGURES.items()
        if (value := record.figures.get(name)) is not None
    }
    if (delivered := record.share_of("delivered")) is not None:
        found["delivered, of pairs in range"] = f"{delivered:.2%}"
        found["pairs in range"] = f"{record.in_range:,}"
    found["emulated time"] = f"{record.emulated_s:.1f} s"
    found["wall-clock time"] = f"{record.wall_s:.1f} s"
    if record.real_time_factor is not None:
        found["real-time factor"] = f"{record.real_time_factor:.2f}"
    if record.start_up_s:
        found["start of the processes"] = f"{record.start_up_s:.1f} s"
    return found


def figures_section(charts: Sequence[Chart], missing: Mapping[str, str]) -> Iterator[str]:
    """The figures side by side, and those with nothing to show, by reason."""
    yield '<section id="figures"><h2>Figures</h2><div class="figures">'
    for chart in charts:
        yield f'<figure id="{chart.key}"><h3>{escape(chart.title)}</h3>{chart.svg}'
        yield f"<figcaption>{escape(chart.caption)}</figcaption></figure>"
    yield "</div>"
    titles: dict[str, list[str]] = {}
    for title, reason in missing.items():
        titles.setdefault(reason, []).append(title)
    if titles:
        listed = "".join(f"<li>{escape(', '.join(some))}: {escape(reason)}</li>" for reason, some in titles.items())
        yield f'<h3 style="margin-top:1.5rem">Not shown, and why</h3><ul class="quiet">{listed}</ul>'
    yield "</section>"


# What happened, what it was, and how to have it again.


def _events(source: Source) -> Iterator[str]:
    yield '<section id="events"><h2>Events</h2>'
    try:
        events = source.events
    except VnetError as error:
        yield f"<p>{escape(error)}</p></section>"
        return
    shown = events[: MOST_EVENTS // 2] + events[max(MOST_EVENTS // 2, len(events) - MOST_EVENTS // 2) :]
    if len(shown) < len(events):
        yield f"<p>The first and the last {MOST_EVENTS // 2} of {len(events):,}; all are in events.jsonl.</p>"
    yield table(list(map(_event, shown))) if shown else "<p>None.</p>"
    yield "</section>"


def _event(event: Event) -> dict[str, Any]:
    """A row of the table of events."""
    details = {name: value for name, value in event.details.items() if name != "where"}
    text = ", ".join(f"{name} {_listed(value)}" for name, value in details.items())
    return {
        "time (s)": f"{event.time_ns / 1e9:.3f}",
        "event": event.kind,
        "node": event.node or "",
        "details": text,
    }


def _listed(value: Any) -> str:
    if not isinstance(value, list):
        return str(value)
    more = f", … ({len(value)})" if len(value) > MOST_NAMED else ""
    return ", ".join(map(str, value[:MOST_NAMED])) + more


def _scenario(source: Source) -> Iterator[str]:
    yield '<section id="scenario"><h2>Scenario</h2>'
    try:
        text = source.scenario_text
        cut = "" if len(text) <= MOST_SCENARIO else f" Its first {MOST_SCENARIO:,} characters:"
        yield f"<details><summary>scenario.toml, with every default spelled out.{cut}</summary>"
        yield f"<pre>{escape(text, MOST_SCENARIO)}</pre></details>"
    except VnetError as error:
        yield f"<p>{escape(error)}</p>"
    yield "</section>"


def _again(source: Source, record: Record | None) -> Iterator[str]:
    yield '<section id="again"><h2>Have it again</h2>'
    folder = shlex.quote(str(source.folder))
    commands = [record.reproduce] if record else [f"vnet run {shlex.quote(str(source.folder / SCENARIO_FILE))}"]
    commands += [f"vnet check {folder}", f"vnet report {folder}"]
    yield f"<pre>{escape(chr(10).join(commands))}</pre>"
    if record is not None:
        yield pairs(dict(_identity(record)))
    yield "</section>"


def _identity(record: Record) -> Iterable[tuple[str, object]]:
    yield "trace sha256", record.trace_sha256
    yield "metrics sha256", record.metrics_sha256
    yield "seed", record.seed
    yield from record.versions.items()
