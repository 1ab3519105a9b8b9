"""A check of hazard.py: everybody in range of the source is warned within 500 ms. docs/checks.md."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from emulator import Result, Run

WITHIN_S = 0.5


def check(run: Run) -> Iterator[Result]:
    """Judge whether everybody in range of the source is warned in time."""
    source = run.scenario.program.options.get("source", run.nodes[0])
    warned = run.reported("warned") >= 1  # (periods, vehicles); False where nothing was reported
    if not warned[:, run.index(source)].any():
        yield Result("warned_in_time", "unknown", f"{source} never warned")
        return
    begins_s = run.times_s[warned[:, run.index(source)].argmax()]
    delay_s = np.where(warned.any(axis=0), run.times_s[warned.argmax(axis=0)] - begins_s, np.inf)
    expected = run.in_range(begins_s)[run.index(source)]
    if not expected.any():
        yield Result("warned_in_time", "not applicable", f"nobody is in range of {source}")
        return
    late = np.flatnonzero(expected & (delay_s > WITHIN_S + 1e-9))
    if len(late):
        text = f"{len(late)} of {expected.sum()} in range of {source} not warned within {WITHIN_S} s"
        yield Result("warned_in_time", "invalid", text, {"rows": [{"node": run.nodes[i]} for i in late]})
    else:
        slowest_s = float(delay_s[expected].max())
        text = f"all {expected.sum()} in range of {source} warned within {slowest_s:.1f} s"
        yield Result("warned_in_time", "valid", text, {"slowest_s": slowest_s})
