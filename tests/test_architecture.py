"""The house has walls: agents/ and emulator/ stand on vnet/ and never meet; vnet/ looks up to nobody."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.paths import ROOT

FORBIDDEN = {"vnet": {"agents", "emulator"}, "agents": {"emulator"}, "emulator": {"agents"}}


# What an agent may do without, and what costs seconds or tens of megabytes once a vehicle.
HEAVY = ["rerun", "matplotlib", "pandas", "pyarrow", "pydantic", "tomli_w", "emulator"]


def tracked_files(package: str) -> list[Path]:
    """The package's Python files that are in the repository, and not what else lies about."""
    listed = subprocess.run(
        ["git", "ls-files", "-z", f"{package}/*.py"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    return [ROOT / name for name in listed.stdout.split("\0") if name and (ROOT / name).exists()]


def imported(code: str) -> set[str]:
    """The top-level packages that some code imports, wherever in it; `import_module("x")` counts as well."""
    found = set()
    for node in ast.walk(ast.parse(code)):
        match node:
            case ast.Import(names=names):
                found |= {alias.name for alias in names}
            case ast.ImportFrom(module=str(module), level=0):
                found.add(module)
            case ast.Call(
                func=ast.Name(id="import_module" | "__import__") | ast.Attribute(attr="import_module"),
                args=[ast.Constant(value=str(module)), *_],
            ):
                found.add(module)
    return {name.split(".")[0] for name in found}


@pytest.mark.parametrize(
    "code",
    [
        "import json, emulator.radio.engine as e",
        "def f():\n    from emulator.world import world",
        "if TYPE_CHECKING:\n    from emulator import engine",
        "import_module('emulator.cli')",
        "importlib.import_module('emulator')",
    ],
)
def test_no_way_of_importing_goes_unseen(code: str) -> None:
    assert "emulator" in imported(code)


def test_what_only_looks_like_an_import_is_none() -> None:
    assert imported('"""import emulator"""\nemulator = "emulator.cli"\nfrom . import emulator') == set()


@pytest.mark.parametrize("package", FORBIDDEN)
def test_no_import_goes_through_a_wall(package: str) -> None:
    files = tracked_files(package)
    assert len(files) > 3
    broken = {str(path.relative_to(ROOT)): imported(path.read_text()) & FORBIDDEN[package] for path in files}
    assert {path: names for path, names in broken.items() if names} == {}


@pytest.mark.parametrize("modules", ["agents.cooperative, agents.host", "agents.cli, agents.beacon"])
def test_an_agent_imports_nothing_heavy(modules: str) -> None:
    """Import cost counts once a vehicle."""
    code = f"import sys, {modules}; print([m for m in {HEAVY} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_every_file_opens_with_what_it_is_for() -> None:
    silent = [
        str(path.relative_to(ROOT))
        for package in FORBIDDEN
        for path in tracked_files(package)
        if path.stat().st_size and ast.get_docstring(ast.parse(path.read_text())) is None
    ]
    assert silent == []


def test_the_smallest_useful_program_is_small() -> None:
    assert len((ROOT / "agents" / "beacon.py").read_text().splitlines()) <= 42
