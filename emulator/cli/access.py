"""`vnet access`: the users of a run, and the configuration of a separate router."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from emulator.cli.options import DEFAULT_LISTEN, ScenarioArgument, SetOption, load
from emulator.drivers.join import split_into_processes
from emulator.scenario.scenario import Scenario
from emulator.terminal.console import one_line_errors
from emulator.world.world import World, build_world
from vnet.errors import TransportError
from vnet.transport.access import Access, is_tls
from vnet.transport.certificates import certifier

TlsNameOption = Annotated[
    list[str] | None,
    typer.Option(
        "--tls-name", metavar="NAME", help="A further name or address of the router, for its certificate."
    ),
]


def access(
    scenario: ScenarioArgument,
    out: Annotated[Path, typer.Option(metavar="FOLDER", help="For the files.")] = Path("access"),
    listen: Annotated[
        str,
        typer.Option(
            metavar="ENDPOINT",
            help="Where the zenohd is to listen; at tls/HOST:PORT everybody gets a certificate.",
        ),
    ] = DEFAULT_LISTEN,
    tls_name: TlsNameOption = None,
    router_folder: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="Where the zenohd sees --out, if elsewhere (in a container)."),
    ] = None,
    overrides: SetOption = None,
) -> None:
    """Write the configuration of a separate router (zenohd) and everybody's credentials."""
    with one_line_errors():
        loaded = load(scenario, overrides)
        users = create_access(loaded, build_world(loaded), listen, tls_name or ())
        users.save(out, listen, router_folder or out.resolve())
        print(f"{len(users.processes)} agent processes, and the emulator, in {out}/credentials")
        print(f"start the router with: zenohd -c {shlex.quote(str(out / 'zenohd.json5'))}")


def create_access(scenario: Scenario, world: World, listen: str = "", tls_names: Sequence[str] = ()) -> Access:
    """New users of a run; with certificates where the router listens at tls/HOST:PORT."""
    groups = split_into_processes(world.node_ids, scenario.run.nodes_per_process)
    return Access.create(scenario.run.name, groups, certifier(listen, tls_names) if is_tls(listen) else None)


def load_or_create_access(scenario: Scenario, world: World, folder: Path, listen: str, separate: bool) -> Access:
    """The users of a run whose agents are started by hand; new ones, not yet saved, where `folder` has none."""
    if (folder / "access.json").exists() or separate:
        access = Access.load(folder)
        nodes = {node for process in access.processes for node in process}
        if access.run != scenario.run.name or nodes != set(world.node_ids):
            raise TransportError(
                f"access folder {folder} was made for another scenario; write a new one with: vnet access"
            )
        return access
    return create_access(scenario, world, listen)
