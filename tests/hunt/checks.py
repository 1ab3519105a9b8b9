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
CALM_S = 0.8
"""Length in s of the end of a run, in which a ring that has healed has one token."""
MOST_FRAMES = 3
"""Frames of a vehicle at one instant: after a pause, what is left of a period, and the next."""


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


def warned_once(run: Run) -> Iterator[Result]:
    """Judge whether no driver is warned twice of the same hazard, but by a program that has restarted."""
    warned: set[tuple[str | None, int]] = set()
    rows: list[dict[str, Any]] = []
    for event in run.events:
        if event.kind == "restarted":
            warned = {(node, number) for node, number in warned if node != event.node}
        elif event.kind == "event":
            key = event.node, event.details["details"]["number"]
            if key in warned:
                rows.append({"node": event.node, "number": key[1], "time_s": event.time_ns / NS_PER_S})
            warned.add(key)
    yield _result("warned_once", rows, f"{len(warned)} warnings, each shown once", "warnings shown again")


def one_token(run: Run) -> Iterator[Result]:
    """Judge whether at the end of the run one vehicle has the token, at most."""
    calm = run.times_s >= run.scenario.run.duration_s - CALM_S
    several = (run.reported("holds") == 1).sum(axis=1) > 1
    rows: list[dict[str, Any]] = [{"time_s": float(time_s)} for time_s in run.times_s[calm & several]]
    yield _result("one_token", rows, "one token at most", "periods with several tokens")


def reckons_without_fixes(run: Run) -> Iterator[Result]:
    """Judge whether a vehicle that has just got a fix does not reckon."""
    rows = _rows(run, run.reported("reckons") == 1)
    yield _result("reckons_without_fixes", rows, "fixes end reckoning", "periods reckoned in spite of a fix")


def each_fix_once(run: Run) -> Iterator[Result]:
    """Judge whether no vehicle has rejected a second frame with the same fix."""
    rows = _rows(run, run.reported("rejected.duplicate") >= 1)
    yield _result("each_fix_once", rows, "each fix sent once", "reports of a fix sent twice")


def few_at_once(run: Run) -> Iterator[Result]:
    """Judge whether no vehicle sends a burst of frames at one instant."""
    columns = [run.trace[name].to_pylist() for name in ("sender", "sent_ns", "seq")]
    frames = set(zip(*columns, strict=True))
    bursts = Counter((sender, sent_ns) for sender, sent_ns, _ in frames)
    rows = [
        {"sender": sender, "time_s": sent_ns / NS_PER_S, "frames": count}
        for (sender, sent_ns), count in sorted(bursts.items())
        if count > MOST_FRAMES
    ]
    yield _result(
        "few_at_once", rows, f"at most {max(bursts.values(), default=0)} frames at once", "bursts of frames"
    )


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
