"""Whatever is wrong with a file that a scenario names is said in one line: the file, its line, the value."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from emulator.scenario.scenario import Radio, Scenario
from emulator.world.maps.files import read_buildings, read_roads
from emulator.world.networks import load_network
from emulator.world.radio_inputs import load_links
from emulator.world.world import build_world
from tests.support import maps
from tests.support.paths import ROOT
from vnet.errors import ScenarioError

BLOCK = re.compile(r"### (\w+) (\S+)\n(.*?)=> ([^\n]+)\n\n?", re.DOTALL)
"""A kind of file, its name, its text, and what is said of it."""


def with_world(section: dict[str, object]) -> object:
    return build_world(Scenario.model_validate({"run": {"duration_s": 20.0}, **section}))


READERS: dict[str, Callable[[Path], object]] = {
    "network": load_network,
    "trips": lambda path: with_world({"network": {"kind": "trips", "path": str(path)}}),
    "links": lambda path: load_links(Radio(links=path), ["a", "b", "c"]),
    "errors": lambda path: with_world({"world": {"common_error": {"kind": "file", "path": str(path)}}}),
    "buildings": lambda path: read_buildings(path, lambda: maps.FRAME),
    "roads": read_roads,
    "arrays": read_roads,
    "matrix": lambda path: with_world({"network": {"kind": "trips", "path": str(path)}}),
}


ARRAYS: dict[str, dict[str, Any]] = {
    "arrays": maps.arrays(),
    "matrix": {"x_m": [[0, 0, 0], [0, 0, 0]], "y_m": [[1, 1, 1], [1, 1, 1]], "rate_hz": 10},
}
"""Arrays of which a block has changes; null leaves one out."""


def write(kind: str, path: Path, text: str) -> None:
    if kind in ARRAYS:
        arrays: dict[str, Any] = ARRAYS[kind] | json.loads(text)
        np.savez(path, **{name: array for name, array in arrays.items() if array is not None})
    else:
        path.write_text(text, encoding="utf-8")


def said_of(kind: str, path: Path) -> str:
    with pytest.raises(ScenarioError) as caught:
        READERS[kind](path)
    said = str(caught.value)
    assert str(path) in said and "\n" not in said
    return said.removeprefix(f"{path}: ").replace(str(path), path.name)


@pytest.mark.slow
def test_messages_are_those_that_were_read(tmp_path: Path) -> None:
    golden = (ROOT / "tests" / "golden" / "input_files.txt").read_text(encoding="utf-8")
    shown = []
    for kind, name, text, _ in BLOCK.findall(golden):
        write(kind, tmp_path / name, text)
        shown.append(f"### {kind} {name}\n{text}=> {said_of(kind, tmp_path / name)}\n")
    assert len(shown) > 80
    (tmp_path / "input_files.txt").write_text("\n".join(shown), encoding="utf-8")
    assert "\n".join(shown) == golden, f"read {tmp_path}/input_files.txt; if it is right, keep it"


@pytest.mark.parametrize("kind", ["network", "links"])
def test_a_file_that_cannot_be_read_is_one_line(tmp_path: Path, kind: str) -> None:
    assert said_of(kind, tmp_path / "no.csv").startswith("cannot be read: No such file")
    (tmp_path / "bytes.csv").write_bytes(b"id,x_m,y_m,heading_rad\n\xff,0,0,0\n")
    assert said_of(kind, tmp_path / "bytes.csv").startswith("not a CSV file")
