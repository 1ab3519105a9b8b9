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
from emulator.terminal.dashboard import Dashboard, sparkline

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
        places.add(
            (len(lines), *(labels.index(name) for name in ("time", "vehicles", "common", "frames", "events")))
        )
    assert len(places) == 1


@pytest.mark.parametrize(
    ("changes", "later_s", "said"),
    [
        ({"idle_s": 3.0}, 1.0, "2.5× real time · 4 s left"),
        ({"idle_s": 3.0}, 9.0, "no period for 12 s"),
        ({"remaining_s": 0.0}, 0.0, "2.5× real time · ending"),
        ({"remaining_s": 600.0}, 0.0, "2.5× real time · 10 min left"),
        ({"remaining_s": 9000.0}, 0.0, "2.5× real time · 2 h 30 min left"),
        ({"phase": "judging", "idle_s": 60.0}, 0.0, "judging the run"),
    ],
)
def test_the_headline_says_how_fast_it_is_or_that_it_stands(
    changes: dict[str, object], later_s: float, said: str
) -> None:
    lines = render(Dashboard(make(**changes), later_s)).export_text().splitlines()
    assert lines[0].endswith(said)


def test_colours_and_none() -> None:
    """Styles, not codes: Rich keeps a style's codes for the first kind of terminal that it was written to."""
    console = Console(width=100, height=30, force_terminal=True, file=io.StringIO(), color_system="truecolor")
    styles = {segment.text: segment.style for segment in console.render(Dashboard(make()))}
    for text in ("v04 died: SIGKILL", "  1 down: "):
        style = styles[text]
        assert style is not None and style.bold and style.color is not None
        assert style.color.triplet == (213, 94, 0), "what is bad is red"
    plain = written(render(Dashboard(make()), color_system=None))
    assert "\x1b" not in plain
    (bar,) = [line for line in plain.splitlines() if line.startswith("frames")]
    assert bar.split()[1] == "█" * 28 + "▒" * 13 + "▤" * 5, "signs tell outcomes apart"


def test_a_status_has_no_room_for_what_is_to_come() -> None:
    steady = render(Dashboard(make())).export_text().splitlines()
    fleeting = render(Dashboard(make(), steady=False)).export_text().splitlines()
    assert fleeting == steady[: len(fleeting)]
    assert fleeting[-1].endswith("SIGKILL")
    assert set(steady[len(fleeting) :]) == {""}


@pytest.mark.parametrize("width", [1, 7, 46, 60, 119, 120])
def test_a_sparkline_rises_and_falls_with_its_values(width: int) -> None:
    rising = sparkline(tuple(1.1**n for n in range(BINS)), width)
    assert len(rising) == width
    assert list(rising) == sorted(rising)
    if width > 6:
        assert (rising[0], rising[-1]) == ("▁", "▇")
    assert set(sparkline((0.3,) * BINS, width)) == {"▄"}, "what is steady does not look wild"
    assert len(sparkline((1.0,) * (BINS // 2), width)) == math.ceil(width / 2)


def test_a_sparkline_of_odd_values() -> None:
    assert sparkline((None,) * 50, 20) == ""
    assert sparkline((), 20) == ""
    assert sparkline((None,) * 60 + (1.0,) * 60, 4) == "  ▄▄"
    assert sparkline((1.0,) * 60 + (math.inf,) * 60, 4) == "▄▄▇▇"
    assert sparkline((0.0,) * 60 + (1.0,) * 60, 4) == "▁▁▇▇"
