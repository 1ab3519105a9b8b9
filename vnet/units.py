"""Units: of time, and those that the ends of names tell.

Times are integer nanoseconds from the start of a run, except in files and texts for people.
"""

from typing import Any, NamedTuple, TypeVar

NS_PER_S = 1_000_000_000
NS_PER_MS = 1_000_000
BYTES_PER_MB = 1_000_000

UNITS = {
    "m_s2": "m/s²",
    "mps2": "m/s²",
    "m_s": "m/s",
    "mps": "m/s",
    "kmh": "km/h",
    "mbps": "Mbit/s",
    "kbps": "kbit/s",
    "percent": "%",
    "dbm": "dBm",
    "ghz": "GHz",
    "mhz": "MHz",
    "db": "dB",
    "bytes": "bytes",
    "kb": "kB",
    "mb": "MB",
    "ppm": "ppm",
    "db_per_m": "dB/m",
    "m_per_km": "m/km",
    "rad_s": "rad/s",
    "rad": "rad",
    "deg": "°",
    "hz": "Hz",
    "ns": "ns",
    "us": "µs",
    "ms": "ms",
    "min": "min",
    "m2": "m²",
    "km": "km",
    "mm": "mm",
    "m": "m",
    "s": "s",
}
"""Units by the end of a name after an underscore; of two that fit the longer one counts."""

Times = TypeVar("Times", int, Any)  # an array of int64, whose type is another module's


class Grid(NamedTuple):
    """The instants `phase_ns`, `phase_ns` + `step_ns`, …; all instants if the step is 0."""

    step_ns: int = 0
    phase_ns: int = 0

    def at_or_after(self, time_ns: Times) -> Times:
        """Return for each time the first instant that is not before it."""
        return time_ns + (self.phase_ns - time_ns) % self.step_ns if self.step_ns else time_ns


ANY_TIME = Grid()


def unit_of(name: str) -> str:
    """Return the unit that a name ends in, or "": "ms" for `delay_ms` and for `delay_ms.v03`."""
    return UNITS.get(_suffix(_stem(name)), "")


def title_of(name: str) -> str:
    """Return a name as words, without its unit: "warning delay" for `warning_delay_ms`.

    What is behind a dot stays: "delay.v_03" for `delay_ms.v_03`.
    """
    stem = _stem(name)
    suffix = _suffix(stem)
    words = (stem.removesuffix(f"_{suffix}") if suffix else stem).replace("_", " ")
    return words + name.removeprefix(stem)


def label_of(name: str, title: str = "") -> str:
    """Return a name's title, or the one given, with its unit: "warning delay (ms)" for `warning_delay_ms`."""
    unit = unit_of(name)
    title = title or title_of(name)
    return f"{title} ({unit})" if unit else title


def _stem(name: str) -> str:
    """Return what is before the dot of a reported value's name, and any other name as it is."""
    before = name.partition(".")[0]
    return before if before.isidentifier() else name


def _suffix(name: str) -> str:
    fitting = [suffix for suffix in UNITS if name.endswith(f"_{suffix}") and len(name) > len(suffix) + 1]
    return max(fitting, key=len, default="")
