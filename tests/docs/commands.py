"""The commands of the documentation: run as they are written; those that cannot run here are parsed."""

import contextlib
import copy
import functools
import importlib
import importlib.util
import io
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import typer.main

import agents.cli
from tests.support import forked_commands
from tests.support.command_line import app
from tests.support.forked_commands import MODULE, VNET
from tests.support.paths import ROOT

APPS = {"vnet": app, "vnet-agent": agents.cli.app}
HERE = (
    "simulate", "check", "analyze", "access", "radio", "export", "report", "compare", "map", "trace", "docs",
    "new",
)  # fmt: skip
"""Commands of vnet that are run in this process."""
APART = (
    *("run", "emulator", "host", "campaign", "sweep"),  # they start processes
    *("fault", "status", "render", "view"),  # they open sessions and recordings
    "experiment",
)
"""Commands of vnet that are run in a process of their own."""
PYTHON = {"python": [], "pytest": ["-m", "pytest"]}
"""Run by this Python, with these arguments first."""
MODULES = {"vnet": "emulator", "vnet-agent": "agents.cli"}
ONLY_PARSED = {
    r"--debug ": "asks its user; tests/system/test_debugging.py has one",
    r"--rerun spawn": "opens a window",
    r"^vnet view ": "opens a window, or serves until somebody has looked",
    r"^vnet(-agent| emulator| host).*tls/": "needs another host, or its address",
    r"dask://HOST": "needs other hosts",
    r"^vnet sweep .*(three_radios/[24]00|traffic|positioning)": "takes half an hour",
    r"^vnet experiment .*DIR/": "needs recorded trips that are not part of vnet",
}
if importlib.util.find_spec("libsumo") is None:
    ONLY_PARSED[r"/sumo_loop/"] = "needs libsumo, of the extra sumo"
"""Patterns of commands that are parsed and not run, and why."""
NOT_RUN = {
    "cd": "the shell's own",
    "dask": "needs other hosts; tests/system/test_dask.py has a scheduler and workers",
    "docker": "needs an engine",
    "ip": "changes the machine; what it executes in a namespace is parsed",
    "make": "builds an environment; the target must be there",
    "pip": "needs the network",
    "rerun": "needs a screen",
    "scp": "needs another host",
    "ssh": "needs another host",
    "source": "the shell's own",
    "tshark": "is not among vnet's dependencies",
    "zenohd": "is not among vnet's dependencies",
}
"""Why these other programs are not run."""
UNKNOWN = 3
"""Exit status that a run in real time may have: the machine that runs the tests may be too slow for it."""
TIMEOUT_S = 300.0
_STATUS = re.compile(r"#.*\bstatus (\d+)\b")


class DocsError(AssertionError):
    """A block that is not what it says."""


def commands(text: str) -> Iterator[tuple[list[str], int]]:
    """Each command of a shell block as its words, and the exit status that its comment says, else 0."""
    for line in text.replace("\\\n", " ").splitlines():
        status = int(found.group(1)) if (found := _STATUS.search(line)) else 0
        words = shlex.split(line, comments=True)
        while words:
            end = words.index("&&") if "&&" in words else len(words)
            yield words[:end], status
            words = words[end + 1 :]


def run(words: Sequence[str], status: int, folder: Path) -> str | None:
    """Run a command in `folder`, which is the current one; returns what it prints, or None if it is only parsed.

    Raises DocsError if it is wrong, or ends with another exit status.
    """
    program, arguments = Path(words[0]).name, list(words[1:])
    if not is_run(words):
        parse(words)
        return None
    if program == "vnet" and arguments[0] in HERE:
        with forgetting(folder):
            text, ended = captured(typer.main.get_command(APPS["vnet"]), arguments)
    else:
        text, ended = _process(words)
    scenarios = [folder / each for each in arguments if each.endswith(".toml") and (folder / each).exists()]
    if ended == UNKNOWN and any("realtime" in each for each in [*arguments, *(s.read_text() for s in scenarios)]):
        return None
    if ended != status:
        raise DocsError(f"{shlex.join(words)}: exit status {ended}, and not {status}:\n{text}")
    return text


def is_run(words: Sequence[str]) -> bool:
    """Return True if a command is run, and False if it is only parsed. Raises DocsError if neither is said here."""
    program = Path(words[0]).name
    if program in NOT_RUN or any(re.search(pattern, shlex.join([program, *words[1:]])) for pattern in ONLY_PARSED):
        return False
    if program not in MODULES.keys() | PYTHON.keys():
        raise DocsError(f"{program}: say in tests/docs/commands.py why it is not run")
    if program == "vnet" and "".join(words[1:2]) not in HERE + APART:
        raise DocsError(f"{shlex.join(words[:2])}: say in tests/docs/commands.py whether it is run, or why not")
    return True


def process(words: Sequence[str]) -> list[str]:
    """Return the words by which a command of a page is started as a process of this Python."""
    program, arguments = Path(words[0]).name, list(words[1:])
    first = PYTHON[program] if program in PYTHON else ["-P", "-m", MODULES[program]]
    return [sys.executable, *first, *arguments]


def parse(words: Sequence[str]) -> None:
    """Have the real command line parse a command, and do nothing. Raises DocsError if it refuses."""
    program, arguments = Path(words[0]).name, list(words[1:])
    if program in NOT_RUN:
        _look_at(program, arguments)
        return
    is_run(words)  # refuses what is not known
    if program in PYTHON:
        return
    text, status = captured(_disarmed(program), arguments)
    if status != 0:
        raise DocsError(f"{shlex.join(words)}: {text.strip()}")


def _look_at(program: str, arguments: list[str]) -> None:
    """Check a command that is not vnet's."""
    if program == "make":
        targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
        if wrong := {word for word in arguments if "=" not in word} - set(targets):
            raise DocsError(f"make: no such target: {', '.join(sorted(wrong))}")
    if program == "ip" and "exec" in arguments:
        parse(arguments[arguments.index("exec") + 2 :])


@functools.cache
def _disarmed(program: str) -> Any:
    """Return a copy of a command that parses its command line, and does nothing."""
    command = copy.deepcopy(typer.main.get_command(APPS[program]))
    _disarm(command)
    return command


def _disarm(command: Any) -> None:
    """Leave of a command, and of all below it, what it parses."""
    for below in getattr(command, "commands", {}).values():
        _disarm(below)
    command.callback = _nothing


def _nothing(*_: object, **__: object) -> None:
    """Run a disarmed command."""


def captured(command: Any, arguments: list[str]) -> tuple[str, int]:
    """Return the output of a command, stdout before stderr, and its exit status."""
    out, error = io.StringIO(), io.StringIO()
    status: object = 0
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(error):
        try:
            command(arguments)
        except SystemExit as end:
            status = end.code or 0
    return out.getvalue() + error.getvalue(), status if isinstance(status, int) else 1


def _process(words: Sequence[str]) -> tuple[str, int]:
    started = process(words)
    if started[1].startswith("docs/examples/"):
        started = [*MODULE, started[1].removesuffix(".py").replace("/", "."), *started[2:]]
    elif started[1] == "-m" and started[2].startswith(("pytest", "docs.examples.")):
        started = [*MODULE, *started[2:]]
    is_forked = started[: len(VNET)] == VNET or started[: len(MODULE)] == MODULE
    start = forked_commands.run if is_forked else subprocess.run
    nothing, out, error = subprocess.DEVNULL, subprocess.PIPE, subprocess.STDOUT
    done = start(started, stdin=nothing, stdout=out, stderr=error, text=True, timeout=TIMEOUT_S)
    return done.stdout, done.returncode


@contextlib.contextmanager
def forgetting(folder: Path) -> Iterator[None]:
    """Leave nothing of the modules in `folder` in this process."""
    path, inside = list(sys.path), f"{folder}{os.sep}"
    importlib.invalidate_caches()
    try:
        yield
    finally:
        sys.path[:] = path
        for name, module in list(sys.modules.items()):
            if str(getattr(module, "__file__", None)).startswith(inside):
                del sys.modules[name]
