"""Random draws that depend on what they decide and on nothing else.

Each (stage, sender, sequence number) has a stream of its own: a counter-based generator (Philox, Salmon et al.
2011, "Parallel random numbers: as easy as 1, 2, 3") whose key is the scenario's seed and the stage, and whose
counter is the frame. So arrival order cannot matter, and one more vehicle changes nobody else's luck.
"""

from __future__ import annotations

import hashlib

import numpy as np
from numpy.typing import NDArray


class Draws:
    """The uniform draws of one stage; `stage` names it."""

    def __init__(self, seed: int, stage: str) -> None:
        stage_key = int.from_bytes(hashlib.blake2b(stage.encode(), digest_size=8).digest(), "little")
        self._bits = np.random.Philox(key=np.array([seed, stage_key], dtype=np.uint64))
        self._generator = np.random.Generator(self._bits)
        self._state = self._bits.state
        self._state["buffer_pos"], self._state["has_uint32"] = 4, 0  # nothing is left over from other frames
        self._counter = self._state["state"]["counter"]

    def uniform(self, sender: int, seq: int, count: int, copy: int = 0) -> NDArray[np.float64]:
        """`count` draws in [0, 1) for one frame, or a copy of it, to be indexed by receiver number."""
        self._go_to(sender, seq, copy)
        return self._generator.random(count)

    def words(self, sender: int, seq: int, count: int, copy: int = 0) -> NDArray[np.uint64]:
        """The same as words of 64 random bits, of which several draws can be made."""
        self._go_to(sender, seq, copy)
        return np.asarray(self._bits.random_raw(count))

    def _go_to(self, sender: int, seq: int, copy: int) -> None:
        # Setting the counter of one generator is four times as fast as making one for each frame.
        counter = self._counter
        counter[0], counter[1], counter[2], counter[3] = 0, seq, sender, copy
        self._bits.state = self._state
