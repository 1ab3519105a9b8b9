"""The averaging program: its frame, its options, and what it does round by round."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents.averaging import Averager, Options, decode, encode
from agents.cooperative.cmm.consensus import Share
from agents.cooperative.frame import short_name
from emulator.drivers.emulation import Emulation
from emulator.drivers.simulate import simulate
from tests.support.recorded import prepared
from vnet import Packet

PERIOD_NS = 100_000_000
names = st.frozensets(st.integers(0, 10_000).map(lambda number: short_name(f"v{number}")), max_size=40)
reals = st.floats(allow_nan=False, allow_infinity=False)


@pytest.mark.slow
@settings(max_examples=100, deadline=None)
@given(st.integers(0, 2**32), st.tuples(reals, reals, reals), names, names)
def test_a_frame_comes_back_as_it_was(
    epoch: int, total: tuple[float, float, float], out_neighbours: frozenset[str], heard: frozenset[str]
) -> None:
    share = Share(epoch, total, out_neighbours, heard)
    assert decode(encode(share)) == share


def test_a_frame_with_thirty_peers_fits() -> None:
    peers = frozenset(short_name(f"v{number}") for number in range(30))
    assert len(encode(Share(2**31, (1 / 3, 1 / 3, 1 / 3), peers, peers))) < 1400


@pytest.mark.slow
@settings(max_examples=80, deadline=None)
@given(st.binary(max_size=100))
def test_arbitrary_bytes_are_refused_or_sane(payload: bytes) -> None:
    try:
        share = decode(payload)
    except ValueError:
        return
    assert np.isfinite(share.running_sum).all()


@pytest.mark.parametrize(
    "share",
    [
        Share(1, (float("nan"), 0.0, 1.0), frozenset(), frozenset()),
        Share(1, (0.0, float("inf"), 1.0), frozenset(), frozenset()),
        Share(-1, (0.0, 0.0, 1.0), frozenset(), frozenset()),
    ],
)
def test_a_frame_of_absurd_numbers_is_refused(share: Share) -> None:
    with pytest.raises(ValueError, match="out of bounds"):
        decode(encode(share))


def test_silence_lasts_from_its_first_instant_to_before_its_last() -> None:
    options = Options.parse({"silent": {"v1": [0.2, 0.4]}})
    assert [options.is_silent("v1", period * PERIOD_NS) for period in range(6)] == [0, 0, 1, 1, 0, 0]
    assert not options.is_silent("v2", 2 * PERIOD_NS)


def heard_from(sender: str, sent_ns: int, state: tuple[float, float], degree: float = 2.0) -> Packet:
    share = Share(0, (*state, degree), frozenset(), frozenset({short_name("v1")}))
    return Packet(sender, sent_ns, sent_ns + 1, encode(share))


def test_only_the_newest_frame_of_a_peer_counts_and_never_an_older_one_later() -> None:
    averager = Averager("v1", "metropolis", np.zeros(2))
    averager.round([])
    averager.round([heard_from("v2", 20, (2.0, 4.0)), heard_from("v2", 10, (50.0, 50.0))])
    mean_m = averager.consensus.mean_m
    assert mean_m == pytest.approx([1.0, 2.0]), "half of the way to a peer of one link"
    averager.round([heard_from("v2", 15, (70.0, 70.0))])
    assert averager.consensus.mean_m == pytest.approx([1.0, 2.0]), "a late one is left out"


def test_what_cannot_be_read_is_counted() -> None:
    averager = Averager("v1", "ratio", np.zeros(2))
    averager.round([Packet("v2", 0, 1, b"beep"), Packet("v3", 0, 1, b"")])
    assert averager.rejected == 2


def emulate(folder: Path, options: dict[str, object], duration_s: float = 3.0) -> Emulation:
    scenario = {
        "run": {"duration_s": duration_s},
        "network": {"vehicles": 4},
        "radio": {"range_m": 1e6},
        "program": {"entry": "agents.averaging:main", "options": options},
    }
    emulation = prepared(scenario, folder)
    simulate(emulation)
    assert [e.kind for e in emulation.folder.events if e.node] == []
    return emulation


def frames_by_period(emulation: Emulation, node: str) -> list[int]:
    """Number of frames that a node sent, by period."""
    rows = emulation.engine.trace.to_table().to_pylist()
    sent = {(row["sender"], row["seq"]): row["sent_ns"] // PERIOD_NS for row in rows}
    periods = [period for (sender, _), period in sent.items() if sender == node]
    return np.bincount(periods, minlength=round(emulation.duration_ns / PERIOD_NS)).tolist()


@pytest.mark.slow
def test_one_frame_a_period(tmp_path: Path) -> None:
    emulation = emulate(tmp_path / "run", {"rule": "ratio"})
    for node in emulation.world.node_ids:
        assert frames_by_period(emulation, node) == [1] * 30


@pytest.mark.slow
@pytest.mark.parametrize("rule", ["ratio", "metropolis", "max-degree"])
def test_all_find_the_mean_of_inputs_that_stay(tmp_path: Path, rule: str) -> None:
    emulation = emulate(tmp_path / "run", {"rule": rule}, 6.0)
    states = emulation.metrics.states_table().to_pylist()
    inputs = {row["node"]: tuple(row["common_error_estimate_m"]) for row in states}
    assert all(tuple(row["common_error_estimate_m"]) == inputs[row["node"]] for row in states)
    mean = np.mean(list(inputs.values()), axis=0)
    assert np.array([row["mean_m"] for row in states[-4:]]) == pytest.approx(np.tile(mean, (4, 1)), abs=1e-6)


@pytest.mark.slow
def test_a_silent_vehicle_neither_sends_nor_reports_and_comes_back_afresh(tmp_path: Path) -> None:
    emulation = emulate(tmp_path / "run", {"rule": "ratio", "silent": {"v02": [5.0, 12.0]}}, 20.0)
    assert frames_by_period(emulation, "v02") == [1] * 50 + [0] * 70 + [1] * 80
    rows = emulation.metrics.rows
    assert [row.reporting for row in rows] == [4] * 50 + [3] * 70 + [4] * 80
    errors = {row.period: row.consensus_error_m for row in rows}
    assert errors[49] == pytest.approx(0.0, abs=1e-6)
    assert errors[60] is not None and errors[60] > 1e-3, "the old mean still counts the one that has left"
    assert errors[119] == pytest.approx(0.0, abs=1e-6), "the mean of the three"
    assert errors[199] == pytest.approx(0.0, abs=1e-6), "the mean of the four again"
