"""Checks of the faults: they did what they say while they acted, nothing else, and at their rates."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from math import log, sqrt
from typing import Any

import numpy as np

from emulator.checks.channel import binomial_band, received_twice
from emulator.faults.plan import PlannedFault
from emulator.records.recorded_run import NO_FAULT, ON_AIR, UNHEARD_OF, Evidence
from emulator.records.verdicts import MOST_ROWS, NO_FAULTS, Finding, NotExercised, result, unknown
from emulator.scenario.faults import BurstLoss, Corrupt, Loss, StaleMessages
from vnet.types import Array, Mask

CUTTING = ("partition", "block", "range", "swizzle")
LOSING = ("loss", "burst_loss")
SENDING = ("DataReplay", "StaleMessages", "DoS", "Sybil")
RATE_BAND = 1 - 1e-6
RATE_SIGMAS = 4.9
"""As wide as RATE_BAND: a run may have dozens of faults, and each has a check."""


def of_kinds(evidence: Evidence, kinds: Iterable[str]) -> list[PlannedFault]:
    """The planned faults of these kinds that had begun when the run ended."""
    named = set(kinds)
    begun = [planned for planned in evidence.plan if planned.start_ns < evidence.closed_ns]
    return [planned for planned in begun if planned.fault.kind in named]


def check_causes(evidence: Evidence) -> Finding:
    """A row names a fault exactly where one acted that can do this, on this link and at this time."""
    name = "causes"
    if not evidence.plan:
        broken = evidence.outcome_is("fault") | (evidence.cause != NO_FAULT)
        if not broken.any():
            return NotExercised(name, NO_FAULTS)
    else:
        explained = evidence.cause == NO_FAULT
        for planned in evidence.plan:
            mine = evidence.cause == planned.number
            explained |= mine & evidence.reached(planned, evidence.guard_ns) & _may(evidence, planned)
        broken = ~explained | (evidence.outcome_is("fault") & (evidence.cause == NO_FAULT))
        broken |= evidence.cause == UNHEARD_OF
    count, named = int(broken.sum()), int((evidence.cause != NO_FAULT).sum())
    text = f"{named:,} pairs name a fault that acted on them"
    broken_text = f"{count} pairs name no fault that acted on them"
    return result(name, count, text, broken_text, evidence.rows(broken), named=named, wrong=count)


def _may(evidence: Evidence, planned: PlannedFault) -> Mask:
    """The rows of which a fault of this kind can be the cause."""
    match planned.fault:
        case fault if fault.kind in (*CUTTING, *LOSING):
            return evidence.outcome_is("fault")
        case Corrupt():
            return evidence.arrived
        case StaleMessages():
            return np.asarray((evidence.copy == 0) & ~evidence.outcome_is("fault"))
        case fault if fault.kind == "duplicate":
            return np.asarray((evidence.copy > 0) & evidence.arrived)
        case _:
            return np.asarray((evidence.copy > 0) & ~evidence.outcome_is("fault"))


def check_partition_respected(evidence: Evidence) -> Finding:
    """Nothing that was sent across a cut (partition, block, range, swizzle) while it acted went on."""
    name = "partition_respected"
    cuts = of_kinds(evidence, CUTTING)
    if not cuts:
        return NotExercised(name, "no fault cuts links" if evidence.plan else NO_FAULTS)
    across = np.zeros(len(evidence.trace), dtype=bool)
    for planned in cuts:
        across |= evidence.reached(planned, -evidence.guard_ns)
    if not across.any():
        return unknown(name, "no frame was sent across a cut")
    passed = across & evidence.outcome_is(*ON_AIR)
    count = int(passed.sum())
    text = f"{int(across.sum()):,} pairs across a cut, and nothing passed"
    broken_text = f"{count} of {int(across.sum()):,} pairs passed a cut"
    return result(name, count, text, broken_text, evidence.rows(passed), across=int(across.sum()), passed=count)


def check_down_respected(evidence: Evidence) -> Finding:
    """A node that is down is silent and deaf: no frame, no report, and what arrives is `receiver_down`."""
    name = "down_respected"
    if not evidence.down:
        return NotExercised(name, "no node was down" if evidence.plan else NO_FAULTS)
    sure = ~evidence.is_unsure(evidence.sent_ns)
    speaking = sure & evidence.is_down(evidence.sender, evidence.sent_ns)
    judged = evidence.arrived & ~evidence.is_unsure(evidence.arrival_ns)
    if evidence.closed_ns < evidence.scenario.duration_ns:  # what was in flight then was decided at once
        judged &= evidence.arrival_ns < evidence.closed_ns
    deaf = evidence.is_down(evidence.receiver, evidence.arrival_ns)
    hearing = judged & deaf & evidence.outcome_is("delivered")
    missing = judged & ~deaf & evidence.outcome_is("receiver_down")
    # A node may report and end by itself at one instant; a fault acts before anything else does.
    spans = [(span.node, span.start_ns + (not span.planned), span.end_ns) for span in evidence.down]
    reports = _reports_within(evidence, spans)
    wrong = speaking | hearing | missing
    broken = int(wrong.sum()) + len(reports)
    figures = {"spoke": int(speaking.sum()), "heard": int(hearing.sum()), "missed": int(missing.sum())}
    return result(
        name,
        broken,
        f"{len({span.node for span in evidence.down})} nodes were down, and silent and deaf",
        f"{broken} frames, arrivals or reports do not fit who was down",
        evidence.rows(wrong) + reports,
        **figures,
        reports=len(reports),
    )


def check_pause_respected(evidence: Evidence) -> Finding:
    """A node that stands still sends nothing and reports nothing."""
    name = "pause_respected"
    pauses = of_kinds(evidence, ["pause"])
    if not pauses:
        return NotExercised(name, "no node was paused" if evidence.plan else NO_FAULTS)
    speaking = np.zeros(len(evidence.trace), dtype=bool)
    spans = []
    for planned in pauses:
        still = evidence.acting(planned, evidence.sent_ns, -evidence.guard_ns)
        speaking |= planned.nodes[evidence.sender] & still
        spans += [(node, planned.start_ns, planned.end_ns) for node in np.flatnonzero(planned.nodes).tolist()]
    reports = _reports_within(evidence, spans)
    broken = int(speaking.sum()) + len(reports)
    broken_text = f"{int(speaking.sum())} frames and {len(reports)} reports of nodes that stood still"
    text = f"{len({span[0] for span in spans})} nodes stood still and were silent"
    rows = evidence.rows(speaking) + reports
    return result(name, broken, text, broken_text, rows, spoke=int(speaking.sum()), reports=len(reports))


def _reports_within(evidence: Evidence, spans: Iterable[tuple[int, int, int]]) -> list[dict[str, Any]]:
    """Reports in periods that lie wholly within one of these spans (node, start, end) of its node."""
    start_ns = evidence.period_starts_ns()
    end_ns = start_ns + evidence.scenario.period_ns
    guard_ns = evidence.guard_ns
    reports = []
    for node, from_ns, to_ns in spans:
        within = (start_ns >= from_ns + guard_ns) & (end_ns <= to_ns) & evidence.reported[:, node]
        for period in np.flatnonzero(within).tolist():
            reports.append(
                {"node": evidence.node_ids[node], "period": period, "reported_until_ns": int(end_ns[period])}
            )
    return reports


def check_outage_respected(evidence: Evidence) -> Finding:
    """A receiver has no fix exactly while an outage acts on it."""
    name = "outage_respected"
    outages = of_kinds(evidence, ["gnss_outage"])
    there = np.isfinite(evidence.vectors("position_m")[..., 0])
    without = there & np.isnan(evidence.vectors("fix_m")[..., 0])
    if not outages and not without.any():
        return NotExercised(name, "no fault takes the fixes" if evidence.plan else NO_FAULTS)
    due = np.zeros_like(without)
    for planned in outages:
        due |= evidence.struck(planned) & there
    period, node = np.nonzero(due != without)
    rows = [
        {"node": evidence.node_ids[n], "period": p, "fix": "none" if without[p, n] else "given"}
        for p, n in zip(period.tolist()[:MOST_ROWS], node.tolist(), strict=False)
    ]
    count = len(period)
    text = f"{int(due.sum())} fixes withheld, and no others"
    return result(name, count, text, f"{count} fixes given in an outage, or withheld without", rows, wrong=count)


def check_fault_loss(evidence: Evidence) -> Iterator[Finding]:
    """Each fault that loses pairs by chance does so at its rate."""
    for planned in of_kinds(evidence, LOSING):
        yield _loss_of(evidence, planned)


def _loss_of(evidence: Evidence, planned: PlannedFault) -> Finding:
    name = f"loss_rate:{planned.label}"
    hit = evidence.cause == planned.number
    drawing = _drew_for(evidence, planned)
    drawn, lost = int(drawing.sum()), int((hit & drawing).sum())
    if not drawn:
        return unknown(name, "no pair came as far as this fault", pairs=0)
    if isinstance(planned.fault, BurstLoss):
        expected, low, high = _burst_band(evidence, planned.fault, planned, drawing)
    else:
        assert isinstance(planned.fault, Loss)
        expected = planned.fault.probability
        low, high = binomial_band(drawn, expected, RATE_BAND)
    figures = {"lost": lost, "pairs": drawn, "rate": lost / drawn, "expected": expected, "low": low, "high": high}
    text = f"{lost:,} of {drawn:,} pairs lost, {lost / drawn:.2%}; {expected:.2%} expected"
    outside = not low <= lost <= high
    rows = evidence.rows(drawing & (hit if lost > high else ~hit)) if outside else []
    return result(name, int(outside), text, f"{text}: outside its band", rows, **figures)


def _drew_for(evidence: Evidence, planned: PlannedFault) -> Mask:
    """Pairs that came as far as a fault of chance: cut by none, and lost to none of those before it."""
    reached = evidence.reached(planned, -evidence.guard_ns) & ~received_twice(evidence)
    later = [other.number for other in of_kinds(evidence, LOSING) if other.number >= planned.number]
    further = evidence.outcome_is(*ON_AIR) | (evidence.outcome_is("fault") & np.isin(evidence.cause, later))
    return np.asarray(reached & further)


def _burst_band(
    evidence: Evidence, fault: BurstLoss, planned: PlannedFault, drawing: Mask
) -> tuple[float, float, float]:
    """Expected rate, and least and most losses, of a two-state chain a link that starts good (Gilbert, Elliott).

    Losses of a link are correlated over 1 / (1 - λ) frames, λ = 1 - enter - leave, which widens the band.
    """
    memory = 1 - fault.enter - fault.leave
    mostly_bad = fault.enter / (fault.enter + fault.leave)
    bad = mostly_bad * (1 - memory ** _steps(evidence, planned)[drawing])
    rate: Array = fault.loss_good + (fault.loss_bad - fault.loss_good) * bad
    mean = float(rate.sum())
    frames_a_link = max(1.0, len(np.unique(evidence.emission[drawing])))
    length = min(1 / (1 - memory), frames_a_link) if memory < 1 else frames_a_link
    stretch = max(1.0, 2 * length - 1)
    variance = float(np.sum(rate * (1 - rate))) * stretch
    away = RATE_SIGMAS * sqrt(variance) + stretch * log(1e6) / 3 if 0 < mean < len(rate) else 0.5
    return mean / len(rate), max(0.0, mean - away), min(float(len(rate)), mean + away)


def _steps(evidence: Evidence, planned: PlannedFault) -> Array:
    """How many frames each row's sender had sent since a fault began, the row's included."""
    while_acting = evidence.acting(planned, evidence.sent_ns, evidence.guard_ns) & ~received_twice(evidence)
    first = np.flatnonzero(while_acting)[np.unique(evidence.emission[while_acting], return_index=True)[1]]
    first = first[np.lexsort((evidence.emission[first], evidence.sent_ns[first], evidence.sender[first]))]
    sender = evidence.sender[first]
    place = np.arange(len(first)) - np.searchsorted(sender, sender) + 1
    order = np.argsort(evidence.emission[first])
    steps = np.zeros(len(evidence.trace))
    where = np.searchsorted(evidence.emission[first][order], evidence.emission[while_acting])
    steps[while_acting] = place[order][where]
    return steps
