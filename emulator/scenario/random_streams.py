"""Random streams that depend on what they decide and on nothing else.

Every decision has a stream of its own: a counter-based generator (Philox, Salmon et al. 2011, "Parallel random
numbers: as easy as 1, 2, 3") whose key is the run's seed and the name of the decision, and whose counter is the
vehicle or the frame. So the order of draws cannot matter, and one more vehicle changes no other vehicle's draws.

Every recorded trace depends on the names and on the layout of keys and counters: neither ever changes.
"""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

NETWORK_KEY = 0x6E6574
"""The key of generated networks: "net" in ASCII. All other keys are hashes of names."""

PHILOX_ROUNDS = 10
PHILOX_MULTIPLIERS = 0xD2E7470EE14C6C93, 0xCA5A826395121157
"""Multipliers of Philox4x64 (Salmon et al. 2011)."""
PHILOX_WEYL = 0x9E3779B97F4A7C15, 0xBB67AE8584CAA73B
"""Steps of the key from one round to the next."""
PIECE = 8192
"""Words that are computed at once: their arrays stay in the cache."""
CALL_US, DRAW_ALONE_US, FRAME_US, DRAW_US = 400.0, 0.26, 4.0, 0.01
"""Measured times in µs: computing single draws costs CALL_US and DRAW_ALONE_US each; drawing for all receivers
costs FRAME_US a frame and DRAW_US a receiver."""
_PHILOX = tuple(np.uint64(multiplier) for multiplier in PHILOX_MULTIPLIERS)
_LOW_HALF, _HALF = np.uint64(2**32 - 1), np.uint64(32)


def named_key(name: str) -> int:
    """Return the 64-bit key of the streams of this name."""
    return int.from_bytes(hashlib.blake2b(name.encode(), digest_size=8).digest(), "little")


def philox(seed: int, key: int, item: int = 0, seq: int = 0, copy: int = 0) -> np.random.Philox:
    """Return the bit generator of number `item`, or of a frame of this sender, of a seed and a key."""
    counter = np.array([0, seq, item, copy], dtype=np.uint64)
    return np.random.Philox(key=np.array([seed, key], dtype=np.uint64), counter=counter)


def stream(seed: int, name: str, item: int = 0) -> np.random.Generator:
    """Return stream number `item` of a name: that of one vehicle, or the only one."""
    return np.random.Generator(philox(seed, named_key(name), item))


def frame_stream(seed: int, name: str, sender: int, seq: int, copy: int = 0) -> np.random.Generator:
    """Return the stream of one frame, or a copy of it, among those of a name."""
    return np.random.Generator(philox(seed, named_key(name), sender, seq, copy))


def philox_words_at(
    key: NDArray[np.uint64], frames: NDArray[np.uint64], index: NDArray[np.intp]
) -> NDArray[np.uint64]:
    """Return single words (n,) of Philox4x64-10 streams with this key (2,), as `Draws.words` draws them.

    `frames` (n, 3) are sender, number and copy of the frame of each word; `index` (n,) is the word's place in the
    frame's stream. numpy has no such function: its generator draws a stream from its beginning.
    """
    words = np.empty(len(index), np.uint64)
    for first in range(0, len(index), PIECE):
        piece = slice(first, first + PIECE)
        sender, seq, copy = np.ascontiguousarray(frames[piece].T)
        block = (index[piece] >> 2).astype(np.uint64) + np.uint64(1)
        words[piece] = np.choose(index[piece] & 3, _philox_blocks(key, block, seq, sender, copy))
    return words


def _philox_blocks(key: NDArray[np.uint64], *counter: NDArray[np.uint64]) -> tuple[NDArray[np.uint64], ...]:
    """Return the four words (n,) each of the blocks at these four words of the counter (n,) each."""
    one, two, three, four = counter
    weyl = [int(word) for word in key]
    for _ in range(PHILOX_ROUNDS):
        high, other_high = _multiply_high(one, 0), _multiply_high(three, 1)
        other_high ^= two
        other_high ^= np.uint64(weyl[0])
        high ^= four
        high ^= np.uint64(weyl[1])
        one, two, three, four = other_high, three * _PHILOX[1], high, one * _PHILOX[0]
        weyl = [(word + step) % 2**64 for word, step in zip(weyl, PHILOX_WEYL, strict=True)]
    return one, two, three, four


def _multiply_high(words: NDArray[np.uint64], which: int) -> NDArray[np.uint64]:
    """Return the upper 64 bits of the 128-bit products (n,) of words with a multiplier of Philox, by halves."""
    low_factor, high_factor = _PHILOX[which] & _LOW_HALF, _PHILOX[which] >> _HALF
    low, high = words & _LOW_HALF, words >> _HALF
    middle = low * low_factor
    middle >>= _HALF
    middle += high * low_factor
    low *= high_factor
    low += middle & _LOW_HALF
    low >>= _HALF
    middle >>= _HALF
    high *= high_factor
    high += low
    high += middle
    return high


def uniform_of(words: NDArray[np.uint64]) -> NDArray[np.float64]:
    """Return the draws in [0, 1) that numpy's generators make of words."""
    return np.asarray((words >> np.uint64(11)) * 2.0**-53)


class Draws:
    """The uniform draws of one stage for all frames; `stage` names the streams."""

    def __init__(self, seed: int, stage: str) -> None:
        self._bits = philox(seed, named_key(stage))
        self._generator = np.random.Generator(self._bits)
        state = self._bits.state
        self.key: NDArray[np.uint64] = state["state"]["key"]
        """Key (2,) of the stage's streams."""
        # numpy takes the numbers one by one, and takes them twice as fast out of a list as out of an array.
        self._state: Any = {  # numpy's types know arrays only
            **state,
            "state": {"counter": [0, 0, 0, 0], "key": self.key.tolist()},
            "buffer": state["buffer"].tolist(),
            "buffer_pos": len(state["buffer"]),  # nothing is left over from other frames
            "has_uint32": 0,
        }
        self._words = self._state["state"]

    def uniform(self, sender: int, seq: int, count: int, copy: int = 0) -> NDArray[np.float64]:
        """Return `count` draws in [0, 1) for one frame, or a copy of it, indexed by receiver."""
        self._go_to(sender, seq, copy)
        return self._generator.random(count)

    def uniform_at(
        self, frames: NDArray[np.uint64], each: NDArray[np.intp], receiver: NDArray[np.intp]
    ) -> NDArray[np.float64]:
        """Return single draws (n,) out of those that `uniform` returns for each frame, at these receivers.

        `frames` (K, 3) are sender, number and copy of each frame; `each` (K,) is the number of receivers of each,
        and `receiver` (n,) those of the first frame, then those of the second, and so on. The two ways to it give
        the same: drawing for all receivers of each frame, or computing no other draw than these.
        """
        most = int(receiver.max(initial=0)) + 1
        if len(receiver) * DRAW_ALONE_US + CALL_US < len(frames) * (FRAME_US + most * DRAW_US):
            index = np.repeat(np.arange(len(frames)), each)
            return uniform_of(philox_words_at(self.key, frames[index], receiver))
        drawn = np.empty(len(receiver))
        end = np.cumsum(each).tolist()
        for (sender, seq, copy), first, last in zip(frames.tolist(), [0, *end], end, strict=False):
            drawn[first:last] = self.uniform(sender, seq, most, copy)[receiver[first:last]]
        return drawn

    def words(self, sender: int, seq: int, count: int, copy: int = 0) -> NDArray[np.uint64]:
        """Return `count` words of 64 random bits for one frame, from which several draws can be made."""
        self._go_to(sender, seq, copy)
        return np.asarray(self._bits.random_raw(count))

    def _go_to(self, sender: int, seq: int, copy: int) -> None:
        # Setting the counter of one generator is four times as fast as making one for each frame.
        self._words["counter"] = 0, seq, sender, copy
        self._bits.state = self._state
