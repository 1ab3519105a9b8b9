"""Figures of the frames that programs have sent to single vehicles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from emulator.records.exchanges import sent_by_programs
from emulator.records.recorded_run import RecordedRun


@dataclass(frozen=True)
class UnicastFigures:
    """Frames to single vehicles: sent, acknowledged, and transmissions beyond the first of each."""

    sent: int
    acknowledged: int
    retries: int

    def __str__(self) -> str:
        """Return the figures in one line."""
        share = f"{self.acknowledged / self.sent:.2%}"
        return f"{self.sent:,} sent, {self.acknowledged:,} acknowledged: {share}; {self.retries:,} retries"


def unicast_figures(recorded: RecordedRun) -> UnicastFigures | None:
    """Return the figures of a run without what faults send again; None without frames to single vehicles."""
    rows = np.flatnonzero((recorded.attempt > 0) & sent_by_programs(recorded))
    if not len(rows):
        return None
    frame = recorded.frame[rows]
    return UnicastFigures(
        sent=len(np.unique(frame)),
        acknowledged=len(np.unique(frame[recorded.acked[rows]])),
        retries=int((recorded.attempt[rows] > 1).sum()),
    )
