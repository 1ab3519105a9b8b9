"""Checks of cooperating vehicles' estimates: they agree, they recover, and none diverges."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from vnet.errors import counted
from vnet.types import Array, Mask
from vnet.units import NS_PER_S

MEAN_TOLERANCE_M = 1.0
"""Distance of a mean from its component's, where the vehicle does not state more, as with receivers of 30 m."""
LAG_PERIODS = 3
"""Periods by which a mean is behind its component's: a frame is heard a period later, and sums take hops."""
AT_REST_S = 5.0
"""Time after the start, or the last fault, that the consensus has to settle."""
WITHIN_S = 10.0
WITHIN_PERIODS = 50
"""Rounds of consensus within which means agree, where these take more than `WITHIN_S`."""
BACK_FACTOR, BACK_LEAST_M = 2.0, 0.3
LEVEL_PERIODS = 20
DIVERGENT_M, DIVERGENT_S = 10.0, 5.0
"""Common error above which a vehicle diverges, and the time for which it has to stay above it (MODEL 6)."""
DIVERGENT_DEVIATIONS = 3.0
"""Deviations that it states, above which as well: along its road c is as uncertain as before the first fix."""
NO_COMMON_ERROR = "the program reports no common error"

Result = tuple[str, str, str] | tuple[str, str, str, dict[str, Any]]


def _result(name: str, rows: list[dict[str, Any]], text: str, broken_text: str, **figures: Any) -> Result:
    """Return a result that is invalid where there are offending rows."""
    return (name, "invalid", broken_text, figures | {"rows": rows}) if rows else (name, "valid", text, figures)


def _parts(run: Any, time_ns: int, among: Mask) -> list[Mask]:
    """Return the connected components of two vehicles or more among some."""
    label = run.components(time_ns / NS_PER_S, among)
    parts = [np.asarray((label == number) & among) for number in range(int(label.max(initial=-1)) + 1)]
    return [part for part in parts if part.sum() > 1]


def check_consensus_mean(run: Any) -> Result:
    """Check that at the end each vehicle's mean is near the mean of its component's estimates."""
    name = "consensus_mean"
    mean_m, common_m = run.column("mean_m"), run.column("common_error_estimate_m")
    if not np.isfinite(mean_m).any():
        return name, "not applicable", "the program reports no mean"
    if run.rested_s < AT_REST_S:
        return name, "not applicable", f"{run.rested_s:.1f} s at rest; {AT_REST_S:g} s are needed"
    off_m, moved_m = _off_the_mean(run, mean_m, common_m)
    judged = int(np.isfinite(off_m).sum())
    if not judged:
        text = "no component in which all vehicles run the scenario's program, are up and report a mean"
        return name, "not applicable", text
    worst_m = float(np.nanmax(off_m))
    tolerance_m = np.fmax(MEAN_TOLERANCE_M, _stated_m(run)[-1]) + moved_m
    over = np.flatnonzero(off_m > tolerance_m).tolist()
    off = [{"node": run.nodes[node], "off_m": float(off_m[node])} for node in over]
    figures = {"vehicles": judged, "worst_m": worst_m, "tolerance_m": MEAN_TOLERANCE_M}
    means = counted(judged, "vehicle")
    broken_text = (
        f"means of {len(off)} of {means} over {MEAN_TOLERANCE_M:g} m, and more than stated, off their component's"
    )
    within_s = max(WITHIN_S, WITHIN_PERIODS * run.scenario.period_ns / NS_PER_S)
    if off and run.rested_s < within_s:
        return name, "unknown", f"{broken_text}, {run.rested_s:.1f} s at rest; {within_s:g} s are allowed", figures
    text = f"means of {means} within {worst_m:.2f} m of their component's"
    return _result(name, off, text, broken_text, **figures)


def _stated_m(run: Any) -> Array:
    """Deviations (periods, N) of the common error that vehicles state; NaN where they state none."""
    covariance_m2 = run.column("common_error_covariance_m2")
    return np.asarray(np.sqrt(covariance_m2[..., 0] + covariance_m2[..., 3]))


def _off_the_mean(run: Any, mean_m: Array, common_m: Array) -> tuple[Array, Array]:
    """Distance (N,) of each vehicle's mean from its component's over the last second; NaN where unknown.

    And the way (N,) of that one within the last `LAG_PERIODS`.
    """
    period_ns = run.scenario.period_ns
    last = slice(-max(1, NS_PER_S // period_ns), None)
    up: Mask = np.asarray(run.up_throughout[last].all(axis=0))
    known = np.isfinite(common_m[last]).all(axis=(0, 2)) & np.isfinite(mean_m[last]).all(axis=(0, 2))
    off_m, moved_m = np.full((2, len(up)), np.nan)
    for part in _parts(run, (len(common_m) - 1) * period_ns, up):
        if (run.runs_the_program & known)[part].all():
            centre = common_m[last, part].mean(axis=1)[:, None]
            off_m[part] = np.hypot(*np.median(mean_m[last, part] - centre, axis=0).T)
            before = common_m[-1 - LAG_PERIODS :, part].mean(axis=1)
            moved_m[part] = np.nanmax(np.hypot(*(before - before[-1]).T))
    return off_m, moved_m


def check_convergence(run: Any) -> Result:
    """Check that after every heal the vehicles agree again in time, nearly as well as before the first fault."""
    name = "convergence"
    common_m = run.column("common_error_estimate_m")
    if not run.faults:
        return name, "not applicable", "the scenario has no faults"
    if not np.isfinite(common_m).any():
        return name, "not applicable", NO_COMMON_ERROR
    deviation_m = _deviation(run, common_m)
    period_ns = run.scenario.period_ns
    start_ns = np.arange(len(common_m)) * period_ns
    first_ns = min(fault.start_ns for fault in run.faults)
    before = deviation_m[start_ns + period_ns <= first_ns][-LEVEL_PERIODS:]
    level_m = float(np.nanmedian(before)) if np.isfinite(before).any() else np.nan
    limit_m = max(BACK_FACTOR * level_m, BACK_LEAST_M) if np.isfinite(level_m) else BACK_LEAST_M
    late, recoveries, cut = [], [], 0
    for heal_ns, until_ns in _rests(run, len(common_m) * period_ns):
        window = (start_ns >= heal_ns) & (start_ns < until_ns) & np.isfinite(deviation_m)
        back = np.flatnonzero(window & (deviation_m <= limit_m))
        if len(back):
            recoveries.append(float(start_ns[back[0]] - heal_ns) / NS_PER_S)
        elif window.any():
            best_m = float(deviation_m[window].min())
            late.append({"heal_s": heal_ns / NS_PER_S, "until_s": until_ns / NS_PER_S, "deviation_m": best_m})
            cut += until_ns - heal_ns < round(WITHIN_S * NS_PER_S)
    if not late and not recoveries:
        return name, "not applicable", "no time without faults after a heal"
    figures = {"level_m": level_m if np.isfinite(level_m) else None, "limit_m": limit_m, "recovered_s": recoveries}
    text = f"agreement within {limit_m:.2f} m again, {max(recoveries, default=0):.1f} s after a fault at most"
    broken_text = f"no agreement within {limit_m:.2f} m after {len(late)} heals"
    if late and cut == len(late):
        return name, "unknown", f"{broken_text}, but the run was over before {WITHIN_S:g} s had passed", figures
    return _result(name, late, text, broken_text, **figures)


def _deviation(run: Any, common_m: Array) -> Array:
    """(periods,), the deviation of the vehicles' estimates from their component's mean, of the worst component."""
    worst = np.full(len(common_m), np.nan)
    up, moves = run.up_throughout, run.scenario.network.moves
    everybody = np.ones(len(run.nodes), dtype=bool)
    # Where vehicles move, each period has its own components, among the vehicles in the network.
    pieces = [slice(k, k + 1) for k in range(len(common_m))] if run.links_change else [slice(None)]
    for piece in pieces:
        among = up[piece.start] if moves else everybody
        for part in _parts(run, (piece.start or 0) * run.scenario.period_ns, among):
            values = np.where((up[piece] & part & run.runs_the_program)[..., None], common_m[piece], np.nan)
            known = np.isfinite(values).all(axis=2)
            several = known.sum(axis=1) > 1
            mean = np.nansum(values, axis=1) / np.maximum(known.sum(axis=1), 1)[:, None]
            squares = np.nansum(np.sum((values - mean[:, None]) ** 2, axis=2) * 1.0, axis=1)
            deviation = np.sqrt(squares / np.maximum(known.sum(axis=1), 1))
            worst[piece][several] = np.fmax(worst[piece][several], deviation[several])
    return worst


def _rests(run: Any, end_ns: int) -> Sequence[tuple[int, int]]:
    """The times in which the network should recover: from the end of all faults, WITHIN_S long.

    A time that the next fault cuts short is not judged.
    """
    rests = []
    for heal_ns in sorted({fault.end_ns for fault in run.faults if fault.end_ns < end_ns}):
        if any(fault.start_ns <= heal_ns < fault.end_ns for fault in run.faults):
            continue
        until_ns = heal_ns + round(WITHIN_S * NS_PER_S)
        if all(not heal_ns <= fault.start_ns < until_ns for fault in run.faults):
            rests.append((heal_ns, min(until_ns, end_ns)))
    return rests


def check_bounded_error(run: Any) -> Result:
    """Check that no vehicle diverges that is up, runs the scenario's program and has a good receiver."""
    name = "bounded_error"
    common_m = run.column("common_error_estimate_m")
    if not np.isfinite(common_m).any():
        return name, "not applicable", NO_COMMON_ERROR
    error_m = np.hypot(*np.moveaxis(common_m - run.column("common_error_m"), 2, 0))
    judged = np.isfinite(error_m) & run.up_throughout & run.runs_the_program & ~run.misled(WITHIN_S)
    limit_m = np.fmax(DIVERGENT_M, DIVERGENT_DEVIATIONS * _stated_m(run))
    diverged = run.first_lasting(judged & (error_m > limit_m), DIVERGENT_S)
    rows = [
        {"node": run.nodes[node], "period": period, "error_m": float(error_m[period, node])}
        for node, period in diverged.items()
    ]
    worst_m = float(error_m[judged].max(initial=0))
    limit = f"over {DIVERGENT_M:g} m and {DIVERGENT_DEVIATIONS:g} stated deviations for {DIVERGENT_S:g} s"
    text = f"no common error {limit}; {worst_m:.1f} m at most"
    broken_text = f"{counted(len(rows), 'vehicle')} with a common error {limit}"
    return _result(name, rows, text, broken_text, worst_m=worst_m, lost=len(rows))
