"""The module `zenoh` that a program of a vehicle imports, and the program's run."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from functools import partial
from types import ModuleType
from typing import Any

import zenoh
import zenoh.ext
import zenoh.handlers
import zenoh.shm

from vnet.errors import ProgramError
from vnet.gateway.emulated import advanced, queries, sessions, values
from vnet.gateway.emulated.facade import Facade
from vnet.gateway.emulated.modules import ProgramModules
from vnet.gateway.emulated.values import Outlet, refused
from vnet.gateway.emulated.vehicle import Vehicle

_NO_TRANSPORT = "sessions of the emulator have no transport"
_NO_STACK = "a frame of the radio carries no stack of timestamps"
REFUSED = {
    **dict.fromkeys(["Link", "LinkEvent", "LinkEventsListener"], _NO_TRANSPORT),
    **dict.fromkeys(["TimestampContext", "TimestampStack", "TimestampStackRecord"], _NO_STACK),
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


def zenoh_modules(vehicle: Vehicle, program: ProgramModules) -> dict[str, ModuleType]:
    """Return the package `zenoh` of a program, by the names of its modules."""
    outlet = Outlet(vehicle.due, program.threads)

    def open_session(config: zenoh.Config, *, timestamp_callback: object = None) -> sessions.Session:
        if timestamp_callback is not None:
            raise zenoh.ZError("timestamp_callback is not available on virtual time")
        program.has_session = True
        return sessions.Session(vehicle, outlet, config)

    def scout(handler: Any = None, what: Any = None, config: zenoh.Config | None = None) -> sessions.Scout:
        return sessions.Scout(vehicle, outlet, handler, what)

    # Values that Python can construct are Zenoh's own.
    handlers, ext = (Facade(real, **_own_names(real)) for real in (zenoh.handlers, zenoh.ext))
    own = _own_names(zenoh) | {name: refused(name, reason) for name, reason in REFUSED.items()}
    own["Config"] = type("Config", (values.Config,), {"environ": program.environ})
    package = Facade(
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
    return {"zenoh": package, "zenoh.ext": ext, "zenoh.handlers": handlers, "zenoh.shm": zenoh.shm}


async def run_program(vehicle: Vehicle, words: Sequence[str]) -> None:
    """Run a program of a vehicle to its end. Raises what ends it, ProgramError for a status other than 0."""
    modules = ProgramModules(vehicle.node)
    modules.modules.update(zenoh_modules(vehicle, modules))
    try:
        await modules.threads.run_main(partial(modules.run, words))
    except SystemExit as leave:
        if leave.code not in (None, 0):
            ended = ProgramError(f"{' '.join(words)} ended with {leave.code!r}")
            raise ended.with_traceback(leave.__traceback__) from leave
    finally:
        if not modules.has_session and not isinstance(sys.exception(), Exception):
            vehicle.node.log(f"{' '.join(words)} has opened no Zenoh session", "warning")
        modules.modules.close()
