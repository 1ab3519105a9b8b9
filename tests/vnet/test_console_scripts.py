"""The console scripts, before anything of the package is imported that they start."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.paths import ROOT

pytestmark = pytest.mark.slow

# Imported at the start of Python: presses Ctrl-C when a module is about to be imported.
AT_IMPORT = """
import os, signal, sys

class Presses:
    def find_spec(self, name, path, target=None):
        if name == "{module}":
            os.kill(os.getpid(), signal.SIGINT)

sys.meta_path.insert(0, Presses())
"""


def start(script: str, folder: Path, *arguments: str) -> tuple[int, str]:
    """Run a console script with `folder` on PYTHONPATH; return its status and standard error."""
    code = f"from vnet.console_scripts import {script}; {script}()"
    environment = {**os.environ, "PYTHONPATH": f"{folder}{os.pathsep}{ROOT}"}
    command = [sys.executable, "-P", "-c", code, *arguments]
    done = subprocess.run(command, env=environment, cwd=folder, capture_output=True, text=True)
    return done.returncode, done.stderr


@pytest.mark.parametrize(("script", "package"), [("emulator", "emulator"), ("agent", "agents")])
def test_a_file_in_place_of_the_package_is_named(script: str, package: str, tmp_path: Path) -> None:
    file = tmp_path / f"{package}.py"
    file.touch()
    said = f"vnet: {package}: found {file}, which is not vnet's package of this name: rename it\n"
    assert start(script, tmp_path, "--version") == (2, said)


@pytest.mark.usefixtures("default_signals")
@pytest.mark.parametrize(("script", "module"), [("emulator", "emulator.cli"), ("agent", "typer")])
def test_an_interrupt_while_the_package_is_imported_is_silent(script: str, module: str, tmp_path: Path) -> None:
    (tmp_path / "sitecustomize.py").write_text(AT_IMPORT.format(module=module))
    assert start(script, tmp_path, "--version") == (130, "")


def test_the_package_imports_nothing_before_ctrl_c_is_guarded() -> None:
    code = "import sys; before = {*sys.modules}; import vnet; print({*sys.modules} - before)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "{'vnet'}\n"
