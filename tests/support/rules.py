"""Rules of a user's own, as tests name them."""

import contextlib
import signal
import threading
import time
from typing import Any

import numpy as np

from emulator import Answer, RadioFrame
from emulator.scenario import own_functions

State = dict[str, Any]


def passes(frame: RadioFrame, state: State) -> None:
    """Let everything pass."""


def drops(frame: RadioFrame, state: State) -> Answer:
    """Drop everything."""
    return Answer(drop=True)


def drops_far(frame: RadioFrame, state: State) -> Answer:
    """Drop what comes from further off than an option says."""
    return Answer(drop=frame.distance_m > frame.options["range_m"])


def delays(frame: RadioFrame, state: State) -> Answer:
    """Delay everything by 150 ms."""
    return Answer(delay_s=0.15)


def doubles(frame: RadioFrame, state: State) -> Answer:
    """Let everything arrive three times, 7 ms apart."""
    return Answer(copies=2, copy_delay_s=0.007)


def every_third(frame: RadioFrame, state: State) -> Answer:
    """Drop every third frame of all, as the state counts them."""
    state["frames"] = state.get("frames", 0) + 1
    return Answer(drop=state["frames"] % 3 == 0)


def everything(frame: RadioFrame, state: State) -> Answer:
    """Drop, delay, corrupt and duplicate by chance, and give one receiver other bytes."""
    state["frames"] = state.get("frames", 0) + 1
    count = len(frame.receivers)
    payload = {frame.receivers[0]: bytes(reversed(frame.payload))} if state["frames"] % 4 == 0 else {}
    return Answer(
        drop=frame.rng.random(count) < 0.2,
        delay_s=frame.rng.uniform(0, 0.2, count),
        corrupt=frame.rng.integers(0, 2, count),
        payload=payload,
        copies=frame.rng.integers(0, 3, count),
        copy_delay_s=0.02,
    )


def babbles(frame: RadioFrame, state: State) -> list[bytes]:
    """Send, in place of each frame, other bytes, the frame itself, and what the last frame was."""
    before, state["before"] = state.get("before", b"none"), frame.payload
    return [b"lie " + frame.payload, frame.payload, before]


def raises(frame: RadioFrame, state: State) -> Answer:
    """Fail from a second on."""
    if frame.time_s >= 1:
        raise ValueError(f"no idea of {frame.sender}")
    return Answer(drop=True)


def exits(frame: RadioFrame, state: State) -> Answer:
    """Try to end the emulator."""
    raise SystemExit("enough")


def loops(frame: RadioFrame, state: State) -> Answer:
    """Never answer, and catch what can be caught."""
    while True:
        with contextlib.suppress(Exception):
            time.monotonic()


def loops_for_now(frame: RadioFrame, state: State) -> Answer:
    """Compute until a test says that it is enough."""
    while not ENOUGH.is_set():
        pass
    return Answer()


ENOUGH = threading.Event()


def sleeps(frame: RadioFrame, state: State) -> Answer:
    """Wait for what never comes, and compute nothing."""
    while True:
        time.sleep(1000.0)


def locks_up(frame: RadioFrame, state: State) -> Answer:
    """Wait for itself."""
    lock = threading.Lock()
    with lock, lock:
        return Answer()


def alarms(frame: RadioFrame, state: State) -> None:
    """Send the process the signal that interrupts rules which wait."""
    signal.raise_signal(own_functions.WAKE_UP)


def silences(frame: RadioFrame, state: State) -> list[bytes] | None:
    """Drop every second frame of a sender, and send each third one three times."""
    if frame.sequence % 2:
        return []
    return [frame.payload] * 3 if frame.sequence % 3 == 0 else None


def nonsense(frame: RadioFrame, state: State) -> Any:
    """Answer what the option says."""
    return eval(frame.options["answer"], {"Answer": Answer, "np": np})


def looks(frame: RadioFrame, state: State) -> None:
    """Keep what a rule sees in a list that the option names."""
    SEEN.append(frame)
    assert not state or state["frames"] == len(SEEN) - 1
    state["frames"] = len(SEEN)


SEEN: list[RadioFrame] = []


async def waits(frame: RadioFrame, state: State) -> None:
    """Be no rule: it is not called, but waited for."""


NUMBER = 3
