"""The resource grid: selection is that of the standards, computed here once more, resource by resource."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from emulator.radio.grid import BusyMeter, Candidates, Heard, Places, SensedGrid, Wanted
from emulator.scenario.radio import LteMode4, NrMode2, Sidelink

QUIET_DBM, LOUD_DBM = -100.0, -60.0


def lte(**keys: Any) -> LteMode4:
    return LteMode4.model_validate({"kind": "lte-mode4", "busy_dbm": -120, **keys})


def sense(
    grid: SensedGrid, mac: Sidelink, slot: int, frames: list[tuple[int, int, int, float]], later: int = 0
) -> None:
    """Let vehicle 1 transmit frames, which vehicle 0 hears: first subchannel, length, period, power in dBm.

    Each is transmitted again so many resources `later`, counted slot by slot.
    """
    power_mw = np.zeros((mac.subchannels, 2))
    for first, length, _, dbm in frames:
        power_mw[first : first + length, 0] += 10 ** (dbm / 10) / length
    own_mw = np.array([[10 ** (dbm / 10), 1.0] for *_, dbm in frames])
    decoded = np.array([[True, False]] * len(frames))
    starts, lengths, periods, _ = (np.array(column) for column in zip(*frames, strict=True))
    places = Places(np.zeros(len(frames), np.int64), starts, lengths)
    told = np.array([periods, np.full(len(frames), later)][: 1 + mac.retransmit])
    grid.sense([slot], power_mw[None], np.array([[False, True]]), Heard(own_mw, decoded, places, told))


frame_lists = st.lists(
    st.tuples(
        st.integers(0, 119),
        st.integers(0, 2),
        st.integers(1, 2),
        st.sampled_from([0, 20, 50, 100]),
        st.sampled_from([-108.0, -95.0, -80.0, -60.0]),
    ),
    max_size=12,
    unique_by=lambda each: each[:2],
)


@pytest.mark.slow
@settings(max_examples=150, deadline=None)
@given(
    frame_lists,
    st.sampled_from([20, 50, 100]),
    st.integers(1, 2),
    st.sampled_from([1, 3, 50]),
    st.sampled_from([None, 10, 30, 100]),
)
def test_excluded_are_the_resources_that_others_reserved(
    frames: list[tuple[int, int, int, int, float]], period: int, length: int, times: int, nr_t2: int | None
) -> None:
    """A short interval counts for all uses within 100 ms, in mode 2 within T2."""
    mac: Sidelink = lte(subchannels=4, exclusion_dbm=-100.0)
    if nr_t2 is not None:
        keys = {"kind": "nr-mode2", "scs_khz": 15, "t2_ms": nr_t2, "subchannels": 4, "exclusion_dbm": -100}
        mac = NrMode2.model_validate(keys)
    now, scale = 120, nr_t2 or 100
    grid = SensedGrid(mac, 2)
    strongest: dict[tuple[int, int], tuple[float, int]] = {}
    for slot in sorted({each[0] for each in frames}):
        some = [each[1:] for each in frames if each[0] == slot]
        sense(grid, mac, slot, some)
        for first, of, reserved, dbm in some:
            for subchannel in range(first, first + of):
                known = strongest.get((slot, subchannel), (-math.inf, 0))
                if reserved and dbm > known[0]:
                    strongest[slot, subchannel] = dbm, reserved
    wanted = Wanted(0, now + 4, now + period, length, period, times)
    found = grid.candidates(now, wanted)
    met: dict[tuple[int, int], float] = {}
    for (slot, subchannel), (dbm, reserved) in strongest.items():
        repeats = -(-scale // reserved) if reserved < scale and now - slot <= reserved else 1
        for nth in range(1, repeats + 1):
            for use in range(times):
                candidate = slot + nth * reserved - use * period
                if wanted.first <= candidate <= wanted.last:
                    met[candidate, subchannel] = max(dbm, met.get((candidate, subchannel), -math.inf))
    expected = {
        (slot, first): max(met.get((slot, first + n), -math.inf) for n in range(length))
        for slot in range(wanted.first, wanted.last + 1)
        for first in range(4 - length + 1)
    }
    threshold_dbm = -100.0
    while sum(dbm <= threshold_dbm for dbm in expected.values()) < 0.2 * len(expected):
        threshold_dbm += 3
    assert found.mask.size == len(expected)
    for (slot, first), dbm in expected.items():
        assert found.has(slot, first) == (dbm <= threshold_dbm), (slot, first, dbm)


@settings(max_examples=25, deadline=None)
@given(frame_lists.filter(bool), st.integers(80, 150))
def test_slots_that_are_sensed_at_once_are_as_if_one_by_one(
    frames: list[tuple[int, int, int, int, float]], now: int
) -> None:
    mac = lte(subchannels=4)
    at_once, one_by_one = SensedGrid(mac, 2), SensedGrid(mac, 2)
    frames = sorted(frames)
    slots = sorted({slot for slot, *_ in frames})
    index, first, length, periods, dbm = (np.array(column) for column in zip(*frames, strict=True))
    places = Places(np.searchsorted(slots, index), first, length)
    power_mw = np.stack([10 ** (dbm / 10), np.ones(len(dbm))], axis=1)
    decoded = np.array([[True, False]] * len(dbm))
    sensed_mw = np.zeros((len(slots), 4, 2))
    for own_mw, (slot, start, count) in zip(power_mw, np.column_stack(places).tolist(), strict=True):
        sensed_mw[slot, start : start + count, 0] += own_mw[0] / count
    deaf = np.array([[False, True]] * len(slots))
    at_once.sense(slots, sensed_mw, deaf, Heard(power_mw, decoded, places, periods[None]))
    for slot in slots:
        sense(one_by_one, mac, slot, [each[1:] for each in frames if each[0] == slot])
    for node in (0, 1):
        wanted = Wanted(node, now + 4, now + 100, 1, 100, 10)
        found, expected = at_once.candidates(now, wanted), one_by_one.candidates(now, wanted)
        assert np.array_equal(found.mask, expected.mask)
        assert found.power_mw is not None and expected.power_mw is not None
        assert np.array_equal(found.power_mw, expected.power_mw)


@pytest.mark.parametrize(("period", "uses"), [(0, [0]), (30, [0, 1, 2, 3, 4]), (100, [0, 1])])
@pytest.mark.parametrize("length", [1, 2])
@pytest.mark.parametrize("kind", ["lte-mode4", "nr-mode2"])
def test_a_first_transmission_reserves_the_second_one(kind: str, length: int, period: int, uses: list[int]) -> None:
    """It is in the same control information, whether or not that tells a period (TS 38.214, 8.1.4 and 8.1.5)."""
    options: dict[str, Any] = {"subchannels": 4, "retransmit": True, "busy_dbm": 0}
    mac = (
        lte(**options) if kind == "lte-mode4" else NrMode2.model_validate({"kind": kind, "scs_khz": 15, **options})
    )
    for gap, first, second in ((1, 3 - length, 0), (9, 0, 4 - length), (15, 1, 1)):
        grid, slot = SensedGrid(mac, 2), 200
        sense(grid, mac, slot, [(first, length, period, LOUD_DBM)], gap * 4 + second - first)
        found = grid.candidates(slot + 1, Wanted(0, slot + 1, slot + 150, 1, 0, 1))
        taken = {(slot + gap + period * use, second + n) for use in uses for n in range(length)}
        taken |= {(slot + period * use, first + n) for use in uses[1:] for n in range(length)}
        expected = {(at, sub) for at, sub in taken if found.first <= at < found.first + len(found.mask)}
        assert {(found.first + at, sub) for at, sub in np.argwhere(~found.mask).tolist()} == expected
    grid.advance(2 * 1100)
    assert grid.candidates(2 * 1100, Wanted(0, 2201, 2300, 1, 0, 1)).mask.all()


def test_threshold_rises_until_a_fifth_remains() -> None:
    mac = lte(subchannels=1)
    grid = SensedGrid(mac, 2)
    powers_dbm = [-109.0 + 0.5 * slot for slot in range(100)]
    for slot, dbm in enumerate(powers_dbm):
        sense(grid, mac, slot, [(0, 1, 100, dbm)])
    found = grid.candidates(100, Wanted(0, 104, 199, 1, 100, 10))
    limit_dbm = next(-110 + 3 * n for n in range(100) if sum(p <= -110 + 3 * n for p in powers_dbm[4:]) >= 0.2 * 96)
    assert found.mask[:, 0].tolist() == [dbm <= limit_dbm for dbm in powers_dbm[4:]]


def test_slots_of_own_transmissions_are_not_selected_again() -> None:
    mac = lte()
    grid = SensedGrid(mac, 2)
    sense(grid, mac, 7, [(0, 1, 100, LOUD_DBM)])
    found = grid.candidates(20, Wanted(1, 24, 120, 1, 100, 10))
    assert not found.mask[107 - 24].any() and found.mask.sum() == found.mask.size - mac.subchannels
    after = grid.candidates(2000, Wanted(1, 2004, 2100, 1, 100, 10))
    assert after.mask.all(), "out of the sensing window"


def test_a_selection_knows_nothing_of_slots_to_come() -> None:
    mac = lte()
    grid = SensedGrid(mac, 2)
    sense(grid, mac, 12, [(0, 4, 20, LOUD_DBM)])
    assert grid.candidates(12, Wanted(0, 16, 112, 1, 100, 10)).mask.all()
    assert not grid.candidates(13, Wanted(0, 17, 112, 1, 100, 10)).mask.all()


def test_the_quietest_fifth_is_taken_and_equal_ones_by_lot() -> None:
    mac = lte(subchannels=1, exclusion_dbm=0.0)
    grid = SensedGrid(mac, 2)
    for slot in range(100):
        if slot % 2:
            sense(grid, mac, slot, [(0, 1, 0, QUIET_DBM)])
    found = grid.candidates(100, Wanted(0, 101, 200, 1, 100, 10))
    ties = np.random.default_rng(1).random(100)
    quiet = found.quietest(0.2, ties)
    chosen = np.flatnonzero(quiet.mask[:, 0])
    assert len(chosen) == 20 and not (chosen + 101).astype(int)[(chosen + 101) % 2 == 1].size
    even = np.flatnonzero((np.arange(100) + 101) % 2 == 0)
    assert set(chosen) == set(even[np.argsort(ties[even])[:20]])


@pytest.mark.parametrize(("period", "samples"), [(20, 50), (50, 20), (100, 10), (500, 10)])
@pytest.mark.parametrize("ago", [1, 450, 900, 901, 1000, 1001])
def test_ranking_averages_all_periods_of_the_sensing_window(period: int, samples: int, ago: int) -> None:
    """The window is 1000 ms, with a sample every period, or every 100 ms (TS 36.213, 14.1.1.6)."""
    mac, now = lte(subchannels=1), 2000
    grid = SensedGrid(mac, 2)
    sense(grid, mac, now - ago, [(0, 1, 0, LOUD_DBM)])
    found = grid.candidates(now, Wanted(0, now + 1, now + 100, 1, period, 10))
    assert found.power_mw is not None
    step = min(period, 100)
    expected = [1e-6 / samples if ago <= 1000 and (1 + n + ago) % step == 0 else 0 for n in range(100)]
    assert found.power_mw[:, 0] == pytest.approx(expected)


def test_nr_takes_any_of_the_candidates() -> None:
    mac = NrMode2.model_validate({"kind": "nr-mode2", "scs_khz": 60, "subchannels": 2, "sensing_ms": 100})
    grid = SensedGrid(mac, 1)
    found = grid.candidates(0, Wanted(0, 1, 40, 1, 400, 10))
    assert found.quietest(0.2, np.zeros(found.mask.size)) is found and found.mask.all()
    assert [found.chosen(u / 80) for u in range(80)] == [(1 + n // 2, n % 2) for n in range(80)]


def test_candidates_around_a_slot() -> None:
    found = Candidates(10, np.ones((5, 2), bool), None).around(12, 1)
    assert found.mask.sum() == 4 and found.has(11, 0) and found.has(13, 1) and not found.has(12, 0)


@pytest.mark.parametrize("scs_khz", [15, 30, 60])
def test_busy_ratio_is_the_share_of_busy_resources(scs_khz: int) -> None:
    mac = NrMode2.model_validate({"kind": "nr-mode2", "scs_khz": scs_khz, "subchannels": 5})
    meter = BusyMeter(mac, 1, 10**9)
    each = scs_khz // 15
    for slot in range(0, 200 * each, 2 * each):
        meter.add(slot, np.array([3]))
    meter.count(200_000_000)
    assert [window[0] for window in meter.windows] == pytest.approx([50 * 3 / (100 * each * 5)] * 2)
    assert meter.at(150_000_000)[0] == pytest.approx(50 * 3 / (100 * each * 5))
