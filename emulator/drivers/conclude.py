"""The end of a run: its tables, its verdict, and the command that reproduces it."""

from __future__ import annotations

import platform
import shlex
import signal
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import asdict
from importlib.metadata import version
from io import StringIO
from typing import Any

import numpy as np
import pyarrow as pa

from emulator.checks.folder import kept, verdict_figures
from emulator.checks.judge import Judgement, RecordedRun, judge
from emulator.checks.own import PREFIX, own_findings
from emulator.drivers.emulation import Emulation
from emulator.drivers.signals import signals_handled
from emulator.radio.outcomes import Outcome
from emulator.records.costs import run_cost
from emulator.records.disk import room_held
from emulator.records.events import EventKind
from emulator.records.manifest import write_manifest
from emulator.records.recorded_world import RecordedWorld
from emulator.records.run import Run
from emulator.records.run_folder import (
    FORMAT,
    VERDICT_FILE,
    VERDICT_ROOM_BYTES,
    WORLD_FILE,
    RunFolder,
    collect,
    write_text,
)
from emulator.records.tables import BACKBONE, BACKGROUND, BUSY, DRIVEN, PAYLOADS, SAMPLES, TABLES, busy_table
from emulator.records.tape import TAPE_FILE, described, dump_tape
from emulator.records.verdicts import Finding, NotExercised
from emulator.scenario.own_functions import declared_checks
from vnet.errors import sendable
from vnet.runtime.environment import arithmetic


def _start_up_s(emulation: Emulation) -> float | None:
    """Time in s that the processes took to start and join; None if they never did."""
    started = [event for event in emulation.folder.events if event.kind == EventKind.started]
    return float(started[0].details["start_up_s"]) if started else None


def gather(emulation: Emulation, wall_s: float) -> RecordedRun:
    """Return the tables of a run that is over. None of them is kept yet."""
    folder = emulation.folder
    over_ns = emulation.emulated_ns if emulation.ended_ns is None else emulation.ended_ns
    emulation.log_book.tell_left_out(over_ns)
    for node, left_out in collect(folder, emulation.world.node_ids, emulation.scenario.run.files_max_mb).items():
        folder.event(over_ns, EventKind.files_left_out, node, count=left_out.count, which=left_out.which)
    metrics = emulation.metrics.metrics_table()  # figures that fail are an event
    folder.event(over_ns, EventKind.ended, wall_s=round(wall_s, 3))
    return RecordedRun(
        emulation.scenario,
        emulation.engine.trace.to_table(),
        emulation.metrics.states_table(),
        metrics,
        folder.events,
        world=RecordedWorld.of(emulation.world),
        more={
            BUSY: _busy(emulation),
            DRIVEN: emulation.driving.table(),
            BACKBONE: emulation.backbone.table(),
            BACKGROUND: emulation.driving.background(),
            PAYLOADS: None if emulation.payloads is None else emulation.payloads.to_table(),
            SAMPLES: None if emulation.samples is None else emulation.samples.to_table(),
        },
    )


def judge_unkept(emulation: Emulation, wall_s: float) -> Judgement:
    """Judge a run of which nothing is kept: files are written only if a check of the user's own asks for them."""
    recorded = gather(emulation, wall_s)

    def write() -> None:
        emulation.folder.open(emulation.scenario)
        _put_tables(emulation, recorded)

    return judge(recorded, _own_findings(recorded, emulation.folder, write))


def conclude(
    emulation: Emulation, wall_s: float, command: str, replay: str = ""
) -> tuple[Judgement, dict[str, Any]]:
    """Write what is kept of a run and judge it. `command` is the vnet command that ran it (run, simulate).

    `replay` says why no replay is warranted, if none is. Returns the judgement and the contents of verdict.json.
    What the disk refuses is left out, and the run is unknown; raises VnetError if it refuses the verdict itself.
    """
    folder = emulation.folder
    emulated_s = emulation.emulated_ns / 1e9
    recorded = gather(emulation, wall_s)
    with room_held(folder.path, VERDICT_ROOM_BYTES):
        _put_tables(emulation, recorded)
    own = _own_findings(recorded, folder)
    judgement = judge(recorded, [*kept(folder.unkept), *own])
    reproduce = f"vnet {command} {shlex.quote(str(folder.scenario_path.absolute()))}"  # from any folder
    if replay:
        judgement.put(NotExercised("replay", replay))
        reproduce += " --program MODULE:FUNCTION"
    cost = run_cost(emulation.costs, emulation.world.node_ids, *emulation.engine.trace.sizes())
    verdict = {
        "format": FORMAT,
        **_judged(judgement),
        "trace_sha256": judgement.trace_sha256,
        "metrics_sha256": emulation.metrics.sha256(),
        **verdict_figures(recorded, emulation.metrics.rows),
        "key_figures": [asdict(each) for each in emulation.metrics.declared.key],
        "views": asdict(emulation.metrics.declared.views),
        "start_up_s": _start_up_s(emulation),
        "wall_s": round(wall_s, 3),
        "real_time_factor": round(emulated_s / wall_s, 3) if wall_s > 0 else None,
        "order": _order(emulation),
        "frames_by_outcome": {o.name: n for o, n in emulation.engine.counts.items() if o is not Outcome.pending},
        "cost": asdict(cost),
        "reproduce": reproduce,
        "versions": {
            "vnet": version("vnet-emulator"),
            "python": platform.python_version(),
            "numpy": np.__version__,
            "arithmetic": arithmetic(),
            **emulation.driving.versions,
        },
    }
    _put_verdict(folder, verdict)
    return judgement, verdict


def _put_verdict(folder: RunFolder, verdict: dict[str, Any]) -> None:
    """Write the verdict, and the manifest that has its digest and those of all files before it."""
    folder.put_json(VERDICT_FILE, verdict)
    write_manifest(folder)


def _put_tables(emulation: Emulation, recorded: RecordedRun) -> None:
    """Write the tables of a run into its folder."""
    folder = emulation.folder
    folder.complete_events()
    if recorded.world is not None:
        folder.keep(WORLD_FILE, recorded.world.write)
    tables = {kind: table for kind in TABLES if (table := recorded.table(kind)) is not None}
    for kind in sorted(tables, key=lambda kind: tables[kind].nbytes):  # on a full disk the smaller ones are kept
        folder.keep_table(kind.file, tables[kind])
    if emulation.orders.explores:
        tape = dump_tape(emulation.orders.in_order())
        folder.keep(TAPE_FILE, lambda path: write_text(path, tape))


def _order(emulation: Emulation) -> dict[str, Any] | None:
    """Return what a verdict says of the order of events: None in FIFO order, else the number of deviations.

    `left` is the first entry of a given tape that the run could not follow, as a phrase.
    """
    orders, run = emulation.orders, emulation.scenario.run
    if not orders.explores:
        return None
    left = orders.left()
    return {
        "kind": "tape" if run.tape is not None else run.order,
        "seed": run.order_seed,
        "deviations": len(orders.made),
        "left": None if left is None else described(left),
    }


def _own_findings(
    recorded: RecordedRun, folder: RunFolder, write: Callable[[], None] = lambda: None
) -> list[Finding]:
    """Judge a run by its own checks. What they print goes to logs/checks.txt; Ctrl-C ends them, and no more.

    `write` makes the folder's files should a check ask for them.
    """
    program = recorded.scenario.program
    if not program.checks and not declared_checks(program):
        return []
    with (
        redirect_stdout(StringIO()) as printed,
        redirect_stderr(printed),
        signals_handled(signal.default_int_handler, signal.SIGINT),
    ):
        findings = own_findings(program, Run(recorded, folder.path, write=write))
    if printed.getvalue():
        folder.keep("logs/checks.txt", lambda path: write_text(path, sendable(printed.getvalue())))
    return findings


def _busy(emulation: Emulation) -> pa.Table | None:
    """Table of channel busy ratios; None where there is no MAC."""
    if emulation.scenario.radio.mac is None:
        return None
    windows = emulation.engine.busy_ratios(emulation.emulated_ns)
    nodes = emulation.world.node_ids
    return busy_table(np.array(windows).reshape(-1, len(nodes)), nodes)


def _judged(judgement: Judgement) -> dict[str, Any]:
    return {
        "verdict": judgement.verdict.value,
        "checks": [asdict(check) for check in judgement.checks],
        "not_exercised": [asdict(check) for check in judgement.not_exercised],
    }


def judge_further(
    emulation: Emulation, judgement: Judgement, verdict: dict[str, Any], findings: Sequence[Finding]
) -> dict[str, Any]:
    """Add findings to a concluded run; returns the new contents of verdict.json."""
    for finding in findings:
        judgement.put(finding)
    if own := [finding.name for finding in findings if finding.name.startswith(PREFIX)]:  # no scenario names them
        emulation.folder.event(emulation.emulated_ns, EventKind.judged_by_test, checks=own)
    verdict = {**verdict, **_judged(judgement)}
    _put_verdict(emulation.folder, verdict)
    return verdict
