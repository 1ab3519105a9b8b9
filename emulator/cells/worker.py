"""Processes that are fit to run programs: hash seed 0, the same arithmetic as elsewhere, each serving many jobs.

A job is a function of vnet's and its arguments. `call_fitly` runs it in this process if that is fit, else in a
worker that it starts once for each thread and keeps. So any executor's workers will do: threads, processes, Dask's.

Programs and rules may be given as functions. They have entries, and some of them other processes can import.
"""

from __future__ import annotations

import importlib.util
import inspect
import math
import os
import pickle
import shutil
import signal
import socket
import subprocess
import sys
import sysconfig
import tempfile
import threading
import traceback
import weakref
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from importlib.machinery import ModuleSpec, PathFinder
from multiprocessing.connection import Connection
from pathlib import Path
from queue import SimpleQueue
from typing import IO, Any, TypeVar

from emulator.records.code_digest import digests_of, rules_of, sources_of
from emulator.scenario.program import from_here
from emulator.scenario.scenario import Scenario
from vnet.errors import ProgramError, ScenarioError, VnetError, shown
from vnet.runtime import running_node
from vnet.runtime.die_with_parent import end_left, rest_of_groups
from vnet.runtime.environment import SAME_ARITHMETIC, has_same_arithmetic
from vnet.runtime.own_packages import INSTALLED, OWN
from vnet.runtime.programs import Program, path_without_programs
from vnet.runtime.running_node import LONGEST_ID, LOOK_S, Patience, RunningNode

T = TypeVar("T")
LONGEST_TAIL_BYTES = 1000
"""Bytes of a process's standard error in which its last line is looked for."""
PATIENCE_S = 10.0
"""Seconds for which an interrupted job may write down what it has."""


class WorkerDiedError(VnetError):
    """A worker process ended before it had answered."""


class WorkerTimeoutError(VnetError):
    """A job took longer than it may, or a program of its did without a pause."""


@dataclass(frozen=True)
class Place:
    """Place where a job's programs are found: current folder and path of modules; and the code that is expected."""

    folder: str
    path: tuple[str, ...]
    folders: tuple[Path, ...]
    entries: tuple[str, ...]
    code: tuple[tuple[str, str], ...]
    """Digests of vnet and of the programs with these entries."""

    @classmethod
    def here(cls, scenario: Scenario) -> Place:
        """Return the place of this process, for the programs and own checks of a scenario."""
        entries, folders = modules_of(scenario), scenario.program.folders
        folder = str(Path.cwd())
        path = tuple(str(Path(entry or folder).absolute()) for entry in path_without_programs())
        return cls(folder, path, folders, entries, tuple(sorted(digests_of(entries, folders).items())))

    def enter(self) -> None:
        """Make the programs importable in this process. Raises VnetError if their code, or vnet's, is another."""
        known = set(sys.path)
        sys.path += [entry for entry in dict.fromkeys((*self.path, self.folder)) if entry not in known]
        if tuple(sorted(digests_of(self.entries, self.folders).items())) != self.code:
            raise VnetError(
                f"{socket.gethostname()}: vnet, or {', '.join(self.entries)}, is not the code that was to be run: "
                "install the same there"
            )


def modules_of(scenario: Scenario) -> tuple[str, ...]:
    """Return the sources of the programs, and the entries of own checks and own rules of a scenario."""
    return (*sources_of(scenario), *rules_of(scenario))


def is_fit() -> bool:
    """Return whether this process has hash seed 0 and the arithmetic of other machines."""
    return sys.flags.hash_randomization == 0 and has_same_arithmetic()


def call_fitly(
    place: Place,
    function: Callable[..., T],
    *arguments: Any,
    limit_s: float | None = None,
    stall_limit_s: float = math.inf,
) -> T:
    """Return what a function returns in a fit process, whose programs are found as in `place`.

    With `limit_s` that is never this process, so that it can be ended after so many seconds of wall clock. Another
    process is ended, too, once a node's code has run in it for `stall_limit_s` without a pause.
    Raises what the function raises, WorkerDiedError if the process ends before, and WorkerTimeoutError.
    """
    is_here = is_fit() and threading.current_thread() is threading.main_thread() and _entered in ([], [place])
    if is_here and limit_s is None:
        _entered[:] = [place]
        place.enter()
        return function(*arguments)
    if (worker := getattr(_kept, "worker", None)) is None or worker.place != place or not worker.is_alive:
        if worker is not None:
            worker.close()
        worker = _kept.worker = Worker(place)
    return worker.call(function, *arguments, limit_s=limit_s, stall_limit_s=stall_limit_s)


_kept = threading.local()
"""The worker of each thread; it ends with the thread."""
_entered: list[Place] = []
"""The place of the jobs that this process itself has done: it has imported their programs."""


class Worker:
    """A fit process, which does one job after the other. It ends with the process that has started it."""

    def __init__(self, place: Place) -> None:
        self.place = place
        mine, its = socket.socketpair()
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115  # closed with the process
        with its, _memory() as shown:
            shown.truncate(LONGEST_ID + 1)
            self._running = RunningNode(shown.fileno())
            passed = its.fileno(), shown.fileno()
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", "emulator.cells.worker", *map(str, passed)],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=self._errors,
                pass_fds=passed,
                process_group=0,  # Ctrl-C is for whoever has started it
                cwd=place.folder if Path(place.folder).is_dir() else None,
                env={**os.environ, **_with_vnet(os.environ), **SAME_ARITHMETIC, "PYTHONHASHSEED": "0"},
            )
        self._connection = Connection(mine.detach())
        self.close = weakref.finalize(self, _end, self._process, self._connection, self._errors)
        """Ends the process, whatever it does."""
        self._entered = False

    @property
    def is_alive(self) -> bool:
        """Return whether the process is there, and waits for a job."""
        return self.close.alive and self._process.poll() is None

    @property
    def pid(self) -> int:
        """Id of the process."""
        return self._process.pid

    def call(
        self,
        function: Callable[..., T],
        *arguments: Any,
        limit_s: float | None = None,
        stall_limit_s: float = math.inf,
    ) -> T:
        """Return what the function returns there, or raise what it raises.

        Raises WorkerDiedError, and WorkerTimeoutError after `limit_s` seconds, or once a node's code has run for
        `stall_limit_s` without a pause. Ctrl-C interrupts the function.
        """
        if not self._entered:
            self._ask(_enter, (self.place, tempfile.gettempdir()), None, math.inf)
            self._entered = True
        return self._ask(function, arguments, limit_s, stall_limit_s)

    def _ask(
        self, function: Callable[..., T], arguments: tuple[Any, ...], limit_s: float | None, stall_limit_s: float
    ) -> T:
        try:
            self._connection.send_bytes(pickle.dumps((function, arguments)))
            if limit_s is None and stall_limit_s < math.inf:
                self._wait(stall_limit_s)
            elif not self._connection.poll(limit_s):
                self.close()
                raise WorkerTimeoutError(f"not over within {limit_s:g} s of wall clock")
            succeeded, value = self._connection.recv()
        except (EOFError, OSError):
            raise WorkerDiedError(self._last_words()) from None
        except KeyboardInterrupt:
            self._interrupt()
            raise
        if succeeded:
            return value  # type: ignore[no-any-return]
        raise value

    def _wait(self, stall_limit_s: float) -> None:
        """Wait for an answer. Raises WorkerTimeoutError."""
        patience = Patience(self._running, stall_limit_s, has_user=False)
        while not self._connection.poll(LOOK_S):
            if patience.is_over(self.pid):
                node = self._running.read()
                self.close()
                raise WorkerTimeoutError(f"{node}: no yield within {stall_limit_s:g} s of wall clock")

    def _interrupt(self) -> None:
        with suppress(OSError, EOFError):
            self._process.send_signal(signal.SIGINT)
            self._connection.poll(PATIENCE_S)
        self.close()

    def _last_words(self) -> str:
        """Say how the process ended, with the last line that it wrote."""
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(PATIENCE_S)
        status = self._process.poll()
        with suppress(ValueError):  # closed by another thread
            if self.close.alive and status is not None:
                how = signal.Signals(-status).name if status < 0 else f"status {status}"
                self._errors.seek(max(0, self._errors.seek(0, os.SEEK_END) - LONGEST_TAIL_BYTES))
                lines = [line.strip() for line in self._errors.read().decode(errors="replace").split("\n")]
                last = [line for line in lines if line][-1:]
                self.close()
                return ": ".join([f"its process ended with {how}", *last])
        self.close()
        return "its process was closed"


def _end(process: subprocess.Popen[bytes], connection: Connection, errors: IO[bytes]) -> None:
    process.kill()
    process.wait()
    end_left(rest_of_groups({process.pid}))
    connection.close()  # afterwards: a thread that waits for an answer sees the end of the process
    errors.close()
    for left in Path(tempfile.gettempdir()).glob(f"{temporary_prefix(process.pid)}*"):
        shutil.rmtree(left, ignore_errors=True)


def temporary_prefix(pid: int) -> str:
    """Return how the names of the temporary folders of a process's jobs begin, which go when it is ended."""
    return f"vnet-cell-{pid}-"


def _with_vnet(environment: Mapping[str, str]) -> dict[str, str]:
    """The path on which the worker finds the vnet of this process, where it is not installed."""
    root = str(Path(__file__).parents[2])
    if root in (sysconfig.get_path("purelib"), sysconfig.get_path("platlib")):
        return {}
    given = environment.get("PYTHONPATH")
    return {"PYTHONPATH": os.pathsep.join([root, given] if given else [root])}


# In the worker.


def _serve(descriptor: int, shown: int) -> None:
    """Do the jobs that come in on a connection, until it is closed at the other end; show whose code runs."""
    running_node.running = RunningNode(shown)
    os.close(shown)
    signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored in what a shell starts in the background
    connection = Connection(descriptor)
    jobs: SimpleQueue[bytes] = SimpleQueue()
    threading.Thread(target=_receive, args=(connection, jobs), daemon=True).start()
    while True:
        job = jobs.get()
        running_node.running.show("")
        try:
            function, arguments = pickle.loads(job)
            answer = True, function(*arguments)
        except BaseException as error:
            answer = False, _portable(error)
        connection.send(answer)


def _receive(connection: Connection, jobs: SimpleQueue[bytes]) -> None:
    """Take jobs; end the process, in the midst of a job too, when there is nobody left to answer."""
    while True:
        try:
            jobs.put(connection.recv_bytes())
        except (EOFError, OSError):
            os._exit(0)


def _memory() -> IO[bytes]:
    """Return a file in memory, which no full disk can fail, where the system has such."""
    if sys.platform != "linux":
        return tempfile.TemporaryFile()
    return os.fdopen(os.memfd_create("vnet-running-node"), "wb")


def _enter(place: Place, temporary: str) -> None:
    """Enter a place; keep temporary folders where `_end` looks for them, though that disk be full by now."""
    tempfile.tempdir = temporary
    place.enter()


def _portable(error: BaseException) -> BaseException:
    """An exception as it can travel: itself, with its traceback as a note, or its text if it cannot be pickled."""
    if not isinstance(error, VnetError):
        error.add_note("in a worker process:\n" + "".join(traceback.format_exception(error)))
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        kind = VnetError if isinstance(error, VnetError) else RuntimeError
        return kind(f"{type(error).__name__}: {error}")
    return error


if __name__ == "__main__":
    from emulator.cells.worker import _serve as serve  # so that its classes are those that others import

    serve(*map(int, sys.argv[1:]))


def entry_of(program: str | Program | None) -> str | None:
    """Return the entry by which a scenario names a program."""
    if program is None or isinstance(program, str):
        return program and from_here(program)
    module, name = str(program.__module__), str(getattr(program, "__name__", ""))
    return f"{module}:{name if name.isidentifier() else 'program'}"


def require_importable(program: str | Program | None, what: str) -> None:
    """Raise ProgramError for a function that other processes cannot import; `what` is what needs them."""
    function = checked_function(program)
    if function is not None and not is_importable(function):
        raise ProgramError(
            f"program = {name_of(function)}: {what} needs processes that import it; "
            "put it into a module, and give that as module:function"
        )


def checked_function(program: str | Program | None) -> Program | None:
    """Return a function that is given as the program; None for an entry. Raises ProgramError."""
    if program is None or isinstance(program, str):
        return None
    if not inspect.iscoroutinefunction(program):
        raise ProgramError(f"program = {shown(program)}: is not an async function: async def main(node)")
    return program


def rule_entry(rule: str | Callable[..., Any]) -> tuple[str, Path | None]:
    """Return the entry of a rule of the user's own, and the folder of its module, None if it needs none.

    Raises ScenarioError for a function that no other process can import.
    """
    if isinstance(rule, str):
        return from_here(rule), None
    if not callable(rule) or not is_importable(rule):
        raise ScenarioError(
            f"rule = {shown(rule)}: must be a function of a module, so that the run can be reproduced: put it there"
        )
    return f"{rule.__module__}:{rule.__name__}", _folder_of(_spec_of(rule))


def is_importable(function: Callable[..., Any]) -> bool:
    """Return whether another process finds this very function by its module and name."""
    module, name = function.__module__, getattr(function, "__name__", "")
    if module == "__main__" or getattr(sys.modules.get(module), name, None) is not function:
        return False
    try:
        return importlib.util.find_spec(module) is not None
    except (ImportError, ValueError):
        return False


def with_folder_of(function: Program | None, scenario: Scenario) -> Scenario:
    """Return the scenario with the folders in which this process finds its programs, where another would not.

    They are the function, or the scenario's entries, of which no earlier run's folders count.
    """
    program = scenario.program
    if function is None:
        tops = [str(each.entry).partition(":")[0].partition(".")[0] for each in (program, *program.exceptions)]
        everybodys = os.environ.get("PYTHONPATH", "").split(os.pathsep)
        path = [each for each in path_without_programs() if each not in everybodys]
        found = [_folder_of(PathFinder.find_spec(top, path)) for top in filter(None, tops) if top not in OWN]
        found = [folder for folder in found if folder != Path.cwd()]
    else:
        found = [_folder_of(_spec_of(function))] if is_importable(function) else []
    folders = dict.fromkeys(folder for folder in found if folder is not None and folder not in program.folders)
    if not folders:
        return scenario
    program = program.model_copy(update={"folders": (*program.folders, *folders)})
    return scenario.model_copy(update={"program": program})


def _spec_of(function: Callable[..., Any]) -> ModuleSpec | None:
    """Return where the package of a function is found; None for one of vnet's own."""
    top = function.__module__.partition(".")[0]
    return None if top in OWN else importlib.util.find_spec(top)


def _folder_of(spec: ModuleSpec | None) -> Path | None:
    """Return the folder in which a module is found; None if it is not, or is installed."""
    places = [] if spec is None else spec.submodule_search_locations or [spec.origin or ""]
    folder = Path(next(iter(places), "")).parent
    return folder if folder.is_absolute() and folder.name not in INSTALLED else None


def name_of(function: Program) -> str:
    """Return the name of a function and its module, for messages."""
    return f"{getattr(function, '__qualname__', shown(function))} of {function.__module__}"
