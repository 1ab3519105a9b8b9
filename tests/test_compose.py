"""compose.yaml: its structure, and that every command in it parses. No Docker engine is needed."""

import shlex

import pytest
import typer.main
import yaml

import agents.cli
import emulator.cli.commands
from emulator.scenario.scenario import load_scenario
from emulator.world.world import build_world
from tests.support.paths import ROOT

COMPOSE = yaml.safe_load((ROOT / "compose.yaml").read_text())
SERVICES = COMPOSE["services"]
PROGRAMS = {"vnet": emulator.cli.commands.app, "vnet-agent": agents.cli.app}
SCENARIO = load_scenario(ROOT / "scenarios" / "beacon.toml")


def options(service: str) -> dict[str, object]:
    """The parameters that a service's command line parses into."""
    program, *arguments = shlex.split(SERVICES[service]["command"])
    command = typer.main.get_command(PROGRAMS[program])
    context = command.make_context(program, arguments, resilient_parsing=False)
    if isinstance(command, typer.core.TyperGroup):
        name, chosen, rest = command.resolve_command(context, [*context._protected_args, *context.args])
        assert chosen is not None
        context = chosen.make_context(name, rest, parent=context)
    return context.params


@pytest.mark.parametrize("name", SERVICES)
def test_services_hang_together(name: str) -> None:
    service = SERVICES[name]
    assert ("image" in service) != ("build" in service)
    assert set(service["networks"]) <= set(COMPOSE["networks"])
    assert set(service.get("depends_on", [])) <= set(SERVICES)
    assert "ports" not in service, "nothing is published to the host"
    assert "./access:/access:ro" in service["volumes"]


def test_the_router_is_zenohd_of_the_pinned_version() -> None:
    pinned = dict(line.split("==") for line in (ROOT / "constraints.txt").read_text().splitlines() if "==" in line)
    assert SERVICES["zenohd"]["image"] == f"eclipse/zenoh:{pinned['eclipse-zenoh']}"
    assert SERVICES["zenohd"]["command"] == ["-c", "/access/zenohd.json5"]


def test_every_vehicle_of_the_scenario_has_its_agent() -> None:
    agents_of = {name for name in SERVICES if str(SERVICES[name]["command"]).startswith("vnet-agent")}
    assert agents_of == set(build_world(SCENARIO).node_ids)
    for name in agents_of:
        parsed = options(name)
        assert parsed["node"] == [name]
        assert parsed["run"] == SCENARIO.run.name
        assert parsed["connect"] == "tcp/zenohd:7447"
        assert str(parsed["credentials"]) == f"/access/credentials/{name}.json"


def test_the_emulator_is_a_client_of_the_router_and_the_recorder_watches() -> None:
    emulator_options = options("emulator")
    assert emulator_options["connect"] == "tcp/zenohd:7447"
    assert str(emulator_options["scenario"]) == "scenarios/beacon.toml"
    assert str(emulator_options["access"]) == "/access"
    assert options("recorder")["run"] == SCENARIO.run.name


def test_the_image_holds_what_the_commands_need() -> None:
    text = (ROOT / "Dockerfile").read_text()
    for path in ("vnet", "agents", "emulator", "scenarios", "pyproject.toml", "constraints.txt"):
        assert f" {path}" in text
        assert (ROOT / path).exists()
