"""The scenes, each with a process of its own at one router, and playing them."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from emulator.drivers.session import Session
from emulator.scenario.scenario import Scenario
from emulator.testing.conformance import scene as timing
from emulator.testing.conformance.courses import Barrier, Clock, Course
from emulator.testing.conformance.findings import Findings
from emulator.testing.conformance.scene import PLACEHOLDERS, Bench, Pacing, Scene, SceneOverError
from vnet.errors import VnetError, did_you_mean
from vnet.transport import wire
from vnet.transport.access import Access, certifier, is_tls
from vnet.units import NS_PER_S

PATIENCE_S = 5.0
"""Time that an answer may take: as long as an emulator waits for a process to end."""
HELLO_WAIT_S = 2.0
AWAY_S = 1.5
"""Time for which the emulator is away: longer than agents wait unasked."""
RETURN_WITHIN_S = 15.0
WARNING_S = 0.2
QUARTER_NS = NS_PER_S // 4
RESTARTED_NS = 2_345_000_000
OTHERS_NONCE = b"of another session"
MALFORMED = (b"\xc1", b"", b"\x93\xa5Grant\xa1x", b"\x91\xa9Nonsense1", b"\x81\x01\x02")
"""No msgpack, nothing, a wrong type, an unknown kind, a map."""


def course_of(scene: Scene, start_ns: int = 0) -> Course:
    """Return the course of a scene, from `start_ns` on."""
    return Barrier(scene, start_ns) if scene.pacing == "lockstep" else Clock(scene, start_ns)


def joining(scene: Scene) -> None:
    """The welcome keeps the agent waiting, and what is meant for others comes first."""
    scene.start()
    scene.findings.expect("hello_repeats", "others_nonce")
    again, data = scene.await_message(wire.Hello, "hello_repeats", HELLO_WAIT_S)
    if again.nonce != scene.nonce:
        scene.findings.fail("hello_repeats", "another nonce", data)
    scene.bench.say(scene.make_welcome(OTHERS_NONCE))
    scene.bench.say(wire.End(OTHERS_NONCE, "another session is refused", refused=True))
    for heard in scene.hear(timing.QUIET_S):
        if isinstance(heard.message, wire.Hello) and heard.message.ready:
            raise scene.over("others_nonce", "ready after another's welcome", heard.data)
    scene.check_stays("others_nonce")
    scene.be_welcome()
    course_of(scene).end()


def refusal(scene: Scene) -> None:
    """The hello is refused."""
    scene.start()
    scene.bench.say(wire.End(scene.nonce, "a second login of a node that is present", refused=True))
    scene.await_exit("refused", scene.patience_s, fails=True)


def ordinary(scene: Scene) -> None:
    """A second of a run: fixes, packets, a clock that goes wrong, batches that are lost, and the end."""
    scene.join()
    course = course_of(scene)
    course.run(12 * scene.emulation.world.period_ns, disturbed=True)
    course.settle()
    scene.ask_stack(scene.patience_s)
    course.end()


def restart(scene: Scene) -> None:
    """The process is started again by a fault, in the middle of a run."""
    scene.join()
    course = course_of(scene)
    course.run(QUARTER_NS)
    before = scene.nonce
    course.end("restarted by a fault")
    scene.join(incarnation=1)
    scene.findings.expect("new_nonce")
    if scene.nonce == before:
        scene.findings.fail("new_nonce", "the same")
    course = course_of(scene, RESTARTED_NS)
    course.run(RESTARTED_NS + QUARTER_NS)
    course.end()


def ended(scene: Scene) -> None:
    """The program has ended before the process was started again: it takes part, and says nothing."""
    scene.join(incarnation=1, runs=False)
    scene.findings.expect("no_traffic")
    fix = scene.fix(NS_PER_S // scene.emulation.world.period_ns)
    scene.bench.say(wire.Grant(0, NS_PER_S, NS_PER_S + 1, [], [fix]))
    answer, data = scene.await_message(wire.Yield, "yields", scene.patience_s)
    has_traffic = any(step.traffic.frames or step.traffic.reports for step in answer.steps)
    if has_traffic or answer.waiting_gnss or answer.waiting_radio:
        scene.findings.fail("no_traffic", "traffic, or a node that waits", data)
    Barrier(scene).end()


def elsewhere(scene: Scene) -> None:
    """The emulator is on another machine, whose monotonic clock is not this one's."""
    scene.join(boot_id="the boot of another machine")
    course = Clock(scene, elsewhere=True)
    course.run(NS_PER_S // 2)
    course.end()


def malformed(scene: Scene) -> None:
    """Bytes that are no message come in the middle of a run: the agent is to drop them and go on."""
    scene.join()
    course = course_of(scene)
    course.run(QUARTER_NS)
    scene.findings.expect("malformed")
    for data in MALFORMED:
        scene.bench.say(data)
    for said in scene.until_quiet():
        if isinstance(said.message, wire.Yield):
            scene.findings.fail("malformed", "a Yield", said.data)
    scene.ask_stack(scene.patience_s, stays="malformed")  # its answer comes after all of them
    course.run(2 * QUARTER_NS)
    course.settle()
    course.end()


def lost(scene: Scene) -> None:
    """The emulator goes away without a word, and does not come back."""
    scene.join()
    course_of(scene).run(QUARTER_NS)
    scene.bench.close()
    timeout_s = timing.ORPHAN_TIMEOUT_S
    took_s = scene.await_exit("orphan", timeout_s + scene.patience_s, fails=True)
    if took_s < 0.8 * timeout_s:
        scene.findings.fail("orphan", f"it ended after {took_s:.2f} s of {timeout_s:g} s")


def away(scene: Scene) -> None:
    """The emulator announces that it will be back, goes for longer than agents wait unasked, and comes back."""
    scene.join()
    course = course_of(scene)
    course.run(QUARTER_NS)
    scene.findings.expect("waits")
    take_frames, scene.take_frames = scene.take_frames, lambda said: None
    scene.bench.say(wire.Await(RETURN_WITHIN_S))
    scene.bench.hear(WARNING_S)
    scene.bench.close()
    deadline_s = time.monotonic() + AWAY_S
    while time.monotonic() < deadline_s:
        scene.bench.hear(timing.ASK_EVERY_S)
        scene.check_stays("waits")
    scene.bench.open()
    scene.ask_stack(RETURN_WITHIN_S)
    scene.take_frames = take_frames
    if isinstance(course, Clock):
        course.lose_frames()
    course.run(2 * NS_PER_S)
    course.end()


SCENES: dict[str, tuple[Pacing, Callable[[Scene], None]]] = {
    "joining": ("lockstep", joining),
    "refusal": ("lockstep", refusal),
    "lockstep": ("lockstep", ordinary),
    "lockstep-restart": ("lockstep", restart),
    "lockstep-ended": ("lockstep", ended),
    "lockstep-malformed": ("lockstep", malformed),
    "lockstep-lost": ("lockstep", lost),
    "lockstep-away": ("lockstep", away),
    "realtime": ("realtime", ordinary),
    "realtime-restart": ("realtime", restart),
    "realtime-elsewhere": ("realtime", elsewhere),
    "realtime-malformed": ("realtime", malformed),
    "realtime-lost": ("realtime", lost),
    "realtime-away": ("realtime", away),
}
"""The scenes by name, in the order in which they are played."""


@dataclass(frozen=True)
class Conformance:
    """Scenes to be played, and the command that they are played against."""

    command: Sequence[str]
    scenario: Scenario
    scenes: Sequence[str]
    listen: str = "tcp/127.0.0.1:0"
    patience_s: float = PATIENCE_S

    def __post_init__(self) -> None:
        """Raises VnetError for an unknown scene, and for a command that cannot know where to connect."""
        for name in self.scenes:
            if name not in SCENES:
                known = ", ".join(SCENES)
                raise VnetError(f"--scene {name}: unknown{did_you_mean(name, SCENES)}; there are {known}")
        for placeholder in PLACEHOLDERS:
            if not any(placeholder in word for word in self.command):
                names = " ".join(PLACEHOLDERS)
                raise VnetError(f"the command has no {placeholder}; it needs all of {names}")

    def play(self, on_scene: Callable[[str], None] = lambda name: None) -> Findings:
        """Play the scenes; `on_scene` is given each name. Raises VnetError if the command cannot be started."""
        emulation = Session(self.scenario).emulation
        certify = certifier(self.listen) if is_tls(self.listen) else None
        access = Access.create(self.scenario.run.name, [[emulation.world.node_ids[0]]], certify)
        findings = Findings()
        with tempfile.TemporaryDirectory(prefix="vnet-") as name:
            for scene_name in self.scenes:
                on_scene(scene_name)
                findings.begin(scene_name)
                pacing, act = SCENES[scene_name]
                with Bench(access, self.listen, self.command, Path(name)) as bench, suppress(SceneOverError):
                    act(Scene(bench, findings, emulation, pacing, self.patience_s))
        return findings
