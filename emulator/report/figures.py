"""The figures of a run's report, each from the run's own files.

A figure that has nothing to show raises VnetError with the reason, which the report says in its place.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from matplotlib.patches import Patch, PathPatch
from matplotlib.path import Path as Outline
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray
from scipy.stats import binom

from emulator.pages.canvas import (
    BLUE,
    GREEN,
    GREY,
    INK,
    QUIET,
    RED,
    SKY,
    Canvas,
    Span,
    canvas,
    from_zero,
    legend,
    logarithmic,
    styled,
    thin,
    to_svg,
    whole_numbers,
)
from emulator.pages.palette import PALETTE
from emulator.radio.medium import WINDOW_NS
from emulator.radio.outcomes import DRAWN
from emulator.records.metrics import anees_band
from emulator.records.radio_metrics import BIN_M
from emulator.report.source import Source
from emulator.world.world import components
from vnet.errors import VnetError, printable
from vnet.types import Array

OUTCOME_COLOURS = {outcome.name: PALETTE[outcome.facts.colour].light for outcome in DRAWN}
DASHES: tuple[Any, ...] = ("-", (0, (4, 1.8)), (0, (1.2, 1.4)))
MOST_BINS = 80
MOST_BARS = 10
MOST_LINKS = 800
"""With more links than that, bins are shown instead of a point for each."""
MOST_IN_MATRIX = 150
DISTANCE_BINS = 25
WIDE_RANGE = 8.0
"""With more than that between the least and the largest value, an axis is logarithmic."""
LINK_BAND = 0.99
OPACITY = {0.05: 0.16, 0.1: 0.32, 0.2: 0.52, 0.4: 0.76, 1.0: 1.0}
"""How dark a fusion weight is, up to which weight."""
TIME = "emulated time (s)"


@dataclass(frozen=True)
class Line:
    """A line against time: its label, times (n,) in seconds, values (n,) with NaN as gaps, and how it looks."""

    label: str
    time_s: Array
    value: Array
    colour: str
    dash: Any = "-"


@dataclass(frozen=True)
class Drawing:
    """A figure, and how to read it."""

    canvas: Canvas
    caption: str


@dataclass(frozen=True)
class Chart:
    """A figure as it stands in a page."""

    key: str
    title: str
    svg: str
    caption: str


# Against time.


def time_figure(
    lines: Sequence[Line], y_label: str, end_s: float, spans: Sequence[Span] = (), linear: bool = False
) -> Canvas:
    """Lines against time, spans of faults behind them; logarithmic if they spread far, unless `linear`."""
    rows = 1 if len(lines) > 1 else 0
    made = canvas(TIME, y_label, rows, spans, end_s)
    for line in lines:
        marker = "o" if np.isfinite(line.value).sum() < 3 else None
        shown: dict[str, Any] = {
            "color": line.colour,
            "linestyle": line.dash,
            "marker": marker,
            "label": line.label,
        }
        made.axes.plot(*thin(line.time_s, line.value), **shown)
    everything = np.concatenate([line.value[np.isfinite(line.value)] for line in lines])
    positive = everything[everything > 0]
    if not linear and len(positive) and positive.max() > WIDE_RANGE * positive.min():
        logarithmic(made.axes)
    else:
        from_zero(made.axes)
    if rows:
        legend(made)
    return made


def _lines(source: Source, names: dict[str, str]) -> list[Line]:
    """Columns of the metrics by label, so far as somebody reported what they need. Raises VnetError for none."""
    found: list[Line] = []
    problem = VnetError("")
    for (label, name), colour, dash in zip(names.items(), (BLUE, RED, GREEN), DASHES, strict=False):
        try:
            found.append(Line(label, source.time_s, source.metric(name), colour, dash))
        except VnetError as error:
            problem = error
    if not found:
        raise problem
    return found


def _faults_note(made: Canvas, source: Source) -> str:
    if not source.spans:
        return ""
    unnamed = f"; {made.unnamed} more are not named for want of room" if made.unnamed else ""
    return f" Shaded: while a fault acted, named above{unnamed}."


def common_error(source: Source) -> Drawing:
    lines = _lines(source, {"RMSE": "common_error_rmse_m", "deviation": "deviation_m"})
    made = time_figure(lines, "common error (m)", source.end_s, source.spans)
    text = "How far the vehicles' estimates are from the true common error, and from their own mean."
    return Drawing(made, text + _faults_note(made, source))


def position(source: Source) -> Drawing:
    lines = _lines(source, {"estimates": "position_rmse_m", "raw fixes": "fix_rmse_m"})
    made = time_figure(lines, "RMSE of position (m)", source.end_s, source.spans)
    text = "How far the vehicles' own estimates, and the raw fixes of their receivers, are from where they are."
    return Drawing(made, text + _faults_note(made, source))


def consensus(source: Source) -> Drawing:
    lines = _lines(source, {"consensus error": "consensus_error_m"})
    made = time_figure(lines, "consensus error (m)", source.end_s, source.spans)
    text = "How far the means that vehicles hold are from the mean of their component's estimates."
    return Drawing(made, text + _faults_note(made, source))


def consistency(source: Source) -> Drawing:
    lines = _lines(source, {"common error": "common_error_anees", "position": "position_anees"})
    made = time_figure(lines, "ANEES (1 = consistent)", source.end_s, source.spans)
    count = int(np.median(source.metrics["reporting"].to_numpy())) or 1
    low, high = anees_band(count)
    made.axes.axhspan(low, high, color=GREY, alpha=0.25, linewidth=0, zorder=0.6)
    made.axes.axhline(1, color=QUIET, linewidth=1, zorder=0.7)
    bottom, top = made.axes.get_ylim()
    made.axes.set_ylim(min(bottom, low / 1.1), max(top, high * 1.1))
    text = (
        f"Squared errors over what the filters expect of them. Above 1 a filter is too sure of itself. Grey: 95 % "
        f"band of {count} independent estimates, {low:.2f} to {high:.2f}; those of the common error are not "
        "independent, and stray further."
    )
    return Drawing(made, text + _faults_note(made, source))


def outcomes(source: Source) -> Drawing:
    names, code, decided_s = decided(source)
    period_s = source.scenario.period_ns / 1e9
    periods = max(1, int(np.ceil(source.end_s / period_s - 1e-9)))
    width_s = int(np.ceil(periods / MOST_BINS)) * period_s
    bins = int(np.ceil(periods * period_s / width_s - 1e-9))
    place = np.minimum((decided_s / width_s).astype(np.intp), bins - 1)
    counts = np.bincount(place * len(names) + code, minlength=bins * len(names)).reshape(bins, len(names))
    share = 100 * counts / np.maximum(1, counts.sum(axis=1, keepdims=True))
    shown = [number for number, name in enumerate(names) if counts[:, number].any() and name in OUTCOME_COLOURS]
    made = canvas(TIME, "share of pairs (%)", int(np.ceil(len(shown) / 3)), source.spans, source.end_s)
    edges = np.minimum(np.arange(bins + 1) * width_s, source.end_s)
    below = np.zeros(bins)
    for number in shown:
        above = below + share[:, number]
        low, high = (np.append(some, some[-1]) for some in (below, above))
        drawn: dict[str, Any] = {"color": OUTCOME_COLOURS[names[number]], "linewidth": 0, "label": names[number]}
        made.axes.fill_between(edges, low, high, step="post", zorder=0.6, **drawn)
        below = above
    made.axes.set_ylim(0, 100)
    legend(made)
    text = f"What became of the pairs of a frame and a receiver in range, in stretches of {width_s:g} s."
    return Drawing(made, text + _faults_note(made, source))


def decided(source: Source) -> tuple[list[str], NDArray[np.intp], Array]:
    """Names of outcomes, and each row's number among them and when it was decided, in seconds."""
    trace = source.recorded.trace
    if not len(trace):
        raise VnetError("no frame was sent to anybody in range")
    column = trace["outcome"].combine_chunks()
    code = np.asarray(column.indices.to_numpy(), dtype=np.intp)
    left = "left_ns" if "left_ns" in trace.column_names else "sent_ns"
    decided_ns = pc.coalesce(trace["arrival_ns"], trace[left]).to_numpy()
    return column.dictionary.to_pylist(), code, decided_ns / 1e9


def busy(source: Source) -> Drawing:
    percent = 100 * source.busy_ratio
    end_s = np.arange(1, len(percent) + 1) * WINDOW_NS / 1e9
    lines = [
        Line("mean", end_s, percent.mean(axis=1), BLUE),
        Line("busiest", end_s, percent.max(axis=1), RED, DASHES[1]),
    ]
    made = time_figure(lines, "busy ratio (%)", source.end_s, source.spans, linear=True)
    text = "The share of the time in which vehicles sensed the medium taken, in windows of 100 ms."
    return Drawing(made, text + _faults_note(made, source))


# Over the whole run.


def totals(source: Source) -> Drawing:
    trace = source.recorded.trace
    if not len(trace):
        raise VnetError("no frame was sent to anybody in range")
    bars = _bars(trace)
    made = canvas("share of pairs (%)", "outcome", plot_px=31 * len(bars) + 6)
    axes = made.axes
    for row, (label, outcome, count) in enumerate(bars):
        share = 100 * count / len(trace)
        axes.barh(row + 0.7, 100, height=0.26, color=GREY, alpha=0.18)
        axes.barh(row + 0.7, share, height=0.26, color=OUTCOME_COLOURS.get(outcome, GREY))
        axes.text(0, row + 0.45, printable(label, 32))
        axes.text(100, row + 0.45, f"{count:,}  ·  {share:.2f} %", ha="right", color=QUIET)
    axes.set(xlim=(0, 100), ylim=(len(bars) + 0.1, 0))
    axes.yaxis.set_ticks([])
    text = f"What became of all {len(trace):,} pairs of a frame and a receiver in range."
    return Drawing(made, text + (" Faults by name." if any(o == "fault" for _, o, _ in bars) else ""))


def _bars(trace: pa.Table) -> list[tuple[str, str, int]]:
    """Label, outcome and count of each bar; those cut by faults by the fault's name."""
    counts = trace.select(["outcome", "cause"]).group_by(["outcome", "cause"]).aggregate([([], "count_all")])
    found: dict[tuple[str, str], int] = {}
    for row in counts.to_pylist():
        label = row["cause"] if row["outcome"] == "fault" else row["outcome"]
        key = (str(label), str(row["outcome"]))
        found[key] = found.get(key, 0) + row["count_all"]
    order = {outcome.name: number for number, outcome in enumerate(DRAWN)}
    bars = [(label, outcome, count) for (label, outcome), count in found.items()]
    bars.sort(key=lambda bar: (order.get(bar[1], len(order)), -bar[2]))
    shown, others = bars[:MOST_BARS], bars[MOST_BARS:]
    return shown + ([("others", "", sum(count for _, _, count in others))] if others else [])


def links(source: Source) -> Drawing:
    recorded = source.recorded
    count = len(recorded.node_ids)
    if not len(recorded.trace):
        raise VnetError("no frame was sent to anybody in range")
    link = recorded.sender * count + recorded.receiver
    rows = np.bincount(link, minlength=count * count)
    used = np.flatnonzero(rows)
    delivered = np.bincount(link, weights=recorded.outcome_is("delivered"), minlength=count * count)
    share = 100 * delivered[used] / rows[used]
    apart_m = recorded.places.pair_distances_m(recorded.sender, recorded.receiver, recorded.sent_ns)
    known = np.isfinite(apart_m)
    total_m = np.bincount(link[known], weights=apart_m[known], minlength=count * count)
    distance_km = total_m[used] / np.maximum(np.bincount(link[known], minlength=count * count), 1)[used] / 1000
    physical, binned = source.scenario.radio.is_physical, recorded.moves or source.scenario.radio.is_physical
    labels = 1 + (len(used) > MOST_LINKS) + (not physical) + binned
    made = canvas("distance (km)", "delivered (%)", legend_rows=int(np.ceil(labels / 3)))
    if len(used) <= MOST_LINKS:
        dots: dict[str, Any] = {"linestyle": "none", "marker": "o", "markersize": 4, "markeredgewidth": 0}
        made.axes.plot(distance_km, share, color=BLUE, alpha=0.55, label="a link", **dots)
    else:
        _draw_bins(made, distance_km, share)
    text = f"The share that was delivered on each of {len(used):,} links, from one vehicle to another."
    lowest = float(share.min())
    if not physical:
        low, band = _draw_expected(made, source.scenario.radio.loss, int(np.median(rows[used])))
        lowest, text = min(lowest, low), text + band + _why_less(source)
    if binned:
        lowest = min(lowest, _draw_frames(made, source.radio.distances))
    made.axes.set_xlim(0, max(float(distance_km.max()) * 1.03, 1e-3))
    made.axes.set_ylim(max(0, np.floor((lowest - 3) / 10) * 10), 102)
    legend(made)
    return Drawing(made, text)


def ages(source: Source) -> Drawing:
    links, share = source.radio.links, np.linspace(0, 1, 101)
    lines = {
        "gap: mean": ("inter_reception_mean_ms", BLUE),
        "gap: 95 %": ("inter_reception_p95_ms", SKY),
        "age: mean": ("age_mean_ms", RED),
    }
    made = canvas("links, from the best to the worst (%)", "time (ms)", legend_rows=1)
    drawn = []
    for (label, (name, colour)), dash in zip(lines.items(), (DASHES[0], DASHES[2], DASHES[1]), strict=True):
        values_ms = links[name].drop_null().to_numpy()
        if len(values_ms):
            drawn.append(np.quantile(values_ms, share, method="inverted_cdf"))
            made.axes.plot(100 * share, drawn[-1], color=colour, linestyle=dash, label=label)
    if not drawn:
        raise VnetError("nothing was received twice on a link")
    made.axes.set_xlim(0, 100)
    least, most = np.min(drawn), np.max(drawn)
    if 0 < WIDE_RANGE * least < most:
        logarithmic(made.axes)
    else:
        from_zero(made.axes)
    legend(made)
    return Drawing(
        made,
        "Gap: from one reception of a sender's frames to the next. Age: how long ago the newest was sent that the "
        f"receiver has. Each line sorts the {len(links):,} links by its own figure.",
    )


def _draw_expected(made: Canvas, loss: float, frames: int) -> tuple[float, str]:
    """What links of so many frames deliver where distance makes no difference; how low that is, and in words."""
    low, high = (100 * edge / frames for edge in binom.interval(LINK_BAND, frames, 1 - loss))
    label = f"expected: {100 * (1 - loss):g} %"
    made.axes.axhline(100 * (1 - loss), color=RED, linestyle=DASHES[1], label=label, zorder=2.5)
    if low == high:
        return low, ""
    made.axes.axhspan(low, high, color=RED, alpha=0.12, linewidth=0, zorder=0.6)
    return low, f" Band: where {LINK_BAND:.0%} of links with {frames:,} frames are by chance alone."


def _draw_bins(made: Canvas, distance_km: Array, share: Array) -> None:
    """Medians, and where nine of ten links are, by distance."""
    edges = np.linspace(0, distance_km.max(), 25)
    place = np.clip(np.digitize(distance_km, edges) - 1, 0, len(edges) - 2)
    there = np.unique(place)
    middle = ((edges[:-1] + edges[1:]) / 2)[there]
    low, median, high = np.array([np.percentile(share[place == p], [5, 50, 95]) for p in there]).T
    made.axes.fill_between(middle, low, high, color=BLUE, alpha=0.25, linewidth=0, label="9 of 10 links")
    made.axes.plot(middle, median, color=BLUE, label="median")


def _draw_frames(made: Canvas, bins: pa.Table) -> float:
    """The share of all frames by distance, in at most `DISTANCE_BINS` bins; returns the least."""
    from_m, pairs, delivered = (bins[name].to_numpy() for name in ("from_m", "pairs", "delivered"))
    width_m = BIN_M * int(np.ceil((from_m.max(initial=0) + BIN_M) / BIN_M / DISTANCE_BINS))
    place = (from_m // width_m).astype(np.intp)
    there = np.unique(place)
    share = 100 * np.bincount(place, delivered)[there] / np.bincount(place, pairs)[there]
    made.axes.plot((there + 0.5) * width_m / 1000, share, color=INK, label=f"all frames, by {width_m:g} m")
    return float(share.min(initial=100))


def _why_less(source: Source) -> str:
    names = [name for name in ("peer_cap", "fault", "receiver_down") if source.recorded.outcome_is(name).any()]
    return f" Links below it met {', '.join(names)} as well." if names else ""


def latencies_ms(source: Source) -> Array:
    """(k,) from sending to arrival of each delivery. Raises VnetError if there is none."""
    recorded = source.recorded
    delivered = recorded.outcome_is("delivered")
    if not delivered.any():
        raise VnetError("nothing was delivered")
    return np.asarray((recorded.arrival_ns[delivered] - recorded.sent_ns[delivered]) / 1e6)


def latency(source: Source) -> Drawing:
    latency_ms = latencies_ms(source)
    median, late, latest = np.percentile(latency_ms, [50, 99, 100])
    shown_ms = min(latest, 2.5 * np.percentile(latency_ms, 99.5))
    counts, edges = np.histogram(latency_ms, bins=50, range=(0, max(shown_ms * 1.02, 1e-3)))
    made = canvas("latency (ms)", "deliveries", legend_rows=1)
    made.axes.stairs(counts, edges, fill=True, color=BLUE, alpha=0.8)
    made.axes.axvline(median, color=RED, linestyle=DASHES[1], label=f"median {median:.2f} ms")
    made.axes.axvline(late, color=GREEN, linestyle=DASHES[2], label=f"99 % within {late:.2f} ms")
    made.axes.set_xlim(0, edges[-1])
    whole_numbers(made.axes)
    legend(made)
    beyond = int((latency_ms > edges[-1]).sum())
    further = f" {beyond:,} more took longer, up to {latest:,.1f} ms." if beyond else ""
    return Drawing(made, f"From handing a frame over to its arrival, of {len(latency_ms):,} deliveries.{further}")


def degrees(source: Source) -> Drawing:
    recorded = source.recorded
    if not recorded.node_ids:
        raise VnetError("no period was completed, so nobody's position is known")
    degree = recorded.places.mean_senders_in_range()
    step = int(np.ceil((degree.max() + 1) / 40))
    edges = np.arange(0, degree.max() + step + 1, step) - 0.5
    counts, _ = np.histogram(degree, edges)
    made = canvas("others in range (vehicles)", "vehicles", legend_rows=1)
    made.axes.bar(edges[:-1] + step / 2, counts, width=0.85 * step, color=BLUE)
    made.axes.axvline(degree.mean(), color=RED, linestyle=DASHES[1], label=f"mean {degree.mean():.1f}")
    if degree.max() > source.scenario.radio.max_peers:
        cap = source.scenario.radio.max_peers
        made.axes.axvline(cap + 0.5, color=INK, linestyle=DASHES[2], label=f"peer cap {cap}")
    made.axes.set_xlim(edges[0] - 0.3, max(edges[-1], 4) + 0.3)
    made.axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    whole_numbers(made.axes)
    legend(made)
    radio = source.scenario.radio
    how = f"within {radio.range_m / 1000:g} km" if radio.links is None else "by the scenario's links"
    if radio.path_loss is not None:
        how = f"with {radio.path_loss.floor_dbm:g} dBm or more on average"
    if recorded.moves:
        return Drawing(
            made, f"How many vehicles each can hear, {how}, in the mean over the time in which it is there."
        )
    parts = int(components(recorded.places.position_m(0), radio.range_m, recorded.places.in_range(0)).max()) + 1
    network = "one connected network" if parts == 1 else f"{parts} networks that do not hear each other"
    return Drawing(made, f"How many vehicles each can hear, {how}: {network}.")


def weights(source: Source) -> Drawing:
    ids = source.recorded.node_ids
    matrix = mean_weights(source)
    if len(ids) > MOST_IN_MATRIX:
        raise VnetError(f"a matrix of {len(ids)} vehicles would not be readable")
    made = canvas("whose estimate (vehicle)", "at which vehicle", legend_rows=2, plot_px=270)
    level = np.searchsorted(list(OPACITY), matrix)
    handles = []
    least = 0.0
    for number, (largest, opacity) in enumerate(OPACITY.items()):
        corners = np.argwhere((level == number) & (matrix > 0))[:, ::-1]
        square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
        if len(corners):
            outline = Outline.make_compound_path_from_polys(corners[:, None] + square)
            made.axes.add_patch(PathPatch(outline, facecolor=BLUE, alpha=opacity, linewidth=0))
        handles.append(Patch(facecolor=BLUE, alpha=opacity, linewidth=0, label=f"{least:g}–{largest:g}"))
        least = largest
    _dress_matrix(made, [printable(node, 7) for node in ids])
    legend(made, handles)
    return Drawing(
        made, "Row by row what a vehicle gave each estimate when it mixed them, its own included; means."
    )


def _dress_matrix(made: Canvas, ids: Sequence[str]) -> None:
    axes = made.axes
    axes.set(xlim=(0, len(ids)), ylim=(len(ids), 0))
    every = int(np.ceil(len(ids) / 12))
    ticks = range(0, len(ids), every)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_ticks([tick + 0.5 for tick in ticks], [ids[tick] for tick in ticks])
        axis.set_tick_params(labelsize=9, length=0)
    axes.grid(visible=False)


def mean_weights(source: Source) -> Array:
    """(N, N): means of the weights that vehicles (rows) reported of others (columns), over their reports with any.

    Raises VnetError if nobody reported any.
    """
    recorded = source.recorded
    count = len(recorded.node_ids)
    lists = recorded.states["values"].combine_chunks().cast(pa.list_(_PAIR))
    row, pair = pc.list_parent_indices(lists).to_numpy(), pc.list_flatten(lists)
    key, value = pair.field("key"), pair.field("value")
    single = pc.and_(pc.starts_with(key, _WEIGHT), pc.equal(pc.list_value_length(value), 1))
    chosen = np.flatnonzero(pc.fill_null(single, False).to_numpy(zero_copy_only=False))
    names = key.take(pa.array(chosen)).dictionary_encode()
    numbers = [recorded.number.get(name.removeprefix(_WEIGHT), -1) for name in names.dictionary.to_pylist()]
    of = np.array(numbers, dtype=np.intp)[names.indices.to_numpy()]
    weight = pc.list_flatten(value.take(pa.array(chosen))).to_numpy(zero_copy_only=False)
    node = np.array([recorded.number[node] for node in recorded.states["node"].to_pylist()], dtype=np.intp)
    at, fits = node[row[chosen]], (of >= 0) & np.isfinite(weight)
    if not fits.any():
        raise VnetError("no program reported any (as values named weight.ID)")
    total = np.bincount((at * count + of)[fits], weights=weight[fits], minlength=count * count)
    reports = np.bincount(node[np.unique(row[chosen])], minlength=count)
    return np.asarray(total.reshape(count, count) / np.maximum(1, reports)[:, None])


_PAIR = pa.struct([("key", pa.string()), ("value", pa.list_(pa.float64()))])
_WEIGHT = "weight."

FIGURES: dict[str, tuple[str, Callable[[Source], Drawing]]] = {
    "common-error": ("Common error", common_error),
    "position": ("Position", position),
    "outcomes": ("Outcomes over time", outcomes),
    "totals": ("Outcomes in total", totals),
    "busy": ("Busy ratio of the medium", busy),
    "links": ("Delivery against distance", links),
    "latency": ("Latency", latency),
    "ages": ("Age of information, and gaps", ages),
    "consensus": ("Consensus error", consensus),
    "consistency": ("Consistency of the filters", consistency),
    "degrees": ("Degrees of the network", degrees),
    "weights": ("Fusion weights", weights),
}


@styled
def draw(source: Source) -> tuple[list[Chart], dict[str, str]]:
    """All figures of a run; and of those with nothing to show, why, by title."""
    charts, missing = [], {}
    for key, (title, figure) in FIGURES.items():
        try:
            drawing = figure(source)
        except VnetError as error:
            missing[title] = str(error)
            continue
        charts.append(Chart(key, title, to_svg(drawing.canvas.figure, key, title), drawing.caption))
    return charts, missing
