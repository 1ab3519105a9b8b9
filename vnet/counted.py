"""Counts in texts: a number that agrees with its noun."""

from __future__ import annotations


def counted(number: int, noun: str, plural: str = "") -> str:
    """Return `number` with its noun: "1 frame", "2,000 frames"; `plural` is for those that take no plain "s"."""
    return f"{number:,} {noun if number == 1 else plural or noun + 's'}"
