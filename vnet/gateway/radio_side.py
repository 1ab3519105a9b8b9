"""The programs of one vehicle as seen from the radio: what crosses it, queries on their way, tokens of others."""

from __future__ import annotations

import asyncio
from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import lru_cache
from itertools import count
from typing import Any, Generic, TypeVar

import msgspec
import zenoh

from vnet.gateway.frames import (
    MOST_MESSAGES,
    CrossingQuery,
    CrossingReply,
    CrossingSample,
    CrossingTokens,
    Reassembly,
    crossing_query,
    decode_fragment,
)
from vnet.gateway.keys import FIX_KEY, OWN_KEYS, RADIO_KEYS, fix_content
from vnet.gateway.ros2 import MOST_KEYS, ROS2_KEYS, Ros2
from vnet.node import Fix
from vnet.units import NS_PER_S

ALL_CACHES = "/@adv/**"
"""End of the key with which an advanced subscriber asks all caches for history (zenoh-ext 1.10)."""
TOKEN_PERIODS = 3
"""Times `liveliness_s` without word of a vehicle's tokens after which they are gone."""

Q = TypeVar("Q")


class RadioSide(ABC, Generic[Q]):
    """Common part of a gateway and of emulated sessions; `Q` are their queries.

    `keys` cross the radio; None stands for those that do if a scenario says nothing.
    """

    def __init__(
        self,
        node_id: str,
        incarnation: int,
        keys: Sequence[str] | None,
        query_s: float,
        liveliness_s: float,
        ros2: Ros2 | None,
    ) -> None:
        self.node_id, self._query_s, self._ros2 = node_id, query_s, ros2
        self._keys = keys if keys is not None else RADIO_KEYS if ros2 is None else ROS2_KEYS
        self._expressions = [zenoh.KeyExpr(key) for key in self._keys]
        self._reassembly = Reassembly()
        self._queries: dict[int, Q] = {}
        """Queries of this vehicle to which replies are awaited."""
        self._histories: list[tuple[zenoh.KeyExpr, list[int]]] = []
        """Keys for which all caches are asked now, and the numbers of the queries that end together with that."""
        # Replies to queries of the last incarnation may still come, and answer none of this one.
        self._query_numbers = count(incarnation * MOST_MESSAGES)
        self._tokens_ns = round(TOKEN_PERIODS * liveliness_s * NS_PER_S)
        self._overtaken_ns = round(liveliness_s * NS_PER_S / 2)
        """Time after which no earlier word of tokens is awaited: a number may be one that a fault has changed."""
        self._told: dict[str, tuple[int, tuple[str, ...], int]] = {}
        """Instant of the last message with tokens, their keys, and its number, by vehicle."""
        self.crosses = lru_cache(MOST_KEYS)(self._crosses)
        """Return whether what has this key is sent by the radio."""

    def _crosses(self, key: str) -> bool:
        if key.startswith(OWN_KEYS) or (self._ros2 is not None and not self._ros2.crosses(key)):
            return False
        return any(each.intersects(key) for each in self._expressions)

    def crosses_in(self, reply: Any) -> bool:
        """Return whether a reply to a query of another vehicle crosses; one to `**` may have any key."""
        return reply.ok is None or self.crosses(str(reply.ok.key_expr))

    def show_fix(self, fix: Fix) -> None:
        """Put a fix of the vehicle's receiver at its programs."""
        self._publish(FIX_KEY, fix_content(fix))
        if self._ros2 is not None:
            self._publish(*self._ros2.fix(fix))

    def show_clock(self, time_ns: int) -> None:
        """Tell the programs emulated time, as ROS 2 does."""
        if self._ros2 is not None:
            self._publish(*self._ros2.clock(time_ns))

    def keep(self, query: Q) -> CrossingQuery:
        """Keep a query for as long as replies are awaited; return what crosses the radio.

        An advanced subscriber holds samples back while it asks all caches for history. One that asks a single
        cache meanwhile, and waits for longer, would drop them (zenoh-ext 1.10): such queries end with the first.
        """
        number = next(self._query_numbers)
        self._queries[number] = query
        crossing, numbers = crossing_query(number, query), [number]
        key = crossing.selector.partition("?")[0]
        if key.endswith(ALL_CACHES):
            self._histories.append((zenoh.KeyExpr(key), numbers))
        elif others := next((others for keys, others in self._histories if keys.includes(key)), None):
            others.append(number)
            return crossing
        asyncio.get_running_loop().call_later(self._query_s, self._end, numbers)
        return crossing

    def _end(self, numbers: list[int]) -> None:
        self._histories = [each for each in self._histories if each[1] is not numbers]
        for number in reversed(numbers):  # that for which the others have been waiting is the first
            self._conclude(self._queries.pop(number))

    def hear(self, sender: str, payload: bytes, time_ns: int) -> None:
        """Give the programs what a frame carries. Raises ValueError for bytes that a fault has changed."""
        try:
            match self._reassembly.take(sender, payload):
                case CrossingTokens() as tokens:
                    self.hear_tokens(sender, tokens, time_ns, decode_fragment(payload).number)
                case CrossingSample() as sample:
                    self._show(sample)
                case CrossingQuery() as query:
                    self._answer(sender, query)
                case CrossingReply() as answer if answer.to == self.node_id:
                    if (asked := self._queries.get(answer.number)) is not None:
                        self._reply(asked, answer)
        except (msgspec.MsgspecError, zenoh.ZError, LookupError, OverflowError) as error:
            raise ValueError(str(error)) from None

    def hear_tokens(self, sender: str, tokens: CrossingTokens, time_ns: int, number: int = 0) -> None:
        """Take word of another vehicle's tokens, unless a later one has overtaken the message of this number.

        Raises ZError for what is no key.
        """
        for key in tokens.keys:
            zenoh.KeyExpr(key)
        last_ns, _, last = self._told.get(sender, (-self._tokens_ns, (), 0))
        if number >= last or time_ns - last_ns >= self._overtaken_ns:
            self._retell({**self._told, sender: (time_ns, tokens.keys, number)})

    def forget_tokens(self, time_ns: int) -> None:
        """Forget the tokens of vehicles that have not told of any lately."""
        self._retell({one: told for one, told in self._told.items() if time_ns - told[0] < self._tokens_ns})

    def wait_anew(self, time_ns: int) -> None:
        """Count the time without word of tokens from now on, as after a pause, in which nothing arrives."""
        self._told = {one: (time_ns, keys, number) for one, (_, keys, number) in self._told.items()}

    @property
    def heard_tokens(self) -> dict[str, None]:
        """The tokens of other vehicles, in the order in which their vehicles were first heard."""
        return dict.fromkeys(key for _, keys, _ in self._told.values() for key in keys)

    def _retell(self, told: dict[str, tuple[int, tuple[str, ...], int]]) -> None:
        before, self._told = self.heard_tokens, told
        after = self.heard_tokens
        for key in [*before, *after]:
            if (key in before) != (key in after):
                self._show_token(key, is_there=key in after)

    @abstractmethod
    def _publish(self, key: str, payload: bytes, attachment: bytes | None = None) -> None:
        """Put a sample of vnet's own at the programs."""

    @abstractmethod
    def _conclude(self, query: Q) -> object:
        """End a query: no more replies are awaited."""

    @abstractmethod
    def _show(self, sample: CrossingSample) -> None:
        """Give the programs a sample."""

    @abstractmethod
    def _answer(self, asker: str, query: CrossingQuery) -> None:
        """Ask the programs on behalf of another vehicle; their replies are messages to it."""

    @abstractmethod
    def _reply(self, query: Q, answer: CrossingReply) -> None:
        """Give a reply to the program that has asked."""

    @abstractmethod
    def _show_token(self, key: str, is_there: bool) -> None:
        """Tell the programs that a token of another vehicle has come, or is gone."""
