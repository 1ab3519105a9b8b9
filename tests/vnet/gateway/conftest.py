"""Vehicles that run programs as they stand, simulated."""

import json
from collections.abc import Callable
from pathlib import Path
from textwrap import dedent
from typing import Any

import pytest

import emulator
from emulator import Run

Drive = Callable[..., Run]


@pytest.fixture
def drive(tmp_path: Path) -> Drive:
    """Simulate vehicles with programs given as text: each of `programs` is a process of every vehicle."""

    def simulate(*programs: str, vehicles: int = 1, duration_s: float = 2.0, loss: float = 0.0, **more: Any) -> Run:
        commands = []
        for index, text in enumerate(programs):
            path = tmp_path / f"program{index}.py"
            path.write_text(dedent(text))
            commands.append(["python", str(path), "{id}"])
        scenario = {
            "run": {"duration_s": duration_s, "settle_s": 0.0, "seed": 1, **more.pop("run", {})},
            "network": {"vehicles": vehicles},
            "radio": {"range_m": 1e5, "loss": loss, **more.pop("radio", {})},
            "program": {"kind": "zenoh", "command": commands, **more.pop("program", {})},
            **more,
        }
        return emulator.simulate(scenario, out=tmp_path / f"run{len(list(tmp_path.iterdir()))}")

    return simulate


def log(run: Run, node: str = "v01") -> list[str]:
    """Return the lines that a vehicle's programs have printed: those of tests need no session."""
    lines = (run.folder / f"logs/{node}.log").read_text().splitlines()
    return [line for line in lines if not line.endswith("has opened no Zenoh session")]


def printed(run: Run, node: str = "v01") -> list[str]:
    """Return the same, but for the line that says that its programs have ended."""
    return [line for line in log(run, node) if line != f"{node} finished"]


def events(run: Run, kind: str) -> list[dict[str, Any]]:
    """Return the events of a kind, as they are written."""
    lines = (run.folder / "events.jsonl").read_text().splitlines()
    return [event for event in map(json.loads, lines) if event["kind"] == kind]
