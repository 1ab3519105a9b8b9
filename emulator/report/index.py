"""`runs/index.html`: all runs of a folder, the newest first, unfinished and broken ones included; its studies."""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pyarrow as pa
from pydantic import ValidationError

from emulator.pages.page import put_page, render
from emulator.records.recorded_run import RecordedRun, written_at
from emulator.records.run_folder import INDEX, RECORDING, REPORT, SCENARIO_FILE, VERDICT_FILE, is_run_folder
from emulator.records.tables import open_table
from emulator.records.verdicts import Record, Verdict
from emulator.scenario.sections import first_problem, validated
from vnet.bounded import read_bounded
from vnet.errors import VnetError, first_names, printable

CAMPAIGN_FILE, CAMPAIGN_PAGE = "campaign.json", "campaign.html"
SWEEP_TABLE, SWEEP_PAGE = "sweep.parquet", "sweep.html"
LARGEST_BYTES = 256 * 2**20
MOST_REPORTED = 6
"""Values of programs' own that have a column: those that most runs report."""
Number = tuple[str, str, str]
"""A number in a row: the key by which its column is sorted, its text, and a smaller text below."""
NONE: Number = ("", "–", "")


@dataclass(frozen=True)
class CampaignRecord:
    """The fields of campaign.json that a list of campaigns needs."""

    seed: int
    runs: int
    kinds: list[str]
    results: list[dict[str, Any]]
    drawn_from: str = ""
    """Digest of what decides which runs can be drawn; "" in campaigns of earlier versions."""


def read_campaign(folder: Path) -> CampaignRecord:
    """Read the campaign.json of a folder. Raises VnetError where it is not what vnet writes."""
    path = folder / CAMPAIGN_FILE
    try:
        return validated(CampaignRecord, json.loads(read_bounded(path, LARGEST_BYTES)))
    except OSError as error:
        raise VnetError(f"{path}: cannot be read: {error.strerror or error}") from None
    except ValidationError as error:
        raise VnetError(f"{path}: {first_problem(error, CampaignRecord)}") from None
    except (ValueError, RecursionError) as error:
        raise VnetError(f"{path}: not JSON: {error}") from None


@dataclass(frozen=True)
class FigureColumn:
    """A column of numbers; one that is `less` is hidden on narrow screens."""

    title: str
    is_less: bool
    read: Callable[[Record], Number]

    @property
    def kind(self) -> str:
        """Class of its cells."""
        return "number less" if self.is_less else "number"


@dataclass(frozen=True)
class Entry:
    """A run's folder, and its record, or the reason for which there is none."""

    folder: Path
    when: datetime
    record: Record | None
    without: str
    """The badge of a run without a record, in two words."""
    problem: str
    files: Sequence[str]
    """Names of those of its files that the list links."""


def write_index(folder: Path) -> Path:
    """Write FOLDER/index.html and return its path. Raises VnetError if the folder cannot be read or written."""
    return put_page(folder / INDEX, index_page(folder))


def index_page(folder: Path) -> str:
    """Return the whole page."""
    entries = sorted(_entries(folder), key=lambda entry: (entry.when, entry.folder.name), reverse=True)
    latest = (folder / "latest").resolve()
    numbers = _columns([entry.record for entry in entries if entry.record is not None])
    titles = {"run": "", "verdict": "", "when": "less"}
    return render(
        "index.html.j2",
        name=folder.resolve().name,
        columns=titles | {column.title: column.kind for column in numbers} | {"files": "less"},
        entries=[_row(entry, entry.folder.resolve() == latest, numbers) for entry in entries],
        studies={
            ("Campaigns", "campaign", "failed", "faults"): _studies(
                folder, CAMPAIGN_FILE, CAMPAIGN_PAGE, _campaign
            ),
            ("Sweeps", "sweep", "not valid", "varied"): _studies(folder, SWEEP_TABLE, SWEEP_PAGE, _sweep),
        },
    )


@dataclass(frozen=True)
class Study:
    """A campaign or a sweep in a folder: a row of the list."""

    name: str
    link: str
    when: datetime
    runs: str = "–"
    failed: int | str = ""
    content: str = ""
    """Kinds of faults, or varied keys."""
    problem: str = ""


def _campaign(folder: Path) -> dict[str, Any]:
    record = read_campaign(folder)
    done = len(record.results)
    runs = str(done) if done == record.runs else f"{done} of {record.runs}"
    failed = sum("failed" in result for result in record.results)
    return {"runs": runs, "failed": failed, "content": first_names(record.kinds, 4, with_total=True)}


def _sweep(folder: Path) -> dict[str, Any]:
    """Read the sweep.parquet of a folder. Raises VnetError where it is not what vnet writes."""
    path = folder / SWEEP_TABLE
    try:
        file = open_table(path, ["verdict"])
        names = file.schema_arrow.names
        varied = names[: names.index("seed")]
        verdicts = file.read(["verdict"])["verdict"].to_pylist()
    except OSError as error:
        raise VnetError(f"{path}: cannot be read: {error.strerror or printable(str(error), 200)}") from None
    except (ValueError, KeyError, pa.ArrowException) as error:
        raise VnetError(f"{path}: not the table of a sweep: {printable(str(error), 200)}") from None
    failed = sum(verdict != Verdict.VALID for verdict in verdicts)
    return {"runs": str(len(verdicts)), "failed": failed, "content": first_names(varied, 4, with_total=True)}


def _studies(folder: Path, file: str, page: str, read: Callable[[Path], dict[str, Any]]) -> list[Study]:
    """Return the studies in a folder that have this file, the newest first."""
    found = []
    for path in (each.parent for each in folder.glob(f"*/{file}")):
        try:
            when = written_at(path / file)
        except OSError:
            continue  # it has just been removed
        try:
            values = read(path)
        except VnetError as error:
            values = {"problem": str(error).removeprefix(f"{path}/")}
        link = _link(path, page if (path / page).is_file() else "")
        found.append(Study(path.name, link, when, **values))
    return sorted(found, key=lambda study: (study.when, study.name), reverse=True)


def _entries(folder: Path) -> Iterator[Entry]:
    try:
        below = list(folder.iterdir())
    except OSError as error:
        raise VnetError(f"{folder}: cannot be read: {error.strerror or error}") from None
    for path in below:
        with suppress(VnetError):  # it has just been removed
            if path.is_symlink() and path.resolve().parent == folder.resolve():
                continue  # `latest`, which is listed under its own name
            try:
                if is_run_folder(path):
                    yield _entry(path)
            except OSError as error:
                problem = f"cannot be read: {error.strerror or error}"
                yield Entry(path, RecordedRun.open(path).when, None, "unreadable", problem, [])


def _entry(path: Path) -> Entry:
    """Return a run's entry. Raises OSError if the folder cannot be entered, and VnetError if it is gone."""
    run = RecordedRun.open(path)
    record, without = None, "no verdict"
    problem = "no verdict.json: it is still going on, or was ended from outside"
    if run.has_record:
        try:
            record = run.record
        except VnetError as error:
            without, problem = "broken", str(error).removeprefix(f"{path}/")
    files = [name for name in (REPORT, SCENARIO_FILE, VERDICT_FILE, RECORDING) if (path / name).is_file()]
    return Entry(path, run.when, record, without, problem, files)


def _row(entry: Entry, is_latest: bool, numbers: Sequence[FigureColumn]) -> dict[str, Any]:
    folder, record = entry.folder, entry.record
    return {
        "name": folder.name,
        "link": _link(folder, REPORT if REPORT in entry.files else ""),
        "is_latest": is_latest,
        "note": f"trace {record.trace_sha256[:12]}" if record else entry.problem,
        "verdict": record.verdict if record else None,
        "without": entry.without,
        "when": entry.when,
        "numbers": [(each.kind, *(each.read(record) if record else ("", "", ""))) for each in numbers],
        "files": {name: _link(folder, name) for name in entry.files if name != REPORT},
    }


def _link(folder: Path, name: str) -> str:
    """The address of a run's file beside the index; a folder's name need not be text."""
    return quote(os.fsencode(f"{folder.name}/{name}"))


# Columns of numbers.


def _columns(records: Sequence[Record]) -> list[FigureColumn]:
    """The columns that some run has a number for."""
    columns = [
        FigureColumn("vehicles", True, lambda record: _number(record.vehicles, "d")),
        FigureColumn("emulated (s)", True, lambda record: _number(record.emulated_s, ".1f")),
    ]
    for key in {each.name: each for record in records for each in record.key_figures}.values():
        if key.column and any(record.figures.get(key.name) is not None for record in records):
            columns.append(FigureColumn(key.column, key.is_less, partial(_figure, key.name)))
    columns.append(FigureColumn("PDR (%)", False, _delivered))
    counts = Counter(name for record in records for name in record.reported)
    for name, _ in counts.most_common(MOST_REPORTED):
        title = next(record.reported[name] for record in records if name in record.reported).words(name)[0]
        columns.append(FigureColumn(title, False, partial(_reported, name)))
    return columns


def _number(value: float | None, form: str) -> Number:
    return NONE if value is None else (f"{value:g}", format(value, form), "")


def _figure(name: str, record: Record) -> Number:
    return _number(record.figures.get(name), ".3f")


def _delivered(record: Record) -> Number:
    share = record.packet_delivery_ratio
    return _number(None if share is None else 100 * share, ".2f")


def _reported(name: str, record: Record) -> Number:
    if (figure := record.reported.get(name)) is None:
        return NONE
    _, mean, spread, _ = figure.words(name)
    return mean if figure.mean is None else f"{figure.mean:g}", mean, spread
