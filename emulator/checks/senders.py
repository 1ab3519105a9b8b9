"""Checks of faults within a vehicle: the copies of misbehaving senders, and the fixes of GNSS receivers."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from emulator.checks.channel import received_twice
from emulator.faults.plan import PlannedFault
from emulator.records.distributions import chi2_cdf, chi2_sf
from emulator.records.recorded_run import RecordedRun
from emulator.records.verdicts import NO_FAULTS, Finding, not_exercised, result, unknown
from emulator.scenario.faults import CustomSender, DataReplay, DoS, GnssFault, Sybil
from emulator.world.gnss import further_error_m
from vnet.counted import counted
from vnet.types import Array, IntArray, Mask
from vnet.units import NS_PER_S

Rows = NDArray[np.intp]

CERTAIN = 1e-6
"""Probability below which a sum of fixes is not that of a receiver without faults."""


def check_copies(recorded: RecordedRun) -> Finding:
    """Check that floods and Sybils send each frame as often as configured, and replays one of the right age."""
    if not any(isinstance(planned.fault, DoS | Sybil | DataReplay) for planned in recorded.plan):
        return not_exercised("no fault sends frames again" if recorded.plan else NO_FAULTS)
    once = ~received_twice(recorded) & (recorded.attempt < 2)  # what is transmitted again is the MAC's
    first = recorded.first_rows(once & ~_near_a_change(recorded) & ~_sent_by_rule(recorded))
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


def _sent_by_rule(recorded: RecordedRun) -> Mask:
    """Rows of frames in whose place a rule of the user's own may have sent others, as often as it liked."""
    ruled = np.zeros(len(recorded.trace), dtype=bool)
    for planned in recorded.plan:
        if isinstance(planned.fault, CustomSender):
            ruled |= recorded.reached(planned, recorded.guard_ns)
    return ruled


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
    """Late copies that are not of the last frame old enough for a replay that acted on the sender."""
    frame_ns = dict(_of(recorded, originals))
    sent_ns = {
        sender: np.sort(recorded.sent_ns[originals[recorded.sender[originals] == sender]])
        for sender in np.unique(recorded.sender[late]).tolist()
    }
    replays = [planned for planned in recorded.plan if isinstance(planned.fault, DataReplay)]
    wrong = []
    for row, (frame, time_ns) in zip(late.tolist(), _of(recorded, late), strict=True):
        sender = int(recorded.sender[row])
        acting = [planned for planned in replays if planned.nodes[sender] and planned.acts_at(time_ns)]
        if frame_ns.get(frame) not in [_last_before(sent_ns[sender], time_ns, planned) for planned in acting]:
            wrong.append(row)
    return wrong


def _last_before(sent_ns: IntArray, time_ns: int, planned: PlannedFault) -> int | None:
    """Time at which the last frame was sent that is old enough for a replay, in ns."""
    assert isinstance(planned.fault, DataReplay)
    index = int(np.searchsorted(sent_ns, time_ns - round(planned.fault.age_s * NS_PER_S), side="right"))
    return int(sent_ns[index - 1]) if index else None


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
