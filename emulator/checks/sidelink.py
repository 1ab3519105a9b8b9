"""Checks of a sidelink: vehicles share the slots of a resource grid by its rules."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from emulator.checks.channel import received_twice
from emulator.radio.reception import milliwatts
from emulator.radio.sidelink import REPEAT_SLOTS
from emulator.records.recorded_run import ON_AIR, RecordedRun
from emulator.scenario.sidelink import Sidelink

ROUNDING = 1e-6
"""Share of a power within which recomputed and recorded detection may differ."""


def broken_rules(recorded: RecordedRun, mac: Sidelink) -> dict[str, NDArray[np.intp]]:
    """Return the rows of the trace that break a rule of the grid, by rule.

    Transmissions are whole slots, and begin `t1_slots` after their frame at the earliest. No vehicle transmits
    twice in a slot, or receives in one. `half_duplex` are the receptions of those that transmitted, and
    `below_sensing` of those at which a signal is too weak. Frames that nobody is in range of have no rows: of a
    vehicle that nobody heard at some time it is not known when it transmitted.
    """
    on_air = ~received_twice(recorded) & (recorded.on_air_ns >= 0)
    rows = np.flatnonzero(on_air)
    begin_ns, left_ns = recorded.on_air_ns[rows], recorded.column("left_ns")[rows]
    lasts, rest = np.divmod(left_ns - begin_ns, mac.slot_ns)
    most = 1 + REPEAT_SLOTS if mac.retransmit else 1
    unaligned = (begin_ns % mac.slot_ns != 0) | (rest != 0) | (lasts < 1) | (lasts > most)
    earliest_ns = (recorded.sent_ns[rows] // mac.slot_ns + mac.t1_slots) * mac.slot_ns
    frames = recorded.first_rows(on_air)
    node, slot = _occupied(recorded, mac, frames)
    count, slots = len(recorded.node_ids), _slots(recorded, mac, rows)
    key, times = np.unique(slot * count + node, return_counts=True)
    deaf = np.logical_and.reduce([np.isin(each * count + recorded.receiver[rows], key) for each in slots])
    twice = [np.isin(each * count + recorded.sender[rows], key[times > 1]) for each in slots]
    outcome_deaf = recorded.outcome_is("half_duplex")[rows]
    seen = recorded.places.always_in_range[recorded.receiver[rows]]
    judged = recorded.outcome_is(*ON_AIR)[rows]
    return {
        "unaligned": rows[unaligned],
        "too_soon": rows[begin_ns < earliest_ns],
        "twice": rows[np.logical_or.reduce(twice)],
        "heard_while_sending": rows[judged & deaf & ~outcome_deaf],
        "deaf_without_sending": rows[outcome_deaf & ~deaf & seen],
        "wrongly_detected": _wrongly_detected(recorded, mac, rows[judged & ~outcome_deaf]),
    }


def _slots(recorded: RecordedRun, mac: Sidelink, rows: NDArray[np.intp]) -> list[NDArray[np.int64]]:
    """Return the slots in which the frames of these rows were first and last transmitted."""
    first = recorded.on_air_ns[rows] // mac.slot_ns
    return [first, recorded.column("left_ns")[rows] // mac.slot_ns - 1] if mac.retransmit else [first]


def _occupied(
    recorded: RecordedRun, mac: Sidelink, frames: NDArray[np.intp]
) -> tuple[NDArray[np.intp], NDArray[np.int64]]:
    """Return the nodes and the slots of all transmissions of frames, each once."""
    slots = _slots(recorded, mac, frames)
    again = slots[-1] != slots[0]
    sender = recorded.sender[frames]
    return np.append(sender, sender[again]), np.append(slots[0], slots[-1][again])


def _wrongly_detected(recorded: RecordedRun, mac: Sidelink, rows: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return the rows that were detected with too little power, or not detected with enough.

    Fading differs from frame to frame: with it the power is not known.
    """
    if recorded.scenario.radio.fading is not None:
        return np.zeros(0, np.intp)
    rows = rows[recorded.placed[rows]]
    power_mw = recorded.places.pair_powers_mw(
        recorded.sender[rows], recorded.receiver[rows], recorded.sent_ns[rows]
    )
    power_mw *= 10 ** (recorded.gain_db[rows] / 10)
    least_mw = milliwatts(mac.sensing_dbm)
    weak = recorded.outcome_is("below_sensing")[rows]
    lacks = weak & (power_mw > least_mw * (1 + ROUNDING))
    return np.asarray(rows[lacks | (~weak & (power_mw < least_mw * (1 - ROUNDING)))])
