"""The emulator's end of the wire, without an agent."""

import queue
from pathlib import Path
from typing import Any

import pytest

from emulator.testing.conformance.scene import Bench, Said
from vnet.transport.access import Access


class Late:
    """A queue into which everything comes only after it was found empty a few times."""

    def __init__(self, *items: Any) -> None:
        self._items = [*items]
        self._empty = 3

    def get(self, timeout: float) -> Any:
        if self._empty or not self._items:
            self._empty -= 1
            raise queue.Empty
        return self._items.pop(0)


def test_what_an_agent_says_last_is_heard_after_its_exit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Bench, "exit_status", 0)
    bench = Bench(Access.create("r", [["v01"]]), "tcp/127.0.0.1:0", [], tmp_path)
    last = Said(b"", 0, None, "nothing")
    monkeypatch.setattr(bench, "_incoming", Late(last, False))
    bench.present = True
    assert bench.hear(1000.0) is last
    assert bench.hear(1000.0) is None
    assert not bench.present
