"""Results of every reader of a run's folder, as plain texts and bytes that can be compared."""

import io
import shutil
from dataclasses import asdict
from pathlib import Path

from rich.console import Console
from typer.testing import CliRunner

from emulator.checks.judge import check_run
from emulator.export.mcap_file import write_mcap
from emulator.export.pcapng import write_pcapng
from emulator.export.tables import write_csv
from emulator.records.recorded_run import RecordedRun
from emulator.report.comparison import Comparison, print_comparison
from emulator.report.source import Source
from emulator.report.write import report_page
from emulator.stream import messages
from tests.support.command_line import app
from tests.support.recordings import Entity, read_back

READERS = ("check", "report", "play", "compare", "pcapng", "mcap", "csv", "radio")
Readings = dict[str, str | bytes]


def readings(folder: Path, other: Path, scratch: Path) -> Readings:
    """Return the results of all `READERS` for a run, without its folder's name; `other` is compared with it."""
    recorded = RecordedRun.open(folder)
    pcapng, mcap = io.BytesIO(), io.BytesIO()
    write_pcapng(recorded, pcapng)
    write_mcap(recorded, mcap)
    tables = scratch / "csv"
    tables.mkdir(parents=True)
    written = {name: (tables / name).read_text() for name in write_csv(recorded, tables)}
    shutil.rmtree(tables)
    read = {
        "check": repr(asdict(check_run(folder))) + command("check", str(folder)),
        "report": report_page(Source(folder)),
        "play": repr(list(messages(folder))),
        "compare": compared(folder, other),
        "csv": repr(written),
        "radio": command("radio", str(folder)),
    }
    named = {name: text.replace(str(folder), "RUN") for name, text in read.items()}
    return {**named, "pcapng": pcapng.getvalue(), "mcap": mcap.getvalue()}


def compared(folder: Path, other: Path) -> str:
    """Return what `vnet compare` prints of two runs; the charts of its page are in tests/emulator/report."""
    printed = io.StringIO()
    print_comparison(Comparison.of(folder, other), Console(file=printed, width=200))
    return printed.getvalue()


def rendered(folder: Path) -> str:
    """Return the drawing that `vnet render` makes of a run.

    Sorted: Rerun writes what has come in since its last tick, so the order in a file depends on the machine.
    """
    command("render", str(folder))
    drawn = read_back(folder / "recording.rrd")
    del drawn["/__properties"]  # when it was made
    return repr([(path, _sorted(entity)) for path, entity in sorted(drawn.items())])


def _sorted(entity: Entity) -> object:
    return sorted(entity.static.items()), [(name, sorted(at.items())) for name, at in sorted(entity.at.items())]


def command(*arguments: str) -> str:
    """Run `vnet ARGUMENTS` in this process, which must succeed; returns what it prints."""
    done = CliRunner(env={"PYTHONHASHSEED": "0"}).invoke(app, arguments)
    assert done.exit_code == 0, done.output
    return done.stdout
