"""The colours of all of vnet's pictures: pages, figures, maps, terminals and Rerun.

Series have the colours of Okabe and Ito (2008), which the colour-blind tell apart, brighter on dark paper; sand,
rust, navy, plum, teal and slate are shades for more series than there are such colours. Nothing is told by colour
alone.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Colour:
    """A colour as `#rrggbb`: on light paper, on dark paper, and one that shows on both."""

    light: str
    dark: str
    either: str

    @property
    def rgb(self) -> tuple[int, int, int]:
        """The colour that shows on light and dark, as red, green and blue from 0 to 255."""
        red, green, blue = bytes.fromhex(self.either[1:])
        return red, green, blue


def _colour(light: str, dark: str = "", either: str = "") -> Colour:
    return Colour(light, dark or light, either or light)


PALETTE = {
    "ink": _colour("#1b1f24", "#e4e7ea", "#646464"),
    "quiet": _colour("#59626d", "#9ba4ae"),
    "line": _colour("#d5d9df", "#363c44"),
    "grid": _colour("#e6e9ed", "#292e35"),
    "paper": _colour("#ffffff", "#14171b"),
    "blue": _colour("#0072b2", "#3fa2e0"),
    "orange": _colour("#e69f00", "#f0b132"),
    "green": _colour("#009e73", "#1fbf94"),
    "red": _colour("#d55e00", "#f5803a"),
    "purple": _colour("#cc79a7", "#e29bc3"),
    "sky": _colour("#56b4e9", "#8fd0f7"),
    "yellow": _colour("#f0e442"),
    "grey": _colour("#8b929b", "#7d858f", "#969696"),
    "sand": _colour("#bdb35c", "#8c8240", "#8c8232"),
    "rust": _colour("#8a3a00", "#c05a20", "#964208"),
    "navy": _colour("#004166", "#2c6f9e", "#285a8c"),
    "plum": _colour("#6a3d7c", "#a274b8", "#825aa0"),
    "teal": _colour("#3a7d7c", "#58a9a6", "#468c8c"),
    "slate": _colour("#4a5568", "#8793a8", "#64738c"),
}
"""Colours of series and of what is around them, by name; no two are alike on light paper."""
PAGE = {
    "panel": _colour("#f5f6f8", "#1d2126"),
    "link": _colour("#00609a", "#6cbcf0"),
    "good": _colour("#0b6b50", "#7fe0c0"),
    "good-paper": _colour("#d9f0e8", "#123a30"),
    "bad": _colour("#ffffff", "#1b1206"),
    "bad-paper": _colour("#b54a00", "#f5803a"),
    "open": _colour("#6a4a00", "#f5cf7d"),
    "open-paper": _colour("#fbeac4", "#3d3010"),
}
"""Colours of the pages alone: panels, links, and the badges of verdicts."""
