"""Exchanges: a frame to one vehicle and its retries, told from those of copies that faults send."""

from __future__ import annotations

import numpy as np

from emulator.records.recorded_run import RecordedRun
from vnet.types import Mask


def sent_by_programs(recorded: RecordedRun) -> Mask:
    """Return the mask of the rows of frames that programs sent, each attempt included.

    What faults send again, its retries, and duplicates of a reception are left out. A retry is a copy as those are;
    but a sender ends one exchange before it begins another of the same frame.
    """
    mask: Mask = np.asarray(recorded.copy == 0)
    if not recorded.attempt.any():
        return mask
    rows = np.flatnonzero((recorded.attempt > 0) & (recorded.on_air_ns >= 0))
    frame, on_air_ns = recorded.frame[rows], recorded.on_air_ns[rows]
    order = np.lexsort((recorded.copy[rows], on_air_ns, frame))
    twice = (np.diff(frame[order]) == 0) & (np.diff(on_air_ns[order]) == 0)
    rows = rows[order[np.append(True, ~twice)[: len(order)]]]
    first = np.flatnonzero(recorded.attempt[rows] == 1)
    exchange = np.searchsorted(first, np.arange(len(rows)), side="right") - 1
    known = exchange >= 0
    mask[rows[known]] = recorded.copy[rows[first]][exchange[known]] == 0
    return mask
