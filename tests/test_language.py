"""The language of the code and the pages: the field's terms, and docstrings that say what a thing is or does.

`docs/glossary.md` has the terms that are vnet's own. The words below once stood for terms of the field; they stand
nowhere any more but in the changelog, in quotations and in code that readers of old folders need.
"""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.paths import ROOT

CODE = ("vnet", "agents", "emulator", "docs", "benchmarks", "tests")
FRAGMENT = re.compile(r"(who|whom|whose|what|when|where|which|whether|of|how)\b", re.IGNORECASE)

REPLACED_NAMES = {
    "luck",
    "fate",
    "Ear",
    "ask_ns",
    "Surroundings",
    "surroundings",
    "Reach",
    "Arrivals",
    "LinkError",
    "NodeLink",
    "BentGnss",
    "ClockBend",
    "BendableLoop",
    "_suffer",
    "way_in",
    "read_way_in",
    "see_off",
    "let_go",
    "_farewell",
    "Standing",
    "ask_where",
    "_stands_still",
    "Evidence",
    "read_evidence",
    "takers",
    "exile",
    "blame",
    "crowd",
    "roads_apart",
    "weigh_roads",
    "least_log_road",
    "LEAST_LOG_ROAD",
    "unlooked_s",
    "sever",
    "supply",
    "Whole",
    "NEVER_NS",
    "OF_THE_RADIO",
    "SPOILT_BY_THE_MACHINE",
    "_excused",
    "Asked",
    "nasties",
    "Workshop",
    "hand_over",
    "Pairs",
}
"""Identifiers that no definition, argument or attribute bears: LANGUAGE has the term that each gave way to."""

REPLACED_WORDS = (
    "flagship",
    "the house",
    "storey",
    "storeys",
    "delivered share",
    "time on the way",
    "between two receptions",
    "added latency",
    "luck",
    "handed over",
    "hand over",
    "hands over",
    "way in",
    "see off",
    "last words",
    "silent and deaf",
    "whom it strikes",
    "takers",
    "come together",
    "comes together",
    "pull together",
    "held to ns-3",
    "have it again",
    "had again",
    "anew",
    "mend",
    "mended",
    "left out, and why",
    "signals have no power",
    "senders share no medium",
    "nobody measured",
    "for ever at one instant",
    "is called so",
    "as often as need be",
    "means nothing here",
    "of all that is drawn at random",
    "what of a trip is believed",
    "stands still",
    "stand still",
    "stood still",
)
"""Phrases that stand in no docstring, no message and on no page."""
WORDS = re.compile(r"\b(" + "|".join(map(re.escape, REPLACED_WORDS)) + r")\b", re.IGNORECASE)
NOT_JUDGED = {"tests/test_language.py", "CHANGELOG.md"}


def code_files() -> list[Path]:
    """The Python files of the project."""
    return sorted(
        path for package in CODE for path in (ROOT / package).rglob("*.py") if "__pycache__" not in path.parts
    )


def pages() -> list[Path]:
    """README, CONTRIBUTING and the documentation."""
    return sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])


def docstrings(code: str) -> Iterator[tuple[int, str]]:
    """Yield line and text of the docstrings of modules, classes, functions and attributes."""
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)):
            for statement in node.body:
                match statement:
                    case ast.Expr(value=ast.Constant(value=str(text))):
                        yield statement.lineno, text


def texts(path: Path) -> str:
    """The prose of a file: the strings of code, or a page without its blocks of code and quotations."""
    text = path.read_text()
    if path.suffix == ".py":
        strings = (n.value for n in ast.walk(ast.parse(text)) if isinstance(n, ast.Constant))
        return "\n".join(string for string in strings if isinstance(string, str))
    text = re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)
    return "\n".join(line for line in text.splitlines() if not line.startswith(">"))


def defined_names(code: str) -> Iterator[str]:
    """Yield the names that some code gives: functions, classes, arguments, variables, attributes."""
    for node in ast.walk(ast.parse(code)):
        match node:
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name) | ast.ClassDef(name=name):
                yield name
            case ast.arg(arg=name) | ast.Name(id=name, ctx=ast.Store()) | ast.Attribute(attr=name, ctx=ast.Store()):
                yield name


def relative(path: Path) -> str:
    """A path as it is named in the repository."""
    return str(path.relative_to(ROOT))


def fragments(path: Path) -> list[str]:
    """The docstrings of a file whose first line is no imperative and no noun phrase with its subject."""
    found = docstrings(path.read_text())
    return [f"{relative(path)}:{line}: {text.splitlines()[0][:60]}" for line, text in found if FRAGMENT.match(text)]


@pytest.mark.parametrize("package", CODE)
def test_docstrings_say_what_a_thing_is_or_does(package: str) -> None:
    found = [line for path in code_files() if relative(path).startswith(f"{package}/") for line in fragments(path)]
    assert found == []


@pytest.mark.parametrize("package", CODE)
def test_names_are_the_fields_terms(package: str) -> None:
    mine = [path for path in code_files() if relative(path).startswith(f"{package}/")]
    found = {relative(path): sorted(set(defined_names(path.read_text())) & REPLACED_NAMES) for path in mine}
    assert {path: names for path, names in found.items() if names} == {}


@pytest.mark.parametrize("path", [*code_files(), *pages()], ids=relative)
def test_no_replaced_word_is_left(path: Path) -> None:
    if relative(path) not in NOT_JUDGED:
        assert sorted({match.group().lower() for match in WORDS.finditer(texts(path))}) == []


@pytest.mark.parametrize(
    ("code", "count"),
    [
        ('"""Whether it is so."""', 1),
        ('def f():\n    """Return the packets."""', 0),
        ('class A:\n    x: int\n    """Of the carrier."""', 1),
        ('"""Wherever it is."""', 0),
    ],
)
def test_fragments_are_seen(code: str, count: int) -> None:
    assert sum(bool(FRAGMENT.match(text)) for _, text in docstrings(code)) == count
