"""Bytes of a frame that arrive altered."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np


def random_flips(draw: float, size_bytes: int, count: int) -> Iterator[tuple[int, int]]:
    """Return `count` bytes of a frame to alter, as position and XOR mask, from a uniform draw in [0, 1).

    All bytes of a shorter frame are altered.
    """
    rng = np.random.default_rng(int(draw * 2**53))
    positions = rng.choice(size_bytes, size=min(count, size_bytes), replace=False)
    masks = rng.integers(1, 256, size=len(positions))
    return zip(positions.tolist(), masks.tolist(), strict=True)


def flips_between(sent: bytes, arrived: bytes) -> Iterator[tuple[int, int]]:
    """Yield where two payloads of one length differ, as position and XOR mask."""
    for position, (before, after) in enumerate(zip(sent, arrived, strict=True)):
        if before != after:
            yield position, before ^ after


def flipped(payload: bytes, flips: Sequence[tuple[int, int]]) -> bytes:
    """Return a payload with these bytes altered."""
    changed = bytearray(payload)
    for position, mask in flips:
        changed[position] ^= mask
    return bytes(changed)
