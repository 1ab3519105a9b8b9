"""Ctrl-C at any moment: status 130, and no traceback."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.forked_commands import VNET, run
from tests.support.paths import ROOT

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("default_signals")]

BEACON = str(ROOT / "scenarios" / "beacon.toml")
# Imported at the start of Python: presses Ctrl-C, twice, when a module is about to be imported.
AT_IMPORT = """
import os, signal, sys

class Presses:
    def find_spec(self, name, path, target=None):
        if name == "{module}":
            os.kill(os.getpid(), signal.SIGINT)
            os.kill(os.getpid(), signal.SIGINT)

sys.meta_path.insert(0, Presses())
"""
# The same before a command starts itself again, which it does before it imports anything.
AT_EXECUTION = """
import os, signal

execve = os.execve

def pressed(*arguments):
    os.kill(os.getpid(), signal.SIGINT)
    execve(*arguments)

os.execve = pressed
"""
# A program that never yields, and presses Ctrl-C itself: again when the first has been answered.
BUSY = """
import os, signal

async def main(node):
    os.kill(os.getpid(), signal.SIGINT)
    while not answered():
        pass
    os.kill(os.getpid(), signal.SIGINT)
    while True:
        pass

def answered():
    with open("stderr.txt") as file:
        return "Ctrl-C again" in file.read()
"""


def vnet(folder: Path, *arguments: str, at_start: str = "") -> tuple[int, str, str]:
    """Run a command in a folder; returns its status, its output and its standard error.

    Unless something is to happen at the start of Python, it is forked.
    """
    (folder / "sitecustomize.py").write_text(at_start)
    environment = {**os.environ, "PYTHONPATH": f"{folder}{os.pathsep}{ROOT}"}
    environment.pop("PYTHONHASHSEED", None)
    errors, start = folder / "stderr.txt", subprocess.run if at_start else run
    with errors.open("w") as stderr:
        done = start(
            [*VNET, *arguments], env=environment, cwd=folder, stdout=subprocess.PIPE, stderr=stderr, text=True
        )
    return done.returncode, done.stdout, errors.read_text()


@pytest.mark.parametrize(
    ("arguments", "module"),
    [
        (["run", BEACON], "vnet.runtime.interrupts"),
        (["run", BEACON], "vnet.runtime.environment"),
        (["run", BEACON], "typer"),
        (["run", BEACON], "pydantic"),
        (["run", BEACON], "zenoh"),
        (["report"], "emulator.report.write"),
    ],
)
def test_while_a_module_is_imported(arguments: list[str], module: str, tmp_path: Path) -> None:
    status, _, said = vnet(tmp_path, *arguments, at_start=AT_IMPORT.format(module=module))
    assert status == 130
    assert said == ("beacon: lockstep, seed 1, 10 s of emulated time\n" if module == "zenoh" else "")
    assert not (tmp_path / "runs").exists()


def test_nothing_is_imported_before_the_command_runs() -> None:
    program = "import sys; before = {*sys.modules}; import emulator.cli; print(*sorted({*sys.modules} - before))"
    done = subprocess.run(
        [sys.executable, "-P", "-c", program],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        check=True,
    )
    assert {*done.stdout.decode().split()} - {"__future__"} == {"emulator", "emulator.cli"}


def test_while_a_command_starts_itself_again(tmp_path: Path) -> None:
    status, _, said = vnet(tmp_path, "simulate", BEACON, at_start=AT_EXECUTION)
    assert (status, said) == (130, "")


def test_a_program_that_does_not_yield_ends_at_the_second(tmp_path: Path) -> None:
    (tmp_path / "busy.py").write_text(BUSY)
    status, shown, said = vnet(tmp_path, "simulate", BEACON, "--program", "busy:main", "--quiet")
    assert status == 130, said
    assert "vnet: interrupted, as soon as the programs yield; Ctrl-C again: at once\n" in said
    assert "Traceback" not in said
    assert "verdict: unknown" in shown


ONCE = "import os, signal\n\nasync def main(node):\n    os.kill(os.getppid(), signal.SIGINT)\n    "
"""A program that presses Ctrl-C once, and goes on."""
HARDENED = """while True:
        try:
            while not os.getpid() == 0:
                os.getpid()
        except BaseException:
            pass
"""


@pytest.mark.parametrize(
    ("spins", "shown", "said"), [("while True: pass", "verdict: unknown", ""), (HARDENED, "", "is killed")]
)
def test_a_program_that_does_not_yield_in_time_ends_as_at_the_second(
    tmp_path: Path, spins: str, shown: str, said: str
) -> None:
    (tmp_path / "busy.py").write_text(f"{ONCE}{spins}\n")
    options = ("--program", "busy:main", "--quiet", "--set", "run.stall_timeout_s=0.3")
    status, output, errors = vnet(tmp_path, "simulate", BEACON, *options)
    assert (status, shown in output, said in errors) == (130, True, True), errors
    assert bool(output) == bool(shown)


@pytest.mark.parametrize(
    ("handler", "emulated"), [(signal.SIG_DFL, "0.0 s"), (signal.SIG_IGN, "10.0 s")], ids=["", "nohup"]
)
def test_a_terminal_that_is_closed_ends_a_run_unless_that_is_ignored(
    handler: signal.Handlers, emulated: str, tmp_path: Path
) -> None:
    (tmp_path / "closes.py").write_text(ONCE.replace("SIGINT", "SIGHUP") + "async for _ in node.gnss: pass\n")
    before = signal.signal(signal.SIGHUP, handler)
    try:
        status, shown, _ = vnet(tmp_path, "simulate", BEACON, "--program", "closes:main", at_start="pass")
    finally:
        signal.signal(signal.SIGHUP, before)
    assert status == (130 if handler is signal.SIG_DFL else 3)  # in which nobody has sent anything
    assert (f" {emulated} " in shown, "verdict: unknown" in shown) == (True, True)


def test_a_process_in_the_background_goes_on_ignoring_it(tmp_path: Path) -> None:
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        status, shown, _ = vnet(tmp_path, "--version", at_start=AT_IMPORT.format(module="typer"))
    finally:
        signal.signal(signal.SIGINT, before)
    assert (status, shown.split()[0]) == (0, "vnet")
