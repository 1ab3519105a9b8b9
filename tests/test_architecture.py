"""The architecture: who may import whom, no circles, no package too large, no file too long.

Imports under TYPE_CHECKING and inside functions count as all others do.
"""

import ast
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path

import pytest

from tests.support.paths import ROOT

PACKAGES = ("vnet", "agents", "emulator", "studies")
LAYERS = (
    ("vnet",),
    ("emulator.scenario",),
    ("emulator.fault_plan",),
    ("emulator.world",),
    ("emulator.radio",),
    ("emulator.records",),
    ("emulator.pages",),
    ("emulator.checks", "emulator.stream", "emulator.export"),
    ("emulator.viewer", "emulator.report"),
    ("emulator.drivers",),
    ("emulator.cells",),
    ("emulator.terminal", "emulator.testing", "emulator.learning", "emulator.api", "emulator.analyze"),
    ("emulator.cli",),
    ("emulator.__main__",),
    ("studies",),
)
"""The lowest first: a module imports from its own package and from lower layers, never from a neighbour."""
VNET_LAYERS = (
    ("vnet.errors", "vnet.types", "vnet.units", "vnet.bounded"),
    ("vnet.roads",),
    ("vnet.node",),
    ("vnet.transport",),
    ("vnet.runtime",),
    ("vnet.gateway",),
)
BASIS = ("vnet.errors", "vnet.types", "vnet.units", "vnet.bounded")
MOST_LINES = 1000
FLAT_LISTS: frozenset[str] = frozenset()
"""Files that may be longer, because they are flat lists."""

# What an agent may do without, and what costs seconds or tens of megabytes once a vehicle.
HEAVY = ["rerun", "matplotlib", "pandas", "pyarrow", "pydantic", "tomli_w", "emulator"]


@cache
def source_files() -> dict[str, Path]:
    """The project's modules by name."""
    return {module_name(path): path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))}


def module_name(path: Path) -> str:
    """The dotted name of a file of the repository."""
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


IMPORT = re.compile(
    r"^[ \t]*(from [\w.]+ import (?:\([^)]*\)|[^(\n]+)|import [\w., ]+)"
    r"|\b((?:import_module|__import__)\([^)\n]+\))",
    re.MULTILINE,
)
"""A statement at the beginning of a line, or a call: one tenth of the time that parsing all of the code takes."""


def imported_names(code: str) -> Iterator[str]:
    """Yield the absolute names that some code imports, wherever in it; `import_module("x")` counts as well."""
    for statement, call in IMPORT.findall(code):
        with suppress(SyntaxError):  # prose that begins like one
            for node in ast.walk(ast.parse(statement or call)):
                yield from _imported_by(node)


def _imported_by(node: ast.AST) -> list[str]:
    match node:
        case ast.Import(names=names):
            return [alias.name for alias in names]
        case ast.ImportFrom(module=str(module), names=names, level=0):
            return [f"{module}.{alias.name}" for alias in names]
        case ast.Call(args=[ast.Constant(value=str(module)), *_]):
            return [module]
    return []


@cache
def imports() -> dict[str, set[str]]:
    """The modules of the project that each of its modules imports."""
    graph = {}
    for module, path in source_files().items():
        found = (nearest_module(name) for name in imported_names(path.read_text()))
        graph[module] = {name for name in found if name is not None and name != module}
    return graph


def nearest_module(name: str) -> str | None:
    """The module that an imported name is, or is in; None for one of another project."""
    while name and name not in source_files():
        name = name.rpartition(".")[0]
    return name or None


def level(module: str, layers: tuple[tuple[str, ...], ...]) -> tuple[int, str] | None:
    """The number of a module's layer and its package there; None for what is in none."""
    for number, packages in enumerate(layers):
        for package in packages:
            if module == package or module.startswith(f"{package}."):
                return number, package
    return None


def violations(graph: dict[str, set[str]], layers: tuple[tuple[str, ...], ...]) -> list[str]:
    """The imports that go up, or to a neighbour on the same layer."""
    found = []
    for module, others in graph.items():
        for other in sorted(others):
            here, there = level(module, layers), level(other, layers)
            if here is None or there is None or here[1] == there[1]:
                continue
            if there[0] >= here[0]:
                found.append(f"{module} -> {other}")
    return found


def circles(graph: dict[str, set[str]]) -> list[list[str]]:
    """Groups of modules that import each other: what is left when nothing can be taken away from either end."""
    left = {module: set(others) for module, others in graph.items()}
    while True:
        imported = {other for others in left.values() for other in others}
        ends = [module for module, others in left.items() if not others & left.keys() or module not in imported]
        if not ends:
            return [sorted(left)] if left else []
        for module in ends:
            del left[module]
        left = {module: others & left.keys() for module, others in left.items()}


@pytest.mark.parametrize(
    "code",
    [
        "import json, emulator.radio.engine as e",
        "def f():\n    from emulator.world import world",
        "if TYPE_CHECKING:\n    from emulator.radio import engine",
        "import_module('emulator.cli')",
        "importlib.import_module('emulator')",
    ],
)
def test_no_way_of_importing_goes_unseen(code: str) -> None:
    assert any(name.split(".")[0] == "emulator" for name in imported_names(code))


def test_what_only_looks_like_an_import_is_none() -> None:
    assert set(imported_names('"""import emulator"""\nemulator = "emulator.cli"\nfrom . import emulator')) == set()


def test_circles_and_upward_imports_would_be_seen() -> None:
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"a", "d"}, "d": set(), "e": {"a"}}) == [["a", "b", "c"]]
    assert circles({"a": {"b"}, "b": {"c"}, "c": set()}) == []
    graph = {"vnet.errors": {"emulator.cli"}, "emulator.checks.run": {"emulator.stream", "vnet.errors"}}
    assert violations(graph, LAYERS) == ["vnet.errors -> emulator.cli", "emulator.checks.run -> emulator.stream"]


def test_imports_only_go_down() -> None:
    assert violations({m: o for m, o in imports().items() if m.split(".")[0] != "agents"}, LAYERS) == []
    assert violations(imports(), VNET_LAYERS) == []


def test_every_module_of_the_emulator_is_in_a_layer() -> None:
    rootless = [module for module in imports() if module.startswith("emulator.") and level(module, LAYERS) is None]
    assert rootless == []


def test_the_mathematics_stands_on_roads_alone() -> None:
    may = ("agents.cooperative.cmm", "vnet.roads", *BASIS)
    for module, others in imports().items():
        if module.startswith("agents.cooperative.cmm"):
            assert [other for other in others if not other.startswith(may)] == [], module


@pytest.mark.parametrize(
    ("package", "forbidden"),
    [("agents", "emulator"), ("emulator", "agents"), ("agents", "studies"), ("emulator", "studies")],
)
def test_agents_and_emulator_never_import_each_other_or_the_studies(package: str, forbidden: str) -> None:
    mine = {module: others for module, others in imports().items() if module.split(".")[0] == package}
    assert len(mine) > 3
    broken = {m: [o for o in others if o.split(".")[0] == forbidden] for m, others in mine.items()}
    assert {module: others for module, others in broken.items() if others} == {}


def test_vnet_imports_neither_agents_nor_emulator() -> None:
    outside = {f"{m} -> {o}" for m, others in imports().items() for o in others if m.startswith("vnet.")}
    outside = {each for each in outside if not each.split(" -> ")[1].startswith("vnet")}
    assert outside == {"vnet.cmm -> agents.cooperative.cmm"}, "this one goes with the next version"


EXAMPLES = re.compile(
    r"agents\.(averaging|baselines|centralized|cooperative)|hears.all|cooperative (positioning )?program"
)
NAMING_EXAMPLES = {"vnet/cmm.py", "vnet/runtime/programs.py"}
"""The former place of the mathematics, and the former name of a program."""
MEAN_OF_FIXES = "emulator/checks/faults.py"
"""A check whose figure, the mean of the fixes' errors, has the name of the program's mean."""


FIGURES = re.compile(
    r"common_error_(estimate|covariance|rmse|anees)|\b(deviation|bias|cloud)_m\b|stacked_(common|rmse|deviation)"
    r"|consensus_error|component_(rmse|deviation)_m|[\"'`]mean_m[\"'`]|weight\.v\d|\b[Pp]articles\b"
)
"""Figures, columns and views of the cooperative program."""


def test_neither_vnet_nor_the_emulator_names_an_example_program_or_its_figures() -> None:
    """A program declares all that belongs to it; only the studies are about one."""
    files = [path for package in ("vnet", "emulator") for path in (ROOT / package).rglob("*") if path.is_file()]
    texts = {str(path.relative_to(ROOT)): path.read_text() for path in files if path.suffix != ".pyc"}
    assert len(texts) > 200
    assert {name for name, text in texts.items() if EXAMPLES.search(text)} == NAMING_EXAMPLES
    assert [name for name, text in texts.items() if FIGURES.search(text)] == [MEAN_OF_FIXES]


def test_there_are_no_circles() -> None:
    assert circles(imports()) == []


def test_no_package_holds_more_than_an_eighth_and_no_file_is_too_long() -> None:
    lines = {path: len(path.read_text().splitlines()) for path in source_files().values()}
    own: Counter[Path] = Counter()
    for path, count in lines.items():
        own[path.parent] += count
    package, most = own.most_common(1)[0]
    assert most <= sum(lines.values()) / 8, package
    names = {str(path.relative_to(ROOT)): count for path, count in lines.items() if count > MOST_LINES}
    assert names.keys() - FLAT_LISTS == set(), names


def test_a_session_alone_builds_an_emulation() -> None:
    """Each recipe of its own for making a run is one that can differ from the others."""
    files = [*source_files().values(), *(ROOT / "benchmarks").rglob("*.py"), *(ROOT / "docs").rglob("*.py")]
    called = {
        path.relative_to(ROOT).as_posix()
        for path in files
        if "Emulation(" in (code := path.read_text())
        for node in ast.walk(ast.parse(code))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "Emulation"
    }
    assert called == {"emulator/drivers/session.py"}


def test_no_package_is_called_run() -> None:
    packages = {path.parent.name for path in source_files().values() if path.name == "__init__.py"}
    assert "run" not in packages


def test_no_public_name_of_the_emulator_is_a_submodule_too() -> None:
    """`emulator.run` is to be a function: importing a submodule of that name would rebind it."""
    import emulator

    below = {module.split(".")[1] for module in source_files() if module.startswith("emulator.")}
    assert set(getattr(emulator, "__all__", ())) & below == set()


def test_tests_mirror_the_packages() -> None:
    packages = {path.parent.relative_to(ROOT) for path in source_files().values()}
    folders = {p.parent.relative_to(ROOT / "tests") for p in (ROOT / "tests").glob("*/**/test_*.py")}
    others = {Path(name) for name in ("benchmarks", "docs", "fuzz", "golden", "hunt", "system")}
    assert folders - packages - others == set()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("statement", "heavy"),
    [
        ("import agents.cooperative, agents.host", HEAVY),
        ("import agents.cli, agents.beacon", HEAVY),
        ("from agents.cooperative.cmm import *", ["emulator", "zenoh", "msgpack"]),
        ("import emulator", ["numpy", "pydantic", "zenoh"]),
        ("import emulator.testing.plugin", ["numpy", "zenoh", "pyarrow"]),
        ("import emulator.cli.runs", ["pyarrow", "zenoh", "scipy", "matplotlib", "jinja2", "rerun", "asyncio"]),
        ("import emulator.drivers.hosts.host", ["pydantic", "scipy", "pyarrow", "matplotlib", "jinja2", "rerun"]),
        ("import emulator.cli.execution", ["scipy", "matplotlib", "jinja2", "rerun"]),
    ],
    ids=[
        *("an agent, which costs once a vehicle", "its command", "the estimators", "a user's script"),
        *("each session of pytest", "until a run is announced", "until a host has started its agents"),
        "until a run on the disc radio is judged",
    ],
)
def test_nothing_is_imported_that_takes_long_and_is_not_needed(statement: str, heavy: list[str]) -> None:
    """scipy, for one, serves maps, fading and tests of significance."""
    code = f"{statement}; import sys; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_every_file_opens_with_what_it_is_for() -> None:
    silent = [
        str(path.relative_to(ROOT))
        for path in source_files().values()
        if (code := path.read_text()) and not code.startswith('"""')
    ]
    assert silent == []


def test_the_smallest_useful_program_is_small() -> None:
    assert len((ROOT / "agents" / "beacon.py").read_text().splitlines()) <= 42
