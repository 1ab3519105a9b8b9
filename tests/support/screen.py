"""A terminal of the tests: what is on its screen after all that a program has written to it."""

import re

_PIECES = re.compile(r"\x1b\[(\??)(\d*(?:;\d+)*)([A-Za-z])|(\r)|(\n)|([^\x1b\r\n]+)")


class Screen:
    """Understands what vnet writes, and refuses anything else.

    Lines that are too wide are broken, and broken again when it is made narrower, as terminals do.
    """

    def __init__(self, width: int, height: int) -> None:
        self.width = width
        self.height = height
        self.rows = [""]
        self.row = self.column = 0

    def feed(self, text: str) -> None:
        """Write to it."""
        assert "".join(match.group() for match in _PIECES.finditer(text)) == text, "it writes something else"
        for match in _PIECES.finditer(text):
            private, numbers, final, carriage_return, newline, plain = match.groups()
            if carriage_return:
                self.column = 0
            elif newline:
                self._newline()
            elif plain:
                self._print(plain)
            else:
                self._control(private + final, int(numbers.split(";")[0] or (final == "A")))

    def _control(self, what: str, count: int) -> None:
        match what:
            case "A":
                self.row = max(self.row - count, 0, len(self.rows) - self.height)
            case "K":
                self.rows[self.row] = "" if count == 2 else self.rows[self.row][: self.column]
            case "J":
                self.rows[self.row] = self.rows[self.row][: self.column]
                del self.rows[self.row + 1 :]
            case "m" | "?h" | "?l":
                pass
            case _:
                raise AssertionError(f"unknown control {what!r}")

    def _newline(self) -> None:
        self.row, self.column = self.row + 1, 0
        if self.row == len(self.rows):
            self.rows.append("")

    def _print(self, text: str) -> None:
        for character in text:
            if self.column == self.width:
                self._newline()
            row = self.rows[self.row].ljust(self.column)
            self.rows[self.row] = row[: self.column] + character + row[self.column + 1 :]
            self.column += 1

    def resize(self, width: int, height: int) -> None:
        """Make it narrower or wider; the cursor stands at the end of the last row."""
        assert self.row == len(self.rows) - 1 and self.column == len(self.rows[-1])
        self.rows = [part for row in self.rows for part in self._broken(row, width)]
        self.row, self.column = len(self.rows) - 1, len(self.rows[-1])
        self.width, self.height = width, height

    @staticmethod
    def _broken(row: str, width: int) -> list[str]:
        return [row[start : start + width] for start in range(0, len(row), width)] or [""]

    @property
    def text(self) -> str:
        """All that is on it, and what has gone out at its top."""
        return "\n".join(row.rstrip() for row in self.rows).rstrip("\n")
