"""The observer process: hears a run over Zenoh and records it. It can never slow a vehicle, or the run.

What it has not recorded yet waits in a bounded inbox; periods for which there is no room are left out, and the
recording says so. It ends with the run, with SIGTERM or SIGINT, or once the emulator has been gone for too long;
the file is closed cleanly.
"""

from __future__ import annotations

import gc
import os
import signal
import sys
import threading
import time
import tomllib
from collections import deque
from typing import Any

import zenoh

from emulator.viewer.recorder import Recorder
from emulator.viewer.sinks import Sinks
from vnet.errors import TransportError, WireError
from vnet.transport import keys, wire
from vnet.transport.credentials import Credentials
from vnet.transport.scheduling import DEFAULT_SLICE, set_time_slice
from vnet.transport.session import open_client

LEASE_MS = 60_000
NICE = 10
"""Niceness of the observer, so that the emulator and the agents come first."""
GATHER_S = 1.0
"""Messages are taken together, once so often: ten at a time cost a fifth less than each by itself."""
CLOSING_S = 0.2
"""Time to finish after a signal: it is killed half a second after it, and the file must be closed by then."""
INBOX_BYTES = 64 * 1024 * 1024
DEFAULT_PATIENCE_S = 5.0
FIRST_SIGN_S = 60.0
"""Time within which the emulator must be there: as long as an agent waits for its welcome."""


class Inbox:
    """Messages on their way to the recording: Zenoh's threads `put`, and never wait; one thread takes them.

    At most `limit_bytes` wait: what finds no room is dropped and counted, but for the end of the run.
    """

    def __init__(self, limit_bytes: int = INBOX_BYTES) -> None:
        self._limit_bytes = limit_bytes
        self._waiting: deque[tuple[str, bytes]] = deque()
        self._bytes = 0
        self._urgent = False
        self._changed = threading.Condition()
        self.dropped = 0
        self.is_closed = False

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

    def close(self) -> None:
        """Nothing is waited for any more. May be called by a signal's handler."""
        with self._changed:
            self.is_closed = True
            self._changed.notify()

    def gather(self, timeout_s: float | None = None, gather_s: float = 0.0) -> int:
        """Wait for messages; returns how many there are: none if none comes within `timeout_s`, or it is closed.

        Periods are given `gather_s` to become more; whatever else comes, and a half-full inbox, are not waited on.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self.is_closed, timeout_s)
            if self._waiting:
                self._changed.wait_for(lambda: self._urgent or self.is_closed, gather_s)
            return len(self._waiting)

    def take(self) -> tuple[str, bytes]:
        """The oldest message; there must be one."""
        with self._changed:
            stream, data = self._waiting.popleft()
            self._bytes -= len(data)
            self._urgent &= bool(self._waiting)
            return stream, data


def record_run(endpoint: str, run: str, credentials: Credentials | None, sinks: Sinks) -> None:
    """Record `run` into `sinks` until its end; see the module's text.

    Raises TransportError if no router at `endpoint` accepts, or no emulator is there under this name, VnetError if
    the file cannot be written, and KeyboardInterrupt if it is to end before anything has been heard.
    """
    inbox = Inbox()

    def on_sample(sample: zenoh.Sample) -> None:
        inbox.put(str(sample.key_expr).rsplit("/", 1)[1], sample.payload.to_bytes())

    def on_alive(sample: zenoh.Sample) -> None:
        inbox.put("found" if sample.kind == zenoh.SampleKind.PUT else "lost")

    def on_signal(*_: object) -> None:
        inbox.close()

    os.nice(NICE)
    set_time_slice(DEFAULT_SLICE)  # what started it may have a shorter one
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with (
        open_client(endpoint, credentials, LEASE_MS) as session,
        Recorder(sinks, run) as recorder,
    ):
        for number in (signal.SIGTERM, signal.SIGINT):  # from here on nothing is left half drawn
            signal.signal(number, on_signal)
        liveliness = session.liveliness()
        alive = liveliness.declare_subscriber(keys.emulator_alive(run), on_alive, history=True)
        with alive, session.declare_subscriber(keys.observe(run, "*"), on_sample):
            _record_all(inbox, recorder, run)
        recorder.finish()


def _record_all(inbox: Inbox, recorder: Recorder, run: str) -> None:
    """Record messages until the end of the run, the inbox is closed, or the emulator has been gone for too long.

    Raises TransportError if it never was there.
    """
    taker = _Taker(inbox, recorder)
    while not taker.ended:
        count = inbox.gather(taker.left_s, GATHER_S)
        taker.take(count)
        if inbox.is_closed:
            if not taker.heard:
                raise KeyboardInterrupt
            return
        if not count:
            if not taker.heard:
                raise TransportError(f"run {run}: no sign of it within {FIRST_SIGN_S:g} s: is it running?")
            _say(f"the emulator has been gone for {taker.patience_s:g} s; the recording ends")
            return


class _Taker:
    """Hands messages on to the recorder, and knows how long the emulator may still be gone."""

    def __init__(self, inbox: Inbox, recorder: Recorder) -> None:
        self._inbox = inbox
        self._recorder = recorder
        self._deadline: float | None = time.monotonic() + FIRST_SIGN_S
        self._said = 0
        self.patience_s = DEFAULT_PATIENCE_S
        self.heard = self.ended = False

    @property
    def left_s(self) -> float | None:
        """Time left for the emulator to come, or to return; None if it is there."""
        return None if self._deadline is None else max(0.0, self._deadline - time.monotonic())

    def take(self, count: int) -> None:
        """Take so many messages, and draw them; of many that wait when the inbox is closed, the first."""
        closing: float | None = None
        for _ in range(count):
            if self._inbox.is_closed:
                closing = closing or time.monotonic() + CLOSING_S
                if time.monotonic() > closing:
                    break
            stream, data = self._inbox.take()
            self.heard = True
            if stream == "found":
                self._deadline = None
            elif stream == "lost" or self._deadline is not None:  # its last words may come after it is lost
                self._deadline = time.monotonic() + self.patience_s
            if stream not in ("lost", "found"):
                self._record(stream, data)
        self._recorder.draw()
        if (missed := self._recorder.missed) > self._said:
            _say(f"{missed - self._said} periods were left out: the recording could not keep up")
            self._said = missed

    def _record(self, stream: str, data: bytes) -> None:
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
    """Time that the emulator may be gone: as long as agents wait, and as long as planned faults take it away."""
    scenario = tomllib.loads(scene["scenario"])
    away_s = [fault.get("down_s", 0.0) for fault in scenario.get("fault", [])]
    return float(scenario["run"]["orphan_timeout_s"]) + max(away_s, default=0.0)


def _say(text: str) -> None:
    print(f"vnet record: {text}", file=sys.stderr, flush=True)
