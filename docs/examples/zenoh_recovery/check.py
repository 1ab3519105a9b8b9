"""A check of recovery.py: all hear every number of an advanced publisher. docs/how-to/zenoh-recovery.md."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from emulator import Result, Run


def check(run: Run) -> Iterator[Result]:
    """Judge whether recovery has brought back all that the radio has lost."""
    published, heard = run.reported("published"), run.reported("heard_kept")
    reporting = np.isfinite(published).any(axis=0)
    if not reporting.all():
        yield Result("all_recovered", "unknown", "not every vehicle has come to its report")
        return
    own = np.nanmax(published, axis=0)
    missing = own.sum() - own - np.nanmax(heard, axis=0)
    rows = [{"node": run.nodes[number], "lost": int(missing[number])} for number in np.flatnonzero(missing > 0)]
    text = f"{int(missing.sum())} numbers of others are lost for good"
    yield Result("all_recovered", "invalid" if rows else "valid", text, {"rows": rows})
