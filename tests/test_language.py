"""The language of the code and the pages: the field's terms, and docstrings that say what a thing is or does.

`docs/glossary.md` has the terms that are vnet's own. The words below once stood for terms of the field; they stand
nowhere any more but in the changelog, in quotations and in code that readers of old folders need.
"""

import ast
import re
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from tests.support.paths import ROOT

CODE = ("vnet", "agents", "emulator", "studies", "docs", "benchmarks", "tests")
FRAGMENT = re.compile(r"(who|whom|whose|what|when|where|which|whether|of|how)\b", re.IGNORECASE)
BEGINS = re.compile(f"[\"']\\s*{FRAGMENT.pattern}", re.IGNORECASE)

REPLACED_NAMES = {
    "luck", "fate", "Ear", "ask_ns", "Surroundings", "surroundings", "Reach", "Arrivals", "LinkError",
    "NodeLink", "BentGnss", "ClockBend", "BendableLoop", "_suffer", "way_in", "read_way_in", "see_off",
    "let_go", "_farewell", "Standing", "ask_where", "_stands_still", "Evidence", "read_evidence", "takers",
    "exile", "blame", "crowd", "roads_apart", "weigh_roads", "least_log_road", "LEAST_LOG_ROAD", "unlooked_s",
    "sever", "supply", "Whole", "NEVER_NS", "OF_THE_RADIO", "SPOILT_BY_THE_MACHINE", "_excused", "Asked",
    "nasties", "Workshop", "hand_over", "Pairs",
}  # fmt: skip
"""Identifiers that no definition, argument or attribute bears: LANGUAGE has the term that each gave way to."""

REPLACED_WORDS = (
    "flagship", "the house", "storey", "storeys", "delivered share", "time on the way",
    "between two receptions", "added latency", "luck", "handed over", "hand over", "hands over", "way in",
    "see off", "last words", "silent and deaf", "whom it strikes", "takers", "come together", "comes together",
    "pull together", "held to ns-3", "have it again", "had again", "anew", "mend", "mended",
    "left out, and why", "signals have no power", "senders share no medium", "nobody measured",
    "for ever at one instant", "is called so", "as often as need be", "means nothing here",
    "of all that is drawn at random", "what of a trip is believed", "stands still", "stand still",
    "stood still",
)  # fmt: skip
"""Phrases that stand in no docstring, no message and on no page."""
WORDS = re.compile(r"\b(" + "|".join(map(re.escape, REPLACED_WORDS)) + r")\b")
PHRASES = [
    (words, re.compile(r"\W+(?:[bfru]+\W+)?".join(words)))
    for words in (re.findall(r"\w+", each) for each in REPLACED_WORDS)
]
"""Their words, and a pattern of these one after the other, whatever quotes and ends of lines stand in between."""
NOT_JUDGED = {"tests/test_language.py", "CHANGELOG.md"}


def code_files(package: str) -> list[Path]:
    """The Python files of a package."""
    return sorted(path for path in (ROOT / package).rglob("*.py") if "__pycache__" not in path.parts)


def pages() -> list[Path]:
    """README, CONTRIBUTING and the documentation."""
    return sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])


@dataclass
class Language:
    """The words of a file."""

    docstrings: list[tuple[int, str]] = field(default_factory=list)
    """Line and text of the docstrings of modules, classes, functions and attributes."""
    names: set[str] = field(default_factory=set)
    """Names that some code gives: functions, classes, arguments, variables, attributes."""
    strings: list[str] = field(default_factory=list)
    """All strings of code, or the prose of a page as one."""


def language_of(code: str) -> Language:
    """The words of some code."""
    found = Language()
    for node in ast.walk(ast.parse(code)):
        match node:
            case ast.Constant(value=str(text)):
                found.strings.append(text)
            case ast.arg(arg=name) | ast.Name(id=name, ctx=ast.Store()) | ast.Attribute(attr=name, ctx=ast.Store()):
                found.names.add(name)
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name) | ast.ClassDef(name=name):
                found.names.add(name)
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)):
            for statement in node.body:
                match statement:
                    case ast.Expr(value=ast.Constant(value=str(text))):
                        found.docstrings.append((statement.lineno, text))
    return found


def language_in(path: Path) -> Language:
    """The words of a file: of code, or of a page without its blocks of code and quotations."""
    text = path.read_text()
    if path.suffix == ".py":
        return language_of(text)
    text = re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)
    return Language(strings=["\n".join(line for line in text.splitlines() if not line.startswith(">"))])


def relative(path: Path) -> str:
    """A path as it is named in the repository."""
    return str(path.relative_to(ROOT))


def fragments(language: Language) -> list[str]:
    """The docstrings whose first line is no imperative and no noun phrase with its subject."""
    return [f"{line}: {text.splitlines()[0][:60]}" for line, text in language.docstrings if FRAGMENT.match(text)]


def replaced_words(language: Language) -> list[str]:
    """The replaced phrases in the strings, also where a line breaks within one."""
    text = " ".join(" ; ".join(language.strings).lower().split())
    return sorted({match.group() for match in WORDS.finditer(text)})


def may_be_wrong(code: str) -> bool:
    """Tell, much faster than parsing it, whether some code may say anything in other words."""
    text = re.sub(r"\\[nt]|#.*", " ", code.lower())
    words = set(re.findall(r"\w+", text))
    return (
        BEGINS.search(code) is not None
        or not REPLACED_NAMES.isdisjoint(re.findall(r"\w+", code))
        or any(words.issuperset(parts) and apart.search(text) for parts, apart in PHRASES)
    )


def problems(path: Path) -> list[str]:
    """All that a file says in other words."""
    if path.suffix == ".py" and not may_be_wrong(path.read_text()):
        return []
    language = language_in(path)
    words = [] if relative(path) in NOT_JUDGED else replaced_words(language)
    return [*fragments(language), *sorted(language.names & REPLACED_NAMES), *words]


@pytest.mark.slow
@pytest.mark.parametrize("package", CODE)
def test_code_speaks_the_language(package: str) -> None:
    assert {relative(path): found for path in code_files(package) if (found := problems(path))} == {}


def test_pages_speak_the_language() -> None:
    assert {relative(path): found for path in pages() if (found := problems(path))} == {}


@pytest.mark.parametrize("word", ["Handed over", "the flagship", "as often\nas need be"])
def test_replaced_words_are_seen(word: str) -> None:
    for code in (
        f"TEXT = {word!r}",
        "TEXT = '" + "' f'".join(re.split(r"(?<=\s)", word)).replace("\n", "\\n") + "'",
    ):
        assert len(replaced_words(language_of(code))) == 1 and may_be_wrong(code)


def test_names_that_are_given_are_seen() -> None:
    language = language_of("def f(a, *b):\n    c.d = e\n    class G: ...\n    async def h(): ...")
    assert language.names == {"f", "a", "b", "d", "G", "h"}
    assert may_be_wrong("a.luck = 3") and not may_be_wrong("a.b = 3")


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
    found = [text for _, text in language_of(code).docstrings if FRAGMENT.match(text)]
    assert len(found) == count == may_be_wrong(code)


PROSE = [path for path in (ROOT / "docs").rglob("*.md") if path.parent.name != "reference"]
PROSE += [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")]
COLUMNS = 120


def test_no_line_of_prose_is_longer_than_the_page_is_wide() -> None:
    long = []
    for path in PROSE:
        in_code = False
        for number, line in enumerate(path.read_text().splitlines(), 1):
            in_code ^= line.lstrip().startswith(("```", "~~~"))
            breakable = " " in re.sub(r"`[^`]*`", "", line).strip()
            if len(line) > COLUMNS and breakable and not in_code and not line.lstrip().startswith("|"):
                long.append(f"{relative(path)}:{number}")
    assert long == []
