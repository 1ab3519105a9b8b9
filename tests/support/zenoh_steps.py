"""Programs of put, delete, get and tokens, made of steps, that run on any module `zenoh`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

Step = Sequence[Any]


Settle = Callable[[], object]
"""Lets what was done take effect everywhere."""


def interpret(zenoh: Any, sessions: Sequence[Any], steps: Sequence[Step], settle: Settle) -> list[Any]:
    """Run steps, and return what was heard and replied, in order."""
    return _Interpreter(zenoh, sessions, settle).run(steps)


class _Interpreter:
    def __init__(self, zenoh: Any, sessions: Sequence[Any], settle: Callable[[], object]) -> None:
        self._zenoh = zenoh
        self._sessions = sessions
        self._settle = settle
        self._declared: dict[str, Any] = {}
        self._channels: dict[str, Any] = {}
        self._heard: list[Any] = []

    def run(self, steps: Sequence[Step]) -> list[Any]:
        for number, (kind, session, *rest) in enumerate(steps):
            self._heard.append(("step", number))
            getattr(self, f"_{kind}")(self._sessions[session], *rest)
            self._settle()
            for name, channel in sorted(self._channels.items()):
                heard = []
                while (sample := channel.try_recv()) is not None:
                    if str(sample.key_expr) != "vnet/fix":
                        heard.append((name, *self._told(sample)))
                # Zenoh tells a session's own tokens twice, and promises no order of different ones.
                self._heard += sorted(set(heard)) if name.startswith("watch") else heard
        for declared in self._declared.values():
            declared.undeclare()
        return self._heard

    def _locality(self, name: str) -> Any:
        return getattr(self._zenoh.Locality, name)

    def _told(self, sample: Any) -> tuple[Any, ...]:
        attachment = None if sample.attachment is None else bytes(sample.attachment)
        return (
            str(sample.key_expr),
            bytes(sample.payload),
            str(sample.kind),
            str(sample.encoding),
            attachment,
            str(sample.priority),
            str(sample.congestion_control),
            sample.express,
            sample.timestamp is not None,
        )

    def _subscribe(self, session: Any, name: str, key: str, origin: str) -> None:
        self._undeclare(session, name)
        declared = session.declare_subscriber(key, allowed_origin=self._locality(origin))
        self._declared[name] = self._channels[name] = declared

    def _watch(self, session: Any, name: str, key: str, history: bool) -> None:
        self._undeclare(session, name)
        declared = session.liveliness().declare_subscriber(key, history=history)
        self._declared[name] = self._channels[name] = declared

    def _token(self, session: Any, name: str, key: str) -> None:
        self._undeclare(session, name)
        self._declared[name] = session.liveliness().declare_token(key)

    def _queryable(
        self, session: Any, name: str, key: str, complete: bool, origin: str, answers: list[str]
    ) -> None:
        self._undeclare(session, name)

        def answer(query: Any) -> None:
            with query:
                replied = False
                for number, each in enumerate(answers):
                    if query.key_expr.intersects(each):
                        replied = True
                        if number == 2:
                            query.reply_del(each, attachment=b"gone")
                        else:
                            query.reply(each, f"{name} {number} {query.parameters}", encoding="text/plain")
                if not replied:
                    query.reply_err(query.payload or b"none", encoding="text/plain")

        self._declared[name] = session.declare_queryable(
            key, answer, complete=complete, allowed_origin=self._locality(origin)
        )

    def _undeclare(self, session: Any, name: str) -> None:
        self._channels.pop(name, None)
        if (declared := self._declared.pop(name, None)) is not None:
            declared.undeclare()

    def _put(self, session: Any, key: str, payload: str, destination: str, urgent: bool) -> None:
        options = {"encoding": "text/plain", "attachment": b"note", "priority": self._zenoh.Priority.REAL_TIME}
        session.put(key, payload, allowed_destination=self._locality(destination), **(options if urgent else {}))

    def _delete(self, session: Any, key: str, destination: str) -> None:
        session.delete(key, allowed_destination=self._locality(destination))

    def _publish(self, session: Any, key: str, payload: str) -> None:
        # At a key of its own: what a session puts at the key of a publisher that it has undeclared is lost by
        # Zenoh 1.10.2 at subscribers that come later.
        with session.declare_publisher(f"published/{key}", encoding="text/json") as publisher:
            self._settle()
            publisher.put(payload)
            publisher.delete(attachment=b"over")

    def _get(
        self, session: Any, selector: str, target: str, mode: str, destination: str, payload: str | None
    ) -> None:
        replies = session.get(
            selector,
            target=getattr(self._zenoh.QueryTarget, target),
            consolidation=getattr(self._zenoh.ConsolidationMode, mode),
            allowed_destination=self._locality(destination),
            payload=payload,
        )
        told: list[tuple[Any, ...]] = []
        for reply in replies:
            if reply.ok is None:
                told.append(("error", str(reply.err.encoding), bytes(reply.err.payload)))
            elif mode == "NONE":
                told.append(self._told(reply.ok))
            else:  # which of several wins is Zenoh's choice
                told.append((str(reply.ok.key_expr),))
        self._heard.append(("replies", *sorted(told, key=repr)))

    def _tokens(self, session: Any, key: str) -> None:
        replies = session.liveliness().get(key, timeout=60.0)
        self._heard.append(("tokens", *sorted({self._told(reply.ok)[:3] for reply in replies})))
