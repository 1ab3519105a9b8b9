"""Zenoh programs as vehicles: their commands, the messages that cross the radio, and their frames."""

from __future__ import annotations

from collections.abc import Sequence

FILLED_IN = ("{id}", "{endpoint}", "{port}")
"""Words of a command that vnet fills in."""


def filled_in(words: Sequence[str], node: str, endpoint: str) -> list[str]:
    """Return the words of a command of the vehicle `node`, whose endpoint is PROTOCOL/HOST:PORT."""
    values = node, endpoint, endpoint.rpartition(":")[2]
    filled = list(words)
    for name, value in zip(FILLED_IN, values, strict=True):
        filled = [word.replace(name, value) for word in filled]
    return filled
