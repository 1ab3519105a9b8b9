"""`vnet radio` and `vnet export`: a run's radio in figures, and a run in formats that other tools read."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Annotated, Any, BinaryIO, Literal, get_args

import pyarrow as pa
import pyarrow.parquet as pq
import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from emulator.cli.options import LATEST, RunArgument
from emulator.export.mcap_file import write_mcap
from emulator.export.pcapng import write_pcapng
from emulator.export.tables import write_csv, write_links
from emulator.records.disk import atomically, disk_errors
from emulator.records.manifest import differing_files, read_manifest
from emulator.records.radio_metrics import BIN_M, RadioMetrics, UnicastFigures, radio_metrics, unicast_figures
from emulator.records.recorded_run import OpenedRun, RecordedRun
from emulator.records.run_folder import check_is_run
from emulator.scenario.sections import DAY_S, FAR_M
from emulator.terminal.console import one_line_errors, tell
from emulator.terminal.live import SafeConsole
from vnet.errors import VnetError

Format = Literal["pcapng", "mcap", "csv", "links"]
WORST_LINKS = 10
FIGURES = {
    "latency": "latency_mean_ms",
    "inter-packet gap": "inter_reception_mean_ms",
    "age of information": "age_mean_ms",
}
DISTANCE_COLUMNS = {"from": "from_m", "to": "to_m", "pairs": "pairs", "delivered": "delivery_ratio"}
LINK_COLUMNS = {
    "sender": "sender",
    "receiver": "receiver",
    "pairs": "pairs",
    "delivered": "delivery_ratio",
    "apart": "distance_mean_m",
    "latency": "latency_mean_ms",
    "gap p95": "inter_reception_p95_ms",
    "age": "age_mean_ms",
    "oldest": "age_peak_ms",
}


def radio(
    run: RunArgument = LATEST,
    bin_m: Annotated[
        float, typer.Option("--bin", min=0.1, max=FAR_M, help="Width of the bins of distance in m.")
    ] = BIN_M,
    within_m: Annotated[
        float, typer.Option("--within", min=0, help="Receivers farther than this, in m, count as out of range.")
    ] = math.inf,
    from_s: Annotated[
        float,
        typer.Option("--from", min=0, max=DAY_S, help="Only frames that were enqueued from this time on, in s."),
    ] = 0.0,
    out: Annotated[
        Path | None, typer.Option(help="Folder for links.parquet, vehicles.parquet and distances.parquet.")
    ] = None,
) -> None:
    """A run's radio in figures: delivery by distance, latency, time between receptions, age of information."""
    with one_line_errors():
        recorded = RecordedRun.open(run)
        metrics = radio_metrics(recorded, bin_m, within_m=within_m, from_s=from_s)
        if out is not None:
            tables = {"links": metrics.links, "vehicles": metrics.vehicles, "distances": metrics.distances}
            with disk_errors(out):
                out.mkdir(parents=True, exist_ok=True)
            for name, table in tables.items():
                with atomically(out / f"{name}.parquet") as part:
                    pq.write_table(table, part, compression="zstd")
        _print(metrics, unicast_figures(recorded, within_m, from_s), SafeConsole())


def _print(metrics: RadioMetrics, unicast: UnicastFigures | None, console: Console) -> None:
    totals = metrics.totals
    if unicast is not None:
        console.print(f"{'frames to one vehicle':24}{unicast}", highlight=False)
    if not totals["pairs"]:
        console.print("nobody broadcast anything to anybody in range")
        return
    counts = f"{totals['pairs']:,} pairs on {totals['links']:,} links, {totals['delivered']:,} delivered"
    console.print(f"{counts}: {totals['delivery_ratio']:.2%}", highlight=False)
    for text, name in FIGURES.items():
        console.print(f"{text:24}{_cell(totals[name])} ms", highlight=False)
    if totals["busy_ratio_mean"] is not None:
        console.print(f"{'busy ratio':24}{totals['busy_ratio_mean']:.1%}", highlight=False)
    console.print(_table("delivered, by distance in m", metrics.distances, DISTANCE_COLUMNS))
    worst = metrics.worst_links(WORST_LINKS)
    console.print(_table("the worst links; distances in m, times in ms", worst, LINK_COLUMNS))


def _table(title: str, rows: pa.Table, columns: Mapping[str, str]) -> Table:
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for heading in columns:
        table.add_column(heading, justify="right", no_wrap=True)
    for row in rows.select(list(columns.values())).to_pylist():
        table.add_row(*(_cell(row[name], name.endswith("ratio")) for name in columns.values()))
    return table


def _cell(value: Any, share: bool = False) -> str:
    if isinstance(value, float):
        return f"{value:.1%}" if share else f"{value:,.1f}"
    return "" if value is None else f"{value:,}" if isinstance(value, int) else str(value)


def export(
    run: RunArgument = LATEST,
    to: Annotated[
        Format | None,
        typer.Option(
            help="pcapng for Wireshark, mcap for Foxglove and Rerun, csv, or links: a table for radio.links. "
            "Default: as --out ends, else csv."
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="File, or for csv folder, that does not exist yet; by default in the run's folder."),
    ] = None,
    payloads: Annotated[
        Literal["its"] | None,
        typer.Option(help="Of pcapng: its for CAM and DENM, which then have headers of GeoNetworking and BTP."),
    ] = None,
    every_s: Annotated[
        float | None,
        typer.Option(
            "--every", min=0, max=DAY_S, help="Of links: seconds for each loss; 0: each frame. Default: 1."
        ),
    ] = None,
    definitions: Annotated[
        Path | None,
        typer.Option(help="Of mcap: folder with PACKAGE/msg/TYPE.msg of own types of ROS 2."),
    ] = None,
) -> None:
    """Write a run in a format that other tools read."""
    with one_line_errors():
        chosen = _format(to, out)
        if every_s is not None and chosen != "links":
            raise VnetError(f"--every {every_s:g}: of links, and not of {chosen}")
        if payloads is not None and chosen != "pcapng":
            raise VnetError(f"--payloads {payloads}: of pcapng, and not of {chosen}")
        if definitions is not None and chosen != "mcap":
            raise VnetError(f"--definitions {definitions}: of mcap, and not of {chosen}")
        check_is_run(run)
        recorded = RecordedRun.open(run)
        for problem in _damage(run):
            tell(f"{run}: {problem}; vnet check says more")
        match chosen:
            case "pcapng":
                path = out or run / "frames.pcapng"
                writer = partial(write_pcapng, as_its=payloads is not None)
                print(f"{_write(path, recorded, writer):,} packets in {path}")
            case "mcap":
                path = out or run / "run.mcap"
                writer = partial(write_mcap, definitions=definitions, tell=partial(print, file=sys.stderr))
                print(f"{_write(path, recorded, writer):,} messages in {path}")
            case "links":
                path = out or run / "links.csv"
                links = partial(write_links, every_s=1.0 if every_s is None else every_s)
                print(f"{_write(path, recorded, links):,} rows in {path}")
            case "csv":
                path = out or run / "csv"
                print(f"{', '.join(_write_folder(path, recorded))} in {path}")


def _damage(run: Path) -> list[str]:
    """Return what is wrong with the files of a finished run, if anything."""
    try:
        digests = read_manifest(run)
    except VnetError as error:
        return [str(error).removeprefix(f"{run}/")]
    wrong = {} if digests is None else differing_files(run, digests)
    return [f"{name} {problem}" for name, problem in wrong.items()]


def _format(to: Format | None, out: Path | None) -> Format:
    """Return the format that was asked for by name or by the end of the file's name; refuse two at once."""
    suffix = "" if out is None else out.suffix.lower().removeprefix(".")
    of_suffix = next((each for each in get_args(Format) if each == suffix), None)
    if to == "links" and suffix == "csv":
        return to
    if to is not None and of_suffix not in (to, None):
        raise VnetError(f"--out {out}: ends like a file of {suffix}, and --to is {to}")
    if suffix in ("pcap", "cap"):
        raise VnetError(f"--out {out}: of captures pcapng is written; let it end with .pcapng")
    return to or of_suffix or "csv"


def _write(path: Path, recorded: OpenedRun, writer: Callable[[OpenedRun, BinaryIO], int]) -> int:
    """Write a file in one step; return what `writer` counts."""
    _refuse_existing(path)
    with atomically(path) as part, part.open("wb") as file:
        return writer(recorded, file)


def _write_folder(path: Path, recorded: OpenedRun) -> list[str]:
    _refuse_existing(path)
    with atomically(path) as part:
        part.mkdir(parents=True)
        return write_csv(recorded, part)


def _refuse_existing(path: Path) -> None:
    if path.exists():
        raise VnetError(f"{path}: exists; remove it, or say --out")
