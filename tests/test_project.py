"""The project's own files agree: supported versions of Python, the linters, and what is run where."""

import re
import subprocess
import tomllib
from importlib.metadata import distributions, entry_points
from pathlib import Path
from typing import Any

import pytest
import yaml
from packaging.specifiers import SpecifierSet

from emulator.cli.table import REGISTRY
from tests.docs import commands
from tests.docs.pages import check_workflow
from tests.hunt.mutants import MUTANTS, Mutant, mutated
from tests.support.paths import ROOT

WORKFLOW = yaml.safe_load((ROOT / ".github" / "workflows" / "test.yml").read_text())
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
MAKEFILE = (ROOT / "Makefile").read_text()


def recipe(target: str) -> list[str]:
    """The commands of a target of the Makefile."""
    found = re.search(rf"^{target}:[^=\n]*\n((?:\t.*\n)+)", MAKEFILE, re.MULTILINE)
    assert found, target
    return [line.strip() for line in found.group(1).splitlines()]


def test_the_workflow_can_be_run() -> None:
    check_workflow(WORKFLOW)
    (job,) = WORKFLOW["jobs"].values()
    assert [step["run"] for step in job["steps"] if "run" in step] == [
        "make test PYTHON=python",
        "make sumo PYTHON=python",
    ]


@pytest.mark.slow
def test_the_action_runs_a_campaign_with_its_inputs(tmp_path: Path) -> None:
    action = yaml.safe_load((ROOT / ".github" / "actions" / "campaign" / "action.yml").read_text())
    (step,) = [step for step in action["runs"]["steps"] if "vnet campaign" in step.get("run", "")]
    given = {"scenario": "my town.toml", "runs": "3", "arguments": "--program chatty:main --duration 12"}
    environment = {}
    for name, value in step["env"].items():
        match = re.fullmatch(r"\$\{\{ inputs\.(\w+) \}\}", value)
        assert match and match[1] in action["inputs"]
        environment[name] = given[match[1]]
    stub = tmp_path / "vnet"
    stub.write_text('#!/bin/sh\nprintf "%s\\n" "$@"\n')
    stub.chmod(0o755)
    command = ["bash", "--noprofile", "--norc", "-eo", "pipefail", "-c", step["run"]]
    done = subprocess.run(
        command,
        env={"PATH": f"{tmp_path}:/usr/bin:/bin", **environment},
        capture_output=True,
        text=True,
        check=True,
    )
    words = done.stdout.splitlines()
    assert words[:2] == ["campaign", "my town.toml"]
    assert words[-4:] == ["--program", "chatty:main", "--duration", "12"]
    commands.parse(["vnet", *words])
    assert set(action["inputs"]) >= set(given)


def test_the_supported_versions_of_python_are_the_same_everywhere() -> None:
    (job,) = WORKFLOW["jobs"].values()
    versions = job["strategy"]["matrix"]["python"]
    listed = re.search(r"^PYTHONS \?= (.*)$", MAKEFILE, re.MULTILINE)
    prefix = "Programming Language :: Python :: 3."
    classifiers = [entry for entry in PROJECT["project"]["classifiers"] if entry.startswith(prefix)]
    assert listed and listed.group(1).split() == versions
    assert classifiers == [f"Programming Language :: Python :: {version}" for version in versions]
    assert PROJECT["project"]["requires-python"] == f">={versions[0]}"
    assert PROJECT["tool"]["mypy"]["python_version"] == versions[0]
    assert PROJECT["tool"]["ruff"]["target-version"] == f"py{versions[0].replace('.', '')}"


def test_the_hooks_before_a_commit_are_the_linters_of_make() -> None:
    hooks: list[Any] = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"][0]["hooks"]
    entries = [hook["entry"].removesuffix(" --force-exclude") for hook in hooks]
    linters = [line.replace("$(BIN)", ".venv/bin").removesuffix(" .") for line in recipe("lint")]
    assert entries == linters


def test_every_package_that_is_installed_has_an_exact_version() -> None:
    """Return the packages that `pyproject.toml` names; `make` installs and lists what those need."""
    pinned = re.findall(r"^([\w.-]+)==", (ROOT / "constraints.txt").read_text(), re.MULTILINE)
    wanted = [*PROJECT["project"]["dependencies"]]
    for extra in PROJECT["project"]["optional-dependencies"].values():
        wanted += extra
    names = {re.split(r"[<>=[]", name)[0] for name in wanted} - {PROJECT["project"]["name"]}
    normal = {re.sub(r"[-_.]+", "-", name).lower() for name in pinned}
    assert {name for name in names if re.sub(r"[-_.]+", "-", name).lower() not in normal} == set()


@pytest.mark.slow
def test_every_package_that_is_installed_accepts_the_first_python_that_vnet_does() -> None:
    """Debian 12 has Python 3.11.2: a package that needs 3.11.5 stops `make setup` there."""
    first = re.fullmatch(r">=([\d.]+)", PROJECT["project"]["requires-python"])
    assert first is not None
    needs = {d.name: d.metadata["Requires-Python"] for d in distributions() if "Requires-Python" in d.metadata}
    assert {n: v for n, v in needs.items() if not SpecifierSet(v).contains(f"{first.group(1)}.0")} == {}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("installed", "said"),
    [
        (["3.98"], "passed with Python 3.98"),
        (["3.97", "3.99"], "tested with Python 3.97 3.99; failed: 3.99"),
        ([], "none of Python 3.97 3.98 3.99 is installed"),
    ],
)
def test_make_test_all_tests_each_python_that_is_installed(installed: list[str], said: str, tmp_path: Path) -> None:
    """With stand-ins for interpreters of versions that do not exist, and for make, which fails for 3.99."""
    for version in installed:
        stand_in(tmp_path / f"python{version}", "exit 0")
    stand_in(tmp_path / "remake", 'case "$*" in *3.99*) exit 1;; esac')
    command = ["make", "-C", str(ROOT), "test-all", f"MAKE={tmp_path / 'remake'}", "PYTHONS=3.97 3.98 3.99"]
    environment = {"PATH": f"{tmp_path}:/usr/bin:/bin", "HOME": str(tmp_path)}
    ended = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert (ended.returncode == 0) == said.startswith("passed"), ended.stdout + ended.stderr
    assert said in ended.stdout.splitlines()
    for version in {"3.97", "3.98", "3.99"} - set(installed):
        assert f"Python {version} is not installed: not tested" in ended.stdout


def stand_in(path: Path, does: str) -> None:
    path.write_text(f"#!/bin/sh\n{does}\n")
    path.chmod(0o755)


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.name)
def test_a_mutant_can_be_put_into_its_file(mutant: Mutant) -> None:
    """Or nobody knows any more whether the tests would find it."""
    assert mutant.new in mutated(mutant)


def test_make_setup_installs_the_studies_that_register_their_command() -> None:
    (entry,) = tomllib.loads((ROOT / "studies" / "pyproject.toml").read_text())["project"]["entry-points"][
        REGISTRY
    ].items()
    assert entry == ("experiment", "studies.commands:app")
    assert any(line.endswith("-e ./studies") for line in recipe(r"\$\(READY\)"))
    assert [found.value for found in entry_points(group=REGISTRY, name="experiment")] == [entry[1]], "make setup"
