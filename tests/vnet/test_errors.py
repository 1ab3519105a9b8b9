"""Words of messages that several commands share."""

import re

import pytest

from tests.support.paths import ROOT
from vnet.errors import counted, first_names


def test_a_long_list_of_names_is_cut_and_says_so() -> None:
    names = [f"v{number}" for number in range(12)]
    assert first_names(names[:2]) == "v0, v1"
    assert first_names(names[:8]) == "v0, v1, v2, v3, v4, v5, v6, v7"
    assert first_names(names) == "v0, v1, v2, v3, v4, v5, v6, v7, …"
    assert first_names(names, 2, with_total=True) == "v0, v1, … (12)"
    assert first_names(names[:2], 2, with_total=True) == "v0, v1"
    assert first_names([]) == ""


PLURALS = "frames|receptions|vehicles|nodes|deliveries|reports|fixes|processes|events|gaps|arrivals|transmissions"


@pytest.mark.parametrize(
    ("number", "text"), [(0, "0 fixes"), (1, "1 fix"), (2, "2 fixes"), (1000, "1,000 fixes"), (-1, "-1 fixes")]
)
def test_a_count_agrees_with_its_noun(number: int, text: str) -> None:
    assert counted(number, "fix", "fixes") == text


def test_an_ordinary_noun_needs_no_plural() -> None:
    assert (counted(1, "frame"), counted(7, "frame")) == ("1 frame", "7 frames")


def test_texts_of_checks_count_by_the_helper() -> None:
    found = [
        f"{path.name}: {text}"
        for path in sorted((ROOT / "emulator" / "checks").glob("*.py"))
        for text in re.findall(rf"\{{[^{{}}]+\}} (?:{PLURALS})\b[^\"]*", path.read_text())
    ]
    assert found == []
