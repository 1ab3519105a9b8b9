"""One simulated run in a process of its own, with a time limit: whatever the run does, its campaign goes on."""

from __future__ import annotations

import faulthandler
import multiprocessing
import os
import signal
import time
import traceback
from collections.abc import Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
import pyarrow.compute as pc

from emulator.checks.judge import Verdict
from emulator.drivers.conclude import conclude
from emulator.drivers.emulation import Emulation
from emulator.drivers.simulate import simulate
from emulator.records.run_folder import PROGRAMS_LOG, RunFolder
from emulator.scenario.scenario import Scenario
from emulator.world.world import build_world

GREATEST = 1e6
"""No number that a vehicle reports grows beyond it: metres, and their squares, of vehicles in one town."""
HUNG, EMULATOR, GROWTH = "hung", "emulator", "growth"
PRELOADED = (
    "emulator.testing.campaign",
    "emulator.cli.experiment",
    "emulator.drivers.live",
    "emulator.terminal.progress",
)
POLL_S = 0.1
STDOUT = 1
"""Descriptor of standard output."""
STACKS_AT = 0.9
"""At this share of its time limit a trial writes down where it stands."""


@dataclass(frozen=True)
class Trial:
    """Result of a run: the verdict of each check, and the texts of those that failed."""

    verdicts: dict[str, Verdict]
    texts: dict[str, str]
    trace_sha256: str = ""
    wall_s: float = 0.0

    @property
    def failed(self) -> list[str]:
        """The checks that are invalid."""
        return [name for name, verdict in self.verdicts.items() if verdict is Verdict.INVALID]

    @classmethod
    def failure(cls, name: str, text: str) -> Trial:
        """A run that did not come as far as its checks."""
        return cls({name: Verdict.INVALID}, {name: text})


UNKNOWN = Trial({}, {})
"""Result of a run that was given up."""


def run_trial(scenario: Scenario, folder: RunFolder) -> Trial:
    """Simulate and judge a run in this process. Raises VnetError if it cannot be run."""
    started = time.monotonic()
    emulation = Emulation(scenario, build_world(scenario), folder)
    wall_s, _ = simulate(emulation)
    judgement, _ = conclude(emulation, wall_s, "simulate")
    verdicts = {check.name: check.verdict for check in judgement.checks}
    texts = {check.name: check.text for check in judgement.checks if check.verdict is not Verdict.VALID}
    greatest = _greatest(emulation)
    verdicts[GROWTH] = Verdict.INVALID if greatest > GREATEST else Verdict.VALID
    if greatest > GREATEST:
        texts[GROWTH] = f"a report holds {greatest:.3g}"
    return Trial(verdicts, texts, judgement.trace_sha256, time.monotonic() - started)


def _greatest(emulation: Emulation) -> float:
    """The greatest number of all positions, common errors and covariances that were reported."""
    states = emulation.metrics.states_table()
    names = ("estimate_m", "covariance_m2", "common_error_estimate_m", "common_error_covariance_m2", "mean_m")
    columns = [pc.list_flatten(states[name]).to_numpy() for name in names]
    numbers = np.concatenate([np.asarray(column, dtype=float) for column in columns])
    return float(np.max(np.abs(numbers), initial=0.0, where=np.isfinite(numbers)))


@dataclass
class TrialPool:
    """Runs trials in processes of their own, forked from a server that has imported everything, `limit_s` each.

    May be used from several threads at once. `close` ends all that are left.
    """

    limit_s: float
    modules: Sequence[str] = ()
    closed: bool = field(default=False, init=False)

    def __post_init__(self) -> None:
        self._context = multiprocessing.get_context("forkserver")
        # All that the main module imports, which each process does anew, but not that itself.
        self._context.set_forkserver_preload([*PRELOADED, *self.modules])

    def run(self, scenario: Scenario, folder: Path) -> Trial:
        """A trial; one that hangs, or ends its process, has failed. Once closed: one that nothing is known of."""
        if self.closed:
            return UNKNOWN
        receiver, sender = self._context.Pipe(duplex=False)
        arguments = (scenario, folder, sender, self.limit_s)
        process = self._context.Process(target=_apart, args=arguments, daemon=True)
        process.start()
        sender.close()
        try:
            return self._await(receiver)
        except EOFError:
            process.join()
            if self.closed:
                return UNKNOWN
            return Trial.failure(EMULATOR, f"the process ended with status {process.exitcode}")
        finally:
            process.kill()
            process.join()
            receiver.close()

    def _await(self, receiver: Connection) -> Trial:
        deadline = time.monotonic() + self.limit_s
        while not receiver.poll(POLL_S):
            if self.closed:
                return UNKNOWN
            if time.monotonic() > deadline:
                text = f"not over within {self.limit_s:g} s of wall clock; logs/stacks.txt says where it stood"
                return Trial.failure(HUNG, text)
        trial = receiver.recv()
        assert isinstance(trial, Trial)
        return trial

    def close(self) -> None:
        """Have every trial that is on given up."""
        self.closed = True


def _apart(scenario: Scenario, folder: Path, sender: Connection, limit_s: float) -> None:
    """The process of a trial."""
    for number in (signal.SIGINT, signal.SIGTERM):  # they are the campaign's, which kills this process if it must
        signal.signal(number, signal.SIG_IGN)
    run_folder = RunFolder.create(folder, scenario)
    with (run_folder.logs / PROGRAMS_LOG).open("ab") as log:
        os.dup2(log.fileno(), STDOUT)
    with (run_folder.logs / "stacks.txt").open("w") as stacks:
        faulthandler.dump_traceback_later(STACKS_AT * limit_s, file=stacks)
        try:
            trial = run_trial(scenario, run_folder)
        except BaseException as error:
            traceback.print_exc(file=stacks)
            trial = Trial.failure(EMULATOR, f"{type(error).__name__}: {error}")
        faulthandler.cancel_dump_traceback_later()
    sender.send(trial)
