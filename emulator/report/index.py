"""`runs/index.html`: all runs of a folder, the newest first, those that broke off or that are broken included."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from urllib.parse import quote

from emulator.pages.page import badge, escape, page, put_page
from emulator.records.page_names import INDEX, REPORT
from emulator.records.recorded_run import RecordedRun
from emulator.records.run_files import is_run_folder
from emulator.records.run_folder import SCENARIO_FILE, VERDICT_FILE
from emulator.records.verdict_file import Record
from emulator.viewer.sinks import RECORDING
from vnet.errors import VnetError

COLUMNS = {
    "run": "",
    "verdict": "",
    "when": "less",
    "vehicles": "number less",
    "emulated (s)": "number less",
    "RMSE (m)": "number",
    "deviation (m)": "number less",
    "delivered (%)": "number",
    "files": "less",
}
"""Columns and their classes; those that are `less` are left out on narrow screens."""
STYLE = """
.tools { display: flex; flex-wrap: wrap; gap: .5rem .75rem; align-items: baseline; margin: 1rem 0 .75rem; }
.tools[hidden] { display: none; }
input, select { font: inherit; color: inherit; background: var(--panel); border: 1px solid var(--line);
  border-radius: .3rem; padding: .2rem .5rem; max-width: 100%; }
th button { font: inherit; color: inherit; background: none; border: 0; padding: 0; cursor: pointer; }
th[aria-sort=ascending] button::after { content: " ↑"; } th[aria-sort=descending] button::after { content: " ↓"; }
table { width: 100%; } td:first-child { overflow-wrap: anywhere; min-width: 7rem; }
td small { display: block; }
@media (max-width: 44rem) { .less { display: none; } th, td { padding-right: .5rem; }
  thead th.number { white-space: normal; } }
"""
SCRIPT = """
const body = document.querySelector("tbody"), rows = [...body.rows];
const text = document.querySelector("#text"), verdict = document.querySelector("#verdict");
document.querySelector(".tools").hidden = false;
const fits = row => row.textContent.toLowerCase().includes(text.value.toLowerCase())
  && (!verdict.value || row.dataset.verdict === verdict.value);
const show = () => rows.forEach(row => row.hidden = !fits(row));
text.oninput = verdict.onchange = show;
document.querySelectorAll("thead th").forEach((head, place) => {
  const button = document.createElement("button");
  button.append(...head.childNodes); head.append(button);
  button.onclick = () => {
    const sign = head.ariaSort === "ascending" ? -1 : 1;
    document.querySelectorAll("thead th").forEach(other => other.removeAttribute("aria-sort"));
    head.ariaSort = sign > 0 ? "ascending" : "descending";
    const key = row => row.cells[place].dataset.sort ?? "", isNumber = head.className.includes("number");
    const order = (a, b) => isNumber ? a - b : a.localeCompare(b, "en", {numeric: true});
    rows.sort((a, b) => (key(a) === "") - (key(b) === "") || sign * order(key(a), key(b)));
    body.append(...rows);
  };
});
"""


@dataclass(frozen=True)
class Entry:
    """A run's folder, and its record, or why there is none."""

    folder: Path
    when: datetime
    record: Record | None
    without: str
    """What it has instead of a verdict, in two words."""
    problem: str


def write_index(folder: Path) -> Path:
    """Write FOLDER/index.html and return its path. Raises VnetError if the folder cannot be read or written."""
    return put_page(folder / INDEX, index_page(folder))


def index_page(folder: Path) -> str:
    """The whole page."""
    entries = sorted(_entries(folder), key=lambda entry: (entry.when, entry.folder.name), reverse=True)
    title = f"vnet: runs in {folder.resolve().name}"
    return page(title, _body(folder, entries), STYLE, SCRIPT if entries else "")


def _entries(folder: Path) -> Iterator[Entry]:
    try:
        below = [path for path in folder.iterdir() if is_run_folder(path)]
    except OSError as error:
        raise VnetError(f"{folder}: cannot be read: {error.strerror or error}") from None
    for path in below:
        if path.is_symlink() and path.resolve().parent == folder.resolve():
            continue  # `latest`, which is listed under its own name
        run = RecordedRun.open(path)
        record, without = None, "no verdict"
        problem = "no verdict.json: it is still going on, or was ended from outside"
        if run.has_record:
            try:
                record = run.record
            except VnetError as error:
                without, problem = "broken", str(error).removeprefix(f"{path}/")
        try:
            yield Entry(path, run.when, record, without, problem)
        except VnetError:
            continue  # somebody has just removed it


def _body(folder: Path, entries: list[Entry]) -> Iterator[str]:
    count = f"{len(entries)} run{'s' if len(entries) != 1 else ''}"
    yield f'<header><h1>Runs in {escape(folder.resolve().name)}</h1><p class="quiet">{count}, the newest first. '
    yield "Errors are means after the first fifth of a run; delivered: of the pairs in range.</p></header>"
    if not entries:
        yield "<p>There are none yet.</p>"
        return
    yield '<div class="tools" hidden>'
    yield '<input id="text" type="search" placeholder="name, hash, …" aria-label="filter">'
    words = ("valid", "invalid", "unknown", "none")
    options = "".join(
        f'<option value="{word}">{"no verdict" if word == "none" else word}</option>' for word in words
    )
    yield '<select id="verdict" aria-label="verdict"><option value="">all verdicts</option>'
    yield f"{options}</select></div>"
    head = "".join(f'<th scope="col" class="{kind}">{escape(name)}</th>' for name, kind in COLUMNS.items())
    yield f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>'
    latest = (folder / "latest").resolve()
    for entry in entries:
        yield _row(entry, entry.folder.resolve() == latest)
    yield "</tbody></table></div>"


def _row(entry: Entry, is_latest: bool) -> str:
    record = entry.record
    verdict = record.verdict.value if record else "none"
    cells = [_named(entry, is_latest), (verdict, badge(record.verdict if record else None, entry.without))]
    cells.append((entry.when.isoformat(), f"{entry.when:%Y-%m-%d %H:%M}".replace(" ", "\u00a0")))
    cells += _numbers(record) if record else [("", "")] * 5
    cells.append(("", _files(entry.folder)))
    shown = (
        f'<td class="{kind}" data-sort="{escape(key)}">{text}</td>'
        for (key, text), kind in zip(cells, COLUMNS.values(), strict=True)
    )
    return f'<tr data-verdict="{verdict}">{"".join(shown)}</tr>'


def _named(entry: Entry, is_latest: bool) -> tuple[str, str]:
    name = entry.folder.name
    target = f"{name}/{REPORT}" if (entry.folder / REPORT).is_file() else f"{name}/"
    shown = f'<a href="./{quote(target)}">{escape(name)}</a>{" · latest" if is_latest else ""}'
    note = f"trace {entry.record.trace_sha256[:12]}" if entry.record else entry.problem
    return name, f"{shown}<small>{escape(note, 300)}</small>"


def _numbers(record: Record) -> list[tuple[str, str]]:
    """Of each column of numbers what it is sorted by, and its text."""
    share = record.share_of("delivered")
    figures = [record.figures.get(name) for name in ("common_error_rmse_m", "deviation_m")]
    values: Iterable[tuple[float | None, str]] = [
        (record.vehicles, "d"),
        (record.emulated_s, ".1f"),
        *((figure, ".3f") for figure in figures),
        (None if share is None else 100 * share, ".2f"),
    ]
    return [("", "–") if value is None else (f"{value:g}", format(value, form)) for value, form in values]


def _files(folder: Path) -> str:
    names = [name for name in (SCENARIO_FILE, VERDICT_FILE, RECORDING) if (folder / name).is_file()]
    return ", ".join(f'<a href="./{quote(f"{folder.name}/{name}")}">{escape(name)}</a>' for name in names)
