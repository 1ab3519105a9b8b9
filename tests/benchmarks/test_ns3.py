"""The radio against recorded curves of ns-3: `python -m benchmarks.ns3` wrote `recorded.json`."""

import json
import os
from pathlib import Path

import numpy as np
import pytest

from benchmarks.ns3 import acknowledged, buildings
from benchmarks.ns3.compare import BUSY_LIMIT, CURVE_LIMIT, LEAST_PAIRS, Comparison, draw
from benchmarks.ns3.ground import RATE_HZ, Curve, Outcome, ScheduleConstraints
from benchmarks.ns3.simulators import ours
from tests.support.forked_commands import MODULE, run
from tests.support.paths import ROOT

pytestmark = pytest.mark.slow

SECONDS = 60.0
RECORDED = json.loads((ROOT / "benchmarks" / "ns3" / "recorded.json").read_text())
ACKNOWLEDGED = json.loads((ROOT / "benchmarks" / "ns3" / "acknowledged.json").read_text())


def curve(pairs: list[int], share: list[float]) -> Curve:
    return Curve(np.array(pairs), np.array(share))


@pytest.mark.parametrize("fading", [False, True])
def test_delivery_by_distance_and_the_busy_ratio_are_those_of_ns3(fading: bool, tmp_path: Path) -> None:
    recorded = next(one for one in RECORDED if one["vehicles"] == 50 and one["fading"] == fading)
    ground = ScheduleConstraints.of(50, SECONDS)
    outcome = ours(ground, fading)
    ours_now = Curve.of(ground, outcome)
    theirs = curve(recorded["pairs"], recorded["delivered_ns3"])
    assert ours_now.pairs.tolist() == recorded["pairs"], "the ground is not the one of the record"
    busy = (recorded["busy_ns3"], float(outcome.busy.mean()))
    one = Comparison(50, fading, theirs, ours_now, busy, (1.0, 1.0), (1.0, 1.0))
    assert one.judged[:10].all()
    assert one.holds, (one.largest, one.busier)
    assert one.largest < 0.01 and abs(one.busier) < 0.05, "far less than is asked for, so far"
    draw([one], tmp_path / "ns3.png")
    assert (tmp_path / "ns3.png").stat().st_size > 10_000


def test_a_comparison_holds_only_within_its_limits_and_where_there_are_enough_pairs() -> None:
    pairs = [LEAST_PAIRS, LEAST_PAIRS, LEAST_PAIRS - 1, *[LEAST_PAIRS] * 8]
    share = [0.5] * 11

    def holds(ours: dict[int, float], busy: float = 0.2) -> bool:
        mine = [ours.get(place, 0.5) for place in range(11)]
        both = curve(pairs, share), curve(pairs, mine)
        return Comparison(50, False, *both, (0.2, busy), (1.0, 1.0), (1.0, 1.0)).holds

    assert holds({}) and holds({0: 0.5 + 0.9 * CURVE_LIMIT, 2: 0.9, 10: 0.9}, 0.2 * (1 + 0.9 * BUSY_LIMIT))
    assert not holds({1: 0.5 - 1.1 * CURVE_LIMIT})
    assert not holds({9: 0.5 - 1.1 * CURVE_LIMIT})
    assert not holds({}, 0.2 * (1 - 1.1 * BUSY_LIMIT))


def test_the_ground_is_the_same_for_both_simulators() -> None:
    ground = ScheduleConstraints.of(7, 2.0)
    assert ground.sent.tolist() == [2 * RATE_HZ] * 7
    assert (np.diff(ground.time_ns) >= 0).all()
    lines = ground.text().splitlines()
    assert lines[0] == "7" and lines[8] == str(7 * 2 * RATE_HZ)
    assert [float(line.split()[0]) for line in lines[1:8]] == ground.east_m.tolist()
    assert [tuple(map(int, line.split())) for line in lines[9:]] == list(
        zip(ground.time_ns.tolist(), ground.sender.tolist(), strict=True)
    )


def test_a_curve_counts_every_pair_at_its_distance() -> None:
    ground = ScheduleConstraints(np.array([0.0, 60.0, 70.0]), np.array([5, 6, 7]), np.array([0, 0, 1]), 1.0)
    received = np.array([[0, 2, 1], [0, 0, 1], [0, 0, 0]])
    found = Curve.of(ground, Outcome(received, np.zeros(3), 1.0, 1.0))
    assert found.pairs[:3].tolist() == [1, 5, 0], "0 → 1 and 0 → 2 twice each, 1 → 0 once: 50 m; 1 → 2 once: 0 m"
    assert found.share[:2].tolist() == [1.0, 3 / 5]


def test_without_ns3_it_says_in_one_line_how_to_get_it(tmp_path: Path) -> None:
    environment = {**os.environ, "PATH": str(tmp_path), "PYTHONPATH": str(ROOT)}
    command = [*MODULE, "benchmarks.ns3", "--out", str(tmp_path / "out")]
    done = run(command, cwd=tmp_path, env=environment, capture_output=True)
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr.count("\n") == 1 and "apt-get install" in done.stderr
    assert not (tmp_path / "out").exists()


def test_buildings_cut_the_same_rays_as_in_ns3_where_it_is_installed(capsys: pytest.CaptureFixture[str]) -> None:
    status = buildings.main()
    if status == 2:
        assert "apt-get install" in capsys.readouterr().err
        pytest.skip("ns-3 is not installed, which Debian's libns3-dev is for")
    assert (status, capsys.readouterr().out) == (0, "19,900 rays: 12,026 cut in ns-3, 12,026 in vnet; 0 differ\n")


@pytest.mark.parametrize(("number", "seconds"), [(1, 1.0), (3, 1.0), (6, 2.0)])
def test_frames_to_one_vehicle_fare_as_in_ns3(number: int, seconds: float) -> None:
    recorded = ACKNOWLEDGED[number]
    case = acknowledged.Case(**recorded["case"])
    found = acknowledged.Comparison(
        case, acknowledged.Exchange(**recorded["theirs"]), acknowledged.our_exchange(case, seconds)
    )
    assert found.holds, found.row()


def test_an_exchange_agrees_only_within_its_limits() -> None:
    case, theirs = acknowledged.Case(2, 0.0), acknowledged.Exchange(0.9, 2.0, 1000.0)
    for figures, holds in (
        ((0.905, 2.05, 1020.0), True),
        ((0.92, 2.0, 1000.0), False),
        ((0.9, 2.2, 1000.0), False),
        ((0.9, 2.0, 950.0), False),
    ):
        assert acknowledged.Comparison(case, theirs, acknowledged.Exchange(*figures)).holds is holds
