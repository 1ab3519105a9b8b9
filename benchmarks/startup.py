"""Time that commands take to begin, beside a Python that does nothing: all of them in turns, medians."""

from __future__ import annotations

import signal
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).parents[1]
ROUNDS = 9
PLAIN = ["-c", "pass"]
WHOLE = {
    "python": PLAIN,
    "help": ["-P", "-m", "emulator", "--help"],
    "version": ["-P", "-m", "emulator", "--version"],
}
"""Commands that are measured from their start to their end."""
FIRST_LINE = {
    name: ["-P", "-m", "emulator", name, str(ROOT / "scenarios" / "twelve.toml")] for name in ("run", "simulate")
}
"""Commands that are measured until their first line."""


def measure() -> dict[str, float]:
    """Return the median wall-clock seconds of each command, and what it takes longer than a plain Python."""
    taken_s: dict[str, list[float]] = {name: [] for name in (*WHOLE, *FIRST_LINE)}
    with tempfile.TemporaryDirectory(prefix="vnet-bench-") as folder:
        for _ in range(ROUNDS):
            for name, arguments in WHOLE.items():
                started = time.perf_counter()
                subprocess.run([sys.executable, *arguments], cwd=folder, capture_output=True, check=True)
                taken_s[name].append(time.perf_counter() - started)
            for name, arguments in FIRST_LINE.items():
                taken_s[name].append(_until_first_line(arguments, folder))
    medians = {name: statistics.median(times) for name, times in taken_s.items()}
    plain_s = medians.pop("python")
    more = {f"{name}_more_s": median - plain_s for name, median in medians.items()}
    return {"python_s": plain_s, **{f"{name}_s": median for name, median in medians.items()}, **more}


def _until_first_line(arguments: list[str], folder: str) -> float:
    started = time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, *arguments], cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
    )
    with process:
        assert process.stderr is not None
        line = process.stderr.readline()
        taken_s = time.perf_counter() - started
        process.send_signal(signal.SIGINT)
        process.communicate()
    assert line.startswith(b"twelve: "), line
    return taken_s
