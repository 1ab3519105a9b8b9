"""Registry of planted bugs: six small vehicle programs, each with one bug that is hard to meet.

They were planted before orders of events could be explored, so that an explorer can be judged by them. They follow
published reports; their programs, sentences and code are our own. Each module of `programs` says what its bug is.
"""

from __future__ import annotations

from dataclasses import dataclass

from emulator.scenario.scenario import Scenario
from emulator.testing.scenarios import make_scenario

PROGRAMS = "tests.hunt.programs"
CHECKS = "tests.hunt.checks"
RADIO = {
    "range_m": 20_000.0,
    "latency_ms": 4.0,
    "jitter_ms": 0.0,
    "access_jitter_ms": 0.0,
    "delivery_tick_us": 10_000,
}
"""Radio that reaches all, and delivers in ticks of 10 ms: what is sent at one tick arrives at the next."""
FAULTS = "kill,restart,pause,partition,block,loss,burst_loss,delay,jitter,reorder,duplicate,throttle,skew,drift"
"""Faults of processes, links and clocks. The programs trust what they receive: they meet no misbehaviour."""
DURATION_S = 2.0
"""Emulated length of a run; its second half is free of faults."""
CRASHED = "agents_alive"
"""The check of vnet's own that judges a bug that is an exception in main."""


@dataclass(frozen=True, kw_only=True)
class Bug:
    """A planted bug."""

    name: str
    program: str
    """Entry of the program with the bug, below `tests.hunt.programs`."""
    repaired: str
    """Entry of the program without it."""
    judged_by: str
    """Name of the check that is invalid if the bug has shown."""
    needs_order: bool
    """True if FIFO does not show it without faults. Some of these bugs show in FIFO with faults, too."""
    vehicles: int = 3
    report: str
    """Published report after which the bug was planted: repository, number and title."""

    def scenario(self, repaired: bool = False) -> Scenario:
        """Return the scenario, with the program with or without the bug."""
        own = self.judged_by.removeprefix("own:")
        program = {
            "entry": f"{PROGRAMS}.{self.repaired if repaired else self.program}",
            "checks": [] if own == self.judged_by else [f"{CHECKS}:{own}"],
        }
        data = {
            "run": {"name": self.name, "duration_s": DURATION_S, "settle_s": DURATION_S / 2},
            "network": {"vehicles": self.vehicles},
            "radio": RADIO,
            "program": program,
        }
        return make_scenario(data, {})


BUGS = (
    Bug(
        name="answered_twice",
        program="signal_phase:main",
        repaired="signal_phase:repaired",
        judged_by=CRASHED,
        needs_order=True,
        report="pengutronix/aiohttp-json-rpc#51: randomly InvalidStateError",
    ),
    Bug(
        name="lost_item",
        program="warning_display:main",
        repaired="warning_display:repaired",
        judged_by="own:shown",
        needs_order=False,
        report="python/asyncio#201: wait()/wait_for() losing items on Queue.get()",
    ),
    Bug(
        name="swallowed_cancellation",
        program="convoy_lead:main",
        repaired="convoy_lead:repaired",
        judged_by="own:followers_give_no_orders",
        needs_order=True,
        vehicles=4,
        report="python/cpython#86296: AsyncIO's wait_for can hide cancellation in a rare race condition",
    ),
    Bug(
        name="leaked_permit",
        program="crossing_permits:main",
        repaired="crossing_permits:repaired",
        judged_by="own:permit_is_kept",
        needs_order=True,
        vehicles=4,
        report="MagicStack/asyncpg#467: Leaked connections caused by timeout on pool.acquire",
    ),
    Bug(
        name="changed_table",
        program="distance_exchange:main",
        repaired="distance_exchange:repaired",
        judged_by=CRASHED,
        needs_order=False,
        report="aio-libs/sockjs#218: Race condition during iteration over sessions",
    ),
    Bug(
        name="second_session",
        program="upload_session:main",
        repaired="upload_session:repaired",
        judged_by="own:one_session",
        needs_order=True,
        report="alisaifee/coredis#182: Connection initialization synchronization fix",
    ),
)
