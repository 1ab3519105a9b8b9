"""Python programs that `import zenoh`, unmodified, as vehicles on virtual time.

`main` is the program of a vehicle that runs others: they find a `zenoh` of the vehicle's own, whose sessions talk
by its radio, and `time`, `threading` and other modules on the emulated clock. docs/how-to/zenoh.md is the guide.
"""

from __future__ import annotations

import asyncio
import sys
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from types import FrameType, ModuleType, TracebackType
from typing import Any

import zenoh
import zenoh.ext
import zenoh.handlers
import zenoh.shm

from vnet.errors import ProgramError
from vnet.gateway import filled_in
from vnet.gateway.emulated import advanced, queries, sessions, values
from vnet.gateway.emulated.modules import ENDPOINT, ProgramModules, is_program
from vnet.gateway.emulated.process import children_outside
from vnet.gateway.emulated.shown import facade
from vnet.gateway.emulated.strands import go_no_further_if_ended
from vnet.gateway.emulated.values import NO_STACK, Intake, Outlet, refused
from vnet.gateway.emulated.vehicle import Vehicle
from vnet.gateway.ros2 import Ros2
from vnet.node import Node
from vnet.runtime.error_text import of_program
from vnet.runtime.own_asyncio import Task
from vnet.runtime.virtual_time import VirtualTimeLoop

_NO_TRANSPORT = "sessions of the emulator have no transport"
REFUSED = {
    **dict.fromkeys(["Link", "LinkEvent", "LinkEventsListener"], _NO_TRANSPORT),
    **dict.fromkeys(["TimestampContext", "TimestampStack", "TimestampStackRecord"], NO_STACK),
    **dict.fromkeys(["Transport", "TransportEvent", "TransportEventsListener"], _NO_TRANSPORT),
}
"""Names of Zenoh that virtual time does not have, and why."""
_EMULATED = (values, queries, sessions, advanced)


def _own_names(real: ModuleType) -> dict[str, Any]:
    """Return what stands here for names of one of Zenoh's modules."""
    return {
        name: own
        for module in _EMULATED
        for name, own in vars(module).items()
        if name in vars(real) and getattr(own, "__module__", "") == module.__name__
    }


_open = zenoh.open


def _open_outside(*args: Any, **options: Any) -> Any:
    """Open a session of Zenoh itself, but for modules that a program has loaded past its own."""
    if is_program():
        raise zenoh.ZError("this module is not the program's own: its Zenoh is outside of the emulation")
    return _open(*args, **options)


zenoh.open = _open_outside


def zenoh_modules(vehicle: Vehicle, program: ProgramModules) -> dict[str, ModuleType]:
    """Return the package `zenoh` of a program, by the names of its modules."""

    def new_outlet() -> Outlet:
        return Outlet(vehicle.due, program.threads, Intake())

    def open_session(config: zenoh.Config, *, timestamp_callback: object = None) -> sessions.Session:
        if timestamp_callback is not None:
            raise zenoh.ZError("timestamp_callback is not available on virtual time")
        go_no_further_if_ended()
        session = sessions.Session(vehicle, new_outlet(), config)
        program.has_session = True
        program.sessions = [*(each for each in program.sessions if not each.is_closed()), session]
        return session.of_program()

    def scout(handler: Any = None, what: Any = None, config: zenoh.Config | None = None) -> sessions.Scout:
        return sessions.Scout(vehicle, new_outlet(), handler, what)

    # Values that Python can construct are Zenoh's own.
    handlers, ext = (facade(real, **_own_names(real)) for real in (zenoh.handlers, zenoh.ext))
    own = _own_names(zenoh) | {name: refused(name, reason) for name, reason in REFUSED.items()}
    own["Config"] = type("Config", (values.Config,), {"environ": program.environ})
    package = facade(
        zenoh,
        **own,
        __path__=[],
        ext=ext,
        handlers=handlers,
        open=open_session,
        scout=scout,
        try_init_log_from_env=lambda: None,
        init_log_from_env_or=lambda level: None,
    )
    vars(package)["zenoh"] = package  # in Zenoh its compiled part, which has the same names
    parts = {"zenoh": package, "ext": ext, "handlers": handlers, "shm": zenoh.shm}
    return {"zenoh": package} | {f"zenoh.{name}": part for name, part in parts.items()}


async def main(node: Node) -> None:
    """Run the programs of a scenario with `program.kind = "zenoh"` until all have ended.

    `node.options` has their commands (`command`), variables of their `environment`, `keys` that cross the radio,
    `query_s` and `liveliness_s`, and `ros2`: the options of `[radio.ros2]`.
    """
    loop = asyncio.get_running_loop()
    if not isinstance(loop, VirtualTimeLoop):
        raise ProgramError('vnet.gateway.emulated needs run.pacing = "lockstep": in real time Zenoh itself runs')
    commands: Sequence[Sequence[str]] = node.options["command"]
    variables: Mapping[str, str] = node.options.get("environment", {})
    environment = dict(zip(variables, filled_in(variables.values(), node.id, ENDPOINT), strict=True))
    topics: Mapping[str, Any] | None = node.options.get("ros2")
    ros2 = None if topics is None else Ros2(node.id, topics["inside"], topics["domain"])
    query_s, liveliness_s = (node.options.get(name, 1.0) for name in ("query_s", "liveliness_s"))
    vehicle = Vehicle(node, node.options.get("keys"), query_s, liveliness_s, ros2)
    clock = [] if topics is None else [vehicle.tell_clock(topics["clock_hz"])]
    background = [Task(each, loop=loop) for each in [*vehicle.tasks(), *clock]]
    try:
        with children_outside():
            async with asyncio.TaskGroup() as tasks:
                for number, words in enumerate(commands):
                    filled = filled_in(words, node.id, ENDPOINT)
                    tasks.create_task(run_program(vehicle, filled, environment, number))
    except ExceptionGroup as errors:
        error = errors.exceptions[0]
        raise error.with_traceback(_without_imports(error.__traceback__)) from None
    except KeyboardInterrupt:  # of the whole process, which has heard of it by the command's task
        raise asyncio.CancelledError from None
    finally:
        for task in background:
            task.cancel()


def _without_imports(trace: TracebackType | None) -> TracebackType | None:
    """Return what of a traceback is the program's, without the import system's."""
    last = inner = of_program(trace)
    while last is not None:
        while last.tb_next is not None and _is_import(last.tb_next.tb_frame):
            last.tb_next = last.tb_next.tb_next
        last = last.tb_next
    return inner


def _is_import(frame: FrameType) -> bool:
    module = str(frame.f_globals.get("__name__"))
    return module == ProgramModules.__module__ or module.startswith("importlib._bootstrap")


async def run_program(vehicle: Vehicle, words: Sequence[str], environment: Mapping[str, str], number: int) -> None:
    """Run a program of a vehicle to its end. Raises what ends it, ProgramError for a status other than 0."""
    python = Path(words[0])
    if len(python.parts) > 1 and python.parent.resolve() != Path(sys.executable).parent.resolve():
        text = f"{python} is taken for {sys.executable}: on virtual time programs have this Python and its packages"
        vehicle.node.log(text, "warning")
    modules = ProgramModules(vehicle.node, environment, number)
    modules.modules.update(zenoh_modules(vehicle, modules))
    try:
        await modules.threads.run_main(partial(modules.run, words))
    except SystemExit as leave:
        if leave.code not in (None, 0):
            ended = ProgramError(f"{' '.join(words)} ended with {leave.code!r}")
            raise ended.with_traceback(leave.__traceback__) from leave
    finally:
        if not isinstance(sys.exception(), GeneratorExit):
            modules.threads.tell_failed()
        if not isinstance(sys.exception(), asyncio.CancelledError):
            modules.threads.stop_where_they_are()
            for session in modules.sessions:
                session.discard()
        if isinstance(sys.exception(), GeneratorExit):
            modules.threads.close_tasks()
        if not modules.has_session and not isinstance(sys.exception(), Exception):
            vehicle.node.log(f"{' '.join(words)} has opened no Zenoh session", "warning")
        modules.close()
