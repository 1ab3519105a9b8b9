"""The tables of docs/messages.md as layouts, for a reader and a writer of the wire that know nothing of vnet.

A layout is the fields of one message or part, in order, each with its type and bounds as the page writes them.
"""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from hypothesis import strategies as st

from tests.support.paths import ROOT

PAGE = ROOT / "docs" / "messages.md"
_SECTION = re.compile(r"^\| \*\*(\w+)\*\* [^\n]*\n(.*?)(?=^\| \*\*|^[^|]|\Z)", re.MULTILINE | re.DOTALL)
_ROW = re.compile(r"^\| `(\w+)` \| `([^|]+)` \|(.*)\|$", re.MULTILINE)
_RANGE = re.compile(r"(-?[\d^]+) … (-?[\d^]+)")
_LIMIT = re.compile(r"([<>]) (-?[\d^]+)")
_SIZE = re.compile(r"(\d+) elements")
_ITEM_BYTES = {"float32": 4, "int32": 4, "int16": 2, "uint8": 1}
_ANY = (
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats(allow_nan=False) | st.text(max_size=5)
)


@dataclass(frozen=True)
class Field:
    """One row of a table. The bounds hold for each number of the value."""

    name: str
    type: str
    bounds: str = ""

    def allows(self, number: float) -> bool:
        """Return True if a number is within the bounds."""
        inside = all(_number(low) <= number <= _number(high) for low, high in _RANGE.findall(self.bounds))
        compare: dict[str, Callable[[float, float], bool]] = {"<": lambda a, b: a < b, ">": lambda a, b: a > b}
        return inside and all(compare[sign](number, _number(limit)) for sign, limit in _LIMIT.findall(self.bounds))

    def range(self) -> tuple[int, int]:
        """The least and the greatest integer of the bounds, or of a range to draw from where there are none."""
        pairs = [(_number(low), _number(high)) for low, high in _RANGE.findall(self.bounds)]
        return max([-(2**62), *(low for low, _ in pairs)]), min([2**62, *(high for _, high in pairs)])

    def edges(self) -> tuple[list[int], list[int]]:
        """Integers at the edges of the bounds that are allowed, and that are not."""
        limits = [_number(text) for pair in _RANGE.findall(self.bounds) for text in pair]
        limits += [_number(text) for _, text in _LIMIT.findall(self.bounds)]
        near = sorted({limit + step for limit in limits for step in (-1, 0, 1)})
        return [n for n in near if self.allows(n)], [n for n in near if not self.allows(n)]


def read_page() -> dict[str, list[Field]]:
    """The layouts of the page by name: a row in bold, and the rows of its fields."""
    return {
        name: [Field(field, type_, rest.rpartition("|")[0].strip()) for field, type_, rest in _ROW.findall(rows)]
        for name, rows in _SECTION.findall(PAGE.read_text(encoding="utf-8"))
    }


def _number(text: str) -> int:
    base, _, exponent = text.lstrip("-").partition("^")
    return (int(base) ** int(exponent or 1)) * (-1 if text.startswith("-") else 1)


def split(text: str, separator: str) -> list[str]:
    """Split a type at a separator that stands outside all brackets."""
    parts, depth, start = [], 0, 0
    for i, character in enumerate(text):
        depth += (character in "[({") - (character in "])}")
        if depth == 0 and text.startswith(separator, i):
            parts.append(text[start:i])
            start = i + len(separator)
    return [*parts, text[start:]]


class Layouts:
    """Reads and writes values as the page says."""

    def __init__(self) -> None:
        self.by_name = read_page()

    # Reading.

    def problem_of(self, kind: str, values: Any, sizes: dict[str, int] | None = None) -> str:
        """Say what is wrong with a message or part: an array of its values, or a map by name; else empty."""
        fields = self.by_name[kind]
        if isinstance(values, dict):
            if list(values) != [field.name for field in fields]:
                return f"{kind}: fields {list(values)}"
            values = list(values.values())
        if not isinstance(values, list) or len(values) != len(fields):
            return f"{kind}: not {len(fields)} values: {values!r}"
        for field, value in zip(fields, values, strict=True):
            if not self._fits(field.type, value, field, sizes or {}):
                return f"{kind}.{field.name}: {value!r} is no {field.type} {field.bounds}"
        return ""

    def _fits(self, type_: str, value: Any, field: Field, sizes: dict[str, int]) -> bool:
        alternatives = split(type_, " or ")
        if len(alternatives) > 1:
            return any(self._fits(each, value, field, sizes) for each in alternatives)
        if type_.startswith("["):
            size = _SIZE.search(field.bounds)
            right_size = size is None or (isinstance(value, list) and len(value) == int(size[1]))
            inside = isinstance(value, list) and all(self._fits(type_[1:-1], v, field, sizes) for v in value)
            return right_size and inside
        if type_.startswith("("):
            types = split(type_[1:-1], ", ")
            if not isinstance(value, list) or len(value) != len(types):
                return False
            return all(self._fits(each, v, field, sizes) for each, v in zip(types, value, strict=True))
        if type_.startswith("{text: "):
            each = type_.removeprefix("{text: ").removesuffix("}")
            return isinstance(value, dict) and all(
                isinstance(name, str) and self._fits(each, v, field, sizes) for name, v in value.items()
            )
        return self._fits_one(type_, value, field, sizes)

    def _fits_one(self, type_: str, value: Any, field: Field, sizes: dict[str, int]) -> bool:
        if type_.startswith('"'):
            return bool(value == type_.strip('"'))
        if type_.split(" ")[0] in _ITEM_BYTES:
            return isinstance(value, bytes) and _is_array(type_, len(value), sizes)
        match type_:
            case "any":
                return True
            case "nil":
                return value is None
            case "text":
                return isinstance(value, str)
            case "bytes":
                return isinstance(value, bytes)
            case "bool":
                return isinstance(value, bool)
            case "int":
                return isinstance(value, int) and not isinstance(value, bool) and field.allows(value)
            case "float":
                return isinstance(value, int | float) and not isinstance(value, bool) and field.allows(value)
        return self.problem_of(type_, value, sizes) == ""

    # Writing.

    def values(self, kind: str) -> st.SearchStrategy[Any]:
        """Values of a message or part, within the page's types and bounds."""
        fields = self.by_name[kind]
        drawn = [self._value(field.type, field) for field in fields]
        if kind == "Report":
            return st.fixed_dictionaries({field.name: each for field, each in zip(fields, drawn, strict=True)})
        return st.tuples(*drawn).map(list)

    def _value(self, type_: str, field: Field) -> st.SearchStrategy[Any]:
        alternatives = split(type_, " or ")
        if len(alternatives) > 1:
            return st.one_of([self._value(each, field) for each in alternatives])
        if type_.startswith("["):
            size = _SIZE.search(field.bounds)
            least, most = (int(size[1]), int(size[1])) if size else (0, 3)
            return st.lists(self._value(type_[1:-1], field), min_size=least, max_size=most)
        if type_.startswith("("):
            return st.tuples(*(self._value(each, field) for each in split(type_[1:-1], ", "))).map(list)
        if type_.startswith("{text: "):
            each = type_.removeprefix("{text: ").removesuffix("}")
            return st.dictionaries(st.text(max_size=5), self._value(each, field), max_size=3)
        if type_.startswith('"'):
            return st.just(type_.strip('"'))
        low, high = field.range()
        integers = st.integers(low, high) | st.sampled_from(field.edges()[0] or [0])
        simple: dict[str, st.SearchStrategy[Any]] = {
            "any": _ANY,
            "nil": st.none(),
            "text": st.text(max_size=8),
            "bytes": st.binary(max_size=20),
            "bool": st.booleans(),
            "int": integers.filter(field.allows),
            "float": st.floats(max(low, -(2.0**60)), min(high, 2.0**60)).filter(field.allows),
        }
        return simple[type_] if type_ in simple else self.values(type_)


def _is_array(type_: str, size: int, sizes: dict[str, int]) -> bool:
    """Return True if so many bytes are an array of this type; `sizes` are those of its letters, k is any."""
    item, _, shape = type_.partition(" ")
    lengths = [int(part) if part.isdigit() else sizes.get(part) for part in shape.strip("()").split(", ")]
    known = math.prod(length for length in lengths if length is not None) * _ITEM_BYTES[item]
    return size % known == 0 if None in lengths else size == known
