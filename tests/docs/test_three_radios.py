"""The study of three radios: its scenario, and what its check says of runs."""

from pathlib import Path
from typing import Any

import pytest

import emulator
from docs.examples.three_radios import figures
from tests.support.paths import ROOT

EXAMPLE = ROOT / "docs" / "examples" / "three_radios"
RADIOS: list[dict[str, Any]] = [
    {"kind": "80211p"},
    {"kind": "lte-mode4", "subchannels": 5},
    {"kind": "nr-mode2", "subchannels": 5, "scs_khz": 15},
]
pytestmark = pytest.mark.slow


def test_a_sweep_has_the_figures_of_near_receptions_of_each_radio(tmp_path: Path) -> None:
    from docs.examples.three_radios import figure  # imports scipy.stats, which takes most of a second

    changes = {"radio.shadowing.sigma_db": 0.0, "radio.path_loss.tx_power_dbm": 30.0}
    vary: dict[str, list[Any]] = {
        "radio.mac": RADIOS,
        "network.path": [str(EXAMPLE / "50.csv")],
        "program.options": [{"rate_hz": 10, "size_bytes": 190}],
    }
    table = emulator.sweep(EXAMPLE / "highway.toml", vary, duration_s=1.4, set=changes, out=tmp_path)
    dot11p, lte, nr = table.to_pylist()
    for row in (dot11p, lte, nr):
        # 25 vehicles 20 m apart have 2 (24 + 23 + … + 15) ordered pairs within 200 m, and 4 frames each after 1 s.
        assert row["own:near.links"] == 2 * sum(range(15, 25)) and 3 <= row["own:near.pairs"] / 390 <= 5
        assert row["own:near.delivery_ratio"] > 0.9
        assert row["own:near.inter_reception_mean_ms"] == pytest.approx(100, abs=5)
    assert dot11p["own:near.latency_mean_ms"] < 5 < lte["own:near.latency_mean_ms"] < 104
    assert dot11p["own:near.age_mean_ms"] < min(lte["own:near.age_mean_ms"], nr["own:near.age_mean_ms"])
    found = figure.samples(str(tmp_path / "sweep.parquet"))
    assert list(found) == [(mac["kind"], "10 Hz, 190 bytes", 50) for mac in RADIOS]
    figure.draw(found, str(tmp_path / "picture.png"))
    assert (tmp_path / "picture.png").stat().st_size > 10_000


def test_a_platoon_whose_first_vehicle_keeps_its_speed_has_no_amplification(tmp_path: Path) -> None:
    scenario = {
        "run": {"duration_s": 1.0, "settle_s": 0.0},
        "network": {"kind": "driven", "vehicles": 8, "driven": {"speed_mps": 20.0}},
        "program": {"entry": "agents.beacon:main"},
    }
    run = emulator.simulate(scenario, out=tmp_path / "run")
    assert [result.verdict for result in figures.platoon(run)] == ["not applicable"]
