"""GNSS time by a clock that is wrong."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import pytest

from agents.cooperative.program import CLOCK_FIXES, GnssClock
from vnet import Fix

MS = 1_000_000


@dataclass
class Wristwatch:
    """A node that is nothing but its clock."""

    now_ns: int = 0


def clock_after(node: Wristwatch, fixes: list[tuple[int, int]]) -> GnssClock:
    """A clock that has met fixes: the GNSS time of each, and the node's time when it came."""
    clock = GnssClock(cast("Any", node))
    for fix_ns, now_ns in fixes:
        node.now_ns = now_ns
        clock.set_by(Fix(fix_ns, np.zeros(2), np.eye(2), None))
    return clock


@pytest.mark.parametrize("ahead_ns", [0, 5_000 * MS, -70 * MS])
def test_a_clock_that_is_wrong_is_corrected_by_the_promptest_fix(ahead_ns: int) -> None:
    """Fixes come 3, 0 and 8 ms late; the least late one shows the clock's error."""
    node = Wristwatch()
    delays = (3 * MS, 0, 8 * MS)
    clock = clock_after(node, [(k * 100 * MS, k * 100 * MS + ahead_ns + late) for k, late in enumerate(delays)])
    assert clock.now_ns == 208 * MS
    node.now_ns += 10 * MS
    assert clock.now_ns == 218 * MS


def test_after_a_jump_ahead_the_old_error_counts_for_so_many_fixes() -> None:
    node, jump_ns = Wristwatch(), 1000 * MS
    fixes = [(k * 100 * MS, k * 100 * MS + (jump_ns if k >= 5 else 0)) for k in range(5 + CLOCK_FIXES)]
    assert clock_after(node, fixes[:-1]).now_ns == fixes[-2][0] + jump_ns
    assert clock_after(node, fixes).now_ns == fixes[-1][0]


def test_sleeping_ends_at_gnss_time_and_is_left_out_if_that_is_past(monkeypatch: pytest.MonkeyPatch) -> None:
    slept_s = []

    async def sleep(seconds: float) -> None:
        slept_s.append(seconds)

    clock = clock_after(Wristwatch(), [(100 * MS, 150 * MS)])
    monkeypatch.setattr(asyncio, "sleep", sleep)
    asyncio.run(clock.sleep_until(130 * MS))
    asyncio.run(clock.sleep_until(100 * MS))
    assert slept_s == [pytest.approx(0.03)]
