"""Checks of cooperating vehicles' estimates: they agree, they recover, and none diverges."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from emulator.checks.channel import admitted_by_cap
from emulator.records.divergence import DIVERGENT_M, DIVERGENT_S, first_divergences
from emulator.records.recorded_run import RecordedRun
from emulator.records.verdicts import NO_FAULTS, Finding, NotExercised, result, unknown
from emulator.scenario.fault_families import GnssFault
from emulator.world.graph import components_of_links
from vnet.counted import counted
from vnet.types import Array, Mask
from vnet.units import NS_PER_S

MEAN_TOLERANCE_M = 1.0
AT_REST_S = 5.0
"""Time after the start, or the last fault, that the consensus has to settle."""
WITHIN_S = 10.0
BACK_FACTOR, BACK_LEAST_M = 2.0, 0.3
LEVEL_PERIODS = 20


def ups(recorded: RecordedRun) -> Mask:
    """Return the nodes that were up throughout each period (periods, N)."""
    up = np.ones((recorded.periods, len(recorded.node_ids)), dtype=bool)
    start_ns = recorded.period_starts_ns()
    for span in recorded.down:
        up[(span.start_ns < start_ns + recorded.scenario.period_ns) & (span.end_ns > start_ns), span.node] = False
    return up


def _components(recorded: RecordedRun, among: Mask, time_ns: int) -> list[Mask]:
    """The connected components by links in both directions among some nodes (N,), of two nodes or more."""
    pairs = admitted_by_cap(recorded, among, time_ns)
    both = pairs.contain(pairs.receiver, pairs.sender)
    label = components_of_links(pairs.sender[both], pairs.receiver[both], pairs.count)
    parts = [np.asarray((label == number) & among) for number in range(int(label.max(initial=-1)) + 1)]
    return [part for part in parts if part.sum() > 1]


def check_consensus_mean(recorded: RecordedRun) -> Finding:
    """Check that at the end each vehicle's mean is near the mean of its component's estimates."""
    name = "consensus_mean"
    mean_m, common_m = recorded.vectors("mean_m"), recorded.vectors("common_error_estimate_m")
    if not np.isfinite(mean_m).any():
        return NotExercised(name, "the program reports no mean")
    rested_s = (recorded.closed_ns - recorded.last_heal_ns) / NS_PER_S
    if rested_s < AT_REST_S:
        return NotExercised(name, f"{rested_s:.1f} s at rest; {AT_REST_S:g} s are needed")
    off_m = _off_the_mean(recorded, mean_m, common_m)
    judged = int(np.isfinite(off_m).sum())
    if not judged:
        return NotExercised(
            name, "no component in which all vehicles run the scenario's program, are up and report a mean"
        )
    worst_m = float(np.nanmax(off_m))
    off = [
        {"node": recorded.node_ids[node], "off_m": float(off_m[node])}
        for node in np.flatnonzero(off_m > MEAN_TOLERANCE_M).tolist()
    ]
    figures = {"vehicles": judged, "worst_m": worst_m, "tolerance_m": MEAN_TOLERANCE_M}
    text = f"means of {counted(judged, 'vehicle')} within {worst_m:.2f} m of their component's"
    broken_text = (
        f"means of {len(off)} of {counted(judged, 'vehicle')} over {MEAN_TOLERANCE_M:g} m off their component's"
    )
    if off and rested_s < WITHIN_S:
        return unknown(name, f"{broken_text}, {rested_s:.1f} s at rest; {WITHIN_S:g} s are allowed", **figures)
    return result(name, len(off), text, broken_text, off, **figures)


def _off_the_mean(recorded: RecordedRun, mean_m: Array, common_m: Array) -> Array:
    """Distance (N,) of each vehicle's mean from its component's over the last second; NaN where unknown."""
    last = slice(-max(1, NS_PER_S // recorded.scenario.period_ns), None)
    up: Mask = np.asarray(ups(recorded)[last].all(axis=0))
    known = np.isfinite(common_m[last]).all(axis=(0, 2)) & np.isfinite(mean_m[last]).all(axis=(0, 2))
    off_m = np.full(len(up), np.nan)
    for part in _components(recorded, up, int(recorded.period_starts_ns()[-1])):
        if (recorded.runs_the_program & known)[part].all():
            centre = common_m[last, part].mean(axis=1)[:, None]
            off_m[part] = np.hypot(*np.median(mean_m[last, part] - centre, axis=0).T)
    return off_m


def check_convergence(recorded: RecordedRun) -> Finding:
    """Check that after every heal the vehicles agree again in time, nearly as well as before the first fault."""
    name = "convergence"
    common_m = recorded.vectors("common_error_estimate_m")
    if not recorded.plan:
        return NotExercised(name, NO_FAULTS)
    if not np.isfinite(common_m).any():
        return NotExercised(name, "the program reports no common error")
    deviation_m = _deviation(recorded, common_m)
    start_ns = recorded.period_starts_ns()
    first_ns = min(planned.start_ns for planned in recorded.plan)
    before = deviation_m[start_ns + recorded.scenario.period_ns <= first_ns][-LEVEL_PERIODS:]
    level_m = float(np.nanmedian(before)) if np.isfinite(before).any() else np.nan
    limit_m = max(BACK_FACTOR * level_m, BACK_LEAST_M) if np.isfinite(level_m) else BACK_LEAST_M
    late, recoveries, cut = [], [], 0
    for heal_ns, until_ns in _rests(recorded):
        window = (start_ns >= heal_ns) & (start_ns < until_ns) & np.isfinite(deviation_m)
        back = np.flatnonzero(window & (deviation_m <= limit_m))
        if len(back):
            recoveries.append(float(start_ns[back[0]] - heal_ns) / NS_PER_S)
        elif window.any():
            best_m = float(deviation_m[window].min())
            late.append({"heal_s": heal_ns / NS_PER_S, "until_s": until_ns / NS_PER_S, "deviation_m": best_m})
            cut += until_ns - heal_ns < round(WITHIN_S * NS_PER_S)
    if not late and not recoveries:
        return NotExercised(name, "no time without faults after a heal")
    figures = {"level_m": level_m if np.isfinite(level_m) else None, "limit_m": limit_m, "recovered_s": recoveries}
    text = f"agreement within {limit_m:.2f} m again, {max(recoveries, default=0):.1f} s after a fault at most"
    broken_text = f"no agreement within {limit_m:.2f} m after {len(late)} heals"
    if late and cut == len(late):
        return unknown(name, f"{broken_text}, but the run was over before {WITHIN_S:g} s had passed", **figures)
    return result(name, len(late), text, broken_text, late, **figures)


def _deviation(recorded: RecordedRun, common_m: Array) -> Array:
    """(periods,), the deviation of the vehicles' estimates from their component's mean, of the worst component."""
    worst = np.full(len(common_m), np.nan)
    up = ups(recorded)
    everybody = np.ones(len(recorded.node_ids), dtype=bool)
    period_ns = recorded.scenario.period_ns
    # Where vehicles move, each period has its own components, among the vehicles in the network.
    changes = recorded.topology_changes
    pieces = [slice(k, k + 1) for k in range(len(common_m))] if changes else [slice(None)]
    for piece in pieces:
        among = up[piece.start] if recorded.moves else everybody
        for part in _components(recorded, among, (piece.start or 0) * period_ns):
            values = np.where((up[piece] & part & recorded.runs_the_program)[..., None], common_m[piece], np.nan)
            known = np.isfinite(values).all(axis=2)
            several = known.sum(axis=1) > 1
            mean = np.nansum(values, axis=1) / np.maximum(known.sum(axis=1), 1)[:, None]
            squares = np.nansum(np.sum((values - mean[:, None]) ** 2, axis=2) * 1.0, axis=1)
            deviation = np.sqrt(squares / np.maximum(known.sum(axis=1), 1))
            worst[piece][several] = np.fmax(worst[piece][several], deviation[several])
    return worst


def _rests(recorded: RecordedRun) -> Sequence[tuple[int, int]]:
    """The times in which the network should recover: from the end of all faults, WITHIN_S long.

    A time that the next fault cuts short is not judged.
    """
    period_ns = recorded.scenario.period_ns
    end_ns = len(recorded.period_starts_ns()) * period_ns
    rests = []
    for heal_ns in sorted({planned.end_ns for planned in recorded.plan if planned.end_ns < end_ns}):
        if any(planned.acts_at(heal_ns) for planned in recorded.plan):
            continue
        until_ns = heal_ns + round(WITHIN_S * NS_PER_S)
        if all(not heal_ns <= planned.start_ns < until_ns for planned in recorded.plan):
            rests.append((heal_ns, min(until_ns, end_ns)))
    return rests


def check_bounded_error(recorded: RecordedRun) -> Finding:
    """Check that no vehicle diverges (MODEL 6) that is up, runs the scenario's program and has a good receiver."""
    name = "bounded_error"
    common_m = recorded.vectors("common_error_estimate_m")
    if not np.isfinite(common_m).any():
        return NotExercised(name, "the program reports no common error")
    error_m = np.hypot(*np.moveaxis(common_m - recorded.vectors("common_error_m"), 2, 0))
    judged = np.isfinite(error_m) & ups(recorded) & recorded.runs_the_program & ~_deceived(recorded)
    diverged = first_divergences(np.where(judged, error_m, np.nan), recorded.scenario.period_ns)
    rows = [
        {"node": recorded.node_ids[node], "period": period, "error_m": float(error_m[period, node])}
        for node, period in diverged.items()
    ]
    worst = float(error_m[judged].max(initial=0))
    text = f"no common error over {DIVERGENT_M:g} m for {DIVERGENT_S:g} s; {worst:.1f} m at most"
    broken_text = (
        f"{counted(len(rows), 'vehicle')} with a common error over {DIVERGENT_M:g} m for {DIVERGENT_S:g} s"
    )
    return result(name, len(rows), text, broken_text, rows, worst_m=worst, lost=len(rows))


def _deceived(recorded: RecordedRun) -> Mask:
    """Vehicles (periods, N) on whose receiver a fault acts, and for WITHIN_S afterwards."""
    deceived = np.zeros((recorded.periods, len(recorded.node_ids)), dtype=bool)
    for planned in recorded.plan:
        if isinstance(planned.fault, GnssFault):
            start_ns = recorded.period_starts_ns()
            when = (planned.start_ns <= start_ns) & (start_ns < planned.end_ns + round(WITHIN_S * NS_PER_S))
            # Where it follows a region, every vehicle that has been within it.
            deceived |= when[:, None] & (np.logical_or.accumulate(recorded.struck(planned)) | planned.nodes)
    return deceived
