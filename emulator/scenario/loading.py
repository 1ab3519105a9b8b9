"""Reading a scenario from a file, a shipped name, plain data or a run's folder, and writing one.

TOML that others wrote is read within bounds: plain values only, so that what is read can be written again. The
standard library's reader takes time in the square of a dotted key's length, overflows the stack where values are
nested deeply, and has dates and integers of any length, which neither the wire nor a run's file can carry.

No program, check or rule is imported here. What a scenario names as a file becomes a module and its folder, so that
whoever imports it needs only the names and `program.folders`.
"""

from __future__ import annotations

import hashlib
import inspect
import json
import math
import os
import re
import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from copy import deepcopy
from datetime import date, time
from functools import wraps
from pathlib import Path, PurePath
from typing import Any, ParamSpec, TypeVar
from zipfile import is_zipfile

import tomli_w
from pydantic import ValidationError

from emulator.scenario.faults import DEFAULT_RULE, RENAMED_SELECTORS, Fault, OwnRule
from emulator.scenario.network import LIBSUMO, input_files, libsumo_build
from emulator.scenario.program import Program, from_here, split_file, with_programs
from emulator.scenario.scenario import Scenario
from emulator.scenario.sections import Section, first_problem
from vnet.bounded import read_bounded
from vnet.errors import OverrideError, ScenarioError, did_you_mean, first_names, printable, shown
from vnet.runtime.own_packages import OWN

LARGEST_BYTES = 4 * 2**20
"""Largest size of a file; a matrix of links for a thousand vehicles takes three of the four megabytes."""
DEEPEST = 32
"""Largest nesting depth of tables and arrays."""
NOT_PLAIN = "a number, a boolean, a text, a list or a table is needed"
_INTEGERS = range(-(2**63), 2**64)  # what msgpack can carry

_KEY = r"""(?:[A-Za-z0-9_-]++|"[^"\n]*+"|'[^'\n]*+')"""
_LONG_KEY = re.compile(rf"(?<![A-Za-z0-9_-]){_KEY}(?:[ \t]*+\.[ \t]*+{_KEY}){{{DEEPEST}}}")
FOLDER = Path(__file__).parent.parent / "scenarios"
"""In a clone a link to its folder `scenarios/`; in an installation that folder's files."""
DEFAULT_FUNCTIONS = {
    "program.entry": "main",
    "program.checks": "check",
    "fault.rule": DEFAULT_RULE,
    "network.function": "network",
    "world.sensor.model": "sensor",
}
"""Functions of a file that is named without one, by key."""
P = ParamSpec("P")
T = TypeVar("T")
AnySection = TypeVar("AnySection", bound=Section)
Source = str | Path | Mapping[str, Any] | Scenario
DATA = Path("scenario")
"""The name of plain data in messages. Relative paths in it are taken from the current folder."""


def read_toml(path: Path) -> dict[str, Any]:
    """The tables of a file. Raises OSError, and ValueError with the reason where it is not valid or not plain."""
    return parse_toml(read_bounded(path, LARGEST_BYTES).decode("utf-8-sig"))


def parse_toml(text: str) -> dict[str, Any]:
    """The tables of a text. Raises ValueError with the reason where it is not valid TOML."""
    if _LONG_KEY.search(text):
        raise ValueError(f"a key of more than {DEEPEST} parts")
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise ValueError(f"nested more than {DEEPEST} deep") from None


def check_plain(value: Any, key: str = "", depth: int = 0) -> None:
    """Raises ValueError, with the key, where something is not plain: text, finite, within 64 bits, not too deep."""
    if depth > DEEPEST:
        raise ValueError(f"{printable(key)}: nested more than {DEEPEST} deep")
    if isinstance(value, dict):
        for name, entry in value.items():
            check_plain(name, key, depth)
            check_plain(entry, f"{key}.{name}" if key else name, depth + 1)
    elif isinstance(value, list):
        for entry in value:
            check_plain(entry, key, depth + 1)
    elif problem := _problem(value):
        raise ValueError(f"{printable(key)} = {shown(value)}: {problem}")


def _problem(value: Any) -> str:
    """Return the problem of a value that is no table or array; "" if it has none."""
    if isinstance(value, bool):
        return ""
    if isinstance(value, int):
        return "" if value in _INTEGERS else "an integer of at most 64 bits is needed"
    if isinstance(value, float):
        return "" if math.isfinite(value) else "a finite number is needed"
    if not isinstance(value, str):
        return "dates and times are written as text, in quotes" if isinstance(value, (date, time)) else NOT_PLAIN
    try:
        value.encode()
    except UnicodeEncodeError:
        return "text in UTF-8 is needed"
    return ""


def shipped_names() -> list[str]:
    """Return the names of the scenarios that are shipped, sorted."""
    return sorted(path.stem for path in FOLDER.glob("*.toml"))


def find_scenario(name: str | Path) -> Path:
    """Return the path of a scenario, given a path or the name of one that is shipped.

    A path that exists wins over a shipped name. A name that is neither is returned as it is.
    """
    path = Path(name)
    return FOLDER / f"{name}.toml" if str(name) in shipped_names() and not _exists(path) else path


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except (OSError, ValueError):  # a name too long, or with a NUL
        return True


def apply_override(data: dict[str, Any], override: str) -> None:
    """Change plain data by `section.key=value`: TOML, or a bare word. Raises ScenarioError."""
    key, equals, text = override.partition("=")
    parts = key.strip().split(".")
    if not equals or not 2 <= len(parts) <= DEEPEST or not all(parts):
        raise ScenarioError(
            f"--set {printable(override)}: write it as section.key=value, for example radio.loss=0.3"
        )
    table = data
    for part in parts[:-1]:
        table = table.setdefault(part, {})
        if not isinstance(table, dict):
            raise ScenarioError(f"--set {printable(override)}: {printable(part)} is not a section")
    table[parts[-1]] = _value(text)


def wrong_value(path: PurePath, problem: str, overrides: Sequence[str]) -> ScenarioError:
    """Return the error for a problem that begins with its key: of the override of that key, else of the file.

    A problem of several keys begins with their section, and with the one that is to blame if there is one.
    """
    found = re.match(r"([^\s:=]+)(?:: ([\w.]+) = )?", problem)
    named = "".join(f"{part}." for part in found.groups() if part) if found else "."
    keys = [override.partition("=")[0].strip() for override in overrides]
    of_key = [key for key in keys if named.startswith(f"{key}.")]
    of_section = [key for key in keys if f"{key}.".startswith(named)]
    if of_key or len(of_section) == 1:  # of several in a section nobody knows which is to blame
        return OverrideError(problem, (of_key or of_section)[0])
    return ScenarioError(f"{path}: {problem}")


def as_overrides(changes: Mapping[str, Any]) -> list[str]:
    """Return changes, values by `section.key`, as overrides. Raises ScenarioError for what TOML cannot hold."""
    return [f"{key}={_toml(key, value)}" for key, value in changes.items()]


def _toml(key: str, value: Any) -> str:
    """A value in TOML's syntax, in one line; numpy's numbers and arrays become Python's."""
    value = value.tolist() if hasattr(value, "tolist") else value
    if isinstance(value, Mapping):
        pairs = (f"{json.dumps(str(name))} = {_toml(f'{key}.{name}', each)}" for name, each in value.items())
        return "{ " + ", ".join(pairs) + " }"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(_toml(key, each) for each in value) + "]"
    if not isinstance(value, (bool, int, float, str, PurePath)):
        raise ScenarioError(f"{key} = {shown(value)}: {NOT_PLAIN}")
    try:
        check_plain(str(value) if isinstance(value, PurePath) else value)
        return json.dumps(value if isinstance(value, (bool, int, float)) else str(value), ensure_ascii=False)
    except ValueError as error:
        raise ScenarioError(f"{key} = {shown(value)}: {str(error).rpartition(': ')[2]}") from None


def parse_values(key: str, text: str) -> list[Any]:
    """Return values that are separated by commas, each in TOML's syntax or a bare word. Raises ScenarioError."""
    try:
        values = parse_toml(f"values = [{text}]")["values"]
    except ValueError:
        values = [_value(part) for part in text.split(",")]
    if not values or "" in values:
        raise ScenarioError(f"{key}={printable(text)}: write its values with commas between, as radio.loss=0,0.1")
    return list(values)


def _value(text: str) -> Any:
    """A value in TOML's syntax, a number such as .5, or a bare word."""
    text = re.sub(r"^(\s*[+-]?)(\.[0-9]+(e[+-]?[0-9]+)?\s*)$", r"\g<1>0\2", text, flags=re.IGNORECASE)
    try:
        (value,) = parse_toml(f"value = {text}").values()  # not what further lines would set
        return value
    except ValueError:
        return text.strip()


def with_modules(
    program: Program, faults: Sequence[Fault], base: Path | None, checks: Sequence[str] = (), source: str = ""
) -> tuple[Program, tuple[Fault, ...]]:
    """Return `[program]` and faults with every file as a module, `checks` after its own, and absolute `folders`.

    Modules are looked for in `program.folders`, in `base`, the folder of the scenario, and in the current one.
    `source` is what messages call the scenario. Raises ScenarioError for a file or folder that is not there.
    """
    found = _Modules(program.folders, base, source)
    exceptions = [
        each.model_copy(update={"entry": found.entry("program.entry", each.entry)}) for each in program.exceptions
    ]
    for command in program.all_commands:
        found.command(command)
    data = {
        "entry": found.entry("program.entry", program.entry),
        "exceptions": tuple(exceptions),
        "checks": tuple(dict.fromkeys(found.entry("program.checks", each) for each in [*program.checks, *checks])),
    }
    ruled = tuple(found.fault(each) for each in faults)
    return program.model_copy(update={**data, "folders": found.folders}), ruled


class _Modules:
    """The folders of a scenario's modules, as they are found."""

    def __init__(self, given: Iterable[Path], base: Path | None, source: str) -> None:
        self._source = f"{source}: " if source else ""
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

    def command(self, words: Sequence[str]) -> None:
        """Take note of the folders of the files of a command. Raises ScenarioError for a script that is missing."""
        for word in words[:2]:
            if split_file(word) is not None and not Path(word).is_absolute():
                folder = self._holder("program.command", word)
                self._holding.add(folder)
            else:
                with suppress(OSError, ValueError):  # no name of a folder
                    self._holding.update(each for each in self._searched if (each / word / "__main__.py").is_file())

    def fault(self, fault: Fault) -> Fault:
        """Return a fault with its rule, if it has one, as `module:function`."""
        if not isinstance(fault, OwnRule):
            return fault
        return fault.model_copy(update={"rule": self.entry("fault.rule", fault.rule)})

    def _file(self, key: str, entry: str, name: str, function: str) -> str:
        problem = f"{self._source}{key} = {shown(entry)}"
        found = self._holder(key, name, entry) / name
        if not found.stem.replace(" ", "_").isidentifier():
            raise ScenarioError(f"{problem}: not importable: name the file with letters, digits, blanks and _ only")
        folder = self._of_files.setdefault(found.stem, found.parent)
        if folder.resolve() != found.parent.resolve():
            raise ScenarioError(f"{problem}: there is another {found.name} in {folder}: rename one of them")
        return f"{found.stem}:{function or DEFAULT_FUNCTIONS[key]}"

    def _holder(self, key: str, name: str, entry: str = "") -> Path:
        """Return the first folder with a file of this name. Raises ScenarioError if there is none."""
        try:
            found = next((folder for folder in self._searched if (folder / name).is_file()), None)
        except (OSError, ValueError):
            found = None
        if found is None:
            where = " or in ".join(dict.fromkeys(str(folder.resolve()) for folder in self._searched))
            raise ScenarioError(f"{self._source}{key} = {shown(entry or name)}: no such file in {where}")
        return found

    def _folder(self, path: Path, base: Path | None) -> Path:
        folder = (base or Path()) / path
        try:
            if folder.is_dir() or (folder.is_file() and is_zipfile(folder)):  # Python imports from both
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


def load_scenario(path: Path, overrides: Sequence[str] = (), checks: Sequence[str] = ()) -> Scenario:
    """Read a scenario, from its path or by its name if it is shipped, and apply `section.key=value` overrides.

    Values are in TOML syntax; bare words are strings. Relative paths of files are taken from the scenario's own
    folder; programs and checks are looked for there, and then in the current folder. `checks` come after those of
    the file. Raises `ScenarioError`.
    """
    path = find_scenario(path)
    try:
        data = read_toml(path)
    except OSError as error:
        raise ScenarioError(f"{path}: cannot be read: {error.strerror}{_instead(path)}") from None
    except ValueError as error:
        if path.suffix == ".py":
            raise ScenarioError(f"{path}: a program; a scenario is needed, and --program {path}") from None
        raise ScenarioError(f"{path}: not valid TOML: {printable(str(error), 300)}") from None
    if "inputs" in data:  # a run has recorded it
        data = with_new_names(data)
    recorded_digests, _ = data.pop("inputs", {}), data.pop("code", None)
    if not isinstance(recorded_digests, dict):
        raise ScenarioError(f"{path}: inputs = {shown(recorded_digests)}: a table of digests is needed")
    return scenario_from(data, path, overrides, recorded_digests, checks)


def scenario_from(
    data: dict[str, Any],
    path: Path,
    overrides: Sequence[str] = (),
    digests: Mapping[str, str] | None = None,
    checks: Sequence[str] = (),
) -> Scenario:
    """Return the scenario of plain data, which it changes by the overrides; `path` is what messages call it.

    `checks` come after those of the data. Raises ScenarioError, also for an input file that has not the digest
    recorded for it.
    """
    for override in overrides:
        apply_override(data, override)
    try:
        check_plain(data)
        scenario = Scenario.model_validate(data)
    except ValidationError as error:
        raise wrong_value(path, first_problem(error, Scenario), overrides) from None
    except ValueError as error:
        raise wrong_value(path, str(error), overrides) from None
    scenario = with_absolute_paths(scenario, path)
    try:
        scenario = with_own_modules(scenario, path.parent, checks, str(path))
    except ScenarioError as error:
        raise wrong_value(path, str(error).removeprefix(f"{path}: "), overrides) from None
    recorded = digests or {}
    for name, digest in input_digests(scenario).items():
        if recorded.get(name, digest) != digest:
            if name == LIBSUMO:
                raise ScenarioError(f"{path}: recorded with libsumo {shown(recorded[name])}; here is {digest!r}")
            raise ScenarioError(f"{path}: {name} has changed since this run was recorded (sha256 differs)")
    return scenario


def with_own_modules(
    scenario: Scenario, base: Path | None, checks: Sequence[str] = (), source: str = ""
) -> Scenario:
    """Return a scenario whose files of the user's own are modules; programs of roadside units are exceptions.

    The arguments and exceptions are those of `with_modules`.
    """
    program = with_programs(scenario.program, scenario.roadside)
    program, faults = with_modules(program, scenario.fault, base, checks, source)
    network, world = scenario.network, scenario.world
    if network.function is not None:
        found = _Modules(program.folders, base, source)
        network = network.model_copy(update={"function": found.entry("network.function", network.function)})
        program = program.model_copy(update={"folders": found.folders})
    if world.sensor:
        found = _Modules(program.folders, base, source)
        sensors = {
            name: sensor.model_copy(update={"model": found.entry("world.sensor.model", sensor.model)})
            for name, sensor in world.sensor.items()
        }
        world = world.model_copy(update={"sensor": sensors})
        program = program.model_copy(update={"folders": found.folders})
    parts = {"program": program, "fault": faults, "network": network, "world": world}
    return scenario.model_copy(update=parts)


def _instead(path: Path) -> str:
    """Return a hint at the file that may have been meant by a path."""
    try:
        inside = sorted(each.name for each in path.glob("*.toml"))
        if inside:
            return f"; in it there are {first_names(inside)}"
        return did_you_mean(path.name, [*(each.name for each in path.parent.glob("*.toml")), *shipped_names()])
    except (OSError, ValueError):
        return ""


def dump_scenario(scenario: Scenario, digests: Mapping[str, Mapping[str, str]] | None = None) -> str:
    """The scenario as TOML with every default, and `digests`, by section; without any, those of its inputs."""
    data = scenario.model_dump(mode="json", exclude_none=True)
    data |= {"inputs": input_digests(scenario)} if digests is None else digests
    return tomli_w.dumps(data)


def input_files_of(scenario: Scenario) -> list[Path]:
    """Return the files that the scenario names for its world and its radio."""
    read = (
        scenario.network.path,
        scenario.radio.links,
        scenario.radio.buildings and scenario.radio.buildings.path,
        scenario.map and scenario.map.path,
        scenario.world.common_error.path,
    )
    return [path for path in read if isinstance(path, Path)]


def input_digests(scenario: Scenario) -> dict[str, str]:
    """SHA-256 of each file that the scenario reads, by path; of SUMO's also those that its configuration names.

    Where SUMO is stepped with the run, `libsumo` is its version and build.
    """
    paths = input_files_of(scenario)
    if isinstance(scenario.run.tape, Path):
        paths.append(scenario.run.tape)
    if scenario.network.kind == "sumo" and scenario.network.path is not None:
        paths += input_files(scenario.network.path)
    build = libsumo_build() if scenario.network.step else None
    return {str(path): _sha256(path) for path in paths} | ({} if build is None else {LIBSUMO: build})


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def with_absolute_paths(section: AnySection, scenario_path: Path, key: str = "") -> AnySection:
    """Return a section in which the paths of files are absolute, those of the sections within it, too."""
    absolute: dict[str, Any] = {}
    for name, value in section:
        if isinstance(value, Path):
            absolute[name] = _absolute(value, f"{key}{name}", scenario_path)
        elif isinstance(value, Section):
            absolute[name] = with_absolute_paths(value, scenario_path, f"{key}{name}.")
    return section.model_copy(update=absolute)


def _absolute(given: Path, key: str, scenario_path: Path) -> Path:
    problem = f"{scenario_path}: {key} = {shown(str(given))}"
    try:
        path = (scenario_path.parent / given).resolve()
        found = path.is_file()
    except (OSError, ValueError, RuntimeError):  # a name too long, with a NUL, or links that lead in a circle
        raise ScenarioError(f"{problem}: cannot be the name of a file") from None
    if not found:
        raise ScenarioError(f"{problem}: no such file: {path}")
    if not os.access(path, os.R_OK):
        raise ScenarioError(f"{problem}: not readable: {path}")
    return path


def parse_recorded_scenario(text: str, path: Path) -> Scenario:
    """Return the scenario of a run's folder from its text; the files that it names need not be there any more.

    `path` is what messages call it. Raises `ScenarioError`.
    """
    try:
        data = parse_toml(text)
        for digests in ("inputs", "code"):
            data.pop(digests, None)
        return Scenario.model_validate(with_new_names(data))
    except ValidationError as error:
        raise ScenarioError(f"{path}: {first_problem(error, Scenario)}") from None
    except ValueError as error:
        raise ScenarioError(f"{path}: not valid TOML: {printable(str(error), 300)}") from None


def recorded_code(path: Path) -> dict[str, Any]:
    """Return the section `[code]` of a file, in which a run has recorded its code; empty if there is none."""
    code = read_toml(find_scenario(path)).get("code")
    return code if isinstance(code, dict) else {}


def with_new_names(data: dict[str, Any]) -> dict[str, Any]:
    """Return the data of a scenario that a run has recorded, with today's names."""
    faults = data.get("fault")
    if not isinstance(faults, list):
        return data
    return {**data, "fault": [_with_new_selectors(fault) for fault in faults]}


def _with_new_selectors(fault: Any) -> Any:
    if not isinstance(fault, dict):
        return fault
    return {
        name: {RENAMED_SELECTORS.get(key, key): each for key, each in value.items()}
        if isinstance(value, dict)
        else value
        for name, value in fault.items()
    }


def checked_scenario(data: Mapping[str, Any]) -> Scenario:
    """Return data as a scenario. Raises ScenarioError, which names the first problem."""
    try:
        return Scenario.model_validate(data)
    except ValidationError as error:
        raise ScenarioError(first_problem(error, Scenario)) from None


def scenario_of(source: Source, changes: Mapping[str, Any], checks: Sequence[str] = ()) -> Scenario:
    """Return the scenario of a source with `changes`, values by `section.key`, and with `checks` after its own.

    None changes nothing. Raises ScenarioError that names the key, the value and what is allowed.
    """
    checks = [from_here(check) for check in checks]
    overrides = as_overrides({key: value for key, value in changes.items() if value is not None})
    if isinstance(source, (str, Path)):
        return load_scenario(Path(source), overrides, checks)
    if isinstance(source, Scenario):
        # Without defaults: another `kind` of a section has others.
        data = source.model_dump(mode="json", exclude_none=True, exclude_defaults=True)
        if "max_payload_bytes" not in source.radio.model_fields_set:  # it follows from the MAC
            data.get("radio", {}).pop("max_payload_bytes", None)
        if "jitter_ms" in source.radio.model_fields_set:  # whose default is that of the kind of program
            data.setdefault("radio", {})["jitter_ms"] = source.radio.jitter_ms
        if "seed" in source.network.model_fields_set:  # without one, that of a run may draw the network
            data.setdefault("network", {})["seed"] = source.network.seed
        source = data
    if not isinstance(source, Mapping):
        raise ScenarioError(f"scenario = {shown(source)}: a path, a shipped scenario's name, or a dict is needed")
    return scenario_from(deepcopy(dict(source)), DATA, overrides, checks=checks)


def hinting(function: Callable[P, T]) -> Callable[P, T]:
    """Have a function say which argument may have been meant by one that it does not have."""
    known = inspect.signature(function).parameters

    @wraps(function)
    def call(*arguments: P.args, **options: P.kwargs) -> T:
        for name in options:
            if name not in known:
                raise TypeError(f"{function.__name__}(): no argument {name!r}{did_you_mean(name, known)}")
        return function(*arguments, **options)

    return call
