"""A page of the documentation as its reader follows it: block by block, in one folder.

- `python`: written to a file if it begins with `# NAME.py`. A program (a function of `node: Node`) is run by the
  page's own commands, or else simulated; tests run under pytest; everything else is executed, in one namespace.
  `python of PATH` is an excerpt of a file of the repository, at any depth of indentation.
- `toml`: loaded as a scenario; written to a file if it begins with `# NAME.toml`.
- `csv NAME`: written to that file.
- `sh`: each command is run, or parsed if it cannot run here (`tests.docs.commands`); comments may say `status 1`.
  `sh terminal`: the command goes on beside the blocks that follow, once it has printed the `text` right after it.
  At the end of the page it is waited for; where its comment says `status 130` it gets Ctrl-C before.
- `text`: right after a block that was run, an excerpt of what that printed, in which `…` stands for anything, and
  alone in its line for any lines; gaps may be of any width. `text figure` is a figure.
- `{eval-rst}`: what its directives show exists.
- `json`, `yaml`: parsed; of a GitHub workflow also its structure and its commands.
"""

import contextlib
import csv
import io
import json
import pkgutil
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import yaml

from emulator.scenario.loading import load_scenario
from tests.docs import commands
from tests.docs.commands import DocsError
from tests.docs.markdown import Block, blocks
from tests.docs.terminals import Terminals
from tests.support.paths import ROOT

NOT_INSTALLED = re.compile(r"^(import|from) pandas\b", re.MULTILINE)
"""Packages that examples use and vnet does not need: such blocks are only compiled."""
_FILE = re.compile(r"# (\S+\.(?:py|toml))\n")


class Page:
    """Follows a page in `folder`, which must be the current one. Raises DocsError where something is not so."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._namespace: dict[str, Any] = {"__name__": "__docs__"}
        self._printed: str | None = None
        self._terminals = Terminals(folder)
        self._is_in_terminal = False
        self._programs: dict[str, str] = {}
        self._tests: dict[str, str] = {}
        self._languages: dict[str, Callable[[Block], str | None]] = {
            "python": self._python,
            "toml": self._toml,
            "csv": self._csv,
            "sh": self._sh,
            "text": self._text,
            "json": self._json,
            "yaml": self._yaml,
            "{eval-rst}": self._directives,
        }
        for name in ("scenarios", "docs"):
            (folder / name).symlink_to(ROOT / name)

    def follow(self, text: str, name: str) -> None:
        """Follow all blocks of the page, which is called `name`."""
        with contextlib.closing(self._terminals):
            self._follow(text, name)
            self._terminals.end()

    def _follow(self, text: str, name: str) -> None:
        for block in blocks(text, name):
            with _at(block.place):
                if block.language not in self._languages:
                    raise DocsError(f"language {block.language!r}; there are {', '.join(self._languages)}")
                if block.language != "text":
                    self._is_in_terminal = block.name == "terminal"
                self._printed = self._languages[block.language](block)
        for file, place in self._programs.items():
            with _at(place):
                self._simulate(f"{file.removesuffix('.py')}:main")
        for place in self._tests.values():
            with _at(place):
                commands.run(["pytest", "-q", *self._tests], 0, self._folder)
            break

    def _simulate(self, entry: str) -> None:
        """Run a program that the page only shows. It need not send, but it must not be invalid."""
        words = ["vnet", "simulate", "scenarios/beacon.toml", "--duration", "2", "--program", entry]
        try:
            commands.run(words, 0, self._folder)
        except DocsError:
            commands.run(words, 3, self._folder)

    def _python(self, block: Block) -> str | None:
        if block.name.startswith("of "):
            _check_excerpt(block)
            return None
        code = compile(block.text, block.place, "exec")
        if NOT_INSTALLED.search(block.text):
            return None
        found = _FILE.match(block.text)
        number = block.place.rpartition(":")[2]
        if "def test_" in block.text:
            self._write(found.group(1) if found else f"test_{number}.py", block, self._tests)
        elif "(node: Node)" in block.text:
            self._write(found.group(1) if found else f"program_{number}.py", block, self._programs)
        else:
            if found:
                (self._folder / found.group(1)).write_text(block.text)
            with contextlib.redirect_stdout(io.StringIO()) as printed:
                exec(code, self._namespace)
            return printed.getvalue()
        return None

    def _write(self, name: str, block: Block, pending: dict[str, str]) -> None:
        """Write a file that is still to be run."""
        if name in pending:
            raise DocsError(f"{name} was written at {pending[name]}, and never run")
        (self._folder / name).write_text(block.text)
        pending[name] = block.place

    def _directives(self, block: Block) -> None:
        """Check that what the site shows from docstrings exists."""
        names = re.findall(r"^\.\. auto\w+:: ([\w.]+)$", block.text, re.MULTILINE)
        if not names:
            raise DocsError("no directive that shows a docstring")
        for name in names:
            try:
                pkgutil.resolve_name(name)
            except (ImportError, AttributeError) as error:
                raise DocsError(f"{name}: {error}") from None

    def _toml(self, block: Block) -> None:
        found = _FILE.match(block.text)
        path = self._folder / (found.group(1) if found else "fragment.toml")
        path.write_text(block.text)
        for unit in load_scenario(path).program.exceptions:  # a run of the scenario runs them
            self._programs.pop(f"{unit.entry.partition(':')[0]}.py", None)

    def _csv(self, block: Block) -> None:
        rows = list(csv.reader(io.StringIO(block.text)))
        if not block.name or len({len(row) for row in rows}) != 1:
            raise DocsError("a CSV file needs its name after the language, and rows of one length")
        (self._folder / block.name).write_text(block.text)

    def _sh(self, block: Block) -> str | None:
        printed: list[str] = []
        for words, status in commands.commands(block.text):
            text: str | None = ""
            if self._is_in_terminal and commands.is_run(words):
                self._terminals.start(words, commands.process(words), status, block.place)
            else:
                text = commands.run(words, status, self._folder)
            if text is not None:
                printed.append(text)
                for word in words:
                    self._programs.pop(f"{word.partition(':')[0].removesuffix('.py')}.py", None)
                    self._tests.pop(word, None)
        return "".join(printed) if printed else None

    def _text(self, block: Block) -> None:
        if self._is_in_terminal and self._printed is not None:
            self._terminals.wait_for(lambda printed: shows(printed, block.text))
        elif self._printed is not None and block.name != "figure" and not shows(self._printed, block.text):
            raise DocsError(f"this is not an excerpt of what was printed, which is:\n{self._printed}")

    def _json(self, block: Block) -> None:
        json.loads(block.text)

    def _yaml(self, block: Block) -> None:
        data = yaml.safe_load(block.text)
        if isinstance(data, dict) and "jobs" in data:
            check_workflow(data)


@contextlib.contextmanager
def _at(place: str) -> Any:
    """Say where in the documentation something is wrong."""
    try:
        yield
    except DocsError as error:
        raise DocsError(f"{place}: {error}") from None
    except Exception as error:
        raise DocsError(f"{place}: {type(error).__name__}: {error}") from error


def _check_excerpt(block: Block) -> None:
    """Raise DocsError unless the lines of a block are consecutive lines of the file that it names."""
    path = ROOT / block.name.removeprefix("of ")
    excerpt, source = ([line.strip() for line in text.splitlines()] for text in (block.text, path.read_text()))
    if not any(source[at : at + len(excerpt)] == excerpt for at in range(len(source))):
        raise DocsError(f"is no excerpt of {path.relative_to(ROOT)}")


def shows(printed: str, shown: str) -> bool:
    """Return True if `shown` is an excerpt of what was printed; see the module. The width of gaps is ignored."""
    pattern = "".join(
        r"(?:.*\n)*?" if line == "…" else ".*".join(map(re.escape, line.split("…"))) + "\n"
        for line in _lines(shown)
    )
    text = "".join(f"{line}\n" for line in _lines(printed))
    return re.search(f"^{pattern}", text, re.MULTILINE) is not None


def _lines(text: str) -> list[str]:
    return [" ".join(line.split()) for line in text.splitlines()]


def check_workflow(data: dict[Any, Any]) -> None:
    """The structure of a GitHub workflow, and its commands. Raises DocsError."""
    if not (data.get("on") or data.get(True)):  # YAML takes a bare `on` for a truth value
        raise DocsError("a workflow needs `on`")
    for name, job in data["jobs"].items():
        if not job.get("runs-on") or not job.get("steps"):
            raise DocsError(f"job {name} needs runs-on and steps")
        for step in job["steps"]:
            if ("uses" in step) == ("run" in step):
                raise DocsError(f"job {name}: a step either uses or runs: {step}")
            if "uses" in step and not re.fullmatch(r"[\w-]+/[\w.-]+(/[\w.-]+)*@[\w.-]+", step["uses"]):
                raise DocsError(f"job {name}: {step['uses']}: is not owner/action@version")
            for words, _ in commands.commands(step.get("run", "")):
                commands.parse(words)
