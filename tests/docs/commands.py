"""The commands of the documentation: really run where that is cheap, and else parsed by the real command line."""

import contextlib
import importlib
import io
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import typer.main

import agents.cli
import emulator.cli.commands
from tests.support.paths import ROOT

APPS = {"vnet": emulator.cli.commands.app, "vnet-agent": agents.cli.app}
HERE = ("simulate", "run", "check", "analyze", "access", "radio", "export", "report", "compare", "map", "trace")
"""Commands of vnet that are run in this process. `run` runs as `simulate`, without processes: the same trace."""
APART = ("campaign", "sweep")
"""Commands of vnet that are run in a process of their own, as they start some themselves."""
PYTHON = {"python": [], "pytest": ["-m", "pytest"]}
"""Run by this Python, with these arguments first."""
ONLY_PARSED = {
    "vnet conformance": "takes a minute; tests/emulator/testing/conformance runs it",
    "vnet emulator": "waits for agents",
    "vnet host": "needs an emulator",
    "vnet-agent": "needs an emulator",
    "vnet record": "needs an emulator",
    "vnet fault": "needs a run that is on",
    "vnet status": "needs a run that is on",
    "vnet experiment": "takes minutes to hours",
    "vnet view": "needs a screen, or somebody who looks",
    "vnet play": "needs a screen, or somebody who looks",
    "vnet render": "needs a run that the page has not made",
}
"""Why these are parsed, and not run."""
NOT_RUN = {
    "cd": "the shell's own",
    "dask": "waits for work",
    "docker": "needs an engine",
    "ip": "changes the machine; what it executes in a namespace is parsed",
    "make": "builds an environment; the target must be there",
    "pip": "needs the network",
    "rerun": "needs a screen",
    "scp": "needs another host",
    "ssh": "needs another host",
    "source": "the shell's own",
    "tshark": "a program of its own",
    "zenohd": "a program of its own",
}
"""Why these other programs are not run."""
EXPENSIVE = ("quickstart.toml", "dense.toml", "faults.toml")
"""Scenarios that take many seconds: only parsed, but for short runs."""
MOST_RUNS = 10
"""Campaigns of more are only parsed."""
MOST_SEEDS = 5
"""Sweeps of more are only parsed."""
SHORT_S = 3.0
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
    parse(words)
    if program == "vnet" and arguments[0] in HERE and not _expensive(arguments):
        verb = {"run": "simulate"}.get(arguments[0], arguments[0])
        with _forgetting(folder):
            text, ended = _captured(typer.main.get_command(APPS["vnet"]), [verb, *arguments[1:]])
    elif program == "vnet" and arguments[0] in APART and not _expensive(arguments):
        text, ended = _process(["-P", "-m", "emulator.cli", *arguments])
    elif program in PYTHON:
        text, ended = _process([*PYTHON[program], *arguments])
    else:
        return None
    if ended != status:
        raise DocsError(f"{shlex.join(words)}: exit status {ended}, and not {status}:\n{text}")
    return text


def _expensive(arguments: list[str]) -> bool:
    """Return True if a command of vnet takes long, or a clock on the wall."""
    given = dict(pairwise(arguments))
    short = float(given.get("--duration", "inf")) <= SHORT_S
    many = arguments[0] == "campaign" and int(given.get("--runs", "200")) > MOST_RUNS
    many = many or (arguments[0] == "sweep" and int(given.get("--seeds", "1")) > MOST_SEEDS)
    slow = any(argument.endswith(EXPENSIVE) for argument in arguments)
    return (
        many
        or "realtime" in arguments
        or "--executor" in arguments
        or "--router" in arguments
        or (slow and not short)
    )


def parse(words: Sequence[str]) -> None:
    """Have the real command line parse a command, and do nothing. Raises DocsError if it refuses."""
    program, arguments = Path(words[0]).name, list(words[1:])
    if program in NOT_RUN:
        _look_at(program, arguments)
        return
    if program in PYTHON:
        return
    if program not in APPS:
        raise DocsError(f"{program}: say in tests/docs/commands.py why it is not run")
    known = f"{program} {arguments[0] if arguments else ''}" if program == "vnet" else program
    if known not in ONLY_PARSED and (program != "vnet" or arguments[0] not in HERE + APART):
        raise DocsError(f"{known}: say in tests/docs/commands.py whether it is run, or why not")
    command = typer.main.get_command(APPS[program])
    _disarm(command)
    text, status = _captured(command, arguments)
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


def _disarm(command: Any) -> None:
    """Leave of a command, and of all below it, what it parses."""
    for below in getattr(command, "commands", {}).values():
        _disarm(below)
    command.callback = _nothing


def _nothing(*_: object, **__: object) -> None:
    """Run a disarmed command."""


def _captured(command: Any, arguments: list[str]) -> tuple[str, int]:
    """Return the output of a command, stdout before stderr, and its exit status."""
    out, error = io.StringIO(), io.StringIO()
    status: object = 0
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(error):
        try:
            command(arguments)
        except SystemExit as end:
            status = end.code or 0
    return out.getvalue() + error.getvalue(), status if isinstance(status, int) else 1


def _process(arguments: list[str]) -> tuple[str, int]:
    words = [sys.executable, *arguments]
    done = subprocess.run(words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    return done.stdout, done.returncode


@contextlib.contextmanager
def _forgetting(folder: Path) -> Iterator[None]:
    """Leave nothing of the modules in `folder` in this process."""
    path = list(sys.path)
    importlib.invalidate_caches()
    try:
        yield
    finally:
        sys.path[:] = path
        for name, module in list(sys.modules.items()):
            if Path(getattr(module, "__file__", None) or "/").is_relative_to(folder):
                del sys.modules[name]
