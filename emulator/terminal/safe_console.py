"""A console for texts that others wrote: control characters are shown as escapes, and no markup is obeyed."""

from __future__ import annotations

from collections.abc import Iterable
from typing import IO

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment

from emulator.pages.text import as_text


class SafeConsole(Console):
    """A console whose own colours are the only escape sequences that reach the terminal."""

    def __init__(self, file: IO[str] | None = None, stderr: bool = False, colours: bool = True) -> None:
        super().__init__(
            file=file, stderr=stderr, markup=False, emoji=False, color_system="auto" if colours else None
        )

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """Yield the segments of a renderable, with the control characters of its texts as escapes."""
        for segment in super().render(renderable, options):
            plain = segment.control is not None or segment.text.isprintable() or segment.text == "\n"
            yield segment if plain else segment._replace(text=as_text(segment.text))
