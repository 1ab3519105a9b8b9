"""Node: what a program has of its vehicle, its receiver, radio, driving, folder, log and clock."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Protocol
from zlib import crc32

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from vnet.errors import sendable, shown
from vnet.radio import (
    NO_ABILITIES,
    Backbone,
    BackboneTransport,
    Mailbox,
    Radio,
    RadioAbilities,
    RadioTransport,
    SentFrame,
    UnitAbilities,
    number_or_nan,
)
from vnet.reports import NoteDetail, Report, Reporter, checked_detail
from vnet.roads.lanes import LaneMap
from vnet.roads.road_map import RoadMap
from vnet.types import Array

LARGEST_M_S2 = 1e6
"""Largest acceleration that can be asked for; what vehicles can do is far below it."""

LEVELS = ("debug", "info", "warning", "error", "critical")
"""Levels of a line of a node's log."""


Reading = float | tuple[float, ...] | dict[str, str]
"""Reading of a sensor: a number, some, or the state of each of several things, as of traffic lights."""
NOTHING_SENSED: Mapping[str, Reading] = MappingProxyType({})
"""Readings of a vehicle without sensors of the scenario's own."""

MOMENTS_OF_FAULTS = ("fault_started", "fault_ended")
"""Names of the moments at which faults begin and end at a vehicle (`emulator.checks.properties`)."""


class Action(msgspec.Struct, frozen=True, array_like=True):
    """Request of the program of `node`: an acceleration, or a change by `lane` lanes, 1 to the left.

    `release` leaves the speed to the vehicle: to SUMO's driver where there is one, else it is kept.
    """

    node: str
    acceleration_m_s2: Annotated[float, msgspec.Meta(ge=-LARGEST_M_S2, le=LARGEST_M_S2)] | None = None
    lane: Annotated[int, msgspec.Meta(ge=-1, le=1)] = 0
    release: bool = False

    @property
    def is_sound(self) -> bool:
        """True unless its acceleration is no number, which no bound of a message excludes."""
        return self.acceleration_m_s2 is None or math.isfinite(self.acceleration_m_s2)


def checked_action(
    node: str, can_drive: bool, acceleration_m_s2: float | None, lane: int, release: bool = False
) -> Action:
    """Return an action of `node`. Raise ValueError for one that is none, and if programs do not drive."""
    if not can_drive:
        raise ValueError('drive(…): programs drive only with [network] kind = "driven", or with step = true')
    asked = acceleration_m_s2
    if asked is not None:
        asked = number_or_nan(asked)
        if not abs(asked) <= LARGEST_M_S2:
            text = f"a finite number within ±{LARGEST_M_S2:g} is needed"
            raise ValueError(f"drive(acceleration_m_s2={shown(acceleration_m_s2)}): {text}")
    if lane not in (-1, 0, 1):
        raise ValueError(f"drive(lane={shown(lane)}): allowed are -1 (right), 1 (left) and 0 (stay)")
    if not isinstance(release, bool):
        raise ValueError(f"drive(release={shown(release)}): True or False is needed")
    if asked is not None and release:
        raise ValueError("drive(…, release=True): gives the speed back, and takes no acceleration_m_s2")
    if asked is None and lane == 0 and not release:
        raise ValueError("drive(): give acceleration_m_s2, lane or both")
    return Action(node, asked, int(lane), release)


@dataclass(slots=True)  # a frozen one takes five times as long to make; each is its program's own
class Fix:
    """One GNSS fix: position (2,) in m east-north, covariance (2, 2) in m², heading in radians or None.

    The covariance is that of the receiver's own errors, without the common error of all receivers. Where the
    scenario says `world.gnss.covariance = "total"` it includes multipath, an error in each axis with the deviation
    `multipath_sigma_m` that lasts for about `multipath_tau_s`; 0 where nothing is stated. A receiver has no
    heading where the scenario says so, for example while the vehicle stands. `speed_m_s` is the vehicle's own speed
    as its receiver measures it, with noise; None if the emulator does not tell it. Where `[world.ranging]` says
    so, driven vehicles measure at the same instant `gap_m`, the clear distance to the vehicle ahead in their lane,
    and its rate of change `gap_rate_m_s`, negative while it closes; None where nobody is ahead in range. `sensors`
    has what sensors of the scenario's own (`[world.sensor.NAME]`) read at that instant, by their names; where
    `network.sumo.lights_to` names this node, also `traffic_lights`, the state of each of SUMO's by its id.
    """

    time_ns: int
    position_m: Array
    covariance_m2: Array
    heading_rad: float | None
    speed_m_s: float | None = None
    gap_m: float | None = None
    gap_rate_m_s: float | None = None
    sensors: Mapping[str, Reading] = field(default_factory=lambda: NOTHING_SENSED)
    multipath_sigma_m: float = 0.0
    multipath_tau_s: float = 0.0


class NodeTransport(RadioTransport, BackboneTransport, Protocol):
    """Interface of a node to the process that hosts it."""

    def now_ns(self, node: str) -> int:
        """Return the emulated time in nanoseconds by the clock of `node`."""
        ...

    def send_report(self, report: Report) -> None:
        """Send a report to the emulator's metrics."""
        ...

    def send_note(self, node: str, kind: str, level: str, text: str, details: dict[str, NoteDetail]) -> None:
        """Send a line of the log (kind "log"), or an event named `text` (kind "event")."""
        ...

    def send_action(self, action: Action) -> None:
        """Send what the program asks its vehicle to do."""
        ...


class GnssReceiver:
    """The vehicle's GNSS receiver: `async for fix in node.gnss`."""

    def __init__(self) -> None:
        self.inbox: Mailbox[Fix] = Mailbox()

    def drain(self) -> list[Fix]:
        """Return all fixes since the last call, oldest first, without waiting."""
        return self.inbox.drain()

    async def receive(self) -> Fix:
        """Return the next fix; wait for one if there is none."""
        return await self.inbox.get()

    def __aiter__(self) -> GnssReceiver:
        return self

    async def __anext__(self) -> Fix:
        return await self.inbox.get()


class Node:
    """One vehicle as its program sees it.

    Attributes:
        id: the node's name.
        radio: the vehicle's radio.
        gnss: the vehicle's GNSS receiver.
        map: the lanes of the area; it does not say which lane the vehicle is on.
        seed: the seed of this node and incarnation, independent of the world's.
        rng: a generator with this seed. What tasks draw without a seed from `random`, `numpy.random`,
            `secrets` or `uuid.uuid4` has it, too.
        options: the scenario's `[program.options]`.
        period_ns: time between two fixes in nanoseconds.
        control_ns: time between two control instants in nanoseconds; 0 where programs do not drive.
        incarnation: number of restarts of the program so far.
        surveyed_position_m: true position (2,) in m of a roadside unit, which a surveyor has found; None for a
            vehicle.
        backbone: the unit's end of the wired network among roadside units; None for a vehicle.
    """

    def __init__(
        self,
        node_id: str,
        transport: NodeTransport,
        *,
        lane_map: LaneMap | RoadMap,
        seed: int,
        options: Mapping[str, Any],
        period_ns: int,
        max_payload: int,
        incarnation: int = 0,
        control_ns: int = 0,
        abilities: RadioAbilities = NO_ABILITIES,
        disk: Callable[[], Path] | None = None,
        unit: UnitAbilities | None = None,
    ) -> None:
        self._reporter = Reporter(node_id)
        self.id = sys.intern(node_id)
        self._hashes = count(crc32(node_id.encode()))  # of its tasks and futures
        self._task_names = count(1)
        self.radio = Radio(node_id, transport, max_payload, abilities)
        self.gnss = GnssReceiver()
        self.map = lane_map
        self.seed = seed
        self.rng = np.random.default_rng(seed)
        self.options = options
        self.period_ns = period_ns
        self.incarnation = incarnation
        self.control_ns = control_ns
        self.surveyed_position_m: Array | None = None
        self.backbone: Backbone | None = None
        if unit is not None:
            self.surveyed_position_m = np.array(unit.position_m)
            self.backbone = Backbone(node_id, transport, unit.peers, unit.max_message_bytes)
        self._transport = transport
        self._disk = disk

    @property
    def now_ns(self) -> int:
        """Emulated time in nanoseconds since the start of the run, by the vehicle's own clock."""
        return self._transport.now_ns(self.id)

    @property
    def folder(self) -> Path:
        """Folder of this vehicle's disk, on the machine of its process: empty at the start of the run.

        What was written there survives kills and restarts, as far as it has left the program's buffers: close or
        flush what must last. At the end of the run regular files are copied to `files/NODE/` in the run's folder,
        up to `run.files_max_mb`, if the emulator has started the process. The path differs from run to run: a
        program that sends it does not replay. Raise OSError where the disk refuses.
        """
        if self._disk is None:
            raise OSError(f"{self.id}: this node has no disk")
        return self._disk()

    def drive(self, acceleration_m_s2: float | None = None, lane: int = 0, release: bool = False) -> None:
        """Ask the vehicle for an acceleration, and with `lane` 1 or -1 for a change to the left or right lane.

        It holds from the first control instant that is not before the present one (there is one every `control_ns`)
        until another is asked for. The vehicle follows with the lag of its actuators. What it cannot do is limited,
        with an event `drive_limited`. `release` gives the speed back, as the end of the program does: in SUMO to
        its own driver; elsewhere the vehicle keeps its speed. Raise ValueError for what is no number, for another
        `lane`, and unless the scenario has `[network] kind = "driven"`, or SUMO with `step = true`.
        """
        action = checked_action(self.id, self.control_ns > 0, acceleration_m_s2, lane, release)
        self._transport.send_action(action)

    def disconnect(self, now_ns: int) -> None:
        """Disconnect the rest of the program from the world: the vehicle's process has ended, at `now_ns`."""
        self._transport = self.radio._transport = disconnected = _Disconnected(now_ns)
        if self.backbone is not None:
            self.backbone._transport = disconnected

    def report(
        self,
        estimate_m: ArrayLike | None = None,
        covariance_m2: ArrayLike | None = None,
        **values: ArrayLike,
    ) -> None:
        """Report the present estimates: position (2,) in m, its covariance (2, 2) in m², and further values.

        The last report of a period counts alone. Each further keyword is a number (kept as a 64-bit float), a
        boolean, a text of at most 64 characters, or an array of numbers. All but arrays are figures of the run: a
        column of its states, a row of its summary, a curve. A name that ends in a unit is shown with it, as
        `delay_ms`; one that ends in `covariance_m2` is a covariance matrix (2, 2). `heard` is the number of packets
        received since the last report, which is checked against the trace. A name is a Python identifier, with a
        dot and any printable text behind it if need be (`delay_ms.v03`, of which 32 have a column). Raise
        ValueError for a wrong shape, for another kind of value, for a covariance that is none (not finite, not
        symmetric, or not positive semidefinite), for a name that is none or that vnet's own columns have, and for a
        text under a name that this node has reported numbers by, or the reverse.
        """
        self._transport.send_report(self._reporter.report(self.now_ns, estimate_m, covariance_m2, values))

    def log(self, text: str, level: str = "info") -> None:
        """Write a line to this vehicle's log, with the emulated time and a level.

        Levels are "debug", "info", "warning", "error" and "critical". The line stands in `logs/NODE.log` and in
        `events.jsonl` (event `log`). So does what the program gives to the standard `logging`, from the level of
        its loggers on ("warning" by default). Raise ValueError for another level.
        """
        if level not in LEVELS:
            raise ValueError(f"log(level={level!r}): allowed are {', '.join(LEVELS)}")
        self._transport.send_note(self.id, "log", level, str(text), {})

    def event(self, name: str, /, **details: NoteDetail) -> None:
        """Record that something happened, at the present time: event `event` of `events.jsonl`.

        `details` are numbers, booleans or texts; numbers that JSON has not (NaN, infinite, beyond 64 bits) are
        recorded as texts. Of each vehicle 10,000 events are kept. Raise ValueError for any other value, an empty
        name, and a name by which properties know the moments of faults.
        """
        if not isinstance(name, str) or not name or name in MOMENTS_OF_FAULTS:
            raise ValueError(f"event({name!r}): a name is expected, other than {' and '.join(MOMENTS_OF_FAULTS)}")
        values = {sendable(key): checked_detail(key, value) for key, value in details.items()}
        self._transport.send_note(self.id, "event", "info", name, values)


class _Disconnected:
    """The transport of a node whose process has ended: it discards all frames and reports."""

    def __init__(self, now_ns: int) -> None:
        self._now_ns = now_ns

    def now_ns(self, node: str) -> int:
        return self._now_ns

    def send_frame(self, frame: SentFrame) -> None:
        pass

    def send_message(self, node: str, to: str | None, payload: bytes) -> None:
        pass

    def busy_ratio(self, node: str) -> float | None:
        return None

    def send_report(self, report: Report) -> None:
        pass

    def send_note(self, node: str, kind: str, level: str, text: str, details: dict[str, NoteDetail]) -> None:
        pass

    def send_action(self, action: Action) -> None:
        pass
