"""The radio's part of a recording: outcomes by time, link, distance and latency; age of information; load."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from emulator.stream import LATENCY_BIN_NS
from emulator.viewer.drawing import (
    BLUE,
    GREEN,
    ORANGE,
    OUTCOME_COLOURS,
    PURPLE,
    SKY,
    Canvas,
    Floats,
    PeriodArrays,
)

WINDOW_S = 5.0
"""Shares, histograms and loads are those of so many last seconds, and redrawn as often."""
DISTANCE_BINS = 20
STROKES = 8
"""The layers of the stacked chart are lines that go up and down so often in a period: Rerun fills no areas."""
LEAST_LATENCY_BINS = 8
LARGEST_MATRIX = 400
"""Vehicles of which the matrix of links is drawn."""


def next_charts_s(time_s: float) -> float:
    """Time of the charts' next redraw: soon in the beginning, then as often as there is new data."""
    return time_s + min(max(1.0, time_s), WINDOW_S)


class SlidingSum:
    """Sums of arrays of whole numbers over the last periods."""

    def __init__(self, periods: int) -> None:
        self._kept: deque[NDArray[Any]] = deque()
        self._periods = max(1, periods)
        self.total: NDArray[Any] = np.zeros(1)

    def add(self, array: NDArray[Any]) -> None:
        """Take one period's."""
        self._kept.append(array)
        self.total = self.total + array
        if len(self._kept) > self._periods:
            self.total -= self._kept.popleft()

    def __len__(self) -> int:
        return len(self._kept)


class Ages:
    """Age of information at the receivers, and the gaps between packets from one sender.

    Times between receptions are those between the sendings of what is received.
    """

    def __init__(self, count: int, periods: int) -> None:
        self._sent_ms = np.full((count, count), np.nan)
        self._gaps = SlidingSum(periods)

    def period(self, period: PeriodArrays, end_ms: float) -> None:
        """Take a period that ended then."""
        links, age_ms = period.received()
        sender, receiver, number = links.T
        sent_ms, before_ms = end_ms - age_ms, self._sent_ms[receiver, sender]
        newer = sent_ms > before_ms
        self._gaps.add(np.array([(sent_ms - before_ms)[newer].sum(), number[newer].sum()]))
        self._sent_ms[receiver, sender] = np.fmax(before_ms, sent_ms)
        if not period.up.all():
            self._sent_ms[~period.up] = self._sent_ms[:, ~period.up] = np.nan

    def at(self, end_ms: float, tried: NDArray[Any]) -> NDArray[np.float64]:
        """The ages in ms (n, n), a row receives, a column sends; NaN on links that have not brought anything yet.

        Links on which there were no frames of late, by `tried` (n, n), begin again.
        """
        self._sent_ms[tried == 0] = np.nan
        return end_ms - self._sent_ms

    @property
    def mean_gap_ms(self) -> float:
        """The mean time between receptions over all links of late; NaN if nothing came twice."""
        total_ms, gaps = self._gaps.total
        return float(total_ms / gaps) if gaps else float("nan")


class RadioScene:
    """Draws what concerns the radio below `/radio`, from the scene and period messages of a run."""

    def __init__(self, canvas: Canvas, scene: Mapping[str, Any]) -> None:
        self._canvas = canvas
        self._count = len(scene["node_ids"])
        self._period_ns: int = scene["period_ns"]
        self._period_s = self._period_ns / 1e9
        self._range_m: float | None = scene["range_m"]
        periods = round(WINDOW_S / self._period_s)
        self._tried, self._delivered = SlidingSum(periods), SlidingSum(periods)
        self._latency, self._sent, self._received = SlidingSum(periods), SlidingSum(periods), SlidingSum(periods)
        self._latency_bins = LEAST_LATENCY_BINS
        self._ages = Ages(self._count if self._count <= LARGEST_MATRIX else 0, periods)
        self._announced: set[str] = set()
        self._next_s = 0.0
        loads = (("sent: mean", SKY, 2.0), ("sent: most", BLUE, 1.0), ("received: mean", GREEN, 2.0))
        canvas.series("radio/load", [*loads, ("received: most", ORANGE, 1.0)])

    def period(self, period: PeriodArrays) -> None:
        """Draw a period."""
        self._stack(period)
        self._load(period)
        self._busy(period)
        if self._count <= LARGEST_MATRIX:
            for window, counts in zip((self._tried, self._delivered), period.counts(), strict=True):
                window.add(counts)
            self._ages.period(period, self._end_ms(period))
        self._latency.add(np.frombuffer(period.message["latency_counts"], dtype="<i4"))
        self._sent.add(period.numbers("sent_bytes").astype(float))
        self._received.add(period.numbers("received_bytes").astype(float))
        if period.time_s >= self._next_s:
            self._next_s = next_charts_s(period.time_s)
            self._charts(period)

    def _stack(self, period: PeriodArrays) -> None:
        """Frames by outcome, one layer on the other: each is a line from its lower to its upper bound and back.

        The line ends with the period: joined to the next one, which has another number of frames, it would be seen
        as frames of this outcome.
        """
        points = 2 * STROKES + 1
        times_ns = (period.time_ns + self._period_ns * np.arange(points) // points).tolist()
        lower = 0.0
        for outcome, colour in OUTCOME_COLOURS.items():
            count = period.message["outcomes"].get(outcome.name, 0)
            entity = f"radio/frames/{outcome.name}"
            if count and entity not in self._announced:
                self._announced.add(entity)
                style = rr.SeriesLines(
                    names=outcome.title, colors=[colour], widths=[2.5], aggregation_policy="MinMax"
                )
                self._canvas.log(entity, style, static=True)
            if count:
                self._canvas.plot_at(entity, times_ns, [lower, lower + count] * STROKES + [np.nan])
            lower += count

    def _load(self, period: PeriodArrays) -> None:
        rates = [period.numbers(name) / self._period_s / 1e3 for name in ("sent_bytes", "received_bytes")]
        self._canvas.plot("radio/load", *(float(value) for rate in rates for value in (rate.mean(), rate.max())))

    def _busy(self, period: PeriodArrays) -> None:
        ratio = 100 * period.numbers("busy_ratio")[period.up]
        if not len(ratio) or np.isnan(ratio).any():  # senders share no medium, or no window is over
            return
        if "radio/busy" not in self._announced:
            self._announced.add("radio/busy")
            self._canvas.series("radio/busy", [("mean", SKY, 2.0), ("most", BLUE, 1.0)])
        self._canvas.plot("radio/busy", float(ratio.mean()), float(ratio.max()))

    def _age(self, end_ms: float) -> None:
        """Ages by vehicle, and over all links."""
        ages_ms = self._ages.at(end_ms, self._tried.total)
        known = np.isfinite(ages_ms)
        by_receiver_ms = np.where(known, ages_ms, 0).sum(axis=1) / np.maximum(1, known.sum(axis=1))
        self._canvas.bars("radio/ages", by_receiver_ms, np.arange(self._count), 0.8, SKY)
        if not known.any():
            return
        if "radio/age" not in self._announced:
            self._announced.add("radio/age")
            lines = (("age: half of the links", SKY, 2.0), ("age: 95 % of the links", BLUE, 1.0))
            self._canvas.series("radio/age", [*lines, ("between receptions: mean", PURPLE, 2.0)])
        # Not the mean: a link that the peer cap closes for good would raise it for ever.
        half_ms, most_ms = np.quantile(ages_ms[known], [0.5, 0.95], method="higher").tolist()
        self._canvas.plot("radio/age", half_ms, most_ms, self._ages.mean_gap_ms)

    def _charts(self, period: PeriodArrays) -> None:
        canvas, span_s = self._canvas, len(self._latency) * self._period_s
        latency, width_ms = self._latency.total, LATENCY_BIN_NS / 1e6
        self._latency_bins = max(self._latency_bins, int(np.flatnonzero(latency).max(initial=0)) + 2)
        latency = latency[: self._latency_bins]
        canvas.bars("radio/latency", latency, (np.arange(len(latency)) + 0.5) * width_ms, width_ms, SKY)
        for side, name, window, colour in ((-1, "sent", self._sent, SKY), (1, "received", self._received, GREEN)):
            rate = window.total / span_s / 1e3
            canvas.bars(f"radio/bytes/{name}", rate, np.arange(self._count) + 0.2 * side, 0.4, colour)
        if self._count <= LARGEST_MATRIX:
            self._links(period)
            self._age(self._end_ms(period))

    def _end_ms(self, period: PeriodArrays) -> float:
        return (period.time_ns + self._period_ns) / 1e6

    def _links(self, period: PeriodArrays) -> None:
        """Delivery by link, by vehicle and by distance."""
        tried, delivered = self._tried.total, self._delivered.total
        vehicles, heard = np.arange(self._count), 100 * delivered.sum(axis=1) / np.maximum(1, tried.sum(axis=1))
        self._canvas.bars("radio/heard", heard, vehicles, 0.8, GREEN)
        share = np.divide(delivered, tried, out=np.full(tried.shape, np.nan), where=tried > 0)
        axes = ("receiver", "sender")
        self._canvas.log("radio/links", rr.Tensor(share.astype(np.float32), dim_names=axes, value_range=(0, 1)))
        position = period.points("position_m").astype(float)
        distance_m = np.hypot(*(position[:, None] - position[None]).transpose(2, 0, 1))
        tried = np.where(np.isfinite(distance_m), tried, 0)  # who has left is nowhere
        distance_m = np.nan_to_num(distance_m)
        farthest_m = self._range_m or float(distance_m[tried > 0].max(initial=1.0))
        shares, middles_m, width_m = delivery_by_distance(distance_m, tried, delivered, farthest_m)
        self._canvas.bars("radio/distance", 100 * np.nan_to_num(shares), middles_m, 0.95 * width_m, GREEN)


def delivery_by_distance(
    distance_m: NDArray[np.float64], tried: NDArray[Any], delivered: NDArray[Any], farthest_m: float
) -> tuple[Floats, Floats, float]:
    """Shares delivered by distance: (DISTANCE_BINS,), NaN where nobody tried; the bins' middles and width (m)."""
    width_m = farthest_m / DISTANCE_BINS
    place = np.minimum((distance_m / width_m).astype(int), DISTANCE_BINS - 1)[tried > 0]
    tries = np.bincount(place, tried[tried > 0], DISTANCE_BINS)
    hits = np.bincount(place, delivered[tried > 0], DISTANCE_BINS)
    share = np.divide(hits, tries, out=np.full(DISTANCE_BINS, np.nan), where=tries > 0)
    middles_m = (np.arange(DISTANCE_BINS) + 0.5) * width_m
    return share.astype(np.float32), middles_m.astype(np.float32), width_m
