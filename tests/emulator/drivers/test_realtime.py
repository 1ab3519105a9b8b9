"""The figures of a real-time run's lateness."""

import sys

import numpy as np
import pytest

from emulator.drivers.realtime import RealTime, lateness_figures
from tests.support.multi_loop_driver import emulation_of, scenario_of
from vnet.radio import SentFrame
from vnet.transport import wire


def test_no_module_is_loaded_while_a_run_is_on(monkeypatch: pytest.MonkeyPatch) -> None:
    """All vehicles would wait for it: pyarrow loads numpy.ma at its first array of numpy's."""
    monkeypatch.setattr("emulator.records.metrics.ROWS_A_PIECE", 8)
    monkeypatch.delattr(np, "ma", raising=False)
    monkeypatch.delitem(sys.modules, "numpy.ma", raising=False)
    emulation = emulation_of(scenario_of((), "agents.beacon:main", run={"pacing": "realtime"}))
    node_ids = emulation.world.node_ids
    realtime = RealTime(emulation, [[node] for node in node_ids])
    realtime.start(0)
    before = set(sys.modules)
    for number in range(8):
        for node in node_ids:
            traffic = wire.Traffic([SentFrame(node, b"x")])
            now_ns = number * emulation.scenario.period_ns
            realtime.receive(now_ns, node, wire.Frames(b"n", number, 0, (), traffic))
        realtime.due(now_ns + emulation.scenario.period_ns // 2)
    assert set(sys.modules) == before


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
