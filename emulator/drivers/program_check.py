"""Check that the programs of a run can be imported, before its folder is made and its processes are started.

They are imported in a process of its own, in the environment of an agent, while the emulator prepares the run: the
emulator itself never runs the code of a live run's programs.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from emulator.drivers.launch import Exit
from emulator.drivers.zygote import AGENT_ENVIRONMENT
from emulator.records.code_digest import entries_of
from emulator.scenario.scenario import Scenario
from vnet.errors import ProgramError
from vnet.runtime.environment import SAME_ARITHMETIC
from vnet.runtime.own_packages import foreign_on_path

_LONGEST_REASON = 1 << 16
"""Bytes of a reason, which fit into a pipe."""


class ProgramCheck:
    """One process that imports the programs of `scenario`; made by `program_check`."""

    def __init__(self, scenario: Scenario) -> None:
        self._entries = entries_of(scenario)
        self._limit_s = scenario.run.join_timeout_s
        self._reason, write_end = os.pipe()
        folders = [word for folder in scenario.program.folders for word in ("--path", str(folder))]
        arguments = ["-P", "-m", "agents.program_check", str(write_end), *folders, *self._entries]
        try:
            self._process = subprocess.Popen(
                [sys.executable, *arguments],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                pass_fds=[write_end],
                process_group=0,  # Ctrl-C in the terminal is the emulator's
                env={**SAME_ARITHMETIC, **os.environ, **AGENT_ENVIRONMENT},
            )
        finally:
            os.close(write_end)

    def wait(self) -> None:
        """Wait for its end. Raises ProgramError if a program cannot be loaded."""
        entries = ", ".join(map(repr, self._entries))
        try:
            status = self._process.wait(self._limit_s)
        except subprocess.TimeoutExpired:
            raise ProgramError(
                f"program.entry = {entries}: not imported within run.join_timeout_s = {self._limit_s:g}"
            ) from None
        if status == 0:
            return
        if foreign := foreign_on_path("agents"):
            raise ProgramError(foreign)
        os.set_blocking(self._reason, False)
        reason = os.read(self._reason, _LONGEST_REASON).decode() if status == 2 else ""
        raise ProgramError(
            reason or f"program.entry = {entries}: importing it ended the process ({Exit(status, '').how})"
        )

    def close(self) -> None:
        """End the process if it is still there."""
        self._process.kill()
        self._process.wait()
        os.close(self._reason)


@contextmanager
def program_check(scenario: Scenario) -> Iterator[ProgramCheck]:
    """Import the programs in the background; `wait` within the block says whether they can be loaded."""
    check = ProgramCheck(scenario)
    try:
        yield check
    finally:
        check.close()
