"""The definition of divergence: over 10 m, for 5 s without a break."""

import numpy as np
import pytest

from emulator.records.divergence import first_divergences
from vnet.units import NS_PER_S


def test_the_period_in_which_five_seconds_are_full_is_found() -> None:
    error_m = np.zeros((30, 4))
    error_m[3:8, 0] = 11.0
    error_m[3:7, 1] = 11.0
    error_m[2:20, 2] = 10.0
    error_m[20:, 3] = 1e6
    assert first_divergences(error_m, NS_PER_S) == {0: 7, 3: 24}


def test_an_unknown_error_interrupts_it() -> None:
    error_m = np.full((9, 1), 50.0)
    error_m[4] = np.nan
    assert first_divergences(error_m, NS_PER_S) == {}
    assert first_divergences(np.vstack([error_m, error_m[:1]]), NS_PER_S) == {0: 9}


@pytest.mark.parametrize(("period_ns", "first"), [(100_000_000, 49), (NS_PER_S, 4), (60 * NS_PER_S, 0)])
def test_periods_of_any_length_count_by_their_time(period_ns: int, first: int) -> None:
    assert first_divergences(np.full((60, 1), 50.0), period_ns) == {0: first}
