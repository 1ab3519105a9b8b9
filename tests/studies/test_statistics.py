"""Intervals, paired tests and their correction, against scipy's and against what was drawn."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy  # its stats are imported when they are first used

from studies.reports import holm, interval_95, paired_tests, shown_interval

pytestmark = pytest.mark.slow


def test_an_interval_is_students() -> None:
    values = [0.2, 0.25, 0.22, 0.31]
    mean, half_width = interval_95(values)
    low, high = scipy.stats.t.interval(0.95, 3, np.mean(values), scipy.stats.sem(values))
    assert (mean - half_width, mean + half_width) == pytest.approx((low, high))
    assert shown_interval([*values, None]) == f"{mean:.3f} ± {half_width:.3f}"


def test_an_interval_holds_the_truth_as_often_as_it_says() -> None:
    drawn = np.random.default_rng(1).standard_normal((2000, 5))
    inside = [abs(mean) <= half_width for mean, half_width in map(interval_95, drawn.tolist())]
    assert np.mean(inside) == pytest.approx(0.95, abs=0.015)


@pytest.mark.parametrize(("values", "text"), [([], "–"), ([None], "–"), ([0.5], "0.500")])
def test_too_few_values_have_no_interval(values: list[float | None], text: str) -> None:
    assert shown_interval(values) == text


def test_paired_tests_are_those_of_scipy() -> None:
    rng = np.random.default_rng(2)
    reference = rng.normal(1.0, 0.3, 10)
    worse, same = reference + 0.05 + 0.02 * rng.standard_normal(10), reference + 0.02 * rng.standard_normal(10)
    tests = paired_tests(
        {"worse": (worse.tolist(), reference.tolist()), "same": (same.tolist(), reference.tolist())}
    )
    for test, values in zip(tests, (worse, same), strict=True):
        assert test.p == pytest.approx(float(scipy.stats.ttest_rel(values, reference).pvalue))
        assert test.pairs == 10
    assert tests[0].adjusted_p == pytest.approx(2 * tests[0].p)
    assert tests[0].shown[1] == "< 0.001"
    assert tests[1].adjusted_p == tests[1].p


def test_pairs_with_a_missing_value_are_left_out() -> None:
    (test,) = paired_tests({"a": ([1.0, None, 3.0], [0.5, 1.0, 2.5])})
    assert (test.pairs, test.difference, test.p) == (2, 0.5, 0.0)
    (nothing,) = paired_tests({"a": ([1.0, 2.0], [1.0, 2.0])})
    assert nothing.p == 1
    (single,) = paired_tests({"a": ([1.0], [2.0])})
    assert math.isnan(single.p) and single.shown == ["-1.0000", "–", "–"]


def test_holms_method() -> None:
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    found = holm([0.5, math.nan, 0.9])
    assert found[0] == 1.0 and math.isnan(found[1]) and found[2] == 1.0
