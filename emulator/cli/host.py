"""`vnet host`: the agents of one host of a run on several hosts."""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path
from typing import Annotated

import typer

from emulator.terminal.console import one_line_errors
from vnet.errors import TransportError, VnetError
from vnet.runtime.die_with_parent import STARTED_BY_VNET, signal_at_parent_death

NO_EMULATOR = 3
"""Exit status of a host that was refused or has lost the emulator, as that of `vnet-agent`."""


def host(
    connect: Annotated[
        str,
        typer.Option(metavar="ENDPOINT", help="Of the emulator, or of its router: tcp/HOST:PORT or tls/HOST:PORT."),
    ],
    run: Annotated[str, typer.Option(metavar="NAME", help="The name of the run: run.name of its scenario.")],
    credentials: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Of this host: access/credentials/host-NAME.json.")
    ] = None,
    name: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="This host's name in --hosts. Default: its credentials' one."),
    ] = None,
    join_timeout_s: Annotated[
        float, typer.Option(metavar="SECONDS", help="How long to wait for the emulator's welcome.")
    ] = 60.0,
    path: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="FOLDER", help="Look for the programs here, before the current folder. May be repeated."
        ),
    ] = None,
) -> None:
    """Start the vehicles of one host, and speak for them, until the run ends (experimental)."""
    with one_line_errors():
        from emulator.drivers.hosts.host import run_host
        from vnet.transport.access import host_user
        from vnet.transport.credentials import Credentials
        from vnet.transport.keys import SEGMENTS, is_segment
        from vnet.transport.session import quiet_zenoh

        login = None if credentials is None else Credentials.load(credentials)
        if name is None:
            if login is None or not login.user.startswith(host_user("")):
                raise VnetError("--name: which host is this? The credentials are not those of a host")
            name = login.user.removeprefix(host_user(""))
        for each in (run, name):
            if not is_segment(each):
                raise VnetError(f"{each!r}: {SEGMENTS}")
        if os.environ.get(STARTED_BY_VNET):
            signal_at_parent_death(signal.SIGKILL)
        quiet_zenoh()
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        try:
            run_host(connect, run, name, login, path or (), join_timeout_s, _say)
        except TransportError as error:
            _say(str(error))
            raise typer.Exit(NO_EMULATOR) from None


def _say(line: str) -> None:
    print(f"vnet: {line}", file=sys.stderr, flush=True)
