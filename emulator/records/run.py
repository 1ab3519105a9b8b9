"""A finished run as its user sees it: verdict, tables, events, scenario, and positions over time.

`emulator.Run` is this class. It is the public face of `RecordedRun`, whose other members may change; checks of a
user's own get one, and so does whoever reads a run from Python.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path
from typing import ClassVar

import numpy as np
import pyarrow as pa

from emulator.fault_plan import PlannedFault
from emulator.radio.reception import Threshold
from emulator.radio.topology import Connectivity, connectivity_of
from emulator.records.events import Event
from emulator.records.radio_metrics import radio_metrics
from emulator.records.recorded_run import RecordedRun
from emulator.records.tables import BACKBONE, BACKGROUND, DRIVEN
from emulator.records.verdicts import CheckResult, NotExercised, Record, Verdict
from emulator.scenario.faults import GnssFault
from emulator.scenario.radio import Receiver
from emulator.scenario.scenario import Scenario
from emulator.world.neighbours import components_of_links
from vnet.errors import VnetError, did_you_mean, first_names, shown
from vnet.types import Array, IntArray, Mask
from vnet.units import NS_PER_S


class Run:
    """A finished run, read from its `folder`; each file is read when it is first needed.

    The tables are of `pyarrow`, with the columns of docs/reference/files.md; `to_pandas()` makes them data frames.
    Arrays over vehicles have the order of `nodes`, arrays over periods that of `times_s`. Everything raises
    VnetError, in one line, for a file that is missing or broken.
    """

    def __init__(
        self,
        recorded: RecordedRun,
        folder: Path,
        record: Record | None = None,
        write: Callable[[], None] = lambda: None,
    ) -> None:
        """Wrap what was recorded; without a `record` the run has not been judged yet.

        `write` makes the files of the folder, where they are not there until somebody asks for them.
        """
        self._folder = folder
        self._recorded = recorded
        self._record = record
        self._write: Callable[[], None] | None = write

    @property
    def folder(self) -> Path:
        """Folder of the run's files."""
        write, self._write = self._write, None
        if write is not None:
            write()
        return self._folder

    @classmethod
    def open(cls, folder: str | Path) -> Run:
        """Return the run in `folder`. Raises VnetError if it is not the folder of a finished run."""
        recorded = RecordedRun.open(Path(folder))
        return cls(recorded, Path(folder), recorded.record)

    html: ClassVar[Callable[[Run], str] | None] = None
    """Function that shows a run as HTML, set by `emulator.report`."""

    def _repr_html_(self) -> str | None:
        """Return the run as a notebook shows it."""
        return None if Run.html is None else Run.html(self)

    def __repr__(self) -> str:
        verdict = "not judged yet" if self._record is None else self._record.verdict.value
        return f"<Run {str(self._folder)!r}: {verdict}>"

    # The verdict.

    @property
    def _judged(self) -> Record:
        if self._record is None:
            raise VnetError(f"{self._folder}: has no verdict yet: its checks are still being made")
        return self._record

    @property
    def verdict(self) -> Verdict:
        """Verdict: "valid", "invalid" or "unknown". Raises VnetError within a check, which comes before it."""
        return self._judged.verdict

    @property
    def checks(self) -> list[CheckResult]:
        """Results of the checks: `name`, `verdict`, `text` and `figures`. Raises VnetError within a check."""
        return self._judged.checks

    @property
    def not_applicable(self) -> list[NotExercised]:
        """Checks that the run could not exercise: `name` and `reason`. Raises VnetError within a check."""
        return self._judged.not_exercised

    @property
    def figures(self) -> dict[str, float | None]:
        """Figures of verdict.json by name: means after the first fifth of the run; None where there is none.

        Raises VnetError within a check.
        """
        return self._judged.figures

    @property
    def driving(self) -> dict[str, float | None]:
        """Figures of driven vehicles by name; empty where programs do not drive.

        Raises VnetError within a check.
        """
        return self._judged.driving

    @property
    def reproduce(self) -> str:
        """Command that runs the run again. Raises VnetError within a check."""
        return self._judged.reproduce

    # What was recorded.

    @property
    def scenario(self) -> Scenario:
        """Scenario as it was run, with every default: `run.scenario.radio.range_m`."""
        return self._recorded.scenario

    @property
    def trace(self) -> pa.Table:
        """Table of receptions: a row for each frame and receiver in range, with its one outcome."""
        return self._recorded.trace

    @property
    def states(self) -> pa.Table:
        """Table of vehicles: a row for each vehicle and period, with truth, fix and report."""
        return self._recorded.states

    @property
    def driven(self) -> pa.Table | None:
        """Table of driven vehicles: a row for each control instant and vehicle; None where no program drives."""
        return self._recorded.table(DRIVEN)

    @property
    def backbone(self) -> pa.Table | None:
        """Table of the backbone: a row for each message of a roadside unit and receiver; None without a unit."""
        return self._recorded.table(BACKBONE)

    @property
    def background(self) -> pa.Table | None:
        """Table of vehicles without programs: a row for each period and vehicle; None where there are none."""
        return self._recorded.table(BACKGROUND)

    @property
    def metrics(self) -> pa.Table:
        """Table of periods: a row for each period, with errors and counts over all vehicles."""
        return self._recorded.metrics

    @property
    def events(self) -> Sequence[Event]:
        """Events in the order of their recording: `time_ns`, `kind`, `node` (or None) and `details`.

        `name` and `values` are those of a program's own event (`node.event`), as in properties over time.
        """
        return list(self._recorded.events)  # a check may sort it, and others read them after it

    @property
    def nodes(self) -> list[str]:
        """Ids of all vehicles."""
        return list(self._recorded.node_ids)

    @property
    def period_s(self) -> float:
        """Length of a period in s: the time between two GNSS fixes."""
        return self.scenario.period_ns / NS_PER_S

    @property
    def times_s(self) -> Array:
        """Starts (periods,) in s of the periods that the run completed."""
        return self._recorded.times_s

    @property
    def last_fault_s(self) -> float:
        """Time in s from which on no fault acts; 0 without faults."""
        return self._recorded.last_heal_ns / NS_PER_S

    @property
    def faults(self) -> Sequence[PlannedFault]:
        """Faults with `start_ns`, `end_ns` and `label`."""
        return list(self._recorded.plan)

    @property
    def rested_s(self) -> float:
        """Time in s from the end of the last fault to that of the run; negative if a fault acts at the end."""
        return (self._recorded.closed_ns - self._recorded.last_heal_ns) / NS_PER_S

    @property
    def links_change(self) -> bool:
        """True if the vehicles in range of each other change during the run, by other causes than faults."""
        return self._recorded.topology_changes

    @property
    def runs_the_program(self) -> Mask:
        """Vehicles (N,) that run the scenario's program, and none of its exceptions."""
        return self._recorded.runs_the_program.copy()

    def index(self, node: str) -> int:
        """Return the index of a vehicle in arrays. Raises VnetError for an id that no vehicle has."""
        if node not in self._recorded.number:
            hint = did_you_mean(node, self.nodes)
            raise VnetError(f"{shown(node)}: no such vehicle{hint}; there are {first_names(self.nodes)}")
        return self._recorded.number[node]

    # Over time.

    def positions(self, time_s: float) -> Array:
        """Return the true positions (N, 2) in m, east and north, in the period that holds `time_s`.

        NaN where a vehicle is not in the network. Raises VnetError if the run has no such period.
        """
        return np.asarray(self._recorded.vectors("position_m")[self._period(time_s)])

    def in_range(self, time_s: float) -> Mask:
        """Return who is in radio range of whom at `time_s` (N, N): rows are senders, columns receivers.

        The peer cap and faults are not considered. Raises VnetError if the run has no such period.
        """
        self._period(time_s)
        places = self._recorded.places
        return places.links(round(time_s * NS_PER_S)).matrix()

    def up(self, time_s: float) -> Mask:
        """Return the vehicles (N,) that are up at `time_s`: in the network, not ended, and not ended by a fault."""
        return ~self._recorded.down_at(round(time_s * NS_PER_S))

    @property
    def up_throughout(self) -> Mask:
        """Vehicles (periods, N) that are up throughout a period."""
        up = np.ones((self._recorded.periods, len(self.nodes)), dtype=bool)
        start_ns = self._recorded.period_starts_ns()
        for span in self._recorded.down:
            up[(span.start_ns < start_ns + self.scenario.period_ns) & (span.end_ns > start_ns), span.node] = False
        return up

    def misled(self, after_s: float = 0.0) -> Mask:
        """Return the vehicles (periods, N) on whose receiver a fault acts, or has acted in the last `after_s`."""
        misled = np.zeros((self._recorded.periods, len(self.nodes)), dtype=bool)
        start_ns = self._recorded.period_starts_ns()
        for planned in self._recorded.plan:
            if isinstance(planned.fault, GnssFault):
                until_ns = planned.end_ns + round(after_s * NS_PER_S)
                when = (planned.start_ns <= start_ns) & (start_ns < until_ns)
                # Where it follows a region, every vehicle that has been within it.
                ever = np.logical_or.accumulate(self._recorded.struck(planned)) | planned.nodes
                misled |= when[:, None] & ever
        return misled

    @cached_property
    def _audible(self) -> Connectivity | None:
        """Connectivity by which frames may arrive, where that is less than being in range.

        Without fading 802.11p detects no frame whose mean power is below what `[radio.receiver]` needs.
        """
        radio = self.scenario.radio
        if radio.path_loss is None or radio.fading is not None or radio.sidelink is not None:
            return None
        needed_dbm = 10 * math.log10(Threshold(radio.receiver or Receiver()).alone_mw)
        least_dbm = max(radio.path_loss.floor_dbm, needed_dbm)
        path_loss = radio.path_loss.model_copy(update={"floor_dbm": least_dbm})
        radio = radio.model_copy(update={"path_loss": path_loss})
        return connectivity_of(radio, self.scenario.run.seed, self._recorded.radio_inputs)

    def components(self, time_s: float, among: Mask) -> IntArray:
        """Return the label (N,) of each vehicle's component at `time_s`.

        A component is connected by links in both directions under the peer cap, `among` these vehicles (N,), over
        which frames may arrive.
        """
        time_ns = round(time_s * NS_PER_S)
        pairs = self._recorded.admitted(among, time_ns)
        if self._audible is not None:
            places = self._recorded.places
            audible = self._audible.links(places.position_m(int(places.index(np.array(time_ns)))))
            pairs = pairs.of(audible.contain(pairs.sender, pairs.receiver))
        both = pairs.contain(pairs.receiver, pairs.sender)
        return components_of_links(pairs.sender[both], pairs.receiver[both], pairs.count)

    def first_lasting(self, holds: Mask, duration_s: float) -> dict[int, int]:
        """Return the period in which a condition (periods, N) had first held for `duration_s`, by vehicle."""
        return first_lasting(holds, self.scenario.period_ns, duration_s)

    def column(self, name: str) -> Array:
        """Return a column of `states` over time, (periods, N) or (periods, N, size); NaN where there is none."""
        return self._recorded.by_period(name)

    def reported(self, name: str) -> Array:
        """Return a value of `node.report(…, name=value)` (periods, N); NaN where there is none."""
        return self._recorded.value(name)

    def radio_figures(self, within_m: float = math.inf, from_s: float = 0.0) -> dict[str, float | None]:
        """Return the figures of `vnet radio` over all attempted receptions: docs/export.md.

        `delivery_ratio`, `latency_mean_ms`, `inter_reception_mean_ms`, `age_mean_ms`, `busy_ratio_mean` and
        others; None where there is none. Receivers farther than `within_m` metres count as out of range, and frames
        enqueued before `from_s` seconds are left out. Raises VnetError if the run's files do not fit.
        """
        return radio_metrics(self._recorded, within_m=within_m, from_s=from_s).totals

    def _period(self, time_s: float) -> int:
        """Index of the period that holds an instant."""
        period, periods = int(round(time_s * NS_PER_S) // self.scenario.period_ns), self._recorded.periods
        if not 0 <= period < periods:
            end_s = periods * self.period_s
            raise VnetError(f"time_s = {time_s:g}: the run has periods from 0 s to {end_s:g} s")
        return period


def first_lasting(holds: Mask, period_ns: int, duration_s: float) -> dict[int, int]:
    """Return the period in which a condition (periods, N) had first held for `duration_s`, by vehicle."""
    needed = max(1, round(duration_s * NS_PER_S / period_ns))
    length = np.zeros(holds.shape[1], dtype=int)
    first: dict[int, int] = {}
    for period, over in enumerate(holds):
        length = np.where(over, length + 1, 0)
        for node in np.flatnonzero(length == needed).tolist():
            first.setdefault(node, period)
    return first
