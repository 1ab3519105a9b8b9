"""The core: vnet without the libraries of its extras, each of which is one line where it is missed.

A `sitecustomize` hides the libraries from every process. The commands run one after the other in one of them.
"""

import json
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import TypeAlias

import pytest

from tests.support.paths import ROOT
from vnet.extras import ALSO_IN, EXTRA_OF, needs

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
IMPORTED_AS = {"eclipse-sumo": None, "rerun-sdk": "rerun", "pycrate": "pycrate_asn1dir", "pytest": None}
"""Imported name of a distribution where it is another; None for one whose absence is said otherwise."""
FOR_USERS = ("cooperative", "dask", "export", "hypothesis", "its", "maps", "plots", "rerun", "rl", "scipy", "sdp")
FEW = ("--set", "network.vehicles=3", "--duration", "1")
WORKING = (
    ("simulate", "beacon", *FEW, "--out", "simulated"),
    ("report", "simulated"),
    ("check", "simulated"),
    ("run", "beacon", *FEW, "--out", "live"),
    ("compare", "simulated", "live", "--out", "comparison.html"),
    ("campaign", "beacon", "--runs", "1", "--jobs", "1", "--duration", "5", "--set", "network.vehicles=3"),
    ("sweep", "beacon", "--vary", "radio.loss=0,0.1", "--seeds", "2", "--jobs", "1", *FEW),
)
LACKING = {
    ("demo",): "rerun",
    ("simulate", "beacon", "--rerun", "save"): "rerun",
    ("render", "simulated"): "rerun",
    ("simulate", "80211p"): "scipy",
    ("simulate", "city"): "scipy",
    ("simulate", "quickstart"): "osqp",
    ("run", "quickstart"): "osqp",
    ("simulate", "beacon", "--program", "agents.centralized:main"): "scipy",
    ("analyze", "beacon"): "scipy",
    ("map", "city", "city.geojson"): "scipy",
    ("map", "show", "map.osm"): "osmium",
    ("map", "show", "map.geojson"): "pyproj",
    ("map", "show", "map.geojson", "--out", "map.png"): "matplotlib",
    ("sweep", "beacon", "--vary", "radio.loss=0,0.1", "--executor", "dask://localhost:1"): "distributed",
    ("access", "beacon", "--listen", "tls/127.0.0.1:7447", "--out", "access"): "cryptography",
}
"""Commands that end before a run begins, each with a library that it lacks."""
LINE = r"vnet: .* needs .*\b{}\b.*: pip install 'vnet-emulator\[[a-z,]*\b{}\b[a-z,]*\]'"
COMMANDS = """
import json, sys
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from emulator.cli.application import build_app
from emulator.terminal.console import run_app

app, results = build_app(), []
for words in json.loads(sys.argv[1]):
    with redirect_stdout(StringIO()), redirect_stderr(StringIO()) as said:
        status = run_app(app, words)
    results.append((words, status, said.getvalue()))
print(json.dumps(results))
"""
Results: TypeAlias = dict[tuple[str, ...], tuple[int, str]]


@pytest.fixture(scope="module")
def hidden(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """An environment in which no library of an extra is found; pytest itself looks for the plugin of hypothesis."""
    folder = tmp_path_factory.mktemp("hidden")
    code = f"import sys\nsys.modules.update(dict.fromkeys({sorted(EXTRA_OF.keys() - {'hypothesis'})}))\n"
    (folder / "sitecustomize.py").write_text(code)
    return {**os.environ, "PYTHONPATH": f"{folder}{os.pathsep}{ROOT}", "PYTHONHASHSEED": "0"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder in which the commands run."""
    folder = tmp_path_factory.mktemp("core")
    (folder / "map.osm").write_text("<osm/>")
    line = {"type": "LineString", "coordinates": [[8.0, 50.0], [8.01, 50.0]]}
    feature = {"type": "Feature", "properties": {"highway": "primary"}, "geometry": line}
    (folder / "map.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}))
    return folder


@pytest.fixture(scope="module")
def results(hidden: dict[str, str], folder: Path) -> Results:
    """Status and standard error of each command."""
    words = [sys.executable, "-c", COMMANDS, json.dumps([*WORKING, *LACKING])]
    done = subprocess.run(words, cwd=folder, env=hidden, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return {tuple(words): (status, said) for words, status, said in json.loads(done.stdout.splitlines()[-1])}


def test_each_library_of_an_extra_names_it() -> None:
    extras = PROJECT["optional-dependencies"]
    for extra in (*FOR_USERS, "sumo", "tls"):
        for wanted in extras[extra]:
            distribution = re.split("[<>=]", wanted)[0]
            library = IMPORTED_AS.get(distribution, distribution)
            assert library is None or library in EXTRA_OF, wanted
    for library, extra in EXTRA_OF.items():
        names = {IMPORTED_AS.get(name := re.split("[<>=]", wanted)[0], name) for wanted in extras[extra]}
        assert library in names


@pytest.mark.parametrize(
    ("libraries", "extras"),
    [
        (["scipy"], "scipy"),
        (["scipy", "osqp"], "cooperative"),
        (["osmium", "scipy"], "maps"),
        (["scipy", "mcap"], "scipy,export"),
    ],
)
def test_missing_libraries_name_no_extra_that_another_includes(libraries: list[str], extras: str) -> None:
    assert needs(*libraries).endswith(f"pip install 'vnet-emulator[{extras}]'")
    for library in libraries:
        for extra in ALSO_IN.get(library, ()):
            assert any(wanted.startswith(library) for wanted in PROJECT["optional-dependencies"][extra])


def test_all_and_dev_have_every_extra_for_users_that_is_small() -> None:
    (everything,) = PROJECT["optional-dependencies"]["all"]
    assert set(FOR_USERS) - set(re.split(r"[\[\],]", everything)) == {"sdp"}
    assert "vnet-emulator[all,site]" in PROJECT["optional-dependencies"]["dev"]


@pytest.mark.slow
@pytest.mark.parametrize("words", WORKING, ids=lambda words: words[0])
def test_the_core_works(words: tuple[str, ...], results: Results) -> None:
    status, said = results[words]
    assert status == 0, said


@pytest.mark.slow
def test_the_report_of_the_core_names_the_figures_that_it_lacks(results: Results, folder: Path) -> None:
    page = (folder / "simulated" / "report.html").read_text()
    assert "a figure needs matplotlib: pip install" in page and "Latency" in page and "<table" in page


@pytest.mark.slow
@pytest.mark.parametrize("words", LACKING, ids=" ".join)
def test_a_missing_extra_is_one_line_before_a_run_begins(
    words: tuple[str, ...], results: Results, folder: Path
) -> None:
    library = LACKING[words]
    status, said = results[words]
    assert status == 2 and re.fullmatch(LINE.format(library, EXTRA_OF[library]), said.splitlines()[-1]), said
    assert not list(folder.glob("runs/*/trace.parquet"))


@pytest.mark.slow
def test_the_pytest_plugin_of_the_core(hidden: dict[str, str], tmp_path: Path) -> None:
    test = """
async def test_beacon(vnet_emulation):
    async with vnet_emulation("beacon", vehicles=3, duration=2) as emu:
        await emu.run_until(1.0)
        emu.check("conservation")
"""
    (tmp_path / "test_it.py").write_text(test)
    words = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "test_it.py"]
    done = subprocess.run(words, cwd=tmp_path, env=hidden, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0 and "1 passed" in done.stdout, done.stdout + done.stderr
