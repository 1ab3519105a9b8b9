"""Messages about orders of events (docs/orders.md): what a node is to follow, and how it deviates from FIFO."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal

import msgspec

TimeNs = Annotated[int, msgspec.Meta(ge=0, le=2**62)]
Count = Annotated[int, msgspec.Meta(ge=0, le=2**62)]


class Deviation(msgspec.Struct, frozen=True, array_like=True):
    """A decision of `node` that is not FIFO's: at `time_ns`, of what happened, `label` came before `first`.

    `decision` counts the decisions of the instant from 0.
    """

    node: str
    incarnation: Count
    time_ns: TimeNs
    decision: Count
    label: Annotated[str, msgspec.Meta(max_length=256)]
    first: Annotated[str, msgspec.Meta(max_length=256)]


class Order(msgspec.Struct, frozen=True, array_like=True):
    """In which order a node is shown what happens at one instant (lockstep), if not FIFO.

    `depth` and `steps` are those of `pct`; `tape` has the deviations from FIFO of a `tape`.
    """

    kind: Literal["shuffle", "pct", "tape"]
    seed: int = 0
    depth: Count = 1
    steps: Count = 0
    tape: Sequence[Deviation] = ()
