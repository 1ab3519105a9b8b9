"""The latency law: what may pass between sending and arrival, by the radio, the queue and the faults that delay."""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt
from typing import Any

import numpy as np

from emulator.faults.plan import PlannedFault
from emulator.observe.checks.channel import nothing_seen, received_twice
from emulator.observe.checks.evidence import Evidence, Mask, Whole
from emulator.observe.checks.verdicts import Finding, result
from vnet.faults import Delay, Duplicate, Jitter, Reorder, Throttle
from vnet.roads.lanes import Array

NS_PER_MS = 1_000_000
BAND_SIGMAS = 4.9
"""One mean in a million is further off."""
ROUNDING_NS = 2


@dataclass(frozen=True)
class Bounds:
    """For each row: the earliest and latest arrival, the airtime, and whether its frame surely waited for no other.

    Times in nanoseconds; `latest_ns` supposes that every access delay was the longest.
    """

    earliest_ns: Array
    latest_ns: Array
    airtime_ns: Array
    alone: Mask


def bounds(evidence: Evidence, without: PlannedFault | None = None) -> Bounds:
    """When each row's frame may have arrived, if it arrived at all; as if `without` one of the faults."""
    radio = evidence.scenario.radio
    plan = [planned for planned in evidence.plan if planned is not without]
    start_ns, end_ns, airtime_ns, alone = _queue(evidence, plan)
    latency_ns = radio.latency_ms * NS_PER_MS
    sooner_ns, later_ns = _delays(evidence, plan)
    most_ns = latency_ns + radio.jitter_ms * NS_PER_MS + radio.delivery_tick_us * 1_000
    earliest_ns = start_ns + airtime_ns + max(latency_ns, 1_000) + sooner_ns - ROUNDING_NS
    return Bounds(earliest_ns, end_ns + most_ns + later_ns + ROUNDING_NS, airtime_ns, alone & (later_ns == 0))


def _queue(evidence: Evidence, plan: list[PlannedFault]) -> tuple[Array, Array, Array, Mask]:
    """For each row: the earliest start and the latest end of its transmission, its airtime, whether it was alone.

    The sender's queue is monotonic in its access delays: with none of them everything is at its earliest, with the
    longest at its latest. Frames of one instant are taken as one batch, so that their order does not matter.
    """
    radio = evidence.scenario.radio
    sent = ~received_twice(evidence) & ~evidence.outcome_is("queue_full", "oversize")
    bits = evidence.column("size_bytes") * 8_000
    fast_mbps, slow_mbps = _bitrates(evidence, plan)
    fast_ns, slow_ns = np.rint(bits / fast_mbps), np.rint(bits / slow_mbps)
    first = np.unique(evidence.emission[sent], return_index=True)[1]
    first = np.flatnonzero(sent)[first]
    longest_ns = int(evidence.sent_ns.max(initial=0)) + 1
    batch_key, batch = np.unique(evidence.sender * longest_ns + evidence.sent_ns, return_inverse=True)
    batch_sender, batch_sent_ns = np.divmod(batch_key, longest_ns)
    air_fast = np.bincount(batch[first], weights=fast_ns[first], minlength=len(batch_key))
    air_slow = np.bincount(batch[first], weights=slow_ns[first], minlength=len(batch_key))
    size = np.bincount(batch[first], minlength=len(batch_key))
    start, end, waits = np.zeros(len(batch_key)), np.zeros(len(batch_key)), np.zeros(len(batch_key), dtype=bool)
    for sender in np.unique(batch_sender):
        mine = batch_sender == sender
        sent_ns = batch_sent_ns[mine].astype(float)
        earliest_end = _busy_until(sent_ns, air_fast[mine])
        start[mine] = np.maximum(sent_ns, np.concatenate([[0.0], earliest_end[:-1]]))
        end[mine] = _busy_until(sent_ns + radio.access_jitter_ms * NS_PER_MS, air_slow[mine])
        waits[mine] = np.concatenate([[0.0], end[mine][:-1]]) > sent_ns
    alone = ~waits & (size == 1)
    return start[batch], end[batch], fast_ns, alone[batch]


def _busy_until(ready_ns: Array, airtime_ns: Array) -> Array:
    """When each transmission of one sender ends, if it starts when it is ready and the one before has ended."""
    before_ns = np.concatenate([[0.0], np.cumsum(airtime_ns)[:-1]])
    return np.asarray(np.maximum.accumulate(ready_ns - before_ns) + before_ns + airtime_ns)


def _bitrates(evidence: Evidence, plan: list[PlannedFault]) -> tuple[Array, Array]:
    """The fastest and the slowest bitrate that each row's frame may have had."""
    base_mbps = evidence.scenario.radio.bitrate_mbps
    fast, slow = np.full(len(evidence.trace), base_mbps), np.full(len(evidence.trace), base_mbps)
    for planned in plan:
        if isinstance(planned.fault, Throttle):
            chosen, limit_mbps = planned.nodes[evidence.sender], min(base_mbps, planned.fault.bitrate_mbps)
            for rate, widen_ns in ((fast, -evidence.guard_ns), (slow, evidence.guard_ns)):
                when = chosen & evidence.acting(planned, evidence.sent_ns, widen_ns)
                rate[when] = np.minimum(rate[when], limit_mbps)
    return fast, slow


def _delays(evidence: Evidence, plan: list[PlannedFault]) -> tuple[Array, Array]:
    """What faults add to the latency of each row: at least, and at most."""
    least, most = np.zeros(len(evidence.trace)), np.zeros(len(evidence.trace))
    guard_ns = evidence.guard_ns
    for planned in plan:
        match planned.fault:
            case Delay(delay_ms=delay_ms):
                least += np.where(evidence.reached(planned, -guard_ns), delay_ms, 0)
                most += np.where(evidence.reached(planned, guard_ns), delay_ms, 0)
            case Jitter(jitter_ms=jitter_ms):
                most += np.where(evidence.reached(planned, guard_ns), jitter_ms, 0)
            case Reorder(delay_ms=delay_ms):
                most += np.where(evidence.reached(planned, guard_ns), delay_ms, 0)
            case Duplicate(delay_ms=delay_ms, copies=copies):
                mine = (evidence.cause == planned.number) & (evidence.copy > 0)
                least += np.where(mine, delay_ms, 0)
                most += np.where(mine, copies * delay_ms, 0)
    return least * NS_PER_MS, most * NS_PER_MS


def check_latency(evidence: Evidence) -> Finding:
    """What arrives does so after its airtime and latency, and no later than queue, jitter and faults explain."""
    name = "latency"
    timed = evidence.arrived & (evidence.arrival_ns >= 0)
    if not timed.any():
        return nothing_seen(name, evidence, "nothing arrived")
    allowed = bounds(evidence)
    early = timed & (evidence.arrival_ns < allowed.earliest_ns)
    late = timed & (evidence.arrival_ns > allowed.latest_ns)
    broken = int(early.sum() + late.sum())
    figures: dict[str, Any] = {"arrivals": int(timed.sum()), "early": int(early.sum()), "late": int(late.sum())}
    mean = _mean_latency(evidence, allowed, timed)
    figures |= mean
    off = bool(mean) and abs(mean["mean_ms"] - mean["expected_ms"]) > mean["band_ms"]
    text = f"{int(timed.sum()):,} arrivals within their bounds"
    if mean:
        text += f"; mean {mean['mean_ms']:.3f} ms where nothing queues, {mean['expected_ms']:.3f} ms expected"
    broken_text = (
        f"{figures['early']} too early, {figures['late']} too late" if broken else f"{text}: outside its band"
    )
    rows = evidence.rows(early | late if broken else timed & allowed.alone) if broken or off else []
    return result(name, broken + off, text, broken_text, rows, **figures)


def _mean_latency(evidence: Evidence, allowed: Bounds, timed: Mask) -> dict[str, float]:
    """The mean latency of frames that waited for no other, what it should be, and how far off it may be."""
    radio = evidence.scenario.radio
    rows = timed & allowed.alone & (evidence.copy == 0)
    count = int(rows.sum())
    if not count:
        return {}
    mean_ns = float(np.mean((evidence.arrival_ns - evidence.sent_ns)[rows] - allowed.airtime_ns[rows]))
    receivers: Whole = np.unique(evidence.emission[rows], return_counts=True)[1]
    tick_ms = radio.delivery_tick_us / 1_000
    expected_ms = radio.latency_ms + (radio.access_jitter_ms + radio.jitter_ms + tick_ms) / 2
    # The access delay is one draw for all receivers of a frame, the jitter one for each of them.
    variance = radio.access_jitter_ms**2 / 12 * float(np.sum(receivers.astype(float) ** 2)) / count**2
    variance += radio.jitter_ms**2 / 12 / count
    band_ms = BAND_SIGMAS * sqrt(variance) + tick_ms / 2 + 1e-5
    return {"mean_ms": mean_ns / NS_PER_MS, "expected_ms": expected_ms, "band_ms": band_ms, "pairs_alone": count}
