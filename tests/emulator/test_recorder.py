"""A recording, read back: what must be in it is in it, and it is closed cleanly."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from emulator.observe.observation import pack, unpack
from emulator.observe.recorder import Recorder
from emulator.observe.run_folder import RunFolder
from emulator.run.emulation import Emulation
from emulator.run.messages import Messages
from emulator.run.simulate import simulate
from emulator.world.world import build_world
from vnet.link import wire
from vnet.scenario import Scenario

ENTITIES = [
    "/map/lanes",
    "/map/vehicles",
    "/map/links",
    "/common/particles",
    "/common/estimates",
    "/errors/fix",
    "/errors/estimate",
    "/series/error/rmse",
    "/series/error/deviation",
    "/series/position/estimate",
    "/series/frames/delivered",
    "/series/frames/lost",
]


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of a simulated cooperative run, its messages having crossed the wire."""
    scenario = Scenario.model_validate(
        {
            "run": {"duration_s": 2.0},
            "network": {"vehicles": 5},
            "radio": {"loss": 0.2},
            "program": {"entry": "agents.cooperative:main", "options": {"particles": 50}},
        }
    )
    folder = tmp_path_factory.mktemp("recorder")
    emulation = Emulation(scenario, build_world(scenario), RunFolder.create(folder / "run", scenario))
    path = folder / "recording.rrd"

    def crossed(message: dict) -> dict:
        return wire.decode_observation(wire.encode_observation(message))

    with Recorder(path) as recorder:
        messages = Messages(emulation)
        recorder.scene(crossed(messages.scene()))
        emulation.watch(lambda view: recorder.period(crossed(messages.period(view))))
        simulate(emulation)
    return path


def rerun(*arguments: str) -> str:
    command = [sys.executable, "-m", "rerun", "rrd", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def test_the_file_is_whole(recording: Path) -> None:
    rerun("verify", str(recording))


def test_every_entity_is_there(recording: Path) -> None:
    text = rerun("print", "-v", str(recording))
    missing = [entity for entity in ENTITIES if entity not in text]
    assert missing == []


def test_arrays_come_back() -> None:
    array = np.array([[1.5, -2.0], [np.nan, 3.0]])
    assert np.array_equal(unpack(pack(array), 2), array.astype(np.float32), equal_nan=True)
