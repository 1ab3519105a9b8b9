"""Cells of studies without processes of their own."""

from typing import Any

import pytest

from emulator.cells.cells import Cell, compute


def compute_here(monkeypatch: pytest.MonkeyPatch) -> list[Cell]:
    """Have cells computed in this process, which starts none; returns those that were, as they are done."""
    ran: list[Cell] = []

    def each(jobs: list[Cell], *_: object) -> Any:
        for cell in jobs:
            ran.append(cell)
            yield cell, compute(cell)

    monkeypatch.setattr("emulator.cells.cells.each_done", each)
    return ran
