"""What can become of a (frame, receiver) pair: a closed set, of which each pair gets exactly one."""

from enum import IntEnum


class Outcome(IntEnum):
    """The outcome of one pair. The values are those of the trace's internal columns, the names its public ones.

    `pending` is the state of a pair that is still on its way; no finished trace contains it.
    """

    pending = 0
    delivered = 1
    out_of_range = 2
    peer_cap = 3
    lost = 4
    queue_full = 5
    oversize = 6
    fault = 7
    receiver_down = 8
    transport = 9
    faded = 10
    collided = 11
    held_back = 12


PENDING, OUT_OF_RANGE = Outcome.pending.value, Outcome.out_of_range.value
"""The same as plain numbers, with which numpy compares ten times as fast."""
