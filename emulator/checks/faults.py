"""Checks of the faults: they did what they say while they acted, nothing else, and at their rates.

The checks `effect:LABEL`: each fault of the plan acted on something, and the run shows it. `effect` is a function
of the fault's class: it dispatches to the function that is registered for the class or the nearest of its families.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from functools import singledispatch
from math import log, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emulator.checks.channel import binomial_band, bounds, frame_digests, received_twice, unseen_frames
from emulator.fault_plan import PlannedFault
from emulator.radio.csma import edca_parameters
from emulator.radio.dot11p import SLOT_NS
from emulator.records.distributions import chi2_cdf, chi2_sf
from emulator.records.events import EventKind
from emulator.records.radio_metrics import sent_by_programs
from emulator.records.recorded_run import END_OF_TIME_NS, NO_FAULT, ON_AIR, UNHEARD_OF, RecordedRun
from emulator.records.verdicts import (
    MOST_ROWS,
    NO_FAULTS,
    CheckResult,
    Finding,
    named,
    not_exercised,
    result,
    unknown,
    valid,
)
from emulator.scenario.faults import (
    BurstLoss,
    ClockFault,
    Corrupt,
    Custom,
    CustomSender,
    DataReplay,
    DelayFault,
    DoS,
    Duplicate,
    Fault,
    GnssFault,
    GnssFreeze,
    GnssOutage,
    Infrastructure,
    LossFault,
    ProcessFault,
    SenderFault,
    StaleMessages,
    Sybil,
    Throttle,
)
from emulator.scenario.radio import Edca
from emulator.world.truth import further_error_m
from vnet.errors import VnetError, counted
from vnet.types import Array, IntArray, Mask
from vnet.units import NS_PER_MS, NS_PER_S

Rows = NDArray[np.intp]

CERTAIN = 1e-6
"""Probability below which a sum of fixes is not that of a receiver without faults."""
RATE_BAND = 1 - 1e-6
RATE_SIGMAS = 4.9
"""As wide as RATE_BAND: a run may have dozens of faults, and each has a check."""


def check_copies(recorded: RecordedRun) -> Finding:
    """Check that floods and Sybils send each frame as often as configured, and replays one of the right age."""
    if not any(isinstance(planned.fault, DoS | Sybil | DataReplay) for planned in recorded.plan):
        return not_exercised("no fault sends frames again" if recorded.plan else NO_FAULTS)
    once = ~received_twice(recorded) & (recorded.attempt < 2)  # what is transmitted again is the MAC's
    first = recorded.first_rows(once & ~_near_a_change(recorded) & ~recorded.may_reach_of(CustomSender))
    originals, copies = first[recorded.copy[first] == 0], first[recorded.copy[first] > 0]
    frame_ns = dict(_of(recorded, originals))
    at_once = np.array([frame_ns.get(f) == t for f, t in _of(recorded, copies)], dtype=bool)
    again, often = np.unique(recorded.frame[copies[at_once]], return_counts=True)
    times_sent = np.zeros(len(originals), dtype=np.int64)
    order = np.argsort(recorded.frame[originals])
    index = np.searchsorted(recorded.frame[originals][order], again)
    times_sent[order[index]] = often
    wrong = originals[times_sent != _due(recorded, originals)]
    # Replayed frames may have been sent near a change.
    odd = _replayed_wrongly(recorded, copies[~at_once], recorded.first_rows(once & (recorded.copy == 0)))
    broken = len(wrong) + len(odd)
    text = f"{counted(len(copies), 'frame')} sent again, as often and as late as configured"
    broken_text = (
        f"{counted(len(wrong), 'frame')} not sent as often as configured, {len(odd)} replayed at another time"
    )
    rows = recorded.rows(np.concatenate([wrong, np.array(odd, dtype=np.intp)])) if broken else []
    return result(broken, text, broken_text, rows, copies=len(copies), miscounted=len(wrong), odd=len(odd))


def _of(recorded: RecordedRun, rows: Rows) -> list[tuple[int, int]]:
    return list(zip(recorded.frame[rows].tolist(), recorded.sent_ns[rows].tolist(), strict=True))


def _near_a_change(recorded: RecordedRun) -> Mask:
    """Rows sent, in real time, too close to a fault's start or end to tell which came first."""
    near = np.zeros(len(recorded.trace), dtype=bool)
    for planned in recorded.plan:
        for edge_ns in (planned.start_ns, planned.end_ns):
            near |= np.abs(recorded.sent_ns - edge_ns) < recorded.guard_ns
    return near


def _due(recorded: RecordedRun, rows: Rows) -> IntArray:
    """Number of times that faults send each of these frames again at once."""
    due = np.zeros(len(rows), dtype=np.int64)
    for planned in recorded.plan:
        acts = planned.nodes[recorded.sender[rows]] & recorded.acting(planned, recorded.sent_ns[rows])
        match planned.fault:
            case DoS(factor=factor):
                due += acts * (factor - 1)
            case Sybil(ghosts=ghosts):
                due += acts * ghosts
    return due


def _replayed_wrongly(recorded: RecordedRun, late: Rows, originals: Rows) -> list[int]:
    """Late copies that are not of the last frame old enough for a replay that acted on the sender.

    Of frames that nobody was in range of the times are not known: there it may be any of those.
    """
    frame_ns = dict(_of(recorded, originals))
    sent_ns = {
        sender: np.sort(recorded.sent_ns[originals[recorded.sender[originals] == sender]])
        for sender in np.unique(recorded.sender[late]).tolist()
    }
    unseen = unseen_frames(recorded)
    wrong = np.ones(len(late), dtype=bool)
    for planned in recorded.plan:
        if not isinstance(planned.fault, DataReplay):
            continue
        old_ns = recorded.sent_ns[late] - round(planned.fault.age_s * NS_PER_S)
        is_hidden = unseen.may_hold(late, old_ns, planned.start_ns)
        is_hidden &= unseen.may_follow(late, old_ns, planned.start_ns)
        acts = planned.nodes[recorded.sender[late]] & recorded.acting(planned, recorded.sent_ns[late])
        for index in np.flatnonzero(acts).tolist():
            row = late[index]
            if (original_ns := frame_ns.get(int(recorded.frame[row]))) is None:
                wrong[index] &= not is_hidden[index]
            else:
                before = sent_ns[int(recorded.sender[row])]
                last = int(np.searchsorted(before, old_ns[index], side="right")) - 1
                due = last >= 0 and before[last] == original_ns >= planned.start_ns - recorded.guard_ns
                wrong[index] &= not due
    rows: list[int] = late[wrong].tolist()
    return rows


def check_gnss(recorded: RecordedRun) -> Finding:
    """Check that fixes differ from the truth, the world's errors and the offsets of faults by receiver noise."""
    sigma_m = recorded.scenario.world.gnss.sigma_m
    error_m = receiver_noise_m(recorded)
    for planned in recorded.plan:
        error_m -= _displaced(recorded, planned)
    usable = np.isfinite(error_m).all(axis=2)
    groups = {"no fault": usable.copy()}
    for planned in recorded.plan:
        if isinstance(planned.fault, GnssFault):
            mine = recorded.struck(planned)
            groups["no fault"] &= ~mine
            if planned.fault.displacement_m(0) is not None:
                groups[planned.label] = mine & usable
            else:
                usable &= ~mine
    groups = {label: group & usable for label, group in groups.items()}
    judged = {label: error_m[group] for label, group in groups.items() if group.any()}
    if not judged:
        return unknown("no fix is free of faults with random effect")
    rows = [_described(label, error) for label, error in judged.items() if not is_noise(error, sigma_m)]
    fixes = sum(map(len, judged.values()))
    text = f"{counted(fixes, 'fix', 'fixes')} with the noise of {sigma_m:g} m"
    broken_text = f"fixes do not have the receiver's noise: {', '.join(row['under'] for row in rows)}"
    return result(len(rows), text, broken_text, rows, fixes=fixes)


def receiver_noise_m(recorded: RecordedRun) -> Array:
    """Return what fixes (periods, N, 2) have beyond the truth and all errors that the world gives them, in metres.

    Without faults it is the receivers' white noise. Multipath, outliers and gradients are drawn again.
    """
    position_m = recorded.vectors("position_m")
    error_m = recorded.vectors("fix_m") - position_m - recorded.vectors("common_error_m")
    world = recorded.world
    middle_m = np.zeros(2) if world is None else world.area_m.mean(axis=0)
    receiver_m = None if world is None else world.receiver_m
    if receiver_m is not None and not (len(receiver_m) >= len(position_m) and receiver_m.size):
        raise VnetError(f"world.npz: receiver_m has the shape {receiver_m.shape} in {len(position_m)} periods")
    further_m = further_error_m(recorded.scenario, position_m, middle_m, receiver_m) if position_m.size else None
    return np.asarray(error_m if further_m is None else error_m - further_m)


def _displaced(recorded: RecordedRun, planned: PlannedFault) -> Array:
    """Offset that a fault adds to the fixes (periods, N, 2)."""
    fault, start_ns = planned.fault, recorded.period_starts_ns()
    moved = np.zeros((len(start_ns), 2))
    if isinstance(fault, GnssFault) and fault.displacement_m(0) is not None:
        moved = np.array([fault.displacement_m(since) for since in (start_ns - planned.start_ns).tolist()])
    return np.asarray(moved.reshape(-1, 1, 2) * recorded.struck(planned)[:, :, None])


def is_noise(error_m: Array, sigma_m: float) -> bool:
    """Return whether errors (n, 2) are independent, zero-mean and of this deviation, judged by their sums."""
    if sigma_m == 0:
        return bool(np.abs(error_m).max() < 1e-6)
    squares, mean = float(np.sum(error_m**2)) / sigma_m**2, error_m.mean(axis=0) / sigma_m
    tails = (chi2_sf(squares, error_m.size), chi2_cdf(squares, error_m.size))
    return bool(min(*tails, chi2_sf(float(len(error_m) * mean @ mean), 2)) > CERTAIN)


def _described(label: str, error_m: Array) -> dict[str, Any]:
    rms_m = float(np.sqrt(np.mean(error_m**2)))
    return {"under": label, "fixes": len(error_m), "rms_m": rms_m, "mean_m": float(np.hypot(*error_m.mean(axis=0)))}


def begun(recorded: RecordedRun, is_meant: Callable[[Fault], bool]) -> list[PlannedFault]:
    """Return the faults that `is_meant` accepts and that had begun when the run ended."""
    return [p for p in recorded.plan if p.start_ns < recorded.closed_ns and is_meant(p.fault)]


def _loses(fault: Fault) -> bool:
    return isinstance(fault, LossFault)


def check_causes(recorded: RecordedRun) -> Finding:
    """Check that a row names a fault exactly where a fitting one acted, on this link and at this time."""
    if not recorded.plan:
        broken = recorded.outcome_is("fault") | (recorded.cause != NO_FAULT)
        if not broken.any():
            return not_exercised(NO_FAULTS)
    else:
        explained = recorded.cause == NO_FAULT
        for planned in recorded.plan:
            mine = recorded.cause == planned.number
            explained |= mine & recorded.may_reach(planned) & can_cause(planned.fault, recorded)
        broken = ~explained | (recorded.outcome_is("fault") & (recorded.cause == NO_FAULT))
        broken |= recorded.cause == UNHEARD_OF
    count, named = int(broken.sum()), int((recorded.cause != NO_FAULT).sum())
    text = f"{counted(named, 'reception')} with the fault that acted on them"
    broken_text = f"{counted(count, 'reception')} without a fault that acted on them"
    return result(count, text, broken_text, recorded.rows(broken), named=named, wrong=count)


@singledispatch
def can_cause(fault: Fault, recorded: RecordedRun) -> Mask:
    """Return the rows that may name a fault of this kind as their cause: none, or those lost where it loses."""
    return recorded.outcome_is("fault") if fault.cuts else np.zeros(len(recorded.trace), dtype=bool)


@can_cause.register
def _(fault: LossFault, recorded: RecordedRun) -> Mask:
    return recorded.outcome_is("fault")


@can_cause.register
def _(fault: Corrupt, recorded: RecordedRun) -> Mask:
    return recorded.arrived | recorded.outcome_is("duplicate")


@can_cause.register
def _(fault: Duplicate, recorded: RecordedRun) -> Mask:
    return np.asarray((recorded.copy > 0) & recorded.arrived)


@can_cause.register
def _(fault: SenderFault, recorded: RecordedRun) -> Mask:
    return np.asarray((recorded.copy > 0) & ~recorded.outcome_is("fault"))


@can_cause.register
def _(fault: StaleMessages, recorded: RecordedRun) -> Mask:
    return np.asarray(sent_by_programs(recorded) & ~recorded.outcome_is("fault"))


@can_cause.register
def _(fault: Custom, recorded: RecordedRun) -> Mask:
    return recorded.arrived | recorded.outcome_is("fault", "duplicate")


@can_cause.register
def _(fault: CustomSender, recorded: RecordedRun) -> Mask:
    return np.asarray(~recorded.outcome_is("fault") | (recorded.copy == 0))


def check_partition_respected(recorded: RecordedRun) -> Finding:
    """Check that nothing sent across a cut (partition, block, range, swizzle) passed it."""
    cuts = begun(recorded, lambda fault: fault.cuts)
    if not cuts:
        return not_exercised("no fault cuts links" if recorded.plan else NO_FAULTS)
    across = np.zeros(len(recorded.trace), dtype=bool)
    for planned in cuts:
        across |= recorded.surely_reaches(planned)
    if not across.any():
        return unknown("no frame was sent across a cut")
    passed = across & recorded.outcome_is(*ON_AIR)
    count = int(passed.sum())
    text = f"{counted(int(across.sum()), 'reception')} across a cut, and none passed"
    broken_text = f"{count} of {counted(int(across.sum()), 'reception')} passed a cut"
    return result(count, text, broken_text, recorded.rows(passed), across=int(across.sum()), passed=count)


def check_down_respected(recorded: RecordedRun) -> Finding:
    """Check that a node that is down neither sends, reports nor receives: arrivals there are `receiver_down`."""
    if not recorded.down:
        return not_exercised("no node was down" if recorded.plan else NO_FAULTS)
    sure = ~recorded.is_unsure(recorded.sent_ns)
    speaking = sure & recorded.is_down(recorded.sender, recorded.sent_ns)
    judged = recorded.arrived & ~recorded.is_unsure(recorded.due_ns)
    if recorded.closed_ns < recorded.scenario.duration_ns:  # frames in flight were decided at once
        judged &= recorded.due_ns < recorded.closed_ns
    receiver_down = recorded.is_down(recorded.receiver, recorded.due_ns)
    hearing = judged & receiver_down & recorded.outcome_is("delivered")
    # A frame to one vehicle is not received either where its radio is down as the frame ends on air, or is dropped.
    left_ns = recorded.sent_ns if recorded.scenario.radio.mac is None else recorded.column("left_ns")
    excused = receiver_down | ((recorded.attempt > 0) & recorded.is_down(recorded.receiver, left_ns))
    missing = judged & ~excused & recorded.outcome_is("receiver_down")
    # A node may report and end by itself at one instant; a fault acts before anything else does.
    spans = [(span.node, span.start_ns + (not span.planned), span.end_ns) for span in recorded.down]
    reports = _reports_within(recorded, spans)
    wrong = speaking | hearing | missing
    broken = int(wrong.sum()) + len(reports)
    down = {span.node for span in recorded.down}
    figures = {"spoke": int(speaking.sum()), "heard": int(hearing.sum()), "missed": int(missing.sum())}
    return result(
        broken,
        f"{counted(len(down), 'node was', 'nodes were')} down, and neither sent nor received",
        f"{counted(broken, 'frame, arrival or report', 'frames, arrivals or reports')} of nodes that were down",
        recorded.rows(wrong) + reports,
        **figures,
        reports=len(reports),
    )


def check_pause_respected(recorded: RecordedRun) -> Finding:
    """Check that a paused node sends nothing and reports nothing."""
    pauses = begun(recorded, lambda fault: isinstance(fault, ProcessFault) and not fault.ends)
    if not pauses:
        return not_exercised("no node was paused" if recorded.plan else NO_FAULTS)
    speaking = np.zeros(len(recorded.trace), dtype=bool)
    spans = []
    for planned in pauses:
        from_ns = _stopped_ns(recorded, planned)
        since = recorded.sent_ns >= from_ns + recorded.guard_ns
        still = since & (recorded.sent_ns < planned.end_ns - recorded.guard_ns)
        speaking |= planned.nodes[recorded.sender] & still
        spans += [(node, from_ns, planned.end_ns) for node in np.flatnonzero(planned.nodes).tolist()]
    reports = _reports_within(recorded, spans)
    broken = int(speaking.sum()) + len(reports)
    broken_text = f"{counted(int(speaking.sum()), 'frame')} and {counted(len(reports), 'report')} of paused nodes"
    paused = int(np.any([planned.nodes for planned in pauses], axis=0).sum())
    text = f"{counted(paused, 'node was', 'nodes were')} paused, and sent and reported nothing"
    rows = recorded.rows(speaking) + reports
    return result(broken, text, broken_text, rows, spoke=int(speaking.sum()), reports=len(reports))


def _stopped_ns(recorded: RecordedRun, planned: PlannedFault) -> int:
    """Return when a fault stopped its processes: once the restart was over within which it was to begin, if any."""
    held_until_ns = [end_ns for start_ns, end_ns in recorded.holding_restarts if start_ns < planned.start_ns]
    return max([planned.start_ns, *held_until_ns])


def _reports_within(recorded: RecordedRun, spans: Iterable[tuple[int, int, int]]) -> list[dict[str, Any]]:
    """Reports in periods that lie wholly within one of these spans (node, start, end) of its node."""
    start_ns = recorded.period_starts_ns()
    end_ns = start_ns + recorded.scenario.period_ns
    guard_ns = recorded.guard_ns
    reports = []
    for node, from_ns, to_ns in spans:
        within = (start_ns >= from_ns + guard_ns) & (end_ns <= to_ns) & recorded.reported[:, node]
        for period in np.flatnonzero(within).tolist():
            reports.append(
                {"node": recorded.node_ids[node], "period": period, "reported_until_ns": int(end_ns[period])}
            )
    return reports


def check_outage_respected(recorded: RecordedRun) -> Finding:
    """Check that a receiver has no fix exactly while an outage acts on it."""
    outages = begun(recorded, lambda fault: isinstance(fault, GnssOutage))
    there = np.isfinite(recorded.vectors("position_m")[..., 0])
    without = there & np.isnan(recorded.vectors("fix_m")[..., 0])
    if not outages and not without.any():
        return not_exercised("no fault takes the fixes" if recorded.plan else NO_FAULTS)
    due = np.zeros_like(without)
    for planned in outages:
        due |= recorded.struck(planned) & there
    period, node = np.nonzero(due != without)
    rows = [
        {"node": recorded.node_ids[n], "period": p, "fix": "none" if without[p, n] else "given"}
        for p, n in zip(period.tolist()[:MOST_ROWS], node.tolist(), strict=False)
    ]
    count = len(period)
    text = f"{counted(int(due.sum()), 'fix', 'fixes')} withheld, and no others"
    return result(
        count,
        text,
        f"{counted(count, 'fix', 'fixes')} given in an outage, or withheld without",
        rows,
        wrong=count,
    )


def check_fault_loss(recorded: RecordedRun) -> Iterator[Finding]:
    """Yield for each fault that loses receptions by chance whether it does so at its rate."""
    for planned in begun(recorded, _loses):
        yield named(f"loss_rate:{planned.label}", _loss_of(recorded, planned))


def _loss_of(recorded: RecordedRun, planned: PlannedFault) -> Finding:
    hit = recorded.cause == planned.number
    drawing = _drew_for(recorded, planned)
    drawn, lost = int(drawing.sum()), int((hit & drawing).sum())
    if not drawn:
        return unknown("no reception came as far as this fault", pairs=0)
    expected, low, high = loss_band(planned.fault, recorded, planned, drawing)
    figures = {"lost": lost, "pairs": drawn, "rate": lost / drawn, "expected": expected, "low": low, "high": high}
    text = f"{lost:,} of {counted(drawn, 'reception')} lost, {lost / drawn:.2%}; {expected:.2%} expected"
    outside = not low <= lost <= high
    rows = recorded.rows(drawing & (hit if lost > high else ~hit)) if outside else []
    return result(int(outside), text, f"{text}: outside its band", rows, **figures)


def _drew_for(recorded: RecordedRun, planned: PlannedFault) -> Mask:
    """Receptions that came as far as a fault of chance: not cut, and not lost to an earlier one."""
    reached = recorded.surely_reaches(planned) & ~received_twice(recorded)
    later = [other.number for other in begun(recorded, _loses) if other.number >= planned.number]
    further = recorded.outcome_is(*ON_AIR) | (recorded.outcome_is("fault") & np.isin(recorded.cause, later))
    return np.asarray(reached & further)


@singledispatch
def loss_band(
    fault: Fault, recorded: RecordedRun, planned: PlannedFault, drawing: Mask
) -> tuple[float, float, float]:
    """Return the expected rate of losses, and the least and the most of the rows `drawing` that may be lost."""
    assert isinstance(fault, LossFault), fault
    return fault.mean_loss, *binomial_band(int(drawing.sum()), fault.mean_loss, RATE_BAND)


@loss_band.register
def _(fault: BurstLoss, recorded: RecordedRun, planned: PlannedFault, drawing: Mask) -> tuple[float, float, float]:
    """Return the same for a two-state chain a link that starts good (Gilbert, Elliott).

    Losses of a link are correlated over 1 / (1 - λ) frames, λ = 1 - enter - leave, which widens the band. So does
    what is not known of frames that nobody was in range of, which move the chain as well.
    """
    memory = 1 - fault.enter - fault.leave
    mostly_bad = fault.enter / (fault.enter + fault.leave)
    _, least, most = (steps[drawing] for steps in frames_since(recorded, planned))
    bad = mostly_bad * (1 - memory ** np.stack([least, np.minimum(least + 1, most), most]))
    rates: Array = fault.loss_good + (fault.loss_bad - fault.loss_good) * bad
    lowest, highest = rates.min(axis=0), rates.max(axis=0)
    rate = (lowest + highest) / 2
    mean = float(rate.sum())
    frames_a_link = max(1.0, len(np.unique(recorded.emission[drawing])))
    length = min(1 / (1 - memory), frames_a_link) if memory < 1 else frames_a_link
    stretch = max(1.0, 2 * length - 1)
    variance = float(np.sum(rate * (1 - rate))) * stretch
    away = RATE_SIGMAS * sqrt(variance) + stretch * log(1e6) / 3 if 0 < mean < len(rate) else 0.5
    return (
        mean / len(rate),
        max(0.0, float(lowest.sum()) - away),
        min(float(len(rate)), float(highest.sum()) + away),
    )


def frames_since(recorded: RecordedRun, planned: PlannedFault) -> tuple[Array, Array, Array]:
    """Return how many frames each row's sender had sent since a fault began, the row's included.

    Those that have rows, and with the others at least and at most.
    """
    while_acting = recorded.acting(planned, recorded.sent_ns, recorded.guard_ns) & ~received_twice(recorded)
    first = recorded.first_rows(while_acting)
    first = first[np.lexsort((recorded.emission[first], recorded.sent_ns[first], recorded.sender[first]))]
    sender = recorded.sender[first]
    begin = np.searchsorted(sender, sender)
    order = np.argsort(recorded.emission[first])
    where = np.searchsorted(recorded.emission[first][order], recorded.emission[while_acting])
    unseen = unseen_frames(recorded)
    began_ns = np.maximum(unseen.after_ns, planned.start_ns)
    possible = unseen.count * recorded.places.were_lonely(
        recorded.sender[unseen.before], began_ns, np.maximum(recorded.sent_ns[unseen.before], began_ns)
    )
    counts = np.zeros((3, len(recorded.emissions.first)))
    counts[1:, recorded.emissions.of_row[unseen.before]] = (
        np.where(unseen.after_ns >= planned.start_ns, possible, 0),
        np.where(possible > 0, unseen.most(), 0),
    )
    steps = np.zeros((3, len(recorded.trace)))
    each = 1 + counts[:, recorded.emissions.of_row[first]]
    total = np.cumsum(each, axis=1)
    total -= (total - each)[:, begin]
    steps[:, while_acting] = total[:, order][:, where]
    return steps[0], steps[1], steps[2]


PHASE_NS = 1_000_000
"""Within a period, a program that sends by the clock does so at times no further apart."""
STEADY_FRAMES = 5
"""Frames that show that a program sends by the clock."""


def check_fault_effects(recorded: RecordedRun) -> Iterator[Finding]:
    """Yield a finding for each fault of the plan: it took effect, or nothing shows that it did."""
    for planned in recorded.plan:
        yield named(f"effect:{planned.label}", _effect_of(recorded, planned))


def _effect_of(recorded: RecordedRun, planned: PlannedFault) -> Finding:
    if planned.start_ns == planned.end_ns:
        return not_exercised("it was healed before it began, or lasts less than a nanosecond")
    if planned.start_ns >= recorded.closed_ns:
        return unknown("the run ended before it began")
    if isinstance(planned.fault, SenderFault) and _held_down(recorded, planned):
        return not_exercised("other faults kept its vehicles from sending throughout")
    return effect(planned.fault, recorded, planned)


@singledispatch
def effect(fault: Fault, recorded: RecordedRun, planned: PlannedFault) -> Finding:
    """Return what shows that a planned fault took effect: unless its class says otherwise, rows that name it."""
    count = int((recorded.cause == planned.number).sum())
    return _found(count, "reception names it|receptions name it", "no reception names it")


@effect.register
def _(fault: Corrupt, recorded: RecordedRun, planned: PlannedFault) -> Finding:
    named = recorded.cause == planned.number
    said, known = frame_digests(recorded)
    shown = named & known
    changed = shown & (recorded.digest != said) if shown.any() else named  # nobody received the original
    text = "reception with changed bytes|receptions with changed bytes"
    return _found(int(changed.sum()), text, "no reception with changed bytes")


@effect.register
def _(fault: DelayFault, recorded: RecordedRun, planned: PlannedFault) -> Finding:
    return _later(_delayed(recorded, planned))


@effect.register
def _(fault: Throttle, recorded: RecordedRun, planned: PlannedFault) -> Finding:
    return _later(_delayed(recorded, planned) + _overflowed(recorded, planned))


def _later(count: int) -> CheckResult:
    text = "arrival is later than it could be without it|arrivals are later than they could be without it"
    return _found(count, text, "no arrival is later than it could be without it")


@effect.register
def _(fault: ProcessFault, recorded: RecordedRun, planned: PlannedFault) -> Finding:
    count = _silenced(recorded, planned)
    text = "node neither sent nor received|nodes neither sent nor received"
    return _found(count, text, "no node had sent or reported before, and then not for two periods")


@effect.register
def _(fault: GnssFault, recorded: RecordedRun, planned: PlannedFault) -> Finding:
    error_m = receiver_noise_m(recorded)[_affected(recorded, planned)]
    error_m = error_m[np.isfinite(error_m).all(axis=1)]
    as_noise = not len(error_m) or is_noise(error_m, recorded.scenario.world.gnss.sigma_m)
    return _wrong_fixes(0 if as_noise else len(error_m))


@effect.register
def _(fault: GnssOutage, recorded: RecordedRun, planned: PlannedFault) -> Finding:
    fix_m = recorded.vectors("fix_m")[_affected(recorded, planned)]
    return _wrong_fixes(int((~np.isfinite(fix_m).all(axis=1)).sum()))


@effect.register
def _(fault: GnssFreeze, recorded: RecordedRun, planned: PlannedFault) -> Finding:
    fix_m = recorded.vectors("fix_m")
    repeated = (fix_m[1:] == fix_m[:-1]).all(axis=2)
    return _wrong_fixes(int(repeated[_affected(recorded, planned)[1:]].sum()))


def _affected(recorded: RecordedRun, planned: PlannedFault) -> Mask:
    """The fixes (periods, N) of vehicles in the network on whose receivers a fault acts."""
    return np.asarray(recorded.struck(planned) & np.isfinite(recorded.vectors("position_m")[..., 0]))


def _wrong_fixes(count: int) -> CheckResult:
    what = "missing, repeated, or further off than receiver noise"
    text = f"fix is {what}|fixes are {what}"
    return _found(count, text, "the fixes could be those of a receiver without faults")


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


def _found(count: int, text: str, nothing: str) -> CheckResult:
    """Return a valid result that `count` things were seen: `text` says what, `of one|of several`."""
    if not count:
        return unknown(nothing, count=0)
    one, several = text.split("|")
    return valid(counted(count, one, several), count=count)


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
    assert isinstance(planned.fault, Throttle)
    ready_ns = recorded.sent_ns + radio.access_jitter_ms * NS_PER_MS
    slow = begin_ns >= ready_ns + recorded.column("size_bytes") * 8_000 / planned.fault.bitrate_mbps - 1
    if radio.congestion is None and isinstance(radio.mac, Edca):
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
    from_ns = _stopped_ns(recorded, planned)
    before, during = end_ns <= planned.start_ns, (start_ns >= from_ns) & (end_ns <= planned.end_ns)
    sends_before = recorded.sent_ns < planned.start_ns
    sends_during = recorded.acting(planned, recorded.sent_ns, -recorded.guard_ns)
    sends_during &= recorded.sent_ns >= from_ns + recorded.guard_ns
    ends = isinstance(planned.fault, ProcessFault) and planned.fault.ends
    count = 0
    for node in np.flatnonzero(planned.nodes).tolist():
        if recorded.deaths_ns.get(node, END_OF_TIME_NS) <= planned.start_ns:
            continue  # it has ended by itself
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
def _(fault: ClockFault, recorded: RecordedRun, planned: PlannedFault) -> Finding:
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
            moved, "vehicle sends at other times of the period|vehicles send at other times of the period", ""
        )
    return not_exercised("these vehicles do not send by their own clocks, and nothing else would show them")


def _disturbed(recorded: RecordedRun) -> Mask:
    """Vehicles (N,) that are paused or restarted at some time, and send at other times for that reason."""
    disturbed = np.zeros(len(recorded.node_ids), dtype=bool)
    for planned in recorded.plan:
        if isinstance(planned.fault, ProcessFault):
            disturbed |= planned.nodes
    return disturbed


@effect.register
def _(fault: Infrastructure, recorded: RecordedRun, planned: PlannedFault) -> Finding:
    done = [e for e in recorded.event(f"{fault.kind}ed") if e.time_ns >= planned.start_ns]
    if done:
        return _found(len(done), "restart|restarts", "")
    started = recorded.event(EventKind.started)
    if started and not started[0].details.get("start_up_s"):
        return not_exercised("a simulation has neither router nor sessions")
    return unknown("no event says that anything was restarted")
