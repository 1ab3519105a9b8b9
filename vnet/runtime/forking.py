"""Messages between the emulator and the zygote, the process from which a run's agents are forked.

They are packets of a Unix socket: the zygote says that it is ready, and then answers each request with one reply.
With a request travel two descriptors an agent: one to read its credentials from, and one to write its log to.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import msgspec

MOST_AGENTS = 50
"""Most agents of one request: Linux passes at most 253 descriptors at once."""
MOST_ARGUMENTS_BYTES = 150_000
"""Most bytes of arguments of one request: a thousand vehicles with the longest ids take 73 kB."""
LONGEST_MESSAGE_BYTES = 200_000
"""Longest message: Linux's default for a packet is 212 992 bytes."""


class ForkRequest(msgspec.Struct, frozen=True):
    """Agents to be forked: the arguments of `vnet-agent` for each, but for its credentials."""

    agents: list[list[str]]


class ForkReply(msgspec.Struct, frozen=True):
    """Process ids of the agents that were forked, in order, and why the others were not."""

    pids: list[int]
    failure: str = ""


READY = ForkReply([])
"""First message of the zygote: it has imported its modules."""


def encode(message: ForkRequest | ForkReply) -> bytes:
    """Encode a message as msgpack."""
    return msgspec.msgpack.encode(message)


def decode_request(data: bytes) -> ForkRequest:
    """Decode a request. Raises msgspec.DecodeError."""
    return msgspec.msgpack.decode(data, type=ForkRequest)


def decode_reply(data: bytes) -> ForkReply:
    """Decode a reply. Raises msgspec.DecodeError."""
    return msgspec.msgpack.decode(data, type=ForkReply)


def split(agents: Mapping[str, list[str]]) -> Iterator[list[str]]:
    """Yield the names of the agents (arguments by name), as many at a time as one request holds."""
    names: list[str] = []
    size_bytes = 0
    for name, arguments in agents.items():
        more_bytes = sum(len(argument.encode()) + 5 for argument in arguments)
        if names and (len(names) == MOST_AGENTS or size_bytes + more_bytes > MOST_ARGUMENTS_BYTES):
            yield names
            names, size_bytes = [], 0
        names.append(name)
        size_bytes += more_bytes
    if names:
        yield names
