"""The environment of processes: imports leave it alone, entry points set it before numpy is imported."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.support.paths import ROOT
from vnet.runtime import environment
from vnet.runtime.environment import SAME_ARITHMETIC, same_arithmetic

PLAIN = {key: value for key, value in os.environ.items() if key not in {*SAME_ARITHMETIC, "PYTHONHASHSEED"}}
LOOK = "import json, os, sys; print(json.dumps([dict(os.environ), 'numpy' in sys.modules]))"


def python(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    environment = {**PLAIN, "PYTHONPATH": str(ROOT), **environment}
    return subprocess.run([sys.executable, "-P", *arguments], env=environment, capture_output=True, text=True)


@pytest.mark.slow
@pytest.mark.parametrize("packages", ["emulator, agents, vnet", "emulator.drivers.live, agents.host"])
def test_importing_vnet_changes_nothing_in_the_caller_s_environment(packages: str) -> None:
    program = f"import os; before = dict(os.environ); import {packages}; assert dict(os.environ) == before"
    done = python("-c", program)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_what_sets_the_environment_imports_no_numpy() -> None:
    modules = "vnet.runtime.environment, vnet.runtime.die_with_parent, agents.cli, emulator.cli"
    done = python("-c", f"import {modules}; {LOOK}")
    environment, numpy = json.loads(done.stdout)
    assert not numpy
    assert not set(SAME_ARITHMETIC) & set(environment)


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
    "vnet": ["-m", "emulator", "simulate", "scenarios/beacon.toml"],
    "vnet-agent": ["-m", "agents.cli", "--connect", "tcp/127.0.0.1:1", "--run", "r", "--node", "v01"],
}


@pytest.mark.slow
@pytest.mark.parametrize("arguments", ENTRY_POINTS.values(), ids=ENTRY_POINTS.keys())
@pytest.mark.parametrize("own", [{}, {"OMP_NUM_THREADS": "2"}], ids=["default", "own"])
def test_an_entry_point_sets_the_arithmetic_before_numpy_is_imported_unless_told_otherwise(
    arguments: list[str], own: dict[str, str], tmp_path: Path
) -> None:
    (tmp_path / "sitecustomize.py").write_text(SPY)
    done = python(*arguments, PYTHONPATH=f"{tmp_path}{os.pathsep}{ROOT}", PYTHONHASHSEED="0", **own)
    seen = json.loads(done.stdout)
    assert {name: seen.get(name) for name in SAME_ARITHMETIC} == {**SAME_ARITHMETIC, **own}


@pytest.mark.slow
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


@pytest.mark.slow
@pytest.mark.parametrize("closed", ["1", "2", "12", "012"])
def test_files_do_not_take_the_place_of_closed_standard_output(closed: str, tmp_path: Path) -> None:
    command = [sys.executable, "-c", CLOSED, OPENED, closed]
    done = subprocess.run(command, cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(ROOT)})
    assert done.returncode == 0
    assert int((tmp_path / "first.txt").read_text()) > 2, "and what was said is not in it"


def test_a_processor_with_avx2_computes_as_all_that_have_it() -> None:
    new, old = same_arithmetic(["sse2", "avx", "fma", "avx2", "avx512f"]), same_arithmetic(["sse2", "avx"])
    assert new["OPENBLAS_CORETYPE"] == "Haswell" and old.items() < new.items()
    assert "OPENBLAS_CORETYPE" not in old, "a kernel for AVX2 would end the process"


@pytest.mark.parametrize(
    ("version", "blas", "expected"),
    [
        ("2.4.0", {"name": "scipy-openblas"}, "AVX2"),
        ("2.3.5", {"name": "scipy-openblas"}, "this processor"),
        ("2.10.0", {"name": "mkl-sdl"}, "this processor"),
        ("2.4.0", {}, "this processor"),
    ],
)
def test_a_numpy_that_does_not_know_the_variables_computes_as_its_processor_does(
    monkeypatch: pytest.MonkeyPatch, version: str, blas: dict[str, str], expected: str
) -> None:
    monkeypatch.setattr(environment, "SAME_ARITHMETIC", {"OPENBLAS_CORETYPE": "Haswell"})
    monkeypatch.setenv("OPENBLAS_CORETYPE", "Haswell")
    monkeypatch.setattr(np, "__version__", version)
    monkeypatch.setattr(np, "show_config", lambda mode: {"Build Dependencies": {"blas": blas} if blas else {}})
    assert environment.arithmetic() == expected


@pytest.mark.slow
@pytest.mark.skipif("OPENBLAS_CORETYPE" not in SAME_ARITHMETIC, reason="this processor has no AVX2")
def test_openblas_and_numpy_take_what_they_are_told_and_a_run_says_so() -> None:
    program = (
        "from numpy._core._multiarray_umath import __cpu_features__ as features\n"
        "from vnet.runtime.environment import arithmetic\n"
        "print(features['X86_V4'], arithmetic())\n"
    )
    done = python("-W", "error", "-c", program, OPENBLAS_VERBOSE="2", **SAME_ARITHMETIC)
    assert "Core: Haswell" in done.stdout + done.stderr
    assert done.stdout.splitlines()[-1] == "False AVX2"
    other = python("-c", program, **SAME_ARITHMETIC | {"OPENBLAS_CORETYPE": "Nehalem"})
    assert other.stdout.splitlines()[-1] == "False this processor"


@pytest.mark.slow
def test_packets_and_ids_of_zenoh_hash_alike_in_each_process() -> None:
    program = "\n".join(
        [
            "from vnet.gateway.emulated.values import EntityGlobalId, SourceInfo, ZenohId",
            "from vnet.radio import Packet",
            "zid = ZenohId(7)",
            "entity = EntityGlobalId(zid, 3)",
            "print(*map(hash, (Packet('v01', 1, 2, b'x'), zid, entity, SourceInfo(entity, 9))))",
        ]
    )
    said = {python("-c", program, PYTHONHASHSEED="0").stdout for _ in range(3)}
    assert len(said) == 1 and len(said.pop().split()) == 4
