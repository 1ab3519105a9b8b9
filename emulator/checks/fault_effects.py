"""The checks `effect:LABEL`: each fault of the plan acted on something, and the run shows it.

`effect` is a function of the fault's class: it dispatches to the function that is registered for the class or the
nearest of its families.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import singledispatch

import numpy as np

from emulator.checks.channel import changed_bytes
from emulator.checks.latency import bounds
from emulator.checks.senders import is_noise, receiver_noise_m
from emulator.faults.plan import PlannedFault
from emulator.radio.csma import edca_parameters
from emulator.radio.dot11p import SLOT_NS
from emulator.records.events import EventKind
from emulator.records.recorded_run import RecordedRun
from emulator.records.verdicts import CheckResult, Finding, NotExercised, Verdict, unknown
from emulator.scenario.faults import (
    ClockFault,
    Corrupt,
    DelayFault,
    Fault,
    GnssFault,
    GnssFreeze,
    GnssOutage,
    Infrastructure,
    ProcessFault,
    SenderFault,
    Throttle,
)
from vnet.counted import counted
from vnet.types import Mask
from vnet.units import NS_PER_MS

PHASE_NS = 1_000_000
"""Within a period, a program that sends by the clock does so at times no further apart."""
STEADY_FRAMES = 5
"""Frames that show that a program sends by the clock."""


def check_fault_effects(recorded: RecordedRun) -> Iterator[Finding]:
    """Yield a finding for each fault of the plan: it took effect, or nothing shows that it did."""
    for planned in recorded.plan:
        name = f"effect:{planned.label}"
        if planned.start_ns == planned.end_ns:
            yield NotExercised(name, "it was healed before it began")
        elif planned.start_ns >= recorded.closed_ns:
            yield unknown(name, "the run ended before it began")
        elif isinstance(planned.fault, SenderFault) and _held_down(recorded, planned):
            yield NotExercised(name, "other faults kept its vehicles from sending throughout")
        else:
            yield effect(planned.fault, recorded, planned, name)


@singledispatch
def effect(fault: Fault, recorded: RecordedRun, planned: PlannedFault, name: str) -> Finding:
    """Return what shows that a planned fault took effect: unless its class says otherwise, rows that name it."""
    count = int((recorded.cause == planned.number).sum())
    return _found(name, count, "reception names it|receptions name it", "no reception names it")


@effect.register
def _(fault: Corrupt, recorded: RecordedRun, planned: PlannedFault, name: str) -> Finding:
    changed = changed_bytes(recorded) & (recorded.cause == planned.number)
    text = "reception with changed bytes|receptions with changed bytes"
    return _found(name, int(changed.sum()), text, "no reception with changed bytes")


@effect.register
def _(fault: DelayFault, recorded: RecordedRun, planned: PlannedFault, name: str) -> Finding:
    return _later(name, _delayed(recorded, planned))


@effect.register
def _(fault: Throttle, recorded: RecordedRun, planned: PlannedFault, name: str) -> Finding:
    return _later(name, _delayed(recorded, planned) + _overflowed(recorded, planned))


def _later(name: str, count: int) -> CheckResult:
    text = "arrival is later than it could be without it|arrivals are later than they could be without it"
    return _found(name, count, text, "no arrival is later than it could be without it")


@effect.register
def _(fault: ProcessFault, recorded: RecordedRun, planned: PlannedFault, name: str) -> Finding:
    count = _silenced(recorded, planned)
    text = "node neither sent nor received|nodes neither sent nor received"
    return _found(name, count, text, "no node had sent or reported before and then not")


@effect.register
def _(fault: GnssFault, recorded: RecordedRun, planned: PlannedFault, name: str) -> Finding:
    error_m = receiver_noise_m(recorded)[_affected(recorded, planned)]
    error_m = error_m[np.isfinite(error_m).all(axis=1)]
    as_noise = not len(error_m) or is_noise(error_m, recorded.scenario.world.gnss.sigma_m)
    return _wrong_fixes(name, 0 if as_noise else len(error_m))


@effect.register
def _(fault: GnssOutage, recorded: RecordedRun, planned: PlannedFault, name: str) -> Finding:
    fix_m = recorded.vectors("fix_m")[_affected(recorded, planned)]
    return _wrong_fixes(name, int((~np.isfinite(fix_m).all(axis=1)).sum()))


@effect.register
def _(fault: GnssFreeze, recorded: RecordedRun, planned: PlannedFault, name: str) -> Finding:
    fix_m = recorded.vectors("fix_m")
    repeated = (fix_m[1:] == fix_m[:-1]).all(axis=2)
    return _wrong_fixes(name, int(repeated[_affected(recorded, planned)[1:]].sum()))


def _affected(recorded: RecordedRun, planned: PlannedFault) -> Mask:
    """The fixes (periods, N) of vehicles in the network on whose receivers a fault acts."""
    return np.asarray(recorded.struck(planned) & np.isfinite(recorded.vectors("position_m")[..., 0]))


def _wrong_fixes(name: str, count: int) -> CheckResult:
    what = "missing, repeated, or further off than receiver noise"
    text = f"fix is {what}|fixes are {what}"
    return _found(name, count, text, "the fixes could be those of a receiver without faults")


def _held_down(recorded: RecordedRun, planned: PlannedFault) -> bool:
    """Return whether other faults kept each of a fault's nodes down or paused from its start to its end."""
    spans = [(span.node, span.start_ns, span.end_ns) for span in recorded.down if span.planned]
    for pause in recorded.plan:
        if isinstance(pause.fault, ProcessFault) and not pause.fault.ends:
            spans += [(node, pause.start_ns, pause.end_ns) for node in np.flatnonzero(pause.nodes).tolist()]
    for node in np.flatnonzero(planned.nodes).tolist():
        free_ns = planned.start_ns
        for _, start_ns, end_ns in sorted(span for span in spans if span[0] == node):
            if start_ns <= free_ns:
                free_ns = max(free_ns, end_ns)
        if free_ns < planned.end_ns:
            return False
    return bool(planned.nodes.any())


def _found(name: str, count: int, text: str, nothing: str) -> CheckResult:
    """Return a valid result that `count` things were seen: `text` says what, `of one|of several`."""
    if not count:
        return unknown(name, nothing, count=0)
    one, several = text.split("|")
    return CheckResult(name, Verdict.VALID, counted(count, one, several), {"count": count})


def _delayed(recorded: RecordedRun, planned: PlannedFault) -> int:
    return int((recorded.arrived & (recorded.due_ns > bounds(recorded, planned).latest_ns)).sum())


def _overflowed(recorded: RecordedRun, planned: PlannedFault) -> int:
    """Receptions of frames for which a throttled queue was full, or that reached a shared medium late."""
    full = recorded.outcome_is("queue_full")
    if recorded.shares_air:
        full |= _slowed(recorded, planned)
    full &= planned.nodes[recorded.sender]
    return int((full & recorded.acting(planned, recorded.sent_ns)).sum())


def _slowed(recorded: RecordedRun, planned: PlannedFault) -> Mask:
    """Frames that came to a shared medium later than the longest access delay explains.

    Either by the whole time that the throttle takes; or so long after all other frames that without the throttle
    they would have been on air by then, if no congestion control held them back.
    """
    radio, begin_ns = recorded.scenario.radio, recorded.on_air_ns
    assert isinstance(planned.fault, Throttle) and radio.mac is not None
    ready_ns = recorded.sent_ns + radio.access_jitter_ms * NS_PER_MS
    slow = begin_ns >= ready_ns + recorded.column("size_bytes") * 8_000 / planned.fault.bitrate_mbps - 1
    if radio.congestion is None:
        on_air = np.flatnonzero(begin_ns >= 0)
        on_air = on_air[np.argsort(begin_ns[on_air])]
        silent_ns = np.maximum.accumulate(np.append(0, (begin_ns + recorded.airtime_ns)[on_air]))
        free_ns = np.maximum(ready_ns, silent_ns[np.searchsorted(begin_ns[on_air], begin_ns)])
        aifs_ns, window, _ = edca_parameters(radio.mac)
        slow |= begin_ns > free_ns + aifs_ns + (window + 2) * SLOT_NS + recorded.guard_ns
    return np.asarray(slow)


def _silenced(recorded: RecordedRun, planned: PlannedFault) -> int:
    """Count the nodes that sent or reported before but not during the fault, or that missed frames by it."""
    start_ns = recorded.period_starts_ns()
    end_ns = start_ns + recorded.scenario.period_ns
    before, during = end_ns <= planned.start_ns, (start_ns >= planned.start_ns) & (end_ns <= planned.end_ns)
    sends_before = recorded.sent_ns < planned.start_ns
    sends_during = recorded.acting(planned, recorded.sent_ns, -recorded.guard_ns)
    ends = isinstance(planned.fault, ProcessFault) and planned.fault.ends
    count = 0
    for node in np.flatnonzero(planned.nodes).tolist():
        sent = recorded.sender == node
        spoke = bool((sent & sends_before).any() or recorded.reported[before, node].any())
        speaks = bool((sent & sends_during).any() or recorded.reported[during, node].any())
        quiet = spoke and not speaks and int(during.sum()) >= 2
        missed = ends and bool(_missed(recorded, planned)[recorded.receiver == node].any())
        count += quiet or missed
    return count


def _missed(recorded: RecordedRun, planned: PlannedFault) -> Mask:
    return np.asarray(recorded.outcome_is("receiver_down") & recorded.acting(planned, recorded.due_ns))


@effect.register
def _(fault: ClockFault, recorded: RecordedRun, planned: PlannedFault, name: str) -> Finding:
    """Return whether vehicles that always sent at the same time within the period send at another time."""
    phase_ns = recorded.sent_ns % recorded.scenario.period_ns
    originals = recorded.copy == 0
    acting = recorded.acting(planned, recorded.sent_ns, -recorded.guard_ns)
    tolerance_ns = max(PHASE_NS, recorded.guard_ns)
    moved = 0
    for node in np.flatnonzero(planned.nodes & ~_disturbed(recorded)).tolist():
        mine = originals & (recorded.sender == node)
        before, during = phase_ns[mine & (recorded.sent_ns < planned.start_ns)], phase_ns[mine & acting]
        if len(before) >= STEADY_FRAMES and np.ptp(before) <= tolerance_ns:
            moved += bool((np.abs(during - np.median(before)) > 2 * tolerance_ns).any())
    if moved:
        return _found(
            name, moved, "vehicle sends at other times of the period|vehicles send at other times of the period", ""
        )
    return NotExercised(name, "these vehicles do not send by their own clocks, and nothing else would show them")


def _disturbed(recorded: RecordedRun) -> Mask:
    """Vehicles (N,) that are paused or restarted at some time, and send at other times for that reason."""
    disturbed = np.zeros(len(recorded.node_ids), dtype=bool)
    for planned in recorded.plan:
        if isinstance(planned.fault, ProcessFault):
            disturbed |= planned.nodes
    return disturbed


@effect.register
def _(fault: Infrastructure, recorded: RecordedRun, planned: PlannedFault, name: str) -> Finding:
    done = [e for e in recorded.event(f"{fault.kind}ed") if e.time_ns >= planned.start_ns]
    if done:
        return _found(name, len(done), "restart|restarts", "")
    started = recorded.event(EventKind.started)
    if started and not started[0].details.get("start_up_s"):
        return NotExercised(name, "a simulation has neither router nor sessions")
    return unknown(name, "no event says that anything was restarted")
