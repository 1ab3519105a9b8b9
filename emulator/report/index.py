"""`runs/index.html`: all runs of a folder, the newest first, unfinished and broken ones included."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any
from urllib.parse import quote

from emulator.pages.page import put_page, render
from emulator.records.run_folder import INDEX, RECORDING, REPORT
from emulator.records.verdict_file import Record, read_record
from emulator.report.source import when
from vnet.errors import VnetError

MARKS = ("scenario.toml", "verdict.json", "events.jsonl")
"""A folder with any of these is a run's."""
NUMBERS = {
    "vehicles": "number less",
    "emulated (s)": "number less",
    "RMSE (m)": "number",
    "deviation (m)": "number less",
    "PDR (%)": "number",
}
COLUMNS = {"run": "", "verdict": "", "when": "less"} | NUMBERS | {"files": "less"}
"""Columns and their classes; those that are `less` are hidden on narrow screens."""


@dataclass(frozen=True)
class Entry:
    """A run's folder, and its record, or the reason for which there is none."""

    folder: Path
    when: datetime
    record: Record | None
    without: str
    """The badge of a run without a record, in two words."""
    problem: str


def write_index(folder: Path) -> Path:
    """Write FOLDER/index.html and return its path. Raises VnetError if the folder cannot be read or written."""
    return put_page(folder / INDEX, index_page(folder))


def index_page(folder: Path) -> str:
    """Return the whole page."""
    entries = sorted(_entries(folder), key=lambda entry: (entry.when, entry.folder.name), reverse=True)
    latest = (folder / "latest").resolve()
    return render(
        "index.html.j2",
        name=folder.resolve().name,
        columns=COLUMNS,
        entries=[_row(entry, entry.folder.resolve() == latest) for entry in entries],
    )


def _entries(folder: Path) -> Iterator[Entry]:
    try:
        below = [path for path in folder.iterdir() if any((path / mark).is_file() for mark in MARKS)]
    except OSError as error:
        raise VnetError(f"{folder}: cannot be read: {error.strerror or error}") from None
    for path in below:
        if path.is_symlink() and path.resolve().parent == folder.resolve():
            continue  # `latest`, which is listed under its own name
        record, without = None, "no verdict"
        problem = "no verdict.json: it is still going on, or was ended from outside"
        if (path / "verdict.json").exists():
            try:
                record = read_record(path)
            except VnetError as error:
                without, problem = "broken", str(error).removeprefix(f"{path}/")
        try:
            yield Entry(path, when(path), record, without, problem)
        except VnetError:
            continue  # it has just been removed


def _row(entry: Entry, is_latest: bool) -> dict[str, Any]:
    folder, record = entry.folder, entry.record
    files = [name for name in ("scenario.toml", "verdict.json", RECORDING) if (folder / name).is_file()]
    return {
        "name": folder.name,
        "link": _link(folder, REPORT if (folder / REPORT).is_file() else ""),
        "is_latest": is_latest,
        "note": f"trace {record.trace_sha256[:12]}" if record else entry.problem,
        "verdict": record.verdict if record else None,
        "without": entry.without,
        "when": entry.when,
        "numbers": [(kind, *texts) for kind, texts in zip(NUMBERS.values(), _numbers(record), strict=True)],
        "files": {name: _link(folder, name) for name in files},
    }


def _link(folder: Path, name: str) -> str:
    """The address of a run's file beside the index; a folder's name need not be text."""
    return quote(os.fsencode(f"{folder.name}/{name}"))


def _numbers(record: Record | None) -> list[tuple[str, str]]:
    """The key by which each column of numbers is sorted, and its text."""
    if record is None:
        return [("", "")] * len(NUMBERS)
    share = record.share_of("delivered")
    figures = [record.figures.get(name) for name in ("common_error_rmse_m", "deviation_m")]
    values: Iterable[tuple[float | None, str]] = [
        (record.vehicles, "d"),
        (record.emulated_s, ".1f"),
        *((figure, ".3f") for figure in figures),
        (None if share is None else 100 * share, ".2f"),
    ]
    return [("", "–") if value is None else (f"{value:g}", format(value, form)) for value, form in values]
