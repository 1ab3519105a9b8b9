"""The figures of a real-time run's lateness."""

import numpy as np
import pytest

from emulator.drivers.realtime import lateness_figures
from vnet.transport import wire


def test_percentiles_are_those_of_the_delays() -> None:
    delays_ms = np.random.default_rng(0).exponential(4.0, 20_000)
    counts = [0] * wire.LATENESS_BINS
    for delay_ms in delays_ms:
        counts[wire.lateness_bin(round(delay_ms * 1e6))] += 1
    figures = lateness_figures(counts)
    assert figures["total"] == 20_000
    assert figures["count"] == np.sum(delays_ms >= 20)
    assert figures["p50_ms"] == pytest.approx(np.percentile(delays_ms, 50), rel=0.03)
    assert figures["p99_ms"] == pytest.approx(np.percentile(delays_ms, 99), rel=0.03)
    assert figures["max_ms"] == pytest.approx(delays_ms.max(), rel=0.2)
