"""`vnet run`, `vnet simulate`, `vnet emulator` and `vnet demo`: a scenario from its file to its verdict.

What runs it is imported once it has been read, and the user told so: that takes longer than all before.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from emulator.cli.options import (
    DEFAULT_LISTEN,
    AgentOption,
    DebugOption,
    DeterminismOption,
    DurationOption,
    HostsOption,
    LiveOptions,
    OutOption,
    ProcessesOption,
    RunOptions,
    debug_target,
    host_names,
    spread,
)
from emulator.cli.own_child import OwnChild, may_fork
from emulator.scenario.faults import refuse_router_restart
from emulator.scenario.loading import find_scenario
from emulator.scenario.scenario import Scenario
from emulator.terminal.console import one_line_errors, result_only, say_first
from emulator.viewer.sinks import choose_sinks
from vnet.errors import VnetError
from vnet.extras import require
from vnet.runtime.interrupts import ended_at_once


@spread
def run(
    asked: LiveOptions,
    check_determinism: DeterminismOption = None,
    router: Annotated[
        Literal["embedded", "separate"],
        typer.Option(help="The emulator is the router itself, or starts one as a separate process."),
    ] = "embedded",
    hosts: Annotated[
        int | None,
        typer.Option(
            metavar="N", min=1, help="Start the vehicles from N hosts (vnet host) on this machine (experimental)."
        ),
    ] = None,
    agent: AgentOption = None,
    debug: DebugOption = None,
) -> None:
    """Run a scenario: start the emulator and one process a vehicle, and judge what happened."""
    with one_line_errors(asked.log_format), result_only(asked.only_the_result) as stdout:
        loaded = asked.load(asked.pacing)
        if check_determinism is not None and loaded.run.pacing == "realtime":
            raise VnetError("--check-determinism: in real time no two runs are alike; use --pacing lockstep")
        if router != "separate" and not loaded.has_gateways:
            refuse_router_restart(loaded.fault)
        sinks = choose_sinks(asked.rerun or (), asked.rerun_bind, asked.rerun_port, asked.rerun_vehicle)
        _refuse_hosts_of_gateways(loaded, hosts)
        if debug is not None and hosts is not None:
            raise VnetError("--debug and --hosts exclude each other")
        if agent is not None and (debug is not None or hosts is not None or check_determinism is not None):
            raise VnetError("--agent excludes --debug, --hosts and --check-determinism")
        target = debug_target(debug, loaded, asked.only_the_result)
        _announce(loaded, asked)
        with ended_at_once():
            from emulator.cli.execution import Request, run_with_processes

        request = Request(loaded, asked, sinks, stdout, check_determinism, target)
        own_hosts = [str(1 + number) for number in range(hosts or 0)]
        run_with_processes(request, router == "separate", own_hosts, agent)


@spread
def simulate(
    asked: RunOptions,
    check_determinism: DeterminismOption = None,
    processes: ProcessesOption = "1",
    debug: DebugOption = None,
) -> None:
    """Run a scenario without Zenoh, in lockstep, in one process or in a few: the same trace, faster."""
    with one_line_errors(asked.log_format), result_only(asked.only_the_result) as stdout:
        loaded = asked.load("lockstep")
        sinks = choose_sinks(asked.rerun or (), vehicle=asked.rerun_vehicle, live=False)
        if debug is not None and processes != "1":
            raise VnetError("--debug and --processes exclude each other")
        target = debug_target(debug, loaded, asked.only_the_result)
        _announce(loaded, asked)
        child, apart = OwnChild(), None
        if processes == "1" and target is None and may_fork():
            apart = child.fork(loaded.run.stall_timeout_s)
        if apart is not None and not asked.only_the_result:
            say_first(f"{apart or 'a program'} {child.ending} the process of all: again, with a process a vehicle")
        with ended_at_once():
            from emulator.cli.execution import Request, run_simulated

        request = Request(loaded, asked, sinks, stdout, check_determinism, target)
        run_simulated(request, processes, child.told, apart, child.ending == "stalled")


@spread
def emulator(
    asked: LiveOptions,
    listen: Annotated[
        str | None,
        typer.Option(
            metavar="ENDPOINT",
            help=f"Be the router, at tcp/HOST:PORT or tls/HOST:PORT. Default: {DEFAULT_LISTEN}.",
        ),
    ] = None,
    connect: Annotated[
        str | None, typer.Option(metavar="ENDPOINT", help="Be a client of the zenohd that is there.")
    ] = None,
    access: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER", help="Users, as vnet access wrote them; made if not there. Default: OUT/access."
        ),
    ] = None,
    hosts: HostsOption = None,
) -> None:
    """Run a scenario for hosts, or for agents that are started by hand, here or on other machines."""
    with one_line_errors(asked.log_format), result_only(asked.only_the_result) as stdout:
        if listen is not None and connect is not None:
            raise VnetError("--listen and --connect exclude each other")
        loaded = asked.load(asked.pacing)
        _refuse_hosts_of_gateways(loaded, hosts)
        if not loaded.has_gateways:
            refuse_router_restart(loaded.fault)
        sinks = choose_sinks(asked.rerun or (), asked.rerun_bind, asked.rerun_port, asked.rerun_vehicle)
        _announce(loaded, asked)
        with ended_at_once():
            from emulator.cli.execution import Request, run_for_agents

        request = Request(loaded, asked, sinks, stdout)
        run_for_agents(request, listen, connect, access, host_names(hosts))


def _refuse_hosts_of_gateways(scenario: Scenario, hosts: object) -> None:
    if hosts and scenario.has_gateways:
        raise VnetError(
            "--hosts: in real time Zenoh programs run beside the emulator; hosts run them in lockstep only"
        )


def _announce(scenario: Scenario, asked: RunOptions) -> None:
    """Say what is going to run, before anything that takes time. Raises ScenarioError where an extra is missing."""
    scenario.require_extras()
    run = scenario.run
    if not asked.only_the_result:
        say_first(f"{run.name}: {run.pacing}, seed {run.seed}, {run.duration_s:g} s of emulated time")


def demo(duration: DurationOption = None, out: OutOption = None) -> None:
    """Run the shipped scenario quickstart: 38 vehicles with a process each, recorded for Rerun.

    It is `vnet run quickstart --rerun save`.
    """
    with one_line_errors():
        require("vnet demo", "rerun", "scipy", "osqp")
    run(scenario=find_scenario("quickstart"), duration=duration, out=out, rerun=["save"])
