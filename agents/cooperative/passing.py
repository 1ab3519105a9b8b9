"""Passing on: the increments of vehicles out of range, by one hop (MODEL 10).

A frame lists the increments that its sender used in the period before, and so says what its prior holds. A receiver
adds of each the share that the pooled priors do not hold. A record of `PASSED` is an exact copy wherever it comes
from, so records are compared and counted as bytes: for the few dozens of a period sets take a third of the time of
arrays.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from agents.cooperative.frame import NAME_BYTES
from agents.cooperative.information_frame import PASSED
from vnet.types import Array

MAX_FORGED_SHARE = 0.5
"""Share of the increments that are known first-hand, beyond which a frame that passes on others is forged."""

Records = frozenset[bytes]


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
        """Return the records of `listed` that are not used yet, sorted, each with the share that priors hold.

        That is the sum of the `weights` of the senders that list it. With `defence` what forged frames list is not
        counted; the second value is their number.
        """
        own = frozenset(self._used)
        new = frozenset[bytes]().union(*listed) - own
        names = {record[:NAME_BYTES] for record in new}
        forged: set[int] = set()
        if len(names) < len(new) or not names.isdisjoint([record[:NAME_BYTES] for record in self._used]):
            forged = _forged(self._used, listed) if defence else set()
            new, listed = _one_an_origin(self._used, listed, forged)
        share = dict.fromkeys(sorted(new), 0.0)
        for weight, records in zip(weights, listed, strict=True):
            for record in records & new:
                share[record] += weight
        return share, len(forged)


def codes_and_increments(records: Sequence[bytes]) -> tuple[list[int], Array]:
    """Return the origins' codes (n,) and the increments (n, 5) of records."""
    table = np.frombuffer(b"".join(records), dtype=PASSED)
    return table["name"].tolist(), table["information"].astype(np.float64)


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
) -> tuple[frozenset[bytes], list[Records]]:
    """Return the records that are new, the first of each origin, and what each frame lists in terms of these.

    An origin that a forged frame lists first is not used, and a forged frame lists nothing.
    """
    first: dict[bytes, bytes] = {record[:NAME_BYTES]: record for record in used}
    new = set()
    for index, records in enumerate(listed):
        for record in sorted(records):
            if record[:NAME_BYTES] not in first:
                first[record[:NAME_BYTES]] = record
                new.update([record] if index not in forged else [])
    of_origins = [
        frozenset() if index in forged else frozenset(first[record[:NAME_BYTES]] for record in records)
        for index, records in enumerate(listed)
    ]
    return frozenset(new), of_origins
