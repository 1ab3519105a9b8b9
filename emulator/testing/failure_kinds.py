"""Failures of one kind: the same check, with texts that differ in their numbers only."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

from emulator.testing.matrix import column_of

_NUMBERS = re.compile(r"(\.py:\d+)|\b0x[0-9a-f]+\b|\d+(?:[.,]\d+)*|'[^']*'")
"""Parts of a text that differ from run to run: numbers, names of vehicles, and what is quoted; lines do not."""


@dataclass(frozen=True)
class FailureKind:
    """Runs in which a check failed in one way: their count, and number and text of the first."""

    check: str
    text: str
    first: str
    runs: int = 1


def failure_kinds(failures: Iterable[tuple[str, Mapping[str, str]]]) -> list[FailureKind]:
    """Return the kinds of failures, given by number with their texts by check; the most frequent come first."""
    kinds: dict[tuple[str, str], FailureKind] = {}
    for number, texts in failures:
        of_this_run: dict[tuple[str, str], FailureKind] = {}
        for check, text in texts.items():
            column = column_of(check)[0]
            of_this_run.setdefault(
                (column, _NUMBERS.sub(lambda part: part[1] or "#", text)), FailureKind(column, text, number)
            )
        for key, kind in of_this_run.items():
            before = kinds.get(key)
            kinds[key] = kind if before is None else replace(before, runs=before.runs + 1)
    return sorted(kinds.values(), key=lambda kind: -kind.runs)
