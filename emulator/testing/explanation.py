"""Comparison of a failure of a campaign with a run that passes: where the two part for the first time.

The failing run, shrunk, is compared with the run that is most like it and passes: the same in FIFO order, else
without faults, else with the seed of the nearest run of the campaign that has passed, else that run itself.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from emulator.records.parting import Parting, before, partings
from emulator.records.recorded_run import OpenedRun, RecordedRun
from emulator.scenario.loading import dump_scenario
from emulator.scenario.scenario import Scenario
from emulator.testing.campaign_plan import with_seed
from emulator.testing.shrinking import with_faults, with_tape
from emulator.testing.trial import TrialPool
from vnet.errors import VnetError, printable
from vnet.units import NS_PER_S

PARTING_FILE = "parting.txt"
LONGEST = 300
"""Characters of what a run has at a parting."""


@dataclass(frozen=True)
class Explanation:
    """Differences of a failing run and one that passes; or the reason why it was compared with none."""

    passing: str = ""
    """The run that passes, as a phrase; "" if there is none."""
    partings: tuple[Parting, ...] = ()
    """The first difference of each kind, the earliest first; `first` is of the run that passes."""
    until: tuple[str, ...] = ()
    """Lines on what had happened to the vehicle of the first difference, in the run that fails."""
    why_not: str = ""
    """Reason why there is nothing to tell; "" if there is."""

    def line(self) -> str:
        """Return the first difference in one line."""
        if self.why_not:
            return f"was not compared: {self.why_not}"
        if not self.partings:
            return f"agrees with {self.passing} in all that is recorded"
        first = self.partings[0]
        return (
            f"parts from {self.passing} at {_seconds(first.time_ns)} s by the {first.kind} of {first.node}: "
            f"{_shown(first, first.second)}; there: {_shown(first, first.first)}"
        )

    def rows(self) -> list[dict[str, str]]:
        """Return a row for each kind of difference, the earliest first, as tables show them."""
        return [
            {
                "time (s)": _seconds(each.time_ns),
                "first": each.kind,
                "vehicle": each.node,
                "in the run that passes": _shown(each, each.first),
                "in this run": _shown(each, each.second),
            }
            for each in self.partings
        ]

    def text(self) -> str:
        """Return the contents of `parting.txt`."""
        lines = [self.line()]
        for row in self.rows():
            lines += ["", f"first {row['first']} that differs: {row['vehicle']}, at {row['time (s)']} s"]
            lines += [f"  {name}: {row[name]}" for name in ("in the run that passes", "in this run")]
        if self.until:
            lines += ["", f"{self.partings[0].node} until then, in this run:"]
            lines += [f"  {printable(line, LONGEST)}" for line in self.until]
        return "\n".join(lines) + "\n"

    def as_json(self) -> dict[str, Any]:
        """Return the explanation's part of campaign.json."""
        if self.why_not:
            return {"why_not": self.why_not}
        return {"passing": self.passing, "differences": self.rows()}


def _seconds(time_ns: int) -> str:
    return f"{time_ns / NS_PER_S:.6f}"


def _shown(parting: Parting, text: str) -> str:
    nothing = "FIFO order" if parting.kind == "decision" else "nothing"
    return printable(text.removeprefix(f"{parting.node}: "), LONGEST) or nothing


def explain(failing: Scenario, folder: Path, passed: Scenario | None, pool: TrialPool) -> Explanation:
    """Compare the run in `folder`, of the scenario `failing`, with the first candidate that passes.

    `passed` is another run of the campaign that has passed, if there is one. At most four runs are made, which
    leave nothing; none begins later than the pool's time limit after the first.
    """
    try:
        run = RecordedRun.open(folder)
        _ = run.trace
    except VnetError:
        return Explanation(why_not="the run did not come to its end, and has no trace")
    until_s = time.monotonic() + pool.limit_s
    tried = []
    for name, scenario in _candidates(failing, passed):
        if pool.closed or time.monotonic() > until_s:
            return Explanation(why_not="no time was left for it")
        tried.append(name)
        with tempfile.TemporaryDirectory(prefix="vnet-passing-") as place:
            trial = pool.run(scenario, Path(place) / "run")
            if trial.verdicts and not trial.failed:
                return _compared(name, RecordedRun.open(Path(place) / "run"), run)
    none = "no run of the campaign has passed" if passed is None else "none of these passes"
    return Explanation(why_not=f"{none}{': ' if tried else ''}{', '.join(tried)}{' fails too' if tried else ''}")


def _compared(name: str, passing: OpenedRun, failing: OpenedRun) -> Explanation:
    try:
        found = tuple(partings(passing, failing))
        told = before(failing.trace, failing.events, found[0].node, found[0].time_ns) if found else ()
    except VnetError as error:
        return Explanation(why_not=str(error))
    return Explanation(name, found, tuple(told))


def _candidates(failing: Scenario, passed: Scenario | None) -> Iterator[tuple[str, Scenario]]:
    """Yield the runs that may pass, the one most like the failing run first, each with its name."""
    if failing.run.order != "fifo" or failing.run.tape is not None:
        yield "the same run in FIFO order", with_tape(failing, ())
    if failing.fault:
        yield "the same run without faults", with_faults(failing, ())
    if passed is None:
        return
    seed = passed.run.seed
    with suppress(VnetError):  # its faults may name vehicles or links that this seed's network has not got
        like_it = with_seed(failing, seed)
        if dump_scenario(like_it) != dump_scenario(passed):
            yield f"the same run with seed {seed}", like_it
    yield f"the campaign's run with seed {seed}", passed
