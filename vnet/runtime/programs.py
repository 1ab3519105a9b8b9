"""Loading of vehicle programs by their entry, `package.module:function`."""

from __future__ import annotations

import importlib
import inspect
import os
import sys
from collections.abc import Awaitable, Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import Context, ContextVar, copy_context
from pathlib import Path
from threading import get_ident
from types import MappingProxyType, ModuleType
from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

from vnet.errors import ProgramError, did_you_mean
from vnet.extras import missed_by
from vnet.runtime.error_text import error_line
from vnet.runtime.own_packages import OWN, another_file, is_compiled, name_clash, names_of, users_file

if TYPE_CHECKING:
    from vnet.node import Node
    from vnet.transport import wire


Program = Callable[["Node"], Awaitable[None]]
Programs = Mapping[str, Program]
"""Program of each node, by id."""

RENAMED_MODULES = {"agents.liar": "agents.cooperative.attacker"}
"""New names of modules with a program, by the old."""


_contexts: WeakKeyDictionary[ModuleType, Context] = WeakKeyDictionary()
_given: ContextVar[Mapping[str, Program]] = ContextVar("vnet_given_programs", default=MappingProxyType({}))


@contextmanager
def given_programs(programs: Mapping[str, Program]) -> Iterator[None]:
    """Take these functions, by entry, for programs within the block: nothing is imported for them."""
    before = _given.set(programs)
    try:
        yield
    finally:
        _given.reset(before)


def load_program(entry: str) -> Program:
    """Import `package.module:function`, if it is not given. Raises ProgramError with the reason in one line."""
    from vnet.runtime import own_asyncio  # asyncio, which the checks of a scenario do without

    if entry in (given := _given.get()):
        own_asyncio.use_stand_ins(given[entry])
        return given[entry]
    module_name, _, name = entry.partition(":")
    if module_name in RENAMED_MODULES:
        raise ProgramError(f"program.entry = {entry!r}: renamed; use {RENAMED_MODULES[module_name]}:{name}")
    own_asyncio.attach()
    is_new, context = module_name not in sys.modules, copy_context()
    try:
        module = context.run(import_for_run, module_name)
    except Exception as error:
        if needed := missed_by(error):
            raise ProgramError(f"program.entry = {entry!r} {needed}") from error
        missed = getattr(error, "name", None) if isinstance(error, ImportError) else None
        raise _load_error(entry, f"cannot import: {error_line(error)}", missed or module_name) from error
    except SystemExit as left:
        status = 0 if left.code is None else left.code if isinstance(left.code, int) else 1
        how = f"importing it ended the process (exit status {status})"
        raise ProgramError(f"program.entry = {entry!r}: {how}") from None
    finally:
        own_asyncio.detach()
    if is_new:
        _contexts[module] = context
        _entered.add(module_name.partition(".")[0])
    elif other := another_file(module):
        raise ProgramError(f"program.entry = {entry!r}: {module_name} is already {_origin(module)}: rename {other}")
    program = getattr(module, name, None)
    if program is None:
        found = f"module {module_name} ({_origin(module)})"
        programs = [each for each, value in vars(module).items() if inspect.iscoroutinefunction(value)]
        raise _load_error(entry, f"{found} has no {name!r}{did_you_mean(name, programs)}", module_name)
    if not inspect.iscoroutinefunction(program):
        raise _load_error(entry, f"is not an async function: async def {name}(node)", module_name)
    try:
        inspect.signature(program).bind(None)
    except TypeError as error:
        raise _load_error(entry, f"called with the node: {error}; async def {name}(node)", module_name) from None
    own_asyncio.use_stand_ins(program)
    return program  # type: ignore[no-any-return]


_imported: list[str] = []
"""Names of the modules that were imported on behalf of runs."""
_entered: set[str] = set()
"""Packages that programs are of, wherever these were found."""
_searched: set[str] = set()
"""The folders in which programs have been looked for."""
_runs_on: list[None] = []
"""An item for each run of this process that is on."""


@contextmanager
def imports_noted(is_ours: Callable[[], bool]) -> Iterator[None]:
    """Note within the block which modules are imported where `is_ours` says so, which knows the present thread."""

    class Finder:
        """Finds nothing: it is asked for each module first."""

        @staticmethod
        def find_spec(name: str, path: object = None, target: object = None) -> None:
            if is_ours():
                _imported.append(name)

    sys.meta_path.insert(0, Finder)
    try:
        yield
    finally:
        sys.meta_path.remove(Finder)


def import_for_run(name: str) -> ModuleType:
    """Import a module, and note what it imports. Raises what its code does, SystemExit if it ends the process."""
    from vnet.runtime.outside_loop import ends_refused  # asyncio, too

    thread = get_ident()
    with imports_noted(lambda: get_ident() == thread), ends_refused():
        return importlib.import_module(name)


@contextmanager
def imports_kept() -> Iterator[None]:
    """Forget no module within the block, in which a run is on."""
    _runs_on.append(None)
    try:
        yield
    finally:
        _runs_on.pop()


def forget_imports() -> None:
    """Have the next run import its programs and the modules of its folders again, as in a process of its own.

    A run that is made while another one is on shares that one's modules. Packages of which somebody else has
    imported a module stay, as do those with compiled parts, which are imported once in a process.
    """
    if not _imported or _runs_on:
        return
    files = {name: users_file(name) for name in _imported}
    packages = {name: name.partition(".")[0] for name in [*sys.modules, *files]}
    found = {packages[name] for name, file in files.items() if file and any(map(file.is_relative_to, _searched))}
    found |= _entered.difference(OWN)
    compiled = {packages[name] for name in files if is_compiled(names_of(name).get("__file__"))}
    of_others = {package for name, package in packages.items() if name in sys.modules and name not in files}
    for name in files:
        if packages[name] in found - compiled - of_others:
            sys.modules.pop(name, None)
    _imported.clear()


def context_of(program: Program) -> Context:
    """Return a copy of the context in which the program's module was imported, or of this one if it was before.

    What the module sets at its top for all of it is in there, such as numpy's errors.
    """
    module = sys.modules.get(str(program.__module__))
    kept = None if module is None else _contexts.get(module)
    return copy_context() if kept is None else kept.copy()


def _load_error(entry: str, reason: str, module: str) -> ProgramError:
    """Error of a program that is not found; it names the file of `module` that another of its name hides."""
    clash = name_clash(module, Path.cwd())
    return ProgramError(f"program.entry = {entry!r}: {reason}" + (f"; {clash}" if clash else ""))


def _origin(module: ModuleType) -> str:
    """File of a module, relative to the current folder if it is inside."""
    file = getattr(module, "__file__", None)
    if file is None:
        return "built into Python" if module.__name__ in sys.builtin_module_names else "a folder without code"
    return os.path.relpath(file) if Path(file).is_relative_to(Path.cwd()) else str(file)


def load_programs(welcomes: Iterable[wire.Welcome]) -> dict[str, Program]:
    """The program of each node that is welcome. Raises ProgramError."""
    entries = {welcome.node: welcome.entry for welcome in welcomes}
    programs = {entry: load_program(entry) for entry in dict.fromkeys(entries.values())}
    return {node: programs[entry] for node, entry in entries.items()}


_added: list[str] = []
"""The folders that were added last: those of another run give way."""


def path_without_programs() -> list[str]:
    """Return `sys.path` without the folders in which programs of this process are looked for."""
    return [path for path in sys.path if path not in _added]


def search_programs_in(folders: Iterable[Path]) -> None:
    """Have modules looked for in `folders`, in this order, and then in the current one.

    They come last on `sys.path`, so that they shadow nothing. Folders of an earlier call are looked in no more.
    """
    sys.path[:] = path_without_programs()
    wanted = dict.fromkeys(str(folder) for folder in [*folders, Path.cwd()])
    _searched.update(str(Path(folder).resolve()) for folder in wanted)
    _added[:] = [path for path in wanted if path not in sys.path]
    sys.path.extend(_added)
    importlib.invalidate_caches()
