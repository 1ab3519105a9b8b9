"""compose.yaml: its structure, and that every command in it parses. No Docker engine is needed."""

import shlex

import pytest
import typer.main
import yaml

from emulator.cli.access import create_access
from emulator.cli.options import host_names
from emulator.scenario.loading import load_scenario
from emulator.world.world import build_world
from tests.support.command_line import app
from tests.support.paths import ROOT
from vnet.transport.access import OBSERVER, host_user

COMPOSE = yaml.safe_load((ROOT / "compose.yaml").read_text())
SERVICES = COMPOSE["services"]
SCENARIO = load_scenario(ROOT / "scenarios" / "beacon.toml")
CLIENTS = {"host-a", "host-b", "recorder"}
ENDPOINT = "tcp/emulator:7447"


def options(service: str) -> dict[str, object]:
    """The parameters that a service's command line parses into."""
    program, *arguments = shlex.split(SERVICES[service]["command"])
    assert program == "vnet"
    command = typer.main.get_command(app)
    context = command.make_context(program, arguments, resilient_parsing=False)
    assert isinstance(command, typer.core.TyperGroup)
    name, chosen, rest = command.resolve_command(context, [*context._protected_args, *context.args])
    assert chosen is not None
    return chosen.make_context(name, rest, parent=context).params


@pytest.mark.parametrize("name", SERVICES)
def test_services_hang_together(name: str) -> None:
    service = SERVICES[name]
    assert ("image" in service) != ("build" in service)
    assert set(service["networks"]) <= set(COMPOSE["networks"])
    assert set(service.get("depends_on", [])) <= set(SERVICES)
    assert "ports" not in service, "nothing is published to the host"
    named = {volume.split(":")[0] for volume in service["volumes"] if not volume.startswith(".")}
    assert named <= set(COMPOSE["volumes"])


@pytest.mark.slow
def test_it_starts_with_one_command() -> None:
    """The emulator makes the users: whoever needs them waits until they are there and the router listens."""
    assert set(SERVICES) == {"emulator", *CLIENTS}
    for name in CLIENTS:
        assert SERVICES[name]["depends_on"] == {"emulator": {"condition": "service_healthy"}}
        assert "access:/access:ro" in SERVICES[name]["volumes"]
    parsed = options("emulator")
    assert str(parsed["access"]) == "/access" and parsed["listen"] == "tcp/0.0.0.0:7447"
    assert "access:/access" in SERVICES["emulator"]["volumes"]
    assert "/access/access.json" in SERVICES["emulator"]["healthcheck"]["test"]
    assert "7447" in SERVICES["emulator"]["healthcheck"]["test"]


@pytest.mark.slow
def test_each_host_of_the_emulator_has_its_container_and_its_credentials() -> None:
    parsed = options("emulator")
    assert str(parsed["scenario"]) == "scenarios/beacon.toml"
    hosts = host_names(str(parsed["hosts"]))
    assert {host_user(host) for host in hosts} == CLIENTS - {"recorder"}
    access = create_access(SCENARIO, build_world(SCENARIO), hosts=hosts)
    assert [len(share) for share in access.hosts.values()] == [5, 5], "as the file says"
    for name in CLIENTS:
        user = OBSERVER if name == "recorder" else name
        client = options(name)
        assert user in access.passwords
        assert str(client["credentials"]) == f"/access/credentials/{user}.json"
        assert (client["connect"], client["run"]) == (ENDPOINT, SCENARIO.run.name)


def test_the_image_holds_what_the_commands_need() -> None:
    text = (ROOT / "Dockerfile").read_text()
    for path in ("vnet", "agents", "emulator", "scenarios", "pyproject.toml", "constraints.txt"):
        assert f" {path}" in text
        assert (ROOT / path).exists()
