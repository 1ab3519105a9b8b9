"""Surroundings of unmodified programs on virtual time: their classes by name, their configuration, themselves."""

import json
import sys
from pathlib import Path

import pytest

from tests.vnet.gateway.conftest import Drive, log
from vnet.gateway import client_config
from vnet.gateway.emulated.modules import CLIENT_CONFIG, ENDPOINT

pytestmark = pytest.mark.slow


def test_classes_of_a_program_are_found_by_the_names_of_their_modules(drive: Drive, tmp_path: Path) -> None:
    """Pickles, annotations as text and sources name a module, of which each vehicle has its own."""
    package = tmp_path / "shapes"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "data.txt").write_text("round")
    (package / "parts.py").write_text("class Wheel:\n    def __init__(self, size):\n        self.size = size\n")
    text = """
        from __future__ import annotations
        import asyncio, importlib.resources, inspect, pickle, pkgutil, sys, time
        import msgspec, pydantic
        from shapes.parts import Wheel

        class Car(pydantic.BaseModel):
            wheels: list[Part]

        class Part(pydantic.BaseModel):
            size: int

        class Frame(msgspec.Struct):
            parts: list[Bolt]

        class Bolt(msgspec.Struct):
            size: int

        class Pose:
            name = sys.argv[1]

        def again(thing):
            return pickle.loads(pickle.dumps(thing))

        async def later():
            done = asyncio.Event()
            def call():
                print(type(again(Pose())) is Pose, again(Wheel(3)).size)
                done.set()
            asyncio.get_running_loop().call_later(0.2, call)
            await done.wait()

        time.sleep(0.1)  # another vehicle has the classes by now, too
        print(again(Pose()).name, type(again(Wheel(3))) is Wheel)
        print(Car(wheels=[{"size": 3}]), msgspec.json.decode(b'{"parts":[{"size":3}]}', type=Frame))
        print(inspect.getmodule(Wheel).__name__, "class Wheel" in inspect.getsource(Wheel))
        print(importlib.resources.files("shapes").joinpath("data.txt").read_text())
        print(pkgutil.get_data("shapes", "data.txt"))
        asyncio.run(later())
        """
    before = dict(sys.modules)
    run = drive(text, vehicles=2)
    for node in ("v01", "v02"):
        assert log(run, node)[:-1] == [
            f"{node} True",
            "wheels=[Part(size=3)] Frame(parts=[Bolt(size=3)])",
            "shapes.parts True",
            "round",
            "b'round'",
            "True 3",
        ]
    assert sys.modules["__main__"] is before["__main__"]
    assert "shapes" not in sys.modules, "what a run has shown is gone after it"


def test_configuration_is_where_a_gateway_gives_it(drive: Drive) -> None:
    run = drive(
        """
        import json, os, zenoh
        assert zenoh.Config.DEFAULT_CONFIG_PATH_ENV == "ZENOH_CONFIG"
        for config in (zenoh.Config.from_env(), zenoh.Config.from_file(os.environ["ZENOH_CONFIG"])):
            print(config.get_json("mode"), config.get_json("connect/endpoints"))
            zenoh.open(config).close()
        config = zenoh.Config()
        for setting in os.environ["ZENOH_CONFIG_OVERRIDE"].split(";"):
            config.insert_json5(*setting.split("=", 1))
        print(config.get_json("mode"), config.get_json("connect/endpoints"))
        os.environ["ZENOH_CONFIG"] = "missing.json5"
        try:
            zenoh.Config.from_env()
        except zenoh.ZError:
            print("refused")
        """
    )
    assert log(run)[:-1] == [f'"client" ["{ENDPOINT}"]'] * 3 + ["refused"]
    assert json.loads(CLIENT_CONFIG.read_text()) == client_config(ENDPOINT)
