"""Quiet instants: what a process does beyond its window without asking the emulator.

Beyond its window a process does not know which packets have come. As long as no vehicle of it waits on the radio,
it need not: it goes on with its timers, and with the fixes of the next period if it has been given them, up to the
instant that its grant names. It asks as soon as a program looks for packets or tells anything: whatever the program
does next, the emulator stands at its instant, and knows what it did before.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Sequence
from functools import partial
from typing import NoReturn

from msgspec.structs import replace

from vnet.errors import VirtualTimeError
from vnet.node import Node
from vnet.runtime.arrivals import Mail
from vnet.runtime.host import Host
from vnet.transport import wire

Swap = Callable[[int | None], int]
"""Yield with the next timer (ns), await the next grant, give it to `RunAhead.open_window`, and return its time."""


class RunAhead:
    """Passes a host through its windows and the quiet instants behind them. `clock` is the loop's own, in ns.

    It is made in the thread of the loop. The loop calls `catch_up` before each job, the host with new traffic.
    """

    def __init__(self, host: Host, clock: Callable[[], int], swap: Swap) -> None:
        self._host = host
        self._clock = clock
        self._swap = swap
        self._end_ns = 0
        self._quiet_ns = 0
        self._fixes: Sequence[wire.WireFix] = ()
        self._fixes_ns: int | None = None
        self._failure: BaseException | None = None
        self._thread = os.getpid(), threading.get_ident()
        self._is_exchanging = False
        self._is_over = False
        for node in host.nodes.values():
            node.radio.inbox.refill = partial(self._look, node.radio.inbox.refill)

    def open_window(self, grant: wire.Grant) -> int:
        """Take a grant; returns its first instant, with everything delivered that is due at it."""
        if self._fixes_ns is not None and self._fixes_ns <= grant.time_ns:
            grant = replace(grant, fixes=[*self._take_fixes(), *grant.fixes])
        self._end_ns, self._quiet_ns = grant.end_ns, grant.quiet_ns
        if grant.next_fixes_ns is not None:
            self._fixes_ns, self._fixes = grant.next_fixes_ns, grant.next_fixes
        return self._host.open_window(grant)

    def exchange(self, next_timer_ns: int | None) -> int:
        """End an instant at which nothing is left to do; returns the next, for which it may ask the emulator."""
        self._is_exchanging = True
        try:
            if self._failure is not None:
                self._give_up(self._failure)
            return self._pass_on(next_timer_ns)
        finally:
            self._is_exchanging = False

    def _pass_on(self, next_timer_ns: int | None) -> int:
        now_ns = self._clock()
        if now_ns >= self._end_ns and (self._host.has_traffic or not self._may_pass(self._wake_ns(next_timer_ns))):
            self._reach(now_ns)  # the last of quiet instants, too: a program that is ended finds what came by then
        next_ns = self._host.next_instant(next_timer_ns)
        if next_ns is not None:
            return next_ns
        wake_ns = self._wake_ns(next_timer_ns)
        if wake_ns is None or not self._may_pass(wake_ns):
            return self._swap(wake_ns)
        if self._fixes_ns is not None and self._fixes_ns <= wake_ns:
            self._host.mail.deliver(Mail.of((), self._take_fixes()), wake_ns)
        return wake_ns

    def _look(self, refill: Callable[[], None]) -> None:
        """Let a program look for packets, as of this instant."""
        self.catch_up()
        refill()

    def catch_up(self) -> None:
        """Have this instant granted if it is quiet: a program looks for packets, tells anything, or begins a job.

        Other threads, and processes that a program has forked, cannot ask. What ends the run here must not pass
        through the program: it leaves the loop when the instant is over.
        """
        if self._clock() < self._end_ns or self._is_exchanging or self._is_over or self._failure is not None:
            return
        if (os.getpid(), threading.get_ident()) != self._thread:
            return
        self._is_exchanging = True
        try:
            self._reach(self._clock())
        except BaseException as failure:
            self._failure = failure
        finally:
            self._is_exchanging = False

    def close(self) -> None:
        """Let programs that are ended look for packets, and tell what they will, without asking."""
        self._is_over = True

    def _may_pass(self, wake_ns: int | None) -> bool:
        """Return whether the process may go on to `wake_ns`, beyond the window, by itself."""
        if wake_ns is None or wake_ns >= self._quiet_ns:
            return False
        return not any(map(_listens, self._host.nodes.values()))

    def _wake_ns(self, next_timer_ns: int | None) -> int | None:
        """Return the earliest of the next timer and, if a vehicle waits for one, the fixes that are here."""
        fixes_ns = self._fixes_ns
        if fixes_ns is None or (next_timer_ns is not None and next_timer_ns <= fixes_ns):
            return next_timer_ns
        awaits_fix = any(node.gnss.inbox.waiting for node in self._host.nodes.values())
        return fixes_ns if awaits_fix else next_timer_ns

    def _take_fixes(self) -> Sequence[wire.WireFix]:
        fixes, self._fixes, self._fixes_ns = self._fixes, (), None
        return fixes

    def _reach(self, time_ns: int) -> None:
        """Have this quiet instant granted."""
        granted_ns = self._swap(time_ns)
        if granted_ns != time_ns:
            raise VirtualTimeError(f"granted {granted_ns} ns to a process that has come to {time_ns} ns")

    def _give_up(self, failure: BaseException) -> NoReturn:
        """Leave the loop; what was done at an instant that was never granted is dropped."""
        self._host.take_traffic()
        self._failure = None
        raise failure


def _listens(node: Node) -> bool:
    """Return whether something that comes for a node makes an instant: for a roadside unit every message does."""
    return node.radio.inbox.waiting or node.radio.is_sending or node.backbone is not None
