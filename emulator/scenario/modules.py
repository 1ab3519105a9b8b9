"""The modules that a scenario names (programs, checks, rules): beside the scenario, or in the current folder.

Nothing is imported here. What a scenario names as a file becomes a module and its folder, so that whoever imports
it needs only the names and `program.folders`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from emulator.scenario.fault_families import DEFAULT_RULE, Fault, OwnRule
from emulator.scenario.program import Program, split_file
from emulator.scenario.world import WorldSection
from vnet.errors import ScenarioError, shown
from vnet.runtime.own_packages import OWN

DEFAULT_FUNCTIONS = {
    "program.entry": "main",
    "program.checks": "check",
    "fault.rule": DEFAULT_RULE,
    "network.function": "network",
    "world.sensor.model": "sensor",
}
"""Functions of a file that is named without one, by key."""


def with_modules(program: Program, base: Path | None, checks: Sequence[str] = (), source: str = "") -> Program:
    """Return `[program]` with every file as a module, with `checks` after its own, and with absolute `folders`.

    Modules are looked for in `program.folders`, in `base`, the folder of the scenario, and in the current one.
    `source` is what messages call the scenario. Raises ScenarioError for a file or folder that is not there.
    """
    return with_rules(program, (), base, checks, source)[0]


def with_rules(
    program: Program, faults: Sequence[Fault], base: Path | None, checks: Sequence[str] = (), source: str = ""
) -> tuple[Program, tuple[Fault, ...]]:
    """Return the same, and the faults with the rules of the user's own as modules in `program.folders`."""
    found = _Modules(program.folders, base, f"{source}: " if source else "")
    exceptions = [
        each.model_copy(update={"entry": found.entry("program.entry", each.entry)}) for each in program.exceptions
    ]
    data = {
        "entry": found.entry("program.entry", program.entry),
        "exceptions": tuple(exceptions),
        "checks": tuple(dict.fromkeys(found.entry("program.checks", each) for each in [*program.checks, *checks])),
    }
    ruled = tuple(found.fault(each) for each in faults)
    return program.model_copy(update={**data, "folders": found.folders}), ruled


def with_network(program: Program, function: str, base: Path | None, source: str) -> tuple[Program, str]:
    """Return `[program]` with the folder of the function of `[network]`, and that as `module:function`.

    Raises ScenarioError for a file that is not there.
    """
    found = _Modules(program.folders, base, f"{source}: " if source else "")
    entry = found.entry("network.function", function)
    return program.model_copy(update={"folders": found.folders}), entry


def with_sensors(
    program: Program, world: WorldSection, base: Path | None, source: str
) -> tuple[Program, WorldSection]:
    """Return `[program]` with the folders of the models of `[world.sensor]`, and `[world]` with them as modules.

    Raises ScenarioError for a file that is not there.
    """
    found = _Modules(program.folders, base, f"{source}: " if source else "")
    sensors = {
        name: sensor.model_copy(update={"model": found.entry("world.sensor.model", sensor.model)})
        for name, sensor in world.sensor.items()
    }
    return program.model_copy(update={"folders": found.folders}), world.model_copy(update={"sensor": sensors})


class _Modules:
    """The folders of a scenario's modules, as they are found."""

    def __init__(self, given: Iterable[Path], base: Path | None, source: str) -> None:
        self._source = source
        self._given = [self._folder(path, base) for path in given]
        self._searched = list(dict.fromkeys([*self._given, *filter(None, [base]), Path.cwd()]))
        self._of_files: dict[str, Path] = {}
        self._holding: set[Path] = set()

    @property
    def folders(self) -> tuple[Path, ...]:
        """Folders of the files; then those that were given or hold a module, in the order of the search."""
        held = [path for path in self._searched if path in self._given or path in self._holding]
        return tuple(dict.fromkeys(path.resolve() for path in [*self._of_files.values(), *held]))

    def entry(self, key: str, entry: str) -> str:
        """Return an entry as `module:function`."""
        if (file := split_file(entry)) is not None:
            return self._file(key, entry, *file)
        parts = entry.partition(":")[0].split(".")
        if parts[0] not in OWN:
            self._holding.update(path for path in self._searched if _holds(path, parts))
        return entry

    def fault(self, fault: Fault) -> Fault:
        """Return a fault with its rule, if it has one, as `module:function`."""
        if not isinstance(fault, OwnRule):
            return fault
        return fault.model_copy(update={"rule": self.entry("fault.rule", fault.rule)})

    def _file(self, key: str, entry: str, name: str, function: str) -> str:
        problem = f"{self._source}{key} = {shown(entry)}"
        try:
            found = next((path for folder in self._searched if (path := folder / name).is_file()), None)
        except (OSError, ValueError):
            found = None
        if found is None:
            where = " or in ".join(dict.fromkeys(str(folder.resolve()) for folder in self._searched))
            raise ScenarioError(f"{problem}: no such file in {where}")
        if not found.stem.replace(" ", "_").isidentifier():
            raise ScenarioError(f"{problem}: not importable: name the file with letters, digits, blanks and _ only")
        folder = self._of_files.setdefault(found.stem, found.parent)
        if folder.resolve() != found.parent.resolve():
            raise ScenarioError(f"{problem}: there is another {found.name} in {folder}: rename one of them")
        return f"{found.stem}:{function or DEFAULT_FUNCTIONS[key]}"

    def _folder(self, path: Path, base: Path | None) -> Path:
        folder = (base or Path()) / path
        try:
            if folder.is_dir():
                return folder.resolve()
        except (OSError, ValueError, RuntimeError):
            pass
        raise ScenarioError(f"{self._source}program.folders: {shown(str(path))}: no such folder")


def _holds(folder: Path, parts: Sequence[str]) -> bool:
    """Return whether a folder holds a module, which is a file or a package."""
    path = folder.joinpath(*parts)
    try:
        return path.with_suffix(".py").is_file() or (path / "__init__.py").is_file()
    except (OSError, ValueError):
        return False
