"""Checks of the radio: each reception has one outcome, and comes within its bounds on latency.

The outcomes fit range, cap and random draws. The bounds are those of the radio, of the sender's queue, and of the
faults that delay.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from math import log, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emulator.fault_plan import PlannedFault
from emulator.radio.dot11p import airtimes_ns
from emulator.radio.outcomes import Outcome
from emulator.radio.own_rules import LONGEST_DELAY_S, MOST_COPIES
from emulator.records.distributions import binomial_interval
from emulator.records.events import EventKind
from emulator.records.recorded_run import ARRIVED, END_OF_TIME_NS, NO_FAULT, ON_AIR, RecordedRun
from emulator.records.verdicts import Finding, not_exercised, result, unknown
from emulator.scenario.faults import (
    Custom,
    CustomSender,
    DataReplay,
    DelayFault,
    DoS,
    Duplicate,
    SenderFault,
    StaleMessages,
    Sybil,
    Throttle,
)
from emulator.scenario.radio import RATES_MBPS
from emulator.scenario.scenario import Scenario
from emulator.world.radio_inputs import LinkTable
from vnet.errors import counted, first_names
from vnet.types import Array, IntArray, Mask
from vnet.units import NS_PER_MS, NS_PER_S

LOSS_BAND = 1 - 1e-6
LOSS_SIGMAS = 4.9
"""Half-width of the band of measured losses, in standard deviations: one sound run in a million is outside."""
IN_TRACE = tuple(o.name for o in Outcome if o not in (Outcome.pending, Outcome.out_of_range))
"""Outcomes of rows of the trace; of frames to single vehicles, `out_of_range` as well."""

BAND_SIGMAS = 4.9
"""Half-width of the band of a mean, in standard deviations: one sound mean in a million is further off."""
ROUNDING_NS = 2
NO_EPISODE = -1


def nothing_seen(recorded: RecordedRun, text: str) -> Finding:
    """Return unknown, as nothing was observed; not applicable if no vehicle has another in range."""
    if not recorded.places.most_in_range:
        return not_exercised("no vehicle has another in range")
    return unknown(text)


def check_conservation(recorded: RecordedRun) -> Finding:
    """Check that each frame, and each copy, has one row with one outcome for each receiver in range."""
    if not len(recorded.trace):
        return nothing_seen(recorded, "no frame was sent")
    broken: dict[str, Mask] = {
        "repeated": _repeated(recorded),
        "wrong_count": _in_frames_of_wrong_size(recorded),
        "not_in_range": recorded.placed & (recorded.in_range == _sent_beyond_range(recorded)) & ~_unsent(recorded),
        "undecided": ~(recorded.outcome_is(*IN_TRACE) | _sent_beyond_range(recorded)),
        "orphans": _orphans(recorded),
        "disordered": _out_of_order(recorded),
        "mistimed": _mistimed(recorded),
    }
    frames = int((recorded.copy[recorded.emissions.first] == 0).sum())
    gaps = _missing_numbers(recorded)
    counts: dict[str, Any] = {what: int(mask.sum()) for what, mask in broken.items()}
    counts["wrong_count"] = len(recorded.first_rows(broken["wrong_count"]))
    total = sum(counts.values()) + gaps
    offending = np.logical_or.reduce(list(broken.values()))
    return result(
        total,
        f"{counted(frames, 'frame')}, {counted(len(recorded.trace), 'reception')} in range, each with one outcome",
        f"{counted(total, 'frame or reception', 'frames or receptions')} without exactly one outcome",
        recorded.rows(offending),
        frames=frames,
        pairs=len(recorded.trace),
        **counts,
        missing_frames=gaps,
    )


def _sent_beyond_range(recorded: RecordedRun) -> Mask:
    """Rows of frames to single vehicles that were out of range."""
    return np.asarray((recorded.attempt > 0) & recorded.outcome_is("out_of_range"))


def _unsent(recorded: RecordedRun) -> Mask:
    """Rows of frames to single vehicles that never left their sender, whether or not the addressee was in range."""
    return np.asarray((recorded.attempt > 0) & recorded.never_sent)


def _repeated(recorded: RecordedRun) -> Mask:
    key = recorded.emission * len(recorded.node_ids) + recorded.receiver
    order = np.argsort(key, kind="stable")
    repeated = np.zeros(len(key), dtype=bool)
    repeated[order[1:]] = key[order[1:]] == key[order[:-1]]
    return repeated


def _in_frames_of_wrong_size(recorded: RecordedRun) -> Mask:
    """Rows of frames without exactly one row for each receiver in range; duplicates may have fewer.

    A frame to a single vehicle has one row.
    """
    first, inverse, rows = recorded.emissions
    in_range = recorded.places.receivers_in_range(recorded.sender[first], recorded.sent_ns[first])
    wrong = recorded.placed[first] & (rows != np.where(recorded.attempt[first] > 0, 1, in_range))
    sent = np.bincount(inverse, weights=~received_twice(recorded), minlength=len(first)) > 0
    return np.asarray((wrong & sent)[inverse])


def _orphans(recorded: RecordedRun) -> Mask:
    """Copies that name no fault, or no original that was sent by then, be it that nobody was in range of it."""
    copies = recorded.copy > 0
    if not copies.any():
        return copies
    index = recorded.frame_of_row
    original_ns = np.full(len(copies), END_OF_TIME_NS)
    np.minimum.at(original_ns, index[~copies], recorded.sent_ns[~copies])
    named = recorded.trace["cause"].combine_chunks()
    nameless = np.asarray(named.to_numpy(zero_copy_only=False) == "", dtype=bool)
    nameless &= recorded.attempt < 2  # what is transmitted again is a copy, but no fault's
    orphans = copies & (original_ns[index] > recorded.sent_ns)
    rows = np.flatnonzero(orphans & (original_ns[index] == END_OF_TIME_NS))
    orphans[rows[unseen_frames(recorded).may_hold(rows, recorded.sent_ns[rows])]] = False
    return np.asarray(orphans | (copies & nameless))


def _out_of_order(recorded: RecordedRun) -> Mask:
    """Originals that were sent before an earlier one of their sender."""
    originals = np.flatnonzero(recorded.copy == 0)
    order = originals[np.argsort(recorded.emission[originals], kind="stable")]
    same = recorded.sender[order[1:]] == recorded.sender[order[:-1]]
    disordered = np.zeros(len(recorded.trace), dtype=bool)
    disordered[order[1:]] = same & (recorded.sent_ns[order[1:]] < recorded.sent_ns[order[:-1]])
    return disordered


def _mistimed(recorded: RecordedRun) -> Mask:
    """Rows whose arrival time is not after the sending time, is missing, or should not be there."""
    there = recorded.arrival_ns >= 0
    return np.asarray((there != recorded.arrived) | (there & (recorded.arrival_ns <= recorded.sent_ns)))


def _missing_numbers(recorded: RecordedRun) -> int:
    """Count the numbers missing below the last one, of each sender's frames and of each frame's copies.

    Frames sent while no receiver is in range have no rows, so their numbers may be missing.
    """
    unseen = unseen_frames(recorded)
    sender, sent_ns = recorded.sender[unseen.before], recorded.sent_ns[unseen.before]
    missing = int(unseen.count[~recorded.places.were_lonely(sender, unseen.after_ns, sent_ns)].sum())
    first = recorded.emissions.first
    copies = first[recorded.copy[first] > 0]
    copies = copies[~recorded.places.ever_lonely[recorded.sender[copies]]]
    frame, index = np.unique(recorded.frame[copies], return_inverse=True)
    last = np.zeros(len(frame), dtype=np.int64)
    np.maximum.at(last, index, recorded.copy[copies])
    return missing + int(last.sum()) - len(copies)


@dataclass(frozen=True)
class UnseenFrames:
    """Frames that nobody was in range of: they have no rows, and only the numbers of others tell of them.

    `count` (n,) are missing before each original, of the row `before`, since the last one of its sender, sent at
    `after_ns`. The originals are in the order of sender and number.
    """

    recorded: RecordedRun
    before: NDArray[np.intp]
    count: IntArray
    after_ns: IntArray

    def most(self) -> Array:
        """Return how many frames (n,) they were at most, with those that sender faults added meanwhile."""
        recorded, most = self.recorded, self.count.astype(float)
        sender, until_ns = recorded.sender[self.before], recorded.sent_ns[self.before] + recorded.guard_ns
        for planned in recorded.plan:
            if isinstance(planned.fault, SenderFault):
                acted = planned.nodes[sender] & (planned.start_ns <= until_ns)
                acted &= planned.end_ns + recorded.guard_ns >= self.after_ns
                most[acted] *= _frames_of_one(planned.fault)
        return most

    def may_hold(self, rows: NDArray[np.intp], until_ns: IntArray, since_ns: int = 0) -> Mask:
        """Return whether the frame of each row (n,), which has no original, may have been sent in that time."""
        recorded = self.recorded
        return self._may_lie(
            np.searchsorted(recorded.frame[self.before], recorded.frame[rows]), rows, until_ns, since_ns
        )

    def may_follow(self, rows: NDArray[np.intp], until_ns: IntArray, since_ns: int = 0) -> Mask:
        """Return whether the last frame up to an instant, of the sender of each row (n,), may be one of them."""
        recorded = self.recorded
        longest_ns = int(recorded.sent_ns.max(initial=0)) + 2
        sent = recorded.sender[self.before] * longest_ns + recorded.sent_ns[self.before]
        until = recorded.sender[rows] * longest_ns + np.maximum(until_ns, -1)
        return self._may_lie(np.searchsorted(sent, until, side="right"), rows, until_ns, since_ns)

    def _may_lie(self, place: NDArray[np.intp], rows: NDArray[np.intp], until_ns: IntArray, since_ns: int) -> Mask:
        """Return whether some were sent before these originals, in that time, by the sender of each row (n,)."""
        recorded = self.recorded
        if not len(self.before):
            return np.zeros(len(rows), dtype=bool)
        there = np.append(recorded.sender[self.before], -1)[place] == recorded.sender[rows]
        place = np.where(there, place, 0)
        from_ns = np.maximum(self.after_ns[place], since_ns)
        to_ns = np.minimum(recorded.sent_ns[self.before[place]], until_ns)
        lonely = recorded.places.were_lonely(recorded.sender[rows], from_ns, to_ns)
        return np.asarray(there & (self.count[place] > 0) & (from_ns <= to_ns) & lonely)


def _frames_of_one(fault: SenderFault) -> int:
    """Return how many frames at most a fault makes of one."""
    match fault:
        case DoS(factor=factor):
            return factor
        case Sybil(ghosts=ghosts):
            return 1 + ghosts
        case StaleMessages():
            return 1
    return 2 if isinstance(fault, DataReplay) else 1 + MOST_COPIES


def unseen_frames(recorded: RecordedRun) -> UnseenFrames:
    """Return the frames of a run that have no rows."""
    first = recorded.emissions.first
    originals = first[recorded.copy[first] == 0]  # by sender, and in the order of their numbers
    sender, seq, sent_ns = recorded.sender[originals], recorded.seq[originals], recorded.sent_ns[originals]
    begins = np.diff(sender, prepend=-1) != 0
    after, after_ns = np.where(begins, -1, np.roll(seq, 1)), np.where(begins, 0, np.roll(sent_ns, 1))
    return UnseenFrames(recorded, originals, seq - after - 1, after_ns)


def check_range(recorded: RecordedRun) -> Finding:
    """Check that nothing was delivered to a receiver out of range."""
    delivered = recorded.outcome_is("delivered")
    if not delivered.any():
        return nothing_seen(recorded, "nothing was delivered")
    beyond = delivered & recorded.placed & ~recorded.in_range
    broken, count = int(beyond.sum()), int(delivered.sum())
    text = f"all {counted(count, 'delivery', 'deliveries')} within range"
    broken_text = f"{counted(broken, 'delivery', 'deliveries')} beyond range"
    return result(broken, text, broken_text, recorded.rows(beyond), delivered=count, beyond=broken)


def check_peer_cap(recorded: RecordedRun) -> Finding:
    """Check that each receiver hears its nearest `max_peers` live senders in range, and no other."""
    cap = recorded.scenario.radio.max_peers
    largest = recorded.places.most_in_range
    capped = recorded.outcome_is("peer_cap") & recorded.placed
    if largest <= cap and not capped.any():
        return not_exercised(f"no receiver has more than {cap} senders in range (at most {largest})")
    if not len(recorded.trace):
        return unknown("no frame was sent")
    wrong = _wrongly_capped(recorded, capped)
    broken = int(wrong.sum())
    figures = {"cap": cap, "largest_in_range": largest, "capped": int(capped.sum()), "wrong": broken}
    if not broken and not capped.any():
        text = f"the cap of {cap} never acted, though up to {largest} are in range: those beyond it sent nothing"
        return unknown(text, **figures)
    if largest <= cap:  # nothing explains them
        broken, wrong = int(capped.sum()), capped
    text = f"{counted(int(capped.sum()), 'reception')} beyond the nearest {cap} (up to {largest} in range)"
    return result(
        broken,
        text,
        f"{counted(broken, 'reception')} on the wrong side of the cap",
        recorded.rows(wrong),
        **figures,
    )


def _wrongly_capped(recorded: RecordedRun, capped: Mask) -> Mask:
    # Frames sent at the instant of a death may have been sent before or after it: they are not judged.
    judged = capped | recorded.outcome_is("fault", *ON_AIR)
    judged &= recorded.placed & ~recorded.is_unsure(recorded.sent_ns) & ~recorded.dropped_by_sender
    edges = {0, END_OF_TIME_NS} | {edge for span in recorded.down for edge in (span.start_ns, span.end_ns)}
    edges |= set(recorded.places.starts_ns.tolist())
    wrong = np.zeros(len(capped), dtype=bool)
    for start_ns, end_ns in pairwise(sorted(edges)):
        rows = recorded.sent_between(start_ns, end_ns)
        if len(rows):
            admitted = recorded.admitted(~recorded.down_at(start_ns), start_ns)
            is_admitted = admitted.contain(recorded.sender[rows], recorded.receiver[rows])
            wrong[rows] = judged[rows] & (is_admitted == capped[rows])
    return wrong


def check_loss_rate(recorded: RecordedRun) -> Finding:
    """Check that the share of lost receptions is in the binomial band of `radio.loss`, or of the links' losses."""
    if isinstance(recorded.radio_inputs.links, LinkTable):
        return _check_measured_losses(recorded)
    loss = recorded.scenario.radio.loss
    drawing = drew_for_loss(recorded)
    lost, drawn = int((drawing & recorded.outcome_is("lost")).sum()), int(drawing.sum())
    if drawn == 0:
        return nothing_seen(recorded, "no reception came as far as the loss")
    low, high = binomial_band(drawn, loss, LOSS_BAND)
    figures = {"lost": lost, "pairs": drawn, "rate": lost / drawn, "expected": loss, "low": low, "high": high}
    text = f"{lost:,} of {counted(drawn, 'reception')} lost, {lost / drawn:.2%}; {loss:.2%} expected"
    wrong_way = recorded.outcome_is("lost") if lost > high else drawing & ~recorded.outcome_is("lost")
    outside = not low <= lost <= high
    rows = recorded.rows(wrong_way) if outside else []
    return result(int(outside), text, f"{text}: outside the {LOSS_BAND:.4%} band", rows, **figures)


def _check_measured_losses(recorded: RecordedRun) -> Finding:
    """Check the number of lost receptions, and each of those on links that lose everything, or nothing."""
    rows = np.flatnonzero(drew_for_loss(recorded) & recorded.placed)
    lost = recorded.outcome_is("lost")[rows]
    if not len(rows):
        return nothing_seen(recorded, "no reception came as far as the loss")
    found = recorded.places.pair_losses(recorded.sender[rows], recorded.receiver[rows], recorded.sent_ns[rows])
    assert found is not None
    loss = np.nan_to_num(found, nan=1.0)
    expected, away = float(loss.sum()), _deviation_of_sum(loss)
    impossible = np.where(lost, loss == 0, loss == 1)
    outside = not expected - away <= lost.sum() <= expected + away
    share, law = float(lost.mean()), expected / len(rows)
    text = f"{int(lost.sum()):,} of {counted(len(rows), 'reception')} lost, {share:.2%}; {law:.2%} expected"
    problem = (
        f"{text}: outside its band" if outside else f"{counted(int(impossible.sum()), 'reception')} impossible"
    )
    broken = rows[impossible] if impossible.any() else rows[lost == (share > law)]
    figures = {"lost": int(lost.sum()), "pairs": len(rows), "rate": share, "expected": law}
    count = int(impossible.sum()) + outside
    return result(count, text, problem, recorded.rows(broken) if count else [], **figures)


def _deviation_of_sum(probability: Array) -> float:
    """Return by how much a sum of independent events (n,) may differ from the sum of their probabilities."""
    variance = float((probability * (1 - probability)).sum())
    return LOSS_SIGMAS * sqrt(variance) + (log(1e6) / 3 if variance > 0 else 0)


def drew_for_loss(recorded: RecordedRun) -> Mask:
    """Return the receptions that came as far as the radio's loss; duplicates had one draw."""
    return np.asarray(recorded.outcome_is("lost", "duplicate", *ARRIVED) & ~received_twice(recorded))


def received_twice(recorded: RecordedRun) -> Mask:
    """Return the rows that are no transmission of their own: duplicates of a reception."""
    by_rule = recorded.caused_by("custom") & ~recorded.outcome_is("fault") & ~_retries(recorded)
    return np.asarray((recorded.caused_by("duplicate") | by_rule) & (recorded.copy > 0))


def _retries(recorded: RecordedRun) -> Mask:
    """Rows of retries of frames to single vehicles, each the first row of its transmission."""
    retries = np.zeros(len(recorded.trace), dtype=bool)
    rows = np.flatnonzero(recorded.attempt > 1)
    if len(rows):
        what = np.column_stack([recorded.frame[rows], recorded.attempt[rows], recorded.on_air_ns[rows]])
        order = np.argsort(recorded.copy[rows], kind="stable")
        retries[rows[order][np.unique(what[order], axis=0, return_index=True)[1]]] = True
    return retries


def binomial_band(drawn: int, probability: float, share: float) -> tuple[float, float]:
    """Return the least and the most of `drawn` that are in the binomial band of this share."""
    if not 0 < probability < 1:
        return (probability * drawn,) * 2
    return binomial_interval(share, drawn, probability)


def check_isolation(recorded: RecordedRun) -> Finding:
    """Check that arrivals were sent, byte for byte, that programs report no more, and pass by no other way."""
    refused = sum(int(event.details.get("count", 0)) for event in recorded.event(EventKind.refused_total))
    arrived = int(recorded.arrived.sum())
    strangers_at = sorted({event.node or "" for event in recorded.event(EventKind.extra_session)})
    found_at = sorted({event.node or "" for event in recorded.event(EventKind.found_session)})
    if not arrived and not strangers_at and not found_at:
        return nothing_seen(recorded, "nothing arrived")
    foreign = _foreign(recorded)
    claims = _claims_beyond(recorded)
    broken = int(foreign.sum()) + len(claims) + len(strangers_at) + len(found_at)
    reporting = int(np.isfinite(recorded.value("heard")).any(axis=0).sum())
    text = f"{counted(arrived, 'arrival')} as they were sent"
    text += f"; {reporting} programs report no more received packets than that" if reporting else ""
    wrong = {
        f"{counted(int(foreign.sum()), 'arrival')} of what was never sent": foreign.any(),
        f"{counted(len(claims), 'report')} of more packets (`heard`) than arrived": claims,
        f"more sessions than commands (program.zenoh.sessions) at {first_names(strangers_at)}": strangers_at,
        f'peers of {first_names(found_at)} are found by multicast (mode "client" is not)': found_at,
    }
    broken_text = ", ".join(text for text, is_so in wrong.items() if is_so)
    figures = {"arrivals": arrived, "foreign": int(foreign.sum()), "claims": len(claims), "refused": refused}
    return result(broken, text, broken_text, recorded.rows(foreign) + claims, **figures)


def _foreign(recorded: RecordedRun) -> Mask:
    """Arrivals with other bytes than their frame's that no fault changed."""
    differs = recorded.arrived & ~recorded.caused_by("corrupt") & changed_bytes(recorded)
    differs &= ~recorded.may_reach_of(Custom, CustomSender)
    replaced = _replaced(recorded)
    differs |= recorded.arrived & _not_of_that_age(recorded, replaced)
    # A frame that a stale one replaced is in no row of its own.
    differs &= ~(recorded.caused_by("DataReplay") & np.isin(recorded.frame, recorded.frame[replaced]))
    twice = np.flatnonzero(differs & received_twice(recorded))
    if len(twice):
        once = recorded.arrived & ~received_twice(recorded)
        heard = set(zip(*(column[once].tolist() for column in _what(recorded)), strict=True))
        described = zip(*(column[twice].tolist() for column in _what(recorded)), strict=True)
        differs[twice] = [what not in heard for what in described]
    return np.asarray(differs)


def changed_bytes(recorded: RecordedRun) -> Mask:
    """Return the rows with other bytes than their frame's, as far as an uncorrupted original shows them."""
    said, known = frame_digests(recorded)
    return np.asarray(known & (recorded.digest != said))


def frame_digests(recorded: RecordedRun) -> tuple[NDArray[np.uint64], Mask]:
    """Return the digest of each row's frame, and the mask of those that an uncorrupted row of it shows."""
    index = recorded.frame_of_row
    altered = recorded.caused_by("corrupt", "custom", "custom_sender")
    plain = np.flatnonzero((recorded.copy == 0) & ~altered)[::-1]
    said = np.zeros(len(index), dtype=np.uint64)
    known = np.zeros(len(index), dtype=bool)
    said[index[plain]], known[index[plain]] = recorded.digest[plain], True
    return said[index], known[index]


def _replaced(recorded: RecordedRun) -> Mask:
    """Originals that a stale frame, or a rule's, may have replaced. (If a fault cut them, they name that fault.)"""
    replaced: Mask = recorded.may_reach_of(CustomSender) & (recorded.copy == 0)
    for planned in recorded.plan:
        if isinstance(planned.fault, StaleMessages):
            old_ns = recorded.sent_ns - round(planned.fault.age_s * NS_PER_S) + recorded.guard_ns
            acts = recorded.may_reach(planned) & (recorded.copy == 0)
            replaced |= acts & (old_ns >= planned.start_ns)
    return replaced


def _not_of_that_age(recorded: RecordedRun, replaced: Mask) -> Mask:
    """Stale frames that differ from the frame their sender sent that long ago, unless that was stale itself.

    Nor is known of a frame that nobody was in range of what was in it.
    """
    wrong = np.zeros(len(replaced), dtype=bool)
    unseen = unseen_frames(recorded)
    sound = ~recorded.caused_by("corrupt")
    for planned in recorded.plan:
        mine = np.flatnonzero(recorded.cause == planned.number)
        if not isinstance(planned.fault, StaleMessages) or not len(mine):
            continue
        for sender in np.unique(recorded.sender[mine]):
            own = np.flatnonzero((recorded.sender == sender) & (recorded.copy == 0))
            own = own[np.lexsort((sound[own], recorded.seq[own], recorded.sent_ns[own]))]
            late = mine[recorded.sender[mine] == sender]
            before_ns = recorded.sent_ns[late] - round(planned.fault.age_s * NS_PER_S)
            index = np.searchsorted(recorded.sent_ns[own], before_ns, side="right") - 1
            old = own[np.maximum(index, 0)]
            too_old = (index < 0) | (recorded.sent_ns[old] < planned.start_ns - recorded.guard_ns)
            differs = sound[old] & ~replaced[old] & (recorded.digest[late] != recorded.digest[old])
            wrong[late] = (too_old | differs) & ~unseen.may_follow(late, before_ns, planned.start_ns)
    return wrong


def _what(recorded: RecordedRun) -> tuple[IntArray, ...]:
    return recorded.frame, recorded.receiver, recorded.digest  # type: ignore[return-value]


def _claims_beyond(recorded: RecordedRun) -> list[dict[str, Any]]:
    """Reports whose sum of `heard` packets is more than had arrived by then; Zenoh programs hear samples."""
    if recorded.scenario.program.kind == "zenoh":
        return []
    heard = recorded.value("heard")
    claimed = np.cumsum(np.nan_to_num(heard), axis=0)
    claims = []
    ends_ns = recorded.period_starts_ns() + recorded.scenario.period_ns
    for node in np.flatnonzero(np.isfinite(heard).any(axis=0)).tolist():
        mine = recorded.outcome_is("delivered", "transport") & (recorded.receiver == node)
        delivered = np.searchsorted(np.sort(recorded.due_ns[mine]), ends_ns, side="right")
        for period in np.flatnonzero((claimed[:, node] > delivered) & np.isfinite(heard[:, node])).tolist():
            claim = {
                "node": recorded.node_ids[node],
                "period": period,
                "heard": int(min(claimed[period, node], 2**53)),
            }
            claims.append({**claim, "delivered": int(delivered[period])})
    return claims


@dataclass(frozen=True)
class Bounds:
    """Bounds of each row: the earliest and latest arrival, the airtime, and whether its frame waited for no other.

    Times in nanoseconds; `latest_ns` supposes that every access delay was the longest. `unsure` frames may have
    waited for some that nobody was in range of, whose sizes are not known.
    """

    earliest_ns: Array
    latest_ns: Array
    airtime_ns: Array
    alone: Mask
    unsure: Mask


def bounds(recorded: RecordedRun, without: PlannedFault | None = None) -> Bounds:
    """Return the bounds on the arrival of each row's frame, if it arrived; as if `without` one of the faults."""
    radio = recorded.scenario.radio
    plan = [planned for planned in recorded.plan if planned is not without]
    start_ns, end_ns, airtime_ns, alone, unsure = _queue(recorded, plan)
    latency_ns = radio.latency_ms * NS_PER_MS
    sooner_ns, later_ns = _delays(recorded, plan)
    most_ns = latency_ns + radio.jitter_ms * NS_PER_MS + _rounding_us(recorded.scenario) * 1_000
    earliest_ns = start_ns + airtime_ns + max(latency_ns, 1_000) + sooner_ns - ROUNDING_NS
    latest_ns = end_ns + most_ns + later_ns + ROUNDING_NS
    return Bounds(earliest_ns, latest_ns, airtime_ns, alone & (later_ns == 0), unsure)


def _rounding_us(scenario: Scenario) -> int:
    """The most by which arrivals are rounded up."""
    return scenario.radio.delivery_tick_us + scenario.run.order_slack_us


def _queue(recorded: RecordedRun, plan: list[PlannedFault]) -> tuple[Array, Array, Array, Mask, Mask]:
    """For each row: the earliest start and latest end of its transmission, its airtime, if it was alone, or unsure.

    The sender's queue is monotonic in its access delays: with none of them everything is at its earliest, with the
    longest at its latest. Frames of one instant are taken as one batch, so that their order does not matter. So are
    those that nobody was in range of, at the last instant at which that was so: they may have taken no time, or as
    long as a full queue of the longest. Where all share the air, the trace tells when each frame was on it.
    """
    usual_ns = recorded.airtime_ns.astype(float)
    if recorded.shares_air:
        start_ns = recorded.on_air_ns.astype(float)
        return start_ns, start_ns + usual_ns, usual_ns, recorded.arrived, np.zeros(len(usual_ns), dtype=bool)
    fast_mbps, slow_mbps = _bitrates(recorded, plan)
    bits = recorded.column("size_bytes") * 8_000
    slowed_ns = [np.maximum(usual_ns, np.rint(bits / mbps)) for mbps in (fast_mbps, slow_mbps)]
    airtimes_ns = [usual_ns, *slowed_ns]
    longest_ns = int(recorded.sent_ns.max(initial=0)) + 1
    absent, absent_ns, longest = _may_have_waited(recorded, plan)
    keys = np.append(recorded.sender, absent) * longest_ns + np.append(recorded.sent_ns, absent_ns)
    key, batch = np.unique(keys, return_inverse=True)
    batch, hidden = batch[: len(recorded.trace)], batch[len(recorded.trace) :]
    offered = ~received_twice(recorded) & ~recorded.outcome_is("oversize") & ~recorded.dropped_by_sender
    first = recorded.first_rows(offered)
    taken = first[~recorded.outcome_is("queue_full")[first]]
    sums = [np.bincount(batch[taken], weights=air[taken], minlength=len(key)) for air in airtimes_ns]
    sums.append(np.bincount(batch[first], weights=airtimes_ns[0][first], minlength=len(key)))
    sums.append(sums[0])
    more = [np.bincount(hidden, weights=longest_each_ns, minlength=len(key)) for longest_each_ns in longest]
    sums[2:] = sums[2] + more[1], sums[3] + more[0], sums[4] + more[0]
    sender, sent_ns = np.divmod(key, longest_ns)
    start, end, waits = _courses(recorded, plan, sender, sent_ns, np.column_stack(sums))
    alone = ~waits & (np.bincount(batch[first], minlength=len(key)) == 1)
    began = ~waits | (np.diff(sender, prepend=-1) != 0)
    began[hidden] = False
    last_began, last_hidden = np.full((2, len(key)), -1)
    last_began[began], last_hidden[hidden] = np.flatnonzero(began), hidden
    unsure = np.maximum.accumulate(last_hidden) > np.maximum.accumulate(last_began)
    return start[batch], end[batch], airtimes_ns[1], alone[batch], unsure[batch]


def _may_have_waited(
    recorded: RecordedRun, plan: list[PlannedFault]
) -> tuple[NDArray[np.intp], IntArray, tuple[Array, Array]]:
    """For each time in which frames have no rows: the sender, when it ended, and how long they waited at most.

    That is the airtime of the longest frames, no more than a queue holds, usually and if a fault throttles them.
    """
    radio, unseen = recorded.scenario.radio, unseen_frames(recorded)
    before, most = unseen.before[unseen.count > 0], unseen.most()[unseen.count > 0]
    sender = recorded.sender[before]
    until_ns = recorded.places.last_lonely_ns(sender, recorded.sent_ns[before])
    known = until_ns >= unseen.after_ns[unseen.count > 0]  # else a number is missing without any reason
    chosen = "bitrate_mbps" in recorded.trace.column_names
    mbps = np.full(len(sender), min(RATES_MBPS) if chosen else radio.bitrate_mbps)
    bytes_ = np.full(len(sender), radio.max_payload_bytes)
    usual_ns = airtimes_ns(radio, bytes_, mbps).astype(float)
    slow_ns = usual_ns.copy()
    for planned in plan:
        if isinstance(planned.fault, Throttle):
            throttled_ns = np.rint(bytes_ * 8_000 / planned.fault.bitrate_mbps)
            slow_ns = np.where(planned.nodes[sender], np.maximum(slow_ns, throttled_ns), slow_ns)
    waiting = np.minimum(most, radio.queue_frames + 1)
    return sender[known], until_ns[known], ((waiting * usual_ns)[known], (waiting * slow_ns)[known])


def _courses(
    recorded: RecordedRun, plan: list[PlannedFault], sender: IntArray, sent_ns: IntArray, airtime_ns: Array
) -> tuple[Array, Array, Mask]:
    """Earliest start, latest end and whether it may have waited, of each batch (B,), in order of sender and time.

    `airtime_ns` (B, 5) is of what was sent, at the bitrate of the radio, and at the fastest and the slowest that
    faults leave; of all that was offered, at that of the radio; and the most of what was sent, at that. A throttled
    sender has a queue of its own, which begins as the plain one stands; afterwards the plain one goes on, as if it
    had never been slowed.
    """
    delay_ns = recorded.scenario.radio.access_jitter_ms * NS_PER_MS
    start, end, waits = np.zeros(len(sender)), np.zeros(len(sender)), np.zeros(len(sender), dtype=bool)
    episode = _episodes(recorded, plan, sender, sent_ns)
    edges = np.flatnonzero(np.diff(sender, prepend=-1)).tolist()
    for first, last in pairwise([*edges, len(sender)]):
        of = slice(first, last)
        if (episode[of] == NO_EPISODE).all():
            start[of], end[of], waits[of] = _plain_course(sent_ns[of], airtime_ns[of], delay_ns)
        else:
            start[of], end[of], waits[of] = _throttled_course(sent_ns[of], airtime_ns[of], delay_ns, episode[of])
    return start, end, waits


def _plain_course(sent_ns: IntArray, airtime_ns: Array, delay_ns: float) -> tuple[Array, Array, Mask]:
    """As `_courses` of one sender's batches (B,) that no fault throttles: each waits for those before it."""
    least_ns, most_ns = (np.cumsum(airtime_ns[:, column]) - airtime_ns[:, column] for column in (0, 4))
    start_ns = least_ns + np.maximum.accumulate(sent_ns - least_ns)
    end_ns = most_ns + airtime_ns[:, 4] + np.maximum.accumulate(sent_ns + delay_ns - most_ns)
    waits = np.zeros(len(sent_ns), bool)
    waits[1:] = end_ns[:-1] > sent_ns[1:]
    return start_ns, end_ns, waits


def _throttled_course(
    sent_ns: IntArray, airtime_ns: Array, delay_ns: float, episode: IntArray
) -> tuple[Array, Array, Mask]:
    """As `_courses` of one sender's batches (B,), with the number of the episode of each."""
    start, end, waits = np.zeros(len(sent_ns)), np.zeros(len(sent_ns)), np.zeros(len(sent_ns), dtype=bool)
    plain, slow, within = (0.0, 0.0), (0.0, 0.0), NO_EPISODE
    batches = zip(sent_ns.tolist(), episode.tolist(), airtime_ns.tolist(), strict=True)
    for index, (time_ns, number, (usual, fast, slowest, offered, most)) in enumerate(batches):
        waits[index] = number != NO_EPISODE or plain[1] > time_ns
        if number == NO_EPISODE:
            start[index], end[index] = max(time_ns, plain[0]), max(time_ns + delay_ns, plain[1]) + most
            plain = start[index] + usual, end[index]
        else:
            slow = slow if number == within else plain
            start[index], end[index] = max(time_ns, slow[0]), max(time_ns + delay_ns, slow[1]) + slowest
            slow = start[index] + fast, end[index]
            plain = plain[0], max(time_ns + delay_ns, plain[1]) + offered
            if fast == usual < slowest:  # in real time: perhaps not throttled yet, or no longer
                start[index], end[index] = max(time_ns, plain[0]), max(end[index], plain[1])
        within = number
    return start, end, waits


def _episodes(recorded: RecordedRun, plan: list[PlannedFault], sender: IntArray, sent_ns: IntArray) -> IntArray:
    """For each batch the number of the time without a break in which its sender was throttled, or NO_EPISODE."""
    episode = np.full(len(sender), NO_EPISODE, dtype=np.int64)
    throttles = sorted((p for p in plan if isinstance(p.fault, Throttle)), key=lambda p: p.start_ns)
    guard_ns = recorded.guard_ns
    number = 0
    for node in np.flatnonzero(np.any([p.nodes for p in throttles], axis=0)).tolist() if throttles else ():
        until_ns = -1
        for planned in (p for p in throttles if p.nodes[node] and p.start_ns < p.end_ns):
            number += planned.start_ns > until_ns
            until_ns = max(until_ns, planned.end_ns)
            episode[(sender == node) & recorded.acting(planned, sent_ns, guard_ns)] = number
        number += 1
    return episode


def _bitrates(recorded: RecordedRun, plan: list[PlannedFault]) -> tuple[Array, Array]:
    """The fastest and the slowest bitrate that each row's frame may have had."""
    fast, slow = recorded.bitrate_mbps.copy(), recorded.bitrate_mbps.copy()
    for planned in plan:
        if isinstance(planned.fault, Throttle):
            chosen, limit_mbps = planned.nodes[recorded.sender], planned.fault.bitrate_mbps
            for rate, widen_ns in ((fast, -recorded.guard_ns), (slow, recorded.guard_ns)):
                when = chosen & recorded.acting(planned, recorded.sent_ns, widen_ns)
                rate[when] = np.minimum(rate[when], limit_mbps)
    return fast, slow


def _delays(recorded: RecordedRun, plan: list[PlannedFault]) -> tuple[Array, Array]:
    """Latency that faults add to each row in ns: at least, and at most."""
    least, most = np.zeros(len(recorded.trace)), np.zeros(len(recorded.trace))
    for planned in plan:
        match planned.fault:
            case DelayFault(bounds_ms=(least_ms, most_ms)):
                if least_ms:
                    least += np.where(recorded.surely_reaches(planned), least_ms, 0)
                most += np.where(recorded.may_reach(planned), most_ms, 0)
            case Custom():
                mine = recorded.may_reach(planned) & (recorded.cause != NO_FAULT)  # what it delays names a fault
                later = np.where(mine, LONGEST_DELAY_S * NS_PER_S / NS_PER_MS, 0)
                most += later * np.where(received_twice(recorded), 1 + MOST_COPIES, 1)
            case Duplicate(delay_ms=delay_ms, copies=copies):
                mine = (recorded.cause == planned.number) & (recorded.copy > 0)
                least += np.where(mine, delay_ms, 0)
                most += np.where(mine, copies * delay_ms, 0)
    return least * NS_PER_MS, most * NS_PER_MS


def check_latency(recorded: RecordedRun) -> Finding:
    """Check that arrivals are neither earlier nor later than airtime, latency, queue, jitter and faults explain."""
    timed = recorded.arrived & (recorded.due_ns >= 0)
    if not timed.any():
        return nothing_seen(recorded, "nothing arrived")
    allowed = bounds(recorded)
    early = timed & (recorded.due_ns < allowed.earliest_ns)
    late = timed & (recorded.due_ns > allowed.latest_ns)
    broken = int(early.sum() + late.sum())
    figures: dict[str, Any] = {"arrivals": int(timed.sum()), "early": int(early.sum()), "late": int(late.sum())}
    mean = _mean_latency(recorded, allowed, timed)
    figures |= mean
    off = bool(mean) and abs(mean["mean_ms"] - mean["expected_ms"]) > mean["band_ms"]
    text = f"{counted(int(timed.sum()), 'arrival')} within their bounds"
    if mean:
        text += f"; mean {mean['mean_ms']:.3f} ms without queueing, {mean['expected_ms']:.3f} ms expected"
    broken_text = (
        f"{figures['early']} too early, {figures['late']} too late" if broken else f"{text}: outside its band"
    )
    rows = recorded.rows(early | late if broken else timed & allowed.alone) if broken or off else []
    return result(broken + off, text, broken_text, rows, **figures)


def _mean_latency(recorded: RecordedRun, allowed: Bounds, timed: Mask) -> dict[str, float]:
    """The mean latency of frames that waited for no other, what it should be, and how far off it may be."""
    radio = recorded.scenario.radio
    rows = timed & allowed.alone & (recorded.copy == 0)
    count = int(rows.sum())
    if not count:
        return {}
    from_ns = recorded.on_air_ns if recorded.shares_air else recorded.sent_ns
    access_ms = 0.0 if recorded.shares_air else radio.access_jitter_ms
    mean_ns = float(np.mean((recorded.due_ns - from_ns)[rows] - allowed.airtime_ns[rows]))
    receivers: IntArray = np.unique(recorded.emission[rows], return_counts=True)[1]
    tick_ms = _rounding_us(recorded.scenario) / 1_000
    expected_ms = radio.latency_ms + (access_ms + radio.jitter_ms + tick_ms) / 2
    # The access delay is one draw for all receivers of a frame, the jitter one for each of them.
    variance = access_ms**2 / 12 * float(np.sum(receivers.astype(float) ** 2)) / count**2
    variance += radio.jitter_ms**2 / 12 / count
    band_ms = BAND_SIGMAS * sqrt(variance) + tick_ms / 2 + 1e-5
    return {"mean_ms": mean_ns / NS_PER_MS, "expected_ms": expected_ms, "band_ms": band_ms, "pairs_alone": count}
