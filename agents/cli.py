"""`vnet-agent`: one vehicle process, with one or more nodes, attached to an emulator over Zenoh."""

from __future__ import annotations

import contextlib
import faulthandler
import fcntl
import os
import signal
import sys
import termios
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vnet.errors import ProgramError, VnetError
from vnet.runtime import interrupts
from vnet.runtime.die_with_parent import STARTED_BY_VNET, signal_at_parent_death
from vnet.runtime.environment import fix_hash_seed, open_standard_descriptors, use_same_arithmetic
from vnet.runtime.programs import search_programs_in

if TYPE_CHECKING:
    from vnet.runtime.debugger import NodeDebugger

LONGEST_TIMEOUT_S = 86_400.0
"""Longest time for which an agent waits to connect or to be welcomed: a day."""

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)


def _print_version(asked: bool) -> None:
    if asked:
        from importlib.metadata import version  # slow to import, and no vehicle needs it

        print(f"vnet-agent {version('vnet-emulator')}")
        raise typer.Exit


@app.command()
def agent(
    connect: Annotated[
        str,
        typer.Option(metavar="ENDPOINT", help="Of the emulator, or of its router: tcp/HOST:PORT or tls/HOST:PORT."),
    ],
    run: Annotated[str, typer.Option(metavar="NAME", help="The name of the run: run.name of its scenario.")],
    node: Annotated[list[str], typer.Option(metavar="ID", help="A vehicle of this process; once for each.")],
    credentials: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Of this process: access/credentials/ID.json, with the first ID."),
    ] = None,
    join_timeout_s: Annotated[
        float, typer.Option(metavar="SECONDS", help="How long to wait for the emulator's welcome.")
    ] = 60.0,
    connect_timeout_s: Annotated[
        float, typer.Option(metavar="SECONDS", help="How long to wait for an answer at ENDPOINT.")
    ] = 5.0,
    path: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="FOLDER", help="Look for the program here, before the current folder. May be repeated."
        ),
    ] = None,
    files: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="Vehicles have their disks (node.folder) here, in FOLDER/ID, and find them again after a restart; "
            "a temporary folder if left out.",
        ),
    ] = None,
    debug: Annotated[
        str | None, typer.Option(hidden=True, help="Stop a debugger in this vehicle's program: NODE[:FILE:LINE].")
    ] = None,
    debug_socket: Annotated[
        Path | None, typer.Option(hidden=True, help="The debugger's user answers here.")
    ] = None,
    show_version: Annotated[
        bool,
        typer.Option(
            "--version", metavar="", callback=_print_version, is_eager=True, help="Show the version and exit."
        ),
    ] = False,
) -> None:
    """Join a run as one or more vehicles and run the scenario's program until the run ends."""
    from agents.host import run_agent  # these import numpy, before which `main` sets its number of threads
    from vnet.runtime.host import Disks
    from vnet.transport.credentials import Credentials
    from vnet.transport.keys import SEGMENTS, is_segment
    from vnet.transport.session import quiet_zenoh

    interrupts.raise_from_now_on()
    faulthandler.register(signal.SIGUSR1)
    # An emulator, or host, that is killed takes along the agents that it has started, also those that are paused or
    # in a busy loop. Agents that were started by hand find that they are orphans, and end.
    signal_at_parent_death(signal.SIGKILL if os.environ.get(STARTED_BY_VNET) else signal.SIGCONT)
    _leave_terminal()
    _pass_breakpoints()
    search_programs_in(path or ())
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    os.register_at_fork(after_in_child=_end_at_sigterm)
    quiet_zenoh()
    try:
        for name in [run, *node]:
            if not is_segment(name):
                raise VnetError(f"{name!r}: {SEGMENTS}")
        _check_timeout("--connect-timeout-s", connect_timeout_s)
        _check_timeout("--join-timeout-s", join_timeout_s)
        login = None if credentials is None else Credentials.load(credentials)
        debugger = None if debug is None or debug_socket is None else _debugger(debug, debug_socket)
        run_agent(connect, run, node, login, join_timeout_s, Disks(files), debugger, connect_timeout_s)
    except VnetError as error:
        print(f"vnet-agent: {error}", file=sys.stderr)
        sys.exit(2 if isinstance(error, ProgramError) else 3)
    except KeyboardInterrupt:
        sys.exit(130)


def _end_at_sigterm() -> None:
    """Have what a program forks end at SIGTERM as other processes do, unless the program handles it."""
    if signal.getsignal(signal.SIGTERM) is signal.default_int_handler:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


def _check_timeout(option: str, timeout_s: float) -> None:
    """Raise VnetError for a time that cannot be waited."""
    if not 0 < timeout_s <= LONGEST_TIMEOUT_S:
        raise VnetError(f"{option} {timeout_s:g}: a time above 0 s, and up to {LONGEST_TIMEOUT_S:g} s, is needed")


def _debugger(target: str, socket: Path) -> NodeDebugger:
    """Return a debugger whose user answers at `socket`."""
    from vnet.runtime.debug_target import DebugTarget
    from vnet.runtime.debugger import (
        NodeDebugger,  # pdb, which few agents need
        RemoteTerminal,
    )

    terminal = RemoteTerminal(socket)
    return NodeDebugger(DebugTarget.parse(target), terminal.open, terminal.quit, terminal, terminal)


def _pass_breakpoints() -> None:
    """Have `breakpoint()` pass where nobody could answer, unless PYTHONBREAKPOINT names a debugger."""
    if os.isatty(0) or os.environ.get("PYTHONBREAKPOINT"):
        return
    told: list[str] = []

    def passed(*args: object, **options: object) -> None:
        if not told:
            told.append("breakpoint() is passed over: there is no terminal here; vnet run --debug NODE stops at it")
            print(f"vnet-agent: {told[0]}", file=sys.stderr, flush=True)

    sys.breakpointhook = passed


def _leave_terminal() -> None:
    """Have no terminal where the emulator has started this process, in the background of its own.

    A program that asked something there would be stopped for good; so it fails.
    """
    if os.getpid() != os.getpgrp() or os.getpid() == os.getsid(0) or os.isatty(0):
        return
    with contextlib.suppress(OSError):
        terminal = os.open("/dev/tty", os.O_RDWR | os.O_NOCTTY)
        try:
            fcntl.ioctl(terminal, termios.TIOCNOTTY)
        finally:
            os.close(terminal)


def main() -> None:
    """The console script."""
    interrupts.end_at_once()
    open_standard_descriptors()
    use_same_arithmetic()
    fix_hash_seed("agents.cli")
    app(prog_name="vnet-agent")


if __name__ == "__main__":
    main()
