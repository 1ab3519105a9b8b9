"""Conformance finds no fault with agents that have none, and tells agents with a mistake which one."""

import itertools
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from emulator.cli.commands import app
from emulator.scenario.scenario import Scenario
from emulator.terminal.console import run_app
from emulator.testing.conformance import courses
from emulator.testing.conformance import play as play_module
from emulator.testing.conformance import scene as scene_module
from emulator.testing.conformance.findings import CHECKS, Findings, decoding_problem, described
from emulator.testing.conformance.play import SCENES, Conformance
from emulator.testing.conformance.scene import Said, Scene, SceneOverError
from tests.support.paths import ROOT
from vnet.errors import VnetError
from vnet.radio import SentFrame
from vnet.transport import wire

pytestmark = pytest.mark.slow

VALUES = ["--connect", "{endpoint}", "--run", "{run}", "--node", "{node}", "--credentials", "{credentials}"]
FOREIGN = [sys.executable, "-P", "docs/examples/foreign_agent.py", *VALUES]
VNET_AGENT = [sys.executable, "-P", "-m", "agents.cli", *VALUES]


LONG_S = 20.0
"""Time for whatever an agent without a mistake does, on a machine that is busy with other things, too."""
SHORT_S = 0.5
"""Time that is waited for what does not come."""
AT_ONCE = 4
"""Scenes that are played at once: they wait for most of their time."""


def play(
    command: Sequence[str], *scenes: str, patience_s: float = LONG_S, listen: str = "tcp/127.0.0.1:0"
) -> Findings:
    return Conformance(command, Scenario(), scenes or list(SCENES), listen, patience_s).play()


def wrong(mistake: str) -> list[str]:
    return [sys.executable, "-P", "-m", "tests.emulator.testing.conformance.wrong_agent", mistake, *VALUES]


@pytest.fixture(autouse=True)
def at_root(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    wait_for(monkeypatch, courses, ACKNOWLEDGE_S=LONG_S, FINAL_S=LONG_S)


def wait_for(monkeypatch: pytest.MonkeyPatch, module: ModuleType, **times_s: float) -> None:
    """Set times that scenes wait."""
    for name, time_s in times_s.items():
        monkeypatch.setattr(module, name, time_s)


def test_an_agent_without_a_mistake_passes_every_check() -> None:
    names = list(SCENES)  # the foreign agent passes them in docs/how-to/other-languages.md
    with ThreadPoolExecutor(AT_ONCE) as pool:
        played = list(pool.map(lambda first: play(VNET_AGENT, *names[first::AT_ONCE]), range(AT_ONCE)))
    assert [found.failed for found in played] == [{}] * AT_ONCE
    assert {name for found in played for name in found.made} == CHECKS.keys()


def test_a_program_that_awaits_the_results_of_its_sends_is_told_them() -> None:
    data = {"radio": {"mac": {}}, "program": {"entry": "tests.support.exchange_programs:ends_with_results"}}
    scenes = ["lockstep", "realtime"]
    found = Conformance(VNET_AGENT, Scenario.model_validate(data), scenes, patience_s=LONG_S).play()
    assert [scene for scene, came in found.failed.pop("stays") if came.startswith("exit status 17")] == scenes
    assert found.failed == {}


def test_two_frames_to_single_vehicles_with_one_number_are_found() -> None:
    findings, frame = Findings(), SentFrame("v01", b"", to="v02", number=3)
    bench: Any = SimpleNamespace(node="v01")
    emulation: Any = SimpleNamespace(scenario=Scenario())
    scene = Scene(bench, findings, emulation, "realtime", LONG_S)
    scene.check_traffic(wire.Traffic([frame, frame]), b"", (0, 0), "")
    ((_, came),) = findings.failed["sends"]
    assert came.startswith("a second frame with number 3")


def test_an_agent_passes_over_tls() -> None:
    assert play(FOREIGN, "lockstep", listen="tls/127.0.0.1:0").failed == {}


@pytest.mark.parametrize(
    ("mistake", "scene", "check", "came"),
    [
        ("SaysHelloOnce", "joining", "hello_repeats", "no Hello within"),
        ("ReadyAtOnce", "refusal", "hello", "ready = True"),
        ("ShortNonce", "refusal", "hello", "a nonce of 1 byte;"),
        ("CannotLoadItsProgram", "lockstep-ended", "ready", "no module beacon"),
        ("TakesAnyWelcome", "joining", "others_nonce", "ready after another's welcome"),
        ("EndsThoughItIsRefused", "refusal", "refused", "exit status 0"),
        ("Deaf", "refusal", "refused", "it still runs after"),
        ("SaysTextForInteger", "lockstep-ended", "decodes", "(Yield.seq)"),
        ("ForgetsItsNonce", "lockstep-ended", "nonce", "Yield with another"),
        ("CountsByItself", "lockstep", "yields", "seq = 1, and not 0"),
        ("YieldsTwice", "lockstep", "yields", "seq = 0, and not 1"),
        ("YieldsBeforeTheGrant", "lockstep-ended", "silence", "Yield"),
        ("TimerInThePast", "lockstep", "timers", "its next timer, 0, lies before the end of its window, 2000000"),
        ("StepsAfterItsWindow", "lockstep", "steps", "a step at 2000000, where 0 to 1999999 are allowed"),
        ("KnowsNoWindows", "refusal", "version", "version = 1"),
        ("WaitsForNothing", "lockstep-lost", "wakes", "it waits for nothing"),
        ("AnswersLate", "lockstep-lost", "yields", "no Yield within 0.5 s"),
        ("SpeaksForOthers", "lockstep-lost", "own_node", "speaks for v02, which is not its own"),
        ("SendsTooMuch", "lockstep-lost", "payload", "100000 bytes, where"),
        ("ReportsNan", "lockstep-lost", "numbers", "not finite"),
        ("ReportsWallClock", "lockstep-lost", "report_time", "and not 0"),
        ("RunsThoughItHasEnded", "lockstep-ended", "no_traffic", "traffic"),
        ("KeepsItsNonce", "lockstep-restart", "new_nonce", "the same"),
        ("IgnoresStackRequests", "lockstep", "stack", "no StackDump within"),
        ("EndsWithAnError", "lockstep-ended", "ends", "exit status 1: an error at the very end"),
        ("GivesUpAtOnce", "lockstep-lost", "orphan", "s of 20 s"),
        ("GivesUpAtOnce", "lockstep-away", "waits", "exit status 3"),
        ("TakesGarbageForTheEnd", "lockstep-malformed", "malformed", "exit status 0"),
        ("StumblesOverGarbage", "lockstep-malformed", "malformed", "exit status 1"),
        ("CountsFramesWrongly", "realtime-restart", "frames_seq", "seq = 7, and not 0"),
        ("NeverAcknowledges", "realtime", "acknowledges", "received_seq = 0"),
        ("HidesGaps", "realtime", "missed", "nothing of [[4, 5]]"),
        ("NeverLate", "realtime", "lateness", "no packet 70 ms late or more, where one was"),
        ("TooFewBins", "realtime-restart", "decodes", "(Frames.lateness)"),
        ("NoLastWords", "realtime-restart", "final", "no such Frames within 0.5 s"),
        ("ReportsWallClock", "realtime-restart", "report_time", "received at"),
    ],
)
def test_an_agent_is_told_its_mistake(
    mistake: str, scene: str, check: str, came: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    arrange(mistake, monkeypatch)

    class UntilFailed(Findings):
        """Ends the scene once the check has failed."""

        def fail(self, name: str, came: str, data: bytes | None = None) -> None:
            super().fail(name, came, data)
            if name == check:
                raise SceneOverError

    monkeypatch.setattr("emulator.testing.conformance.play.Findings", UntilFailed)
    found = play(wrong(mistake), scene, patience_s=SHORT_S if mistake in ("Deaf", "AnswersLate") else LONG_S)
    assert came in dict(found.failed[check])[scene]


def arrange(mistake: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Give what comes a long time, however slow the machine, and what does not come a short one."""
    match mistake:
        case "TakesAnyWelcome" | "YieldsBeforeTheGrant":
            wait_for(monkeypatch, scene_module, QUIET_S=LONG_S)
        case "GivesUpAtOnce":
            wait_for(monkeypatch, scene_module, ORPHAN_TIMEOUT_S=LONG_S)
            wait_for(monkeypatch, play_module, AWAY_S=LONG_S)
        case "SaysHelloOnce":
            wait_for(monkeypatch, play_module, HELLO_WAIT_S=SHORT_S)
        case "NeverAcknowledges" | "NoLastWords":
            wait_for(monkeypatch, courses, ACKNOWLEDGE_S=SHORT_S, FINAL_S=SHORT_S)
        case "IgnoresStackRequests":
            ask = Scene.ask_stack
            monkeypatch.setattr(Scene, "ask_stack", lambda scene, timeout_s: ask(scene, SHORT_S))


def test_an_agent_that_does_not_start_is_told_what_it_printed() -> None:
    command = [sys.executable, "-c", "print('no such library'); exit(4)", *VALUES]
    assert play(command, "refusal").failed == {"starts": [("refusal", "exit status 4: no such library")]}


def test_an_agent_that_never_says_hello_is_told_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("emulator.testing.conformance.scene.START_UP_S", 0.2)
    command = [sys.executable, "-c", "import time; time.sleep(60)", *VALUES]
    found = play(command, "refusal", patience_s=0.2)
    assert found.failed["hello"] == [("refusal", "no Hello within 0.2 s")]


def conformance(*arguments: str) -> int:
    return run_app(app, ["conformance", *arguments])


def test_the_command_prints_a_line_for_each_check_and_ends_with_0(capsys: pytest.CaptureFixture[str]) -> None:
    assert conformance("--scene", "refusal", "--", *FOREIGN) == 0
    *lines, last = capsys.readouterr().out.splitlines()
    assert [line.split()[1] for line in lines] == ["starts", "hello", "version", "decodes", "nonce", "refused"], (
        "no others"
    )
    assert {line.split()[0] for line in lines} == {"ok"}
    assert last == "6 checks: 0 wrong"


def test_the_command_shows_the_bytes_of_what_is_wrong_and_ends_with_1(capsys: pytest.CaptureFixture[str]) -> None:
    assert conformance("--scene", "refusal", "--", *wrong("OfAnotherProcess")) == 1
    (line,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("wrong")]
    assert "came in refusal: node 'v01', process_id 'v02'; ['Hello', 'v01', 'v02', b" in line
    assert "bytes: 99 a5 48 65 6c 6c 6f" in line


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--scene", "lockstepp", "--", *FOREIGN], "--scene lockstepp: unknown (did you mean lockstep?)"),
        (["--", "./agent", "{endpoint}", "{run}", "{node}"], "the command has no {credentials}"),
        (["--", "./no-such-agent", *VALUES], "cannot start './no-such-agent': No such file or directory"),
        ([], "missing argument"),
    ],
)
def test_wrong_usage_is_one_line_and_ends_with_2(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert conformance(*arguments) == 2
    assert message in capsys.readouterr().err.splitlines()[-1]


def test_a_command_that_cannot_know_the_node_is_refused() -> None:
    with pytest.raises(VnetError, match=r"the command has no \{node\}"):
        Conformance(["agent", "{endpoint}", "{run}", "{credentials}"], Scenario(), ["refusal"])


@pytest.mark.parametrize(
    ("data", "problem"),
    [
        (b"\x98\xa5Yield\xc4\x01n\xa10\xc0\x90\x90\x90\x01", "(Yield.seq)"),
        (b"\x93\xa9StackDump\x01\xa0", "(StackDump.nonce)"),
        (b"\xc1", "not a message"),
        (b"\x91\xa9Nonsense1", "not a message"),
    ],
)
def test_what_does_not_decode_is_named_by_its_field(data: bytes, problem: str) -> None:
    message, why = decoding_problem(data)
    assert message is None
    assert problem in why


def test_bytes_that_are_no_msgpack_are_shown_all_the_same() -> None:
    assert described(b"\xc1" * 60).startswith("no msgpack (")
    assert described(b"\xc1" * 60).endswith("60 bytes: " + " ".join(["c1"] * 48) + " …")


def frames(seq: int) -> Said:
    """Frames as an agent in real time sends them all the time."""
    message = wire.Frames(b"nonce", seq, 0, (), wire.Traffic())
    return Said(wire.encode(message), 0, message, "")


def test_an_agent_that_never_stops_sending_does_not_hold_a_scene(monkeypatch: pytest.MonkeyPatch) -> None:
    now_s = itertools.count(step=0.01)
    taken: list[Said] = []
    monkeypatch.setattr("emulator.testing.conformance.scene.time.monotonic", lambda: next(now_s))
    endless = (frames(seq) for seq in itertools.count())
    bench: Any = SimpleNamespace(hear=lambda timeout_s: next(endless), exit_status=None)
    emulation: Any = None
    scene = Scene(bench, Findings(), emulation, "realtime", 5.0)
    scene.silent, scene.take_frames = False, taken.append
    assert scene.until_quiet() == []
    assert len(taken) > 3, "none is passed over"
    with pytest.raises(SceneOverError):
        scene.await_message(wire.StackDump, "stack", 1.0)


def test_bytes_that_nest_too_deeply_are_shown_all_the_same() -> None:
    assert "1101 bytes" in described(b"\x91" * 1100 + b"\x01")
