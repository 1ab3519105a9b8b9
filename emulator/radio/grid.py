"""The resource grid of a sidelink: what each vehicle has sensed of it, and which resources it may select.

A resource is a slot and some adjacent subchannels. All arrays cover all vehicles at once, and what one of them has
sensed lies together, because selections read it. Slots count from the start of the run, and the last ones are kept
in a ring.

**Sensing and selection** are those of 3GPP TS 36.213, 14.1.1.6 (LTE mode 4), and TS 38.214, 8.1.4 (NR mode 2). Of
the resources in the selection window those are excluded that another vehicle has reserved, if its signal was
stronger than a threshold, and those that would repeat a slot in which the vehicle itself transmitted, and sensed
nothing. The threshold is raised by 3 dB until the least share remains. LTE then takes the share that was quietest
on average; both choose one at random. Unlike the standards, a vehicle that transmitted supposes that others have
its own reservation interval, and not any that is allowed; where this leaves too few resources it is left out, which
only NR says.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from emulator.radio.medium import SLICE_NS, WINDOW_NS
from emulator.radio.reception import milliwatts
from emulator.scenario.radio import Sidelink
from vnet.types import Array, IntArray, Mask
from vnet.units import NS_PER_MS

STEP_DB = 3.0
"""Step by which the threshold of exclusion is raised."""
NOT_RESERVED_DBM = -np.inf


class Wanted(NamedTuple):
    """Resources that a vehicle looks for: `length` subchannels in a slot from `first` to `last`.

    It will use them again every `period` slots, `times` times in all. It transmits anyway in the slots `booked`.
    The slots of resources that it `checks` again are left unless others have reserved these.
    """

    node: int
    first: int
    last: int
    length: int
    period: int
    times: int
    booked: frozenset[int] = frozenset()
    checks: tuple[int, ...] = ()


class Candidates(NamedTuple):
    """Candidate resources: the first slot of the window, a mask (slots, subchannels), and mean powers or None.

    A resource is named by its first subchannel. `power_mw` is the mean power sensed in earlier periods.
    """

    first: int
    mask: Mask
    power_mw: Array | None

    def has(self, slot: int, subchannel: int) -> bool:
        """Return true if a resource is a candidate."""
        return 0 <= slot - self.first < len(self.mask) and bool(self.mask[slot - self.first, subchannel])

    def chosen(self, uniform: float) -> tuple[int, int]:
        """Return the slot and the subchannel of the candidate that a draw in [0, 1) chooses."""
        index = np.flatnonzero(self.mask)
        slot, subchannel = divmod(int(index[int(uniform * len(index))]), self.mask.shape[1])
        return self.first + slot, subchannel

    def quietest(self, share: float, ties: Array) -> Candidates:
        """Return the share of all resources on which the least power was sensed; draws `ties` order equal ones."""
        if self.power_mw is None:
            return self
        index = np.flatnonzero(self.mask)
        most = int(np.ceil(share * self.mask.size))
        power_mw = self.power_mw.ravel()[index]
        if most < len(index):
            bound_mw = np.partition(power_mw, most - 1)[most - 1]
            less, equal = index[power_mw < bound_mw], index[power_mw == bound_mw]
            index = np.concatenate([less, equal[np.argsort(ties[equal], kind="stable")[: most - len(less)]]])
        mask = np.zeros(self.mask.size, bool)
        mask[index] = True
        return self._replace(mask=mask.reshape(self.mask.shape))

    def around(self, slot: int, most: int) -> Candidates:
        """Return the candidates in the slots that are at most so many before or after one, without it."""
        away = np.abs(self.first + np.arange(len(self.mask)) - slot)
        return self._replace(mask=self.mask & ((away > 0) & (away <= most))[:, None])


class Places(NamedTuple):
    """Places of K frames, in the order of their slots: (K,) each.

    `slot` is the index of a frame's slot among some, `first` its first subchannel, and `length` their number.
    """

    slot: IntArray
    first: IntArray
    length: IntArray

    def each(self) -> Iterator[tuple[int, int, int]]:
        """Yield the place of each frame: the index of its slot, its first subchannel, and their number."""
        return zip(self.slot.tolist(), self.first.tolist(), self.length.tolist(), strict=True)

    def resources(self) -> tuple[IntArray, IntArray, IntArray]:
        """Return all resources that are used: of each the frame, the index of its slot, and its subchannel."""
        if self.length.max(initial=0) <= 1:
            return np.arange(len(self.slot)), self.slot, self.first
        each = np.repeat(np.arange(len(self.slot)), self.length)
        nth = np.arange(len(each)) - np.repeat(np.cumsum(self.length) - self.length, self.length)
        return each, self.slot[each], self.first[each] + nth


class Heard(NamedTuple):
    """Frames of some slots: received powers (K, N) in mW, who decoded what they reserve, and their places.

    They have `told` their periods in slots and, where frames are sent twice, how many resources later their second
    transmission begins, counted slot by slot: (1 or 2, K), and 0 reserves nothing.
    """

    power_mw: Array
    decoded: Mask
    places: Places
    told: IntArray


class SensedGrid:
    """Powers and reservations that each of `count` vehicles has sensed in the sensing window of a MAC."""

    def __init__(self, mac: Sidelink, count: int) -> None:
        self._mac = mac
        self._slots = mac.sensing_slots
        self._ring = self._slots + mac.t1_slots + 1  # slots are decided ahead of their time
        self._busy_mw = milliwatts(mac.busy_dbm)
        shape = count, self._ring, mac.subchannels
        self._reserved_dbm = np.full(shape, NOT_RESERVED_DBM, np.float16)
        self._told = np.zeros((1 + mac.retransmit, *shape), np.int16)
        self._power_mw = np.zeros(shape, np.float32) if mac.ranks_power else None
        self._deaf = np.zeros((count, self._ring), bool)
        self._next = 0

    def advance(self, slot: int) -> None:
        """Let all slots before this one be over: nobody transmitted in those that were not sensed."""
        first = max(self._next, slot - self._ring)
        if first >= slot:
            return
        for rows, _ in self._spans(first, slot - first):
            self._reserved_dbm[:, rows], self._told[:, :, rows], self._deaf[:, rows] = NOT_RESERVED_DBM, 0, False
            if self._power_mw is not None:
                self._power_mw[:, rows] = 0
        self._next = slot

    def _spans(self, first: int, count: int) -> Iterator[tuple[slice, slice]]:
        """Yield where the ring has successive slots, in one piece or two, and which of the slots these are."""
        row = first % self._ring
        before = min(count, self._ring - row)
        yield slice(row, row + before), slice(0, before)
        if before < count:
            yield slice(0, count - before), slice(before, count)

    def sense(self, slots: Sequence[int], power_mw: Array, deaf: Mask, heard: Heard) -> None:
        """Note slots: the power (slots, subchannels, N) at each vehicle, who transmitted, and what others reserve.

        None of them may have been over. Of the frames on one subchannel the strongest that a vehicle can decode
        counts.
        """
        self.advance(slots[0])
        index = np.array(slots) - slots[0]
        shape = slots[-1] - slots[0] + 1, *power_mw.shape[1:]
        reserved_dbm, told = self._reservations(shape, index, heard)
        silent = np.zeros((shape[0], shape[2]), bool)
        silent[index] = deaf
        sensed_mw = None
        if self._power_mw is not None:
            sensed_mw = np.zeros(shape, np.float32)
            sensed_mw[index] = np.where(deaf[:, None] | (power_mw < self._busy_mw), 0, power_mw)
        for rows, some in self._spans(slots[0], shape[0]):
            self._reserved_dbm[:, rows] = reserved_dbm[some].transpose(2, 0, 1)
            self._told[:, :, rows] = told[:, some].transpose(0, 3, 1, 2)
            self._deaf[:, rows] = silent[some].T
            if self._power_mw is not None and sensed_mw is not None:
                self._power_mw[:, rows] = sensed_mw[some].transpose(2, 0, 1)
        self._next = slots[-1] + 1

    def _reservations(
        self, shape: tuple[int, ...], index: IntArray, heard: Heard
    ) -> tuple[NDArray[np.float16], NDArray[np.int16]]:
        """Return the strongest reservation that each vehicle decodes on each resource, and what is told there.

        The first has the `shape` (slots, subchannels, N); `index` are the slots of the frames.
        """
        each_dbm = np.full(heard.power_mw.shape, NOT_RESERVED_DBM)
        np.log10(heard.power_mw, out=each_dbm, where=heard.decoded)
        each_dbm *= 10
        each_dbm[~heard.told.any(axis=0)] = NOT_RESERVED_DBM
        each_told = (each_dbm > NOT_RESERVED_DBM) * heard.told[:, :, None].astype(np.int16)
        frame, slot, subchannel = heard.places.resources()
        row, index = index[slot] * shape[1] + subchannel, np.arange(len(frame))
        first = np.zeros(shape[0] * shape[1], np.intp)
        first[row[::-1]] = index[::-1]  # of several the one assigned last stays
        is_first = first[row] == index
        reserved_dbm = np.full((len(first), shape[2]), NOT_RESERVED_DBM, np.float16)
        told = np.zeros((len(each_told), len(first), shape[2]), np.int16)
        reserved_dbm[row[is_first]] = each_dbm[frame[is_first]]
        told[:, row[is_first]] = each_told[:, frame[is_first]]
        for number in np.flatnonzero(~is_first).tolist():
            place, dbm = row[number], each_dbm[frame[number]].astype(np.float16)
            stronger = dbm > reserved_dbm[place]
            np.copyto(reserved_dbm[place], dbm, where=stronger)
            np.copyto(told[:, place], each_told[:, frame[number]], where=stronger)
        return reserved_dbm.reshape(shape), told.reshape(-1, *shape)

    def candidates(self, now: int, wanted: Wanted) -> Candidates:
        """Return the candidates among the resources that a vehicle looks for in slot `now`.

        It knows of the slots of the sensing window that have ended.
        """
        self.advance(now)
        strongest_dbm = self._strongest_dbm(now, wanted)
        free = np.ones(len(strongest_dbm), bool)
        if wanted.booked:
            free[[slot - wanted.first for slot in wanted.booked if 0 <= slot - wanted.first < len(free)]] = False
        monitored = free & ~self._unmonitored(now, wanted)
        checked = [slot - wanted.first for slot in wanted.checks]
        monitored[checked] = free[checked]
        least = int(np.ceil(self._mac.candidate_share * strongest_dbm.size))
        if monitored.sum() * strongest_dbm.shape[1] < least:
            monitored = free
        remaining_dbm = np.where(monitored[:, None], strongest_dbm, np.inf)
        threshold_dbm = self._mac.exclusion_dbm
        enough_dbm = np.partition(remaining_dbm.ravel(), least - 1)[least - 1]
        if np.isinf(enough_dbm) and enough_dbm > 0:  # own transmissions leave less than the share
            threshold_dbm = np.finfo(float).max
        elif enough_dbm > threshold_dbm:
            threshold_dbm += STEP_DB * np.ceil((enough_dbm - threshold_dbm) / STEP_DB)
        return Candidates(wanted.first, remaining_dbm <= threshold_dbm, self._mean_power_mw(now, wanted))

    def _slot_of(self, row: NDArray[np.intp]) -> IntArray:
        """Return the last slots that rows of the ring stand for."""
        last = self._next - 1
        return np.asarray(row + (last - last % self._ring) - self._ring * (row > last % self._ring))

    def _strongest_dbm(self, now: int, wanted: Wanted) -> Array:
        """Return the strongest signal (slots, places) whose sender has reserved a part of each resource."""
        told = self._told[:, wanted.node].reshape(len(self._told), -1)
        place = np.flatnonzero(np.bitwise_or.reduce(told) != 0)
        row = place // self._mac.subchannels
        slot = self._slot_of(row)
        known = (slot < now) & (slot >= now - self._slots)
        if not known.all():
            place, row, slot = place[known], row[known], slot[known]
        subchannel = place - row * self._mac.subchannels
        period = told[0, place].astype(np.int64)
        dbm = self._reserved_dbm[wanted.node].ravel()[place].astype(float)
        window = wanted.last - wanted.first + 1
        strongest_dbm = np.full((window, self._mac.subchannels), NOT_RESERVED_DBM)
        scale = self._mac.projected_ms * NS_PER_MS // self._mac.slot_ns
        repeats = np.ones(len(period), np.int64)
        short = np.flatnonzero((period < scale) & (now - slot <= period))
        repeats[short] = -(-scale // period[short])
        if len(told) > 1:
            twice = np.flatnonzero(told[1, place])
            later = subchannel[twice] + told[1, place[twice]]
            slots, subchannels = slot[twice] + later // self._mac.subchannels, later % self._mac.subchannels
            self._mark(wanted, strongest_dbm, slots, subchannels, dbm[twice])
            slot, subchannel = np.concatenate([slot, slots]), np.concatenate([subchannel, subchannels])
            period, dbm, repeats = (np.concatenate([each, each[twice]]) for each in (period, dbm, repeats))
        for nth in range(1, int(repeats.max(initial=0)) + 1):
            if nth > 1:
                again = nth <= repeats
                repeats, slot, period = repeats[again], slot[again], period[again]
                subchannel, dbm = subchannel[again], dbm[again]
            self._mark(wanted, strongest_dbm, slot + nth * period, subchannel, dbm)
        if wanted.length == 1:
            return strongest_dbm
        parts = [strongest_dbm[:, n : strongest_dbm.shape[1] - wanted.length + 1 + n] for n in range(wanted.length)]
        return np.asarray(np.max(parts, axis=0))

    def _mark(
        self, wanted: Wanted, strongest_dbm: Array, reserved: IntArray, subchannel: NDArray[np.intp], dbm: Array
    ) -> None:
        """Mark the resources whose use, now or in one of the periods to come, would meet a reserved slot."""
        period = max(wanted.period, 1)
        later = offset = reserved - wanted.first
        if wanted.times > 1:
            offset = later - later // period * period  # much faster than the remainder
        for lap in range(0, len(strongest_dbm), period):
            index = offset + lap
            ahead = later - index
            meets = (index >= 0) & (index < len(strongest_dbm)) & (ahead >= 0) & (ahead < wanted.times * period)
            place = index[meets] * strongest_dbm.shape[1] + subchannel[meets]  # `at` is slow with two indices
            np.maximum.at(strongest_dbm.reshape(-1), place, dbm[meets])
            if wanted.times <= 1:
                break

    def _unmonitored(self, now: int, wanted: Wanted) -> Mask:
        """Return the mask of the slots that repeat one in which the vehicle transmitted."""
        unmonitored = np.zeros(wanted.last - wanted.first + 1, bool)
        own = np.flatnonzero(self._deaf[wanted.node])
        if len(own):
            period = max(wanted.period, 1) if wanted.period else 100 * NS_PER_MS // self._mac.slot_ns
            slot = self._slot_of(own)
            slot = slot[(slot < now) & (slot >= now - self._slots)]
            for lap in range(0, len(unmonitored), period):
                index = (slot - wanted.first) % period + lap
                unmonitored[index[index < len(unmonitored)]] = True
        return unmonitored

    def _mean_power_mw(self, now: int, wanted: Wanted) -> Array | None:
        """Return the mean power (slots, places) in the slots whole periods before each resource."""
        if self._power_mw is None:
            return None
        hundred = 100 * NS_PER_MS // self._mac.slot_ns
        step = min(wanted.period, hundred) if wanted.period else hundred
        slots = np.arange(wanted.first, wanted.last + 1)
        latest = slots - step * -(-(slots - now + 1) // step)
        each = latest - step * np.arange(self._slots // step)[:, None]
        known = each >= max(now - self._slots, 0)
        rows = each % self._ring
        counts = np.add.reduce(known & ~self._deaf[wanted.node].take(rows), axis=0, dtype=np.intp)
        sensed_mw = self._power_mw[wanted.node].take(rows, axis=0)
        if not known.all():
            sensed_mw *= known[:, :, None]
        power_mw = np.zeros(sensed_mw.shape[1:])  # it was silent in slots in which it transmitted
        for in_period_mw in sensed_mw:
            power_mw += in_period_mw
        power_mw /= np.maximum(counts, 1)[:, None]
        places = self._mac.subchannels - wanted.length + 1
        return np.asarray(sum(power_mw[:, n : n + places] for n in range(wanted.length)) / wanted.length)


class BusyMeter:
    """Channel busy ratio: the share of busy resources, counted in slices of 10 ms (TS 36.214, 5.1.30)."""

    def __init__(self, mac: Sidelink, count: int, remembered_ns: int) -> None:
        self._slot_ns, self._subchannels, self._count = mac.slot_ns, mac.subchannels, count
        self._remembered = remembered_ns // SLICE_NS
        self._busy: dict[int, IntArray] = defaultdict(lambda: np.zeros(count, np.int64))
        self.windows: list[Array] = []
        """Channel busy ratios (N,) of the windows that have ended."""

    def add(self, slot: int, busy: IntArray) -> None:
        """Add the number of busy subchannels (N,) in a slot; all before it are over."""
        self.count(slot * self._slot_ns)
        self._busy[slot * self._slot_ns // SLICE_NS] += busy

    def count(self, time_ns: int) -> None:
        """Close the windows that end by a time."""
        while (end_ns := (len(self.windows) + 1) * WINDOW_NS) <= time_ns:
            self.windows.append(self.at(end_ns))
        oldest = time_ns // SLICE_NS - self._remembered
        while self._busy and (first := next(iter(self._busy))) < oldest:
            del self._busy[first]

    def at(self, time_ns: int) -> Array:
        """Return the channel busy ratios (N,) of the 100 ms before a multiple of 10 ms."""
        some = [
            self._busy[n] for n in range((time_ns - WINDOW_NS) // SLICE_NS, time_ns // SLICE_NS) if n in self._busy
        ]
        total = np.sum(some, axis=0) if some else np.zeros(self._count)
        return np.asarray(total / (WINDOW_NS // self._slot_ns * self._subchannels))
