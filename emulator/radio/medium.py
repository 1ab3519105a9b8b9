"""The shared medium: frames on air, carrier sensing at every vehicle, and the frame each receiver is locked on.

All arrays cover all vehicles at once. The access rules are in `csma`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from emulator.radio.dot11p import DETECTION_NS
from emulator.radio.frames import Signal, Transmission
from emulator.radio.reception import Threshold
from vnet.types import Array

WINDOW_NS = 100_000_000
"""Measurement window of the channel busy ratio (ETSI TS 102 687)."""
SLICE_NS = WINDOW_NS // 10
"""Interval at which busy time is summed, so that windows of measurement may begin at any multiple of it."""
LONG_AGO_NS = -(1 << 60)
"""Initial time of the last change of the medium's state."""

Listener = Callable[[int, NDArray[np.int64]], None]
"""Called at the end of a slice with its number and the busy time (N,) in ns."""


class Medium:
    """The frames on air between `count` vehicles, and the state of the medium at each.

    `sensed` (N,) marks the vehicles at which the medium is busy: those that transmit, and those at which the sum of
    all powers is at least `carrier_sense_mw`. It is None if nothing is on air. `idle_ns` (N,) is the time at which
    the medium last became idle. Busy times of the last `remembered_ns` are kept.
    `listener` is called at the end of each slice.
    """

    def __init__(
        self,
        count: int,
        carrier_sense_mw: float,
        threshold: Threshold,
        remembered_ns: int = WINDOW_NS,
        listener: Listener | None = None,
    ) -> None:
        self._carrier_sense_mw = carrier_sense_mw
        self._threshold = threshold
        self._frames: list[Transmission] = []
        self._total_mw: Array = np.zeros(count)
        self.sensed: NDArray[np.bool_] | None = None
        self._busy_ns = np.full(count, LONG_AGO_NS)
        self._busy_since_ns: int | None = None
        self.idle_ns = np.full(count, LONG_AGO_NS)
        self._counted_ns = 0
        self._spans: list[tuple[NDArray[np.bool_], int]] = []
        self._slice_ends_ns = SLICE_NS
        self._slices: deque[NDArray[np.int64]] = deque(maxlen=max(remembered_ns, WINDOW_NS) // SLICE_NS)
        self._window_ns = np.zeros(count, np.int64)
        self._listener = listener
        self.windows: list[Array] = []
        """Channel busy ratios (N,) of the windows that have ended."""

    def is_sensed(self, node: int) -> bool:
        """Return true if the medium is busy at `node`."""
        return self.sensed is not None and bool(self.sensed[node])

    def busy_ns(self, node: int) -> int:
        """Return the time since which the medium is busy at `node`; meaningful only while it is."""
        return int(self._busy_ns[node]) if self._busy_since_ns is None else self._busy_since_ns

    def _store_busy_since(self) -> None:
        """Store `_busy_since_ns`, common to all vehicles while one frame is alone on air, for each vehicle."""
        if self._busy_since_ns is not None:
            assert self.sensed is not None
            np.copyto(self._busy_ns, self._busy_since_ns, where=self.sensed)
            self._busy_since_ns = None

    def begin(self, sent: Transmission, time_ns: int) -> None:
        """Start the transmission of a frame, with the powers of `sent.signal`."""
        self.count(time_ns)
        signal = _signal(sent)
        before_mw, others = self._total_mw, self._frames
        if others:
            total_mw = before_mw + signal.power_mw
            self._lock(sent, signal, total_mw)
            for other in others:
                _signal(other).pieces.append((time_ns, before_mw))
        else:
            total_mw = signal.power_mw
        others.append(sent)
        self._sense(total_mw, time_ns)

    def _lock(self, sent: Transmission, signal: Signal, total_mw: Array) -> None:
        """Lock receivers on a new signal: those that detect it and are not locked on another one yet.

        A receiver releases a signal that began less than `DETECTION_NS` ago if, with the new one as interference,
        it no longer detects it. The new signal's sender is locked on nothing, and no vehicle on air locks on it.
        """
        taken = np.zeros(len(total_mw), dtype=bool)
        for other in self._frames:
            known = _signal(other)
            if known.locked is None:
                known.locked = known.power_mw >= self._threshold.alone_mw
            if other.on_air_ns + DETECTION_NS > sent.on_air_ns:
                known.locked &= self._threshold.detects(known.power_mw, total_mw)
            known.locked[sent.frame.sender] = False
            taken |= known.locked
            taken[other.frame.sender] = True  # whatever little power it sends with
        signal.locked = self._threshold.detects(signal.power_mw, total_mw) & ~taken

    def locked(self, sent: Transmission) -> NDArray[np.bool_]:
        """Return the mask (N,) of the receivers that are locked on a frame, or were until it ended."""
        signal = _signal(sent)
        return signal.power_mw >= self._threshold.alone_mw if signal.locked is None else signal.locked

    def end(self, sent: Transmission, time_ns: int) -> None:
        """End the transmission of a frame."""
        self.count(time_ns)
        signal, before_mw = _signal(sent), self._total_mw
        self._frames.remove(sent)
        if signal.pieces or self._frames:
            signal.pieces.append((time_ns, before_mw))
        if not self._frames:
            assert self.sensed is not None
            np.copyto(self.idle_ns, time_ns, where=self.sensed)
            self.sensed = None
            return
        total_mw = _signal(self._frames[0]).power_mw
        for other in self._frames:
            _signal(other).pieces.append((time_ns, before_mw))
            if other is not self._frames[0]:
                total_mw = total_mw + _signal(other).power_mw
        self._sense(total_mw, time_ns)

    def _sense(self, total_mw: Array, time_ns: int) -> None:
        sensed, before = total_mw >= self._carrier_sense_mw, self.sensed
        for sent in self._frames:
            sensed[sent.frame.sender] = True  # half duplex
        if before is None:
            self._busy_since_ns = time_ns
        else:
            self._store_busy_since()
            np.copyto(self._busy_ns, time_ns, where=sensed & ~before)
            np.copyto(self.idle_ns, time_ns, where=before & ~sensed)
        self._total_mw, self.sensed = total_mw, sensed

    def count(self, time_ns: int) -> None:
        """Accumulate the busy time up to `time_ns`."""
        while time_ns >= self._slice_ends_ns:
            self._count(self._slice_ends_ns)
            self._end_slice()
        self._count(time_ns)

    def _count(self, time_ns: int) -> None:
        if time_ns > self._counted_ns:
            if self.sensed is not None:
                self._spans.append((self.sensed, time_ns - self._counted_ns))
            self._counted_ns = time_ns

    def _end_slice(self) -> None:
        busy_ns = np.zeros_like(self._window_ns)
        if self._spans:
            sensed, lengths_ns = zip(*self._spans, strict=True)
            busy_ns = np.array(lengths_ns) @ np.array(sensed)
            self._spans.clear()
        if self._listener is not None:
            self._listener(self._slice_ends_ns // SLICE_NS - 1, busy_ns)
        self._slices.append(busy_ns)
        self._window_ns += busy_ns
        if self._slice_ends_ns % WINDOW_NS == 0:
            self.windows.append(self._window_ns / WINDOW_NS)
            self._window_ns[:] = 0
        self._slice_ends_ns += SLICE_NS

    def busy_ratios_at(self, time_ns: int) -> Array:
        """Return the channel busy ratios (N,) of the 100 ms before `time_ns`, a past multiple of `SLICE_NS`.

        Before time 0 the medium was idle.
        """
        self.count(time_ns)
        begin, end = (time_ns - WINDOW_NS) // SLICE_NS, time_ns // SLICE_NS
        first = self._slice_ends_ns // SLICE_NS - 1 - len(self._slices)
        some = [self._slices[number - first] for number in range(max(begin, 0), end)]
        return np.asarray(np.sum(some, axis=0) / WINDOW_NS) if some else np.zeros(len(self._window_ns))


def _signal(sent: Transmission) -> Signal:
    assert sent.signal is not None
    return sent.signal
