"""Target of a debugger: a vehicle, and a line of its program."""

from __future__ import annotations

import inspect
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from vnet.errors import VnetError, printable


@dataclass(frozen=True)
class DebugTarget:
    """Target of a debugger: a node, and the line at which it stops first, or its program's first."""

    node: str
    file: str = ""
    line: int = 0

    @classmethod
    def parse(cls, text: str) -> DebugTarget:
        """Read `NODE` or `NODE:FILE:LINE`. Raises VnetError."""
        read = re.fullmatch(r"([^:]+)(?::(.+):([1-9][0-9]{0,8}))?", text)
        if read is None:
            raise VnetError(f"--debug {printable(text)}: write it as NODE or NODE:FILE:LINE, as v03:hello.py:12")
        return cls(read[1], read[2] or "", int(read[3] or 0))

    def __str__(self) -> str:
        return f"{self.node}:{self.file}:{self.line}" if self.file else self.node


def resolve(target: DebugTarget, folders: Sequence[Path], has_scripts: bool = False) -> DebugTarget:
    """Return a target with its file absolute, looked for in the current folder and then in `folders`.

    With `has_scripts` programs are run as scripts are, so that a debugger stops outside of functions, too.

    Raises VnetError where there is no such file, or no code on the line.
    """
    if not target.file:
        return target
    found = [path for folder in (Path(), *folders) if (path := (folder / target.file).absolute()).is_file()]
    if not found:
        raise VnetError(f"--debug {target}: {printable(target.file)}: no such file")
    lines = _lines_with_code(found[0], has_scripts)
    if lines is not None and target.line not in lines:
        later = min((line for line in lines if line > target.line), default=None)
        hint = "" if later is None else f"; the next one with code is {later}"
        raise VnetError(f"--debug {target}: no code on line {target.line}{hint}")
    return DebugTarget(target.node, str(found[0]), target.line)


def _lines_with_code(path: Path, has_scripts: bool) -> set[int] | None:
    """Lines at which a debugger can stop within functions, or anywhere; None for a file that does not compile."""
    try:
        waiting = [compile(path.read_bytes(), str(path), "exec", dont_inherit=True)]
    except (OSError, SyntaxError, ValueError):
        return None
    lines: set[int] = set()
    while waiting:
        code = waiting.pop()
        inner = [constant for constant in code.co_consts if inspect.iscode(constant)]
        waiting += inner
        if has_scripts or code.co_flags & inspect.CO_NEWLOCALS:
            first = code.co_firstlineno if code.co_flags & inspect.CO_NEWLOCALS else 0
            lines.update(line for _, _, line in code.co_lines() if line is not None and line > first)
    return lines
