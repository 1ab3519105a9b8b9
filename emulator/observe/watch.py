"""The observer process: hears a run over Zenoh and records it. It can never slow a vehicle, or the run.

What it has not recorded yet waits in a bounded inbox; periods for which there is no room are left out, and the
recording says so. It ends with the run, with SIGTERM or SIGINT, or once the emulator has been gone for too long;
the file is closed cleanly.
"""

from __future__ import annotations

import contextlib
import gc
import os
import signal
import sys
import threading
import time
import tomllib
from collections.abc import Iterable
from typing import Any

import zenoh

from emulator.observe.recorder import Recorder
from emulator.observe.sinks import Sinks
from vnet.errors import WireError
from vnet.link import keys, wire
from vnet.link.access import Credentials
from vnet.link.scheduling import DEFAULT_SLICE, set_time_slice
from vnet.link.session import open_client

LEASE_MS = 60_000
NICE = 10
"""Where it shares a session with the run, or sessions do not count, the emulator and the agents come first."""
GATHER_S = 1.0
"""Messages are taken together, once so often: ten at a time cost a fifth less than each by itself."""
INBOX_BYTES = 64 * 1024 * 1024
DEFAULT_PATIENCE_S = 5.0


class Inbox:
    """Messages on their way to the recording: Zenoh's threads `put`, and never wait; one thread takes them.

    At most `limit_bytes` wait: what finds no room is dropped and counted, but for the end of the run.
    """

    def __init__(self, limit_bytes: int = INBOX_BYTES) -> None:
        self._limit_bytes = limit_bytes
        self._waiting: list[tuple[str, bytes]] = []
        self._bytes = 0
        self._urgent = False
        self._changed = threading.Condition()
        self.dropped = 0

    def put(self, stream: str, data: bytes = b"") -> None:
        """Add a message, if there is room."""
        with self._changed:
            if self._bytes + len(data) > self._limit_bytes and stream != "end":
                self.dropped += 1
                return
            self._waiting.append((stream, data))
            self._bytes += len(data)
            self._urgent |= stream != "period" or 2 * self._bytes > self._limit_bytes
            if self._urgent or len(self._waiting) == 1:
                self._changed.notify()

    def get_all(self, timeout_s: float | None = None, gather_s: float = 0.0) -> list[tuple[str, bytes]]:
        """All that waits, the oldest first; nothing if nothing comes within `timeout_s`.

        Periods are given `gather_s` to become more; whatever else comes, and a half-full inbox, are not waited on.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._waiting, timeout_s)
            if self._waiting:
                self._changed.wait_for(lambda: self._urgent, gather_s)
            items, self._waiting = self._waiting, []
            self._bytes, self._urgent = 0, False
            return items


def record_run(endpoint: str, run: str, credentials: Credentials | None, sinks: Sinks) -> None:
    """Record `run` into `sinks` until its end; see the module's text.

    Raises LinkError if there is no router at `endpoint` or it refuses, VnetError if the file cannot be written.
    """
    inbox = Inbox()

    def on_sample(sample: zenoh.Sample) -> None:
        inbox.put(str(sample.key_expr).rsplit("/", 1)[1], sample.payload.to_bytes())

    def on_alive(sample: zenoh.Sample) -> None:
        inbox.put("found" if sample.kind == zenoh.SampleKind.PUT else "lost")

    os.nice(NICE)
    set_time_slice(DEFAULT_SLICE)  # what started it may have a shorter one
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with (
        contextlib.suppress(KeyboardInterrupt),
        open_client(endpoint, credentials, LEASE_MS) as session,
        Recorder(sinks, run) as recorder,
    ):
        liveliness = session.liveliness()
        alive = liveliness.declare_subscriber(keys.emulator_alive(run), on_alive, history=True)
        with alive, session.declare_subscriber(keys.observe(run, "*"), on_sample):
            _record_all(inbox, recorder)


def _record_all(inbox: Inbox, recorder: Recorder) -> None:
    """Record messages until the end of the run, or until the emulator has been gone for too long."""
    taker = _Taker(recorder)
    while not taker.ended:
        try:
            items = inbox.get_all(taker.left_s, GATHER_S)
        except KeyboardInterrupt:  # what has come is recorded
            taker.take_all(inbox.get_all(0))
            raise
        if not items:
            _say(f"the emulator has been gone for {taker.patience_s:g} s; the recording ends")
            return
        taker.take_all(items)


class _Taker:
    """Hands messages on to the recorder, and knows how long the emulator may still be gone."""

    def __init__(self, recorder: Recorder) -> None:
        self._recorder = recorder
        self._deadline: float | None = None
        self._said = 0
        self.patience_s = DEFAULT_PATIENCE_S
        self.ended = False

    @property
    def left_s(self) -> float | None:
        """How long the emulator may still be gone; None if it is there."""
        return None if self._deadline is None else max(0.0, self._deadline - time.monotonic())

    def take_all(self, items: Iterable[tuple[str, bytes]]) -> None:
        """Take messages, and draw them."""
        for stream, data in items:
            if stream in ("lost", "found"):
                self._deadline = time.monotonic() + self.patience_s if stream == "lost" else None
                continue
            self._deadline = None  # whoever says something is there
            self._take(stream, data)
        self._recorder.draw()
        if (missed := self._recorder.missed) > self._said:
            _say(f"{missed - self._said} periods were left out: the recording could not keep up")
            self._said = missed

    def _take(self, stream: str, data: bytes) -> None:
        if (message := _decode(data)) is not None:
            self._recorder.take(stream, message)
            if stream == "scene":
                self.patience_s = _patience_s(message)
                gc.freeze()  # what is loaded stays: it need not be searched for garbage again and again
        self.ended |= stream == "end"


def _decode(data: bytes) -> dict[str, Any] | None:
    """A message; None if it is none, which is left out."""
    try:
        return wire.decode_observation(data)
    except WireError:
        return None


def _patience_s(scene: dict[str, Any]) -> float:
    """How long the emulator may be gone: as long as agents wait, and as long as planned faults take it away."""
    scenario = tomllib.loads(scene["scenario"])
    away_s = [fault.get("down_s", 0.0) for fault in scenario.get("fault", [])]
    return float(scenario["run"]["orphan_timeout_s"]) + max(away_s, default=0.0)


def _say(text: str) -> None:
    print(f"vnet record: {text}", file=sys.stderr, flush=True)
