"""Checks of what a run writes: the order of rows, what reports may hold, and the events of faults."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np
import pyarrow.compute as pc

from emulator.records.events import Event, EventKind
from emulator.records.recorded_run import RecordedRun
from emulator.records.reported import is_text
from emulator.records.run_tables import VALUES_AS_LIST
from emulator.records.tables import STATES
from emulator.records.verdicts import MOST_ROWS, NO_FAULTS, Finding, not_exercised, result
from emulator.scenario.faults import ProcessFault
from vnet.counted import counted
from vnet.errors import printable
from vnet.reports import COVARIANCE_TOLERANCE, LONGEST_TEXT, check_name
from vnet.types import Mask

KINDS = {str(kind): kind for kind in EventKind}
KEY = ("sent_ns", "sender", "seq", "receiver", "copy")
"""Columns by which the rows of the trace are sorted."""


def check_row_order(recorded: RecordedRun) -> Finding:
    """Check that the rows of trace, states and metrics are in order, and that each event can be of the run."""
    count, period_ns = len(recorded.node_ids), recorded.scenario.period_ns
    states, metrics = recorded.states, recorded.metrics
    place = np.arange(len(states))
    period = place // max(count, 1)
    columns = {
        "period of the states": np.asarray(states["period"].to_numpy()) != period,
        "time_ns of the states": np.asarray(states["time_ns"].to_numpy()) != period * period_ns,
        "node of the states": _nodes(recorded) != place - period * count,
        "period of the metrics": np.asarray(metrics["period"].to_numpy()) != np.arange(len(metrics)),
        "time_ns of the metrics": np.asarray(metrics["time_ns"].to_numpy()) != np.arange(len(metrics)) * period_ns,
        "trace": _disordered(recorded),
    }
    columns["events"] = np.array([_is_nobodys(event, recorded) for event in recorded.events], dtype=bool)
    kinds = [event.kind for event in recorded.events]
    if EventKind.started in kinds and EventKind.ended in kinds[: kinds.index(EventKind.started)]:
        columns["events"][0] = True
    wrong = {what: np.flatnonzero(mask) for what, mask in columns.items() if mask.any()}
    rows = [{"table": what, "row": int(where[0]), "count": len(where)} for what, where in wrong.items()]
    total = sum(map(len, wrong.values()))
    text = (
        f"{counted(len(recorded.trace), 'row')} of the trace, {counted(len(states), 'row')} of the states in order"
    )
    return result(total, text, f"{counted(total, 'row')} out of order, first in the {next(iter(wrong), '')}", rows)


def _is_nobodys(event: Event, recorded: RecordedRun) -> bool:
    """Return whether an event is of no kind, of no node of the run, or of no time in it."""
    if event.kind not in KINDS or event.time_ns < 0:
        return True
    of_vehicle = (
        KINDS[event.kind].node_is == "vehicle" and event.kind != EventKind.refused
    )  # whoever claims to be one
    if event.node is not None and of_vehicle and event.node not in recorded.number:
        return bool(recorded.number)
    return recorded.scenario.run.pacing == "lockstep" and event.time_ns > recorded.scenario.duration_ns


def _nodes(recorded: RecordedRun) -> Any:
    column = recorded.states["node"].combine_chunks().dictionary_encode()
    code = np.array([recorded.number_of(node) for node in column.dictionary.to_pylist()], dtype=np.intp)
    return code[column.indices.to_numpy()]


def _disordered(recorded: RecordedRun) -> Mask:
    """Mask (rows,) of the rows of the trace that do not come after the one before."""
    later = np.zeros(max(len(recorded.trace) - 1, 0), dtype=bool)
    equal = ~later
    for column in (recorded.sent_ns, recorded.sender, recorded.seq, recorded.receiver, recorded.copy):
        step = np.diff(column)
        later |= equal & (step > 0)
        equal &= step == 0
    return np.concatenate([np.zeros(min(len(recorded.trace), 1), dtype=bool), ~later & ~equal])


def check_reports(recorded: RecordedRun) -> Finding:
    """Check that reports hold what `node.report` allows: names, texts and covariance matrices."""
    if not recorded.reported.any():
        return not_exercised("the program reports nothing")
    wrong: list[dict[str, Any]] = [
        {"what": f"{printable(name)}: not a name of a value"} for name in _names(recorded) if not _allowed(name)
    ]
    wrong += [
        {"what": f"{column}: no covariance matrix", "period": period, "node": recorded.node_ids[node]}
        for column in recorded.reported_names
        if column.endswith("covariance_m2")
        for period, node in np.argwhere(_not_covariances(recorded, column)).tolist()
    ]
    for column in recorded.value_names:
        if is_text(recorded.states[column].type):
            texts = [text for text in recorded.states[column].unique().to_pylist() if text is not None]
            wrong += [
                {"what": f"{column}: text of {len(text)} characters"} for text in texts if len(text) > LONGEST_TEXT
            ]
    reports = int(recorded.reported.sum())
    text = f"{counted(reports, 'report')} hold what node.report allows"
    first = f": {wrong[0]['what']}" if wrong else ""
    return result(len(wrong), text, f"{counted(len(wrong), 'value')} that node.report refuses{first}", wrong)


def _not_covariances(recorded: RecordedRun, column: str) -> Mask:
    """Mask (periods, N) of the matrices that are not symmetric and positive semidefinite, but for rounding."""
    matrix = recorded.matrices(column)
    a, b, c, d = (matrix[..., row, other] for row in (0, 1) for other in (0, 1))
    largest = np.abs(matrix).max(axis=(2, 3), initial=0.0)
    margin = COVARIANCE_TOLERANCE * largest
    with np.errstate(invalid="ignore", over="ignore"):
        wrong = (np.abs(b - c) > margin) | (a < -margin) | (d < -margin) | (a * d - b * c < -margin * largest)
    return np.asarray(wrong)


def _names(recorded: RecordedRun) -> list[str]:
    """Return the names of all values that were reported."""
    lists = recorded.states["values"].combine_chunks().cast(VALUES_AS_LIST)
    keys = pc.unique(pc.struct_field(lists.flatten(), "key")).to_pylist()
    columns = [name for name in recorded.states.column_names if name not in STATES.columns]
    return [*columns, *(str(key) for key in keys)]


def _allowed(name: str) -> bool:
    try:
        check_name(name)
    except ValueError:
        return False
    return True


def check_fault_events(recorded: RecordedRun) -> Finding:
    """Check that events tell the start and the end of each fault, and each restart, at their instants."""
    told_of = recorded.event(EventKind.fault_started, EventKind.fault_ended, EventKind.restarted)
    if not recorded.plan and not told_of:
        return not_exercised(NO_FAULTS)
    in_real_time = recorded.scenario.run.pacing == "realtime"
    due: Counter[tuple[Any, ...]] = Counter()
    for planned in recorded.plan:
        if planned.start_ns >= min(planned.end_ns, recorded.closed_ns):
            continue  # it never acts
        nodes = [recorded.node_ids[node] for node in np.flatnonzero(planned.placed(planned.start_ns).nodes)]
        due[EventKind.fault_started, planned.start_ns, planned.label, tuple(nodes)] += 1
        if planned.end_ns < recorded.closed_ns:
            due[EventKind.fault_ended, planned.end_ns, planned.label, ()] += 1
    for node, time_ns in _restarts(recorded):
        due[EventKind.restarted, time_ns, node, ()] += 1
    told: Counter[tuple[Any, ...]] = Counter()
    for event in told_of:
        what = event.node if event.kind == EventKind.restarted else event.details.get("fault")
        nodes = event.details.get("nodes", []) if event.kind == EventKind.fault_started else []
        told[event.kind, event.time_ns, what, tuple(nodes) if isinstance(nodes, list) else ()] += 1
    if in_real_time:  # processes take their time, and the run acts when it comes to it
        due, told = (_without_times(events) for events in (due, told))
    missing, odd = due - told, told - due
    rows = [
        {"event": kind, "time_ns": time_ns, "of": what, "what": how}
        for how, events in (("missing", missing), ("out of place", odd))
        for kind, time_ns, what, _ in events.elements()
    ]
    text = f"{counted(due.total(), 'event')} of faults as they were planned"
    return result(len(rows), text, f"{counted(len(rows), 'event')} against the plan of faults", rows[:MOST_ROWS])


def _without_times(events: Counter[tuple[Any, ...]]) -> Counter[tuple[Any, ...]]:
    return Counter((kind, 0, what, ()) for kind, _, what, _ in events.elements() if kind != EventKind.restarted)


def _restarts(recorded: RecordedRun) -> list[tuple[str, int]]:
    """Return the nodes that come back because a fault ends, and when; not those that enter the network."""
    entered = {(event.node, event.time_ns) for event in recorded.event(EventKind.entered)}
    ending = [
        planned for planned in recorded.plan if isinstance(planned.fault, ProcessFault) and planned.fault.ends
    ]
    found = set()
    for planned in ending:
        nodes, time_ns = np.flatnonzero(planned.nodes), planned.end_ns
        if planned.start_ns < time_ns < recorded.closed_ns:
            before, after = (recorded.is_down(nodes, np.full(len(nodes), at)) for at in (time_ns - 1, time_ns))
            found |= {(recorded.node_ids[node], time_ns) for node in nodes[before & ~after].tolist()}
    return sorted(found - entered)
