"""The whole network's part of a recording: the map, what vehicles believe, figures against time, faults, events."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr

from emulator.radio.outcomes import Outcome
from emulator.records.events import WARNING, EventKind, level_of
from emulator.records.metrics import Setting, reference_of
from emulator.records.period_figures import Views, figures_if_here
from emulator.records.run_folder import SCENARIO_FILE
from emulator.records.tables import STATES, columns_of
from emulator.scenario.loading import parse_recorded_scenario
from emulator.scenario.own_functions import declared, load_entry
from emulator.stream import unpack
from emulator.viewer.drawing import (
    BLUE,
    DARK,
    GREEN,
    GREY,
    ORANGE,
    OUTCOME_COLOURS,
    POSITION,
    PURPLE,
    RED,
    SKY,
    Canvas,
    Floats,
    PeriodArrays,
    drawable,
    ellipses,
    in_length,
    link_states,
    nice_length,
    outcome_colours,
)
from emulator.viewer.radio_scene import next_charts_s
from vnet.errors import VnetError, first_names
from vnet.types import Array

LANE_HALF_LENGTH_M = 250.0
ELLIPSES_EVERY_S = 1.0
"""Interval at which ellipses and clouds are drawn."""
CURVES = (RED, SKY, BLUE, ORANGE)
"""Colours of the curves of a chart that the program declares."""
LARGEST_MATRIX = 400
"""Vehicles of which a matrix is drawn."""
LOG_LEVELS = {"debug": "DEBUG", "warning": "WARN", "error": "ERROR", "critical": "CRITICAL"}
"""Rerun's names of the levels of a program's log."""
NAMED_DOWN = 6
ACTING, NOBODY = "acting", "none"
"""States of faults, and of those who are down."""
LEGEND_STEP = 3.1
"""From one name of the legend to the next; its rows are 1 apart."""


class OverviewScene:
    """Draws the network, from the scene and period messages of a run."""

    def __init__(self, canvas: Canvas, scene: Mapping[str, Any], views: Views) -> None:
        self._canvas = canvas
        self._views = views
        self._node_ids: list[str] = scene["node_ids"]
        try:
            self._reference: DrawnReference | None = DrawnReference(scene)
        except VnetError:
            self._reference = None
        self._published = published(scene)
        self._peers: dict[str, Floats] = {}
        """By name, the latest values that vehicles (rows) reported for others (columns)."""
        self._faults: set[str] = set()
        self._known_faults: set[str] = set()
        self._down: list[str] | None = None
        self._up: bytes | None = None
        self._clouds: dict[str, dict[str, Floats]] = {each.name: {} for each in views.estimates}
        """Each vehicle's latest, by estimate."""
        self._next_ellipses_s = self._next_peers_s = 0.0
        self._draw_static(scene)

    def _draw_static(self, scene: Mapping[str, Any]) -> None:
        canvas = self._canvas
        canvas.log("about", rr.TextDocument(describe(scene), media_type=rr.MediaType.MARKDOWN), static=True)
        point, heading = unpack(scene["lane_point_m"], 2), unpack(scene["lane_heading_rad"])[:, 0]
        length = unpack(scene["lane_length_m"])[:, 0]
        endless = np.isinf(length)
        ahead, behind = np.where(endless, LANE_HALF_LENGTH_M, length), np.where(endless, LANE_HALF_LENGTH_M, 0)
        along = np.column_stack([np.cos(heading), np.sin(heading)])
        lanes = np.stack([point - behind[:, None] * along, point + ahead[:, None] * along], axis=1)
        canvas.strip_style("map/lanes", (*GREY, 120), 1.0, -30.0)
        canvas.strips("map/lanes", lanes, static=True)
        if len(edges := unpack(scene["building_edge_m"], 2).reshape(-1, 2, 2)):
            canvas.strip_style("map/buildings", (*GREY, 200), 1.0, -29.0)
            canvas.strips("map/buildings", edges, static=True)
        self._set_styles()
        if units := tomllib.loads(scene["scenario"]).get("roadside", []):
            names = [unit["id"] for unit in units]
            canvas.point_style("map/roadside", ORANGE, 7.0, names, show_labels=True, order=29.0)
            canvas.points("map/roadside", [unit["position_m"] for unit in units], static=True)
        self._has_background = has_background(scene)
        if self._has_background:
            canvas.point_style("map/background", GREY, 1.5, order=-20.0)
        draw_scale(canvas, point if len(point) else unpack(scene["area_m"], 2))
        draw_legend(canvas, scene)
        for each in (POSITION, *self._views.estimates):
            canvas.rings(each.name, each.rings_m)
        for chart in self._views.charts:
            lines = [(label, colour, 2.0) for label, colour in zip(chart.lines, CURVES, strict=False)]
            first = next(iter(chart.lines.values()))
            if self._reference is not None:
                lines.append((self._reference.label, GREEN, 1.5))
            if first in self._published:
                lines.append((self._published[first][0], GREY, 1.5))
            canvas.series(f"figures/{chart.id}", lines)
        canvas.states("faults/down", {NOBODY: DARK})
        canvas.series("figures/position", [("estimate", SKY, 2.0), ("raw fix", GREY, 1.0)])

    def _set_styles(self) -> None:
        canvas = self._canvas
        canvas.strip_style("map/links", None, 1.8, -10.0)
        canvas.point_style("map/true", None, 5.0, self._node_ids)
        canvas.point_style("map/fix", GREY, 2.0)
        canvas.point_style("map/estimate", BLUE, 2.5, order=31.0)
        canvas.point_style("position/fix", GREY, 3.0, self._node_ids)
        canvas.point_style("position/estimate", SKY, 4.0, self._node_ids)
        for each in self._views.estimates:
            canvas.point_style(f"{each.name}/cloud", GREY, 1.0)
            canvas.point_style(f"{each.name}/estimate", SKY, 4.0, self._node_ids)
            canvas.strip_style(f"{each.name}/ellipses", (*SKY, 130), 1.2)

    def period(self, period: PeriodArrays) -> None:
        """Draw a period."""
        self._map(period)
        self._beliefs(period)
        self._figures(period)
        self._of_peers(period)
        self._faults_and_downs(period)
        self.events(period.message["events"])
        self._canvas.at(period.time_ns)

    def _map(self, period: PeriodArrays) -> None:
        canvas, position = self._canvas, period.points("position_m")
        sender, receiver, state = link_states(period)
        # Each direction is the half of the line that is nearer to its sender.
        halves = np.stack([position[sender], (position[sender] + position[receiver]) / 2], axis=1)
        canvas.strips("map/links", halves, outcome_colours(state))
        canvas.points("map/true", position)
        if self._has_background:
            canvas.points("map/background", period.points("background_m"))
        canvas.points("map/fix", period.points("fix_m"))
        canvas.points("map/estimate", period.points("estimate_m"))

    def _beliefs(self, period: PeriodArrays) -> None:
        canvas, position = self._canvas, period.points("position_m")
        canvas.points("position/fix", period.points("fix_m") - position)
        canvas.points("position/estimate", period.off_truth(POSITION))
        is_time = period.time_s >= self._next_ellipses_s
        if is_time:
            self._next_ellipses_s = period.time_s + ELLIPSES_EVERY_S
        for each in self._views.estimates:
            off_m, clouds = period.off_truth(each), self._clouds[each.name]
            canvas.points(f"{each.name}/estimate", off_m)
            clouds |= period.clouds(each)
            for node in period.down:
                clouds.pop(node, None)
            if is_time:
                canvas.strips(f"{each.name}/ellipses", ellipses(off_m, period.covariances(each.covariance)))
                if clouds:
                    canvas.points(f"{each.name}/cloud", np.concatenate([clouds[node] for node in sorted(clouds)]))

    def _figures(self, period: PeriodArrays) -> None:
        found = {} if self._reference is None else self._reference.step(period.message)
        for chart in self._views.charts:
            names = list(chart.lines.values())[: len(CURVES)]
            values = [period.figure(name) for name in names]
            if self._reference is not None:
                values.append(found.get(names[0], float("nan")))
            if names[0] in self._published:
                values.append(self._published[names[0]][1])
            self._canvas.plot(f"figures/{chart.id}", *values)
        self._canvas.plot("figures/position", period.figure("position_rmse_m"), period.figure("fix_rmse_m"))

    def _of_peers(self, period: PeriodArrays) -> None:
        count = len(self._node_ids)
        for name, by_node in period.peers().items():
            matrix = self._peers.setdefault(name, np.full((count, count), np.nan, dtype=np.float32))
            for node, row in by_node.items():
                matrix[self._node_ids.index(node)] = row
        for matrix in self._peers.values():
            matrix[~period.up] = np.nan
        if not self._peers or period.time_s < self._next_peers_s or count > LARGEST_MATRIX:
            return
        self._next_peers_s = next_charts_s(period.time_s)
        for name, matrix in self._peers.items():
            axes = ("reports", "of")
            self._canvas.log(f"peers/{name}", rr.Tensor(matrix, dim_names=axes, value_range=(0, 1)))

    def _faults_and_downs(self, period: PeriodArrays) -> None:
        acting = set(period.message["faults"])
        for label in sorted(acting ^ self._faults):
            if label not in self._known_faults:
                self._known_faults.add(label)
                self._canvas.states(f"faults/{label}", {ACTING: PURPLE})
            state = ACTING if label in acting else ""  # an empty state ends the one before
            self._canvas.log(f"faults/{label}", rr.StateChange(state=state))
        self._faults = acting
        up = period.up.tobytes()
        if up != self._up:  # as vehicles enter and leave, too: who is down may be the same then
            colours = np.where(period.up[:, None], np.array(SKY, dtype=np.uint8), np.array(RED, dtype=np.uint8))
            self._canvas.log("map/true", rr.Points2D.from_fields(colors=colours))
            self._up = up
        down = period.down
        if down != self._down:
            shown = first_names(down, NAMED_DOWN)
            self._canvas.log("faults/down", rr.StateChange(state=f"{len(down)}: {shown}" if down else NOBODY))
            self._down = down

    def events(self, events: Iterable[Mapping[str, Any]]) -> None:
        """Write down what happened, each event at its own time."""
        for event in events:
            self._canvas.at(event["time_ns"])
            planned = event["kind"] == EventKind.fault_started
            level = "WARN" if level_of(event["kind"], event["details"]) >= WARNING or planned else "INFO"
            if event["kind"] == EventKind.log:
                level = LOG_LEVELS.get(str(event["details"].get("level")), level)
            self._canvas.log("events", rr.TextLog(drawable(event["text"]), level=level))


def draw_scale(canvas: Canvas, point_m: Floats) -> None:
    """A bar with its length in words, below the map on the left."""
    low, high = point_m.min(axis=0), point_m.max(axis=0)
    length_m = nice_length(max(float(high[0] - low[0]) / 5, 1.0))
    x, y = low[0], low[1] - max(0.08 * float(high[1] - low[1]), length_m / 10)
    ends = [[[end, y - length_m / 30], [end, y + length_m / 30]] for end in (x, x + length_m)]
    canvas.strip_style("map/scale/bar", GREY, 2.0)
    canvas.strips("map/scale/bar", [[[x, y], [x + length_m, y]], *ends], static=True)
    canvas.labels("map/scale/length", [[x + length_m / 2, y]], GREY, [in_length(length_m)])


def draw_legend(canvas: Canvas, scene: Mapping[str, Any]) -> None:
    """Legend of the map's colours, in a view of its own: two rows of points with their names."""
    vehicles = [("true position", SKY), ("estimate", BLUE), ("raw fix", GREY), ("vehicle down", RED)]
    if "roadside" in tomllib.loads(scene["scenario"]):
        vehicles.append(("roadside unit", ORANGE))
    if has_background(scene):
        vehicles.append(("small: without program", GREY))
    never = impossible(scene)
    links = [(one.title, colour) for one, colour in OUTCOME_COLOURS.items() if one not in never]
    for entity, items, row in (("vehicles", vehicles, 0.0), ("links", links, -1.0)):
        place = [[LEGEND_STEP * number, row] for number in range(1, len(items) + 1)]
        canvas.labels(f"legend/{entity}/title", [[0.0, row]], GREY, [f"{entity}:"])
        colours = [list(colour) for _, colour in items]
        canvas.point_style(f"legend/{entity}", colours, 5.0, [label for label, _ in items], show_labels=True)
        canvas.points(f"legend/{entity}", place, static=True)


def has_background(scene: Mapping[str, Any]) -> bool:
    """Return whether there are vehicles without programs."""
    return bool(tomllib.loads(scene["scenario"])["network"].get("step"))


def impossible(scene: Mapping[str, Any]) -> set[Outcome]:
    """The outcomes that no reception of this run can have, whatever faults are injected."""
    scenario = parse_recorded_scenario(scene["scenario"], Path(SCENARIO_FILE))
    vehicles = len(scene["node_ids"])
    return {outcome for outcome in Outcome if not outcome.facts.is_possible(scenario, vehicles)}


def in_reach(radio: Mapping[str, Any]) -> str:
    """Rule of connectivity in words, by the scenario's section."""
    if "path_loss" not in radio:
        return "radio by given links" if "links" in radio else f"radio {radio['range_m']:g} m"
    stages = {
        "shadowing": "shadowing",
        "buildings": "buildings",
        "fading": "fading",
        "mac": "CSMA",
        "congestion": "congestion",
    }
    words = [f"radio: {radio['path_loss']['kind'].replace('_', ' ')}"]
    return ", ".join(words + [text for name, text in stages.items() if name in radio])


def describe(scene: Mapping[str, Any]) -> str:
    """A run in a heading and a line, as Markdown."""
    scenario = tomllib.loads(scene["scenario"])
    run, radio, program = scenario["run"], scenario["radio"], scenario["program"]
    count = int(np.frombuffer(scene["component"], dtype="<i2").max()) + 1
    at_first = " at first" if scene["moves"] else ""
    parts = [
        f"{len(scene['node_ids'])} vehicles in {count} component{'s' if count > 1 else ''}{at_first}",
        program["entry"].removesuffix(":main"),
        f"{in_reach(radio)}, loss {radio['loss']:.0%}, at most {scene['max_peers']} peers",
        f"{run['pacing']}, {run['duration_s']:g} s, seed {run['seed']}",
    ]
    return f"### {drawable(scene['name'])}\n\n{drawable(' · '.join(parts))}"


class DrawnReference:
    """Takes the messages of a run; see `emulator.records.metrics`. Raises VnetError if it has no reference."""

    def __init__(self, scene: Mapping[str, Any]) -> None:
        scenario = parse_recorded_scenario(scene["scenario"], Path("scenario"))
        kind = reference_of(scenario)
        self.label, self._columns, self._count = f"{kind.NAME}: {kind.TEXT}", kind.COLUMNS, len(scene["node_ids"])
        point_m = unpack(scene["lane_point_m"], 2).astype(float)
        heading_rad = unpack(scene["lane_heading_rad"])[:, 0].astype(float)
        component = np.frombuffer(scene["component"], dtype="<i2")
        self._sizes = {
            name: each.type.list_size if pa.types.is_fixed_size_list(each.type) else 1
            for name, each in columns_of(STATES, figures_if_here(scenario.program)).items()
        }
        if unknown := [name for name in self._columns if name not in self._sizes]:
            raise VnetError(f"its column {unknown[0]!r} is neither vnet's nor declared")
        self._reference = kind(Setting(scenario, component, point_m, heading_rad))

    def step(self, period: Mapping[str, Any]) -> dict[str, float]:
        """Take a period; returns its figures of the whole network by name. Periods may be left out."""
        told = {**period["columns"], **period}
        states = {name: self._column(name, told[name]) for name in self._columns}
        up = np.frombuffer(period["up"], dtype=np.uint8).astype(bool)
        states["fix_m"] = np.where(up[:, None], states["fix_m"], np.nan)
        figures = self._reference.step(int(period["time_ns"]), states)
        return {name: figure for name, figure in figures.items() if not isinstance(figure, list)}

    def _column(self, name: str, data: bytes) -> Array:
        """Return a column of the states, with a row for each vehicle."""
        size = self._sizes[name]
        if size == 1:
            return unpack(data)[:, 0].astype(float)
        return np.broadcast_to(unpack(data, size).astype(float), (self._count, size))


def published(scene: Mapping[str, Any]) -> dict[str, tuple[str, float]]:
    """Return what has been published of such a run, as its programs declare it: a label and a value by figure."""
    found: dict[str, tuple[str, float]] = {}
    try:
        scenario = parse_recorded_scenario(scene["scenario"], Path("scenario"))
        for entry in declared(scenario.program, "PUBLISHED"):
            found |= load_entry(entry)(scene)
    except VnetError:  # a run is drawn all the same
        return {}
    return found
