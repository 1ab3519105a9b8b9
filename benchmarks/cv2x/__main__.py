"""Compare LTE-V2X mode 4 with published simulations: a table on stdout. The data are not part of the project.

`python -m benchmarks.cv2x --data FOLDER` needs `lte_mode4.csv` there, or in `VNET_CV2X_DATA`.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

import numpy as np

from benchmarks.cv2x.highway import Curves, Setting, deviations, drive, mode4_radio, published, together

LIMIT = 2.5
"""Largest mean absolute deviation, in percentage points."""


def main() -> int:
    """Print the table, and return 1 if a deviation is too large."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.cv2x")
    parser.add_argument("--data", type=Path, default=os.environ.get("VNET_CV2X_DATA"), help="folder of the curves")
    parser.add_argument("--seconds", type=float, default=20.0, help="emulated time of a run")
    parser.add_argument("--seeds", type=int, default=3, help="runs of a setting, each with its own shadowing")
    parser.add_argument("--density", type=float, help="only settings with so many vehicles a metre")
    parser.add_argument("--curves", action="store_true", help="print the curves, too")
    options = parser.parse_args()
    if options.data is None:
        parser.error("--data, or VNET_CV2X_DATA, must name the folder with lte_mode4.csv")
    found = published(Path(options.data) / "lte_mode4.csv")
    print(
        "| setting | PDR | HD | SEN | PRO | COL | CBR | CPU time (s) |",
        "|---|---|---|---|---|---|---|---|",
        sep="\n",
    )
    worst = 0.0
    for setting, theirs in sorted(found.items(), key=lambda each: each[0].name):
        if options.density in (None, setting.density_per_m):
            worst = max(worst, _compare(setting, theirs, options))
    print(f"largest deviation: {worst:.2f} percentage points; at most {LIMIT:g} are allowed")
    return int(worst > LIMIT)


def _compare(setting: Setting, theirs: Curves, options: argparse.Namespace) -> float:
    """Print a row, and return the largest deviation."""
    seeds = range(1, options.seeds + 1)
    measured = together([drive(mode4_radio(setting), setting, options.seconds, seed) for seed in seeds])
    ours = measured.curves()
    away = deviations(ours, theirs)
    cells = " | ".join(f"{away[name]:.2f}" for name in ("PDR", "HD", "SEN", "PRO", "COL"))
    print(f"| {setting.name} | {cells} | {measured.busy.mean():.3f} | {measured.cpu_s:.0f} |", flush=True)
    if options.curves:
        for name, curve in theirs.items():
            print(f"  {name}: {np.round(ours[name], 3).tolist()} published {np.round(curve, 3).tolist()}")
    return max(away.values())


if __name__ == "__main__":
    sys.exit(main())
