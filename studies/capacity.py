"""Capacity of the channel: delivery ratio against the number of senders in range, by the engine alone.

Vehicles send ten frames a second, each at its own instant within every tenth. The packet delivery ratio is that of
enqueued frames at the receivers in range, which is the distance at which a frame is just detected without fading.
There are two layouts: all vehicles within 200 m, so that all hear all; and a straight road, of which the middle
third is measured, with hidden terminals beyond the range of either end of a link.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from emulator.radio.dot11p import airtime_ns
from emulator.radio.engine import Engine
from emulator.radio.outcomes import Outcome
from emulator.scenario.radio import LogDistance, Receiver
from emulator.scenario.scenario import Radio
from studies.figures import BLACK, BLUE, GREEN, GREY, ORANGE, RED, save, styled

PAPER_PEERS = 30
SIGNIFICANT = 0.9
"""Less than this share delivered is significant loss; the paper's vehicles stand a tenth."""
HOPELESS = 0.5
"""Beyond the number of peers at which less than this is delivered, no more are tried."""
PEERS = (5, 10, 20, 30, 40, 50, 60, 80, 100, 130, 160, 200)
SIZES = (300, 1400)
RATE_HZ = 10
PLACE_M, ROAD_M = 200.0, 3000.0
PERIOD_NS = 10**9 // RATE_HZ
SETTLE_S = 3.0
ROWS_AT_ONCE = 1 << 20
RADIO: dict[str, Any] = {"max_peers": 100_000, "path_loss": {"kind": "log_distance"}, "mac": {}}


@dataclass(frozen=True)
class Variant:
    """A way of sharing the air: `radio` are keys beyond RADIO's."""

    name: str
    on_a_road: bool
    radio: Mapping[str, Any]


VARIANTS = (
    Variant("one place", False, {}),
    Variant("road", True, {}),
    Variant("road, ETSI's table", True, {"congestion": {"kind": "etsi"}}),
    Variant("road, LIMERIC", True, {"congestion": {"kind": "limeric"}}),
)


@dataclass(frozen=True)
class Point:
    """Packet delivery ratio and channel busy ratio with this number of peers."""

    variant: str
    size_bytes: int
    peers: int
    delivered: float
    busy: float


def reach_m() -> float:
    """Distance at which a frame is just detected without fading."""
    loss, receiver = LogDistance(kind="log_distance"), Receiver()
    spare_db = loss.tx_power_dbm - loss.reference_db - receiver.min_rssi_dbm
    return float(10 ** (spare_db / (10 * loss.exponent)))


def measure(variant: Variant, size_bytes: int, peers: int, seconds: float, seed: int) -> Point:
    """One network for so long; the first seconds, in which queues fill and controls settle, are left out."""
    draws = np.random.default_rng([seed, peers])
    length_m = ROAD_M if variant.on_a_road else PLACE_M
    count = round(peers * ROAD_M / (2 * reach_m())) if variant.on_a_road else peers + 1
    east_m = draws.uniform(0, length_m, count)
    radio = Radio.model_validate({**RADIO, **variant.radio})
    position_m = np.column_stack([east_m, np.zeros(count)])
    engine = Engine([f"v{number}" for number in range(count)], radio, seed, position_m, None)
    periods = round((SETTLE_S + seconds) * RATE_HZ)
    time_ns = np.arange(periods)[:, None] * PERIOD_NS + draws.integers(0, PERIOD_NS, (periods, count))
    order = np.argsort(time_ns, axis=None, kind="stable")
    payload = [bytes(size_bytes)]
    by_period = np.split(order, np.arange(1, periods) * count)
    for period, some in enumerate(by_period):
        engine.advance(period * PERIOD_NS)  # frames are kept until they have arrived
        for at_ns, sender in zip(time_ns.ravel()[some].tolist(), (some % count).tolist(), strict=True):
            engine.transmit(at_ns, sender, payload)
    engine.drain()
    return _point(engine, variant, size_bytes, peers, east_m, periods * PERIOD_NS)


def _point(engine: Engine, variant: Variant, size_bytes: int, peers: int, east_m: np.ndarray, end_ns: int) -> Point:
    third_m = (np.ptp(east_m) / 3 + east_m.min(), east_m.max() - np.ptp(east_m) / 3)
    middle = (east_m >= third_m[0]) & (east_m <= third_m[1]) if variant.on_a_road else np.ones(len(east_m), bool)
    tried = delivered = 0
    for first in range(0, len(engine.trace), ROWS_AT_ONCE):
        rows = engine.trace.rows(slice(first, first + ROWS_AT_ONCE))
        near = np.abs(east_m[rows["sender"]] - east_m[rows["receiver"]]) <= reach_m()
        judged = near & middle[rows["receiver"]] & (rows["sent_ns"] >= SETTLE_S * 1e9)
        tried += int(judged.sum())
        delivered += int((judged & (rows["outcome"] == Outcome.delivered)).sum())
    busy = np.array(engine.busy_ratios(end_ns))[round(SETTLE_S * RATE_HZ) :, middle]
    return Point(variant.name, size_bytes, peers, delivered / max(1, tried), float(busy.mean()))


def study(seconds: float, seeds: Sequence[int], peers: Sequence[int] = PEERS) -> list[Point]:
    """All variants and sizes, with ever more peers until it is hopeless; means over the seeds."""
    points = []
    for variant, size_bytes in product(VARIANTS, SIZES):
        for number in peers:
            points.append(_mean([measure(variant, size_bytes, number, seconds, seed) for seed in seeds]))
            if points[-1].delivered < HOPELESS:
                break
    return points


def _mean(points: Sequence[Point]) -> Point:
    """Mean of points that differ only in their seeds."""
    delivered, busy = (float(np.mean([getattr(one, name) for one in points])) for name in ("delivered", "busy"))
    return replace(points[0], delivered=delivered, busy=busy)


def onset(points: Sequence[Point]) -> float | None:
    """From how many peers on less than SIGNIFICANT is delivered, between the points; None if it never is."""
    for before, after in zip([None, *points], points, strict=False):
        if after.delivered < SIGNIFICANT:
            if before is None:
                return float(after.peers)
            slope = (before.delivered - SIGNIFICANT) / (before.delivered - after.delivered)
            return before.peers + slope * (after.peers - before.peers)
    return None


def _of(points: Sequence[Point], variant: str, size_bytes: int) -> list[Point]:
    return [point for point in points if point.variant == variant and point.size_bytes == size_bytes]


def report(points: Sequence[Point]) -> str:
    """The study as Markdown."""
    series = [(variant.name, size) for size in SIZES for variant in VARIANTS]
    lines = [
        "| peers | " + " | ".join(f"{name}, {size} B" for name, size in series) + " |",
        "|---:|" + "---:|" * len(series),
    ]
    shown = {(p.variant, p.size_bytes, p.peers): f"{p.delivered:.3f} ({p.busy:.2f})" for p in points}
    for peers in sorted({point.peers for point in points}):
        lines.append(f"| {peers} | " + " | ".join(shown.get((*one, peers), "") for one in series) + " |")
    onsets = [onset(_of(points, name, size)) for name, size in series]
    begins = ["never" if peers is None else f"**{peers:.0f}**" for peers in onsets]
    lines.append(f"| less than {SIGNIFICANT:.0%} from | " + " | ".join(begins) + " |")
    air = ", ".join(f"{size} B take {airtime_ns(size, 6.0) / 1e6:.3f} ms" for size in SIZES)
    head = f"Delivered of the enqueued frames (channel busy ratio); {RATE_HZ} frames a second, 6 Mbit/s: {air}."
    return "\n".join([head, "", *lines, ""])


_LOOKS: Mapping[str, tuple[str, str, str]] = {
    "one place": (BLACK, "o", "-"),
    "road": (BLUE, "s", "-"),
    "road, ETSI's table": (ORANGE, "^", "--"),
    "road, LIMERIC": (GREEN, "D", "-."),
}


@styled
def draw(points: Sequence[Point], path: Path) -> None:
    """Delivery against peers, a panel for each size of frame: `path`.png and `path`.svg."""
    figure = Figure(figsize=(10.5, 4.2), layout="constrained")
    panels = figure.subplots(1, len(SIZES), sharey=True)
    for axes, size_bytes in zip(panels, SIZES, strict=True):
        _draw_size(axes, points, size_bytes)
    panels[0].set_ylabel("packet delivery ratio")
    panels[0].legend(loc="lower left", frameon=True, framealpha=1, edgecolor="none")
    figure.suptitle(
        f"Delivery within {reach_m():.0f} m against the number of others there, {RATE_HZ} frames a second"
    )
    save(figure, path)


def _draw_size(axes: Axes, points: Sequence[Point], size_bytes: int) -> None:
    axes.axvline(PAPER_PEERS, color=RED, linewidth=1.2, linestyle=(0, (4, 2)))
    axes.text(PAPER_PEERS + 3, 1.06, "the paper's 30", color=RED, fontsize=9, va="center")
    axes.axhline(SIGNIFICANT, color=GREY, linewidth=0.9, linestyle=":")
    for variant in VARIANTS:
        colour, marker, line = _LOOKS[variant.name]
        series = _of(points, variant.name, size_bytes)
        peers, delivered = [point.peers for point in series], [point.delivered for point in series]
        axes.plot(peers, delivered, line, color=colour, marker=marker, markersize=4.5, label=variant.name)
    axes.set_title(f"{size_bytes} bytes, {airtime_ns(size_bytes, 6.0) / 1e6:.2f} ms on air")
    axes.set_xlabel("others in range")
    axes.set_ylim(0, 1.1)
    axes.set_xlim(0, None)
