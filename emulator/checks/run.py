"""Checks of the run itself: processes lived and reported, the machine kept up, and rows and reports are sound."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from emulator.records.distributions import lowest_share
from emulator.records.events import KINDS, Event, EventKind, in_words, kinds_of
from emulator.records.recorded_run import END_OF_TIME_NS, RecordedRun
from emulator.records.reported import is_text, numbers_of
from emulator.records.tables import STATES, VALUES_AS_LIST
from emulator.records.verdicts import (
    MOST_ROWS,
    NO_FAULTS,
    CheckResult,
    Finding,
    Verdict,
    invalid,
    not_exercised,
    result,
    unknown,
    valid,
)
from emulator.scenario.faults import GnssOutage, ProcessFault
from vnet.errors import counted, first_names, printable
from vnet.reports import COVARIANCE_TOLERANCE, LONGEST_TEXT, check_name
from vnet.types import Array, IntArray, Mask
from vnet.units import NS_PER_S

LATE_SHARE_LIMIT = 0.001
"""Largest share of deliveries that may be late in real time."""
LIVENESS_NS = NS_PER_S
KB_PER_KIB = 1.024
START_UP_NS = 5 * NS_PER_S
"""Time that a restarted process may take, in real time, until its program reports."""


def check_transport(recorded: RecordedRun) -> Finding:
    """Check that no message between agents and emulator went missing."""
    gaps = sum(int(event.details.get("count", 1)) for event in recorded.event(EventKind.transport_gap))
    lost = recorded.outcome_is("transport")
    if gaps or lost.any():
        count = int(lost.sum())
        missing = counted(count, "delivery", "deliveries")
        text = (
            f"{counted(gaps, 'gap')} in sequence numbers, {missing} that never arrived: the machine, not the radio"
        )
        return unknown(text, gaps=gaps, lost=count)
    if unheard := _without_a_program(recorded):
        names, count = sorted({row["node"] for row in unheard}), sum(row["count"] for row in unheard)
        text = f"{counted(count, 'delivery', 'deliveries')} to {first_names(names)} while no program was connected"
        return unknown(text, rows=unheard)
    return valid("no message between agents and emulator went missing", gaps=0)


def _without_a_program(recorded: RecordedRun) -> list[dict[str, Any]]:
    """Return the times at which a vehicle whose programs others have started had none, and what arrived in them."""
    since_ns: dict[str, int] = {}
    times = []
    ends = EventKind.session_back, EventKind.restarted, EventKind.entered, EventKind.ended
    for event in recorded.event(EventKind.session_gone, *ends):
        if event.kind == EventKind.session_gone:
            since_ns[event.node or ""] = event.time_ns
        else:
            back = [event.node] if event.node else list(since_ns)
            times += [(node, since_ns.pop(node), event.time_ns) for node in back if node in since_ns]
    if not times:
        return []
    delivered = recorded.trace.filter(recorded.outcome_is("delivered"))
    receiver, arrival_ns = delivered["receiver"].cast(pa.string()), delivered["arrival_ns"]
    rows = []
    for node, from_ns, to_ns in times:
        within = pc.and_(pc.greater_equal(arrival_ns, from_ns), pc.less(arrival_ns, to_ns))
        count = pc.sum(pc.and_(pc.equal(receiver, node), within)).as_py() or 0
        rows += [{"node": node, "from_ns": from_ns, "to_ns": to_ns, "count": count}] if count else []
    return rows


def check_agents_alive(recorded: RecordedRun) -> Finding:
    """Check that no process died and no program crashed, except those that a fault ended."""
    gone = [
        event for event in recorded.event(EventKind.died, EventKind.crashed) if not _was_killed(recorded, event)
    ]
    if not gone and not recorded.event(EventKind.started):
        return unknown("no event says that the run started")
    away = {} if gone else _not_up(recorded)
    if late := {node: since_ns for node, since_ns in away.items() if since_ns + START_UP_NS < recorded.closed_ns}:
        names = [recorded.node_ids[node] for node in late]
        rows = [{"node": node, "since_ns": since_ns} for node, since_ns in zip(names, late.values(), strict=True)]
        since = f"{min(late.values()) / NS_PER_S:g} s, when a fault ended or it entered"
        return unknown(f"{first_names(names)}: not up since {since}", rows=rows)
    if away:
        names = [recorded.node_ids[node] for node in away]
        there = len(recorded.node_ids) - len(names)
        return valid(
            f"{there} of {counted(len(recorded.node_ids), 'node')} to the end; {first_names(names)} not yet up"
        )
    if not gone:
        who = f"all {counted(len(recorded.node_ids), 'node')}" if recorded.node_ids else "all nodes"
        return valid(f"{who} to the end")
    listed = [{"node": e.node, "time_ns": e.time_ns, "kind": e.kind, **e.details} for e in gone]
    return invalid(in_words(kinds_of(gone)), gone=listed)


def _not_up(recorded: RecordedRun) -> dict[int, int]:
    """Return the nodes that should be up at the end and are down all the same, and since when they should be up.

    That is of real time, where a program of another kind than vnet's own may wait before it connects.
    """
    if recorded.scenario.run.pacing != "realtime":
        return {}
    due_ns: dict[int, int] = {}
    for planned in recorded.plan:
        if isinstance(planned.fault, ProcessFault) and planned.fault.ends:
            for node in np.flatnonzero(planned.nodes).tolist():
                due_ns[node] = max(due_ns.get(node, 0), planned.end_ns)
    if recorded.moves:
        here = recorded.places.present()
        for node in np.flatnonzero(here[-1] & ~here.all(axis=0)).tolist():
            entered_ns = (int(np.flatnonzero(~here[:, node])[-1]) + 1) * recorded.scenario.period_ns
            due_ns[node] = max(due_ns.get(node, 0), entered_ns)
        due_ns = {node: time_ns for node, time_ns in due_ns.items() if here[-1, node]}
    due = [
        node for node, time_ns in due_ns.items() if time_ns < recorded.closed_ns and node not in recorded.deaths_ns
    ]
    down = recorded.is_down(np.array(due, dtype=np.intp), np.full(len(due), recorded.closed_ns - 1))
    return {node: due_ns[node] for node, is_down in sorted(zip(due, down.tolist(), strict=True)) if is_down}


def check_no_exceptions(recorded: RecordedRun) -> Finding:
    """Check that programs handled every exception that was raised in their tasks, callbacks, jobs and threads."""
    raised = recorded.event(EventKind.exception)
    if not raised and not recorded.event(EventKind.started):
        return unknown("no event says that the run started")
    if not raised:
        return valid("no exception was left unhandled")
    kinds = kinds_of(raised)
    left_out = sum(
        int(e.details["count"])
        for e in recorded.event(EventKind.left_out)
        if e.details.get("what") == EventKind.exception
    )
    rows = [
        {
            "what": kind.first.why,
            "vehicles": len(kind.nodes),
            "node": kind.first.node,
            "time_ns": kind.first.time_ns,
            "count": len(kind.events),
        }
        for kind in kinds
    ]
    first = {"node": kinds[0].first.node, "where": kinds[0].first.details.get("where", "")}
    return result(len(raised), "", in_words(kinds), rows, count=len(raised) + left_out, **first)


def _was_killed(recorded: RecordedRun, event: Event) -> bool:
    """Return whether a fault ended the process that died."""
    if event.kind != EventKind.died or event.node not in recorded.number:
        return False
    node = recorded.number_of(event.node)
    ended = [p for p in recorded.plan if isinstance(p.fault, ProcessFault) and p.fault.ends and p.nodes[node]]
    return any(p.start_ns <= event.time_ns <= p.end_ns + recorded.guard_ns for p in ended)


def check_progress(recorded: RecordedRun) -> Finding:
    """Check that the run reached its end: no busy loop, no hang, no interruption."""
    if spun := recorded.event(EventKind.spun):
        event = spun[0]
        when = f"at {event.time_ns / 1e9:.3f} s"
        text = f"{event.node} does not let time advance (busy loop) {when}: {event.details.get('error')}"
        return invalid(text, **{"node": event.node, **event.details})
    if stalled := recorded.event(EventKind.stalled):
        event = stalled[0]
        when, error, refused = (
            f"{event.time_ns / 1e9:.3f} s",
            event.details.get("error"),
            event.details.get("refused"),
        )
        text = f"{event.node} hangs at {when}: {error}"
        if refused is not None:
            text = f"the last message of {event.node} at {when} was refused: {refused}; since then {error}"
        return unknown(text, **{"node": event.node, **event.details})
    if exceeded := recorded.event(EventKind.memory_exceeded):
        return unknown(memory_exceeded(exceeded[0]), node=exceeded[0].node)
    if gone := recorded.event(EventKind.router_ended):
        return unknown(f"the separate router ended at {gone[0].time_ns / 1e9:.3f} s: {gone[0].details['how']}")
    if interrupted := recorded.event(EventKind.interrupted):
        return unknown(f"interrupted at {interrupted[0].time_ns / 1e9:.3f} s")
    if not recorded.event(EventKind.ended):
        return unknown("no event says that the run ended")
    due = recorded.scenario.duration_ns // recorded.scenario.period_ns
    if len(recorded.metrics) != due or len(recorded.states) != due * len(recorded.node_ids):
        text = f"{counted(len(recorded.metrics), 'period')} kept, {due} due"
        return unknown(text, periods=len(recorded.metrics), due=due)
    rest_ns = recorded.scenario.duration_ns - due * recorded.scenario.period_ns
    rest = f", of which the last {rest_ns / NS_PER_S:g} s are no whole period, so that reports in them are not kept"
    is_rounding = rest_ns <= due  # of periods as of 30 Hz
    return valid(f"{recorded.scenario.run.duration_s:g} s emulated to the end{'' if is_rounding else rest}")


def check_finite(recorded: RecordedRun) -> Finding:
    """Check that no report holds NaN or infinity."""
    if not len(recorded.metrics):
        return not_exercised("no period was completed")
    reporting = int(np.sum(recorded.metrics["reporting"].to_numpy()))
    if reporting == 0:
        return not_exercised("the program reports nothing")
    not_finite = np.maximum(recorded.metrics["not_finite"].to_numpy(), _not_finite_rows(recorded))
    broken = int(np.sum(not_finite))
    text = f"{counted(reporting, 'report')}, all numbers finite"
    rows = [{"period": int(p), "not_finite": int(not_finite[p])} for p in np.flatnonzero(not_finite)]
    values = "; ".join(_not_finite_values(recorded)) if broken else ""
    broken_text = f"{counted(broken, 'report')} with NaN or infinity" + (f": {values}" if values else "")
    return result(broken, text, broken_text, rows, reports=reporting, not_finite=broken)


def _not_finite_rows(recorded: RecordedRun) -> IntArray:
    """Number of rows of the states in each period of the metrics that hold NaN or infinity."""
    broken = np.zeros(len(recorded.states), dtype=bool)
    for name in recorded.reported_names:
        column = recorded.states[name].combine_chunks()
        if is_text(column.type):
            continue
        if not pa.types.is_list(column.type) and not pa.types.is_fixed_size_list(column.type):
            broken |= np.asarray(column.is_valid()) & ~np.isfinite(numbers_of(recorded.states[name]))
            continue
        number = np.asarray(column.flatten().to_numpy(zero_copy_only=False), dtype=float)
        if not np.isfinite(number).all():
            row = np.asarray(pc.list_parent_indices(column).to_numpy())
            broken[row[~np.isfinite(number)]] = True
    period = np.asarray(recorded.states["period"].to_numpy(), dtype=np.intp)[broken]
    counts = np.bincount(period[period >= 0], minlength=len(recorded.metrics))
    return np.asarray(counts[: len(recorded.metrics)], dtype=np.int64)


def _not_finite_values(recorded: RecordedRun) -> list[str]:
    """Return "NAME of NODES" for each figure of the program's own that was reported as NaN or infinity."""
    found = []
    for name in recorded.value_names:
        column = recorded.states[name]
        if not is_text(column.type):
            broken = np.asarray(column.is_valid()) & ~np.isfinite(numbers_of(column))
            nodes = recorded.states["node"].filter(pa.array(broken)).unique().to_pylist()
            found += [f"{name} of {first_names(nodes)}"] if nodes else []
    return found


def check_kept_up(recorded: RecordedRun) -> Finding:
    """Check that in real time the machine delivered on time."""
    if recorded.scenario.run.pacing != "realtime":
        return not_exercised("lockstep: nothing can be late")
    late = recorded.event(EventKind.late_deliveries)
    if not late or not late[-1].details["total"]:
        return unknown("no delivery was timed")
    figures = late[-1].details
    count, total = figures["count"], figures["total"]
    at_least = lowest_share(count, total)
    deliveries = counted(total, "delivery", "deliveries")
    text = f"{count / total:.3%} of {deliveries} over 20 ms late or early (p99 {figures['p99_ms']:.1f} ms)"
    verdict = Verdict.VALID if at_least <= LATE_SHARE_LIMIT else Verdict.UNKNOWN
    return CheckResult("", verdict, text, {**figures, "share_at_least": at_least})


def check_liveness(recorded: RecordedRun) -> Finding:
    """Check that after the last fault every node that is up goes on reporting, about once a second."""
    if not recorded.reported.any():
        return not_exercised("the program reports nothing")
    window = max(2, -(-LIVENESS_NS // recorded.scenario.period_ns))
    longest = _longest_silence(recorded, window)
    if not longest.any():
        return not_exercised("no program reports once a second")
    start_ns = recorded.period_starts_ns()
    rested = np.flatnonzero(start_ns >= recorded.last_heal_ns)
    if len(rested) < window:
        return not_exercised("less than a second is left after the last fault")
    silent: list[dict[str, Any]] = []
    for node in np.flatnonzero(longest).tolist():
        for from_ns, until_ns in _times_up(recorded, node):
            mine = rested[(start_ns[rested] >= from_ns) & (start_ns[rested] < until_ns)]
            reports = mine[recorded.reported[mine, node]]
            if not recorded.plan and (len(reports) or len(mine) < START_UP_NS // recorded.scenario.period_ns):
                mine = mine[mine >= reports.min(initial=recorded.periods)]  # it may take its time at the start
            edges = [int(mine[0]) - 1, *reports.tolist(), int(mine[-1]) + 1] if len(mine) else []
            # One that comes up, and reports a second later, is on time.
            gaps = [(last, next_) for last, next_ in pairwise(edges) if next_ - max(last, mine[0]) > longest[node]]
            if gaps:
                before, after = gaps[0]
                silent.append({"node": recorded.node_ids[node], "last_period": before, "next_period": after})
                break
    count, bound_s = int(np.count_nonzero(longest)), longest * recorded.scenario.period_ns / NS_PER_S
    most_s = bound_s.max()
    text = (
        f"{counted(count, 'node')} reported at least once {f'every {most_s:.1f} s' if most_s > 1 else 'a second'}"
    )
    if recorded.plan:
        text += " after the last fault"
    broken_text = f"{len(silent)} of {counted(count, 'node')} silent {_where(silent, recorded, bound_s)}"
    if silent and not recorded.reported[:, [recorded.number[each["node"]] for each in silent]].any():
        text = f"{broken_text}; nothing was reported before, and a fault left no time to"
        return unknown(text, rows=silent[:MOST_ROWS])
    return result(len(silent), text, broken_text, silent, nodes=count, silent=len(silent))


def _where(silent: list[dict[str, Any]], recorded: RecordedRun, bound_s: Array) -> str:
    if not silent:
        return ""
    least_s = min(bound_s[recorded.number[each["node"]]] for each in silent)
    least = f"{least_s:.1f} s" if least_s > 1 else "a second"
    return f"for over {least}, {silent[0]['node']} from period {silent[0]['last_period'] + 1}"


def _longest_silence(recorded: RecordedRun, window: int) -> IntArray:
    """Periods (N,) that nodes may be silent: `window`, or up to twice that by twice their program's usual time.

    0, for ever, unless a node reports within `window` at some time, or its program does elsewhere and a fault took
    it (`_taken`). The usual time is that which three of four times between reports do not exceed.
    """
    programs = [recorded.scenario.program.of(node).entry for node in recorded.node_ids]
    apart = [np.diff(np.flatnonzero(reported)) for reported in recorded.reported.T]
    able = np.array([bool((each <= window).any()) for each in apart])
    longest: dict[str, int] = {}
    for program in {programs[node] for node in np.flatnonzero(able)}:
        its_own = [each for each, of in zip(apart, programs, strict=True) if of == program]
        usual = np.percentile(np.concatenate(its_own), 75)
        longest[program] = min(max(window, int(2 * usual)), 2 * window)
    of_program = np.array([longest.get(program, 0) for program in programs])
    return np.where(able | _taken(recorded, able, programs, window, of_program), of_program, 0)


def _taken(recorded: RecordedRun, able: Mask, programs: list[str], window: int, longest: IntArray) -> Mask:
    """Return the nodes (N,) that a fault took, or their fixes, after a report or before they had time to begin.

    That is as much as the last of their program that is `able` took before any fault, and `window` periods. One
    whose last report was by then longer ago than its program may be silent reports less often than elsewhere.
    """
    taking = [each for each in recorded.plan if isinstance(each.fault, (ProcessFault, GnssOutage))]
    if not taking:
        return np.zeros(len(able), dtype=bool)
    up_ns = np.array([_times_up(recorded, node)[:1] or [(END_OF_TIME_NS, 0)] for node in range(len(able))])[:, 0, 0]
    struck_ns = np.full(len(able), END_OF_TIME_NS)
    for planned in taking:
        struck = planned.nodes & (up_ns <= planned.end_ns)
        struck_ns[struck] = np.minimum(struck_ns[struck], planned.start_ns)
    first_ns = recorded.reported.argmax(axis=0) * recorded.scenario.period_ns
    time_ns = np.zeros(len(able), dtype=np.int64)
    for program in {programs[node] for node in np.flatnonzero(able)}:
        its_own = np.array([each == program for each in programs])
        begun = its_own & able & (first_ns <= struck_ns)
        if not begun.any():
            begun = its_own & able
        time_ns[its_own] = (first_ns - up_ns)[begun].max() + window * recorded.scenario.period_ns
    start_ns = recorded.period_starts_ns()
    before = recorded.reported & (start_ns[:, None] < struck_ns)
    last_ns = np.where(before, start_ns[:, None], -END_OF_TIME_NS).max(axis=0)
    is_seldom = before.any(axis=0) & (struck_ns - last_ns > longest * recorded.scenario.period_ns)
    reported = recorded.reported.any(axis=0) & ~is_seldom
    taken: Mask = (struck_ns - up_ns < time_ns) | (reported & (struck_ns < END_OF_TIME_NS))
    return taken


def _times_up(recorded: RecordedRun, node: int) -> list[tuple[int, int]]:
    """Spans [from, until) in which a node is up; in real time they begin once its process had time to start."""
    start_up_ns = START_UP_NS if recorded.scenario.run.pacing == "realtime" else 0
    times, from_ns = [], 0
    for span in sorted((span for span in recorded.down if span.node == node), key=lambda span: span.start_ns):
        if span.start_ns > from_ns:
            times.append((from_ns, span.start_ns))
        from_ns = max(from_ns, END_OF_TIME_NS if span.end_ns == END_OF_TIME_NS else span.end_ns + start_up_ns)
    return [*times, (from_ns, END_OF_TIME_NS)] if from_ns < END_OF_TIME_NS else times


def check_presence(recorded: RecordedRun) -> Finding:
    """Check that vehicles enter and leave when their trips do."""
    if not recorded.moves:
        return not_exercised("vehicles stand where they are")
    there = recorded.places.present()
    changes = _changes(recorded, there)
    if not changes and not recorded.event(EventKind.entered, EventKind.left):
        return not_exercised("all vehicles are in the network throughout")
    known_ns = len(there) * recorded.scenario.period_ns  # of what came later no states are kept
    events = [event for event in recorded.event(EventKind.entered, EventKind.left) if event.time_ns < known_ns]
    told = {(event.kind, str(event.node), event.time_ns) for event in events}
    missing = [change for change in changes if not _is_told(recorded, change, told)]
    due = set(changes)
    odd = [one for one in told if one not in due and not _may_come_late(recorded, one, there)]
    rows = [{"what": what, "node": node, "time_ns": t, "event": "missing"} for what, node, t in missing]
    rows += [{"what": what, "node": node, "time_ns": t, "event": "out of place"} for what, node, t in sorted(odd)]
    entered = sum(kind == EventKind.entered for kind, _, _ in changes)
    text = f"vehicles entered ({entered}) and left ({len(changes) - entered}) as their trips do"
    return result(len(rows), text, f"{counted(len(rows), 'event')} against the trips", rows, changes=len(changes))


Change = tuple[str, str, int]
"""The kind of event (entered, left), the vehicle, and the time in ns."""


def _changes(recorded: RecordedRun, there: Mask) -> list[Change]:
    """Vehicles that enter and leave, by the true positions."""
    period, node = np.nonzero(there[1:] != there[:-1])
    kinds = np.where(there[1:][period, node], EventKind.entered, EventKind.left).tolist()
    times_ns = ((period + 1) * recorded.scenario.period_ns).tolist()
    names = [recorded.node_ids[number] for number in node.tolist()]
    return list(zip(kinds, names, times_ns, strict=True))


def _is_told(recorded: RecordedRun, change: Change, told: set[Change]) -> bool:
    """Return whether an event reports a change, or none is needed: the vehicle's entry was not reported either."""
    kind, node, time_ns = change
    if change in told:
        return True
    if kind == EventKind.left:
        before = [one for one in told if one[1] == node and one[2] < time_ns]
        last = max(before, key=lambda one: one[2], default=None)
        absent_at_first = not recorded.places.present()[0][recorded.number[node]]
        return last[0] == EventKind.left if last else absent_at_first
    number = recorded.number[node]
    if recorded.deaths_ns.get(number, END_OF_TIME_NS) <= time_ns or recorded.scenario.run.pacing == "realtime":
        return True
    ended = [p for p in recorded.plan if isinstance(p.fault, ProcessFault) and p.fault.ends and p.nodes[number]]
    return any(planned.acts_at(time_ns) for planned in ended)


def _may_come_late(recorded: RecordedRun, one: Change, there: Mask) -> bool:
    """Return whether a vehicle may enter later than its trip does.

    In real time its process has to start first, and one that a fault has taken waits until it ends.
    """
    kind, node, time_ns = one
    if kind == EventKind.left or not there[time_ns // recorded.scenario.period_ns, recorded.number_of(node)]:
        return False
    return recorded.scenario.run.pacing == "realtime" or any(planned.end_ns == time_ns for planned in recorded.plan)


def check_memory(recorded: RecordedRun) -> Finding:
    """Note the agents' processes whose private memory grows steadily; unknown if one exceeded its limit.

    Judged by the events `memory` {node, time_s, private_kb}, a series each from the start of a process to its end;
    the emulator's own grows with the trace that it keeps, and is not judged.
    """
    if exceeded := recorded.event(EventKind.memory_exceeded):
        return unknown(memory_exceeded(exceeded[0]), node=exceeded[0].node, **exceeded[0].details)
    measured = [
        e for e in recorded.event(EventKind.memory) if e.node in recorded.number and "private_kb" in e.details
    ]
    if not measured:
        return not_exercised("no process of a program was measured")
    judged = [e for e in measured if is_long_enough(e.details["time_s"])]
    if not judged:
        return not_exercised("no process was measured for 30 s")
    rates = {
        e.node: KB_PER_KIB * steady_growth_kib_per_s(e.details["time_s"], e.details["private_kb"]) for e in judged
    }
    growing = {node: rate for node, rate in sorted(rates.items(), key=lambda one: -one[1]) if rate}
    text = f"{counted(len(judged), 'process', 'processes')} of steady memory"
    figures: dict[str, Any] = {"processes": len(judged)}
    if growing:
        node, rate = next(iter(growing.items()))
        of = f"{len(growing)} of {counted(len(judged), 'process', 'processes')}"
        text = f"note: memory of {of} grows: {node} by {rate:.1f} kB a second, {rate * 3.6:,.0f} MB an hour"
        rows = [{"node": node, "kb_per_s": rate, "kb_per_hour": 3600 * rate} for node, rate in growing.items()]
        figures["growing"] = rows[:MOST_ROWS]
    return valid(text, **figures)


def memory_exceeded(event: Event) -> str:
    """Return what an event `memory_exceeded` says, in words."""
    details = event.details
    held = f"process {event.node} ({first_names(details['nodes'])}) holds {details['memory_mb']:g} MB"
    return f"{held} at {event.time_ns / 1e9:.3f} s; run.memory_limit_mb = {details['limit_mb']:g}"


SPAN_S = 27.0
"""Least time in s from the first sample to the last: in a run of 30 s both lie within 1.5 s of its ends."""
TENTHS = 10
"""Parts of the second half of a series."""
RISING_TENTHS = 8
"""Tenths in which steady growth shows; memory that is taken once, or in a few steps, rises in fewer."""
FLOOR_KIB = 512.0
"""Growth over the second half, in KiB, that is the allocator's and the collector's own; less is no growth."""


def is_long_enough(time_s: Sequence[float]) -> bool:
    """Return whether a series with these times can be judged."""
    return len(time_s) > TENTHS and time_s[-1] - time_s[0] >= SPAN_S


def steady_growth_kib_per_s(time_s: Sequence[float], size_kb: Sequence[float]) -> float:
    """Return the rate at which memory grew steadily in the second half of its series, in KiB a second; else 0."""
    if not is_long_enough(time_s):
        return 0.0
    from_s, to_s = (time_s[0] + time_s[-1]) / 2, time_s[-1]
    levels_kb = np.interp(np.linspace(from_s, to_s, TENTHS + 1), time_s, size_kb)
    rises_kb = np.diff(levels_kb)
    grown_kb = float(min(levels_kb[-1] - levels_kb[0], TENTHS * np.median(rises_kb)))  # without a step or two
    is_steady = int((rises_kb > 0).sum()) >= RISING_TENTHS and grown_kb >= FLOOR_KIB
    return grown_kb / (to_s - from_s) if is_steady else 0.0


def check_row_order(recorded: RecordedRun) -> Finding:
    """Check that the rows of trace, states and metrics are in order, and that each event can be of the run."""
    count, period_ns = len(recorded.node_ids), recorded.scenario.period_ns
    states, metrics = recorded.states, recorded.metrics
    place = np.arange(len(states))
    period = place // max(count, 1)
    columns = {
        "period of the states": np.asarray(states["period"].to_numpy()) != period,
        "time_ns of the states": np.asarray(states["time_ns"].to_numpy()) != period * period_ns,
        "node of the states": recorded.place[1] != place - period * count,
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
    # A run that is interrupted may have come to what happens at its last instant, or not.
    told_of = [event for event in told_of if event.time_ns != recorded.closed_ns]
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
            ended = np.array([recorded.deaths_ns.get(node) == time_ns for node in nodes.tolist()], dtype=bool)
            back = before & (~after | ended)  # a program may end at the instant at which it is started again
            found |= {(recorded.node_ids[node], time_ns) for node in nodes[back].tolist()}
    return sorted(found - entered)
