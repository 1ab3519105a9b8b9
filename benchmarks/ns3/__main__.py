"""Hold the radio to ns-3: a table, a JSON file and a picture. `python -m benchmarks.ns3 [--out FOLDER]`

Status 0 if both agree, 1 if not, 2 if ns-3 is not there.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.ns3.compare import BUSY_LIMIT, CURVE_LIMIT, FARTHEST_M, TIME_AIM, Comparison, compare, draw
from benchmarks.ns3.ground import BIN_M
from benchmarks.ns3.simulators import MissingError, build

OUT = Path("build") / "ns3"


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.ns3", description="Hold the radio to ns-3.")
    parser.add_argument("--seconds", type=float, default=60.0, help="emulated time of each run")
    parser.add_argument("--vehicles", type=int, nargs="+", default=[50, 100], help="on a road of 1 km")
    parser.add_argument("--out", type=Path, default=OUT, help="folder for table, JSON and picture")
    options = parser.parse_args()
    console = Console(stderr=True)
    try:
        with tempfile.TemporaryDirectory(prefix="vnet-ns3-") as folder:
            program = build(Path(folder))
            comparisons = []
            for vehicles in options.vehicles:
                for fading in (False, True):
                    comparisons.append(compare(program, vehicles, fading, options.seconds))
                    console.print(_said(comparisons[-1]))
    except MissingError as error:
        print(error, file=sys.stderr)
        return 2
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "ns3.json").write_text(json.dumps([one.figures() for one in comparisons], indent=2) + "\n")
    (options.out / "ns3.md").write_text(_markdown(comparisons))
    draw(comparisons, options.out / "ns3.png")
    console.print(_table(comparisons))
    console.print(f"{options.out}: ns3.md, ns3.json, ns3.png")
    return 0 if all(one.holds for one in comparisons) else 1


def _name(one: Comparison) -> str:
    return f"{one.vehicles} vehicles, {'fading' if one.fading else 'no fading'}"


def _said(one: Comparison) -> str:
    return f"{_name(one)}: ns-3 {one.cpu_s[0]:.1f} s, vnet {one.cpu_s[1]:.2f} s of CPU"


def _table(comparisons: Sequence[Comparison]) -> Table:
    table = Table("distance (m)", *(_name(one) for one in comparisons), title="delivered: ns-3 → vnet")
    for place in range(len(comparisons[0].theirs.pairs)):
        cells = [
            f"{one.theirs.share[place]:.3f} → {one.ours.share[place]:.3f}" if one.judged[place] else ""
            for one in comparisons
        ]
        table.add_row(f"{place * BIN_M:g}-{(place + 1) * BIN_M:g}", *cells)
    table.add_section()
    for title, cells in _summary(comparisons):
        table.add_row(title, *cells)
    return table


def _summary(comparisons: Sequence[Comparison]) -> list[tuple[str, list[str]]]:
    return [
        (f"largest up to {FARTHEST_M:g} m (≤ {CURVE_LIMIT:g})", [f"{one.largest:.3f}" for one in comparisons]),
        ("busy ratio", [f"{one.busy[0]:.3f} → {one.busy[1]:.3f}" for one in comparisons]),
        (f"busier by (± {BUSY_LIMIT:.0%})", [f"{one.busier:+.1%}" for one in comparisons]),
        ("CPU (s)", [f"{one.cpu_s[0]:.2f} → {one.cpu_s[1]:.2f}" for one in comparisons]),
        ("wall clock (s)", [f"{one.wall_s[0]:.2f} → {one.wall_s[1]:.2f}" for one in comparisons]),
        (f"ratio of CPU (aim {TIME_AIM:g})", [f"{one.ratio:.1f}" for one in comparisons]),
    ]


def _markdown(comparisons: Sequence[Comparison]) -> str:
    """The same table, for the documentation."""
    lines = ["| distance (m) | " + " | ".join(map(_name, comparisons)) + " |"]
    lines.append("|---|" + "---|" * len(comparisons))
    for place in np.flatnonzero(np.any([one.judged for one in comparisons], axis=0)).tolist():
        cells = [
            f"{one.theirs.share[place]:.3f} → {one.ours.share[place]:.3f}" if one.judged[place] else ""
            for one in comparisons
        ]
        lines.append(f"| {place * BIN_M:g}–{(place + 1) * BIN_M:g} | " + " | ".join(cells) + " |")
    for title, cells in _summary(comparisons):
        lines.append(f"| {title} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.exit(main())
