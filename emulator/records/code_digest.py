"""SHA-256 of the code that a run depends on: the program, rules of the user's own, and vnet itself.

The program is every module that its entry leads to by `import`, wherever in a module that stands, or by a constant
that declares others, from outside the standard library and site-packages; modules of the entry's own package count
wherever they are installed. Sources are read, and nothing is imported: whoever records a program need not run it.
"""

from __future__ import annotations

import ast
import hashlib
import importlib.util
import sys
import sysconfig
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache, lru_cache
from importlib.machinery import SOURCE_SUFFIXES, FileFinder, ModuleSpec, PathFinder, SourceFileLoader
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vnet.gateway import python_words

if TYPE_CHECKING:  # slow to import, and hosts need no scenario
    from emulator.scenario.scenario import Scenario

SCRIPT = ".py"
OWN = ("vnet", "emulator")
"""The packages that are vnet itself."""
DECLARING = frozenset({"DECLARES", "CHECKS", "FIGURES", "REFERENCE", "PUBLISHED"})
"""Constants that name modules, or `module:name` (`emulator.scenario.own_functions`)."""
_SITE = ("purelib", "platlib", "stdlib", "platstdlib")
_SITE_NAMES = frozenset({"site-packages", "dist-packages"})


def code_digests(scenario: Scenario) -> dict[str, str]:
    """Return digests of the `program` of a scenario, its exceptions included, of its `rules`, and of `vnet`.

    A program that cannot be found has none.
    """
    return digests_of(sources_of(scenario), scenario.program.folders) | rule_digests(scenario)


def rule_digests(scenario: Scenario) -> dict[str, str]:
    """Return the entries of a scenario's rules and their digest; nothing where there are none."""
    entries = rules_of(scenario)
    digest = program_digest(entries, scenario.program.folders) if entries else None
    return {"rule_entries": " ".join(entries), "rules": digest} if digest else {}


def rules_of(scenario: Scenario) -> tuple[str, ...]:
    """Return the entries of a scenario's rules, sensors, checks and network of the user's own, sorted."""
    from emulator.scenario.faults import OwnRule

    entries = {fault.rule for fault in scenario.fault if isinstance(fault, OwnRule)}
    network = scenario.network.function
    sensors = {sensor.model for sensor in scenario.world.sensor.values()}
    return tuple(sorted({*entries, *sensors, *scenario.program.checks, *([network] if network else [])}))


def digests_of(entries: tuple[str, ...], folders: tuple[Path, ...] = ()) -> dict[str, str]:
    """Return the same for the entries of a scenario's programs, looked for in its folders too."""
    digest = program_digest(entries, folders)
    return {"entries": " ".join(entries), **({"program": digest} if digest else {}), "vnet": vnet_digest()}


def changed_code(recorded: Mapping[str, Any], now: Mapping[str, str]) -> str:
    """Say what has changed of the code since `recorded`; "" if nothing, or if these are other programs."""
    if recorded.get("entries") != now["entries"]:
        return ""
    names = {"program": f"the program {now['entries'].replace(' ', ', ')}", "vnet": "vnet"}
    if recorded.get("rule_entries") == now.get("rule_entries") is not None:
        names["rules"] = f"the functions {now['rule_entries'].replace(' ', ', ')}"
    changed = [
        words for key, words in names.items() if key in recorded and key in now and recorded[key] != now[key]
    ]
    return f"{' and '.join(changed)} changed since this run was recorded" if changed else ""


def entries_of(scenario: Scenario) -> tuple[str, ...]:
    """The entries of all programs of a scenario that vnet loads, sorted."""
    program = scenario.program
    if scenario.has_gateways:
        return ()
    return tuple(sorted({program.entry, *(exception.entry for exception in program.exceptions)}))


def sources_of(scenario: Scenario) -> tuple[str, ...]:
    """The same, but in the place of Zenoh programs' commands their modules, and their scripts as paths.

    Other commands than Python's, and what is named by `{id}`, have none.
    """
    from emulator.scenario.program import PYTHON_NAME

    program = scenario.program
    if program.kind != "zenoh":
        return entries_of(scenario)
    found = set()
    for command in program.all_commands:
        is_python = PYTHON_NAME.fullmatch(Path(command[0]).name)
        words = python_words(command) if is_python else [command[0]]
        if words[:1] == ["-m"]:
            found.add(f"{words[1]}:main")
        elif words and words[0].endswith(SCRIPT):
            found.add(words[0])
    return tuple(sorted(each for each in found if "{" not in each))


def program_digest(entries: Iterable[str], folders: Iterable[Path] = ()) -> str | None:
    """One digest of the programs with these entries, or of scripts; None if one cannot be found.

    They are looked for among what is installed, in `folders`, and in the current folder.
    """
    modules: dict[str, Path | None] = {}
    searched = [*map(str, folders), str(Path.cwd())]
    for entry in entries:
        name = entry.partition(":")[0]
        if not name.endswith(SCRIPT):
            for module in (name, f"{name}.__main__"):
                _collect(module, name.partition(".")[0], modules, searched)
        elif path := next((file for folder in searched if (file := Path(folder) / name).is_file()), None):
            beside: dict[str, Path | None] = {}  # other scripts have modules of the same names beside them
            for imported in _imported(path.stem, path):
                _collect(imported, "", beside, [str(path.parent), *searched])
            modules |= {name: path} | {f"{name}/{module}": found for module, found in beside.items()}
        if modules.get(name) is None:
            return None
    digest = hashlib.sha256()
    for name, path in sorted(modules.items()):
        if path is not None:
            digest.update(name.encode() + b"\0" + hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()


@cache
def vnet_digest() -> str:
    """One digest of vnet's own sources."""
    digest = hashlib.sha256()
    for package in OWN:
        spec = importlib.util.find_spec(package)
        for folder in (spec.submodule_search_locations or []) if spec else []:
            for path in sorted(Path(folder).rglob("*.py")):
                name = path.relative_to(folder)
                digest.update(f"{package}/{name.as_posix()}\0".encode())
                digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()


def _collect(name: str, own: str, modules: dict[str, Path | None], searched: list[str]) -> None:
    """Add a module, its packages, and all that they import, to `modules`: the source of each, or None if foreign.

    `own` is the package of the entry; `searched` are folders beside what is installed.
    """
    waiting = [name]
    while waiting:
        parts = waiting.pop().split(".")
        for length in range(1, len(parts) + 1):
            module = ".".join(parts[:length])
            if module in modules:
                continue
            modules[module] = path = _source(module, own, searched)
            if path is not None:
                waiting += _imported(module, path)


def _source(module: str, own: str, searched: list[str]) -> Path | None:
    """The source of a module of the program; None if it is another's, or no source."""
    top = module.partition(".")[0]
    if top in OWN or top in sys.stdlib_module_names:
        return None
    spec = _find(module, searched)
    if spec is None or spec.origin is None or not spec.origin.endswith(".py"):
        return None
    path = Path(spec.origin)
    return path if top == own or not _is_installed(path) else None


def _find(module: str, searched: list[str]) -> ModuleSpec | None:
    """Find a module without importing it or its packages."""
    parent, _, _ = module.rpartition(".")
    try:
        if not parent:
            spec = importlib.util.find_spec(module)
            if spec is None or spec.origin is None:  # a mere folder of that name, behind which a module wins
                spec = PathFinder.find_spec(module, [*sys.path, *searched]) or spec
            return spec
        package = _find(parent, searched)
        folders = None if package is None else package.submodule_search_locations
        return None if folders is None else _find_in(list(folders), module)
    except (ImportError, ValueError):
        return None


def _find_in(folders: list[str], module: str) -> ModuleSpec | None:
    """Find a module of a package by the package's folders.

    `PathFinder` needs the package imported where the module is a package without `__init__.py`.
    """
    portions: list[str] = []
    for folder in folders:
        spec = FileFinder(folder, (SourceFileLoader, SOURCE_SUFFIXES)).find_spec(module)
        if spec is not None and spec.loader is not None:
            return spec
        portions += (spec.submodule_search_locations or []) if spec is not None else []
    if not portions:
        return None
    namespace = ModuleSpec(module, None, is_package=True)
    namespace.submodule_search_locations = portions
    return namespace


def _is_installed(path: Path) -> bool:
    """Return whether a file is of the standard library, or was installed, in this environment or another."""
    return not _SITE_NAMES.isdisjoint(path.parts) or any(path.is_relative_to(f) for f in _installed_folders())


@cache
def _installed_folders() -> tuple[Path, ...]:
    return tuple(Path(sysconfig.get_path(name)) for name in _SITE)


def _imported(module: str, path: Path) -> Sequence[str]:
    """Names that a source imports or declares, absolute; one imported from a package may be a module, or not."""
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    try:
        return _names_imported(package, path.read_bytes())
    except (OSError, SyntaxError, ValueError, RecursionError, MemoryError):
        return ()


@lru_cache(1024)
def _names_imported(package: str, source: bytes) -> tuple[str, ...]:
    """Names that a source of a package imports: parsed once in a process that runs many scenarios."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # they are the program's, and Python tells them when it runs
        tree = ast.parse(source)
    names: list[str] = []
    for node in _statements(tree):
        if isinstance(node, ast.Import):
            names += (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            parts = package.split(".")
            start = ".".join(parts[: len(parts) - node.level + 1]) if node.level else ""
            base = ".".join(part for part in (start, node.module) if part)
            if base:
                names.append(base)
                names += (f"{base}.{alias.name}" for alias in node.names if alias.name != "*")
        elif isinstance(node, (ast.Assign, ast.AnnAssign, ast.AugAssign)) and node.value is not None:
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            if any(isinstance(target, ast.Name) and target.id in DECLARING for target in targets):
                named = (each.value for each in ast.walk(node.value) if isinstance(each, ast.Constant))
                names += (each.partition(":")[0] for each in named if isinstance(each, str))
    return tuple(names)


def _statements(tree: ast.Module) -> Iterator[ast.AST]:
    """Yield all statements of a source: `ast.walk` goes through expressions too, and takes five times as long."""
    waiting: list[ast.AST] = [tree]
    while waiting:
        node = waiting.pop()
        for name in ("body", "orelse", "finalbody", "handlers", "cases"):
            within = getattr(node, name, ())
            if isinstance(within, list):
                yield from within
                waiting += within
