"""The physical radio on an engine: connectivity, reception, and its section of a scenario."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from emulator.drivers.simulate import simulate
from emulator.radio.outcomes import Outcome
from emulator.radio.propagation import MeanPower, Nakagami
from emulator.radio.topology import Topology, connectivity_of, distances_m
from emulator.scenario.loading import dump_scenario, load_scenario
from emulator.scenario.scenario import Radio, Scenario
from tests.support.motion import along, scenario_of_trips, write_trips
from tests.support.radio import drained, engine, line, nist_qpsk_half
from tests.support.recorded import prepared

MS = 1_000_000
PERIOD_NS = 100 * MS


def test_the_longest_frames_destroy_each_other_between_hidden_terminals() -> None:
    radio: dict[str, Any] = {
        "path_loss": {"kind": "log_distance"},
        "mac": {},
        "bitrate_mbps": 3.0,
        "max_payload_bytes": 65_000,
    }
    subject = engine(line(0, 450, 900), **radio)
    subject.transmit(0, 0, [bytes(65_000)])
    subject.transmit(50_000, 2, [bytes(65_000)])
    outcomes = [row["outcome"] for row in drained(subject) if row["receiver"] == "v1"]
    assert outcomes == ["collided", "collided"]


class Counted:
    """Counter of the computations of mean powers."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.times = 0
        dbm = MeanPower.dbm

        def counted(power: MeanPower, position_m: np.ndarray, distance_m: np.ndarray) -> np.ndarray:
            self.times += 1
            return dbm(power, position_m, distance_m)

        monkeypatch.setattr(MeanPower, "dbm", counted)


@pytest.mark.parametrize(
    "radio",
    [{"path_loss": {"kind": "log_distance"}, "shadowing": {}}, {"range_m": 900.0, "mac": {}}, {"range_m": 900.0}],
    ids=["path loss", "disc with a medium", "disc"],
)
def test_who_is_in_range_is_told_by_the_powers_where_there_are_any(
    radio: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    model = Radio.model_validate(radio)
    reach, nakagami = connectivity_of(model, 1, None), Nakagami(None) if model.is_physical else None
    counted = Counted(monkeypatch)
    first_m, then_m = np.random.default_rng(2).uniform(0, 4000, (2, 30, 2))
    then_m[7] = np.nan
    topology = Topology(first_m, reach, 1000, nakagami)
    topology.move(then_m)
    topology.move(then_m.copy())
    assert counted.times == (2 if "path_loss" in radio else 0), "once for each set of positions"
    in_range = reach.in_range(then_m, distances_m(then_m))
    assert np.array_equal(topology.now.in_range, in_range)
    assert in_range.any() and not in_range[7].any() and not in_range[:, 7].any()
    then_m[:] = first_m
    topology.move(then_m)
    assert np.array_equal(topology.now.in_range, reach.in_range(first_m, distances_m(first_m))), "moved in place"


def test_where_vehicles_drive_powers_are_worked_out_once_a_period(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_trips(tmp_path / "trips.csv", {f"c{n}": [(0.0, 3.0, along(60.0 * n, 20.0 * n))] for n in range(4)})
    scenario = scenario_of_trips(path, 2.0, radio={"path_loss": {"kind": "log_distance"}, "mac": {}})
    counted = Counted(monkeypatch)
    emulation = prepared(scenario, tmp_path / "run")
    simulate(emulation)
    assert len(emulation.engine.trace) > 50
    assert counted.times == 2 * 5, "two seconds, five periods each"


# The chain without a medium.


def test_without_fading_the_threshold_is_a_circle() -> None:
    """20 dBm are -82 dBm after 509.3 m, and -94 dBm, the floor, after 2 028 m."""
    subject = engine(line(0, 509, 510, 2027, 2029), path_loss={"kind": "log_distance"})
    subject.transmit(0, 0, [bytes(300)])
    outcomes = [row["outcome"] for row in drained(subject)]
    assert outcomes == ["delivered", "faded", "faded"]
    assert subject.counts[Outcome.out_of_range] == 1


def test_the_noise_decides_where_it_is_loud() -> None:
    """Half of all frames arrive at -71.03 dBm with 20 dB more noise: after 144 m, and at 27 Mbit/s after 24 m."""
    loud: dict[str, Any] = {"path_loss": {"kind": "log_distance"}, "receiver": {"noise_dbm": -84.0}}
    subject = engine(line(0, 120, 144, 170), **loud)
    fast = engine(line(0, 20, 40, 80), **loud, bitrate_mbps=27.0)
    for one in (subject, fast):
        one.transmit(0, 0, [bytes(300)] * 40)
        one.drain()
    rows = subject.trace.to_table().to_pylist()
    share = {
        node: np.mean([row["outcome"] == "delivered" for row in rows if row["receiver"] == node])
        for node in ("v1", "v2", "v3")
    }
    assert share["v1"] == 1
    assert 0.2 < share["v2"] < 0.8
    assert share["v3"] == 0
    arrived = {row["receiver"] for row in fast.trace.to_table().to_pylist() if row["outcome"] == "delivered"}
    assert arrived == {"v1"}


@pytest.mark.slow
def test_delivery_against_distance_is_the_integral_over_the_fading() -> None:
    """Twenty receivers, two thousand frames, without a medium: Monte Carlo against quadrature."""
    from scipy import stats  # slow to import
    from scipy.integrate import quad

    east_m = np.linspace(30, 900, 20)
    subject = engine(
        np.vstack([[[0.0, 0.0]], line(*east_m)]), path_loss={"kind": "log_distance"}, fading={}, max_peers=100
    )
    for number in range(2000):
        subject.transmit(number * MS, 0, [bytes(300)])
    subject.drain()
    receiver = subject.trace.column("receiver")
    share = np.bincount(receiver, subject.trace.column("outcome") == Outcome.delivered, 21)[1:] / 2000
    for place, distance_m in enumerate(east_m):
        mean_db = 20 - 47.86 - 20 * math.log10(distance_m)
        gamma = stats.gamma(1.5, scale=1 / 1.5) if distance_m <= 80 else stats.gamma(0.75, scale=1 / 0.75)
        least = 10 ** ((-82 - mean_db) / 10)
        expected = quad(
            lambda factor, g=gamma, db=mean_db: (
                g.pdf(factor) * nist_qpsk_half(factor * 10 ** ((db + 97) / 10), 2448)
            ),
            least,
            np.inf,
            limit=200,
        )[0]
        assert share[place] == pytest.approx(expected, abs=4.5 * math.sqrt(0.25 / 2000))


def test_without_a_medium_frames_do_not_interfere() -> None:
    subject = engine(line(0, 50, 100), path_loss={"kind": "free_space"})
    for node in range(3):
        subject.transmit(0, node, [bytes(300)])
    rows = drained(subject)
    assert {row["outcome"] for row in rows} == {"delivered"}
    assert "on_air_ns" not in rows[0]
    assert all(448_000 + 2 * MS <= row["arrival_ns"] <= 448_000 + 3 * MS for row in rows)


def test_the_peer_cap_and_the_loss_act_on_what_the_radio_leaves() -> None:
    subject = engine(line(0, 50, 100, 150), path_loss={"kind": "free_space"}, max_peers=2, loss=0.5)
    for number in range(200):
        subject.transmit(number * PERIOD_NS, 0, [bytes(100)])
        subject.transmit(number * PERIOD_NS, 3, [bytes(100)])
    subject.drain()
    counts = subject.counts
    # Of three neighbours each hears the nearest two: v0 and v3 do not hear each other, and one of them at either
    # of the two in the middle is the third.
    assert counts[Outcome.peer_cap] == 800
    assert counts[Outcome.faded] == 0
    assert 150 < counts[Outcome.lost] < 250


# The scenario.


def test_a_physical_radio_survives_its_dump(tmp_path: Any) -> None:
    radio = {
        "path_loss": {"kind": "two_ray"},
        "shadowing": {"sigma_db": 2.5},
        "fading": {"m": [3, 2, 1], "until_m": [50, 150]},
        "receiver": {"min_rssi_dbm": -85},
        "mac": {"access_category": "VI"},
        "congestion": {"kind": "limeric", "target": 0.6},
    }
    scenario = Scenario.model_validate({"radio": radio})
    path = tmp_path / "s.toml"
    path.write_text(dump_scenario(scenario))
    assert load_scenario(path) == scenario
    assert "antenna_m = 1.5" in path.read_text(), "every default is spelled out"
    assert "path_loss" not in dump_scenario(Scenario()), "and what is left out stays so"
