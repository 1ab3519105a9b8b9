"""Start of Python in the commands of Zenoh vehicles: `zenoh.open` heeds `ZENOH_CONFIG_OVERRIDE`, as rmw_zenoh does.

Python finds it by `PYTHONPATH`, also where vnet is not installed. So programs with `zenoh.Config()`, or an endpoint
of their own, are clients of their vehicle's router, and no peers of other vehicles past the radio.

A main thread that ends by an exception, or with another status than 0, ends its program at once, and leaves a
report, which vnet reads once the process has ended. Python would wait for other threads, and Zenoh has one for each
callback: the program would stay, and nobody would see that it has failed.

Imports no module whose name a program might have.
"""

from __future__ import annotations

import gc
import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from functools import lru_cache
from importlib import import_module
from importlib.machinery import ModuleSpec
from importlib.util import module_from_spec, spec_from_file_location
from types import ModuleType
from typing import Any, NoReturn

INTERRUPTED = 130
"""Status of a program that an interrupt has ended."""
_code: Any = vars(SystemExit)["code"]
_left: list[SystemExit] = []
"""The exception by which the main thread has left, once it has."""


class ZenohFinder:
    """Finds `zenoh` as Python does, and has its `open` changed once it is loaded."""

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return how to load `zenoh`; None for any other module."""
        if name != "zenoh":
            return None
        found = (each.find_spec(name, path, target) for each in sys.meta_path if each is not self)
        spec = next(filter(None, found), None)
        if spec is not None and spec.loader is not None:
            execute = spec.loader.exec_module

            def load(module: ModuleType) -> None:
                execute(module)
                check_version(module)
                open_with_override(module)
                if reports:
                    watch_main_thread(reports.pop())

            spec.loader.exec_module = load  # type: ignore[method-assign]
        return spec


def check_version(zenoh: Any) -> None:
    """Raise ImportError for a Zenoh of another protocol, which would only find that nobody answers."""
    if not hasattr(zenoh, "ZBytes"):  # as importlib.metadata would say, with modules that programs may have, too
        raise ImportError(f"{zenoh.__file__} cannot connect to vnet's endpoints, which are of Zenoh 1")


def open_with_override(zenoh: Any) -> None:
    """Have `zenoh.open` change each configuration as the environment says: a copy would lose keys of TLS."""
    opened = zenoh.open

    def open(config: Any, **options: Any) -> Any:
        if "VNET_OUTSIDE" in os.environ:
            raise zenoh.ZError("a child process on virtual time is outside of the emulation, and opens no session")
        changes = os.environ.get("ZENOH_CONFIG_OVERRIDE", "") if isinstance(config, zenoh.Config) else ""
        for setting in filter(None, changes.split(";")):
            config.insert_json5(*setting.split("=", 1))
        return opened(config, **options)

    zenoh.open = open
    vars(zenoh).get("zenoh", zenoh).open = open  # the compiled part, as which `from zenoh import *` binds `zenoh`


class _Code:
    """`SystemExit.code`: Python asks for it outside of any function when the main thread has left by it."""

    def __get__(self, error: SystemExit | None, kind: type) -> Any:
        if error is None:
            return self
        try:
            sys._getframe(1)
        except ValueError:
            _left.append(error)
        return _code.__get__(error)

    def __set__(self, error: SystemExit, code: object) -> None:
        _code.__set__(error, code)


def _exit(status: Any = None, /) -> NoReturn:
    """Do as `sys.exit`; the exception keeps its place, which before Python 3.12 the end does not show."""
    error: Any = SystemExit(status)
    error._place = _error_text().line_of_caller()
    raise error


@lru_cache
def _error_text() -> Any:
    """Return vnet's module of this name, also where vnet is not installed."""
    path = f"{__file__.rpartition('/gateway/')[0]}/runtime/error_text.py"
    spec: Any = spec_from_file_location("_vnet_error_text", path)
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _failure() -> BaseException | None:
    """Return the exception that has ended the main thread, if it has failed."""
    if _left:
        return _left[0] if _left[0].code not in (None, 0) else None
    error: Any = getattr(sys, "last_exc", None) or getattr(sys, "last_value", None)
    trace = getattr(error, "__traceback__", None)
    ends_main = trace is not None and trace.tb_frame.f_code.co_name in ("<module>", "_run_module_as_main")
    return error if ends_main else None


def _leave(status: Any) -> None:
    import_module("atexit")._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        with suppress(AttributeError, OSError, ValueError):
            stream.flush()
    os._exit(status & 0xFF if isinstance(status, int) else 1)


def note_exits() -> None:
    """Take note of the exception by which the main thread leaves. Before any program has looked at such a one."""
    gc.get_referents(vars(SystemExit))[0]["code"] = _Code()
    sys.exit = _exit


def watch_main_thread(path: str) -> None:
    """Have a failure of this process's main thread written to a file, and end the process."""
    process, threading = os.getpid(), import_module("threading")
    wait_for_threads = threading._shutdown

    def end() -> None:
        error = _failure() if os.getpid() == process else None
        if error is not None:
            status: Any = INTERRUPTED if isinstance(error, KeyboardInterrupt) else None
            status = error.code if isinstance(error, SystemExit) else status
            _error_text().write_report(path, error, status, getattr(error, "_place", ""))
            if any(not each.daemon for each in threading.enumerate() if each is not threading.main_thread()):
                _leave(status)
        wait_for_threads()

    vars(threading)["_shutdown"] = end


sys.meta_path.insert(0, ZenohFinder())
reports = list(filter(None, [os.environ.pop("VNET_FAILURE", None)]))
"""The file for a failure of this process, and of none that it starts."""
if reports:
    note_exits()
# The one that this one hides runs as well.
sys.path.remove(__file__.rpartition("/")[0])
own = sys.modules.pop("sitecustomize")
try:
    import_module("sitecustomize")
except ImportError as error:
    if error.name != "sitecustomize":
        raise
    sys.modules["sitecustomize"] = own
