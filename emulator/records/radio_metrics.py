"""Radio metrics of a run: packet delivery ratio, also against distance, inter-packet gap, age of information,
latency; by link (a sender and a receiver), by vehicle and over all, from a run's trace and states.

A pair is a broadcast, as its sender handed it over, and a receiver in range that was up. What faults send again, or
let arrive again, is not counted. A link is in *contact* from one frame to the next unless frames in between were no
pairs (out of range, receiver down) or one of the two was not in the network; times between receptions, and ages,
are those within contacts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from emulator.radio.medium import WINDOW_NS
from emulator.records.recorded_run import RecordedRun
from vnet.types import Array, IntArray, Mask
from vnet.units import NS_PER_S

NS_PER_MS = 1e6
BIN_M = 50.0
LEAST_PAIRS = 10
"""Links with fewer pairs are not called bad."""
_SHARE = 0.95

Numbers = NDArray[np.number]

LINKS = pa.schema(
    {
        "sender": pa.dictionary(pa.int32(), pa.string()),
        "receiver": pa.dictionary(pa.int32(), pa.string()),
        "pairs": pa.int64(),
        "delivered": pa.int64(),
        "delivery_ratio": pa.float64(),
        "distance_mean_m": pa.float64(),
        "contacts": pa.int64(),
        "latency_mean_ms": pa.float64(),
        "latency_p95_ms": pa.float64(),
        "latency_max_ms": pa.float64(),
        "inter_reception_mean_ms": pa.float64(),
        "inter_reception_p95_ms": pa.float64(),
        "inter_reception_max_ms": pa.float64(),
        "age_mean_ms": pa.float64(),
        "age_peak_ms": pa.float64(),
    }
)
"""A row for each link that had a pair; `p95` are 95th percentiles by nearest rank. The age of information is, at
any time from the first reception of a contact to its last frame, how long ago the newest frame received was sent;
its mean is over time (Kaul, Yates, Gruteser 2012)."""
VEHICLES = pa.schema(
    {
        "node": pa.string(),
        "frames": pa.int64(),
        "sent_pairs": pa.int64(),
        "sent_delivery_ratio": pa.float64(),
        "heard_pairs": pa.int64(),
        "heard_delivery_ratio": pa.float64(),
        "heard_vehicles": pa.int64(),
        "latency_mean_ms": pa.float64(),
        "inter_reception_mean_ms": pa.float64(),
        "age_mean_ms": pa.float64(),
        "busy_ratio_mean": pa.float64(),
    }
)
"""A row for each vehicle: as a sender, then as a receiver; latency, inter-reception time and age are means over the
links by which it hears. How busy it found the medium is null where senders share none."""
DISTANCES = pa.schema(
    {
        "from_m": pa.float64(),
        "to_m": pa.float64(),
        "pairs": pa.int64(),
        "delivered": pa.int64(),
        "delivery_ratio": pa.float64(),
    }
)
"""A row for each bin of distance, at the time of sending, in which there were pairs."""


@dataclass(frozen=True)
class RadioMetrics:
    """Tables `LINKS`, `VEHICLES` and `DISTANCES`, and the figures over all pairs."""

    links: pa.Table
    vehicles: pa.Table
    distances: pa.Table
    totals: dict[str, float | None]

    def worst_links(self, count: int) -> pa.Table:
        """The `count` links on which the least was delivered, of those with `LEAST_PAIRS` pairs."""
        tried = self.links.filter(pc.greater_equal(self.links["pairs"], LEAST_PAIRS))
        return tried.sort_by([("delivery_ratio", "ascending"), ("pairs", "descending")]).slice(0, count)


@dataclass(frozen=True)
class _Pairs:
    """All pairs, sorted by link and then by number of the frame: (n,) each."""

    link: NDArray[np.intp]
    seq: IntArray
    sent_ns: IntArray
    arrival_ns: IntArray
    delivered: Mask
    distance_m: Array
    contact: IntArray


def radio_metrics(
    recorded: RecordedRun,
    bin_m: float = BIN_M,
    has_busy: bool = True,
    within_m: float = math.inf,
    from_s: float = 0.0,
) -> RadioMetrics:
    """The radio's figures of a run; distances in bins of `bin_m`. Raises VnetError if its files do not fit.

    Receivers farther than `within_m` count as out of range, and frames enqueued before `from_s` are left out.
    Without `has_busy` the channel busy ratio is left empty, whatever there is.
    """
    count = len(recorded.node_ids)
    from_ns = round(from_s * NS_PER_S)
    pairs = _pairs(recorded, count, within_m, from_ns)
    codes, place = np.unique(pairs.link, return_inverse=True)
    figures = _by_link(pairs, place, len(codes))
    links = _links_table(recorded.node_ids, codes, count, figures)
    busy = busy_ratios(recorded, math.ceil(from_ns / WINDOW_NS)) if has_busy else np.zeros((0, count))
    original = _chosen(recorded, np.flatnonzero(recorded.copy == 0), within_m, from_ns)
    vehicles = _vehicles_table(recorded, original, codes, count, figures, busy)
    totals = _totals(pairs, figures) | {"busy_ratio_mean": _mean(busy[~np.isnan(busy)])}
    return RadioMetrics(links, vehicles, _distances_table(pairs, bin_m), totals)


def busy_ratios(recorded: RecordedRun, first: int = 0) -> Array:
    """Return the channel busy ratios (W, N) of windows from the `first` on; NaN for a vehicle that is not there."""
    busy = recorded.busy_ratio[first:]
    if not recorded.moves or not len(busy):
        return busy
    present = recorded.places.present()
    periods = recorded.places.index((first + np.arange(len(busy))) * WINDOW_NS)
    return np.where(present[np.minimum(periods, len(present) - 1)], busy, np.nan)


def delivery_ratio(recorded: RecordedRun) -> float | None:
    """Packet delivery ratio over all pairs, without the other figures; None without any."""
    return _mean(recorded.outcome_is("delivered")[rows_of_pairs(recorded)].astype(float))


def rows_of_pairs(recorded: RecordedRun) -> NDArray[np.intp]:
    """Rows (n,) of the trace that are pairs: of frames as programs sent them, at receivers that are up."""
    original = (recorded.copy == 0) & (recorded.attempt == 0) & ~recorded.outcome_is("receiver_down")
    rows = np.flatnonzero(original)
    if not recorded.node_ids:  # no period was completed
        return rows
    down = ~recorded.arrived[rows] & recorded.is_down(recorded.receiver[rows], recorded.sent_ns[rows])
    return rows[~down]


def _pairs(recorded: RecordedRun, count: int, within_m: float, from_ns: int) -> _Pairs:
    rows = _chosen(recorded, rows_of_pairs(recorded), within_m, from_ns)
    link = recorded.sender[rows] * count + recorded.receiver[rows]
    if (np.diff(recorded.sent_ns[rows]) >= 0).all():  # as runs write it; few links are sorted by their bits
        order = np.argsort(link.astype(np.uint16) if count <= 256 else link, kind="stable")
    else:
        order = np.lexsort((recorded.seq[rows], link))
    rows, link = rows[order], link[order]
    seq, sent_ns = recorded.seq[rows], recorded.sent_ns[rows]
    breaks = (np.diff(link) != 0) | (np.diff(seq - _unicasts_before(recorded, recorded.sender[rows], seq)) != 1)
    if recorded.moves:
        breaks |= _was_away(recorded, recorded.sender[rows], sent_ns)
        breaks |= _was_away(recorded, recorded.receiver[rows], sent_ns)
    contact = np.concatenate([[0], np.cumsum(breaks)]) if len(rows) else np.zeros(0, np.int64)
    delivered = recorded.outcome_is("delivered")[rows]
    distance_m = _distances_m(recorded, rows)
    return _Pairs(link, seq, sent_ns, recorded.arrival_ns[rows], delivered, distance_m, contact)


def _chosen(recorded: RecordedRun, rows: NDArray[np.intp], within_m: float, from_ns: int) -> NDArray[np.intp]:
    """Return those of some rows of the trace that were enqueued from then on, and whose receivers are so near."""
    if from_ns > 0:
        rows = rows[recorded.sent_ns[rows] >= from_ns]
    return rows[_distances_m(recorded, rows) <= within_m] if within_m < math.inf else rows


def _distances_m(recorded: RecordedRun, rows: NDArray[np.intp]) -> Array:
    """Return the distance (n,) between sender and receiver of rows of the trace, at the time of sending."""
    ends = recorded.sender[rows], recorded.receiver[rows]
    return np.asarray(recorded.places.pair_distances_m(*ends, recorded.sent_ns[rows]))


def _unicasts_before(recorded: RecordedRun, sender: NDArray[np.intp], seq: IntArray) -> IntArray:
    """Number (n,) of the frames to single vehicles that these senders sent before their frames of these numbers."""
    rows = (recorded.copy == 0) & (recorded.attempt > 0)
    most = int(recorded.seq.max(initial=0)) + 1
    sent = np.sort(recorded.sender[rows] * most + recorded.seq[rows])
    return np.asarray(np.searchsorted(sent, sender * most + seq) - np.searchsorted(sent, sender * most))


def _was_away(recorded: RecordedRun, node: NDArray[np.intp], sent_ns: IntArray) -> Mask:
    """(n - 1,), whether a row's vehicle was not in the network at some time between it and the next."""
    away = np.cumsum(~recorded.places.present(), axis=0)
    index = np.minimum(recorded.places.index(sent_ns), len(away) - 1)
    return np.asarray(away[index[1:], node[1:]] != away[index[:-1], node[1:]])


def _by_link(pairs: _Pairs, place: NDArray[np.intp], links: int) -> dict[str, Array]:
    """The numeric columns of LINKS (links,), by name; NaN where there is nothing to say."""

    def total(of: NDArray[np.intp], weights: Array | None = None) -> Array:
        return np.asarray(np.bincount(of, weights, links), dtype=float)

    pair_count, heard = total(place), total(place[pairs.delivered])
    known = np.isfinite(pairs.distance_m)
    began = np.diff(pairs.contact, prepend=-1) != 0
    figures = {
        "pairs": pair_count,
        "delivered": heard,
        "delivery_ratio": heard / pair_count,
        "distance_mean_m": _ratio(total(place[known], pairs.distance_m[known]), total(place[known])),
        "contacts": total(place[began]),
    }
    place, sent_ns, arrival_ns, contact = _received(pairs, place)
    last_sent_ns = pairs.sent_ns[np.append(np.flatnonzero(began)[1:] - 1, -1)] if len(pairs.link) else sent_ns
    figures |= _spread("latency", place, arrival_ns - sent_ns, links)
    same = contact[1:] == contact[:-1]
    figures |= _spread("inter_reception", place[1:][same], np.diff(arrival_ns)[same], links)
    return figures | _ages(place, sent_ns, arrival_ns, contact, last_sent_ns, links)


def _received(pairs: _Pairs, place: NDArray[np.intp]) -> tuple[NDArray[np.intp], IntArray, IntArray, IntArray]:
    """Link, sending, arrival and contact of what was delivered, by contact and in the order of arrival."""
    rows = np.flatnonzero(pairs.delivered)
    contact, arrival_ns = pairs.contact[rows], pairs.arrival_ns[rows]
    if ((np.diff(arrival_ns) < 0) & (contact[1:] == contact[:-1])).any():  # some have overtaken others
        rows = rows[np.lexsort((arrival_ns, contact))]
    return place[rows], pairs.sent_ns[rows], pairs.arrival_ns[rows], pairs.contact[rows]


def _ages(
    place: NDArray[np.intp],
    sent_ns: IntArray,
    arrival_ns: IntArray,
    contact: IntArray,
    last_sent_ns: IntArray,
    links: int,
) -> dict[str, Array]:
    """Mean and peak age of information: a saw that falls at each arrival of something newer."""
    fresh = np.arange(len(place))
    while True:  # what was overtaken tells nothing new
        stale = (np.diff(sent_ns[fresh]) < 0) & (contact[fresh][1:] == contact[fresh][:-1])
        if not stale.any():
            break
        fresh = fresh[np.append(True, ~stale)]
    ends = np.append(np.diff(contact[fresh]) != 0, True)[: len(fresh)]
    next_ns = np.append(arrival_ns[fresh][1:], 0)[: len(fresh)]
    next_ns[ends] = np.maximum(arrival_ns[fresh], last_sent_ns[contact[fresh]])[ends]
    youngest_ms = (arrival_ns[fresh] - sent_ns[fresh]) / NS_PER_MS
    oldest_ms = (next_ns - sent_ns[fresh]) / NS_PER_MS
    area = np.bincount(place[fresh], (oldest_ms**2 - youngest_ms**2) / 2, links)
    lasted_ms = np.bincount(place[fresh], oldest_ms - youngest_ms, links)
    peak_ms = np.full(links, -np.inf)
    np.maximum.at(peak_ms, place[fresh], oldest_ms)
    return {"age_mean_ms": _ratio(area, lasted_ms), "age_peak_ms": np.where(peak_ms < 0, np.nan, peak_ms)}


def _spread(name: str, place: NDArray[np.intp], values_ns: IntArray, links: int) -> dict[str, Array]:
    """Mean, 95th percentile and maximum of each link's values, in ms."""
    counts = np.bincount(place, minlength=links)
    mean = _ratio(np.bincount(place, values_ns / NS_PER_MS, links), counts.astype(float))
    ordered_ns = _sorted_within(place, values_ns)
    ends = np.cumsum(counts)
    last, share = np.full(links, np.nan), np.full(links, np.nan)
    some = counts > 0
    last[some] = ordered_ns[ends[some] - 1] / NS_PER_MS
    rank = np.ceil(_SHARE * counts[some]).astype(np.int64)
    share[some] = ordered_ns[(ends - counts)[some] + rank - 1] / NS_PER_MS
    return {f"{name}_mean_ms": mean, f"{name}_p95_ms": share, f"{name}_max_ms": last}


def _sorted_within(place: NDArray[np.intp], values: IntArray) -> IntArray:
    """Non-negative values, sorted by place and then by value."""
    bits = int(values.max(initial=0)).bit_length()
    if bits + int(place.max(initial=0)).bit_length() < 63:  # one number sorts many times as fast as two
        return np.asarray(np.sort((place.astype(np.int64) << bits) | values) & ((1 << bits) - 1))
    return np.asarray(values[np.lexsort((values, place))])


def _ratio(above: Numbers, below: Numbers) -> Array:
    return np.asarray(np.divide(above, below, out=np.full(len(below), np.nan), where=below > 0))


def _links_table(node_ids: list[str], codes: NDArray[np.intp], count: int, figures: dict[str, Array]) -> pa.Table:
    columns = {
        end: pa.DictionaryArray.from_arrays(pa.array(number.astype(np.int32)), pa.array(node_ids, pa.string()))
        for end, number in zip(("sender", "receiver"), divmod(codes, max(count, 1)), strict=True)
    }
    return pa.table(columns | {name: _column(values) for name, values in figures.items()}).cast(LINKS)


def _vehicles_table(
    recorded: RecordedRun,
    original: NDArray[np.intp],
    codes: NDArray[np.intp],
    count: int,
    figures: dict[str, Array],
    busy: Array,
) -> pa.Table:
    sender, receiver = divmod(codes, max(count, 1))

    def over(end: NDArray[np.intp], name: str) -> Array:
        return np.asarray(np.bincount(end, figures[name], count))

    def mean(name: str) -> Array:
        known = np.isfinite(figures[name])
        total = np.bincount(receiver[known], figures[name][known], count)
        return _ratio(total, np.bincount(receiver[known], minlength=count).astype(float))

    frames = np.unique(recorded.frame[original], return_index=True)[1]
    columns = {
        "frames": np.bincount(recorded.sender[original][frames], minlength=count),
        "sent_pairs": over(sender, "pairs"),
        "sent_delivery_ratio": _ratio(over(sender, "delivered"), over(sender, "pairs")),
        "heard_pairs": over(receiver, "pairs"),
        "heard_delivery_ratio": _ratio(over(receiver, "delivered"), over(receiver, "pairs")),
        "heard_vehicles": np.bincount(receiver[figures["delivered"] > 0], minlength=count),
        **{name: mean(name) for name in ("latency_mean_ms", "inter_reception_mean_ms", "age_mean_ms")},
    }
    windows = (~np.isnan(busy)).sum(axis=0)
    columns["busy_ratio_mean"] = _ratio(np.nansum(busy, axis=0), windows)
    named = {"node": pa.array(recorded.node_ids, pa.string())}
    return pa.table(named | {name: _column(values) for name, values in columns.items()}).cast(VEHICLES)


def _distances_table(pairs: _Pairs, bin_m: float) -> pa.Table:
    known = np.isfinite(pairs.distance_m)
    place = (pairs.distance_m[known] // bin_m).astype(np.intp)
    tried = np.bincount(place)
    heard = np.bincount(place[pairs.delivered[known]], minlength=len(tried))
    bins = np.flatnonzero(tried)
    columns = {
        "from_m": bins * bin_m,
        "to_m": (bins + 1) * bin_m,
        "pairs": tried[bins],
        "delivered": heard[bins],
        "delivery_ratio": heard[bins] / tried[bins],
    }
    return pa.table({name: _column(values) for name, values in columns.items()}).cast(DISTANCES)


def _totals(pairs: _Pairs, figures: dict[str, Array]) -> dict[str, float | None]:
    """Over all pairs; means of ages and inter-reception times are over links."""
    latency_ms = (pairs.arrival_ns - pairs.sent_ns)[pairs.delivered] / NS_PER_MS
    totals = {
        "links": len(figures["pairs"]),
        "pairs": len(pairs.link),
        "delivered": int(pairs.delivered.sum()),
        "delivery_ratio": _mean(pairs.delivered.astype(float)),
        "latency_mean_ms": _mean(latency_ms),
    }
    for name in ("inter_reception_mean_ms", "inter_reception_p95_ms", "age_mean_ms", "age_peak_ms"):
        totals[name] = _mean(figures[name][np.isfinite(figures[name])])
    return totals


def _mean(values: Array) -> float | None:
    return float(values.mean()) if values.size else None


def _column(values: Numbers) -> pa.Array:
    """Numbers as a column; null where they are NaN."""
    return pa.array(values, mask=np.isnan(values))


def sent_by_programs(recorded: RecordedRun) -> Mask:
    """Return the mask of the rows of frames that programs sent, each attempt included.

    What faults send again, its retries, and duplicates of a reception are left out. A retry is a copy as those are;
    but a sender ends one exchange before it begins another of the same frame.
    """
    mask: Mask = np.asarray(recorded.copy == 0)
    if not recorded.attempt.any():
        return mask
    rows = np.flatnonzero((recorded.attempt > 0) & (recorded.on_air_ns >= 0))
    frame, on_air_ns = recorded.frame[rows], recorded.on_air_ns[rows]
    order = np.lexsort((recorded.copy[rows], on_air_ns, frame))
    twice = (np.diff(frame[order]) == 0) & (np.diff(on_air_ns[order]) == 0)
    rows = rows[order[np.append(True, ~twice)[: len(order)]]]
    first = np.flatnonzero(recorded.attempt[rows] == 1)
    exchange = np.searchsorted(first, np.arange(len(rows)), side="right") - 1
    known = exchange >= 0
    mask[rows[known]] = recorded.copy[rows[first]][exchange[known]] == 0
    return mask


@dataclass(frozen=True)
class UnicastFigures:
    """Frames to single vehicles: sent, acknowledged, and transmissions beyond the first of each."""

    sent: int
    acknowledged: int
    retries: int

    def __str__(self) -> str:
        """Return the figures in one line."""
        share = f"{self.acknowledged / self.sent:.2%}"
        return f"{self.sent:,} sent, {self.acknowledged:,} acknowledged: {share}; {self.retries:,} retries"


def unicast_figures(
    recorded: RecordedRun, within_m: float = math.inf, from_s: float = 0.0
) -> UnicastFigures | None:
    """Return the figures of a run without what faults send again; None without frames to single vehicles.

    Frames to receivers farther than `within_m`, and those that were enqueued before `from_s`, are left out.
    """
    rows = np.flatnonzero((recorded.attempt > 0) & sent_by_programs(recorded))
    rows = _chosen(recorded, rows, within_m, round(from_s * NS_PER_S))
    if not len(rows):
        return None
    frame = recorded.frame[rows]
    return UnicastFigures(
        sent=len(np.unique(frame)),
        acknowledged=len(np.unique(frame[recorded.acked[rows]])),
        retries=int((recorded.attempt[rows] > 1).sum()),
    )
