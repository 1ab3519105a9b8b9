"""Counts in texts agree with their nouns."""

import re

import pytest

from tests.support.paths import ROOT
from vnet.errors import counted

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
