"""A run that goes on up to the horizon that it is given: on a thread of its own, simulated or live, in lockstep.

Whoever steps it may look at its emulation, and plan faults, while it is held.
"""

from __future__ import annotations

import asyncio
import threading
from abc import ABC, abstractmethod
from concurrent.futures import Future
from queue import SimpleQueue

from emulator.drivers.attachment import LiveOptions
from emulator.drivers.emulation import Emulation
from emulator.drivers.live import run_live
from emulator.drivers.lockstep import Lockstep
from emulator.drivers.simulate import simulate


class SteppedRun(ABC):
    """See the module's text. Use: `start`, then `go` again and again until it is `over`; wait for each future."""

    command: str
    """The vnet command that runs the same."""

    def __init__(self, emulation: Emulation) -> None:
        self.emulation = emulation
        self.over = False
        self.stands: Future[None] = Future()
        self._thread = threading.Thread(target=self._run, name=f"vnet {self.command}", daemon=True)

    @property
    def started(self) -> bool:
        """Return whether `start` was called."""
        return self._thread.ident is not None

    def start(self) -> Future[None]:
        """Get ready for time 0. The future, here and in `go`, is done when the run is held or over."""
        self._thread.start()
        return self.stands

    def go(self, horizon_ns: int | None) -> Future[None]:
        """Do all that happens before `horizon_ns`, or all to the end."""
        assert self.stands.done() and not self.over
        self.stands = Future()
        self._order(horizon_ns)
        return self.stands

    @abstractmethod
    def _order(self, horizon_ns: int | None) -> None:
        """Pass the next horizon to the run's thread."""

    @abstractmethod
    def _drive(self) -> None:
        """Run to the end, waiting at each horizon (on the run's thread)."""

    def _run(self) -> None:
        try:
            self._drive()
        except BaseException as error:
            self.over = True
            self.stands.set_exception(error)
        else:
            self.over = True
            self.stands.set_result(None)


class SimulatedRun(SteppedRun):
    """A run in this process."""

    command = "simulate"

    def __init__(self, emulation: Emulation) -> None:
        super().__init__(emulation)
        self._orders: SimpleQueue[int | None] = SimpleQueue()

    def _order(self, horizon_ns: int | None) -> None:
        self._orders.put(horizon_ns)

    def _drive(self) -> None:
        simulate(self.emulation, self._before_horizon)

    def _before_horizon(self, lockstep: Lockstep) -> None:
        self.stands.set_result(None)
        lockstep.horizon_ns = self._orders.get()


class SteppedLiveRun(SteppedRun):
    """A run of real processes over Zenoh."""

    command = "run"

    def __init__(self, emulation: Emulation, options: LiveOptions) -> None:
        super().__init__(emulation)
        self._options = options

    def _order(self, horizon_ns: int | None) -> None:
        self._loop.call_soon_threadsafe(self._next.set_result, horizon_ns)

    def _drive(self) -> None:
        asyncio.run(run_live(self.emulation, self._options, before_horizon=self._before_horizon))

    async def _before_horizon(self, lockstep: Lockstep) -> None:
        self._loop = asyncio.get_running_loop()
        self._next: asyncio.Future[int | None] = self._loop.create_future()
        self.stands.set_result(None)
        lockstep.horizon_ns = await self._next
