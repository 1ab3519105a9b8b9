"""A check of forwarding.py: warnings reach those who are connected to the source. docs/how-to/worked-example.md."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator

from scipy.sparse.csgraph import breadth_first_order

from emulator import Result, Run

WITHIN_MS = 500.0
"""Longest delay: a driver at 50 km/h goes 7 m in this time."""
LEAST_SHARE = 0.95
"""Share of the connected vehicles that a warning must reach in time: broadcasts are not acknowledged."""


def check(run: Run) -> Iterator[Result]:
    """Judge whether each warning reaches enough of the vehicles that are connected to its source in time."""
    sent: dict[int, tuple[float, str]] = {}
    in_time: dict[int, set[str]] = defaultdict(set)
    for event in run.events:
        if event.kind == "event" and event.node:
            details = event.values
            if event.name == "warned":
                sent[details["number"]] = event.time_ns / 1e9, event.node
            elif event.name == "informed" and details["delay_ms"] <= WITHIN_MS:
                in_time[details["number"]].add(event.node)
    # A warning that was sent so late that the run ended before WITHIN_MS were over is not judged.
    end_s = run.times_s[-1] + run.period_s
    shares = {
        number: len(in_time[number] & connected) / len(connected)
        for number, (time_s, source) in sent.items()
        if time_s + WITHIN_MS / 1e3 <= end_s and (connected := connected_to(run, source, time_s))
    }
    if not shares:
        yield Result("informed_in_time", "unknown", "no warning was sent to anybody")
        return
    failed = {number: share for number, share in shares.items() if share < LEAST_SHARE}
    worst = min(shares, key=lambda number: (shares[number], number))
    text = f"{len(failed)} of {len(shares)} warnings reached less than {LEAST_SHARE:.0%} of the connected vehicles"
    if not failed:
        text = f"each of {len(shares)} warnings reached {LEAST_SHARE:.0%} or more of the connected vehicles"
    rows = [{"warning": number, "informed": f"{share:.1%}"} for number, share in failed.items()]
    figures = {"least_share": shares[worst], "worst": worst, "rows": rows}
    yield Result(
        "informed_in_time",
        "invalid" if failed else "valid",
        f"{text} within {WITHIN_MS:.0f} ms; the least {shares[worst]:.1%}",
        figures,
    )


def connected_to(run: Run, source: str, time_s: float) -> set[str]:
    """Return the ids of the vehicles that are up and connected to `source` over any hops, at a time in s."""
    up = run.up(time_s)
    links = run.in_range(time_s) & up & up[:, None]
    index = run.index(source)
    reached = breadth_first_order(links, index, return_predecessors=False)
    return {run.nodes[i] for i in reached if i != index}
