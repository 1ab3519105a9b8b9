"""Playback of a run in wall-clock time: due times of its messages."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator

from emulator.stream.playback import Message


def schedule(
    messages: Iterable[Message], speed: float, from_ns: int = 0, to_ns: int | None = None
) -> Iterator[tuple[float, Message]]:
    """Yield the messages of the emulated times [from_ns, to_ns), each with its due time.

    Due times are in seconds of the wall clock from `from_ns` on. The scene is always first and the end last;
    periods that start before `from_ns`, or at `to_ns` or later, are skipped.
    """
    due_s = 0.0
    for stream, message in messages:
        if stream == "period":
            time_ns = message["time_ns"]
            if time_ns < from_ns:
                continue
            if to_ns is not None and time_ns >= to_ns:
                yield due_s, ("end", {"events": []})
                return
            due_s = (time_ns - from_ns) / 1e9 / speed
        yield due_s, (stream, message)


def play(
    scheduled: Iterable[tuple[float, Message]],
    show: Callable[[Message], None],
    now_s: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
) -> int:
    """Show each message when it is due, or later if those before it take longer; return the number of periods.

    The clock starts with the first period, however long reading up to it takes.
    """
    periods = 0
    started_s = 0.0
    for due_s, message in scheduled:
        if message[0] == "period":
            if periods == 0:
                started_s = now_s() - due_s
            periods += 1
            if (early_s := started_s + due_s - now_s()) > 0:
                sleep(early_s)
        show(message)
    return periods
