"""Registry of planted bugs: twelve small vehicle programs, each with one bug that is hard to meet.

They were planted before orders of events could be explored, so that an explorer can be judged by them. Six follow
published reports; their programs, sentences and code are our own. Each module of `programs` says what its bug is.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

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
SILENCING_FAULTS = "kill,restart,pause,partition,block,loss,burst_loss,skew,drift"
"""Faults that delay no frame: the cooperative program rejects a frame that another has overtaken, as it should."""
COOPERATIVE = {"program.options": {"particles": 20}}
"""Few particles, for short runs: the bugs are not the filter's."""
CRASHED, UNHANDLED = "agents_alive", "no_exceptions"
"""Checks of vnet's own that judge a bug that is an exception: in main, or in a task or callback."""


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
    duration_s: float = 2.0
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Further keys of the scenario."""
    faults: str = FAULTS
    """Faults that the repaired program withstands, and with which the bug is looked for."""
    report: str = ""
    """Published report after which the bug was planted: repository, number and title; "" for a bug of our own."""

    @property
    def is_cooperative(self) -> bool:
        """True for a bug of the cooperative program."""
        return self.program.startswith("cooperative:")

    def scenario(self, repaired: bool = False) -> Scenario:
        """Return the scenario, with the program with or without the bug."""
        own = self.judged_by.removeprefix("own:")
        program = {
            "entry": f"{PROGRAMS}.{self.repaired if repaired else self.program}",
            "checks": [] if own == self.judged_by else [f"{CHECKS}:{own}"],
        }
        data = {
            "run": {"name": self.name, "duration_s": self.duration_s, "settle_s": self.duration_s / 2},
            "network": {"vehicles": self.vehicles},
            "radio": RADIO,
            "program": program,
        }
        return make_scenario(data, self.settings)


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
    Bug(
        name="forgotten_duplicate",
        program="repeated_warning:main",
        repaired="repeated_warning:repaired",
        judged_by="own:warned_once",
        needs_order=True,
    ),
    Bug(
        name="crossing_acknowledgement",
        program="acknowledged_data:main",
        repaired="acknowledged_data:repaired",
        judged_by=UNHANDLED,
        needs_order=True,
    ),
    Bug(
        name="second_token",
        program="token_ring:main",
        repaired="token_ring:repaired",
        judged_by="own:one_token",
        needs_order=True,
        vehicles=4,
        duration_s=3.0,
    ),
    Bug(
        name="endless_reckoning",
        program="dead_reckoning:main",
        repaired="dead_reckoning:repaired",
        judged_by="own:reckons_without_fixes",
        needs_order=True,
    ),
    Bug(
        name="fix_sent_twice",
        program="cooperative:by_the_clock",
        repaired="cooperative:repaired",
        judged_by="own:each_fix_once",
        needs_order=True,
        settings=COOPERATIVE,
        faults=SILENCING_FAULTS,
    ),
    Bug(
        name="burst_after_pause",
        program="cooperative:every_fix",
        repaired="cooperative:repaired",
        judged_by="own:few_at_once",
        needs_order=False,
        settings=COOPERATIVE,
        faults=SILENCING_FAULTS,
    ),
)
