"""Findings of the conformance checks: one line a check, with the bytes of a wrong message."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import msgpack

from vnet.counted import counted
from vnet.errors import WireError, printable
from vnet.transport import wire

LONGEST_HEX = 48
"""Bytes of a wrong message that are shown."""
LONGEST_DECODED = 200
"""Characters of a wrong message that are shown."""

CHECKS = {
    "starts": "the agent starts and connects with its credentials",
    "hello": "Hello names the node and its process, with ready = false and a nonce of at least 8 bytes",
    "version": f"Hello bears the version of the messages, {wire.VERSION}",
    "hello_repeats": "Hello is repeated, with the same nonce, until the welcome",
    "others_nonce": "Welcome and End with another nonce are ignored",
    "token": "the token vnet/RUN/node/ID/alive is there",
    "ready": "Hello with ready = true follows the welcome",
    "silence": "nothing but Hello is said before the first grant or batch",
    "decodes": "every message decodes",
    "nonce": "every message bears the nonce of its Hello",
    "new_nonce": "a process that is started again has another nonce",
    "yields": "each grant is answered with one Yield that repeats its seq",
    "unasked": "no Yield without a grant",
    "timers": "next_timer_ns is not before the end of the granted window",
    "steps": "each step lies in the granted window, later than the one before",
    "wakes": "each Yield waits for a timer, the radio or a fix, or its program has ended",
    "own_node": "frames, reports, endings and waiting nodes are the agent's own",
    "payload": "no frame exceeds max_payload",
    "sends": "each frame to a single vehicle has a number of its own",
    "numbers": "reports hold finite numbers",
    "report_time": "reports bear the time that the vehicle's clock shows",
    "frames_seq": "Frames are numbered 0, 1, 2, …",
    "acknowledges": "each batch is acknowledged within 2 s",
    "missed": "batches that never came are named in missed, and no others",
    "lateness": "lateness counts each packet once, in the bin of its lateness, and none that was held",
    "final": "End is answered with Frames, final = true",
    "no_traffic": "no traffic of a program that has ended (runs = false)",
    "stack": "StackRequest is answered with StackDump",
    "malformed": "a malformed message is dropped, and the agent goes on",
    "refused": "a refusal ends the agent with an error",
    "ends": "End ends the agent with exit status 0",
    "orphan": "the agent ends with an error once the emulator has been gone for orphan_timeout_s",
    "waits": "the agent waits for an emulator that has announced its return, and goes on",
    "stays": "the agent stays until it is told to end",
}
"""Each check, and what it expects."""

_KINDS = {kind.__name__: kind for kind in (wire.Hello, wire.Yield, wire.Frames, wire.StackDump)}


@dataclass
class Findings:
    """The results of all checks: in which scenes each was made, and what came where it failed."""

    made: dict[str, list[str]] = field(default_factory=dict)
    failed: dict[str, list[tuple[str, str]]] = field(default_factory=dict)
    scene: str = ""

    def begin(self, scene: str) -> None:
        """The checks from now on are those of a scene."""
        self.scene = scene

    def expect(self, *names: str) -> None:
        """Note that these checks are made in this scene."""
        for name in names:
            assert name in CHECKS, name
            scenes = self.made.setdefault(name, [])
            if self.scene not in scenes:
                scenes.append(self.scene)

    def fail(self, name: str, came: str, data: bytes | None = None) -> None:
        """Note that a check has failed, and what came instead; the first failure of a check in a scene is kept."""
        self.expect(name)
        failures = self.failed.setdefault(name, [])
        if all(scene != self.scene for scene, _ in failures):
            failures.append((self.scene, came if data is None else f"{came}; {described(data)}"))

    def lines(self, unreached: bool = True) -> Iterator[str]:
        """A line for each check: what is expected, in which scenes it was seen, or what came instead.

        Checks that were not made have a line if `unreached`: after all scenes, but not after some of them.
        """
        for name, expected in CHECKS.items():
            scenes = self.made.get(name, [])
            if failures := self.failed.get(name, []):
                scene, came = failures[0]
                others = "".join(f", also in {other}" for other, _ in failures[1:])
                yield f"wrong  {name:13}  expected: {expected}; came in {scene}{others}: {came}"
            elif scenes:
                yield f"ok     {name:13}  {expected} ({counted(len(scenes), 'scene')})"
            elif unreached:
                yield f"-      {name:13}  {expected} (not reached)"


def described(data: bytes) -> str:
    """A message as text: decoded where that is possible, and its first bytes."""
    shown = data[:LONGEST_HEX].hex(" ") + (" …" if len(data) > LONGEST_HEX else "")
    try:
        decoded = printable(repr(msgpack.unpackb(data)), LONGEST_DECODED)
    except (ValueError, RecursionError) as error:
        decoded = f"no msgpack ({printable(str(error))})"
    return f"{decoded}; {len(data)} bytes: {shown}"


def decoding_problem(data: bytes) -> tuple[wire.AgentMessage | None, str]:
    """An agent's message, or why it is none, with the name of the field that is wrong."""
    try:
        return wire.decode_tx(data), ""
    except WireError as error:
        return None, f"{error}{_field(data, str(error))}"


def _field(data: bytes, error: str) -> str:
    """The name of the field to which a decoder's `$[3]` points."""
    try:
        message: Any = msgpack.unpackb(data)
        kind = _KINDS[message[0]]
        index = int(error.rpartition("`$[")[2].partition("]")[0])
        return f" ({kind.__name__}.{kind.__struct_fields__[index - 1]})"
    except (ValueError, LookupError, TypeError, RecursionError):
        return ""
