"""Pictures and tables are made from what cells leave, whatever is missing from it."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from studies import figures, reports
from studies.paper import ALPHAS, PAPER_VEHICLES

pytestmark = pytest.mark.slow


def is_picture(path: Path) -> bool:
    picture = path.read_bytes()
    return picture.startswith(b"\x89PNG") and len(picture) > 5000 and path.with_suffix(".svg").exists()


def series(seed: int, missing: bool = False) -> pa.Table:
    rng = np.random.default_rng(seed)
    rmse = rng.uniform(0.1, 1.0, 50).tolist()
    return pa.table(
        {
            "time_ns": [100_000_000 * k for k in range(50)],
            "common_error_rmse_m": [None if missing and k < 10 else x for k, x in enumerate(rmse)],
            "deviation_m": rmse,
        }
    )


@pytest.mark.parametrize("seeds", [1, 3])
def test_time_courses_are_drawn_for_one_seed_or_many(tmp_path: Path, seeds: int) -> None:
    found = {name: [series(s, missing=name == "none") for s in range(seeds)] for name in ("optimized", "none")}
    assert is_picture(figures.against_time(found, tmp_path / "course", "N2", {"the paper's optimized": 0.72}))


def table1_results() -> list[dict[str, object]]:
    rows: list[dict[str, object]] = []
    for name in ("optimized", *(f"{alpha:g}" for alpha in ALPHAS)):
        value = 0.1 if name == "optimized" else 0.2 + (float(name) - 0.48) ** 2
        for seed in (1, 2):
            rows.append(
                {"weights": name, "seed": seed, "stacked_deviation_m": value * seed, "stacked_rmse_m": value + 0.5}
            )
    return rows


def test_table_one_says_where_the_minimum_is_and_how_far_below_optimized_weights_are(tmp_path: Path) -> None:
    text = reports.table1(table1_results())
    assert "smallest at α = 0.5 and largest at α = 0.95" in text
    assert "0.50 ± 0.00 times that of the best constant" in text
    assert is_picture(figures.alpha_curve(table1_results(), reports.PAPER_TABLE1, tmp_path / "table1"))


def test_table_two_puts_the_papers_figures_beside() -> None:
    rows = [
        {"network": n, "sides": sides, "mechanism": m, "seed": 1, "stacked_rmse_m": value, "rmse_m": value}
        for n in PAPER_VEHICLES
        for sides in (1, 2)
        for m, value in {"centralized": 0.1, "optimized": 0.2, "random": 0.6, "none": 0.9}.items()
    ]
    text = reports.table2(rows)
    assert "4.30" in text and "3.00" in text, "the paper's random N3, and ours over optimized"
