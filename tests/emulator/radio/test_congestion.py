"""Channel busy ratio and congestion control, on their own and on an engine."""

from typing import Any

import numpy as np
import pytest

from emulator.radio.csma import BusyRatioMeter, LimericControl, ReactiveControl
from emulator.radio.engine import Engine
from emulator.radio.medium import SLICE_NS, WINDOW_NS
from emulator.radio.outcomes import Outcome
from emulator.scenario.radio import EtsiReactive, Limeric
from tests.support.radio import drained, engine, line

MS = 1_000_000


def test_the_busy_ratio_is_the_airtime_of_all_that_are_sensed() -> None:
    """v0 sends 448 µs ten times in each window; v1 senses it, v2 at 800 m does not; senders sense themselves."""
    subject = engine(line(0, 300, 800), path_loss={"kind": "log_distance"}, mac={})
    for number in range(50):
        subject.transmit(number * 10 * MS, 0, [bytes(300)])
    subject.advance(500 * MS)
    ratios = np.array(subject.busy_ratios(500 * MS))
    assert ratios.shape == (5, 3)
    assert ratios[:, :2] == pytest.approx(np.full((5, 2), 0.0448))
    assert ratios[:, 2] == pytest.approx(0)


def test_what_lasts_over_the_edge_of_a_window_counts_in_both() -> None:
    subject = engine(line(0, 300), path_loss={"kind": "log_distance"}, mac={}, latency_ms=1)
    subject.transmit(99_800_000, 0, [bytes(300)])
    subject.drain()
    on_air_ns = subject.trace.to_table()["on_air_ns"][0].as_py()
    first, second = (ratio[1] for ratio in subject.busy_ratios(200 * MS))
    assert first == pytest.approx((100 * MS - on_air_ns) / WINDOW_NS)
    assert first + second == pytest.approx(0.00448)


def windows(control: ReactiveControl | LimericControl, *ratios: float, first: int = 0) -> None:
    """Let a congestion control observe windows with these channel busy ratios."""
    for number, ratio in enumerate(np.repeat(ratios, 10), start=10 * first):
        control.observe(number, np.full(len(control._meter), int(ratio * SLICE_NS)))


def pause_ms(control: ReactiveControl | LimericControl) -> int:
    """Return the pause of the first sender in ms at the present channel busy ratio."""
    control.record_transmission(0, 0, 448_000)
    return next(ms for ms in range(2000) if control.next_poll_ns(0, ms * MS) == ms * MS)


def test_the_reactive_states_are_reached_one_after_the_other() -> None:
    control = ReactiveControl(EtsiReactive(kind="etsi"), BusyRatioMeter(1, 1))
    assert control.next_poll_ns(0, 0) == 0, "the first frame may go"
    pauses_ms = [pause_ms(control)]
    for first, ratio in enumerate((0.7,) * 6 + (0.45,) * 4 + (0.1,) * 4):
        windows(control, ratio, first=first)
        pauses_ms.append(pause_ms(control))
    states = [(50, 100, 200, 250, 1000).index(pause) for pause in pauses_ms]
    assert set(np.abs(np.diff(states))) == {0, 1}
    assert (states[0], states[6], states[10], states[14]) == (0, 4, 2, 0)


def test_who_is_held_back_asks_again_after_its_next_window() -> None:
    control = ReactiveControl(EtsiReactive(kind="etsi", pause_ms=(1000,) * 5), BusyRatioMeter(1, 1))
    control.record_transmission(0, 0, 448_000)
    asks_ns = [0]
    while (next_ns := control.next_poll_ns(0, asks_ns[-1])) > asks_ns[-1]:
        asks_ns.append(next_ns)
    assert asks_ns[-1] == 1000 * MS
    assert set(np.diff(asks_ns[1:-1])) == {WINDOW_NS}


def test_senders_measure_each_on_its_own_clock() -> None:
    meter = BusyRatioMeter(50, 3)
    asks_ns = [meter.next_poll_ns(node, 10**10, 0) for node in range(50)]
    assert len(set(asks_ns)) == 50
    assert asks_ns[:20] == [BusyRatioMeter(20, 3).next_poll_ns(node, 10**10, 0) for node in range(20)], (
        "independent of other senders"
    )
    # Slices are busy or idle by turns of ten: a window with half of each has a ratio of one half.
    ratios = []
    for number in range(40):
        over = meter.observe(number, np.full(50, SLICE_NS if number // 10 % 2 else 0))
        ratios.append((number, over, meter.busy_ratio.copy()))
    seen = np.concatenate([ratio[over] for number, over, ratio in ratios if number >= 9])
    assert set(np.round(seen, 3)) == {round(part / 10, 3) for part in range(11)}


def test_limeric_takes_the_mean_of_two_windows() -> None:
    steady, by_turns = (LimericControl(Limeric(kind="limeric"), BusyRatioMeter(1, 1)) for _ in range(2))
    for first in range(300):
        windows(steady, 0.5, first=first)
        windows(by_turns, float(first % 2), first=first)
    assert by_turns.share[0] == pytest.approx(steady.share[0], rel=1e-3)


@pytest.mark.slow
def test_limeric_settles_where_its_equation_does() -> None:
    """K senders of airtime a: share* = β (target - K share) / α, as the busy ratio is the sum of all shares."""
    control = LimericControl(Limeric(kind="limeric"), BusyRatioMeter(1, 1))
    for first in range(6000):
        windows(control, min(100 * float(control.share[0]), 1.0), first=first)
    expected = 0.0012 * 0.68 / (0.016 + 0.0012 * 100)
    assert control.share[0] == pytest.approx(expected, rel=1e-4)


def test_limerics_pause_is_the_airtime_over_the_share_within_bounds() -> None:
    control = LimericControl(Limeric(kind="limeric"), BusyRatioMeter(1, 1))
    for share, expected_ms in ((0.03, 25), (0.00448, 100), (0.0001, 1000)):
        control.share[0] = share
        assert pause_ms(control) == expected_ms


@pytest.mark.slow
def test_a_congested_channel_thins_out_what_is_sent() -> None:
    """Sixty vehicles send 1 000 bytes every 50 ms each: two thirds more than the capacity of the medium."""
    position_m = np.random.default_rng(3).uniform(0, 200, (60, 2))
    physical: dict[str, Any] = {
        "path_loss": {"kind": "log_distance"},
        "mac": {},
        "max_peers": 100,
        "queue_frames": 8,
    }

    def run(**congestion: Any) -> tuple[float, float, Engine]:
        subject = engine(position_m, **physical, **congestion)
        draws = np.random.default_rng(4)
        sends = sorted((int(t), n) for n in range(60) for t in draws.uniform(0, 3e9, 60))
        for time_ns, node in sends:
            subject.transmit(time_ns, node, [bytes(1000)])
        subject.drain()
        counts = subject.counts
        on_air = counts[Outcome.delivered] + counts[Outcome.collided]
        return counts[Outcome.delivered] / on_air, float(np.mean(subject.busy_ratios(3_000 * MS)[5:])), subject

    free, full, crowded = run()
    assert crowded.counts[Outcome.held_back] == 0
    assert full > 0.9
    for kind in ("etsi", "limeric"):
        share, load, subject = run(congestion={"kind": kind})
        assert share > free + 0.1
        assert load < full - 0.15
        assert subject.counts[Outcome.held_back] > 1000


def test_of_what_waits_the_newest_goes() -> None:
    subject = engine(
        line(0, 50),
        path_loss={"kind": "free_space"},
        mac={},
        congestion={"kind": "etsi", "pause_ms": [50, 50, 50, 50, 50], "waiting": 1},
    )
    for number in range(10):
        subject.transmit(number * 10 * MS, 0, [bytes(100)])
    rows = drained(subject)
    assert [row["seq"] for row in rows if row["outcome"] == "delivered"] == [0, 5, 9]
    assert {row["outcome"] for row in rows} == {"delivered", "held_back"}
    on_air_ms = [round(row["on_air_ns"] / MS) for row in rows if row["on_air_ns"] is not None]
    assert on_air_ms == [0, 50, 100]
