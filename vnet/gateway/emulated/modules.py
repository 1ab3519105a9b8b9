"""Modules of an unmodified program, loaded for its vehicle alone, with time and threads of that vehicle.

What is pure Python and outside the standard library (the script, its neighbours, packages) is loaded once a
program, and so are the modules of the standard library that block: they import what stands here for `time`,
`_thread`, `os` and others. All else is shared with the rest of the process, packages with compiled parts among it.
"""

from __future__ import annotations

import asyncio
import builtins
import ctypes
import gc
import importlib
import importlib.machinery
import importlib.metadata
import importlib.util
import multiprocessing
import multiprocessing.synchronize
import os
import random
import select
import signal
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, MutableMapping, Sequence
from contextvars import ContextVar
from copy import copy
from datetime import date, datetime, tzinfo
from functools import cache, partial, wraps
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any, ClassVar, NoReturn

from greenlet import GreenletExit

from vnet.errors import ProgramError, shown
from vnet.gateway import client_config, python_words, session_variables
from vnet.gateway.emulated.loops import prepare_asyncio
from vnet.gateway.emulated.process import INTERRUPTED, OwnProcess, Semaphore, subprocess_functions, take_output
from vnet.gateway.emulated.shown import facade, hide, import_shared, show
from vnet.gateway.emulated.strands import (
    Strand,
    Threads,
    Waiting,
    current_strand,
    fail,
    look,
    set_generator_hooks,
    sleep,
)
from vnet.node import Node
from vnet.runtime.own_asyncio import Numbered
from vnet.runtime.virtual_time import VirtualTimeLoop
from vnet.units import NS_PER_S

ENDPOINT = "tcp/127.0.0.1:1"
"""Endpoint that programs are told, at which nobody listens. Sessions here have no transport."""
CLIENT_CONFIG = Path(__file__).with_name("client.json5")
"""File of a client's configuration for that endpoint, as a gateway gives one."""
EPOCH_NS = 1_735_689_600 * NS_PER_S
"""The wall clock of programs at the start of a run: 2025-01-01T00:00:00Z."""
SERVER_LOOK_S = 0.5
"""Time between two looks of a server for requests, as `serve_forever` has it."""
CORES = 4
"""Cores that a program sees: the size of a pool of threads may not depend on the machine."""
_OWN_COPIES = (
    "_threading_local",
    "argparse",
    "asyncio",
    "concurrent",
    "contextlib",
    "email.generator",
    "email.utils",
    "fileinput",
    "gzip",
    "http.cookies",
    "http.server",
    "logging",
    "mailbox",
    "multiprocessing.dummy",
    "multiprocessing.pool",
    "multiprocessing.util",
    "optparse",
    "pkgutil",
    "pprint",
    "pydoc",
    "queue",
    "runpy",
    "sched",
    "selectors",
    "socketserver",
    "tarfile",
    "tempfile",
    "threading",
    "timeit",
    "traceback",
    "unittest.mock",
    "uuid",
    "weakref",
    "wsgiref.simple_server",
    "xmlrpc.server",
    "zipfile",
)
"""Modules and packages of the standard library of which each program has its own: they block, keep such objects,
ask for the time, print, load modules, wait for the end of the program, or read the words of the command."""
_SHARED_PARENTS = {name.rpartition(".")[0] for name in _OWN_COPIES if "." in name}
"""Packages that are shared but for modules of which each program has its own."""
_ABSENT = {
    **{name: f"No module named {name!r}" for name in ("_asyncio", "_queue")},
    "trio": "trio is not available on virtual time, whose event loops are those of asyncio",
}
"""Modules that are not there, and what is said of them. Of accelerators, which block in C, Python is taken."""
_SHARED = ("vnet", "agents", "emulator", "greenlet")


_shared_code: Callable[[SourceFileLoader, str], Any] = cache(SourceFileLoader.get_code)
_present: ContextVar[ProgramModules | None] = ContextVar("vnet_zenoh_program", default=None)


def is_program() -> bool:
    """Return whether the present code runs for a program, whose modules are its own or not."""
    return _present.get() is not None


def _import_for_present(name: str, package: str | None = None) -> ModuleType:
    program = _present.get()
    return importlib.import_module(name, package) if program is None else program.load(name)


vars(importlib.metadata)["import_module"] = _import_for_present  # by which an entry point is loaded


_from_timestamp = vars(datetime)["fromtimestamp"]  # Python's own, whatever a subclass has


def _now(cls: Any, tz: tzinfo | None = None) -> Any:
    look()
    program = _present.get()
    assert program is not None
    return _from_timestamp.__get__(None, cls)((EPOCH_NS + program.node.now_ns) / NS_PER_S, tz)


def _today(cls: Any) -> Any:
    return _now(cls) if issubclass(cls, datetime) else cls.fromordinal(_now(datetime).toordinal())


def _show_clock(kind: type, name: str, own: Callable[..., Any]) -> None:
    """Have programs call `own` in place of a class method of `datetime` or `date`, and all others that method.

    The classes stay what they are, for compiled code (pickle, msgspec, pydantic) looks for these and no others.
    """
    methods = gc.get_referents(vars(kind))[0]  # behind the proxy, as built-in classes refuse to be changed
    method = methods[name]

    @wraps(method)  # pickle finds it by its name
    def chosen(cls: Any, *args: Any, **options: Any) -> Any:
        return own(cls, *args, **options) if is_program() else method.__get__(None, cls)(*args, **options)

    methods[name] = classmethod(chosen)
    ctypes.pythonapi.PyType_Modified(ctypes.py_object(kind))


_show_clock(datetime, "now", _now)
_show_clock(datetime, "utcnow", lambda cls: _now(cls))
_show_clock(date, "today", _today)
_MACHINES_ZONE = os.environ.get("TZ")


def _set_zone(zone: str | None) -> None:
    """Have local time be that of a zone, also where compiled code computes it; None is that of /etc/localtime."""
    if zone is None:
        os.unsetenv("TZ")
    else:
        os.putenv("TZ", zone)
    time.tzset()


class OwnModules(dict[str, ModuleType]):
    """The modules of a program by name. Its own are found by it wherever its code runs, until `close`."""

    def __init__(self) -> None:
        super().__init__()
        self._shown: set[str] = set()

    def __setitem__(self, name: str, module: ModuleType) -> None:
        super().__setitem__(name, module)
        parent, _, child = name.rpartition(".")
        if parent in self:  # at once: Python would find those that are being loaded in its own `sys.modules`
            setattr(self[parent], child, module)
        is_common = name.partition(".")[0] in sys.stdlib_module_names or sys.modules.get(name) is module
        if not is_common and name not in self._shown:
            show(name, _present_module)
            self._shown.add(name)

    def take_back(self, name: str) -> None:
        """Remove a module that could not be loaded."""
        self.pop(name, None)
        parent, _, child = name.rpartition(".")
        if parent in self:
            vars(self[parent]).pop(child, None)

    def close(self) -> None:
        """Have none of them found any more."""
        for name in self._shown:
            hide(name)
        self._shown.clear()


class Variables(dict[str, str]):
    """The environment of a program: a dict that, as Python's own, has attributes."""


class _PresentData(MutableMapping[bytes, bytes]):
    """The variables of `os.environ` for modules that programs share: of whose strand runs, else vnet's own."""

    def __init__(self, own: MutableMapping[bytes, bytes]) -> None:
        self._own = own

    def __getitem__(self, key: bytes) -> bytes:
        program = _present.get()
        return self._own[key] if program is None else os.fsencode(program.environ[os.fsdecode(key)])

    def __setitem__(self, key: bytes, value: bytes) -> None:
        program = _present.get()
        if program is None:
            self._own[key] = value
        else:
            program.environ[os.fsdecode(key)] = os.fsdecode(value)

    def __delitem__(self, key: bytes) -> None:
        program = _present.get()
        if program is None:
            del self._own[key]
        else:
            del program.environ[os.fsdecode(key)]

    def __iter__(self) -> Iterator[bytes]:
        program = _present.get()
        return iter(self._own) if program is None else map(os.fsencode, program.environ)

    def __len__(self) -> int:
        program = _present.get()
        return len(self._own if program is None else program.environ)


_data = _PresentData(vars(os.environ)["_data"])
for _environ in os.environ, os.environb:
    vars(_environ)["_data"] = _data  # as `Path.home` and `shutil.which` read it


class ProgramModules:
    """The modules of one program of a vehicle, as `sys.modules` has them; its commands have a `number`."""

    _open: ClassVar[set[ProgramModules]] = set()
    """Those of programs that are there, whose local time is the same on all machines."""

    def __init__(self, node: Node, environment: Mapping[str, str], number: int) -> None:
        self.node = node
        loop = asyncio.get_running_loop()
        assert isinstance(loop, VirtualTimeLoop)
        self.steady_ns = partial(loop.steady_ns, node.id, loop.now_ns)
        """Returns nanoseconds on the clock that nobody sets: a skew does not move it."""
        self.threads = Threads()
        self.process = OwnProcess(self.threads, f"{node.id}/{node.incarnation}/{number}")
        self.threads.on_interrupt = partial(self.process.send, signal.SIGINT)
        self.at_exit: list[Callable[[], object]] = []
        self.has_session = False
        """True once the program has opened a session of Zenoh's."""
        self.sessions: list[Any] = []
        """Those that it has opened and not closed."""
        self._executing: dict[str, tuple[Strand | None, Waiting]] = {}
        """The threads that execute modules, and those that wait for the end of that."""
        self._awaited: dict[Strand, str] = {}
        """The modules that threads wait for."""
        self.path: list[str] = []
        self.argv: list[str] = []
        own = session_variables(node.id, ENDPOINT, client_config(ENDPOINT), CLIENT_CONFIG)
        self.environ = Variables({**os.environ, **environment, **own, "TZ": "UTC"})
        self._open.add(self)
        _set_zone("UTC")
        searched = filter(None, environment.get("PYTHONPATH", "").split(os.pathsep))
        self._searched = [*searched, *sys.path]
        if "ros2" in node.options:
            self.environ["ROS_DOMAIN_ID"] = str(node.options["ros2"]["domain"])
        has_children = "child processes are outside of the emulation: Zenoh in Python opens no session there"
        tell = cache(partial(node.log, has_children))
        self.modules, self._no_keys = OwnModules(), Path(os.devnull).open()  # noqa: SIM115
        self._facades: dict[str, Callable[[], ModuleType]] = {
            "_thread": self.threads.module,
            "atexit": self._atexit,
            "importlib": self._importlib,
            "importlib.machinery": self._importlib_machinery,
            "importlib.util": self._importlib_util,
            "os": self._os,
            "select": lambda: facade(select, select=staticmethod(_select)),
            "signal": lambda: facade(signal, **self.process.signal_functions()),
            "subprocess": lambda: facade(subprocess, **subprocess_functions(self.environ, tell)),
            "sys": self._sys,
            "time": self._time,
            "uvloop": self._uvloop,
            **{name: partial(self._package, name) for name in _SHARED_PARENTS},
            "multiprocessing": self._multiprocessing,
        }
        self._preparations: dict[str, Callable[[Any], None]] = {
            "asyncio": lambda module: prepare_asyncio(
                module, self.steady_ns, self.threads, self.process.set_handler
            ),
            "concurrent.futures": self._prepare_futures,
            "multiprocessing.pool": self._prepare_pools,
            "multiprocessing.util": _prepare_finalizers,
            "selectors": _prepare_selectors,
            "socketserver": _prepare_servers,
            "queue": self._prepare_queue,
            "threading": self._prepare_threading,
            "uuid": _prepare_uuid,
        }
        own_import = _import_on(self.load("sys"), self.load)
        self._builtins = {**vars(builtins), "__import__": own_import, "input": self._no_input}

    def close(self) -> None:
        """Have none of its modules found any more."""
        self.modules.close()
        self._no_keys.close()
        self._open.discard(self)
        if not self._open:
            _set_zone(_MACHINES_ZONE)

    # Running.

    def run(self, words: Sequence[str]) -> None:
        """Run a program by the words of its command to its end, in the present strand. Raises what ends it."""
        _present.set(self)
        take_output(self._builtins, self.load("sys"))
        self.load("threading")  # whose main thread is that which imports it
        main = ModuleType("__main__")
        self.modules["__main__"] = main
        code, file, spec = self._find_main(words)
        vars(main).update(__builtins__=self._builtins, __file__=file, __spec__=spec)
        main.__package__ = None if spec is None else spec.parent
        leave: SystemExit | None = None
        try:
            exec(code, vars(main))
        except SystemExit as raised:
            leave = raised
        except KeyboardInterrupt as interrupt:
            if interrupt is not self.process.interrupt:  # of the whole process
                raise
            leave = SystemExit(INTERRUPTED).with_traceback(interrupt.__traceback__)
        except Exception as error:
            hook: Any = vars(self.load("sys"))["excepthook"]
            if hook is not sys.excepthook:
                hook(type(error), error, error.__traceback__)
            self._leave()
            if isinstance(error, StopIteration):  # which no coroutine can pass on
                raise RuntimeError("StopIteration").with_traceback(error.__traceback__) from None
            raise
        self.load("threading")._shutdown()
        if leave is None or leave.code in (None, 0):  # a failure ends it at once, as in real time
            self.threads.await_callbacks()
        self._leave()
        if leave is not None:
            raise leave

    def _leave(self) -> None:
        """Call what `atexit` is to call, the last first; what fails keeps none of the others from it."""
        while self.at_exit:
            try:
                self.at_exit.pop()()
            except GreenletExit:
                raise
            except BaseException as error:
                fail(error, "in a function of atexit")

    def _find_main(self, words: Sequence[str]) -> tuple[Any, str, ModuleSpec | None]:
        """Return code, file and specification of the program, and set `sys.argv` and `sys.path` for it."""
        here = str(Path.cwd())
        words = [words[0], *python_words(words)]
        if words[1] == "-m":
            self.path[:] = [here, *self._searched]
            spec = self._find_module(words[2])
            self.argv[:] = [spec.origin or "", *words[3:]]
            assert isinstance(spec.loader, SourceFileLoader)
            return spec.loader.get_code(spec.name), spec.origin or "", spec
        if words[1] == "-c":
            self.path[:] = [here, *self._searched]
            self.argv[:] = ["-c", *words[3:]]
            return compile(words[2], "<string>", "exec", dont_inherit=True), "", None
        script = words[1]
        path = Path(script)
        if path.is_dir():
            path = path / "__main__.py"
        try:
            source = path.read_bytes()
        except OSError as error:
            raise ProgramError(f"program.command: {shown(str(path))}: {error.strerror}") from None
        if b"\0" in source:
            raise ProgramError(f"program.command: {shown(script)}: no script in Python")
        self.path[:] = [str(path.resolve().parent), *self._searched]
        self.argv[:] = list(words[1:])
        return compile(source, str(path), "exec", dont_inherit=True), str(path), None

    def _find_module(self, name: str) -> ModuleSpec:
        spec = self._find(name)
        if spec is not None and spec.submodule_search_locations is not None:
            spec = self._find(f"{name}.__main__")
        if spec is None or not isinstance(spec.loader, SourceFileLoader):
            raise ProgramError(f"program.command: no module {shown(name)} in Python to run")
        return spec

    def _no_input(self, prompt: object = "") -> NoReturn:
        self._builtins["print"](prompt, end="", flush=True)
        raise EOFError("input(): a vehicle has no keyboard")

    # Importing.

    def load(self, name: str) -> ModuleType:
        """Return a module as the program sees it; load it if need be. Raises ImportError."""
        self._await(name)
        if (found := self.modules.get(name)) is not None:
            return found
        if name in self.modules:
            raise ModuleNotFoundError(f"import of {name} halted; None in sys.modules", name=name)
        parent = name.rpartition(".")[0]
        if parent:
            self.load(parent)
            if name in self.modules:
                return self.load(name)  # another thread may execute it by now
        return self._load_new(name)

    def _await(self, name: str) -> None:
        """Wait until no other thread executes a module, unless that waits for one that this executes, as Python."""
        strand = current_strand()
        while strand is not None and (executing := self._executing.get(name)) is not None:
            other, waiting = executing
            while other is not None and other is not strand:
                other, _ = self._executing.get(self._awaited.get(other, ""), (None, None))
            if other is strand:
                return
            self._awaited[strand] = name
            try:
                waiting.wait()
            finally:
                del self._awaited[strand]

    def _load_new(self, name: str) -> ModuleType:
        top = name.partition(".")[0]
        if name in _ABSENT:
            raise ModuleNotFoundError(_ABSENT[name], name=name)
        if name in self._facades:
            module = self.modules[name] = self._facades[name]()
            return module
        if _is_own_copy(name):
            spec = importlib.util.find_spec(name)
            if spec is None or not _is_python(spec):  # frozen
                spec = PathFinder.find_spec(name)
        elif top in sys.stdlib_module_names or top in _SHARED:
            spec = None
        else:
            spec = self._find(name)
            if spec is None:
                raise ModuleNotFoundError(f"No module named {name!r}", name=name)
        if spec is None or not _is_python(spec) or (not _is_own_copy(name) and self._is_compiled(top)):
            module = self.modules[name] = import_shared(name)
            return module
        return self._execute(spec)

    def _find(self, name: str) -> ModuleSpec | None:
        path: Sequence[str] = self.path
        if parent := name.rpartition(".")[0]:
            if (places := getattr(self.load(parent), "__path__", None)) is None:
                raise ModuleNotFoundError(f"No module named {name!r}; {parent!r} is not a package", name=name)
            path = list(places)
        return next(filter(None, (finder.find_spec(name, path) for finder in sys.meta_path)), None)

    def _is_compiled(self, top: str) -> bool:
        spec = self._find(top)
        places = None if spec is None else spec.submodule_search_locations
        return places is not None and _has_compiled(tuple(places))

    def _execute(self, spec: ModuleSpec, again: ModuleType | None = None) -> ModuleType:
        name = spec.name
        module = self.modules[name] = again or importlib.util.module_from_spec(spec)
        vars(module)["__builtins__"] = self._builtins
        waiting = Waiting()
        self._executing[name] = current_strand(), waiting
        try:
            if isinstance(spec.loader, SourceFileLoader):  # else a folder without code
                get_code: Any = _shared_code if _is_own_copy(name) else SourceFileLoader.get_code
                exec(get_code(spec.loader, name), vars(module))
        except BaseException:
            if again is None:
                self.modules.take_back(name)
            raise
        finally:
            self._executing.pop(name, None)  # a module may load itself again while it is executed
            waiting.wake_all()
        if (prepare := self._preparations.get(name)) is not None:
            prepare(module)
        return self.modules.get(name, module)

    # Modules of which the program has others.

    def _importlib(self) -> ModuleType:
        def import_module(name: str, package: str | None = None) -> ModuleType:
            return self.load(importlib.util.resolve_name(name, package))

        def reload(module: ModuleType) -> ModuleType:
            spec = module.__spec__
            if spec is None or self.modules.get(spec.name) is not module or not _is_python(spec):
                return importlib.reload(module)
            return self._execute(spec, module)

        own_import = self._builtins["__import__"]
        parts = {name: partial(self.load, f"importlib.{name}") for name in ("machinery", "util")}
        return facade(importlib, parts, import_module=import_module, reload=reload, __import__=own_import)

    def _importlib_machinery(self) -> ModuleType:
        own = self._builtins

        class Loader(SourceFileLoader):
            def exec_module(self, module: ModuleType) -> None:
                vars(module)["__builtins__"] = own
                super().exec_module(module)

        Loader.__name__ = Loader.__qualname__ = "SourceFileLoader"
        return facade(importlib.machinery, SourceFileLoader=Loader)

    def _importlib_util(self) -> ModuleType:
        def find_spec(name: str, package: str | None = None) -> ModuleSpec | None:
            name = importlib.util.resolve_name(name, package)
            top = name.partition(".")[0]
            is_shared = top in sys.stdlib_module_names or top in _SHARED
            return importlib.util.find_spec(name) if is_shared else self._find(name)

        def module_from_spec(spec: ModuleSpec) -> ModuleType:
            module = importlib.util.module_from_spec(spec)
            vars(module)["__builtins__"] = self._builtins  # with which its loader executes it
            return module

        return facade(importlib.util, find_spec=find_spec, module_from_spec=module_from_spec)

    def _package(self, name: str) -> ModuleType:
        """Return a package that is shared but for some modules."""
        own = [each for each in _OWN_COPIES if each.startswith(f"{name}.")]
        return facade(import_shared(name), {each.rpartition(".")[2]: partial(self.load, each) for each in own})

    def _multiprocessing(self) -> ModuleType:
        package, chosen = self._package("multiprocessing"), ""
        multiprocessing.synchronize._multiprocessing = SimpleNamespace(SemLock=Semaphore)  # type: ignore[attr-defined]

        def new_pool(*args: Any, **options: Any) -> Any:
            return vars(self.load("multiprocessing.pool"))["Pool"](*args, **options)

        def get_context(method: str | None = None) -> Any:
            mine = copy(multiprocessing.get_context(method or chosen or None))
            # What it makes asks it for locks: they are of its own method.
            vars(mine).update(Pool=new_pool, get_context=lambda other=None: get_context(other) if other else mine)
            return mine

        def set_start_method(method: str | None, force: bool = False) -> None:
            nonlocal chosen
            if chosen and not force:
                raise RuntimeError("context has already been set")
            chosen = method or ""
            context = get_context()
            names = [name for name in multiprocessing.__all__ if hasattr(context, name) and name not in own]
            vars(package).update({name: getattr(context, name) for name in names})

        def get_start_method(allow_none: bool = False) -> str | None:
            return chosen or (None if allow_none else multiprocessing.get_context().get_start_method())

        own = {each.__name__: each for each in (get_context, set_start_method, get_start_method)}
        vars(package).update(own, Pool=new_pool)
        return package

    def _uvloop(self) -> ModuleType:
        """Return what stands for a faster loop that is in C."""
        if self._find("uvloop") is None:
            raise ModuleNotFoundError("No module named 'uvloop'", name="uvloop")
        module, loops = ModuleType("uvloop"), self.load("asyncio")
        vars(module).update(install=lambda: None, EventLoopPolicy=vars(loops)["DefaultEventLoopPolicy"])
        vars(module).update({name: vars(loops)[name] for name in ("run", "new_event_loop")})
        return module

    def _sys(self) -> ModuleType:
        own: dict[str, Any] = {"argv": self.argv, "path": self.path, "modules": self.modules}
        own |= {"stdin": self._no_keys, "set_asyncgen_hooks": set_generator_hooks}
        return facade(sys, **own, __stdout__=sys.stdout, __stderr__=sys.stderr)

    def _os(self) -> ModuleType:
        return facade(
            os,
            environ=self.environ,
            getenv=self.environ.get,
            **dict.fromkeys(["cpu_count", "process_cpu_count"], lambda: CORES),
            register_at_fork=lambda **hooks: None,
            sched_yield=partial(sleep, 0.0),
            **self.process.os_functions(),
        )

    def _time(self) -> ModuleType:
        node = self.node

        def ns(clock: int) -> int:
            look()
            return EPOCH_NS + node.now_ns if clock == time.CLOCK_REALTIME else self.steady_ns()

        def seconds(clock: int) -> float:
            return ns(clock) / NS_PER_S

        def moment(at: float | None = None) -> float:
            return seconds(time.CLOCK_REALTIME) if at is None else at

        own: dict[str, Any] = {
            "time": partial(seconds, time.CLOCK_REALTIME),
            "time_ns": partial(ns, time.CLOCK_REALTIME),
            **dict.fromkeys(["monotonic", "perf_counter"], partial(seconds, time.CLOCK_MONOTONIC)),
            **dict.fromkeys(["monotonic_ns", "perf_counter_ns"], partial(ns, time.CLOCK_MONOTONIC)),
            **dict.fromkeys(["process_time", "thread_time"], lambda: 0.0),  # computing costs no emulated time
            **dict.fromkeys(["process_time_ns", "thread_time_ns"], lambda: 0),
            "clock_gettime": seconds,
            "clock_gettime_ns": ns,
            "sleep": sleep,
            "gmtime": lambda at=None: time.gmtime(moment(at)),
            "localtime": lambda at=None: time.localtime(moment(at)),
            "ctime": lambda at=None: time.ctime(moment(at)),
            "asctime": lambda at=None: time.asctime(at or time.localtime(moment())),
            "strftime": lambda form, at=None: time.strftime(form, at or time.localtime(moment())),
        }
        # As those of `time`, they make no methods of classes that have them.
        return facade(time, **{name: staticmethod(each) if callable(each) else each for name, each in own.items()})

    def _atexit(self) -> ModuleType:
        module = ModuleType("atexit")

        def register(function: Callable[..., Any], *args: Any, **kwargs: Any) -> Callable[..., Any]:
            self.at_exit.append(partial(function, *args, **kwargs))
            return function

        def unregister(function: Callable[..., Any]) -> None:
            self.at_exit[:] = [each for each in self.at_exit if getattr(each, "func", None) != function]

        vars(module).update(register=register, unregister=unregister)
        return module

    def _prepare_threading(self, module: Any) -> None:
        module.local = self.load("_threading_local").local
        vars(self.load("_thread"))["RLock"] = module._PyRLock
        make_hook = module._make_invoke_excepthook

        def make_silent_hook() -> Callable[[Any], None]:
            """As Python's for threads that fail: the end of a program is no failure of its threads."""
            hook = make_hook()
            return lambda thread: None if isinstance(sys.exception(), GreenletExit) else hook(thread)

        module._make_invoke_excepthook = make_silent_hook
        module.Thread.__hash__ = Numbered.__hash__
        module.Event.is_set = module.Event.isSet = _looking(module.Event.is_set)
        module.active_count = module.activeCount = _looking(module.active_count)
        module.enumerate = _looking(module.enumerate)
        module.Semaphore.acquire = _looking(module.Semaphore.acquire)

    def _prepare_queue(self, module: Any) -> None:
        """Have what finds a queue empty count as a look at it."""

        class Empty(module.Empty):  # type: ignore[misc]
            def __init__(self, *args: object) -> None:
                super().__init__(*args)
                look()

        module.Empty = Empty
        for kind in (module.Queue, module._PySimpleQueue):
            for name in ("empty", "full", "qsize"):
                if hasattr(kind, name):
                    setattr(kind, name, _looking(getattr(kind, name)))

    def _prepare_futures(self, module: Any) -> None:
        """Have jobs of processes run in threads: a child process has a time of its own.

        Workers that wait when their program is ended have not failed.
        """

        class ProcessPoolExecutor(module.ThreadPoolExecutor):  # type: ignore[misc]
            def __init__(
                self, max_workers: Any = None, mp_context: Any = None, *initializer: Any, **options: Any
            ) -> None:
                options.pop("max_tasks_per_child", None)
                super().__init__(max_workers, "process", *initializer, **options)

            def map(self, function: Any, *iterables: Any, timeout: Any = None, chunksize: int = 1) -> Any:
                return super().map(function, *iterables, timeout=timeout)

        module.ProcessPoolExecutor = ProcessPoolExecutor
        module.Future.__hash__ = Numbered.__hash__
        module.Future.done = _looking(module.Future.done)
        module._base.LOGGER.addFilter(lambda _: not isinstance(sys.exception(), GreenletExit))

    def _prepare_pools(self, module: Any) -> None:
        """Have jobs of processes run in threads here, too, and what keeps a pool wait for a queue, no pipe."""
        base = module.Pool
        vars(module)["get_context"] = partial(SimpleNamespace, SimpleQueue=module.queue.SimpleQueue)
        module.ThreadPool._get_sentinels = lambda pool: []
        module.ThreadPool._wait_for_updates = staticmethod(lambda sentinels, notifier: notifier.get())

        class Pool(module.ThreadPool):  # type: ignore[misc]
            def __init__(
                self, processes: Any = None, initializer: Any = None, initargs: Any = (), *args: Any, **options: Any
            ) -> None:
                base.__init__(self, processes, initializer, initargs)

        module.Pool = Pool


def _import_on(sys: ModuleType, load: Callable[[str], ModuleType]) -> Callable[..., ModuleType]:
    """Return Python's own `__import__`, run again for the modules of a program: those of its `sys`."""
    system: Any = ModuleType("importlib._bootstrap")
    loader = SourceFileLoader(system.__name__, str(Path(importlib.__file__).with_name("_bootstrap.py")))
    exec(_shared_code(loader, system.__name__), vars(system))
    vars(system).update(sys=sys, _warnings=warnings, _find_and_load=lambda name, import_: load(name))
    return system.__import__  # type: ignore[no-any-return]


def _present_module(name: str) -> ModuleType | None:
    """Return the module of this name of the program whose code runs."""
    program = _present.get()
    return None if program is None else program.modules.get(name)


@cache
def _is_own_copy(name: str) -> bool:
    parent = name.rpartition(".")[0]
    return name in _OWN_COPIES or (bool(parent) and _is_own_copy(parent))


class _Selector:
    """Waits for requests of a server: it looks for some, and lets emulated time go on without any."""

    def __init__(self) -> None:
        self._servers: list[Any] = []

    def __enter__(self) -> _Selector:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def register(self, server: Any, events: int) -> None:
        """Wait for this one, too."""
        self._servers.append(server)

    def select(self, timeout: float | None = None) -> list[Any]:
        """Return the servers that are asked, after `timeout` seconds without any."""
        while not (ready := select.select(self._servers, [], [], 0)[0]):
            sleep(SERVER_LOOK_S if timeout is None else timeout)
            if timeout is not None:
                break
        return ready


def _prepare_servers(module: Any) -> None:
    """Have servers let emulated time go on, as nobody asks them on it; a request from elsewhere is answered."""
    module._ServerSelector = _Selector


def _prepare_finalizers(module: Any) -> None:
    """Have the end of a program leave child processes alone: they are those of all vehicles of this process."""
    module.atexit.unregister(module._exit_function)
    module.atexit.register(module._run_finalizers, 0)


def _prepare_uuid(module: Any) -> None:
    """Have ids of version 1 drawn, where Python asks for the machine's address and the system."""
    module._node = random.getrandbits(48) | 1 << 40
    module._generate_time_safe = module._UuidCreate = None


def _prepare_selectors(module: Any) -> None:
    """Have all selectors wait by `select.select`, which is the program's own."""
    for name in ("DefaultSelector", "PollSelector", "EpollSelector"):
        setattr(module, name, module.SelectSelector)


def _select(readers: Any, writers: Any, others: Any, timeout_s: float | None = None) -> Any:
    """Do as `select.select`, which without files is a sleep."""
    if readers or writers or others or timeout_s is None:
        return select.select(readers, writers, others, timeout_s)
    sleep(timeout_s)
    return [], [], []


def _looking(ask: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that counts as a look at what others change."""

    def looking(*args: Any, **options: Any) -> Any:
        look()
        return ask(*args, **options)

    return looking


def _is_python(spec: ModuleSpec) -> bool:
    return isinstance(spec.loader, SourceFileLoader) or (
        spec.loader is None or type(spec.loader).__name__ == "NamespaceLoader"
    )


@cache
def _has_compiled(places: tuple[str, ...]) -> bool:
    """Return whether a package has compiled parts."""
    return any(True for place in places for _ in Path(place).rglob("*.so"))
