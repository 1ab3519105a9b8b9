"""The picture of a run: it says what is so, fits whatever terminal there is, and stays where it is."""

import io
import math
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import pytest
from rich.console import Console

from emulator.drivers.status import BINS, FaultState, Snapshot
from emulator.records.events import Event
from emulator.terminal.progress import Dashboard

SIZES = [(200, 60), (100, 30), (90, 24), (80, 24), (60, 15), (60, 12), (40, 8), (20, 5), (8, 3), (1, 2)]
FAULTS = (
    FaultState("kill-0", "ended", 4.0, 6.0, ("v02",)),
    FaultState("ConstPosOffset-1", "acting", 9.0, 12.0, ("v01", "v03")),
    FaultState("emulator_restart-12", "to come", 15.0, 15.001, ()),
)
EVENTS = (
    Event(0, "started", None, {"start_up_s": 3.25}),
    Event(4_000_000_000, "fault_started", None, {"fault": "kill-0", "nodes": ["v02"]}),
    Event(9_200_000_000, "died", "v04", {"how": "SIGKILL", "log_tail": "a page\nof text"}),
)

FIGURES: dict[str, float | None] = {
    "common_error_rmse_m": 0.21,
    "deviation_m": 0.05,
    "position_rmse_m": 0.43,
    "fix_rmse_m": 6.31,
}


def make(**changes: Any) -> Snapshot:
    """Twelve vehicles after ten of twenty seconds."""
    falling = tuple(5.0 * 0.9**n for n in range(BINS // 2))
    shot = Snapshot(
        run="town",
        pacing="realtime",
        seed=7,
        node_ids=tuple(f"v{n:02}" for n in range(1, 13)),
        phase="running",
        missing=(),
        down=("v04",),
        emulated_s=10.0,
        duration_s=20.0,
        join_timeout_s=60.0,
        real_time_factor=2.5,
        remaining_s=4.0,
        idle_s=0.0,
        wall_s=4.0,
        figures=dict(FIGURES),
        over_time=dict.fromkeys(FIGURES, falling),
        lines={"common_error_rmse_m": ("common error", "RMSE"), "deviation_m": ("deviation", "between vehicles")},
        frames_by_outcome={"delivered": 900, "lost": 100, "out_of_range": 77},
        frames_per_s={"delivered": 60.0, "lost": 30.0, "receiver_down": 10.0, "out_of_range": 7.0},
        faults=FAULTS,
        events=EVENTS,
        emulator_memory_mb=151.2,
    )
    return replace(shot, **changes)


def render(
    dashboard: Dashboard,
    width: int = 100,
    height: int = 30,
    color_system: Literal["truecolor"] | None = "truecolor",
) -> Console:
    console = Console(
        record=True,
        width=width,
        height=height,
        force_terminal=True,
        file=io.StringIO(),
        color_system=color_system,
        _environ={},
    )
    console.print(dashboard, end="")
    return console


def written(console: Console) -> str:
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def rows(shot: Snapshot, width: int = 100, height: int = 30) -> list[str]:
    return render(Dashboard(shot), width, height).export_text().splitlines()


def row(shot: Snapshot, label: str, width: int = 100, height: int = 30) -> str:
    (found,) = [line for line in rows(shot, width, height) if line.startswith(label)]
    return " ".join(found.split())


MANY = tuple(FaultState(f"loss-{n}", "ended", n, n + 1.0, ()) for n in range(8))
MANY += (FAULTS[1], *(FaultState(f"delay-{n}", "to come", 12.0 + n, 14.0 + n, ()) for n in range(5)))
UNREPORTED = {
    "over_time": dict.fromkeys(FIGURES, (None,)),
    "figures": dict.fromkeys(FIGURES) | {"fix_rmse_m": 6.31},
}
LEGEND = {"frames_per_s": {"delivered": 800.0, "lost": 100.0, "peer_cap": 30.0, "fault": 70.0}}
VEHICLES = tuple(f"n{n}" for n in range(460))
PICTURES: dict[str, tuple[dict[str, Any], list[tuple[int, int]]]] = {
    "running": ({}, [(100, 30), (60, 12)]),
    "joining": ({"phase": "joining", "missing": ("v02", "v11"), "down": (), "wall_s": 12.0}, [(100, 30)]),
    "faults that act, then the next": ({"faults": MANY}, [(100, 18)]),
    "nobody reports": (UNREPORTED, [(100, 18)]),
    "a legend": (LEGEND, [(120, 12), (40, 12)]),
    "many of many are down": ({"node_ids": VEHICLES, "down": VEHICLES[:100]}, [(100, 12)]),
}
"""Runs, and the sizes of the terminals at which they are shown."""
GOLDEN = Path(__file__).with_name("pictures.txt")


def test_pictures_are_those_that_were_looked_at(tmp_path: Path) -> None:
    """All that a picture says, over one axis, and what a small terminal leaves out."""
    shown = ""
    for name, (changes, sizes) in PICTURES.items():
        for width, height in sizes:
            lines = (line.rstrip() for line in rows(make(**changes), width, height))
            shown += f"{f'=== {name}, {width} × {height} ':=<80}\n" + "\n".join(lines) + "\n"
    (tmp_path / "pictures.txt").write_text(shown, encoding="utf-8")
    assert shown == GOLDEN.read_text(encoding="utf-8"), f"look at {tmp_path}/pictures.txt; if it is right, keep it"


@pytest.mark.parametrize(("width", "height"), SIZES)
@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"phase": "joining", "missing": ("v02", "v03")},
        {"phase": "starting"},
        {"phase": "judging", "emulated_s": 20.0},
        {"node_ids": tuple(f"vehicle-{n}" for n in range(500)), "down": tuple(f"vehicle-{n}" for n in range(90))},
        {"faults": (), "events": (), "frames_per_s": {}},
        {"faults": FAULTS * 20, "events": EVENTS * 3, "run": "r" * 64},
        {"events": (Event(10**14, "crashed", "v01", {"error": "x\n\x1b[2J\r\ttab" + "漢字" * 200}),)},
        {"figures": FIGURES | {"deviation_m": 1e300, "fix_rmse_m": math.inf}, "remaining_s": None},
        {"emulator_memory_mb": None, "idle_s": 86_400.0},
    ],
)
def test_it_fits_whatever_terminal_there_is(width: int, height: int, changes: dict[str, object]) -> None:
    console = render(Dashboard(make(**changes)), width, height)
    text = console.export_text(clear=False)
    lines = text.splitlines()
    assert 0 < len(lines) < height, "the last line is the cursor's"
    assert max(map(len, lines)) <= width
    assert lines[0].startswith(("town"[:width], "r" * width, "rrrr"))
    assert "\x1b[2J" not in text
    assert not set(text) & set("\r\t\v\f")


@pytest.mark.parametrize("height", [12, 15, 24, 30, 60])
def test_nothing_moves_while_events_and_frames_come(height: int) -> None:
    shots = [make(), make(events=()), make(events=EVENTS[:1]), make(frames_per_s={}), make(down=())]
    shots += [make(emulated_s=seconds) for seconds in (1.0, 19.9)]
    places = set()
    for shot in shots:
        lines = rows(shot, height=height)
        labels = [line.split()[0] if line[:1].strip() else "" for line in lines]
        places.add((len(lines), *map(labels.index, ("time", "vehicles", "common", "frames", "events"))))
    assert len(places) == 1
