"""Checks of a finished run's folder, which `vnet check` makes beside those of the run: its files fit together.

A folder of an earlier format has no manifest, and was written without these checks: where one of them finds
something there, the run is *unknown* and not *invalid*.

Some compute again what the folder holds: metrics from states, truth from the world, outcomes from frames. They need
no program, and find what no other check speaks of, because no law of the radio or of a fault is broken by it.
"""

from __future__ import annotations

import math
import re
import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, is_dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from emulator.checks.channel import bounds, received_twice
from emulator.checks.faults import frames_since
from emulator.checks.own import PREFIX
from emulator.radio.engine import Engine
from emulator.records.code_digest import vnet_digest
from emulator.records.costs import Costs, PayloadSizes, RunCost, run_cost
from emulator.records.events import CUTS_RUN, ENDS_PROGRAM, EventKind, kinds_with
from emulator.records.manifest import differing_files, read_manifest
from emulator.records.metrics import rows_of, sha256_of_rows, summarize
from emulator.records.period_figures import Period, figures_of
from emulator.records.radio_metrics import delivery_ratio
from emulator.records.recorded_run import OpenedRun, RecordedRun
from emulator.records.recorded_world import ARRAYS, RecordedWorld
from emulator.records.reported import reported_figures
from emulator.records.run_folder import MANIFEST_FILE, SCENARIO_FILE, VERDICT_FILE, WORLD_FILE
from emulator.records.tables import BACKBONE, BUSY, DRIVEN, PAYLOADS, STATES, backbone_figures, driving_figures
from emulator.records.verdicts import (
    FIRST_WITH_RATIO,
    MOST_ROWS,
    CheckResult,
    Finding,
    Judgement,
    NotExercised,
    Verdict,
    invalid,
    named,
    not_exercised,
    result,
    unknown,
)
from emulator.scenario.faults import BurstLoss, Corrupt, OwnRule, SenderFault, StaleMessages
from emulator.scenario.loading import input_files_of, parse_toml
from emulator.scenario.own_functions import are_here, declared_checks
from emulator.scenario.scenario import Scenario
from emulator.world.truth import FaultyGnss
from emulator.world.world import Instant, build_world, components, periods_of
from vnet.errors import ScenarioError, counted, first_names, printable
from vnet.radio import SentFrame
from vnet.transport.wire import LARGEST_MESSAGE_BYTES
from vnet.types import Array, IntArray, Mask

TOLERANCE_M = 1e-6
"""Difference of a recomputed position that is none; headings in rad have the same."""
RELATIVE, ABSOLUTE = 1e-9, 1e-9
"""Difference of a recomputed figure that is none: sums in another order differ in their last bits."""
POWER_STEP_DB = 0.011
"""Difference of a recomputed power that is none: one step of its rounding."""
SPARE_ROWS = 1_000_000
"""States that a world may have beyond those of the run, which was cut short, and is still built for it."""
MOST_RECEPTIONS = 20_000_000
"""Receptions that are decided again; more take minutes."""
MOST_BYTES = 1 << 32
"""Bytes of frames that are sent again: each is hashed."""
KEY = ("sent_ns", "sender", "seq", "receiver", "copy")
"""Columns that name a row of the trace, in the order of its rows."""
UNCOMPARED = (*KEY, "payload_digest", "size_bytes")
FIRST_WITH_MANIFEST = 3
"""Format of the first folders that have a manifest."""
FILES = "files"
NO_PERIOD = "no period was completed"
NOT_OF_THE_RUN = (FILES, "replay", "trace_sha256")
"""Checks that compare files, and have other findings once the run is over."""


def same_numbers(ours: Array, theirs: Array, tolerance: float = ABSOLUTE) -> Mask:
    """Return which numbers are equal but for rounding; NaN equals NaN."""
    return np.isclose(ours, theirs, rtol=RELATIVE, atol=tolerance, equal_nan=True)


def check_metrics(recorded: OpenedRun) -> Finding:
    """Check that the metrics are those of the states, and that verdict.json has their hash."""
    if not len(recorded.metrics) and not recorded.periods:
        return not_exercised("no period was completed")
    rows = rows_of(recorded.metrics)
    wrong = list(_wrong_metrics(recorded, rows))
    if (told := recorded.record.metrics_sha256) and told != sha256_of_rows(rows):
        wrong.append({"period": None, "figure": "metrics_sha256", "kept": told[:12], "computed": "another"})
    text = f"{counted(len(rows), 'period')}, all figures as the states give them"
    first = f", first {wrong[0]['figure']}" if wrong else ""
    broken_text = f"{counted(len(wrong), 'figure')} other than the states give{first}"
    return result(len(wrong), text, broken_text, wrong)


def _wrong_metrics(recorded: RecordedRun, rows: list[Any]) -> Iterator[dict[str, Any]]:
    if len(rows) != recorded.periods:
        yield {"period": None, "figure": "periods", "kept": len(rows), "computed": recorded.periods}
    for kept, computed in zip(rows, _computed_figures(recorded), strict=False):
        for field in fields(computed):  # a folder may have more, of a program that is not installed
            ours, theirs = getattr(kept, field.name), getattr(computed, field.name)
            # The states have the last report of a period only, and no empty one.
            counts_reports = field.name in ("reporting", "not_finite")
            if ours < theirs if counts_reports else not _alike(ours, theirs):
                yield {"period": computed.period, "figure": field.name, "kept": ours, "computed": theirs}


def _alike(ours: Any, theirs: Any) -> bool:
    if isinstance(ours, list) and isinstance(theirs, list):
        return len(ours) == len(theirs) and all(map(_alike, ours, theirs))
    if ours == theirs:
        return True
    if ours is None or theirs is None:
        return False
    return bool(same_numbers(np.asarray(ours, float), np.asarray(theirs, float)))


def _computed_figures(recorded: RecordedRun) -> list[Any]:
    """Return the figures of all periods, from the states alone."""
    position_m, heading = recorded.vectors("position_m"), np.zeros(0)
    fix_m, common_m = recorded.vectors("fix_m"), recorded.vectors("common_error_m")
    columns = {name: recorded.by_period(name).reshape(-1, size) for name, size in recorded.declared.vectors.items()}
    period_ns, component = recorded.scenario.period_ns, None
    periods = []
    for period in range(recorded.periods):
        if component is None or recorded.topology_changes:
            links = recorded.places.links(period * period_ns)
            component = components(recorded.places.position_m(period), links)
        instant = Instant(
            period, period * period_ns, position_m[period], heading, common_m[period, 0], fix_m[period], heading
        )
        periods.append(Period(instant, component, int(recorded.reported[period].sum()), not_finite=0))
    return figures_of(periods, columns, recorded.declared)[0] if periods else []


def input_of(scenario: Scenario) -> str:
    """Return why a world cannot be built from the scenario alone; "" if it can."""
    if scenario.network.programs_drive:
        return "programs drive the vehicles"
    if scenario.network.function is not None:
        return f"vehicles are where {scenario.network.function} says"
    named = [str(path) for path in input_files_of(scenario)]
    return f"the world comes from files: {first_names(named, 2)}" if named else ""


def check_truth(recorded: OpenedRun) -> Finding:
    """Check that positions, headings, common errors and fixes are those that the scenario and its seed give."""
    scenario = recorded.scenario
    if why := input_of(scenario):
        return not_exercised(why)
    vehicles = len(recorded.world.node_ids)
    if vehicles != scenario.network.vehicles + len(scenario.roadside):
        text = f"{WORLD_FILE} has {counted(vehicles, 'node')}, the scenario {scenario.network.vehicles}"
        return invalid(text)
    if periods_of(scenario) * vehicles > len(recorded.states) + SPARE_ROWS:
        return not_exercised("the run was cut short")
    world = build_world(scenario)
    ours, theirs = recorded.world.arrays(), RecordedWorld.of(world).arrays()
    wrong = [
        {"file": WORLD_FILE, "column": name}
        for name in ARRAYS
        if not _same_array(name, ours.get(name), theirs.get(name))
    ]
    if recorded.node_ids and list(world.node_ids) != recorded.node_ids:
        wrong.append({"file": STATES.file, "column": "node"})
    else:
        wrong += _wrong_states(recorded, FaultyGnss(world, recorded.plan, scenario.run.seed), recorded.periods)
    text = f"{counted(recorded.periods, 'period')} of {counted(vehicles, 'node')} as the scenario gives them"
    first = f"{wrong[0]['column']} of {wrong[0]['file']}" if wrong else ""
    broken_text = f"other truth or fixes than the scenario gives, first in {first}"
    return result(len(wrong), text, broken_text, wrong)


def _same_array(name: str, mine: NDArray[Any] | None, other: NDArray[Any] | None) -> bool:
    if mine is None or other is None or mine.shape != other.shape:
        return mine is other
    if name == "area_m":  # of a test that ended the run early it is that of the whole
        return bool((mine[0] <= other[0] + TOLERANCE_M).all() and (mine[1] >= other[1] - TOLERANCE_M).all())
    if mine.dtype.kind != "f":
        return bool(np.array_equal(mine, other))
    return bool(same_numbers(mine, other, TOLERANCE_M).all())


def _wrong_states(recorded: RecordedRun, gnss: FaultyGnss, periods: int) -> list[dict[str, Any]]:
    wrong: list[dict[str, Any]] = []
    vectors = {name: recorded.vectors(name) for name in ("position_m", "fix_m", "common_error_m")}
    heading = recorded.scalars("heading_rad")
    for period in range(periods):
        instant = gnss.at(period)
        for name, array in (*vectors.items(), ("heading_rad", heading)):
            ours = array[period]
            theirs = np.broadcast_to(getattr(instant, name), ours.shape)
            same = same_numbers(ours, theirs, TOLERANCE_M).reshape(len(ours), -1).all(axis=1)
            for node in np.flatnonzero(~same)[: MOST_ROWS - len(wrong)].tolist():
                row = {"file": STATES.file, "column": name, "period": period, "node": recorded.node_ids[node]}
                wrong.append({**row, "kept": ours[node].tolist(), "computed": theirs[node].tolist()})
        if len(wrong) >= MOST_ROWS:
            break
    return wrong


# The radio.


def check_outcomes(recorded: OpenedRun) -> Finding:
    """Check that each reception has the outcome, cause and arrival that the radio gives the frames of the trace."""
    if why := _why_not_decided_again(recorded):
        return not_exercised(why)
    size = recorded.column("size_bytes")
    if int(size.min()) < 0 or int(size.max()) > LARGEST_MESSAGE_BYTES:
        return invalid(f"frames of {int(size.min())} to {int(size.max())} bytes")
    try:
        engine = _decided_again(recorded)
    except (AssertionError, IndexError, OverflowError, ValueError) as error:  # no run has such frames
        return invalid(f"the radio cannot send these frames: {printable(str(error))}")
    computed = engine.trace.to_table()
    order = np.lexsort([_codes(recorded, each) for each in reversed(KEY)])
    kept = recorded.trace.take(pa.array(order))
    unsure = np.unique(recorded.frame[_unsure(recorded)])
    ours, theirs = (
        table.filter(pa.array(~np.isin(_frames(recorded, table), unsure))) for table in (kept, computed)
    )
    if not len(ours):
        return not_exercised("all depends on frames that nobody was in range of")
    wrong = _first_difference(recorded, ours, theirs) + _wrong_busy_ratios(recorded, engine)
    counts = {outcome.name: count for outcome, count in engine.counts.items()}
    text = f"{counted(len(ours), 'reception')} decided again as they were"
    if len(ours) < len(kept):
        text += f"; {len(kept) - len(ours):,} depend on frames that nobody was in range of"
    broken_text = f"{counted(len(wrong), 'reception')} other than the radio decides" if wrong else ""
    return result(len(wrong), text, broken_text, wrong, out_of_range=counts["out_of_range"])


def _unsure(recorded: RecordedRun) -> Mask:
    """Return the rows that frames which are not in the trace may have decided: by a queue, or a chain of losses."""
    unsure = bounds(recorded).unsure
    for planned in recorded.plan:
        if isinstance(planned.fault, BurstLoss):
            seen, _, most = frames_since(recorded, planned)
            unsure = unsure | (recorded.may_reach(planned) & (most > seen))
    return unsure


def _frames(recorded: RecordedRun, table: pa.Table) -> IntArray:
    """Return the number of the frame of each row of a trace, as `RecordedRun.frame` has it."""
    sender = table["sender"].cast(pa.string()).combine_chunks().dictionary_encode()
    code = np.array([recorded.number_of(node) for node in sender.dictionary.to_pylist()], dtype=np.int64)
    seq = np.asarray(table["seq"].to_numpy(), dtype=np.int64)
    return np.asarray(code[sender.indices.to_numpy()] * (int(recorded.seq.max(initial=0)) + 1) + seq)


def _wrong_busy_ratios(recorded: RecordedRun, engine: Engine) -> list[dict[str, Any]]:
    """Return the first channel busy ratio that is not the one of these frames."""
    kept = recorded.busy_ratio
    computed = np.array(engine.busy_ratios(recorded.periods * recorded.scenario.period_ns)).reshape(
        -1, kept.shape[1]
    )
    if recorded.table(BUSY) is None or (len(kept) == len(computed) and same_numbers(kept, computed).all()):
        return []
    shared = min(len(kept), len(computed))
    windows = np.flatnonzero(~same_numbers(kept[:shared], computed[:shared]).all(axis=1))
    return [{"trace": BUSY.file, "window": int(windows[0]) if len(windows) else shared}]


def _why_not_decided_again(recorded: OpenedRun) -> str:
    run, faults = recorded.scenario.run, [planned.fault for planned in recorded.plan]
    payload_bytes = np.maximum(recorded.column("size_bytes")[_originals(recorded)], 0).sum()
    reasons = {
        "no frame was sent": not len(recorded.trace),
        "in real time the machine has a part in it": run.pacing == "realtime",
        "where vehicles are in a period that the run did not complete is not known": not recorded.placed.all(),
        "the order of events was not FIFO": run.order != "fifo" or run.tape is not None,
        "the run was cut short": bool(recorded.event(*kinds_with(CUTS_RUN), EventKind.spun, EventKind.died)),
        f"receptions: more than {MOST_RECEPTIONS:,}": len(recorded.trace) > MOST_RECEPTIONS,
        f"more than {MOST_BYTES:,} bytes": payload_bytes > MOST_BYTES,
        "programs send to single vehicles": bool((recorded.attempt > 0).any()),
        "programs choose power or bit rate": "gain_db" in recorded.trace.column_names,
        "a rule of your own changes frames": any(isinstance(fault, OwnRule) for fault in faults),
        "a fault replaces frames": any(isinstance(fault, StaleMessages) for fault in faults),
        "frames that nobody was in range of are not in the trace": bool(_unseen(recorded))
        and (recorded.shares_air or any(isinstance(fault, SenderFault) for fault in faults)),
    }
    return next((why for why, holds in reasons.items() if holds), "")


def _originals(recorded: RecordedRun) -> NDArray[np.intp]:
    """Return a row of each frame that programs sent, in the order of sending."""
    first = np.unique(recorded.emission[recorded.copy == 0], return_index=True)[1]
    rows = np.flatnonzero(recorded.copy == 0)[first]
    return np.asarray(rows[np.lexsort((recorded.seq[rows], recorded.sender[rows], recorded.sent_ns[rows]))])


def _unseen(recorded: OpenedRun) -> int:
    """Return how many frames are not in the trace, by the numbers of those that are and by the verdict file."""
    rows = _originals(recorded)
    last = np.full(len(recorded.node_ids), -1)
    np.maximum.at(last, recorded.sender[rows], recorded.seq[rows])
    cost = recorded.record.cost if recorded.has_record else None
    return max(int((last + 1).sum()), 0 if cost is None else cost.payload.frames) - len(rows)


def _decided_again(recorded: RecordedRun) -> Engine:
    """Return an engine that has been given the frames of the trace, and all that happened besides."""
    scenario, places = recorded.scenario, recorded.places
    engine = Engine(
        recorded.node_ids,
        scenario.radio,
        scenario.run.seed,
        places.position_m(0),
        recorded.radio_inputs,
        arrivals=scenario.run.order_grid,
    )
    rows = _originals(recorded)
    sent_ns, size_bytes = recorded.sent_ns[rows], recorded.column("size_bytes")[rows].tolist()
    sender, seq, period_ms = (each[rows].tolist() for each in (recorded.sender, recorded.seq, recorded.period_ms))
    changes_ns = _changes_ns(recorded)
    endings = {event.time_ns for event in recorded.event(*kinds_with(ENDS_PROGRAM))}
    up = np.ones(len(recorded.node_ids), dtype=bool)

    def set_up(time_ns: int) -> None:
        now_up = ~recorded.down_at(time_ns)
        for node in np.flatnonzero(up != now_up).tolist():
            engine.set_up(node, bool(now_up[node]))
        up[:] = now_up

    starts = np.flatnonzero(np.diff(sent_ns, prepend=-1))
    frames = dict(zip(sent_ns[starts].tolist(), pairwise([*starts.tolist(), len(sent_ns)]), strict=True))
    placed = 0
    for time_ns in sorted({*changes_ns, *endings, *frames}):
        if time_ns in changes_ns:
            engine.look_ahead(time_ns, ())
            engine.advance(time_ns - 1)
            engine.set_faults([] if recorded.fault_plan is None else recorded.fault_plan.active(time_ns), time_ns)
            if time_ns not in endings:
                set_up(time_ns)
        if time_ns in endings:
            engine.advance(time_ns)
        period = time_ns // scenario.period_ns
        if recorded.moves and period != placed and time_ns in frames:
            engine.set_positions(places.position_m(period))
            placed = period
        for index in range(*frames.get(time_ns, (0, 0))):
            engine.number_next(sender[index], seq[index])
            frame = SentFrame("", bytes(size_bytes[index]), period_ms=period_ms[index] or None)
            engine.transmit(time_ns, sender[index], [frame])
        if time_ns in endings:
            set_up(time_ns)
    engine.look_ahead(recorded.closed_ns, ())
    engine.drain()
    return engine


def _changes_ns(recorded: RecordedRun) -> set[int]:
    """Return the instants at which faults or vehicles come and go."""
    changes = {0} | {edge for span in recorded.down for edge in (span.start_ns, span.end_ns)}
    time_ns: int | None = -1
    while recorded.fault_plan is not None and time_ns is not None:
        time_ns = recorded.fault_plan.next_change_ns(time_ns)
        changes |= set() if time_ns is None else {time_ns}
    return {change_ns for change_ns in changes if 0 <= change_ns < recorded.closed_ns}


def _codes(recorded: RecordedRun, name: str) -> IntArray:
    if name in ("sender", "receiver"):
        return np.asarray(recorded.nodes(name), dtype=np.int64)
    return recorded.column(name)


def _first_difference(recorded: RecordedRun, kept: pa.Table, computed: pa.Table) -> list[dict[str, Any]]:
    """Return the first rows in which two traces in canonical order differ."""
    shared = min(len(kept), len(computed))
    ours, theirs = kept.slice(0, shared), computed.slice(0, shared)
    differs = np.zeros(shared, dtype=bool)
    for column in KEY:
        differs |= _differs(ours[column], theirs[column])
    if differs.any() or len(kept) != len(computed):  # all that follows has moved up or down
        row = int(np.flatnonzero(differs)[0]) if differs.any() else shared
        return [_shown(table, row, whose) for whose, table in (("kept", kept), ("computed", computed))]
    for column in (name for name in kept.column_names if name not in UNCOMPARED):
        if column in theirs.column_names:
            differs |= _differs(ours[column], theirs[column])
    unsure = recorded.is_unsure(np.asarray(ours["sent_ns"].to_numpy()))
    unsure |= recorded.is_unsure(np.asarray(pc.fill_null(ours["arrival_ns"], -1).to_numpy()))
    rows = np.flatnonzero(differs & ~unsure)[:MOST_ROWS].tolist()
    tables = (("kept", kept), ("computed", computed))
    return [_shown(table, row, whose) for row in rows for whose, table in tables]


def _differs(ours: pa.ChunkedArray, theirs: pa.ChunkedArray) -> Mask:
    if pa.types.is_floating(ours.type):
        mine, other = (np.asarray(each.to_numpy(), dtype=float) for each in (ours, theirs))
        return np.asarray(~np.isclose(mine, other, rtol=0, atol=POWER_STEP_DB, equal_nan=True))
    if pa.types.is_dictionary(ours.type) or pa.types.is_string(ours.type):
        ours, theirs = (pc.fill_null(each.cast(pa.string()), "") for each in (ours, theirs))
    else:
        ours, theirs = (pc.fill_null(each.cast(pa.int64()), -1) for each in (ours, theirs))
    return np.asarray(pc.not_equal(ours, theirs).to_numpy())


def _shown(table: pa.Table, row: int, whose: str) -> dict[str, Any]:
    values: Mapping[str, Any] = table.slice(row, 1).to_pylist()[0] if row < len(table) else {}
    return {"trace": whose, **{name: value for name, value in values.items() if name != "payload_digest"}}


def checked_world(recorded: OpenedRun) -> Finding:
    """Return `check_truth`, or that a scenario whose world cannot be built is none of a run."""
    try:
        return check_truth(recorded)
    except ScenarioError as error:
        return CheckResult("truth", Verdict.INVALID, f"the scenario has no world: {error}")


@dataclass(frozen=True)
class FolderCheck:
    """One check of a folder, and its row of the reference page; fields as those of `judge.Check`."""

    name: str
    function: Callable[[OpenedRun], Finding]
    claims: str
    invalid: str
    not_applicable: str = ""


_MORE_OPTIONS = re.compile(
    r""" --program MODULE:FUNCTION| --check-determinism(=portable)?| --agent ('[^']*'("'"'[^']*')*|[^\s']+)"""
)
"""Options of a command that no other file shows; quoted as by `shlex`."""
ROUNDED_S = 0.001
"""Digits that verdict.json keeps of the run's wall-clock time."""


def kept(unkept: Sequence[str]) -> list[Finding]:
    """Return, at the end of a run, the finding that the disk has refused files; none if it has kept all."""
    return [named(FILES, unknown(f"not kept: {'; '.join(unkept)}", unkept=list(unkept)))] if unkept else []


def check_files(recorded: OpenedRun) -> Finding:
    """Check that each file is the one whose digest the manifest has."""
    digests = read_manifest(recorded.folder)
    if digests is None:
        if recorded.record.format < FIRST_WITH_MANIFEST:
            return not_exercised(f"a folder of format {recorded.record.format} has no manifest")
        return invalid(f"there is no {MANIFEST_FILE}")
    differing = differing_files(recorded.folder, digests)
    for check in recorded.record.checks if not differing else ():
        if check.name == FILES and check.figures.get("unkept"):
            return unknown(check.text, **check.figures)  # whatever verdict the file gives itself
    first = next((f"{name} {what}" for name, what in differing.items()), "")
    rows = [{"file": name, "what": what} for name, what in differing.items()]
    text = f"{counted(len(digests), 'file')} as they were written"
    return result(len(rows), text, f"{counted(len(rows), 'file')} other than written: {first}", rows)


def verdict_figures(recorded: RecordedRun, rows: Sequence[Any]) -> dict[str, Any]:
    """Return the figures of verdict.json that follow from the other files; `rows` are those of the metrics."""
    scenario = recorded.scenario
    count = len(recorded.node_ids) or len(recorded.world.node_ids if recorded.world is not None else ())
    return {
        "emulated_s": min(len(rows) * scenario.period_ns, scenario.duration_ns) / 1e9,
        "seed": scenario.run.seed,
        "vehicles": count - len(scenario.roadside),
        "roadside_units": len(scenario.roadside),
        "packet_delivery_ratio": delivery_ratio(recorded),
        "figures": summarize(rows),
        "driving": driving_figures(recorded.table(DRIVEN), recorded.events),
        "backbone": backbone_figures(recorded.table(BACKBONE)),
        "reported": {name: asdict(figure) for name, figure in reported_figures(recorded.states).items()},
    }


def check_payloads(recorded: OpenedRun) -> Finding:
    """Check that the payload of each frame is the one whose digest the trace has."""
    if not recorded.scenario.run.keep_payloads:
        return not_exercised("run.keep_payloads is false")
    if any(isinstance(planned.fault, (SenderFault, Corrupt, OwnRule)) for planned in recorded.plan):
        return not_exercised("faults change what is sent or received")
    kept, first = recorded.payloads, _sent_frames(recorded)
    digests, node_ids = recorded.digest, recorded.node_ids
    frames = [(node_ids[recorded.sender[row]], int(recorded.seq[row]), int(digests[row])) for row in first.tolist()]
    wrong = [
        {"sender": sender, "seq": seq}
        for sender, seq, digest in frames
        if kept is None or kept.of(sender, seq, (digest,)) is None
    ]
    text = f"payloads of {counted(len(frames), 'frame')} as they were sent"
    return result(len(wrong), text, f"{counted(len(wrong), 'frame')} with another payload", wrong[:MOST_ROWS])


def check_verdict_file(recorded: OpenedRun, judgement: Judgement) -> Finding:
    """Check that verdict.json has the figures that the other files give, and the verdict that its checks give."""
    record = recorded.record
    if record.format == 1:
        return not_exercised("figures of a folder of format 1 meant something else")
    kept_figures = _plain(record)
    computed = verdict_figures(recorded, rows_of(recorded.metrics)) | dict(_of_the_course(recorded))
    if record.format < 4:  # which left out some
        computed["figures"] = {name: value for name, value in computed["figures"].items() if name in record.figures}
    if record.format < 3 or (record.format < FIRST_WITH_RATIO and recorded.down):  # whose definition differs
        del computed["packet_delivery_ratio"]
    wrong = [
        {"figure": path, "kept": ours, "computed": theirs}
        for each, value in computed.items()
        for path, ours, theirs in differences(kept_figures[each], _plain(value), each)
    ]
    if record.format >= 3:
        wrong += _wrong_commands(recorded)
    wrong += _wrong_counts(recorded)
    wrong += _wrong_checks(recorded, judgement)
    if record.verdict is not (summed := record.judgement.verdict):
        wrong.append({"figure": "verdict", "kept": record.verdict.value, "computed": summed.value})
    text = f"{VERDICT_FILE} has what the other files give"
    first = f", first {wrong[0]['figure']}" if wrong else ""
    return result(len(wrong), text, f"{counted(len(wrong), 'figure')} other than the files give{first}", wrong)


def _of_the_course(recorded: OpenedRun) -> Iterator[tuple[str, Any]]:
    """Yield what events and figures say of the run's wall clock."""
    wall_s = [event.details.get("wall_s") for event in recorded.event(EventKind.ended)]
    start_up_s = [event.details.get("start_up_s") for event in recorded.event(EventKind.started)]
    yield "wall_s", wall_s[-1] if wall_s else None
    yield "start_up_s", start_up_s[0] if start_up_s else None
    seconds, told = recorded.record.wall_s, recorded.record.real_time_factor
    if seconds > 0:
        factor = recorded.record.emulated_s / seconds
        rounding = ROUNDED_S * factor / seconds + ROUNDED_S
        yield "real_time_factor", told if told is not None and abs(told - factor) <= rounding else round(factor, 3)


def _wrong_commands(recorded: OpenedRun) -> Iterator[dict[str, Any]]:
    """Yield what verdict.json says of the scenario's order of events, and the command that runs it again."""
    run, order = recorded.scenario.run, recorded.record.order
    told = (order or {}).get("kind", "fifo"), (order or {}).get("seed", run.order_seed)
    due = "tape" if run.tape is not None else run.order, run.order_seed
    if told != due:
        yield {"figure": "order", "kept": told, "computed": due}
    scenario, kept = shlex.quote(str(recorded.folder.absolute() / SCENARIO_FILE)), recorded.record.reproduce
    commands = [f"vnet {command} {scenario}" for command in ("simulate", "run")]
    if _MORE_OPTIONS.sub("", kept) not in commands:
        yield {"figure": "reproduce", "kept": kept, "computed": commands[0]}


def _wrong_counts(recorded: OpenedRun) -> list[dict[str, Any]]:
    """Return the numbers of frames and receptions that are not those of the trace."""
    wrong: dict[str, tuple[Any, Any]] = {}
    outcomes, counts = np.unique(recorded.trace["outcome"].to_numpy(), return_counts=True)
    rows = dict(zip(outcomes.tolist(), counts.tolist(), strict=True))
    record = recorded.record
    for outcome in {*rows, *record.frames_by_outcome} - {"out_of_range"}:
        if (count := record.frames_by_outcome.get(outcome, 0)) != rows.get(outcome, 0):
            wrong[f"frames_by_outcome.{outcome}"] = count, rows.get(outcome, 0)
    if record.cost is not None:
        wrong |= _wrong_payloads(recorded, record.cost)
        unseen = record.cost.payload.frames - len(_sent_frames(recorded))  # nobody was in range of them
        count, due = record.frames_by_outcome.get("out_of_range", 0), _out_of_range(recorded, unseen)
        copied = unseen > 0 and any(isinstance(planned.fault, SenderFault) for planned in recorded.plan)
        if count < due if copied else count != due:
            wrong["frames_by_outcome.out_of_range"] = count, due
    return [{"figure": what, "kept": ours, "computed": theirs} for what, (ours, theirs) in wrong.items()]


def _wrong_payloads(recorded: OpenedRun, cost: RunCost) -> dict[str, tuple[Any, Any]]:
    """Return the numbers and sizes of frames that are not those of the trace; it has not those out of all range."""
    first = _sent_frames(recorded)
    sizes = recorded.column("size_bytes")[first]
    due = run_cost(Costs(), recorded.node_ids, recorded.sender[first], sizes, len(recorded.node_ids))
    of_node = {vehicle.node: vehicle.payload for vehicle in due.vehicles}
    always = recorded.places.always_in_range & recorded.places.is_whole
    seen = dict(zip(recorded.node_ids, always.tolist(), strict=True))
    told = [("cost.payload", cost.payload, due.payload, all(seen.values()))]
    for vehicle in cost.vehicles:
        payload = of_node.get(vehicle.node, PayloadSizes(-1))
        told.append((f"cost of {vehicle.node}", vehicle.payload, payload, seen.get(vehicle.node, True)))
    return {
        what: (asdict(ours), asdict(theirs))
        for what, ours, theirs, exact in told
        if (ours != theirs if exact else ours.frames < theirs.frames)
    }


def _sent_frames(recorded: RecordedRun) -> NDArray[np.intp]:
    """Return the first row of each transmission of a frame by its program."""
    number = recorded.emission * (int(recorded.attempt.max(initial=0)) + 1) + recorded.attempt
    first = np.unique(number, return_index=True)[1]
    return np.asarray(first[recorded.copy[first] == 0], dtype=np.intp)


def _out_of_range(recorded: RecordedRun, unseen: int) -> int:
    """Return how many receptions were out of range; so are all of the frames that the trace has not."""
    broadcast = ~received_twice(recorded) & (recorded.attempt == 0)
    frames = len(np.unique(recorded.emission[broadcast])) + unseen
    single = int(((recorded.attempt > 0) & recorded.outcome_is("out_of_range")).sum())
    return frames * (len(recorded.node_ids) - 1) - int(broadcast.sum()) + single


def _wrong_checks(recorded: OpenedRun, judgement: Judgement) -> list[dict[str, Any]]:
    """Return the checks of verdict.json that are not those that the files give; own ones stand as recorded."""
    record, program = recorded.record, recorded.scenario.program
    wrong = []
    ours = _by_name(record.judgement)
    theirs = _by_name(judgement)
    of_tests = [event.details.get("checks") for event in recorded.event(EventKind.judged_by_test)]
    asked = {name for names in of_tests if isinstance(names, list) for name in names if isinstance(name, str)}
    silent = not program.checks and are_here(program) and not declared_checks(program)
    for name in ours:
        if name.startswith(PREFIX) and silent and name not in asked:
            wrong.append({"figure": name, "kept": "a check of your own", "computed": "the scenario has none"})
    code = parse_toml(recorded.scenario_text).get("code")
    if not isinstance(code, dict) or code.get("vnet") != vnet_digest():  # another vnet may have judged otherwise
        return wrong
    for name, check in ours.items():
        if name.startswith(PREFIX):
            continue
        if name not in theirs:
            wrong.append({"figure": name, "kept": "a check", "computed": "no such check"})
        elif differing := next(differences(_plain(check), _plain(theirs[name]), name), None):
            wrong.append(dict(zip(("figure", "kept", "computed"), differing, strict=True)))
    missing = [name for name in theirs if name not in ours and not name.startswith(PREFIX)]
    return [*wrong, *({"figure": name, "kept": None, "computed": "a check"} for name in missing)]


def _by_name(judgement: Judgement) -> dict[str, Finding]:
    """Return the findings on a run by name, without those that compare files."""
    findings: list[Finding] = [*judgement.checks, *judgement.not_exercised]
    return {finding.name: finding for finding in findings if finding.name not in NOT_OF_THE_RUN}


def differences(ours: Any, theirs: Any, path: str) -> Iterator[tuple[str, Any, Any]]:
    """Yield path and both values wherever two values as JSON has them differ by more than rounding."""
    if isinstance(ours, Mapping) and isinstance(theirs, Mapping):
        for name in {**ours, **theirs}:
            yield from differences(ours.get(name), theirs.get(name), f"{path}.{name}")
    elif isinstance(ours, list) and isinstance(theirs, list) and len(ours) == len(theirs):
        for index, (mine, other) in enumerate(zip(ours, theirs, strict=True)):
            yield from differences(mine, other, f"{path}.{index}")
    elif isinstance(ours, float) or isinstance(theirs, float):
        numbers = isinstance(ours, (int, float)) and isinstance(theirs, (int, float))
        if not numbers or not math.isclose(ours, theirs, rel_tol=1e-9, abs_tol=1e-9):
            yield path, ours, theirs
    elif ours != theirs:
        yield path, ours, theirs


def _plain(value: Any) -> Any:
    """Return a value as JSON holds it."""
    if is_dataclass(value) and not isinstance(value, type):
        value = {name: getattr(value, name) for name in value.__dataclass_fields__}
    if isinstance(value, Mapping):
        return {str(name): _plain(each) for name, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(each) for each in value]
    if isinstance(value, np.ndarray):
        return value.tolist()
    return value.item() if isinstance(value, np.generic) else value


FOLDER_CHECKS = (
    FolderCheck(
        FILES,
        check_files,
        f"Each file is the one whose SHA-256 `{MANIFEST_FILE}` has. A run itself is unknown "
        "if the disk refused one.",
        "a file has other contents, is missing, or is not in the manifest",
        "a folder of format 1 or 2, which has no manifest",
    ),
    FolderCheck(
        "truth",
        checked_world,
        "Positions, headings, common errors, fixes (with the faults of receivers) and `world.npz` are those that "
        "the scenario and its seed give, to 1e-6 m.",
        "another position, heading, common error or fix",
        "the world comes from files, from a function of yours, or from programs that drive",
    ),
    FolderCheck(
        "payloads",
        check_payloads,
        f"`{PAYLOADS.file}` has the payload of each frame of the trace, by its digest.",
        "another payload, or none",
        "a run without `run.keep_payloads`, or with faults that change what is sent or received",
    ),
    FolderCheck(
        "metrics",
        check_metrics,
        "The metrics of each period are those of the states, and `metrics_sha256` is their hash.",
        "another figure",
        "no period was completed",
    ),
    FolderCheck(
        "outcomes",
        check_outcomes,
        "The radio is given the frames of the trace once more: each has the same receivers, outcomes, causes and "
        "arrivals, each fault the same copies, and each vehicle the same channel busy ratios.",
        "another reception",
        "real time, an order of events other than FIFO, a run that was cut short, frames to single vehicles, "
        "powers or bit rates of programs, rules of your own, `StaleMessages`, and, with a MAC or copies, frames "
        "that nobody was in range of; besides frames that may have waited for such a one, or drew in a "
        "`burst_loss` after it",
    ),
)
"""Checks of a folder by themselves; `verdict_file` comes last, as it compares what all others have found."""
VERDICT_FILE_CHECK = FolderCheck(
    "verdict_file",
    lambda recorded: not_exercised("judged with all others"),
    f"`{VERDICT_FILE}` has the figures, the numbers of frames and vehicles, and the checks that the other files "
    "give.",
    "another figure, or a check that the files do not give",
    "a folder of format 1",
)


def judge_folder(recorded: OpenedRun, judgement: Judgement) -> None:
    """Add the findings of the checks of a folder to those of its run."""
    findings: list[Finding] = [named(FILES, check_files(recorded))]
    if len(recorded.states):
        findings += [named(check.name, check.function(recorded)) for check in FOLDER_CHECKS[1:]]
        findings.append(named(VERDICT_FILE_CHECK.name, check_verdict_file(recorded, judgement)))
    else:
        findings += [NotExercised(check.name, NO_PERIOD) for check in (*FOLDER_CHECKS[1:], VERDICT_FILE_CHECK)]
    for finding in findings:
        judgement.put(_of_earlier_format(finding) if recorded.record.format < FIRST_WITH_MANIFEST else finding)


def _of_earlier_format(finding: Finding) -> Finding:
    """Return a finding on a folder of an earlier vnet, which did not make this check: it makes no run invalid."""
    if isinstance(finding, NotExercised) or finding.verdict is not Verdict.INVALID:
        return finding
    return CheckResult(
        finding.name, Verdict.UNKNOWN, f"{finding.text}; the folder is of an earlier format", finding.figures
    )
