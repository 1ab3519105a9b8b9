"""Modules of an unmodified program, loaded for its vehicle alone, with time, threads and chance of that vehicle.

What is pure Python and outside the standard library (the script, its neighbours, packages) is loaded once a
program, and so are the modules of the standard library that block or draw: they import what stands here for `time`,
`_thread`, `os` and others. All else is shared with the rest of the process, packages with compiled parts among it.
"""

from __future__ import annotations

import asyncio
import builtins
import datetime
import importlib
import importlib.util
import io
import os
import random
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Coroutine, Iterable, Sequence
from concurrent import futures
from contextvars import ContextVar
from functools import cache, partial
from importlib.machinery import ModuleSpec, SourceFileLoader
from itertools import dropwhile
from pathlib import Path
from types import ModuleType
from typing import Any, NoReturn
from weakref import WeakKeyDictionary

from vnet.errors import ProgramError, shown
from vnet.gateway import client_config, session_variables
from vnet.gateway.emulated.chance import numpy_random, prepare_random, prepare_uuid
from vnet.gateway.emulated.facade import Facade
from vnet.gateway.emulated.process import INTERRUPTED, OwnProcess, subprocess_functions, take_output
from vnet.gateway.emulated.shown import hide, import_shared, show
from vnet.gateway.emulated.strands import Threads, block_on, current_strand, look, run_strand, sleep
from vnet.node import Node
from vnet.runtime.own_asyncio import Task
from vnet.runtime.virtual_time import VirtualTimeLoop
from vnet.units import NS_PER_S

ENDPOINT = "tcp/127.0.0.1:7447"
"""Endpoint that programs are told. Sessions here have no transport, and connect to nothing."""
CLIENT_CONFIG = Path(__file__).with_name("client.json5")
"""File of a client's configuration for that endpoint, as a gateway gives one."""
EPOCH_NS = 1_735_689_600 * NS_PER_S
"""The wall clock of programs at the start of a run: 2025-01-01T00:00:00Z."""
FLAGS = frozenset(["-u", "-B", "-E", "-I", "-O", "-OO", "-s", "-S", "-P", "-q"])
"""Options of Python's command line that change nothing here."""
CORES = 4
"""Cores that a program sees: the size of a pool of threads may not depend on the machine."""
_OWN_COPIES = (
    "_threading_local",
    "argparse",
    "concurrent",
    "concurrent.futures",
    "concurrent.futures._base",
    "concurrent.futures.thread",
    "contextlib",
    "fileinput",
    "logging",
    "logging.config",
    "logging.handlers",
    "optparse",
    "queue",
    "random",
    "sched",
    "secrets",
    "tempfile",
    "threading",
    "uuid",
)
"""Modules of the standard library of which each program has its own: they block, draw, keep such objects, or read
the words of the command."""
_ABSENT = ("_queue",)
"""Accelerators whose Python version is taken, as they block in C."""
_SHARED = ("vnet", "agents", "emulator", "greenlet")


_present: ContextVar[ProgramModules | None] = ContextVar("vnet_zenoh_program", default=None)
_present_run: ContextVar[object] = ContextVar("vnet_asyncio_run", default=None)


class OwnModules(dict[str, ModuleType]):
    """The modules of a program by name. Its own are found by it wherever its code runs, until `close`."""

    def __init__(self) -> None:
        super().__init__()
        self._shown: set[str] = set()

    def __setitem__(self, name: str, module: ModuleType) -> None:
        super().__setitem__(name, module)
        if name not in _OWN_COPIES and name not in self._shown and show(name, _present_module):
            self._shown.add(name)

    def close(self) -> None:
        """Have none of them found any more."""
        for name in self._shown:
            hide(name)
        self._shown.clear()


class ProgramModules:
    """The modules of one program of a vehicle, as `sys.modules` has them."""

    def __init__(self, node: Node) -> None:
        self.node = node
        self.threads = Threads()
        self.process = OwnProcess(self.threads)
        self.threads.on_interrupt = partial(self.process.send, signal.SIGINT)
        self.at_exit: list[Callable[[], object]] = []
        self.path: list[str] = []
        self.argv: list[str] = []
        own = session_variables(node.id, ENDPOINT, client_config(ENDPOINT), CLIENT_CONFIG)
        self.environ = {**os.environ, **own}
        if "ros2" in node.options:
            self.environ["ROS_DOMAIN_ID"] = str(node.options["ros2"]["domain"])
        self._random = random.Random(int.from_bytes(node.rng.bytes(16)))
        self.modules = OwnModules()
        self._builtins = {**vars(builtins), "__import__": self._import, "input": _no_input}
        self.coroutines: WeakKeyDictionary[asyncio.Task[Any], object] = WeakKeyDictionary()
        """Tasks of the program, and the call of `asyncio.run` within which each was made."""
        self._facades: dict[str, Callable[[], ModuleType]] = {
            "_thread": self.threads.module,
            "asyncio": self._asyncio,
            "atexit": self._atexit,
            "datetime": self._datetime,
            "importlib": lambda: Facade(importlib, import_module=self._import_module, __import__=self._import),
            "os": self._os,
            "numpy": self._numpy,
            "select": lambda: Facade(select, select=_select),
            "signal": lambda: Facade(signal, **self.process.signal_functions()),
            "subprocess": lambda: Facade(subprocess, **subprocess_functions(self.environ)),
            "sys": self._sys,
            "time": self._time,
        }
        self._preparations: dict[str, Callable[[Any], None]] = {
            "concurrent.futures": self._prepare_futures,
            "queue": self._prepare_queue,
            "random": lambda module: prepare_random(module, self._random),
            "threading": self._prepare_threading,
            "uuid": lambda module: prepare_uuid(module, self._random),
        }

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
            leave = SystemExit(INTERRUPTED)
        except Exception as error:
            hook: Any = vars(self.load("sys"))["excepthook"]
            if hook is not sys.excepthook:
                hook(type(error), error, error.__traceback__)
            raise
        self.load("threading")._shutdown()
        for function in reversed(self.at_exit):
            function()
        if leave is not None:
            raise leave

    def _find_main(self, words: Sequence[str]) -> tuple[Any, str, ModuleSpec | None]:
        """Return code, file and specification of the program, and set `sys.argv` and `sys.path` for it."""
        here = str(Path.cwd())
        words = [words[0], *dropwhile(FLAGS.__contains__, words[1:])]
        if words[1:2] == ["-m"] and len(words) > 2:
            self.path[:] = [here, *sys.path]
            spec = self._find_module(words[2])
            self.argv[:] = [spec.origin or "", *words[3:]]
            assert isinstance(spec.loader, SourceFileLoader)
            return spec.loader.get_code(spec.name), spec.origin or "", spec
        if words[1:2] == ["-c"] and len(words) > 2:
            self.path[:] = [here, *sys.path]
            self.argv[:] = ["-c", *words[3:]]
            return compile(words[2], "<string>", "exec", dont_inherit=True), "", None
        script = next(iter(words[1:]), "-")
        if script.startswith("-"):
            raise ProgramError(f"program.command = {shown(list(words))}: a script or -m MODULE is expected")
        path = Path(script)
        try:
            source = path.read_bytes()
        except OSError as error:
            raise ProgramError(f"program.command: {shown(script)}: {error.strerror}") from None
        self.path[:] = [str(path.resolve().parent), *sys.path]
        self.argv[:] = list(words[1:])
        return compile(source, script, "exec", dont_inherit=True), script, None

    def _find_module(self, name: str) -> ModuleSpec:
        spec = self._find(name)
        if spec is not None and spec.submodule_search_locations is not None:
            spec = self._find(f"{name}.__main__")
        if spec is None or not isinstance(spec.loader, SourceFileLoader):
            raise ProgramError(f"program.command: no module {shown(name)} in Python to run")
        return spec

    # Importing.

    def load(self, name: str) -> ModuleType:
        """Return a module as the program sees it; load it if need be. Raises ImportError."""
        if (found := self.modules.get(name)) is not None:
            return found
        parent = name.rpartition(".")[0]
        if parent:
            self.load(parent)
            if name in self.modules:
                return self.modules[name]
        module = self._load_new(name)
        if parent and (package := self.modules.get(parent)) is not None:
            setattr(package, name.rpartition(".")[2], module)
        return module

    def _load_new(self, name: str) -> ModuleType:
        top = name.partition(".")[0]
        if name in _ABSENT:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
        if name in self._facades:
            module = self.modules[name] = self._facades[name]()
            return module
        if name in _OWN_COPIES:
            spec = importlib.util.find_spec(name)
        elif top in sys.stdlib_module_names or top in _SHARED:
            spec = None
        else:
            spec = self._find(name)
            if spec is None:
                raise ModuleNotFoundError(f"No module named {name!r}", name=name)
        if spec is None or not _is_python(spec) or (name not in _OWN_COPIES and self._is_compiled(top)):
            module = self.modules[name] = import_shared(name)
            return module
        return self._execute(spec)

    def _find(self, name: str) -> ModuleSpec | None:
        parent = name.rpartition(".")[0]
        path = list(self.load(parent).__path__) if parent else self.path
        for finder in sys.meta_path:
            spec = finder.find_spec(name, path)
            if spec is not None:
                return spec
        return None

    def _is_compiled(self, top: str) -> bool:
        spec = self._find(top)
        places = None if spec is None else spec.submodule_search_locations
        return places is not None and _has_compiled(tuple(places))

    def _execute(self, spec: ModuleSpec) -> ModuleType:
        name = spec.name
        module = self.modules[name] = importlib.util.module_from_spec(spec)
        vars(module)["__builtins__"] = self._builtins
        try:
            if isinstance(spec.loader, SourceFileLoader):  # else a folder without code
                exec(spec.loader.get_code(name), vars(module))  # type: ignore[arg-type]
        except BaseException:
            self.modules.pop(name, None)
            raise
        if (prepare := self._preparations.get(name)) is not None:
            prepare(module)
        return self.modules.get(name, module)

    def _import(
        self,
        name: str,
        globals: dict[str, Any] | None = None,
        locals: object = None,
        fromlist: Iterable[str] | None = (),
        level: int = 0,
    ) -> ModuleType:
        """Do as `__import__`."""
        if level:
            package = (globals or {}).get("__package__") or ""
            if not package:
                raise ImportError("attempted relative import with no known parent package")
            name = importlib.util.resolve_name("." * level + name, package)
        module = self.load(name)
        if not fromlist:
            return module if level else self.load(name.partition(".")[0])
        if hasattr(module, "__path__"):
            wanted = list(fromlist)
            for each in wanted + (list(getattr(module, "__all__", ())) if "*" in wanted else []):
                if each != "*" and not hasattr(module, each):
                    try:
                        self.load(f"{name}.{each}")
                    except ModuleNotFoundError as error:
                        if error.name != f"{name}.{each}":
                            raise
        return module

    def _import_module(self, name: str, package: str | None = None) -> ModuleType:
        return self.load(importlib.util.resolve_name(name, package))

    # Modules of which the program has others.

    def _sys(self) -> ModuleType:
        own = {"argv": self.argv, "path": self.path, "modules": self.modules, "stdin": io.StringIO()}
        return Facade(sys, **own, __stdout__=sys.stdout, __stderr__=sys.stderr)

    def _os(self) -> ModuleType:
        return Facade(
            os,
            environ=self.environ,
            getenv=self.environ.get,
            urandom=self._random.randbytes,
            cpu_count=lambda: CORES,
            process_cpu_count=lambda: CORES,
            register_at_fork=lambda **hooks: None,
            sched_yield=partial(sleep, 0.0),
            **self.process.os_functions(),
        )

    def _time(self) -> ModuleType:
        node = self.node

        def ns() -> int:
            look()
            return node.now_ns

        def seconds() -> float:
            return ns() / NS_PER_S

        def unix_ns() -> int:
            return EPOCH_NS + ns()

        def unix() -> float:
            return (EPOCH_NS + ns()) / NS_PER_S

        def utc(at: float | None = None) -> time.struct_time:
            return time.gmtime(unix() if at is None else at)

        clocks = {time.CLOCK_REALTIME: unix_ns}
        own: dict[str, Any] = {
            "time": unix,
            "time_ns": unix_ns,
            "monotonic": seconds,
            "monotonic_ns": ns,
            "perf_counter": seconds,
            "perf_counter_ns": ns,
            "process_time": lambda: 0.0,  # computing costs no emulated time
            "process_time_ns": lambda: 0,
            "thread_time": lambda: 0.0,
            "thread_time_ns": lambda: 0,
            "clock_gettime": lambda clock: clocks.get(clock, ns)() / NS_PER_S,
            "clock_gettime_ns": lambda clock: clocks.get(clock, ns)(),
            "sleep": sleep,
            "gmtime": utc,
            "localtime": utc,
            "ctime": lambda at=None: time.asctime(utc(at)),
            "asctime": lambda at=None: time.asctime(at or utc()),
            "strftime": lambda form, at=None: time.strftime(form, at or utc()),
            "timezone": 0,
            "altzone": 0,
            "daylight": 0,
            "tzname": ("UTC", "UTC"),
        }
        # As those of `time`, they make no methods of classes that have them.
        return Facade(time, **{name: staticmethod(each) if callable(each) else each for name, each in own.items()})

    def _datetime(self) -> ModuleType:
        node = self.node

        class Alike(type):
            def __instancecheck__(cls, instance: object) -> bool:
                return isinstance(instance, cls.__base__ or object)

        class Moment(datetime.datetime, metaclass=Alike):
            @classmethod
            def now(cls, tz: Any = None) -> Any:
                zone = tz or datetime.UTC
                at = datetime.datetime.fromtimestamp((EPOCH_NS + node.now_ns) / NS_PER_S, zone)
                return at if tz else at.replace(tzinfo=None)

            @classmethod
            def utcnow(cls) -> Any:
                return cls.now()

            @classmethod
            def today(cls) -> Any:
                return cls.now()

        class Day(datetime.date, metaclass=Alike):
            @classmethod
            def today(cls) -> Any:
                return Moment.now().date()

        Moment.__name__ = Moment.__qualname__ = "datetime"
        Day.__name__ = Day.__qualname__ = "date"
        return Facade(datetime, datetime=Moment, date=Day)

    def _atexit(self) -> ModuleType:
        module = ModuleType("atexit")

        def register(function: Callable[..., Any], *args: Any, **kwargs: Any) -> Callable[..., Any]:
            self.at_exit.append(partial(function, *args, **kwargs))
            return function

        def unregister(function: Callable[..., Any]) -> None:
            self.at_exit[:] = [each for each in self.at_exit if getattr(each, "func", None) != function]

        vars(module).update(register=register, unregister=unregister)
        return module

    def _numpy(self) -> ModuleType:
        import numpy

        random_module = self.modules["numpy.random"] = numpy_random(self._random)
        return Facade(numpy, random=random_module)

    def _prepare_threading(self, module: Any) -> None:
        module.local = self.load("_threading_local").local

        given = module.Event.is_set

        def is_set(event: Any) -> bool:
            if not given(event):
                look()
            return bool(given(event))

        module.Event.is_set = module.Event.isSet = is_set

    def _prepare_queue(self, module: Any) -> None:
        """Have what finds a queue empty count as a look at it."""
        for kind in (module.Queue, module._PySimpleQueue):
            kind.get = _looking_get(kind.get, module.Empty)
            kind.empty = _looking_empty(kind.empty)

    def _prepare_futures(self, module: Any) -> None:
        """Have jobs of processes run in threads: a child process has a time of its own."""

        class ProcessPoolExecutor(module.ThreadPoolExecutor):  # type: ignore[misc]
            def __init__(
                self, max_workers: Any = None, mp_context: Any = None, *initializer: Any, **options: Any
            ) -> None:
                options.pop("max_tasks_per_child", None)
                super().__init__(max_workers, "process", *initializer, **options)

            def map(self, function: Any, *iterables: Any, timeout: Any = None, chunksize: int = 1) -> Any:
                return super().map(function, *iterables, timeout=timeout)

        module.ProcessPoolExecutor = ProcessPoolExecutor

    # asyncio: coroutines of the program run on the node's loop, in strands of their own.

    def _asyncio(self) -> ModuleType:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, VirtualTimeLoop)
        loop.set_task_factory(_new_task)
        loop.run_jobs_by(_run_job)
        program_loop = ProgramLoop(loop, self)

        def new_event_loop() -> ProgramLoop:
            nonlocal program_loop
            program_loop = ProgramLoop(loop, self)
            return program_loop

        own = {
            "run": lambda main, *, debug=None, loop_factory=None: program_loop.run(main),
            "Runner": lambda **options: Runner(program_loop),
            "new_event_loop": new_event_loop,
            "set_event_loop": lambda loop: None,
            "get_event_loop": lambda: loop if _in_coroutine() else program_loop,
            "get_running_loop": lambda: loop if _in_coroutine() else _no_loop(),
            "_get_running_loop": lambda: loop if _in_coroutine() else None,
            "current_task": lambda loop=None: asyncio.current_task() if _in_coroutine() else _no_loop(),
            "all_tasks": lambda loop=None: set(self.living_tasks()),
            "wrap_future": _wrap_future,
            "run_coroutine_threadsafe": self._run_coroutine_threadsafe,
        }
        for part in (asyncio.events, asyncio.futures, asyncio.runners, asyncio.tasks):
            found = {name: value for name, value in own.items() if hasattr(part, name)}
            self.modules[part.__name__] = Facade(part, **found)
        parts = {part: self.modules[f"asyncio.{part}"] for part in ("events", "futures", "runners", "tasks")}
        return Facade(asyncio, **own, **parts)

    def living_tasks(self) -> list[asyncio.Task[Any]]:
        """Return the tasks that were made within the present call of `asyncio.run`, and go on."""
        run = _present_run.get()
        return sorted((task for task, its in self.coroutines.items() if its is run and not task.done()), key=hash)

    def _run_coroutine_threadsafe(self, coroutine: Any, loop: Any) -> futures.Future[Any]:
        result = self.load("concurrent.futures").Future()
        task = asyncio.get_running_loop().create_task(coroutine)

        def done(task: asyncio.Task[Any]) -> None:
            if task.cancelled():
                result.cancel()
                result.set_running_or_notify_cancel()
            elif (error := task.exception()) is not None:
                result.set_exception(error)
            else:
                result.set_result(task.result())

        task.add_done_callback(done)
        return result  # type: ignore[no-any-return]


def _present_module(name: str) -> ModuleType | None:
    """Return the module of this name of the program whose code runs."""
    program = _present.get()
    return None if program is None else program.modules.get(name)


def _new_task(loop: Any, coroutine: Any, **options: Any) -> asyncio.Task[Any]:
    """Make a task of a vehicle with programs: those of a program run in strands."""
    program = _present.get()
    if program is None:
        return Task(coroutine, loop=loop, **options)
    task = Task(program.threads.green(coroutine), loop=loop, **options)
    program.coroutines[task] = _present_run.get()
    return task


def _run_job(executor: Any, function: Callable[..., Any], *args: Any) -> asyncio.Future[Any]:
    """Run a job of `run_in_executor` or `to_thread` in a strand, or in the program's own executor."""
    if executor is not None:
        return _wrap_future(executor.submit(function, *args))
    program = _present.get()
    assert program is not None
    strand = program.threads.strand(partial(function, *args))
    return Task(run_strand(strand), loop=asyncio.get_running_loop(), name=f"thread {strand.number}")


def _in_coroutine() -> bool:
    strand = current_strand()
    return strand is None or strand.is_task


def _select(readers: Any, writers: Any, others: Any, timeout_s: float | None = None) -> Any:
    """Do as `select.select`, which without files is a sleep."""
    if readers or writers or others or timeout_s is None:
        return select.select(readers, writers, others, timeout_s)
    sleep(timeout_s)
    return [], [], []


def _no_loop() -> NoReturn:
    raise RuntimeError("no running event loop")


def _no_input(prompt: object = "") -> NoReturn:
    raise EOFError("input(): a vehicle has no keyboard")


def _wrap_future(future: Any, *, loop: Any = None) -> asyncio.Future[Any]:
    """Return a future of asyncio for one of the program's own `concurrent.futures`."""
    if isinstance(future, asyncio.Future):
        return future
    outer = asyncio.get_running_loop().create_future()

    def done(inner: Any) -> None:
        if outer.done():
            return
        if inner.cancelled():
            outer.cancel()
        elif (error := inner.exception()) is not None:
            outer.set_exception(error)
        else:
            outer.set_result(inner.result())

    future.add_done_callback(done)
    return outer


class ProgramLoop:
    """The node's loop as a blocking program sees one of its own: it runs while the program says so."""

    def __init__(self, loop: VirtualTimeLoop, program: ProgramModules) -> None:
        self._loop = loop
        self._program = program
        self._stopped: asyncio.Future[None] | None = None
        self._is_closed = False

    def __getattr__(self, name: str) -> Any:
        return getattr(self._loop, name)

    def run(self, main: Coroutine[Any, Any, Any]) -> Any:
        """Do as `asyncio.run`."""
        if _in_coroutine():
            raise RuntimeError("asyncio.run() cannot be called from a running event loop")
        outer = _present_run.set(object())
        try:
            return self.run_until_complete(main)
        finally:
            self.cancel_tasks()
            _present_run.reset(outer)

    def cancel_tasks(self) -> None:
        """Cancel the tasks of the present run, and wait for them."""
        left = self._program.living_tasks()
        for task in left:
            task.cancel()
        if left:
            block_on(asyncio.wait(left))

    def run_until_complete(self, future: Any) -> Any:
        """Do as the loop's."""
        task = self._loop.create_task(future) if asyncio.iscoroutine(future) else future
        return block_on(task)

    def run_forever(self) -> None:
        """Block until `stop`."""
        self._stopped = self._loop.create_future()
        block_on(self._stopped)

    def stop(self) -> None:
        """End `run_forever`."""
        if self._stopped is not None and not self._stopped.done():
            self._stopped.set_result(None)

    def close(self) -> None:
        """Take note of it: the loop is the node's."""
        self._is_closed = True

    def is_closed(self) -> bool:
        """Return whether it was closed."""
        return self._is_closed

    def is_running(self) -> bool:
        """Return whether a coroutine runs."""
        return _in_coroutine()

    async def shutdown_asyncgens(self) -> None:
        """Do nothing, as `close`."""

    shutdown_default_executor = shutdown_asyncgens


class Runner:
    """`asyncio.Runner` on the node's loop."""

    def __init__(self, loop: ProgramLoop) -> None:
        self._loop = loop
        self._outer: Any = _present_run.set(object())

    def __enter__(self) -> Runner:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def run(self, main: Coroutine[Any, Any, Any], *, context: Any = None) -> Any:
        """Run a coroutine."""
        return self._loop.run_until_complete(main)

    def get_loop(self) -> ProgramLoop:
        """Return the loop."""
        return self._loop

    def close(self) -> None:
        """Cancel the tasks that are left."""
        if self._outer is not None:
            self._loop.cancel_tasks()
            _present_run.reset(self._outer)
            self._outer = None


def _looking_get(get: Callable[..., Any], empty: type[Exception]) -> Callable[..., Any]:
    def looking(queue: Any, block: bool = True, timeout: float | None = None) -> Any:
        try:
            return get(queue, block, timeout)
        except empty:
            look()
            raise

    return looking


def _looking_empty(is_empty: Callable[[Any], bool]) -> Callable[[Any], bool]:
    def looking(queue: Any) -> bool:
        if is_empty(queue):
            look()
        return is_empty(queue)

    return looking


def _is_python(spec: ModuleSpec) -> bool:
    return isinstance(spec.loader, SourceFileLoader) or (
        spec.loader is None or type(spec.loader).__name__ == "NamespaceLoader"
    )


@cache
def _has_compiled(places: tuple[str, ...]) -> bool:
    """Return whether a package has compiled parts."""
    return any(True for place in places for _ in Path(place).rglob("*.so"))
