"""C-V2X beside published curves and closed forms: a few points of the table of `python -m benchmarks.cv2x`."""

import os
from pathlib import Path

import numpy as np
import pytest

from benchmarks.cv2x import closed_forms, dot11p
from benchmarks.cv2x.closed_forms import COUNTERS, Case, lives, measured, meets, meets_by_cao
from benchmarks.cv2x.highway import Setting, deviations, drive, mode4_radio, published, together

CURVES = {
    Setting(0.1, 10, 20.0, 4): {
        "PDR": [0.991, 0.98, 0.968, 0.916, 0.715, 0.331],
        "HD": [0.008, 0.008, 0.008, 0.008, 0.008, 0.009],
        "SEN": [0.0, 0.0, 0.0, 0.005, 0.169, 0.594],
        "PRO": [0.0, 0.0, 0.0, 0.001, 0.003, 0.003],
        "COL": [0.001, 0.011, 0.024, 0.07, 0.104, 0.063],
    },
    Setting(0.1, 10, 23.0, 4): {
        "PDR": [0.991, 0.979, 0.97, 0.937, 0.856, 0.644],
        "HD": [0.008, 0.008, 0.008, 0.008, 0.008, 0.008],
        "SEN": [0.0, 0.0, 0.0, 0.0, 0.026, 0.223],
        "PRO": [0.0, 0.0, 0.0, 0.0, 0.002, 0.004],
        "COL": [0.001, 0.012, 0.022, 0.055, 0.109, 0.121],
    },
    Setting(0.3, 10, 20.0, 4): {
        "PDR": [0.986, 0.924, 0.844, 0.673, 0.451, 0.197],
        "HD": [0.009, 0.008, 0.008, 0.008, 0.009, 0.01],
        "SEN": [0.0, 0.0, 0.0, 0.005, 0.169, 0.59],
        "PRO": [0.0, 0.0, 0.0, 0.001, 0.003, 0.003],
        "COL": [0.005, 0.067, 0.147, 0.313, 0.367, 0.2],
    },
}
"""Every fourth point, from 0 to 500 m, of simulated curves of Gonzalez-Martin, Sepulcre, Molina-Masegosa and
Gozalvez, IEEE TVT 68(2), 2019, as published in their repository msepulcre/C-V2X."""

SECONDS = [float(each) for each in os.environ.get("CURVES_S", "5 3 3").split()]
"""Emulated seconds of each; `make radios` takes more."""


def away(setting: Setting, seconds: float, seeds: int) -> dict[str, float]:
    """Return the deviations of a setting from its published points."""
    runs = together([drive(mode4_radio(setting), setting, seconds, seed) for seed in range(1, seeds + 1)])
    theirs = {name: np.array(curve) for name, curve in CURVES[setting].items()}
    return deviations({name: curve[::4] for name, curve in runs.curves().items()}, theirs)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("setting", "seconds"), [*zip(CURVES, SECONDS, strict=True)], ids=lambda each: getattr(each, "name", None)
)
def test_mode_4_agrees_with_its_published_curves(setting: Setting, seconds: float) -> None:
    found = away(setting, seconds, 1)
    assert max(found.values()) <= 2.5, found


def test_lives_of_resources_have_the_mean_of_their_counters() -> None:
    assert lives(0.0).sum() == pytest.approx(COUNTERS.mean())
    assert lives(0.8).sum() == pytest.approx(COUNTERS.mean() / 0.2, rel=1e-3)
    assert lives(0.0)[4] == 1 and lives(0.0)[15] == pytest.approx(0)


@pytest.mark.slow
@pytest.mark.parametrize("case", [Case(40), Case(20, keep=0.4), Case(20, keep=None)], ids=lambda case: case.name)
def test_mode_2_meets_others_as_often_as_its_closed_form_says(case: Case) -> None:
    assert abs(measured(case, 6.0) - meets(case)) <= 0.03


def test_closed_forms_grow_with_the_load_and_fall_with_the_resources() -> None:
    assert meets(Case(10)) < meets(Case(20)) < meets(Case(40))
    assert meets(Case(20, subchannels=2)) < meets(Case(20)) < meets(Case(20, keep=None))
    assert len({case.name for case in closed_forms.CASES}) == len(closed_forms.CASES)


@pytest.mark.parametrize("vehicles", [2, 20, 40])
def test_the_model_of_cao_is_twice_the_closed_form_while_resources_are_free(vehicles: int) -> None:
    theirs = meets_by_cao(Case(vehicles, subchannels=2))
    assert theirs is not None and 1.5 <= theirs / meets(Case(vehicles, subchannels=2)) <= 2.5
    assert meets_by_cao(Case(vehicles, keep=None)) is None


def test_published_files_are_read(tmp_path: Path) -> None:
    header = "density_per_m,rate_hz,power_dbm,subchannels,figure,curve,distance_m,value\n"
    rows = "".join(f"0.1,10,20,4,PDR,PDR Simulation,{25 * n},{n / 10}\n" for n in range(3))
    (tmp_path / "lte.csv").write_text(header + rows + "0.1,10,20,4,PDR,PDR Analytical,0,0.5\n")
    curves = published(tmp_path / "lte.csv")[Setting(0.1, 10, 20.0, 4)]
    assert curves["PDR"] == pytest.approx([0.0, 0.1, 0.2])
    busy = "density_per_m,bitrate_mbps,rate_hz,power_dbm,size_bytes,curve,cbr,density\n0.1,6,10,23,190,CBR sim,"
    (tmp_path / "cbr.csv").write_text(busy + "0.2,1\n" + busy.splitlines()[1] + "0.4,3\n")
    setting = Setting(0.1, 10, 23.0, bitrate_mbps=6.0)
    assert dot11p.published_busy(tmp_path / "cbr.csv") == {setting: pytest.approx(0.35)}
    assert np.isclose(dot11p.radio(setting).bitrate_mbps, 6.0)
