"""What programs may report, however odd, is measured or left out; it never stops a run or its recording."""

import numpy as np
import pytest

from emulator.observe.metrics import Metrics
from emulator.observe.observation import pack, period_message, unpack
from emulator.world.world import Instant
from vnet.link.node import Report

POSITION_M = np.array([[0.0, 0.0], [10.0, 0.0]])
INSTANT = Instant(0, 0, POSITION_M, np.zeros(2), np.zeros(2), POSITION_M, np.zeros(2))


def metrics() -> Metrics:
    return Metrics(["a", "b"], np.array([0, 0]), 100_000_000)


@pytest.mark.parametrize("covariance", [(-1.0, 0.0, 0.0, -1.0), (0.0, 0.0, 0.0, 0.0), (1.0, 0.0, 0.0, -1.0)])
def test_a_covariance_that_is_not_positive_definite_takes_no_part_in_the_anees(covariance: tuple) -> None:
    honest = Report(0, "a", (1.0, 0.0), (1.0, 0.0, 0.0, 1.0))
    broken = Report(0, "b", (0.0, 0.0), covariance)
    assert metrics().record(INSTANT, [broken]).position_anees is None
    assert metrics().record(INSTANT, [honest, broken]).position_anees == pytest.approx(0.5)


@pytest.mark.parametrize("cloud", [1.0, [1.0], [1.0, 2.0, 3.0]])
def test_a_cloud_that_is_not_made_of_points_is_not_shown(cloud: object) -> None:
    reports = [Report(0, "a", None, None, {"cloud_m": cloud}), Report(0, "b", None, None, {"cloud_m": [1.0, 2.0]})]
    message = period_message(["a", "b"], INSTANT, reports, metrics().record(INSTANT, reports), {}, [])
    assert list(message["clouds"]) == ["b"]
    assert unpack(message["clouds"]["b"], 2).tolist() == [[1.0, 2.0]]


def test_the_hash_is_of_the_content() -> None:
    def record(x_m: float) -> str:
        kept = metrics()
        kept.record(INSTANT, [Report(0, "a", (x_m, 0.0), None)])
        return kept.sha256()

    assert record(1.0) == record(1.0)
    assert record(1.0) != record(float(np.nextafter(1.0, 2.0)))


def test_arrays_cross_as_little_endian_float32() -> None:
    assert pack([[1.0, 2.0]]) == np.array([1, 2], "<f4").tobytes()
