"""Driving in a run: actions of programs on their way to the vehicles, and events of the vehicles."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
import pyarrow as pa

from emulator.records.driven_table import driven_table
from emulator.records.events import KINDS
from emulator.records.run_folder import RunFolder
from emulator.records.tables import background_table
from emulator.world.driven.stepped import SteppedWorld
from emulator.world.driven.vehicles import Happening
from emulator.world.world import World
from vnet.driving import Action
from vnet.types import Array


class Driving:
    """Vehicles of a run and their programs' actions; nothing in a world whose truth is known from the start."""

    def __init__(self, world: World, folder: RunFolder, number: Mapping[str, int]) -> None:
        self._world = world if isinstance(world, SteppedWorld) else None
        self._node_ids = () if self._world is None else self._world.driven
        self._drive = frozenset(self._node_ids)
        self._folder = folder
        self._number = number

    @property
    def next_ns(self) -> int | None:
        """The next control instant within the run; None if there is none."""
        return None if self._world is None else self._world.next_control_ns()

    def control_ns(self, node: str) -> int:
        """Return the time between two control instants; 0 for a node that its program does not drive."""
        return 0 if self._world is None or node not in self._drive else self._world.vehicles.step_ns

    @property
    def versions(self) -> Mapping[str, str]:
        """Versions of programs that move vehicles, by name."""
        return {} if self._world is None else self._world.versions

    def table(self) -> pa.Table | None:
        """Return what vehicles did at each control instant; None where programs do not drive."""
        return None if self._world is None else driven_table(self._world.vehicles.finished_log(), self._node_ids)

    def background(self) -> pa.Table | None:
        """Return where vehicles without programs were; None where there are none."""
        return None if self._world is None else background_table(self._world.background)

    def background_m(self, period: int) -> Array:
        """Return the positions (k, 2) of vehicles without programs at the start of a period."""
        background = None if self._world is None else self._world.background
        return np.zeros((0, 2)) if background is None else background.position_m[period]

    def take(self, time_ns: int, actions: Iterable[Action]) -> None:
        """Take what programs of vehicles that are up ask for at `time_ns`."""
        if self._world is not None:
            for action in actions:
                if action.node not in self._drive:  # a roadside unit
                    continue
                self._tell(self._world.vehicles.take(time_ns, self._number[action.node], action))

    def release(self, time_ns: int, node: str) -> None:
        """Leave the speed of a vehicle whose program has ended to the vehicle."""
        self.take(time_ns, [Action(node, release=True)])

    def advance_to(self, time_ns: int) -> bool:
        """Let vehicles drive to the last control instant until `time_ns`; returns whether they have moved."""
        moved = False
        while self._world is not None and (next_ns := self.next_ns) is not None and next_ns <= time_ns:
            self._tell(self._world.advance())
            moved = True
        return moved

    def close(self) -> None:
        """Let go of what moves the vehicles; the run is over."""
        if self._world is not None:
            self._world.close()

    def detach(self) -> None:
        """Let go of it in a process forked from the emulator's, which goes on with it."""
        if self._world is not None:
            self._world.detach()

    def _tell(self, happened: Iterable[Happening]) -> None:
        for each in happened:
            self._folder.event(each.time_ns, KINDS[each.kind], self._node_ids[each.number], **each.details)
