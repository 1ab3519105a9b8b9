"""Frames to single vehicles in a finished run: those of programs are told from what faults send again."""

from pathlib import Path

import pytest

from emulator.records.radio_metrics import unicast_figures
from tests.support.exchange_programs import COPYING, exchange_run

pytestmark = pytest.mark.slow


def test_figures_of_frames_to_one_vehicle_are_what_the_program_was_told(tmp_path: Path) -> None:
    """Also of those that faults have lost or altered, and without those that faults have sent again."""
    lossy = [
        {"kind": "loss", "at_s": 0.4, "duration_s": 0.2, "probability": 1.0, "nodes": ["b"]},
        {"kind": "corrupt", "at_s": 0.0, "duration_s": 0.2, "probability": 1.0},
        {"kind": "StaleMessages", "at_s": 0.6, "duration_s": 0.2, "age_s": 0.05, "nodes": ["a"]},
    ]
    recorded = exchange_run(tmp_path, [*COPYING, *lossy])
    told = [event.details["details"] for event in recorded.event("event")]
    assert len(told) == 80 and {row["cause"] for row in recorded.trace.to_pylist()} >= {"loss-2", "corrupt-3"}
    figures = unicast_figures(recorded)
    assert figures is not None
    assert figures.sent == len(told)
    assert figures.acknowledged == sum(each["delivered"] for each in told)
    assert figures.retries == sum(each["attempts"] - 1 for each in told)
