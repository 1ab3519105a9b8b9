"""Channel busy ratios for programs: what each vehicle's radio has measured, told early enough to be known.

A radio measures at each multiple of `SLICE_NS` over the last 100 ms. Its program sees a measurement one lookahead
later. So all that a program can see in a window is known when the window begins, however long it is, and a run is
the same with and without windows, live and simulated.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from emulator.radio.engine import Engine
from emulator.radio.medium import SLICE_NS
from vnet.transport.wire import BusyRatios
from vnet.types import Array, IntArray

MOST_KNOWN = 64
"""Measurements that are kept: those of a window serve all processes that are granted it."""


class BusyFeed:
    """Measurements of the nodes `node_ids` of an engine, in its order, which are known `delay_ns` later."""

    def __init__(self, engine: Engine, node_ids: Sequence[str], delay_ns: int) -> None:
        self._engine = engine
        self._number = {node: number for number, node in enumerate(node_ids)}
        self._delay_ns = delay_ns
        self._numbers: dict[tuple[str, ...], IntArray] = {}
        self._known: dict[int, Array] = {}

    def of(self, nodes: tuple[str, ...], time_ns: int, end_ns: int) -> Sequence[BusyRatios]:
        """Return what `nodes` know from `time_ns` to just before `end_ns`; nothing if they share no medium.

        All events of the medium more than the delay before `end_ns` have been processed.
        """
        if not self._engine.shares_medium:
            return ()
        if nodes not in self._numbers:
            self._numbers[nodes] = np.array([self._number[node] for node in nodes])
        first_ns = max(0, (time_ns - self._delay_ns) // SLICE_NS * SLICE_NS)
        later_ns = range(first_ns + SLICE_NS, end_ns - self._delay_ns, SLICE_NS)
        return [self._measured(nodes, measured_ns) for measured_ns in (first_ns, *later_ns)]

    def _measured(self, nodes: tuple[str, ...], measured_ns: int) -> BusyRatios:
        if measured_ns not in self._known:
            if len(self._known) >= MOST_KNOWN:
                self._known.clear()
            self._known[measured_ns] = self._engine.busy_ratios_at(measured_ns)
        ratios = self._known[measured_ns][self._numbers[nodes]]
        return BusyRatios(measured_ns + self._delay_ns if measured_ns else 0, ratios.tolist())
