"""The "sometimes" checks: that each fault of the plan did act on something, and that the run shows it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from emulator.checks.channel import changed_bytes
from emulator.checks.faults import CUTTING, LOSING, SENDING
from emulator.checks.latency import bounds
from emulator.checks.senders import is_noise
from emulator.faults.plan import PlannedFault
from emulator.radio.csma import edca_parameters
from emulator.radio.dot11p import SLOT_NS
from emulator.records.recorded_run import RecordedRun
from emulator.records.verdicts import CheckResult, Finding, NotExercised, Verdict, unknown
from emulator.scenario.faults import ClockFault, GnssFault, Infrastructure, ProcessFault, SenderFault, Throttle
from vnet.types import Mask
from vnet.units import NS_PER_MS

IN_ROWS = (*CUTTING, *LOSING, *SENDING, "duplicate")
DELAYING = ("delay", "jitter", "reorder", "throttle")
PHASE_NS = 1_000_000
STEADY_FRAMES = 5


def check_bits(recorded: RecordedRun) -> Iterator[Finding]:
    """One finding for each fault of the plan: it bit, or nothing shows that it did."""
    for planned in recorded.plan:
        name = f"bit:{planned.label}"
        if planned.start_ns == planned.end_ns:
            yield NotExercised(name, "it was healed before it began")
        elif planned.start_ns >= recorded.closed_ns:
            yield unknown(name, "the run ended before it began")
        elif isinstance(planned.fault, SenderFault) and _held_down(recorded, planned):
            yield NotExercised(name, "other faults kept its vehicles from sending all the while")
        else:
            yield _bit(recorded, planned, name)


def _bit(recorded: RecordedRun, planned: PlannedFault, name: str) -> Finding:
    kind = planned.fault.kind
    if kind == "corrupt":
        changed = changed_bytes(recorded) & (recorded.cause == planned.number)
        return _found(name, int(changed.sum()), "pairs arrive with other bytes", "no pair arrives with other bytes")
    if kind in IN_ROWS:
        return _found(name, int((recorded.cause == planned.number).sum()), "pairs name it", "no pair names it")
    if kind in DELAYING:
        text = "arrivals are later than they could be without it"
        return _found(name, _delayed(recorded, planned), text, "no arrival is later than it could be without it")
    if kind in ("kill", "restart", "pause"):
        text = "nodes fell silent or deaf"
        return _found(name, _silenced(recorded, planned), text, "no node had sent or reported before and then not")
    if isinstance(planned.fault, GnssFault):
        text = "fixes are where no receiver's noise puts them, or not there"
        return _found(name, _bent(recorded, planned), text, "the fixes could be those of a sound receiver")
    if isinstance(planned.fault, ClockFault):
        return _clocks(recorded, planned, name)
    assert isinstance(planned.fault, Infrastructure), planned.fault
    return _restarts(recorded, planned, name)


def _held_down(recorded: RecordedRun, planned: PlannedFault) -> bool:
    """Whether each of a fault's nodes was down or stood still, by other faults, from its start to its end."""
    spans = [(span.node, span.start_ns, span.end_ns) for span in recorded.down if span.planned]
    for pause in recorded.plan:
        if pause.fault.kind == "pause":
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
    if not count:
        return unknown(name, nothing, count=0)
    return CheckResult(name, Verdict.VALID, f"{count:,} {text}", {"count": count})


def _delayed(recorded: RecordedRun, planned: PlannedFault) -> int:
    return int((recorded.arrived & (recorded.arrival_ns > bounds(recorded, planned).latest_ns)).sum()) + (
        _overflowed(recorded, planned) if planned.fault.kind == "throttle" else 0
    )


def _overflowed(recorded: RecordedRun, planned: PlannedFault) -> int:
    """Pairs of frames for which a throttled queue was full, or that came to a shared medium too late."""
    full = recorded.outcome_is("queue_full")
    if recorded.shares_air:
        full |= _slowed(recorded, planned)
    full &= planned.nodes[recorded.sender]
    return int((full & recorded.acting(planned, recorded.sent_ns)).sum())


def _slowed(recorded: RecordedRun, planned: PlannedFault) -> Mask:
    """Which frames came to a shared medium later than the longest access delay explains.

    Either by all that the throttle takes; or so long after everybody else that without it they would have been on
    air by then, if no congestion control held them back.
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
        aifs_ns, window = edca_parameters(radio.mac)
        slow |= begin_ns > free_ns + aifs_ns + (window + 2) * SLOT_NS + recorded.guard_ns
    return np.asarray(slow)


def _silenced(recorded: RecordedRun, planned: PlannedFault) -> int:
    """Nodes that sent or reported before, and not while the fault acted; or at which nobody was there to hear."""
    start_ns = recorded.period_starts_ns()
    end_ns = start_ns + recorded.scenario.period_ns
    before, during = end_ns <= planned.start_ns, (start_ns >= planned.start_ns) & (end_ns <= planned.end_ns)
    sends_before = recorded.sent_ns < planned.start_ns
    sends_during = recorded.acting(planned, recorded.sent_ns, -recorded.guard_ns)
    count = 0
    for node in np.flatnonzero(planned.nodes).tolist():
        sent = recorded.sender == node
        spoke = bool((sent & sends_before).any() or recorded.reported[before, node].any())
        speaks = bool((sent & sends_during).any() or recorded.reported[during, node].any())
        quiet = spoke and not speaks and int(during.sum()) >= 2
        deaf = planned.fault.kind != "pause" and bool(_unheard(recorded, planned)[recorded.receiver == node].any())
        count += quiet or deaf
    return count


def _unheard(recorded: RecordedRun, planned: PlannedFault) -> Mask:
    return np.asarray(recorded.outcome_is("receiver_down") & recorded.acting(planned, recorded.arrival_ns))


def _bent(recorded: RecordedRun, planned: PlannedFault) -> int:
    """Fixes that show the fault: none, the same again, or all in all too far from the truth."""
    struck = recorded.struck(planned) & np.isfinite(recorded.vectors("position_m")[..., 0])
    fix_m = recorded.vectors("fix_m")
    if planned.fault.kind == "gnss_outage":
        return int((~np.isfinite(fix_m[struck]).all(axis=1)).sum())
    if planned.fault.kind == "gnss_freeze":
        again = (fix_m[1:] == fix_m[:-1]).all(axis=2)
        return int(again[struck[1:]].sum())
    error_m = (fix_m - recorded.vectors("position_m") - recorded.vectors("common_error_m"))[struck]
    error_m = error_m[np.isfinite(error_m).all(axis=1)]
    sound = not len(error_m) or is_noise(error_m, recorded.scenario.world.gnss.sigma_m)
    return 0 if sound else len(error_m)


def _clocks(recorded: RecordedRun, planned: PlannedFault, name: str) -> Finding:
    """A clock shows only in when within the period its vehicle sends, if that was always the same before."""
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
        return _found(name, moved, "vehicles send at other times of the period", "")
    return NotExercised(name, "these vehicles do not send by their own clocks, and nothing else would show them")


def _disturbed(recorded: RecordedRun) -> Mask:
    """(N,), vehicles that stand still or start anew at some time, and send at other times for that reason."""
    disturbed = np.zeros(len(recorded.node_ids), dtype=bool)
    for planned in recorded.plan:
        if isinstance(planned.fault, ProcessFault):
            disturbed |= planned.nodes
    return disturbed


def _restarts(recorded: RecordedRun, planned: PlannedFault, name: str) -> Finding:
    done = [e for e in recorded.event(f"{planned.fault.kind}ed") if e.time_ns >= planned.start_ns]
    if done:
        return _found(name, len(done), "restarts", "")
    started = recorded.event("started")
    if started and not started[0].details.get("start_up_s"):
        return NotExercised(name, "a simulation has neither router nor sessions")
    return unknown(name, "no event says that anything was restarted")
