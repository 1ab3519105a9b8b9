"""All colours stand in the palette, and are told apart."""

import ast
import re
from pathlib import Path

import pytest

from emulator.pages.palette import PAGE, PALETTE
from tests.support.paths import ROOT

HEX = re.compile(r"#[0-9a-fA-F]{3}(?:[0-9a-fA-F]{3})?\b(?![^{]*\{)")
OKABE_ITO = {"#e69f00", "#56b4e9", "#009e73", "#f0e442", "#0072b2", "#d55e00", "#cc79a7"}


def strings(path: Path) -> list[str]:
    tree = ast.parse(path.read_text())
    return [node.value for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)]


@pytest.mark.slow
def test_no_colour_stands_anywhere_else() -> None:
    sources = [path for path in (ROOT / "emulator").rglob("*.py") if path.name != "palette.py"]
    found = {path.name: text for path in sources for text in strings(path) if re.fullmatch(HEX, text)}
    templates = list((ROOT / "emulator" / "pages" / "templates").iterdir())
    assert any(path.name == "style.css" for path in templates)
    found |= {path.name: match[0] for path in templates if (match := HEX.search(path.read_text()))}
    assert found == {}


def test_series_are_those_of_okabe_and_ito_and_all_colours_differ() -> None:
    assert {colour.light for colour in PALETTE.values()} > OKABE_ITO
    for shade in ("light", "dark", "either"):
        assert len({getattr(colour, shade) for colour in PALETTE.values()}) == len(PALETTE)
    assert PALETTE["sky"].rgb == (86, 180, 233)


def luminance(colour: str) -> float:
    """Relative luminance by WCAG 2."""
    parts = [part / 255 for part in bytes.fromhex(colour[1:])]
    red, green, blue = (part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts)
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue


def contrast(one: str, other: str) -> float:
    low, high = sorted((luminance(one), luminance(other)))
    return (high + 0.05) / (low + 0.05)


def test_texts_can_be_read_on_their_paper() -> None:
    colours = PALETTE | PAGE
    pairs = [("ink", "paper"), ("quiet", "paper"), ("link", "paper"), ("ink", "panel")]
    pairs += [(name, f"{name}-paper") for name in ("good", "bad", "open")]
    for text, paper in pairs:
        for shade in ("light", "dark"):
            assert contrast(getattr(colours[text], shade), getattr(colours[paper], shade)) >= 4.5, (text, shade)
