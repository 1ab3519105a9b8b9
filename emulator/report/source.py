"""A run as reports show it: what is missing or broken is told in one line, and the rest is shown."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from functools import cached_property, partial
from pathlib import Path
from typing import TypeVar

import numpy as np
import pyarrow as pa

from emulator.pages.canvas import FaultSpan
from emulator.records.events import CUTS_RUN, Event, EventKind
from emulator.records.metrics import DeclaredReference, reference_series
from emulator.records.period_figures import SAME, Views
from emulator.records.radio_metrics import RadioMetrics, radio_metrics
from emulator.records.recorded_run import OpenedRun, RecordedRun
from emulator.records.reported import reported_figures
from emulator.records.tables import STATES, TRACE
from vnet.errors import VnetError, printable
from vnet.types import Array

TABLES = {
    TRACE: ("sent_ns", "sender", "seq", "receiver", "size_bytes", "outcome", "cause", "arrival_ns", "copy"),
    STATES: ("period", "time_ns", "node", "position_m", "values"),
}
"""The columns that reports need; of the metrics all."""
T = TypeVar("T")


class NothingToShow(VnetError):
    """A run has no data for a figure, as its program or its radio has nothing of the kind: pages say nothing."""


class Source(OpenedRun):
    """A run as the pages show it. Properties raise VnetError where a file is not there or not vnet's."""

    def __init__(self, folder: Path) -> None:
        """Read the columns that reports need."""
        super().__init__(folder, TABLES)

    @cached_property
    def views(self) -> Views:
        """The program's declarations for views; none where the scenario cannot be read."""
        return maybe(lambda: super(Source, self).views) or Views()

    @cached_property
    def radio(self) -> RadioMetrics:
        """The radio in figures, without the channel busy ratio where its table cannot be read."""
        return radio_metrics(self, has_busy=maybe(lambda: self.busy_ratio) is not None)

    @cached_property
    def reference(self) -> DeclaredReference:
        """The reference that the program declares. Raises VnetError if it declares none."""
        return DeclaredReference(self.scenario)

    @cached_property
    def reference_series(self) -> dict[str, Array]:
        """The figures of the reference, (periods,) by name. Raises VnetError if the run has none."""
        columns = ("period", "node", *self.reference.columns)
        return reference_series(RecordedRun.open(self.folder, {STATES: columns}))

    # What programs report by names of their own.

    @cached_property
    def drawn_names(self) -> list[str]:
        """Names of the values with a report that can be drawn; none where the states cannot be read."""
        states = maybe(lambda: self.states)
        return [] if states is None else list(reported_figures(states))

    def is_boolean(self, name: str) -> bool:
        """Return whether a value is a boolean."""
        return bool(pa.types.is_boolean(self.states.schema.field(name).type))

    # Metrics, events and times, as the figures need them.

    @cached_property
    def time_s(self) -> Array:
        """(periods,) when the periods of the metrics start."""
        return np.asarray(self.metrics["time_ns"].to_numpy() / 1e9)

    def metric(self, name: str) -> Array:
        """(periods,) a column of the metrics; NaN where nobody reported. Raises VnetError if nobody ever did."""
        if name not in self.metrics.column_names:
            raise NothingToShow("no program reported what it needs")
        if not (pa.types.is_floating(kind := self.metrics[name].type) or pa.types.is_integer(kind)):
            raise VnetError(f"{name} is no number a period")
        column = np.asarray(self.metrics[name].cast(pa.float64()).to_numpy(zero_copy_only=False), dtype=float)
        if not np.isfinite(column).any():
            raise NothingToShow("no program reported what it needs")
        return np.where(np.isfinite(column), column, np.nan)

    @cached_property
    def estimates_positions(self) -> bool:
        """True if programs report positions of their own, and not their raw fixes again."""
        estimate, fix = (maybe(partial(self.metric, name)) for name in ("position_rmse_m", "fix_rmse_m"))
        if estimate is None or fix is None:
            return estimate is not None
        both = np.isfinite(estimate) & np.isfinite(fix)
        return not np.allclose(estimate[both], fix[both], rtol=SAME, atol=0)

    @cached_property
    def end_s(self) -> float:
        """End of the run, or of what is kept of it, in s; more than zero."""
        if found := maybe(lambda: self.record.emulated_s):
            return found
        last_ns = max((event.time_ns for event in maybe(lambda: self.events) or ()), default=0)
        return last_ns / 1e9 or (maybe(lambda: self.scenario.run.duration_s) or 1.0)

    @cached_property
    def spans(self) -> list[FaultSpan]:
        """Spans in which faults acted, as the events say."""
        spans = []
        for event, end_ns in acted(maybe(lambda: self.events) or ()):
            start_s = event.time_ns / 1e9
            end_s = max(start_s, self.end_s) if end_ns is None else end_ns / 1e9
            spans.append(FaultSpan(printable(str(event.details.get("fault"))), start_s, end_s))
        return spans

    @cached_property
    def damages(self) -> list[str]:
        """Reasons why files on which the verdict stands cannot be read; none where there is no verdict."""
        if maybe(lambda: self.record) is None:
            return []
        reads = (
            lambda: self.scenario,
            lambda: self.trace,
            lambda: self.states,
            lambda: self.metrics,
            lambda: self.events,
        )
        return list(dict.fromkeys(reason for read in reads if (reason := why_not(read))))

    @cached_property
    def cut(self) -> Event | None:
        """The event that ended the run before its time."""
        return next((event for event in maybe(lambda: self.events) or () if event.has(CUTS_RUN)), None)


def acted(events: Iterable[Event]) -> Iterator[tuple[Event, int | None]]:
    """Yield the event that began each fault, and when it ended, in ns; None, at last, for one that did not."""
    begun: dict[str, Event] = {}
    for event in events:
        label = str(event.details.get("fault"))
        if event.kind == EventKind.fault_started:
            begun[label] = event
        elif event.kind == EventKind.fault_ended and label in begun:
            yield begun.pop(label), event.time_ns
    for event in begun.values():
        yield event, None


def maybe(read: Callable[[], T]) -> T | None:
    """Return what `read` returns, or None where it meets a VnetError."""
    try:
        return read()
    except VnetError:
        return None


def why_not(read: Callable[[], object]) -> str:
    """Return why `read` raises VnetError; "" where it does not."""
    try:
        read()
    except VnetError as error:
        return str(error)
    return ""
