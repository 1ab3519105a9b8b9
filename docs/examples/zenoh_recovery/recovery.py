"""Samples and calls of one vehicle over a radio that loses them: what others have of them in the end.

A Zenoh program, written without vnet: `python recovery.py NAME`. Each vehicle publishes a number ten times a
second, by a plain publisher, and by an advanced one whose subscribers recover what they miss from its cache. Once a
second it calls a service of another vehicle. At the end it reports what it has of the numbers and calls.
"""

from __future__ import annotations

import statistics
import sys
import threading
import time

import msgspec
import zenoh
from zenoh import ext

PERIOD_S = 0.1
PUBLISHED = 100
"""Numbers that each vehicle publishes, from the first second on."""
CACHE = 100
"""Numbers that an advanced publisher keeps: all."""
LATE_S = 0.09
"""Longest delay of a number that the radio has not lost: it takes a few milliseconds."""
ATTEMPTS = 3
END_S = 19.0


class Heard:
    """Numbers that were heard under one key, by their publisher, and when each was published and heard."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._delay_s: dict[tuple[str, bytes], float] = {}

    def take(self, sample: zenoh.Sample) -> None:
        """Take a sample; it may come twice, by the radio and from a cache."""
        content = sample.payload.to_bytes()
        _, published_s = msgspec.msgpack.decode(content)
        with self._lock:
            self._delay_s.setdefault((str(sample.key_expr), content), time.time() - published_s)

    @property
    def count(self) -> int:
        """Number of different numbers."""
        return len(self._delay_s)

    @property
    def recovered_s(self) -> list[float]:
        """Delays of those that the radio has lost at first, sorted."""
        return sorted(delay_s for delay_s in self._delay_s.values() if delay_s > LATE_S)


def call(session: zenoh.Session, name: str, attempts: int) -> bool:
    """Call the service until it answers; return whether it did."""
    for _ in range(attempts):
        if any(reply.ok is not None for reply in session.get(f"service/{name}", timeout=0.3)):
            return True
    return False


def main(name: str) -> None:
    """Publish, listen and call, then report."""
    session = zenoh.open(zenoh.Config.from_env())
    begin_s = time.time()
    plain, kept, published = Heard(), Heard(), 0
    remote = zenoh.Locality.REMOTE
    session.declare_subscriber("plain/*", plain.take, allowed_origin=remote)
    recovery = ext.RecoveryConfig(heartbeat=True, periodic_queries=None)
    ext.declare_advanced_subscriber(session, "kept/*", kept.take, recovery=recovery, allowed_origin=remote)
    first = session.declare_publisher(f"plain/{name}", allowed_destination=remote)
    second = ext.declare_advanced_publisher(
        session,
        f"kept/{name}",
        cache=ext.CacheConfig(CACHE),
        sample_miss_detection=ext.MissDetectionConfig(heartbeat=0.5, sporadic_heartbeat=None),
        allowed_destination=remote,
    )
    session.declare_queryable(f"service/{name}", lambda query: query.reply(query.key_expr, b"done"))
    time.sleep(1.0)
    calls: list[bool] = []

    def call_often() -> None:
        callee = "v02" if name == "v01" else "v01"
        for number in range(10):
            calls.append(call(session, callee, 1 + number % 2 * (ATTEMPTS - 1)))
            time.sleep(max(0.0, begin_s + number + 2 - time.time()))

    caller = threading.Thread(target=call_often)
    caller.start()
    while published < PUBLISHED:
        content = msgspec.msgpack.encode((published, time.time()))
        first.put(content)
        second.put(content)
        published += 1
        time.sleep(max(0.0, begin_s + 1 + published * PERIOD_S - time.time()))
    caller.join()
    time.sleep(max(0.0, begin_s + END_S - time.time()))
    delays_s = kept.recovered_s or [0.0]
    told = {
        "published": published,
        "heard_plain": plain.count,
        "heard_kept": kept.count,
        "recovery_p50_s": statistics.median(delays_s),
        "recovery_p95_s": delays_s[int(0.95 * len(delays_s))],
        "answered_once": sum(calls[0::2]) / len(calls[0::2]),
        "answered_thrice": sum(calls[1::2]) / len(calls[1::2]),
    }
    session.put("vnet/report", msgspec.msgpack.encode(told))
    time.sleep(3600)


if __name__ == "__main__":
    main(sys.argv[1])
