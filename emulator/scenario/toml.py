"""TOML that others wrote, read within bounds: plain values only, so that what is read can be written again.

The standard library's reader takes time in the square of a dotted key's length, overflows the stack where values
are nested deeply, and knows dates and integers of any length, which neither the wire nor a run's file can carry.
"""

from __future__ import annotations

import math
import re
import tomllib
from pathlib import Path
from typing import Any

from vnet.bounded import read_bounded
from vnet.errors import printable, shown

LARGEST_BYTES = 4 * 2**20
"""Largest size of a file; a matrix of links for a thousand vehicles takes three of the four megabytes."""
DEEPEST = 32
"""Largest nesting depth of tables and arrays."""
_INTEGERS = range(-(2**63), 2**64)  # what msgpack can carry

_KEY = r"""(?:[A-Za-z0-9_-]++|"[^"\n]*+"|'[^'\n]*+')"""
_LONG_KEY = re.compile(rf"(?<![A-Za-z0-9_-]){_KEY}(?:[ \t]*+\.[ \t]*+{_KEY}){{{DEEPEST}}}")


def read_toml(path: Path) -> dict[str, Any]:
    """The tables of a file. Raises OSError, and ValueError with the reason where it is not valid or not plain."""
    return parse_toml(read_bounded(path, LARGEST_BYTES).decode("utf-8-sig"))


def parse_toml(text: str) -> dict[str, Any]:
    """The tables of a text. Raises ValueError with the reason where it is not valid TOML."""
    if _LONG_KEY.search(text):
        raise ValueError(f"a key of more than {DEEPEST} parts")
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise ValueError(f"nested more than {DEEPEST} deep") from None


def check_plain(value: Any, key: str = "", depth: int = 0) -> None:
    """Raises ValueError, with the key, where something is not plain: text, finite, within 64 bits, not too deep."""
    if depth > DEEPEST:
        raise ValueError(f"{printable(key)}: nested more than {DEEPEST} deep")
    if isinstance(value, dict):
        for name, entry in value.items():
            check_plain(name, key, depth)
            check_plain(entry, f"{key}.{name}" if key else name, depth + 1)
    elif isinstance(value, list):
        for entry in value:
            check_plain(entry, key, depth + 1)
    elif problem := _problem(value):
        raise ValueError(f"{printable(key)} = {shown(value)}: {problem}")


def _problem(value: Any) -> str:
    """Return the problem of a value that is no table or array; None if it has none."""
    if isinstance(value, bool):
        return ""
    if isinstance(value, int):
        return "" if value in _INTEGERS else "an integer of at most 64 bits is needed"
    if isinstance(value, float):
        return "" if math.isfinite(value) else "a finite number is needed"
    if not isinstance(value, str):
        return "dates and times are written as text, in quotes"
    try:
        value.encode()
    except UnicodeEncodeError:
        return "text in UTF-8 is needed"
    return ""
