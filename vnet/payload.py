"""Payloads that programs send: bytes, and nothing else."""

from __future__ import annotations

from vnet.errors import shown


def checked_payload(call: str, payload: bytes) -> bytes:
    """Return a payload of a `call` as bytes. Raise TypeError for what is not bytes."""
    try:
        return bytes(memoryview(payload))
    except TypeError:
        raise TypeError(
            f"{call}({shown(payload)}): bytes are expected, not {type(payload).__name__}; encode it first, "
            "as with msgpack.packb(…) or text.encode()"
        ) from None
