"""Airtimes and error model of 802.11p, against the standard and ns-3."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from emulator.radio.dot11p import COST_STEPS, airtime_ns, arrival_probability, cost
from emulator.radio.reception import reception_draws
from emulator.scenario.radio import RATES_MBPS
from emulator.scenario.scenario import Radio
from tests.support.radio import nist_qpsk_half


@pytest.mark.parametrize(
    ("size", "rate", "expected_us"),
    [(300, 6.0, 448), (300, 3.0, 40 + 8 * 101), (300, 27.0, 40 + 8 * 12), (1400, 6.0, 40 + 8 * 234), (0, 6.0, 48)],
)
def test_airtimes_are_those_of_the_standard(size: int, rate: float, expected_us: int) -> None:
    assert airtime_ns(size, rate) == expected_us * 1000


@pytest.mark.parametrize("snr_db", [2, 4, 5, 5.5, 6, 6.5, 7, 8, 9, 12])
def test_arrival_is_the_nist_models(snr_db: float) -> None:
    snr = 10 ** (snr_db / 10)
    found = arrival_probability(np.array([snr]), airtime_ns(300, 6.0), 6.0)[0]
    assert found == pytest.approx(nist_qpsk_half(snr, 51 * 48), abs=1e-6)


@pytest.mark.parametrize(
    ("rate", "half_db"),
    [
        (3.0, 2.954),
        (4.5, 5.798),
        (6.0, 5.967),
        (9.0, 8.808),
        (12.0, 12.401),
        (18.0, 15.492),
        (24.0, 20.234),
        (27.0, 21.460),
    ],
)
def test_faster_modes_need_more_and_all_improve_with_the_signal(rate: float, half_db: float) -> None:
    """The ratios at which half of all frames of 300 bytes arrive, as the error model of ns-3 3.37 gives them."""
    snr = 10 ** (np.arange(-5, 35, 0.01) / 10)
    arrives = arrival_probability(snr, airtime_ns(300, rate), rate)
    assert np.all(np.diff(arrives) >= 0)
    assert arrives[0] == 0
    assert arrives[-1] == 1
    assert 10 * np.log10(snr[np.searchsorted(arrives, 0.5)]) == pytest.approx(half_db, abs=0.011)


@pytest.mark.slow
@given(
    st.lists(st.integers(1, 1000), min_size=1, max_size=6), st.floats(0.1, 100), st.sampled_from([3.0, 6.0, 27.0])
)
def test_costs_add_up_however_time_is_cut(pieces: list[int], snr: float, rate: float) -> None:
    one = cost(np.array([snr]), rate)
    assert (one * np.array(pieces)[:, None]).sum() == (one * sum(pieces)).sum()


@pytest.mark.parametrize("rate", RATES_MBPS)
def test_even_the_longest_frame_without_any_signal_has_a_cost_that_can_be_told(rate: float) -> None:
    """Else it would come round and be less than nothing: a frame that is destroyed would arrive."""
    longest = max(bound.le for bound in Radio.model_fields["max_payload_bytes"].metadata if hasattr(bound, "le"))
    worst = int(cost(np.zeros(1), rate)[0])
    assert worst * airtime_ns(longest, rate) < 2**63
    assert worst * 1000 / COST_STEPS > -math.log(reception_draws(np.zeros(1, np.uint64))[0]), "a microsecond"
