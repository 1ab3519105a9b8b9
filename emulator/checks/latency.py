"""The bounds on latency: from the radio, the sender's queue, and the faults that delay."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from math import sqrt
from typing import Any

import numpy as np

from emulator.checks.channel import nothing_seen, received_twice
from emulator.fault_plan import PlannedFault
from emulator.radio.own_rules import LONGEST_DELAY_S, MOST_COPIES
from emulator.records.recorded_run import RecordedRun
from emulator.records.verdicts import Finding, result
from emulator.scenario.faults import Custom, DelayFault, Duplicate, Throttle
from emulator.scenario.scenario import Scenario
from vnet.errors import counted
from vnet.types import Array, IntArray, Mask
from vnet.units import NS_PER_MS, NS_PER_S

BAND_SIGMAS = 4.9
"""Half-width of the band of a mean, in standard deviations: one sound mean in a million is further off."""
ROUNDING_NS = 2
NO_EPISODE = -1


@dataclass(frozen=True)
class Bounds:
    """Bounds of each row: the earliest and latest arrival, the airtime, and whether its frame waited for no other.

    Times in nanoseconds; `latest_ns` supposes that every access delay was the longest.
    """

    earliest_ns: Array
    latest_ns: Array
    airtime_ns: Array
    alone: Mask


def bounds(recorded: RecordedRun, without: PlannedFault | None = None) -> Bounds:
    """Return the bounds on the arrival of each row's frame, if it arrived; as if `without` one of the faults."""
    radio = recorded.scenario.radio
    plan = [planned for planned in recorded.plan if planned is not without]
    start_ns, end_ns, airtime_ns, alone = _queue(recorded, plan)
    latency_ns = radio.latency_ms * NS_PER_MS
    sooner_ns, later_ns = _delays(recorded, plan)
    most_ns = latency_ns + radio.jitter_ms * NS_PER_MS + _rounding_us(recorded.scenario) * 1_000
    earliest_ns = start_ns + airtime_ns + max(latency_ns, 1_000) + sooner_ns - ROUNDING_NS
    return Bounds(earliest_ns, end_ns + most_ns + later_ns + ROUNDING_NS, airtime_ns, alone & (later_ns == 0))


def _rounding_us(scenario: Scenario) -> int:
    """The most by which arrivals are rounded up."""
    return scenario.radio.delivery_tick_us + scenario.run.order_slack_us


def _queue(recorded: RecordedRun, plan: list[PlannedFault]) -> tuple[Array, Array, Array, Mask]:
    """For each row: the earliest start and the latest end of its transmission, its airtime, whether it was alone.

    The sender's queue is monotonic in its access delays: with none of them everything is at its earliest, with the
    longest at its latest. Frames of one instant are taken as one batch, so that their order does not matter. Where
    all share the air, the trace tells when each frame was on it.
    """
    usual_ns = recorded.airtime_ns.astype(float)
    if recorded.shares_air:
        start_ns = recorded.on_air_ns.astype(float)
        return start_ns, start_ns + usual_ns, usual_ns, recorded.arrived
    fast_mbps, slow_mbps = _bitrates(recorded, plan)
    bits = recorded.column("size_bytes") * 8_000
    slowed_ns = [np.maximum(usual_ns, np.rint(bits / mbps)) for mbps in (fast_mbps, slow_mbps)]
    airtimes_ns = [usual_ns, *slowed_ns]
    longest_ns = int(recorded.sent_ns.max(initial=0)) + 1
    key, batch = np.unique(recorded.sender * longest_ns + recorded.sent_ns, return_inverse=True)
    offered = ~received_twice(recorded) & ~recorded.outcome_is("oversize") & ~recorded.dropped_by_sender
    first = recorded.first_rows(offered)
    taken = first[~recorded.outcome_is("queue_full")[first]]
    sums = [np.bincount(batch[taken], weights=air[taken], minlength=len(key)) for air in airtimes_ns]
    sums.append(np.bincount(batch[first], weights=airtimes_ns[0][first], minlength=len(key)))
    sender, sent_ns = np.divmod(key, longest_ns)
    start, end, waits = _courses(recorded, plan, sender, sent_ns, np.column_stack(sums))
    alone = ~waits & (np.bincount(batch[first], minlength=len(key)) == 1)
    return start[batch], end[batch], airtimes_ns[1], alone[batch]


def _courses(
    recorded: RecordedRun, plan: list[PlannedFault], sender: IntArray, sent_ns: IntArray, airtime_ns: Array
) -> tuple[Array, Array, Mask]:
    """Earliest start, latest end and whether it may have waited, of each batch (B,), in order of sender and time.

    `airtime_ns` (B, 4) is of what was sent, at the bitrate of the radio, and at the fastest and the slowest that
    faults leave; and of all that was offered, at that of the radio. A throttled sender has a queue of its own,
    which begins as the plain one stands; afterwards the plain one goes on, as if it had never been slowed.
    """
    delay_ns = recorded.scenario.radio.access_jitter_ms * NS_PER_MS
    start, end, waits = np.zeros(len(sender)), np.zeros(len(sender)), np.zeros(len(sender), dtype=bool)
    episode = _episodes(recorded, plan, sender, sent_ns)
    edges = np.flatnonzero(np.diff(sender, prepend=-1)).tolist()
    for first, last in pairwise([*edges, len(sender)]):
        of = slice(first, last)
        if (episode[of] == NO_EPISODE).all():
            start[of], end[of], waits[of] = _plain_course(sent_ns[of], airtime_ns[of, 0], delay_ns)
        else:
            start[of], end[of], waits[of] = _throttled_course(sent_ns[of], airtime_ns[of], delay_ns, episode[of])
    return start, end, waits


def _plain_course(sent_ns: IntArray, airtime_ns: Array, delay_ns: float) -> tuple[Array, Array, Mask]:
    """As `_courses` of one sender's batches (B,) that no fault throttles: each waits for those before it."""
    before_ns = np.cumsum(airtime_ns) - airtime_ns
    start_ns = before_ns + np.maximum.accumulate(sent_ns - before_ns)
    end_ns = before_ns + airtime_ns + np.maximum.accumulate(sent_ns + delay_ns - before_ns)
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
    for index, (time_ns, number, (usual, fast, slowest, offered)) in enumerate(batches):
        waits[index] = number != NO_EPISODE or plain[1] > time_ns
        if number == NO_EPISODE:
            start[index], end[index] = max(time_ns, plain[0]), max(time_ns + delay_ns, plain[1]) + usual
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
    guard_ns = recorded.guard_ns
    for planned in plan:
        match planned.fault:
            case DelayFault(bounds_ms=(least_ms, most_ms)):
                if least_ms:
                    least += np.where(recorded.reached(planned, -guard_ns), least_ms, 0)
                most += np.where(recorded.reached(planned, guard_ns), most_ms, 0)
            case Custom():
                later = np.where(recorded.reached(planned, guard_ns), LONGEST_DELAY_S * NS_PER_S / NS_PER_MS, 0)
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
