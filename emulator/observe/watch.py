"""The observer process: subscribes to a run over Zenoh and records it. It can never slow a vehicle."""

from __future__ import annotations

import contextlib
import queue
import signal
from pathlib import Path
from typing import Any

import zenoh

from emulator.observe.recorder import Recorder
from vnet.errors import WireError
from vnet.link import keys, wire
from vnet.link.access import Credentials
from vnet.link.session import open_client

LEASE_MS = 60_000


def record_run(endpoint: str, run: str, credentials: Credentials | None, path: Path) -> None:
    """Record `run` into `path` until its end, or until SIGTERM or SIGINT; the file is closed cleanly.

    Raises LinkError if there is no router at `endpoint` or it refuses.
    """
    inbox: queue.SimpleQueue[tuple[str, bytes]] = queue.SimpleQueue()

    def on_sample(sample: zenoh.Sample) -> None:
        inbox.put((str(sample.key_expr).rsplit("/", 1)[1], sample.payload.to_bytes()))

    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with open_client(endpoint, credentials, LEASE_MS) as session, Recorder(path) as recorder:
        session.declare_subscriber(keys.observe(run, "*"), on_sample)
        with contextlib.suppress(KeyboardInterrupt):
            while _record_one(recorder, *inbox.get()):
                pass


def _record_one(recorder: Recorder, stream: str, data: bytes) -> bool:
    """Record one message; False at the end of the run. What does not decode is left out."""
    if stream == "end":
        return False
    try:
        message: dict[str, Any] = wire.decode_observation(data)
    except WireError:
        return True
    if stream == "scene":
        recorder.scene(message)
    elif stream == "period":
        recorder.period(message)
    return True
