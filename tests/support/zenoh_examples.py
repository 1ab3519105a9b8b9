"""Programs in the manner of Zenoh's own Python examples, which return what they were told.

Each is given the module `zenoh`, a function that opens a session, and one that waits until what was done has taken
effect at all of them.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from typing import Any

Open = Callable[[], Any]
Settle = Callable[[], object]


def z_sub_queued(zenoh: Any, open_session: Open, settle: Settle) -> list[Any]:
    """z_pub and z_sub_queued: a publisher, and a subscriber that is iterated over in a thread."""
    heard: list[Any] = []
    session = open_session()
    subscriber = session.declare_subscriber("demo/example/**")

    def listen() -> None:
        for sample in subscriber:
            heard.append((str(sample.kind), str(sample.key_expr), sample.payload.to_string(), str(sample.encoding)))

    thread = threading.Thread(target=listen)
    thread.start()
    settle()
    publisher = open_session().declare_publisher("demo/example/zenoh-python-pub", encoding="text/plain")
    settle()
    for index in range(5):
        publisher.put(f"[{index:4d}] Pub from Python!", attachment=str(index))
    publisher.delete()
    settle()
    subscriber.undeclare()
    thread.join()
    return heard


def z_pull(zenoh: Any, open_session: Open, settle: Settle) -> list[Any]:
    """z_pull: a ring channel has the newest samples."""
    subscriber = open_session().declare_subscriber("demo/*", zenoh.handlers.RingChannel(3))
    settle()
    session = open_session()
    for index in range(10):
        session.put("demo/pull", str(index), congestion_control=zenoh.CongestionControl.BLOCK)
    settle()
    heard = []
    while (sample := subscriber.try_recv()) is not None:
        heard.append(sample.payload.to_string())
    return heard


def z_storage(zenoh: Any, open_session: Open, settle: Settle) -> list[Any]:
    """z_storage, z_put, z_delete and z_get: a subscriber stores, and a queryable answers."""
    store: dict[str, Any] = {}
    taken: queue.Queue[None] = queue.Queue()

    def listen(sample: Any) -> None:
        if sample.kind == zenoh.SampleKind.DELETE:
            store.pop(str(sample.key_expr), None)
        else:
            store[str(sample.key_expr)] = sample
        taken.put(None)

    def answer(query: Any) -> None:
        for stored, sample in store.items():
            if query.key_expr.intersects(stored):
                query.reply(sample.key_expr, sample.payload, encoding=sample.encoding)

    storage = open_session()
    storage.declare_subscriber("demo/**", listen)
    storage.declare_queryable("demo/**", answer, complete=True)
    settle()
    session = open_session()
    for key in ("demo/a", "demo/b", "demo/c/d"):
        session.put(key, f"at {key}", encoding="text/plain")
    session.delete("demo/b")
    for _ in range(4):  # Zenoh calls each subscriber on a thread of its own: `settle` does not wait for it
        taken.get()
    told = []
    for selector in ("demo/*", "demo/**", "demo/b", "other/**"):
        samples = [reply.ok for reply in session.get(selector)]
        told.append((selector, sorted((str(each.key_expr), each.payload.to_string()) for each in samples)))
    return told


def z_querier(zenoh: Any, open_session: Open, settle: Settle) -> list[Any]:
    """z_querier and z_queryable: a querier asks again and again, and errors are replies."""

    def answer(query: Any) -> None:
        if query.payload is None:
            query.reply_err("a payload is expected")
        else:
            query.reply("demo/q", f"{query.parameters} {query.payload.to_string()}", attachment=query.attachment)

    queryable = open_session().declare_queryable("demo/q", answer)
    settle()
    querier = open_session().declare_querier("demo/**", target=zenoh.QueryTarget.ALL)
    settle()
    told: list[Any] = []
    for index in range(3):
        options = {} if index == 1 else {"payload": str(index), "attachment": "note"}
        for reply in querier.get(parameters=f"n={index}", **options):
            if reply.ok is None:
                told.append(reply.err.payload.to_string())
            else:
                told.append((reply.ok.payload.to_string(), reply.ok.attachment.to_string()))
    queryable.undeclare()
    settle()
    return [*told, [*querier.get()]]


def z_liveliness(zenoh: Any, open_session: Open, settle: Settle) -> list[Any]:
    """z_liveliness, z_get_liveliness and z_sub_liveliness: tokens that come and go, the last with its session."""
    told: queue.Queue[Any] = queue.Queue()
    watching = open_session()
    first, second = open_session(), open_session()
    token = first.liveliness().declare_token("group/first")
    settle()
    there: set[str] = set()

    def take(sample: Any) -> None:
        """Tell of changes: on a busy machine Zenoh tells of a token by history, and again."""
        is_there, key = sample.kind == zenoh.SampleKind.PUT, str(sample.key_expr)
        if is_there != (key in there):
            (there.add if is_there else there.discard)(key)
            told.put((str(sample.kind), key))

    watching.liveliness().declare_subscriber("group/**", take, history=True)
    heard = [told.get()]
    settle()
    kept = second.liveliness().declare_token("group/second")
    heard.append(told.get())
    settle()
    replies = watching.liveliness().get("group/**", timeout=60.0)
    heard.append(sorted(str(reply.ok.key_expr) for reply in replies))
    token.undeclare()
    heard.append(told.get())
    second.close()
    heard.append(told.get())
    del kept
    return heard


def z_advanced(zenoh: Any, open_session: Open, settle: Settle) -> list[Any]:
    """z_advanced_pub and z_advanced_sub: a late subscriber has the history, in which a delete is an empty put."""
    ext = zenoh.ext
    heard: queue.Queue[Any] = queue.Queue()
    session = open_session()
    publisher = ext.declare_advanced_publisher(
        session,
        "demo/advanced",
        cache=ext.CacheConfig(max_samples=3),
        sample_miss_detection=ext.MissDetectionConfig(heartbeat=5),
        publisher_detection=True,
    )
    for index in range(4):
        publisher.put(str(index))
    publisher.delete()
    settle()
    subscriber = ext.declare_advanced_subscriber(
        open_session(),
        "demo/**",
        lambda sample: heard.put((str(sample.kind), sample.payload.to_string(), sample.source_info.source_sn)),
        history=ext.HistoryConfig(detect_late_publishers=True, max_samples=2),
        recovery=ext.RecoveryConfig(heartbeat=True),
        subscriber_detection=True,
    )
    told = [heard.get(), heard.get()]
    found: queue.Queue[int] = queue.Queue()
    subscriber.detect_publishers(lambda sample: found.put(str(sample.key_expr).count("@adv/pub")), history=True)
    told.append(found.get())
    for index in range(5, 8):
        publisher.put(str(index))
        told.append(heard.get())
    publisher.delete()
    unasked = [reply.ok for reply in session.get("demo/advanced/@adv/**")]  # of keys that the query does not match
    return [*told, heard.get(), unasked]


def z_matching(zenoh: Any, open_session: Open, settle: Settle) -> list[Any]:
    """z_pub with --add-matching-listener: a publisher is told when its first subscriber comes and its last goes."""
    told: queue.Queue[bool] = queue.Queue()
    publisher = open_session().declare_publisher("demo/matching")
    publisher.declare_matching_listener(lambda status: told.put(status.matching))
    settle()
    session = open_session()
    one, two = session.declare_subscriber("demo/*"), session.declare_subscriber("**")
    heard = [told.get()]
    one.undeclare()
    two.undeclare()
    return [*heard, told.get()]


_ALL = z_sub_queued, z_pull, z_storage, z_querier, z_liveliness, z_advanced, z_matching
EXAMPLES = {each.__name__: each for each in _ALL}
