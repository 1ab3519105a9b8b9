"""Compare C-V2X and 802.11p with published curves and closed forms: tables on stdout.

`python -m benchmarks.cv2x [lte nr 80211p speed]` prints some of the tables. The curves are not part of the project:
`--data FOLDER`, or `VNET_CV2X_DATA`, names the folder with `lte_mode4.csv`, `80211p.csv` and `80211p_cbr.csv`.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks.cv2x import closed_forms, dot11p
from benchmarks.cv2x.highway import (
    Curves,
    Measured,
    Setting,
    deviations,
    drive,
    mode4_radio,
    published,
    real_time_factor,
    together,
)
from emulator.scenario.scenario import Radio
from emulator.scenario.sections import DAY_S

LIMITS = {"lte": 2.5, "nr": 3.0, "80211p": 5.0}
"""Largest deviations, in percentage points."""
TABLES = ("lte", "nr", "80211p", "speed")
LEAST_S = 3.0
"""Shortest run: the first two seconds, in which nobody has sensed yet, do not count."""


def main() -> int:
    """Print the tables, and return 1 if a deviation is too large."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.cv2x")
    parser.add_argument("tables", nargs="*", choices=[*TABLES, []], help="tables to print; all if left out")
    parser.add_argument("--data", type=Path, default=os.environ.get("VNET_CV2X_DATA"), help="folder of the curves")
    parser.add_argument("--seconds", type=float, default=20.0, help="emulated time of a run")
    parser.add_argument("--seeds", type=int, default=3, help="runs of a setting, each with its own shadowing")
    parser.add_argument("--density", type=float, help="only settings with so many vehicles a metre")
    parser.add_argument("--curves", action="store_true", help="print the curves, too")
    options = parser.parse_args()
    tables = options.tables or list(TABLES)
    if options.data is None and {"lte", "80211p"} & {*tables}:
        parser.error("--data, or VNET_CV2X_DATA, must name the folder of the published curves")
    if not LEAST_S <= options.seconds <= DAY_S or options.seeds < 1:
        parser.error(f"--seconds is {LEAST_S:g} to {DAY_S:g}, and --seeds 1 or more")
    print_table = {"lte": _lte, "nr": _nr, "80211p": _dot11p, "speed": _speed}
    broken = 0
    for table in tables:
        try:
            worst = print_table[table](options)
        except OSError as error:
            parser.error(str(error))
        if table in LIMITS:
            print(f"largest deviation: {worst:.2f} percentage points; {LIMITS[table]:g} are allowed\n", flush=True)
            broken |= worst > LIMITS[table]
    return int(broken)


def _runs(options: argparse.Namespace, radio_of: Callable[[Setting], Radio], setting: Setting) -> Measured:
    seeds = range(1, options.seeds + 1)
    return together([drive(radio_of(setting), setting, options.seconds, seed) for seed in seeds])


def _chosen(found: dict[Setting, Curves], options: argparse.Namespace) -> list[tuple[Setting, Curves]]:
    """Return the settings of a density with their curves, by name. Raise OSError if there is none."""
    chosen = [each for each in found.items() if options.density in (None, each[0].density_per_m)]
    if not chosen:
        known = sorted({setting.density_per_m for setting in found})
        raise FileNotFoundError(f"--density {options.density:g}: the curves are of {known}")
    return sorted(chosen, key=lambda each: each[0].name)


def _print_curves(ours: Curves, theirs: Curves) -> None:
    for name in theirs.keys() & ours.keys():
        print(f"  {name}: {np.round(ours[name], 3).tolist()} published {np.round(theirs[name], 3).tolist()}")


def _lte(options: argparse.Namespace) -> float:
    """Print the table of mode 4, and return the largest deviation."""
    print(
        "| mode 4 | PDR | HD | SEN | PRO | COL | CBR | CPU time (s) |",
        "|---|" + "---|" * 7,
        sep="\n",
    )
    worst = 0.0
    found = published(Path(options.data) / "lte_mode4.csv")
    for setting, theirs in _chosen(found, options):
        measured = _runs(options, mode4_radio, setting)
        away = deviations(measured.curves(), theirs)
        cells = " | ".join(f"{away[name]:.2f}" for name in ("PDR", "HD", "SEN", "PRO", "COL"))
        print(f"| {setting.name} | {cells} | {measured.busy.mean():.3f} | {measured.cpu_s:.0f} |", flush=True)
        if options.curves:
            _print_curves(measured.curves(), theirs)
        worst = max(worst, *away.values())
    return worst


def _nr(options: argparse.Namespace) -> float:
    """Print the table of mode 2, and return the largest deviation."""
    print("| mode 2 | closed form (%) | Cao et al. (%) | measured (%) |", "|---|---|---|---|", sep="\n")
    worst = 0.0
    for case in closed_forms.CASES:
        expected = closed_forms.meets(case)
        found = float(np.mean([closed_forms.measured(case, options.seconds, n + 1) for n in range(options.seeds)]))
        theirs = closed_forms.meets_by_cao(case)
        text = "–" if theirs is None else f"{100 * theirs:.2f}"
        print(f"| {case.name} | {100 * expected:.2f} | {text} | {100 * found:.2f} |", flush=True)
        worst = max(worst, 100 * abs(found - expected))
    return worst


def _dot11p(options: argparse.Namespace) -> float:
    """Print the table of 802.11p, and return the largest deviation."""
    print("| 802.11p | PDR | CBR | published CBR | CPU time (s) |", "|---|---|---|---|---|", sep="\n")
    worst = 0.0
    folder = Path(options.data)
    busy = dot11p.published_busy(folder / "80211p_cbr.csv")
    found = published(folder / "80211p.csv")
    for setting, theirs in _chosen(found, options):
        measured = _runs(options, dot11p.radio, setting)
        away = deviations(measured.curves(), {"PDR": theirs["PDR"]})["PDR"]
        ours, known = float(measured.busy.mean()), busy.get(setting)
        text = "–" if known is None else f"{known:.3f}"
        print(f"| {setting.name} | {away:.2f} | {ours:.3f} | {text} | {measured.cpu_s:.0f} |", flush=True)
        if options.curves:
            _print_curves(measured.curves(), theirs)
        worst = max(worst, away, 0.0 if known is None else 100 * abs(ours - known))
    return worst


def _speed(options: argparse.Namespace) -> float:
    """Print the table of real-time factors."""
    print("| vehicles on 2 km | 802.11p | mode 4 | mode 2 |", "|---|---|---|---|", sep="\n")
    for vehicles in (100, 200, 400):
        factors = [real_time_factor(vehicles, mac) for mac in ({}, {"kind": "lte-mode4"}, {"kind": "nr-mode2"})]
        print(f"| {vehicles} | {' | '.join(f'{factor:.2f}' for factor in factors)} |", flush=True)
    return 0.0


if __name__ == "__main__":
    sys.exit(main())
