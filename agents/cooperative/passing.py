"""Passing on: the increments of vehicles out of range, by one hop (MODEL 10).

A frame lists the increments that its sender used in the period before, and so says what its prior holds. A receiver
adds of each the share that the pooled priors do not hold. A record of `PASSED` is an exact copy wherever it comes
from, so records are compared and counted as bytes: for the few dozens of a period that takes a third of the time of
arrays.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from agents.cooperative.frame import NAME_BYTES
from agents.cooperative.information_frame import PASSED

MAX_FORGED_SHARE = 0.5
"""Share of the increments that are known first-hand, beyond which a frame that passes on others is forged."""

Records = Sequence[bytes]
"""Different records, as a frame lists them."""


class Passing:
    """The increments that a vehicle has used in the latest period, its own first, as records of `PASSED`."""

    def __init__(self, own: bytes) -> None:
        self._used = [own]

    def use(self, records: list[bytes]) -> None:
        """Replace the increments used; the vehicle's own is the first of `records`."""
        self._used = records

    def to_send(self, limit: int, period: int) -> NDArray[np.void]:
        """Return at most `limit` of the records, the first and of the others in turns."""
        used, others = self._used, len(self._used) - 1
        if limit <= others:
            used = [used[0], *[used[1 + (turn + period * limit) % others] for turn in range(limit - 1)]][:limit]
        return np.frombuffer(b"".join(used), dtype=PASSED)

    def shares(
        self, listed: Sequence[Records], weights: Sequence[float], defence: bool
    ) -> tuple[dict[bytes, float], int]:
        """Return the records of `listed` that are not used yet, each with the share that priors hold.

        That is the sum of the `weights` of the senders that list it. With `defence` what forged frames list is not
        counted; the second value is their number.
        """
        shares = _shares(set(self._used), listed, weights)
        names = {record[:NAME_BYTES] for record in shares}
        if len(names) == len(shares) and names.isdisjoint([record[:NAME_BYTES] for record in self._used]):
            return shares, 0
        forged = _forged(self._used, listed) if defence else set()
        new, listed = _one_an_origin(self._used, listed, forged)
        return {record: share for record, share in _shares(set(), listed, weights).items() if record in new}, len(
            forged
        )


def _shares(known: set[bytes], listed: Sequence[Records], weights: Sequence[float]) -> dict[bytes, float]:
    """Return the sum of the weights of the frames that list a record, for those that are not known."""
    shares: dict[bytes, float] = {}
    for weight, records in zip(weights, listed, strict=True):
        for record in records:
            if record not in known:
                shares[record] = shares.get(record, 0.0) + weight
    return shares


def _forged(used: Sequence[bytes], listed: Sequence[Records]) -> set[int]:
    """Return the indices of the frames that forge: most that is known first-hand of what they list differs."""
    own = {record[:NAME_BYTES]: record for record in used}
    forged = set()
    for index, records in enumerate(listed):
        known = [record == own[name] for record in records if (name := record[:NAME_BYTES]) in own]
        if known.count(False) > MAX_FORGED_SHARE * len(known):
            forged.add(index)
    return forged


def _one_an_origin(
    used: Sequence[bytes], listed: Sequence[Records], forged: set[int]
) -> tuple[set[bytes], list[Records]]:
    """Return the records that are new, the first of each origin, and what each frame lists in terms of these.

    An origin that a forged frame lists first is not used, and a forged frame lists nothing.
    """
    first: dict[bytes, bytes] = {record[:NAME_BYTES]: record for record in used}
    new: set[bytes] = set()
    for index, records in enumerate(listed):
        for record in records:
            if record[:NAME_BYTES] not in first:
                first[record[:NAME_BYTES]] = record
                new.update([record] if index not in forged else [])
    of_origins: list[Records] = [
        [] if index in forged else list(dict.fromkeys(first[record[:NAME_BYTES]] for record in records))
        for index, records in enumerate(listed)
    ]
    return new, of_origins
