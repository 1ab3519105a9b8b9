"""`vnet demo`: the run that shows what vnet is, without a file to begin with."""

from __future__ import annotations

from emulator.cli.options import DurationOption, OutOption
from emulator.cli.runs import run
from emulator.scenario.loading import find_scenario


def demo(duration: DurationOption = None, out: OutOption = None) -> None:
    """Run the shipped scenario quickstart: 38 vehicles with a process each, recorded for Rerun.

    It is `vnet run quickstart --rerun save`.
    """
    run(find_scenario("quickstart"), duration=duration, out=out, rerun=["save"])
