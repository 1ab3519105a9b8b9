"""Cost of showing a run in a terminal: the CPU time of its thread, and the time taken from the run's own."""

import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from rich.console import Console

from emulator.drivers.session import Session
from emulator.drivers.status import Course, Snapshot
from emulator.scenario.loading import load_scenario
from emulator.terminal.live import EVERY_S, LivePicture
from emulator.terminal.progress import Dashboard

SCENARIO = Path(__file__).parents[1] / "scenarios" / "faults.toml"
OVERRIDES = ["network.vehicles=50", "program.entry=agents.beacon:main"]


def measure(width: int = 100, height: int = 30) -> dict[str, float]:
    """Medians in ms, and the share of a core, of a picture in which something changes at every redraw."""
    with tempfile.TemporaryDirectory() as folder:
        scenario = load_scenario(SCENARIO, OVERRIDES)
        session = Session(scenario, Path(folder) / "run").open()
        course = Course(session.emulation)
        shots: list[Snapshot] = []
        snapshot_ms: list[float] = []
        session.emulation.watch(lambda view: snapshot_ms.append(_ms(lambda: shots.append(course.snapshot()))))
        session.run()
    with Path("/dev/null").open("w") as nobody:
        console = Console(file=nobody, force_terminal=True, width=width, height=height, color_system="truecolor")
        redraw_ms = []
        with LivePicture(console, lambda: Dashboard(shots[0])) as picture:
            while len(shots) > 1:
                shots.pop(0)
                redraw_ms.append(_ms(picture.refresh))
    together_ms = statistics.median(snapshot_ms) + statistics.median(redraw_ms)
    return {
        "snapshot_ms": statistics.median(snapshot_ms),
        "redraw_ms": statistics.median(redraw_ms),
        "redraw_p99_ms": statistics.quantiles(redraw_ms, n=100)[-1],
        "share_of_a_core": together_ms / 1000 / EVERY_S,
    }


def _ms(what: Callable[[], None]) -> float:
    started = time.perf_counter()
    what()
    return 1000 * (time.perf_counter() - started)
