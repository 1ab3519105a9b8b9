"""The page of a sweep: what intervals say."""

from emulator.report.sweep_page import differences, mean_of


def test_rounding_of_a_constant_difference_is_no_spread() -> None:
    rows = [
        {"program.entry": program, "seed": seed, "gap_s": seed + more}
        for program, more in (("a", 0.1), ("b", 0.3))
        for seed in range(1, 6)
    ]
    (row,) = differences(rows, ["program.entry"], {"gap_s": "gap"})
    assert row["gap"] == "0.2 ± 0"


def test_small_spread_of_small_numbers_is_kept() -> None:
    assert str(mean_of([1e-13, 2e-13, 3e-13])).endswith("e-13")
    assert str(mean_of([1e-16, -3e-16, 2e-16], size=1.0)) == str(mean_of([0.0, 0.0, 0.0]))
