"""The example of the estimators finds what there is to be found."""

import numpy as np
import pytest

from docs.examples import estimators


def test_the_common_error_is_found_from_two_roads() -> None:
    np.testing.assert_allclose(estimators.find_common_error(50), estimators.COMMON_ERROR_M, atol=0.5)


def test_the_mean_is_found_though_frames_are_lost() -> None:
    np.testing.assert_allclose(estimators.find_mean(), [1.5, 15.0], atol=0.01)


def test_an_uncertain_estimate_weighs_little() -> None:
    weights = estimators.fuse_three()
    assert weights.sum() == pytest.approx(1) and weights[2] < 0.05


def test_the_example_prints_its_results(capsys: pytest.CaptureFixture[str]) -> None:
    estimators.main()
    names = [line.partition(":")[0] for line in capsys.readouterr().out.splitlines()]
    assert names == ["common error", "mean of the ring", "fusion weights"]
