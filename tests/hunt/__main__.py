"""Look for the planted bugs with and without other orders and faults: `make hunt`, or `python -m tests.hunt`.

Prints in how many of so many runs each bug shows, with 95 % intervals (Wilson 1927), as a table in Markdown. Ends
with status 1 if no mode shows one of them.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from concurrent.futures import ThreadPoolExecutor

from scipy.stats import binomtest

from emulator.testing.campaign_plan import NONE, Plan
from emulator.testing.scenarios import make_scenario
from emulator.testing.trial import TrialPool
from tests.hunt.bugs import BUGS, FAULTS, Bug

ORDERS = ("fifo", "shuffle", "pct")
MODES = [(order, faulty) for faulty in (False, True) for order in ORDERS]
LIMIT_S = 60.0
"""Seconds that a run may take."""


def plan_of(bug: Bug, order: str, faulty: bool, runs: int) -> Plan:
    """Return the runs of a bug in one mode: with seeds, orders and faults as a campaign draws them."""
    scenario = make_scenario(bug.scenario(), {"run.order": order})
    return Plan.of(scenario, FAULTS if faulty else NONE, runs, 1)


def failures(bug: Bug, order: str, faulty: bool, runs: int, pool: TrialPool, threads: ThreadPoolExecutor) -> int:
    """Return how many runs of a mode show the bug."""
    plan = plan_of(bug, order, faulty, runs)
    trials = threads.map(pool.run_anywhere, [plan.draw(number) for number in range(runs)])
    return sum(bug.judged_by in trial.failed for trial in trials)


def shown(count: int, runs: int) -> str:
    """Return a share with its interval, in per cent."""
    interval = binomtest(count, runs).proportion_ci(0.95, method="wilson")
    return f"{100 * count / runs:.0f} ({100 * interval.low:.0f}–{100 * interval.high:.0f})"


def hunt(runs: int, jobs: int) -> bool:
    """Print the table; returns whether all bugs were found."""
    heads = [f"{order}{' + faults' if faulty else ''}" for order, faulty in MODES]
    print(f"| bug | {' | '.join(heads)} |")
    print(f"|---|{'---|' * len(heads)}")
    missed = []
    pool = TrialPool(LIMIT_S, BUGS[0].scenario())
    with ThreadPoolExecutor(jobs) as threads:
        for bug in BUGS:
            counts = [failures(bug, order, faulty, runs, pool, threads) for order, faulty in MODES]
            print(f"| {bug.name} | {' | '.join(shown(count, runs) for count in counts)} |", flush=True)
            if not any(counts):
                missed.append(bug.name)
    pool.close()
    print(f"\nPer cent of the runs in each mode; not found: {', '.join(missed) or 'none'}")
    return not missed


def main() -> int:
    """Read the options, and hunt."""
    parser = argparse.ArgumentParser(prog="python -m tests.hunt", description=__doc__)
    parser.add_argument("--runs", type=int, default=40, help="runs of each bug in each mode")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="runs at once")
    options = parser.parse_args()
    started_s = time.monotonic()
    found = hunt(options.runs, options.jobs)
    print(f"{time.monotonic() - started_s:.0f} s", file=sys.stderr)
    return 0 if found else 1


if __name__ == "__main__":
    sys.exit(main())
