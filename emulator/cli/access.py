"""`vnet access`: the users of a run, and the configuration of a separate router."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from emulator.cli.options import (
    DEFAULT_LISTEN,
    HostsOption,
    ProgramOption,
    ScenarioArgument,
    SetOption,
    host_names,
    load,
)
from emulator.drivers.join import split_into_processes
from emulator.scenario.scenario import Scenario
from emulator.terminal.console import one_line_errors
from emulator.world.world import World, build_world
from vnet.errors import TransportError, counted
from vnet.transport.access import Access, certifier, is_tls

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
    hosts: HostsOption = None,
    program: ProgramOption = None,
    overrides: SetOption = None,
) -> None:
    """Write the configuration of a separate router (zenohd) and everybody's credentials."""
    with one_line_errors():
        loaded = load(scenario, overrides, program)
        users = create_access(loaded, build_world(loaded), listen, tls_name or (), host_names(hosts))
        users.save(out, listen, router_folder or out.resolve())
        who = counted(len(users.processes), "agent process", "agent processes")
        if users.hosts:
            who = f"{counted(len(users.hosts), 'host')} with {who}"
        print(f"{who}, and the emulator, in {out}/credentials")
        print(f"start the router with: zenohd -c {shlex.quote(str(out / 'zenohd.json5'))}")


def create_access(
    scenario: Scenario,
    world: World,
    listen: str = "",
    tls_names: Sequence[str] = (),
    hosts: Sequence[str] = (),
) -> Access:
    """New users of a run, on these hosts; with certificates where the router listens at tls/HOST:PORT."""
    groups = split_into_processes(world.node_ids, scenario.run.nodes_per_process)
    certify = certifier(listen, tls_names) if is_tls(listen) else None
    return Access.create(scenario.run.name, groups, certify, hosts, scenario.unit_ids)


def load_or_create_access(
    scenario: Scenario, world: World, folder: Path, listen: str, separate: bool, hosts: Sequence[str] = ()
) -> Access:
    """The users of a run whose agents are started elsewhere; new ones, not yet saved, where `folder` has none.

    Raises TransportError for those of another scenario, or of other `hosts`, if any are given.
    """
    if (folder / "access.json").exists() or separate:
        access = Access.load(folder)
        nodes = {node for process in access.processes for node in process}
        is_same = nodes == set(world.node_ids) and set(access.units) == set(scenario.unit_ids)
        if access.run != scenario.run.name or not is_same:
            raise TransportError(
                f"access folder {folder} was made for another scenario; write a new one with: vnet access"
            )
        groups = split_into_processes(world.node_ids, scenario.run.nodes_per_process)
        if access.hosts and [list(nodes) for nodes in access.processes] != groups:
            raise TransportError(
                f"access folder {folder} was made for another run.nodes_per_process; "
                "write a new one with: vnet access"
            )
        if hosts and list(hosts) != list(access.hosts):
            made = ",".join(access.hosts) or "no hosts"
            raise TransportError(f"--hosts {','.join(hosts)}: access folder {folder} was made for {made}")
        return access
    return create_access(scenario, world, listen, hosts=hosts)
