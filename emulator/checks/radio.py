"""Checks of a physical radio: frames fade as often as predicted, and the medium is shared by its rules."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import log, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emulator.checks.channel import nothing_seen, received_twice
from emulator.radio.csma import edca_parameters
from emulator.radio.dot11p import DETECTION_NS, SIFS_NS, arrival_probability
from emulator.radio.medium import WINDOW_NS
from emulator.radio.reception import Threshold, milliwatts
from emulator.radio.sidelink import REPEAT_SLOTS, Link
from emulator.radio.unicast import MOST_ATTEMPTS, ack_airtime_ns
from emulator.records.distributions import chi2_sf
from emulator.records.recorded_run import ON_AIR, RecordedRun
from emulator.records.verdicts import Finding, not_exercised, result
from emulator.scenario.faults import Throttle
from emulator.scenario.radio import Edca, EtsiReactive, Limeric, Receiver, Sidelink
from emulator.scenario.scenario import Radio
from vnet.errors import counted
from vnet.types import Array, IntArray, Mask

SIGMAS = 4.9
"""Half-width of bands in standard deviations: one sound sum in a million is further off."""
CERTAIN = 1e-6
TELLING_VARIANCE = 5.0
"""Least variance of the number of faded receptions on a link: with less, a sum is not yet normal."""
GRID_DB = 0.25
FACTORS = 1024
LEAST_PAUSE_NS = 25_000_000
ROUNDING = 1e-6
"""Share of a power, or of the busy time, within which recomputed and recorded values may differ."""


def check_fading(recorded: RecordedRun) -> Finding:
    """Check that as many receptions faded as path loss, fading and noise predict."""
    radio = recorded.scenario.radio
    if not radio.is_physical:
        return not_exercised("unit-disc radio: no fading")
    if radio.sidelink is not None and radio.sidelink.retransmit:
        return not_exercised("frames are transmitted twice: how many fade depends on who transmits")
    reached = recorded.outcome_is(*ON_AIR) & ~recorded.outcome_is("half_duplex")
    if radio.sidelink is not None:
        alike = _of_one_length(recorded, radio.sidelink)
        if len(alike) and not alike.any():
            return not_exercised("no sender's frames all need as many subchannels")
        reached &= alike
    drawing = np.flatnonzero(reached & ~received_twice(recorded) & recorded.placed)
    if not len(drawing):
        return nothing_seen(recorded, "no reception came as far as the receiver")
    survives = _survival(recorded, radio, drawing)
    faded = recorded.outcome_is("faded")[drawing]
    expected, seen = float((1 - survives).sum()), int(faded.sum())
    away = SIGMAS * sqrt(float((survives * (1 - survives)).sum())) + (log(1e6) / 3 if expected > 0 else 0)
    broken = not expected - away <= seen <= expected + away
    share, law = seen / len(drawing), expected / len(drawing)
    text = f"{seen:,} of {counted(len(drawing), 'reception')} faded, {share:.2%}; {law:.2%} expected"
    figures: dict[str, Any] = {"faded": seen, "pairs": len(drawing), "rate": share, "expected": law}
    unlike, figures["links"] = _unlike_their_law(recorded, drawing, survives, faded)
    broken_text = f"{text}: outside its band" if broken else f"{text}, but not on the links on which they should"
    rows = drawing[faded == (seen > expected)]
    if radio.fading is None and (impossible := np.where(faded, survives >= 1, survives <= 0)).any():
        rows, unlike = drawing[impossible], True
        broken_text = f"{counted(len(rows), 'reception')} with an impossible outcome"
        figures["impossible"] = len(rows)
    return result(broken + unlike, text, broken_text, recorded.rows(rows), **figures)


def _of_one_length(recorded: RecordedRun, mac: Sidelink) -> Mask:
    """Return the rows of senders whose frames all need as many subchannels.

    Others send short frames on the resources of longer ones, on more subchannels than the trace tells.
    """
    length = _subchannels(recorded, mac)
    least, most = np.full((2, len(recorded.node_ids)), [[np.iinfo(np.int64).max], [0]])
    np.minimum.at(least, recorded.sender, length)
    np.maximum.at(most, recorded.sender, length)
    return np.asarray((least == most)[recorded.sender])


def _subchannels(recorded: RecordedRun, mac: Sidelink) -> IntArray:
    """Return the number of subchannels that the frame of each row needs."""
    return np.asarray(-(-np.maximum(recorded.column("size_bytes"), 1) // mac.subchannel_bytes))


def _unlike_their_law(
    recorded: RecordedRun, rows: NDArray[np.intp], survives: Array, faded: Mask
) -> tuple[bool, int]:
    """Return whether the links together differ from their expectations by χ², and how many links count."""
    link = recorded.sender[rows] * len(recorded.node_ids) + recorded.receiver[rows]
    variance, differs = np.bincount(link, survives * (1 - survives)), np.bincount(link, faded - (1 - survives))
    telling = variance >= TELLING_VARIANCE
    squares = float((differs[telling] ** 2 / variance[telling]).sum())
    return bool(chi2_sf(squares, max(1, int(telling.sum()))) < CERTAIN), int(telling.sum())


def _survival(recorded: RecordedRun, radio: Radio, rows: NDArray[np.intp]) -> Array:
    """Return the probabilities (n,) that receptions arrive if no other vehicle sends."""
    sender, receiver, sent_ns = recorded.sender[rows], recorded.receiver[rows], recorded.sent_ns[rows]
    power_mw = recorded.places.pair_powers_mw(sender, receiver, sent_ns) * 10 ** (recorded.gain_db[rows] / 10)
    shape = np.zeros(len(rows), np.intp)
    shapes: tuple[float, ...] = (np.inf,)
    if radio.fading is not None:
        shapes = radio.fading.m
        shape = np.searchsorted(radio.fading.until_m, recorded.places.pair_distances_m(sender, receiver, sent_ns))
    power_db = np.full(len(rows), -np.inf)
    np.log10(power_mw, out=power_db, where=power_mw > 0)
    power_db *= 10
    survives = np.zeros(len(rows))
    heard = power_mw > 0
    first, of_row, _ = recorded.emissions  # far fewer than rows, which take long to sort
    airtime_ns, rate_mbps = recorded.airtime_ns[first], recorded.bitrate_mbps[first]
    if radio.sidelink is not None:  # where not the time on air counts, but the share of the channel
        airtime_ns = _subchannels(recorded, radio.sidelink)[first]
    kinds, kind = np.unique(np.column_stack([airtime_ns, rate_mbps]), axis=0, return_inverse=True)
    kind = kind.ravel()[of_row[rows]]
    for number, m in enumerate(shapes):
        for index, (length_ns, mbps) in enumerate(kinds.tolist()):
            some = heard & (shape == number) & (kind == index)
            if some.any():
                survives[some] = _arrives(radio, m, int(length_ns), mbps, power_db[some])
    return survives


def _arrives(radio: Radio, m: float, airtime_ns: int, rate_mbps: float, power_db: Array) -> Array:
    """Return the probability that frames arrive alone, by mean power; without fading m is infinite.

    On a sidelink `airtime_ns` is the number of subchannels, and what is not detected has not faded.
    """
    threshold = Threshold(radio.receiver or Receiver())
    link = Link(radio) if radio.sidelink is not None else None

    def of(power_mw: Array) -> Array:
        if link is not None:
            lost = link.error_rate(power_mw / link.noise_mw(max(airtime_ns, 1)))
            return np.asarray(1 - np.where(power_mw >= link.sensing_mw, lost, 0.0))
        arrives = arrival_probability(power_mw / threshold.noise_mw, airtime_ns, rate_mbps)
        return np.asarray(np.where(power_mw >= threshold.alone_mw, arrives, 0.0))

    if np.isinf(m):
        return of(10 ** (power_db / 10))
    from scipy.special import gammainccinv  # slow to import, and only fading needs it

    grid_db = np.arange(power_db.min() - GRID_DB, power_db.max() + GRID_DB, GRID_DB)
    # Steps of the factor's distribution that are finest where it is greatest, which is what weak signals live on.
    step = (np.arange(FACTORS) + 0.5) / FACTORS
    factors = gammainccinv(m, step**2) / m
    arrives = of(10 ** (grid_db[:, None] / 10) * factors) @ (2 * step / FACTORS)
    return np.asarray(np.interp(power_db, grid_db, arrives))


@dataclass(frozen=True)
class _Air:
    """The transmissions of a run, in order of their beginning, each by its first row of the trace.

    An acknowledgement, `is_ack`, has the row of its frame.
    """

    recorded: RecordedRun
    rows: NDArray[np.intp]
    sender: NDArray[np.intp]
    begin_ns: IntArray
    end_ns: IntArray
    is_ack: Mask

    @classmethod
    def of(cls, recorded: RecordedRun) -> _Air:
        """All that were on air."""
        frames = recorded.first_rows(~received_twice(recorded) & (recorded.on_air_ns >= 0))
        acked = frames[recorded.ack_on_air_ns[frames] >= 0]
        acks_ns = np.array([ack_airtime_ns(rate) for rate in recorded.bitrate_mbps[acked].tolist()], np.int64)
        rows = np.concatenate([frames, acked])
        sender = np.concatenate([recorded.sender[frames], recorded.receiver[acked]])
        begin_ns = np.concatenate([recorded.on_air_ns[frames], recorded.ack_on_air_ns[acked]])
        end_ns = begin_ns + np.concatenate([recorded.airtime_ns[frames], acks_ns])
        is_ack = np.arange(len(rows)) >= len(frames)
        order = np.argsort(begin_ns, kind="stable")
        return cls(recorded, rows[order], sender[order], begin_ns[order], end_ns[order], is_ack[order])

    def near(self, within_ns: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Pairs of transmissions (earlier, later): the later begins before so long after the other's end."""
        earlier, later = [np.zeros(0, np.intp)], [np.zeros(0, np.intp)]
        latest_ns = int((self.end_ns - self.begin_ns).max(initial=0)) + within_ns
        step = 1
        while step < len(self.rows) and (self.begin_ns[step:] - self.begin_ns[:-step] < latest_ns).any():
            close = np.flatnonzero(self.begin_ns[step:] < self.end_ns[:-step] + within_ns)
            earlier.append(close)
            later.append(close + step)
            step += 1
        return np.concatenate(earlier), np.concatenate(later)

    @cached_property
    def _overlaps(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """For each transmission those that overlap it, one after the other, and where each one's begin."""
        earlier, later = self.near(0)
        one, other = np.concatenate([earlier, later]), np.concatenate([later, earlier])
        order = np.argsort(one, kind="stable")
        return other[order], np.searchsorted(one[order], np.arange(len(self.rows) + 1))

    def met(self, rows: NDArray[np.intp]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return pairs of an index into `rows` of the trace and a transmission that overlapped that row's."""
        other, starts = self._overlaps
        emission = self.recorded.emission
        frames = np.flatnonzero(~self.is_ack)
        frames = frames[np.argsort(emission[self.rows[frames]])]
        mine = frames[np.searchsorted(emission[self.rows[frames]], emission[rows])]
        count = starts[mine + 1] - starts[mine]
        index = np.repeat(np.arange(len(rows)), count)
        nth = np.arange(len(index)) - np.repeat(np.cumsum(count) - count, count)
        return index, other[np.repeat(starts[mine], count) + nth]


def check_medium(recorded: RecordedRun) -> Finding:
    """Check that senders share the medium by its rules.

    No vehicle sends twice at once, without a pause, or while it senses another transmission. A collided frame met
    another transmission that its receiver could hear, and no vehicle receives while it sends.
    """
    if not recorded.shares_air:
        return not_exercised("no MAC configured ([radio.mac])")
    if not len(recorded.trace):
        return nothing_seen(recorded, "no frame was sent")
    air = _Air.of(recorded)
    if (mac := recorded.scenario.radio.sidelink) is not None:
        rules = broken_rules(recorded, mac)
        return _judged(
            recorded, air, {"mistimed": _mistimed(recorded), "collided_alone": _collided_alone(air), **rules}
        )
    broken: dict[str, NDArray[np.intp]] = {
        "mistimed": _mistimed(recorded),
        "without_pause": _without_pause(air),
        "into_others": _into_others(air),
        "collided_alone": _collided_alone(air),
        "heard_while_sending": _heard_while_sending(air),
        "badly_acknowledged": _badly_acknowledged(recorded),
    }
    return _judged(recorded, air, broken, too_idle=_too_idle(air))


def _judged(recorded: RecordedRun, air: _Air, broken: dict[str, NDArray[np.intp]], **more: int) -> Finding:
    """Return the finding of the rows that break each rule, and of what is counted without rows."""
    counts: dict[str, Any] = {**{what: len(rows) for what, rows in broken.items()}, **more}
    total = sum(counts.values())
    collided = int(recorded.outcome_is("collided").sum())
    sent = counted(len(air.rows), "transmission")
    text = f"{sent} by the rules of the MAC, {counted(collided, 'reception')} collided"
    broken_text = ", ".join(f"{count} {what}" for what, count in counts.items() if count)
    rows = recorded.rows(np.concatenate(list(broken.values())))
    return result(total, text, broken_text, rows, transmissions=len(air.rows), collided=collided, **counts)


def _mistimed(recorded: RecordedRun) -> NDArray[np.intp]:
    """Rows that were on air before they were sent, sooner than a throttle allows, or though discarded."""
    began = recorded.on_air_ns >= 0
    end_ns = np.where(began, recorded.on_air_ns + recorded.airtime_ns, recorded.sent_ns)
    left_ns = recorded.column("left_ns")
    wrong = (began == recorded.never_sent) | (began & (left_ns != end_ns)) | (left_ns < end_ns)
    wrong |= began & (recorded.on_air_ns < recorded.sent_ns)
    for planned in recorded.plan:
        if isinstance(planned.fault, Throttle):
            slow = planned.nodes[recorded.sender] & recorded.acting(planned, recorded.sent_ns, -recorded.guard_ns)
            least_ns = recorded.column("size_bytes") * 8_000 / planned.fault.bitrate_mbps - 1
            wrong |= began & slow & (recorded.on_air_ns - recorded.sent_ns < least_ns)
    return np.flatnonzero(wrong)


def _without_pause(air: _Air) -> NDArray[np.intp]:
    """Transmissions that begin too early after the same sender's last."""
    radio = air.recorded.scenario.radio
    assert isinstance(radio.mac, Edca)
    match radio.congestion:
        case EtsiReactive(pause_ms=pause_ms):
            least_ns = round(min(pause_ms) * 1_000_000)
        case Limeric():
            least_ns = LEAST_PAUSE_NS
        case _:
            least_ns = 0
    early = [np.zeros(0, np.intp)]
    for some, pause_ns in ((np.arange(len(air.rows)), 0), (np.flatnonzero(~air.is_ack), least_ns)):
        order = some[np.argsort(air.sender[some], kind="stable")]
        before, after = order[:-1], order[1:]
        soon = air.begin_ns[after] < air.end_ns[before] + edca_parameters(radio.mac).aifs_ns
        is_retry = air.recorded.attempt[air.rows[after]] > 1
        soon |= (air.begin_ns[after] < air.begin_ns[before] + pause_ns) & ~is_retry
        early.append(after[(air.sender[before] == air.sender[after]) & soon & ~air.is_ack[after]])
    return np.asarray(air.rows[np.unique(np.concatenate(early))])


def _into_others(air: _Air) -> NDArray[np.intp]:
    """Transmissions that begin while their sender senses another one, or before it has waited long enough.

    Fading differs from frame to frame: with it, what a sender sensed is not known.
    """
    recorded, radio = air.recorded, air.recorded.scenario.radio
    if radio.fading is not None:
        return np.zeros(0, np.intp)
    assert isinstance(radio.mac, Edca)
    earlier, later = air.near(edca_parameters(radio.mac).aifs_ns)
    noticed = air.begin_ns[later] >= air.begin_ns[earlier] + DETECTION_NS
    earlier, later = earlier[noticed], later[noticed]
    sent_ns = recorded.sent_ns[air.rows[earlier]]
    power_mw = recorded.places.pair_powers_mw(air.sender[earlier], air.sender[later], sent_ns)
    power_mw *= 10 ** (np.where(air.is_ack[earlier], 0.0, recorded.gain_db[air.rows[earlier]]) / 10)
    sensed = power_mw >= milliwatts(radio.mac.carrier_sense_dbm) * (1 + ROUNDING)
    sensed &= (air.sender[earlier] != air.sender[later]) & ~air.is_ack[later]  # which nothing keeps back
    return np.unique(air.rows[later[sensed]])


def _audible(air: _Air, rows: NDArray[np.intp]) -> Mask:
    """Return the mask of these rows that met a transmission that their receiver may have heard, or its own."""
    recorded = air.recorded
    index, other = air.met(rows)
    receiver, sent_ns = recorded.receiver[rows][index], recorded.sent_ns[air.rows[other]]
    heard = recorded.places.pairs_in_range(air.sender[other], receiver, sent_ns) | ~recorded.places.known(sent_ns)
    heard |= air.sender[other] == receiver
    return np.asarray(np.bincount(index, weights=heard, minlength=len(rows)) > 0)


def _collided_alone(air: _Air) -> NDArray[np.intp]:
    """Return the rows of frames that collided though their receiver could hear no other transmission.

    A frame that nobody is in range of has no row: receivers that sent such frames may have collided with their own.
    """
    recorded = air.recorded
    seen = recorded.places.always_in_range[recorded.receiver] & recorded.places.known(recorded.column("left_ns"))
    rows = np.flatnonzero(recorded.outcome_is("collided") & recorded.placed & seen)
    return np.asarray(rows[~_audible(air, rows)])


def _heard_while_sending(air: _Air) -> NDArray[np.intp]:
    recorded = air.recorded
    rows = np.flatnonzero(recorded.arrived & ~received_twice(recorded))
    index, other = air.met(rows)
    itself = air.sender[other] == recorded.receiver[rows][index]
    return np.asarray(rows[np.unique(index[itself])])


def _badly_acknowledged(recorded: RecordedRun) -> NDArray[np.intp]:
    """Rows of frames to single vehicles that break the rules of acknowledgements.

    An acknowledgement follows what was received after SIFS. A frame that was acknowledged is not transmitted again,
    and none more often than allowed. Of the attempts that were received only the first arrives.
    """
    rows = np.flatnonzero((recorded.attempt > 0) & ~received_twice(recorded))
    attempt, ack_ns, acked = recorded.attempt[rows], recorded.ack_on_air_ns[rows], recorded.acked[rows]
    arrived = recorded.arrived[rows]
    duplicate = recorded.outcome_is("duplicate")[rows]
    answered = ack_ns >= 0
    wrong = attempt > MOST_ATTEMPTS
    wrong |= (answered & (ack_ns != recorded.column("left_ns")[rows] + SIFS_NS)) | (acked & ~answered)
    wrong |= answered & ~(arrived | duplicate)
    frame = recorded.frame[rows]
    index = np.unique(frame, return_inverse=True)[1]
    single = (np.bincount(index, weights=attempt == 1) == 1)[index]  # faults may send a frame several times
    order = np.lexsort((attempt, frame))
    order = order[single[order]]
    same = np.diff(frame[order]) == 0
    wrong[order[1:]] |= same & (acked[order[:-1]] | (np.diff(attempt[order]) != 1))
    delivered = arrived & ~recorded.outcome_is("receiver_down")[rows]
    came, handed_over = np.zeros((2, len(rows)), bool)  # an earlier attempt, to the vehicle and to its program
    for before, after in zip(order[:-1][same].tolist(), order[1:][same].tolist(), strict=True):
        came[after] = came[before] or arrived[before]
        handed_over[after] = handed_over[before] or delivered[before]
    return np.asarray(rows[wrong | (single & ((delivered & handed_over) | (duplicate & ~came)))])


def _too_idle(air: _Air) -> int:
    """Count the channel busy ratios that are less than the vehicle's own transmissions."""
    ratio = air.recorded.busy_ratio
    sent_ns = np.zeros(ratio.shape)
    for shift in range(int((air.end_ns - air.begin_ns).max(initial=0)) // WINDOW_NS + 2):
        window = air.begin_ns // WINDOW_NS + shift
        from_ns = np.maximum(air.begin_ns, window * WINDOW_NS)
        part_ns = np.minimum(air.end_ns, (window + 1) * WINDOW_NS) - from_ns
        there = (window < len(ratio)) & (part_ns > 0)
        np.add.at(sent_ns, (window[there], air.sender[there]), part_ns[there])
    return int((sent_ns > (ratio + ROUNDING) * WINDOW_NS).sum())


def broken_rules(recorded: RecordedRun, mac: Sidelink) -> dict[str, NDArray[np.intp]]:
    """Return the rows of the trace that break a rule of the grid, by rule.

    Transmissions are whole slots, and begin `t1_slots` after their frame at the earliest. No vehicle transmits
    twice in a slot, or receives in one. `half_duplex` are the receptions of those that transmitted, and
    `below_sensing` of those at which a signal is too weak. Frames that nobody is in range of have no rows: of a
    vehicle that nobody heard at some time it is not known when it transmitted.
    """
    on_air = ~received_twice(recorded) & (recorded.on_air_ns >= 0)
    rows = np.flatnonzero(on_air)
    count = len(recorded.node_ids)
    node, slot = _occupied(recorded, mac, recorded.first_rows(on_air))
    key, times = np.unique(slot * count + node, return_counts=True)
    deaf = _transmit(recorded.receiver, recorded, mac, rows, key).all(axis=0)
    outcome_deaf = recorded.outcome_is("half_duplex")[rows]
    seen = recorded.places.always_in_range[recorded.receiver[rows]]
    seen &= recorded.places.known(recorded.on_air_ns[rows])
    judged = recorded.outcome_is(*ON_AIR)[rows]
    return {
        "unaligned": rows[_unaligned(recorded, mac, rows)],
        "too_soon": rows[_too_soon(recorded, mac, rows)],
        "twice": rows[_transmit(recorded.sender, recorded, mac, rows, key[times > 1]).any(axis=0)],
        "heard_while_sending": rows[judged & deaf & ~outcome_deaf],
        "deaf_without_sending": rows[outcome_deaf & ~deaf & seen],
        "wrongly_detected": _wrongly_detected(recorded, mac, rows[judged & ~outcome_deaf]),
    }


def _unaligned(recorded: RecordedRun, mac: Sidelink, rows: NDArray[np.intp]) -> Mask:
    """Return whether each row's transmission is no whole number of slots, or of too many."""
    begin_ns = recorded.on_air_ns[rows]
    lasts, rest = np.divmod(recorded.column("left_ns")[rows] - begin_ns, mac.slot_ns)
    most = 1 + REPEAT_SLOTS if mac.retransmit else 1
    return np.asarray((begin_ns % mac.slot_ns != 0) | (rest != 0) | (lasts < 1) | (lasts > most))


def _too_soon(recorded: RecordedRun, mac: Sidelink, rows: NDArray[np.intp]) -> Mask:
    """Return whether each row's transmission began before the first slot that its frame may have."""
    earliest = recorded.sent_ns[rows] // mac.slot_ns + mac.t1_slots
    return np.asarray(recorded.on_air_ns[rows] < earliest * mac.slot_ns)


def _transmit(
    node: NDArray[np.intp], recorded: RecordedRun, mac: Sidelink, rows: NDArray[np.intp], keys: NDArray[np.int64]
) -> Mask:
    """Return whether the node of each row transmits in the first and in the last slot of its frame.

    `keys` are the transmissions, slot by slot, in order.
    """
    keys = np.append(keys, -1)  # so that what is after the last has one to compare with
    found = []
    for slot in _slots(recorded, mac, rows):
        wanted = slot * len(recorded.node_ids) + node[rows]
        found.append(keys[np.searchsorted(keys[:-1], wanted)] == wanted)
    return np.asarray(found)


def _slots(recorded: RecordedRun, mac: Sidelink, rows: NDArray[np.intp]) -> list[NDArray[np.int64]]:
    """Return the slots in which the frames of these rows were first and last transmitted."""
    first = recorded.on_air_ns[rows] // mac.slot_ns
    return [first, recorded.column("left_ns")[rows] // mac.slot_ns - 1] if mac.retransmit else [first]


def _occupied(
    recorded: RecordedRun, mac: Sidelink, frames: NDArray[np.intp]
) -> tuple[NDArray[np.intp], NDArray[np.int64]]:
    """Return the nodes and the slots of all transmissions of frames, each once."""
    slots = _slots(recorded, mac, frames)
    again = slots[-1] != slots[0]
    sender = recorded.sender[frames]
    return np.append(sender, sender[again]), np.append(slots[0], slots[-1][again])


def _wrongly_detected(recorded: RecordedRun, mac: Sidelink, rows: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return the rows that were detected with too little power, or not detected with enough.

    Fading differs from frame to frame: with it the power is not known.
    """
    if recorded.scenario.radio.fading is not None:
        return np.zeros(0, np.intp)
    rows = rows[recorded.placed[rows]]
    power_mw = recorded.places.pair_powers_mw(
        recorded.sender[rows], recorded.receiver[rows], recorded.sent_ns[rows]
    )
    power_mw *= 10 ** (recorded.gain_db[rows] / 10)
    least_mw = milliwatts(mac.sensing_dbm)
    weak = recorded.outcome_is("below_sensing")[rows]
    lacks = weak & (power_mw > least_mw * (1 + ROUNDING))
    return np.asarray(rows[lacks | (~weak & (power_mw < least_mw * (1 - ROUNDING)))])
