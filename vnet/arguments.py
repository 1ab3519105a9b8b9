"""Arguments that programs give to calls of their vehicle: what counts as a number, and as a payload."""

from __future__ import annotations

import math
from typing import Any

from vnet.errors import shown


def number_or_nan(value: Any) -> float:
    """Return a number, numpy's included, as a float; NaN for what is none: texts, booleans, and beyond floats."""
    if isinstance(value, (str, bytes, bytearray, bool)):
        return math.nan
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        return math.nan


def checked_payload(call: str, payload: bytes) -> bytes:
    """Return a payload of a `call` as bytes. Raise TypeError for what is not bytes."""
    try:
        return bytes(memoryview(payload))
    except TypeError:
        raise TypeError(
            f"{call}({shown(payload)}): bytes are expected, not {type(payload).__name__}; encode it first, "
            "as with msgpack.packb(…) or text.encode()"
        ) from None
