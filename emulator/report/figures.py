"""The figures of a run's report, each from the run's own files."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import pyarrow as pa

from emulator.pages.canvas import (
    BLUE,
    CURVES,
    GREEN,
    GREY,
    INK,
    QUIET,
    RED,
    Canvas,
    canvas,
    legend,
    whole_numbers,
)
from emulator.radio.outcomes import DRAWN, Outcome
from emulator.radio.topology import component_links
from emulator.records.distributions import binomial_interval
from emulator.records.events import EventKind
from emulator.records.metrics import ReferenceFailedError, anees_band
from emulator.records.period_figures import DeclaredChart
from emulator.records.radio_metrics import BIN_M, rows_of_pairs
from emulator.records.reported import named_numbers
from emulator.records.tables import DRIVEN, of_vehicles
from emulator.report.drawing import DASHES, Chart, Drawing, Line, draw_charts, faults_note, time_figure
from emulator.report.map_figures import map_charts
from emulator.report.program_figures import Drawers, program_charts
from emulator.report.radio_figures import ages, busy, latency, outcomes, totals
from emulator.report.source import NothingToShow, Source
from emulator.world.radio_inputs import LinkTable
from emulator.world.world import components
from vnet.errors import VnetError, printable
from vnet.types import Array, IntArray
from vnet.units import title_of

MOST_LINKS = 800
"""Links up to which each has a point; more are shown in bins."""
MOST_IN_MATRIX = 150
"""Vehicles of which the matrix of values of each pair is readable."""
DISTANCE_BINS = 25
LINK_BAND = 0.99
"""Share of the links that lie in the drawn band by chance alone."""
OPACITY = {0.05: 0.16, 0.1: 0.32, 0.2: 0.52, 0.4: 0.76, 1.0: 1.0}
"""Opacity of a value of a pair, by the largest that has it."""


def links(source: Source) -> Drawing:
    """Draw the packet delivery ratio of the links against their length: that of broadcasts."""
    count = len(source.node_ids)
    cast = rows_of_pairs(source)
    if not len(cast):
        raise NothingToShow("no broadcast was sent to anybody in range")
    sender, receiver = source.sender[cast], source.receiver[cast]
    link = sender * count + receiver
    rows = np.bincount(link, minlength=count * count)
    used = np.flatnonzero(rows)
    delivered = np.bincount(link, weights=source.outcome_is("delivered")[cast], minlength=count * count)
    share = 100 * delivered[used] / rows[used]
    apart_m = source.places.pair_distances_m(sender, receiver, source.sent_ns[cast])
    known = np.isfinite(apart_m)
    total_m = np.bincount(link[known], weights=apart_m[known], minlength=count * count)
    distance_km = total_m[used] / np.maximum(np.bincount(link[known], minlength=count * count), 1)[used] / 1000
    physical, binned = source.scenario.radio.is_physical, source.moves or source.scenario.radio.is_physical
    alike = not physical and not isinstance(source.radio_inputs.links, LinkTable)
    made = canvas("distance (km)", "delivery ratio (%)")
    if len(used) <= MOST_LINKS:
        dots: dict[str, Any] = {"linestyle": "none", "marker": "o", "markersize": 4, "markeredgewidth": 0}
        made.axes.plot(distance_km, share, color=BLUE, alpha=0.55, label="a link", **dots)
    else:
        _draw_bins(made, distance_km, share)
    each = f"each of {len(used):,} links" if len(used) > 1 else "the one link"
    text = f"Packet delivery ratio of {each}, from one vehicle to another."
    if (source.attempt > 0).any():
        text += " Frames to one vehicle are not counted."
    lowest = float(share.min())
    if alike:
        low, band = _draw_expected(made, source.scenario.radio.loss, int(np.median(rows[used])))
        lowest, text = min(lowest, low), text + band + _why_less(source, cast)
    farthest_km = float(distance_km.max())
    if binned:
        least, last_km = _draw_frames(made, source.radio.distances)
        lowest, farthest_km = min(lowest, least), max(farthest_km, last_km)
    made.axes.set_xlim(0, max(farthest_km * 1.03, 1e-3))
    made.axes.set_ylim(max(0, np.floor((lowest - 3) / 10) * 10), 102)
    made.axes.set_yticks([tick for tick in made.axes.get_yticks() if tick <= 100])
    made.axes.set_ylim(top=102)
    legend(made)
    return Drawing(made, text)


def _draw_expected(made: Canvas, loss: float, frames: int) -> tuple[float, str]:
    """Draw the expected ratio of links that all lose alike; returns its lower bound in percent, and a caption."""
    low, high = (100 * edge / frames for edge in binomial_interval(LINK_BAND, frames, 1 - loss))
    label = f"expected: {100 * (1 - loss):g} %"
    made.axes.axhline(100 * (1 - loss), color=RED, linestyle=DASHES[1], label=label, zorder=2.5)
    if low == high:
        return low, ""
    made.axes.axhspan(low, high, color=RED, alpha=0.12, linewidth=0, zorder=0.6)
    return low, f" Band: {LINK_BAND:.0%} of links with {frames:,} frames lie in it by chance alone."


def _draw_bins(made: Canvas, distance_km: Array, share: Array) -> None:
    """Draw the median by distance, and the range of nine of ten links."""
    edges = np.linspace(0, distance_km.max(), 25)
    index = np.clip(np.digitize(distance_km, edges) - 1, 0, len(edges) - 2)
    filled = np.unique(index)
    middle = ((edges[:-1] + edges[1:]) / 2)[filled]
    low, median, high = np.array([np.percentile(share[index == i], [5, 50, 95]) for i in filled]).T
    made.axes.fill_between(middle, low, high, color=BLUE, alpha=0.25, linewidth=0, label="9 of 10 links")
    made.axes.plot(middle, median, color=BLUE, label="median")


def _draw_frames(made: Canvas, bins: pa.Table) -> tuple[float, float]:
    """Draw the ratio of all frames by distance, in at most `DISTANCE_BINS` bins.

    Returns the least in percent, and the largest distance in km.
    """
    from_m, pairs, delivered = (bins[name].to_numpy() for name in ("from_m", "pairs", "delivered"))
    width_m = BIN_M * int(np.ceil((from_m.max(initial=0) + BIN_M) / BIN_M / DISTANCE_BINS))
    index = (from_m // width_m).astype(np.intp)
    filled = np.unique(index)
    share = 100 * np.bincount(index, delivered)[filled] / np.bincount(index, pairs)[filled]
    middle_km = (filled + 0.5) * width_m / 1000
    made.axes.plot(middle_km, share, color=INK, label=f"all frames, by {width_m:g} m")
    return float(share.min(initial=100)), float(middle_km.max(initial=0))


def _why_less(source: Source, cast: IntArray) -> str:
    """The outcomes besides `lost` that lower a link's delivery ratio, of some rows of the trace."""
    others = (outcome.name for outcome in DRAWN if outcome not in (Outcome.delivered, Outcome.lost))
    names = [name for name in others if source.outcome_is(name)[cast].any()]
    return f" Links below it had outcomes {', '.join(names)} as well." if names else ""


def degrees(source: Source) -> Drawing:
    """Draw the distribution of the vehicles' degrees: how many others each has in range."""
    if not source.node_ids:
        raise VnetError("no period was completed, and no position is known")
    degree = source.places.mean_senders_in_range()
    step = int(np.ceil((degree.max() + 1) / 40))
    edges = np.arange(0, degree.max() + step + 1, step) - 0.5
    counts, _ = np.histogram(degree, edges)
    made = canvas("degree (vehicles in range)", "vehicles")
    made.axes.bar(edges[:-1] + step / 2, counts, width=0.85 * step, color=BLUE)
    made.axes.axvline(degree.mean(), color=RED, linestyle=DASHES[1], label=f"mean {degree.mean():.1f}")
    if degree.max() > source.scenario.radio.max_peers:
        cap = source.scenario.radio.max_peers
        made.axes.axvline(cap + 0.5, color=INK, linestyle=DASHES[2], label=f"peer cap {cap}")
    made.axes.set_xlim(edges[0] - 0.3, max(edges[-1], 4) + 0.3)
    from matplotlib.ticker import MaxNLocator

    made.axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    whole_numbers(made.axes)
    legend(made)
    radio = source.scenario.radio
    how = f"within {radio.range_m / 1000:g} km" if radio.links is None else "by the scenario's links"
    if radio.path_loss is not None:
        how = f"with {radio.path_loss.floor_dbm:g} dBm or more on average"
    if source.moves:
        return Drawing(
            made,
            f"Number of vehicles that each can hear, {how}; mean over its time in the network.",
        )
    start_m = source.places.position_m(0)
    links = component_links(source.scenario, source.radio_inputs, start_m)
    parts = int(components(start_m, links).max()) + 1
    if source.topology_changes:
        how += ", in the mean over the run"
    network = "one component" if parts == 1 else f"{parts} components out of range of each other"
    return Drawing(made, f"Number of vehicles that each can hear, {how}: {network}.")


def peers(name: str, source: Source) -> Drawing:
    """Draw the matrix of the mean value, between 0 and 1, that vehicles report for each other by this name."""
    ids = source.node_ids
    matrix = mean_of_peers(f"{name}.", source)
    if len(ids) > MOST_IN_MATRIX:
        raise VnetError(f"a matrix of {len(ids)} vehicles would not be readable")
    made = canvas("for vehicle", "reporting vehicle", plot_px=270)
    from matplotlib.patches import Patch, PathPatch
    from matplotlib.path import Path as Outline

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
        made, f"Row by row the mean {title_of(name)} that a vehicle reported for each other one and itself."
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


def mean_of_peers(prefix: str, source: Source) -> Array:
    """Return the mean values (N, N) that vehicles (rows) gave others (columns), over their reports with any.

    Raises VnetError if nobody reported any.
    """
    count = len(source.node_ids)
    row, name, weight = named_numbers(source.states["values"].combine_chunks(), prefix)
    names = name.dictionary_encode()
    numbers = [source.number.get(name.removeprefix(prefix), -1) for name in names.dictionary.to_pylist()]
    of = np.array(numbers, dtype=np.intp)[names.indices.to_numpy()]
    node = np.array([source.number[node] for node in source.states["node"].to_pylist()], dtype=np.intp)
    at, fits = node[row], (of >= 0) & np.isfinite(weight)
    if not fits.any():
        raise NothingToShow("no program reported any")
    total = np.bincount((at * count + of)[fits], weights=weight[fits], minlength=count * count)
    reports = np.bincount(node[np.unique(row)], minlength=count)
    return np.asarray(total.reshape(count, count) / np.maximum(1, reports)[:, None])


def _lines(source: Source, names: Mapping[str, str]) -> list[Line]:
    """Return columns of the metrics by label; those that no program reported are dropped.

    Raises VnetError if none is left.
    """
    found: list[Line] = []
    problem: VnetError = NothingToShow("")
    for (label, name), colour, dash in zip(names.items(), (BLUE, RED, GREEN), DASHES, strict=False):
        try:
            found.append(Line(label, source.time_s, source.metric(name), colour, dash))
        except VnetError as error:
            problem = error
    if not found:
        raise problem
    return found


def declared_chart(chart: DeclaredChart, source: Source) -> Drawing:
    """Draw figures that the program declares to belong together."""
    lines = _lines(source, chart.lines)
    text = chart.text + _add_reference(source, next(iter(chart.lines.values())), lines)
    made = time_figure(lines, chart.axis, source.end_s, source.spans)
    return Drawing(made, text + faults_note(made, source))


def _add_reference(source: Source, name: str, lines: list[Line]) -> str:
    """Add a line of the reference's figure of this name, if there is one; returns the caption's sentence on it.

    It compares the means after the first fifth of the run with those of the first line.
    """
    try:
        series = source.reference_series
    except ReferenceFailedError as error:
        return f" No reference: {error}."
    except VnetError:
        return ""
    if name not in series:
        return ""
    label, value = source.reference.name, series[name][: len(source.time_s)]
    settled = slice(len(value) // 5, len(value))
    mean_m, least_m = (float(np.sqrt(np.nanmean(each[settled] ** 2))) for each in (lines[0].value, value))
    ratio = f": {mean_m / least_m:.2f} times the {label} after the first fifth of the run" if least_m > 0 else ""
    lines.append(Line(label, source.time_s, value, GREEN, DASHES[2]))
    return f" {label.capitalize()}: {source.reference.text}{ratio}."


def position(source: Source) -> Drawing:
    """Draw the errors of the estimated positions and of the raw fixes."""
    if not source.estimates_positions:
        raise NothingToShow("no program estimated its position")
    lines = _lines(source, {"estimates": "position_rmse_m", "raw fixes": "fix_rmse_m"})
    text = "Distance of the vehicles' estimates, and of their receivers' raw fixes, from the true positions."
    text += _add_reference(source, "position_rmse_m", lines)
    made = time_figure(lines, "RMSE of position (m)", source.end_s, source.spans)
    return Drawing(made, text + faults_note(made, source))


def consistency(source: Source) -> Drawing:
    """Draw the normalized squared errors of the filters."""
    names = [name for name in source.metrics.column_names if name.endswith("_anees")]
    if not source.estimates_positions:
        names.remove("position_anees")
    names.sort(key="position_anees".__eq__)
    lines = _lines(source, {title_of(name.removesuffix("_anees")): name for name in names})
    made = time_figure(lines, "ANEES (1 = consistent)", source.end_s, source.spans)
    count = int(np.median(source.metrics["reporting"].to_numpy())) or 1
    low, high = anees_band(count)
    made.axes.axhspan(low, high, color=GREY, alpha=0.25, linewidth=0, zorder=0.6)
    made.axes.axhline(1, color=QUIET, linewidth=1, zorder=0.7)
    bottom, top = made.axes.get_ylim()
    made.axes.set_ylim(min(bottom, low / 1.1), max(top, high * 1.1))
    text = (
        f"Normalized estimation error squared, averaged. Above 1 a filter is overconfident. Grey: 95 % band of "
        f"{count} independent estimates, {low:.2f} to {high:.2f}; dependent ones spread further."
    )
    return Drawing(made, text + faults_note(made, source))


MOST_LINES = 12
"""Vehicles that have a line each; of more, every so many has one."""


def speeds(source: Source) -> Drawing:
    """Draw the true speeds of driven vehicles against time, with the instants of collisions."""
    table, units = source.table(DRIVEN), source.scenario.roadside
    nodes = source.node_ids[: len(source.node_ids) - len(units)]
    if table is None or not len(table) or not nodes:
        raise NothingToShow("no program drives")
    time_s, speed = of_vehicles(table, "speed_m_s", len(nodes))
    shown = np.unique(np.linspace(0, len(nodes) - 1, min(len(nodes), MOST_LINES)).round().astype(int)).tolist()
    styles = [(CURVES[i % len(CURVES)], DASHES[i // len(CURVES) % len(DASHES)]) for i in range(len(shown))]
    lines = [Line(nodes[n], time_s, speed[:, n], *style) for n, style in zip(shown, styles, strict=True)]
    made = time_figure(lines, "speed (m/s)", source.end_s, source.spans, linear=True)
    collisions = source.event(EventKind.collision)
    for event in collisions:
        made.axes.axvline(event.time_ns / 1e9, color=GREY, linewidth=0.8, zorder=0.8)
    some = f"{len(shown)} of {len(nodes)} vehicles" if len(shown) < len(nodes) else "All vehicles"
    crashed = f" Grey lines: collisions ({len(collisions)})." if collisions else " No collision."
    return Drawing(made, f"{some}; true speeds.{crashed}{faults_note(made, source)}")


FIGURES: dict[str, tuple[str, Callable[[Source], Drawing]]] = {
    "position": ("Position", position),
    "speeds": ("Speed of driven vehicles", speeds),
    "outcomes": ("Outcomes over time", outcomes),
    "totals": ("Outcomes in total", totals),
    "busy": ("Channel busy ratio", busy),
    "links": ("Packet delivery ratio against distance", links),
    "latency": ("Latency", latency),
    "ages": ("Inter-packet gap and age of information", ages),
    "consistency": ("Consistency of the filters", consistency),
    "degrees": ("Node degrees", degrees),
}
"""Title and drawing by id, in the order of the page. A figure without data raises NothingToShow."""


def figures_of(source: Source) -> Drawers:
    """Return title and drawing of the figures of a run, by id: those that its program declares around vnet's."""
    first = {each.id: (each.title, partial(declared_chart, each)) for each in source.views.charts}
    last = {
        f"peers-{name}": (f"{title_of(name).capitalize()} by vehicle", partial(peers, name))
        for name in source.views.peers
    }
    of_run: dict[str, tuple[str, Callable[[Source], Drawing]]] = {**first, **FIGURES, **last}
    return {key: (title, partial(figure, source)) for key, (title, figure) in of_run.items()}


@dataclass(frozen=True)
class Charts:
    """The charts of a run, and the titles of those that cannot be drawn, by reason."""

    map: list[Chart]
    program: list[Chart]
    figures: list[Chart]
    missing: dict[str, list[str]]


def draw(source: Source) -> Charts:
    """Draw all figures of a run."""
    network, program, figures = (
        draw_charts(each) for each in (map_charts(source), program_charts(source), figures_of(source))
    )
    missing: dict[str, list[str]] = {}
    for _, problems in (network, program, figures):
        for reason, titles in problems.items():
            missing.setdefault(reason, []).extend(titles)
    return Charts(network[0], program[0], figures[0], missing)
