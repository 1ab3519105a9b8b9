"""The runs of the golden table `runs.toml`, and what they come to, through the command line.

A row's command runs in one or more ways, which all have the results that stand in the row.
"""

import contextlib
import hashlib
import json
import os
import re
import shlex
import sys
import tomllib
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pyarrow.parquet as pq
import typer.main

from tests.docs.commands import APPS, captured, forgetting
from tests.docs.markdown import blocks
from tests.support import forked_commands
from tests.support.forked_commands import VNET
from tests.support.paths import ROOT
from tests.system.conftest import PATIENT, TIMEOUT_S
from vnet.runtime.environment import arithmetic

TABLE = Path(__file__).with_name("runs.toml")
WAYS: dict[str, list[str]] = {
    "simulated": ["simulate"],
    "two processes": ["simulate", "--processes", "2"],
    "no windows": ["simulate", "--set", "run.windows=false"],
    "live": ["run"],
    "live, three a process": ["run", "--set", "run.nodes_per_process=3"],
    "real time": ["run", "--pacing", "realtime"],
}
"""The ways of running a row's command, and what each adds to it."""
MEASURED = {"memory", "late_deliveries", "transport_gap"}
"""Kinds of events that tell of the machine."""
_FILE = re.compile(r"# (\S+\.(?:py|toml))\n")
_DIGITS = 16


def machine() -> dict[str, str]:
    """Return what results of numpy depend on: its version, and where it computes the same bits."""
    return {"numpy": np.__version__, "arithmetic": arithmetic()}


def load() -> tuple[dict[str, str], dict[str, "Row"]]:
    """Return the machine of the table, and its rows by name."""
    data = tomllib.loads(TABLE.read_text(encoding="utf-8"))
    made_with = data.pop("made_with")
    return made_with, {name: Row(**row) for name, row in data.items()}


@dataclass(frozen=True)
class Row:
    """A run: its command, and its results.

    Attributes:
        command: the scenario and the options, as after `vnet simulate`.
        ways: names of `WAYS`; the table is made with the first.
        page: the page of the documentation whose files the run uses.
        made: a file that a Python block of the page makes.
        version: which version of them, from 1 on, where the page writes one several times; 0 is the last.
        before: commands of vnet that make more files.
        numpy: results that depend on the arithmetic of numpy.
        quick: True if the first way costs little and belongs to the quick tests.
        results: what the run comes to, by name; without them the row is new.
    """

    command: str
    ways: list[str]
    page: str = ""
    made: str = ""
    version: int = 0
    before: list[str] = field(default_factory=list)
    numpy: list[str] = field(default_factory=list)
    quick: bool = False
    results: dict[str, Any] = field(default_factory=dict)

    def run(self, way: str, folder: Path) -> dict[str, Any]:
        """Run it in `folder`, which is empty; returns its results."""
        for name in ("scenarios", "docs", "tests"):
            (folder / name).symlink_to(ROOT / name)
        if self.page:
            write_files(self.page, self.version, folder)
        environment = {"PYTHONHASHSEED": "0", "PYTHONPATH": str(ROOT), "COLUMNS": "100"}
        with contextlib.chdir(folder), patch.dict(os.environ, environment):
            if self.made:
                _make(self.made, self.page)
            for command in self.before:
                _vnet(shlex.split(command), folder)
            first, *more = WAYS[way]
            words = [first, *shlex.split(self.command), *more, "--out", "golden"]
            words += [] if first == "simulate" else PATIENT
            status, said = _vnet([*words, "--no-report"], folder)
            assert (folder / "golden" / "verdict.json").exists(), said
            if way == "real time":
                return kinds_of(folder / "golden")
            return {"status": status} | results_of(folder / "golden")


def write_files(page: str, version: int, folder: Path) -> None:
    """Write the files of a page into `folder`."""
    versions: dict[str, list[str]] = {}
    for block in blocks((ROOT / page).read_text(encoding="utf-8"), page):
        found = _FILE.match(block.text)
        if name := found[1] if found else block.name if block.language == "csv" else "":
            versions.setdefault(name, []).append(block.text)
    for name, texts in versions.items():
        (folder / name).write_text(texts[: version or None][-1], encoding="utf-8")


def _make(file: str, page: str) -> None:
    """Run the Python block of a page that makes a file."""
    for block in blocks((ROOT / page).read_text(encoding="utf-8"), page):
        if block.language == "python" and f'"{file}"' in block.text:
            exec(compile(block.text, block.place, "exec"), {})
            return
    raise AssertionError(f"{page}: no block makes {file}")


def results_of(run: Path) -> dict[str, Any]:
    """Return what a run folder holds that must not change."""
    verdict = json.loads((run / "verdict.json").read_text())
    hashes = {name: verdict[f"{name}_sha256"][:_DIGITS] for name in ("trace", "metrics")}
    tables = {path.stem: _digest(path) for path in sorted(run.glob("*.parquet")) if path.stem not in hashes}
    if (tape := run / "tape.jsonl").exists():
        tables["tape"] = hashlib.sha256(tape.read_bytes()).hexdigest()[:_DIGITS]
    return {"verdict": verdict["verdict"], **hashes, **tables, "events": dict(sorted(_events(run).items()))}


def kinds_of(run: Path) -> dict[str, Any]:
    """Return what must not change of a run on the wall clock."""
    return {"verdict": json.loads((run / "verdict.json").read_text())["verdict"], "events": sorted(_events(run))}


def _events(run: Path) -> Counter[str]:
    kinds = (json.loads(line)["kind"] for line in (run / "events.jsonl").read_text().splitlines())
    return Counter(kind for kind in kinds if kind not in MEASURED)


def _digest(path: Path) -> str:
    """Return a digest of a table's rows, whatever the order of its columns and however the file holds them."""
    table, found = pq.read_table(path), hashlib.sha256()
    for name in sorted(table.column_names):
        found.update(f"{name} {table[name].to_pylist()!r}\n".encode())
    return found.hexdigest()[:_DIGITS]


def _vnet(words: Sequence[str], folder: Path) -> tuple[int, str]:
    """Return the exit status of a command of vnet, and what it prints; what starts no process runs in this one."""
    if words[0] in ("simulate", "export", "map"):
        with forgetting(folder):
            text, status = captured(typer.main.get_command(APPS["vnet"]), list(words))
        return status, text
    done = forked_commands.run([*VNET, *words], capture_output=True, timeout=TIMEOUT_S)
    return done.returncode, done.stdout + done.stderr


def dump(made_with: dict[str, str], rows: dict[str, Row]) -> str:
    """Return the text of a table."""
    parts = [HEADING, "[made_with]\n" + _lines(made_with)]
    for name, row in rows.items():
        told = {key: value for key, value in vars(row).items() if value and key != "results"}
        parts.append(f"[{json.dumps(name)}]\n{_lines(told)}results = {_inline(row.results)}\n")
    return "\n".join(parts)


def _lines(values: dict[str, Any]) -> str:
    return "".join(f"{key} = {json.dumps(value)}\n" for key, value in values.items())


def _inline(values: dict[str, Any]) -> str:
    parts = (f"{key} = {_inline(v) if isinstance(v, dict) else json.dumps(v)}" for key, v in values.items())
    return "{" + ", ".join(parts) + "}"


HEADING = """\
# What must not change: a row a run, whose results all its ways have. A row changes only where the key that it uses
# is deleted. `python -m tests.golden [ROW ...]` makes results again: name each row that changed, and why, in the
# commit. The results listed as `numpy` come of floating-point arithmetic that another version of numpy, or a
# processor without AVX2, rounds otherwise: they are compared where `made_with` is the same.
"""


def main(names: Sequence[str]) -> None:
    """Make the results of the named rows again, or of all."""
    import tempfile

    made_with, rows = load()
    if unknown := set(names) - rows.keys():
        sys.exit(f"no such row: {', '.join(sorted(unknown))}; there are {', '.join(rows)}")
    if names and made_with != machine():
        sys.exit(f"the table was made with {made_with}, and this is {machine()}: make all rows again")
    for name in names or rows:
        with tempfile.TemporaryDirectory() as folder:
            found = rows[name].run(rows[name].ways[0], Path(folder).resolve())
        print(f"{'same   ' if found == rows[name].results else 'CHANGED'}  {name}", flush=True)
        rows[name].results.clear()
        rows[name].results.update(found)
    TABLE.write_text(dump(machine(), rows), encoding="utf-8")
