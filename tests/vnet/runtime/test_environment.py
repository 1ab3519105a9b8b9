"""The environment of processes: imports leave it alone, entry points set it before numpy is imported."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.paths import ROOT
from vnet.runtime.environment import ONE_BLAS_THREAD

PLAIN = {key: value for key, value in os.environ.items() if key not in {*ONE_BLAS_THREAD, "PYTHONHASHSEED"}}
LOOK = "import json, os, sys; print(json.dumps([dict(os.environ), 'numpy' in sys.modules]))"


def python(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    environment = {**PLAIN, "PYTHONPATH": str(ROOT), **environment}
    return subprocess.run([sys.executable, "-P", *arguments], env=environment, capture_output=True, text=True)


@pytest.mark.parametrize("packages", ["emulator, agents, vnet", "emulator.drivers.live, agents.host"])
def test_importing_vnet_changes_nothing_in_the_caller_s_environment(packages: str) -> None:
    program = f"import os; before = dict(os.environ); import {packages}; assert dict(os.environ) == before"
    done = python("-c", program)
    assert done.returncode == 0, done.stderr


def test_what_sets_the_environment_imports_no_numpy() -> None:
    modules = "vnet.runtime.environment, vnet.runtime.die_with_parent, agents.cli, emulator.cli"
    done = python("-c", f"import {modules}; {LOOK}")
    environment, numpy = json.loads(done.stdout)
    assert not numpy
    assert not set(ONE_BLAS_THREAD) & set(environment)


# A package that python imports at its start, to see the environment when numpy is imported, and to end there.
SPY = """
import json, os, sys
from importlib.abc import MetaPathFinder

class Spy(MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name == "numpy":
            print(json.dumps(dict(os.environ)), flush=True)
            os._exit(0)

sys.meta_path.insert(0, Spy())
"""
ENTRY_POINTS = {
    "vnet": ["-m", "emulator.cli", "simulate", "scenarios/beacon.toml"],
    "vnet-agent": ["-m", "agents.cli", "--connect", "tcp/127.0.0.1:1", "--run", "r", "--node", "v01"],
}


@pytest.mark.parametrize("arguments", ENTRY_POINTS.values(), ids=ENTRY_POINTS.keys())
@pytest.mark.parametrize("own", [{}, {"OMP_NUM_THREADS": "2"}], ids=["default", "own"])
def test_an_entry_point_sets_one_thread_before_numpy_is_imported_unless_told_otherwise(
    arguments: list[str], own: dict[str, str], tmp_path: Path
) -> None:
    (tmp_path / "sitecustomize.py").write_text(SPY)
    done = python(*arguments, PYTHONPATH=f"{tmp_path}{os.pathsep}{ROOT}", PYTHONHASHSEED="0", **own)
    seen = json.loads(done.stdout)
    assert {name: seen.get(name) for name in ONE_BLAS_THREAD} == {**ONE_BLAS_THREAD, **own}


def test_a_command_starts_itself_again_with_a_fixed_hash_seed() -> None:
    done = python("-m", "agents.cli", "--help")
    assert done.returncode == 0 and "vehicle" in done.stdout.lower()
    program = (
        "import os, sys\n"
        "os.execve = lambda path, arguments, environment: (print(arguments[1:], environment['PYTHONHASHSEED']))\n"
        "from vnet.runtime.environment import fix_hash_seed\n"
        "fix_hash_seed('agents.cli')\n"
    )
    assert python("-c", program).stdout == "['-P', '-m', 'agents.cli'] 0\n"
    assert python("-c", program, PYTHONHASHSEED="0").stdout == "", "it has one already"


CLOSED = """
import os, sys
for number in map(int, sys.argv[2]):
    os.close(number)
os.execv(sys.executable, [sys.executable, "-c", sys.argv[1]])
"""
OPENED = """
import os
from vnet.runtime.environment import open_standard_descriptors
open_standard_descriptors()
first = os.open("first.txt", os.O_WRONLY | os.O_CREAT)
print("said", flush=True)
os.write(first, str(first).encode())
"""


@pytest.mark.parametrize("closed", ["1", "2", "12", "012"])
def test_files_do_not_take_the_place_of_closed_standard_output(closed: str, tmp_path: Path) -> None:
    command = [sys.executable, "-c", CLOSED, OPENED, closed]
    done = subprocess.run(command, cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(ROOT)})
    assert done.returncode == 0
    assert int((tmp_path / "first.txt").read_text()) > 2, "and what was said is not in it"
