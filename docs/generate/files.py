"""docs/reference/files.md: what a run leaves. Names and types come from the code, and each has its text here."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Mapping

import pyarrow as pa

from agents.cooperative.figures import Figures
from docs.generate.markdown import attribute_docstrings, docstring, table
from docs.generate.markdown import page as whole_page
from emulator.radio.outcomes import Outcome
from emulator.records.events import EventKind
from emulator.records.period_figures import program_figures
from emulator.records.recorded_world import ARRAYS
from emulator.records.tables import METRICS, STATES, TABLES, Column, Table, columns_of
from emulator.scenario.program import Program
from vnet.units import unit_of

INTRODUCTION = """
A run writes one folder: `runs/NAME-SEED` (with a number if that exists), or that of `--out`. `runs/latest` points
to the newest. Times are emulated nanoseconds from the start of the run; positions are metres east and north.
[How to read the tables](../how-to/results.md#read-the-tables) has examples.

The folder of a finished run is complete: `vnet check`, `report`, `render`, `compare`, `export` and `radio`
give the same results on another machine, without input files, program, or SUMO. Repeating the run
(`vnet run FOLDER/scenario.toml`) needs these.
"""
COOPERATIVE = """
Runs of `agents.cooperative`, and of programs that declare the same, have more columns: these in `states.parquet`,
and those below in `metrics.parquet`. Others [declare theirs](../how-to/results.md#declare-figures-of-periods).
"""
FOLDER = {
    "scenario.toml": "[the scenario](#scenariotoml) with every default, and digests of inputs and code; it "
    "reproduces the run",
    "tape.jsonl": "deviations from FIFO in [the order of events](../orders.md), with `run.order` or `run.tape`",
    "world.npz": "[the rest of the world](#worldnpz): vehicles, lanes, links",
    "events.jsonl": "[events](#eventsjsonl), one a line, written during the run",
    "verdict.json": "[the verdict](#verdictjson), the checks with their figures, and the command that "
    "reproduces the run",
    "manifest.json": "SHA-256 of each file above, of `logs/` but for `programs.txt`, and of `files/`, by its path; "
    "[`vnet check`](../checks.md#the-files-of-a-run) compares them",
    "logs/": "output and log of each vehicle: `v01.log`, … (live, of each process: its first vehicle's); further "
    "incarnations append. `programs.txt`: standard "
    "output of programs of a simulation with `--quiet`, `--log-format json` or in a campaign; `calls/`: frames and "
    "reports of each vehicle with their lines of code, with `--check-determinism`",
    "files/": "the disk of each vehicle, `node.folder`: `files/v01/`, …, up to `run.files_max_mb` each. Only "
    "regular files of processes that the emulator has started; during a run they are in `disks/`",
    "report.html": "[the run on one page](../viewing.md#reports)",
    "recording.rrd": "a Rerun recording, with `--rerun`",
    "control.json, operator.json": "the control endpoint for `vnet fault` and `vnet status`, during a live run",
    "access/": "users and credentials, if `vnet emulator` made them; do not share them with a run",
    "again/": "the repetition that differs, or the last one, with `--check-determinism`",
}
SCENARIO = """
Two sections are added by the run: SHA-256 of its inputs and its code.

- `[inputs]`: each input file by its path. `vnet run FOLDER/scenario.toml` refuses a file that has changed, by name.
  With SUMO in the loop, `libsumo` is its version and build, and another one is refused.
- `[code]`: `program` is one digest of the programs named in `entries` and of every module that they import,
  directly or not, from outside the standard library and site-packages; `vnet` is one digest of vnet's own sources.
  If either has changed, `vnet run FOLDER/scenario.toml` reports it in one line, records it (event `code_changed`,
  and the new digests), and continues. The hash of the trace does not depend on them.
"""
WORLD_ABOUT = """
An archive of numpy arrays, `np.load("world.npz")`, for `n` vehicles, `l` lanes, `k` periods and `r` receivers.
"""
FEW = 4
"""Columns of a table that are told in a sentence."""
WORLD_COLUMNS = ["array", "type", "shape", "unit", "what"]
KINDS = {"U": "text", "f": "double", "i": "int64", "b": "bool"}
FORMATS = """
`format` in `verdict.json` is the version of the whole folder.

- 5: `packet_delivery_ratio` counts receivers that are up. Of an earlier folder in which one was down it is not
  shown; `vnet radio` computes it.
- 4: `states.parquet` and `metrics.parquet` have the columns that the run's program declares, and no other's.
- 3: the folder has a `manifest.json`. Without one, checks that compare files are *unknown* instead of *invalid*.
- 2: the folder has a `world.npz`, and `scenario.toml` a section `[code]`.
- 1 (vnet 0.1.0): it has neither. `render` and, with `radio.links` in a file, checks and radio figures need
  the run's input files. Names of checks that began with `bit:` are read as `effect:`.

A folder of a later format is refused, with the version of vnet that wrote it.
"""
WORLD = {
    "node_ids": "ids of the vehicles, in the order of the scenario's network and of the tables' rows",
    "position_m": "positions at time 0; NaN of a vehicle that is not there yet",
    "area_m": "lower left and upper right corner of the box in which vehicles are during the run",
    "lane_point_m": "where each lane, or straight piece of a road, begins",
    "lane_heading_rad": "its direction of travel, counter-clockwise from east",
    "lane_length_m": "its length; infinite for a lane that is a straight line through its point",
    "links": "with `radio.links` only: whether the row's vehicle hears the column's",
    "link_time_ns": "with links over time only: from when on a row holds, in the order of their times",
    "link_sender": "number of the sender",
    "link_receiver": "number of the receiver",
    "link_loss": "probability of a loss; NaN if the receiver is out of range",
    "building_corner_m": "with `[radio.buildings]` only: the corners of the buildings near vehicles, ring by ring",
    "building_first": "for each ring its first corner, and then the number of all corners",
    "building_number": "the building to which each ring belongs; courts are rings of their own",
    "receiver_m": "with a recorded common error of several receivers only: what each has beyond the common error",
}
VERDICT = {
    "format": "version of the folder, [5](#formats)",
    "verdict": "`valid`, `invalid` or `unknown`",
    "checks": "list of {`name`, `verdict`, `text`, `figures`}; `figures.rows` are the first offending rows",
    "not_exercised": "list of {`name`, `reason`}",
    "trace_sha256": "SHA-256 of the trace's content, independent of its storage",
    "metrics_sha256": "SHA-256 of the metrics' content",
    "emulated_s": "length of all periods that were completed",
    "start_up_s": "time until all processes had joined; 0 if simulated",
    "wall_s": "wall-clock time from time 0 to the end",
    "real_time_factor": "emulated by wall-clock time",
    "seed": "`run.seed`",
    "order": "[the order of events](../orders.md): null in FIFO order, else its kind, its seed, the number of "
    "deviations, and where a given tape was left",
    "vehicles": "number of vehicles",
    "frames_by_outcome": "receptions by [outcome](#outcomes), copies included",
    "packet_delivery_ratio": "[of broadcasts](../export.md#radio-figures), without copies; null without any",
    "figures": "means of some metrics, after the first fifth of the run",
    "key_figures": "those of them that summaries show, with their titles, as the program declares them",
    "views": "`PEERS`, `CHARTS`, `ESTIMATES` as it [declares](../how-to/results.md#declare-figures-of-periods)",
    "roadside_units": "number of roadside units",
    "backbone": "where there are roadside units: number of messages and receivers by outcome; else empty",
    "driving": "where programs drive: `collisions`, `limited_actions`, `hardest_braking_m_s2`; else empty",
    "reported": "[figures of what programs report](../how-to/results.md#report-figures), by name: `reports`, "
    "`mean`, `p05`, `p95`, `last`, `is_share`; of a text `text` and its `share`",
    "cost": "[what the run cost](../how-to/fast.md#what-is-slow): `measured` (of each `program`, or of its "
    "`process`, which stands at its first vehicle), `cpu_s`, `wake_ups` (null in real time), `payload`, the "
    "same of up to 100 `vehicles`, the slowest first, and the number of `processes` of a simulation. The "
    "machine decides `cpu_s`: no hash and no comparison has it",
    "reproduce": "the command that reproduces the run, from any folder of the machine",
    "versions": "of vnet, Python and numpy, and `arithmetic`: which processors compute the same bits",
}


def page() -> str:
    """The whole page. Raises LookupError where a text is missing, or speaks of what is not there."""
    tables = {each.file: f"[{each.rows}](#{each.name}parquet){each.which}" for each in TABLES}
    rows = ([f"`{name}`", what] for name, what in (tables | FOLDER).items())
    parts = [INTRODUCTION, table(["file", "what"], rows)]
    for each in TABLES:
        about = docstring(each.fields_of) if each.fields_of else each.about
        if len(each.columns) <= FEW and not each.fields_of:
            parts += [f"## `{each.file}`", in_a_sentence(each), each.further]
            continue
        parts += [f"## `{each.file}`", about, columns(each.columns, each.fields_of), each.further]
    parts += ["## Columns of the cooperative program", COOPERATIVE, columns(_of_program(STATES), None)]
    parts += [docstring(Figures), columns(_of_program(METRICS), Figures)]
    parts += ["## Outcomes", "Each reception has exactly one."]
    public = [outcome for outcome in Outcome if outcome is not Outcome.pending]
    parts.append(table(["outcome", "what"], ([f"`{outcome.name}`", outcome.meaning] for outcome in public)))
    parts += ["## `scenario.toml`", SCENARIO, "## `world.npz`", WORLD_ABOUT, table(WORLD_COLUMNS, world_rows())]
    parts += [
        "## `events.jsonl`",
        "Each line is an object with `time_ns`, `kind`, `node` (or null) and these details.",
    ]
    rows = ([f"`{k}`", k.node_is, ", ".join(f"`{name}`" for name in k.details), k.meaning] for k in EventKind)
    parts.append(table(["kind", "node", "details", "what happened"], rows))
    parts += ["## `verdict.json`", "[checks.md](checks.md) has the claim of each check."]
    parts.append(table(["key", "what"], ([f"`{key}`", what] for key, what in VERDICT.items())))
    parts += ["## Formats", FORMATS]
    return whole_page("What a run leaves", *parts)


def world_rows() -> list[list[str]]:
    """A row for each array of world.npz. Raises LookupError where the texts do not fit them."""
    _check_texts("array", ARRAYS, WORLD)
    return [
        [f"`{name}`", KINDS[kind], f"({shape})", unit_of(name), WORLD[name]]
        for name, (kind, shape) in ARRAYS.items()
    ]


def _of_program(kind: Table) -> dict[str, Column]:
    """The columns that the cooperative program adds to a table."""
    declared = program_figures(Program(entry="agents.cooperative:main"))
    return {name: each for name, each in columns_of(kind, declared).items() if name not in kind.columns}


def columns(of: Mapping[str, Column], fields_of: type | None) -> str:
    """The columns of a table with their types, units and texts. Raises LookupError where a text is missing."""
    said = {name: column.text for name, column in of.items()}
    said |= attribute_docstrings(fields_of) if fields_of else {}
    _check_texts("column", of, {name: text for name, text in said.items() if text})
    rows = ([f"`{n}`", f"`{_type(c.type)}`", unit_of(n), said[n]] for n, c in of.items())
    return table(["column", "type", "unit", "what"], rows)


def in_a_sentence(kind: Table) -> str:
    """The columns of a table that has few."""
    said = (
        f"`{name}` ({', '.join(filter(None, [f'`{_type(column.type)}`', unit_of(name)]))}): {column.text}"
        for name, column in kind.columns.items()
    )
    return textwrap.fill(f"{kind.about} {'; '.join(said)}.".strip(), 120, break_on_hyphens=False)


def _check_texts(what: str, names: Iterable[str], texts: Mapping[str, str]) -> None:
    if wrong := set(names) ^ texts.keys():
        raise LookupError(f"{what}s without a text, or texts without {what}: {', '.join(sorted(wrong))}")


def _type(kind: pa.DataType) -> str:
    """An Arrow type in short: a dictionary is how its values are stored, and not what they are."""
    if pa.types.is_dictionary(kind):
        return str(kind.value_type)
    if pa.types.is_fixed_size_list(kind):
        return f"{kind.value_type}[{kind.list_size}]"
    if pa.types.is_list(kind):
        return f"{kind.value_type}[]"
    if pa.types.is_map(kind):
        return f"map of {kind.key_type} to {_type(kind.item_type)}"
    return str(kind)
