"""Scenarios in which SUMO is stepped with the run: with a stand-in for libsumo, which tests install."""

import json
import os
import shutil
from pathlib import Path
from typing import Any

import pytest

from tests.support.paths import ROOT

FAKE = ROOT / "tests" / "support" / "fake_sumo" / "libsumo.py"
CONFIGURATION = """<configuration>
    <input><net-file value="a.net.xml"/><route-files value="plan.json"/></input>
    <time><begin value="0"/></time>
</configuration>
"""
CARS = [
    {"id": "lead#1", "depart": 0.0, "x": 60.0, "speed": 12.0},
    {"id": "behind", "depart": 0.0, "x": 30.0, "speed": 12.0},
    {"id": "late", "depart": 1.0, "x": 5.0, "speed": 10.0},
    {"id": "never", "depart": 1e6, "x": 5.0, "speed": 10.0},
]


def install_fake(folder: Path, monkeypatch: pytest.MonkeyPatch, version: str = "1.0") -> None:
    """Have this process and those that it starts find the stand-in, in `folder`, in this version."""
    for old in folder.glob("libsumo-*"):
        shutil.rmtree(old)
    about = folder / f"libsumo-{version}.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: libsumo\nVersion: {version}\n")
    (about / "WHEEL").write_text("Wheel-Version: 1.0\nTag: cp311-cp311-fake_x86_64\n")
    shutil.copy(FAKE, folder)
    monkeypatch.syspath_prepend(folder)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(folder), os.environ.get("PYTHONPATH", ""), str(ROOT)]))


def write_scenario(folder: Path, plan: dict[str, Any] | None = None, **sections: dict[str, Any]) -> dict[str, Any]:
    """Write the input files, with what is to go wrong in `plan`; returns the sections of a scenario."""
    (folder / "town.sumocfg").write_text(CONFIGURATION)
    (folder / "a.net.xml").write_text("<net/>")
    (folder / "plan.json").write_text(json.dumps({"vehicles": CARS} | (plan or {})))
    data: dict[str, dict[str, Any]] = {
        "run": {"duration_s": 3.0, "settle_s": 0.5},
        "network": {"kind": "sumo", "path": str(folder / "town.sumocfg"), "step": True},
        "world": {"gnss": {"rate_hz": 10, "speed_sigma_mps": 0.0}},
        "radio": {"loss": 0.1, "range_m": 1e5},
    }
    for name, section in sections.items():
        data[name] = {key: value for key, value in {**data.get(name, {}), **section}.items() if value is not None}
    return data
