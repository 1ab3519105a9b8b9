"""Reports: estimates, values and details of events that a program gives, and which of them are allowed."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from typing import Annotated

import numpy as np
from msgspec import Meta, Struct
from numpy.typing import ArrayLike

from vnet.errors import sendable, shown

LONGEST_TEXT = 64
"""Characters of a reported text: it names a state, and is no log."""
Value = bool | float | Annotated[str, Meta(max_length=LONGEST_TEXT)] | list[float]
"""A reported value besides the estimates."""

RESERVED_NAMES = frozenset(["period", "time_ns", "node", "position_m", "heading_rad", "fix_m", "values"])
"""Names that no reported value can have: columns that the emulator fills in every row of a run's states."""
COVARIANCE_TOLERANCE = 1e-6
"""Asymmetry and negative eigenvalues of a covariance, relative to its largest element, that rounding may cause."""
LARGEST_EXACT = 2**53
"""Integers below it are numbers of double precision."""
_FLOAT = np.dtype(float)
NoteDetail = bool | int | float | str
"""Value of a detail of an event."""


class Report(Struct, frozen=True, gc=False):
    """A program's estimates at one time; see `Node.report`."""

    time_ns: int
    node: str
    estimate_m: tuple[float, float] | None
    covariance_m2: tuple[float, float, float, float] | None
    values: dict[str, Value] = {}


def checked_detail(name: str, value: object) -> NoteDetail:
    """A detail of an event as plain Python; numbers of numpy are taken, and what is not finite becomes a text."""
    if isinstance(value, np.generic):
        value = value.item()
    if not isinstance(value, (bool, int, float, str)):
        raise ValueError(f"event({name}={value!r}): a number, a boolean or a text is expected")
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    if isinstance(value, int) and abs(value) >= 2**63:
        return str(value)
    return sendable(value) if isinstance(value, str) else value


def checked_numbers(name: str, value: ArrayLike, size: int | None = None) -> list[float]:
    try:
        if type(value) is np.ndarray and value.dtype == _FLOAT:
            flat: list[float] = value.ravel().tolist()
        else:
            flat = np.asarray(value, dtype=float).ravel().tolist()
    except OverflowError:
        raise ValueError(
            f"report({name}={shown(value)}): a number within ±{sys.float_info.max:.2g} is expected"
        ) from None
    except (TypeError, ValueError):
        raise ValueError(f"report({name}={shown(value)}): numbers are expected") from None
    if size is not None and len(flat) != size:
        raise ValueError(f"report({name}=…): {len(flat)} numbers given, {size} expected")
    return flat


def checked_covariance(name: str, value: ArrayLike) -> list[float]:
    """Return a covariance matrix (2, 2) in row-major order; errors of rounding are allowed."""
    flat = checked_numbers(name, value, 4)
    a, b, c, d = flat
    largest = max(abs(a), abs(b), abs(c), abs(d))
    margin = COVARIANCE_TOLERANCE * largest
    if not math.isfinite(a + b + c + d) and not all(map(math.isfinite, flat)):
        reason = "not finite"
    elif abs(b - c) > margin:
        reason = "not symmetric"
    elif a < -margin or d < -margin or a * d - b * c < -margin * largest:
        reason = "not positive semidefinite"
    else:
        return flat
    raise ValueError(f"report({name}=[[{a:g}, {b:g}], [{c:g}, {d:g}]]): {reason}, so no covariance")


def check_name(name: str) -> None:
    if name in RESERVED_NAMES:
        taken = ", ".join(sorted(RESERVED_NAMES))
        raise ValueError(f"report({name}=…): this name is taken by vnet; so are {taken}")
    if not (name.partition(".")[0].isidentifier() and name.isprintable()):
        allowed = "a Python identifier is expected, with a dot and any printable text behind it if need be"
        raise ValueError(f"report(**{{{name!r}: …}}): not a name of a value; {allowed}")


def checked_value(name: str, value: ArrayLike) -> Value:
    if name.endswith("covariance_m2"):
        return checked_covariance(name, value)
    if type(value) is float:
        return value
    if type(value) is int and abs(value) < LARGEST_EXACT:
        return float(value)
    if type(value) is np.ndarray and value.ndim:
        return checked_numbers(name, value)
    if isinstance(value, (bool, np.bool_)):
        return bool(value)
    if isinstance(value, str):
        if len(value) > LONGEST_TEXT:
            raise ValueError(f"report({name}=…): text of {len(value)} characters, at most {LONGEST_TEXT} allowed")
        return sendable(value)
    flat = checked_numbers(name, value)
    return flat[0] if np.ndim(value) == 0 else flat


class Reporter:
    """Makes the reports of one program of `node`, and holds it to one kind of value a name."""

    def __init__(self, node: str) -> None:
        self._node = node
        self._is_text: dict[str, bool] = {}  # by the name of each reported value

    def report(
        self,
        time_ns: int,
        estimate_m: ArrayLike | None,
        covariance_m2: ArrayLike | None,
        values: Mapping[str, ArrayLike],
    ) -> Report:
        """Return a report; the arguments and errors are those of `Node.report`."""
        estimate = None if estimate_m is None else checked_numbers("estimate_m", estimate_m, 2)
        covariance = None if covariance_m2 is None else checked_covariance("covariance_m2", covariance_m2)
        named = {name: checked_value(name, value) for name, value in values.items()}
        is_text = self._is_text
        for name, kept in named.items():
            if is_text.get(name) is not isinstance(kept, str):
                self._check_kind(name, kept)
        return Report(
            time_ns=time_ns,
            node=self._node,
            estimate_m=None if estimate is None else (estimate[0], estimate[1]),
            covariance_m2=(
                None if covariance is None else (covariance[0], covariance[1], covariance[2], covariance[3])
            ),
            values=named,
        )

    def _check_kind(self, name: str, value: Value) -> None:
        """Raise ValueError for a name that no value can have, and for a text where numbers were, or the reverse."""
        is_text = isinstance(value, str)
        if name not in self._is_text:
            check_name(name)
            self._is_text[name] = is_text
        elif self._is_text[name] != is_text:
            before, now = ("a text", "a number") if self._is_text[name] else ("a number", "a text")
            text = f"{now}, but {self._node} has reported {before} by this name; use two names"
            raise ValueError(f"report({name}={value!r}): {text}")
