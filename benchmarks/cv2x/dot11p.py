"""802.11p on the highway of the published curves (Sepulcre et al., IEEE802.11p-model)."""

from __future__ import annotations

import csv
from pathlib import Path

from benchmarks.cv2x.highway import Setting
from emulator.scenario.scenario import Radio


def radio(setting: Setting) -> Radio:
    """Return our radio in a setting: their propagation, noise and sensing; our error model, lock and EDCA."""
    return Radio.model_validate(
        {
            "max_peers": 1_000_000,
            "access_jitter_ms": 0.0,
            "bitrate_mbps": setting.bitrate_mbps,
            "path_loss": {
                "kind": "winner_b1",
                "frequency_ghz": 5.91,
                "environment_m": 0.5,
                "tx_power_dbm": setting.power_dbm,
                "floor_dbm": -105.0,
            },
            "shadowing": {"sigma_db": 3.0},
            "receiver": {"noise_figure_db": 9.0, "min_rssi_dbm": -85.0},
            "mac": {"carrier_sense_dbm": -85.0},
        }
    )


def published_busy(path: Path) -> dict[Setting, float]:
    """Return the mean channel busy ratio of each setting from its published density."""
    sums: dict[Setting, list[float]] = {}
    with path.open() as file:
        for row in csv.DictReader(file):
            setting = Setting(
                density_per_m=float(row["density_per_m"]),
                rate_hz=int(row["rate_hz"]),
                power_dbm=float(row["power_dbm"]),
                bitrate_mbps=float(row["bitrate_mbps"]),
                size_bytes=int(row["size_bytes"]),
            )
            both = sums.setdefault(setting, [0.0, 0.0])
            both[0] += float(row["cbr"]) * float(row["density"])
            both[1] += float(row["density"])
    return {setting: weighted / total for setting, (weighted, total) in sums.items()}
