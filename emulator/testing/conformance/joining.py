"""Scenes of joining, and of losing the emulator, which are the same in both pacings."""

from __future__ import annotations

import time

from emulator.testing.conformance.scene import (
    ORPHAN_TIMEOUT_S,
    OTHERS_NONCE,
    QUIET_S,
    Scene,
    SceneOverError,
)
from vnet.transport import wire

HELLO_WAIT_S = 2.0
AWAY_S = 1.5 * ORPHAN_TIMEOUT_S
RETURN_WITHIN_S = 15.0
WARNING_S = 0.2
ASK_EVERY_S = 0.2


def joining(scene: Scene) -> None:
    """The welcome keeps the agent waiting, and what is meant for others comes first."""
    hello = scene.start()
    scene.findings.expect("hello_repeats", "others_nonce")
    again, said = scene.await_message(wire.Hello, "hello_repeats", HELLO_WAIT_S)
    if again.nonce != hello.nonce:
        scene.findings.fail("hello_repeats", "another nonce", said.data)
    scene.bench.say(scene.make_welcome(OTHERS_NONCE))
    scene.bench.say(wire.End(OTHERS_NONCE, "another session is refused", refused=True))
    deadline_s = time.monotonic() + QUIET_S
    while (wait_s := deadline_s - time.monotonic()) > 0 and (heard := scene.hear(wait_s)) is not None:
        if isinstance(heard.message, wire.Hello) and heard.message.ready:
            scene.findings.fail("others_nonce", "ready after another's welcome", heard.data)
            raise SceneOverError
    if (status := scene.bench.agent.exit_status) is not None:
        scene.findings.fail("others_nonce", f"exit status {status} after another's End")
        raise SceneOverError
    scene.be_welcome()
    scene.end()


def refusal(scene: Scene) -> None:
    """The hello is refused."""
    scene.start()
    scene.bench.say(wire.End(scene.nonce, "a second login of a node that is present", refused=True))
    scene.await_exit("refused", scene.patience_s, fails=True)


def orphan(scene: Scene) -> None:
    """The emulator goes away without a word, and does not come back."""
    scene.bench.close()
    took_s = scene.await_exit("orphan", ORPHAN_TIMEOUT_S + scene.patience_s, fails=True)
    if took_s < 0.8 * ORPHAN_TIMEOUT_S:
        scene.findings.fail("orphan", f"it ended after {took_s:.2f} s of {ORPHAN_TIMEOUT_S:g} s")


def absence(scene: Scene) -> None:
    """The emulator announces that it will be back, goes for longer than agents wait unasked, and comes back."""
    scene.findings.expect("waits")
    scene.bench.say(wire.Await(RETURN_WITHIN_S))
    scene.bench.hear(WARNING_S)
    scene.bench.close()
    deadline_s = time.monotonic() + AWAY_S
    while time.monotonic() < deadline_s:
        scene.bench.hear(ASK_EVERY_S)
        if (status := scene.bench.agent.exit_status) is not None:
            scene.findings.fail("waits", f"exit status {status}: {scene.bench.agent.last_words()}")
            raise SceneOverError
    scene.bench.open()
    ask_stack(scene, RETURN_WITHIN_S)


def ask_stack(scene: Scene, timeout_s: float, stays: str = "stays") -> None:
    """Ask for the stack until it comes: also how an emulator finds out whether messages pass.

    `stays` is the check that has failed if the agent ends instead.
    """
    deadline_s = time.monotonic() + timeout_s
    scene.findings.expect("stack")
    while time.monotonic() < deadline_s:
        scene.bench.say(wire.StackRequest())
        wait_s = time.monotonic() + ASK_EVERY_S
        while (left_s := wait_s - time.monotonic()) > 0 and (said := scene.hear(left_s)) is not None:
            if isinstance(said.message, wire.StackDump):
                for _ in scene.until_quiet():  # answers to earlier requests
                    pass
                return
        scene.check_stays(stays)
    scene.findings.fail("stack", f"no StackDump within {timeout_s:g} s")
    raise SceneOverError
