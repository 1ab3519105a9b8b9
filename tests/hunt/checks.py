"""Checks of what the programs with planted bugs promise. Transients within one instant are no failures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import Any

import numpy as np

from emulator import Result, Run
from vnet.types import Mask
from vnet.units import NS_PER_S

MOST_ABSENT = 5
"""Periods for which a permit may be neither free nor used: it is passed on within an instant."""


def shown(run: Run) -> Iterator[Result]:
    """Judge whether each warning that a vehicle received was shown to its driver at once."""
    received, seen = _events(run, "received"), _events(run, "shown")
    missing = sorted((received - seen).elements())
    rows = [{"node": node, "number": number, "time_s": time_ns / NS_PER_S} for node, number, time_ns in missing]
    yield _result("shown", rows, f"all {received.total()} received warnings shown", "received warnings not shown")


def _events(run: Run, name: str) -> Counter[tuple[str, int, int]]:
    """Count events of this name by node, number and time."""
    named = (e for e in run.events if e.kind == "event" and e.details["name"] == name)
    return Counter((str(e.node), e.details["details"]["number"], e.time_ns) for e in named)


def followers_give_no_orders(run: Run) -> Iterator[Result]:
    """Judge whether a vehicle that follows has given no order since its last report, in which it followed too."""
    follows: Mask = run.reported("leads") == 0
    orders = run.reported("orders")
    rows = _rows(run, follows[1:] & follows[:-1] & (orders[1:] > orders[:-1]))
    yield _result(
        "followers_give_no_orders", rows, "only leaders give orders", "periods in which followers gave orders"
    )


def permit_is_kept(run: Run) -> Iterator[Result]:
    """Judge whether the permit of the crossing is always free or used."""
    absent = (run.reported("free") + run.reported("inside")) != 1
    absent &= ~np.isnan(run.reported("free"))
    windows = np.lib.stride_tricks.sliding_window_view(absent, MOST_ABSENT + 1, axis=0)
    long: Mask = np.logical_and.reduce(windows, axis=-1)
    yield _result("permit_is_kept", _rows(run, long), "the permit is free or used", "periods without the permit")


def one_session(run: Run) -> Iterator[Result]:
    """Judge whether no vehicle opens a session while it has one."""
    is_open: dict[str | None, bool] = {}
    rows: list[dict[str, Any]] = []
    for event in run.events:
        if event.kind == "restarted":
            is_open[event.node] = False
        elif event.kind == "event":
            opens = event.details["name"] == "opened"
            if opens and is_open.get(event.node):
                rows.append({"node": event.node, "time_s": event.time_ns / NS_PER_S})
            is_open[event.node] = opens
    yield _result("one_session", rows, "one session at a time", "sessions opened beside another")


def _rows(run: Run, bad: Mask) -> list[dict[str, Any]]:
    """Rows for the last periods and vehicles of a mask (periods, vehicles), which may begin later than the run."""
    offset = len(run.times_s) - len(bad)
    return [
        {"node": run.nodes[vehicle], "time_s": float(run.times_s[offset + period])}
        for period, vehicle in np.argwhere(bad).tolist()
    ]


def _result(name: str, rows: list[dict[str, Any]], text: str, broken: str) -> Result:
    if rows:
        return Result(name, "invalid", f"{len(rows)} {broken}", {"rows": rows})
    return Result(name, "valid", text)
