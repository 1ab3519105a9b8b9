"""Random streams that depend on what they decide and on nothing else.

Every decision has a stream of its own: a counter-based generator (Philox, Salmon et al. 2011, "Parallel random
numbers: as easy as 1, 2, 3") whose key is the run's seed and the name of the decision, and whose counter is the
vehicle or the frame. So the order of draws cannot matter, and one more vehicle changes no other vehicle's draws.

Every recorded trace depends on the names and on the layout of keys and counters: neither ever changes.
"""

from __future__ import annotations

import hashlib

import numpy as np
from numpy.typing import NDArray

NETWORK_KEY = 0x6E6574
"""The key of generated networks: "net" in ASCII. All other keys are hashes of names."""


def named_key(name: str) -> int:
    """Return the 64-bit key of the streams of this name."""
    return int.from_bytes(hashlib.blake2b(name.encode(), digest_size=8).digest(), "little")


def philox(seed: int, key: int, item: int = 0) -> np.random.Philox:
    """Return the bit generator of number `item` among the streams of a seed and a key."""
    counter = np.array([0, 0, item, 0], dtype=np.uint64)
    return np.random.Philox(key=np.array([seed, key], dtype=np.uint64), counter=counter)


def stream(seed: int, name: str, item: int = 0) -> np.random.Generator:
    """Return stream number `item` of a name: that of one vehicle, or the only one."""
    return np.random.Generator(philox(seed, named_key(name), item))


class Draws:
    """The uniform draws of one stage for all frames; `stage` names the streams."""

    def __init__(self, seed: int, stage: str) -> None:
        self._bits = philox(seed, named_key(stage))
        self._generator = np.random.Generator(self._bits)
        self._state = self._bits.state
        self._state["buffer_pos"], self._state["has_uint32"] = 4, 0  # nothing is left over from other frames
        self._counter = self._state["state"]["counter"]

    def uniform(self, sender: int, seq: int, count: int, copy: int = 0) -> NDArray[np.float64]:
        """Return `count` draws in [0, 1) for one frame, or a copy of it, indexed by receiver."""
        self._go_to(sender, seq, copy)
        return self._generator.random(count)

    def words(self, sender: int, seq: int, count: int, copy: int = 0) -> NDArray[np.uint64]:
        """Return `count` words of 64 random bits for one frame, from which several draws can be made."""
        self._go_to(sender, seq, copy)
        return np.asarray(self._bits.random_raw(count))

    def _go_to(self, sender: int, seq: int, copy: int) -> None:
        # Setting the counter of one generator is four times as fast as making one for each frame.
        counter = self._counter
        counter[0], counter[1], counter[2], counter[3] = 0, seq, sender, copy
        self._bits.state = self._state
