"""The pytest plugin: tests that pass, fail, step, break and judge runs, as users write them."""

import json
import os
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.support.forked_commands import MODULE, VNET, run
from tests.support.paths import ROOT

pytestmark = pytest.mark.slow

pytest_plugins = "pytester"

BEACON = ROOT / "scenarios" / "beacon.toml"
TWELVE = ROOT / "scenarios" / "twelve.toml"


RunTests = Callable[[str], pytest.RunResult]


@pytest.fixture
def run_tests(pytester: pytest.Pytester) -> RunTests:
    """Run a test module in a session of its own."""

    def run_code(code: str) -> pytest.RunResult:
        header = f"import pytest\nBEACON = {str(BEACON)!r}\nTWELVE = {str(TWELVE)!r}\n"
        pytester.makepyfile(header + code)
        return pytester.runpytest()

    return run_code


def session_of_its_own(pytester: pytest.Pytester, *options: str) -> subprocess.CompletedProcess[str]:
    """Run pytest in a process of its own, which may end by a signal."""
    words, environment = [*MODULE, "pytest", *options], {**os.environ, "PYTHONPATH": str(ROOT)}
    return run(words, cwd=pytester.path, env=environment, capture_output=True, timeout=300)


def verdict_of(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "verdict.json").read_text())


def test_a_coroutine_test_steps_a_run_and_checks_it(run_tests: RunTests) -> None:
    run_tests("""
async def test_steps(vnet_emulation):
    async with vnet_emulation(BEACON, vehicles=4, duration=3) as emu:
        assert emu.nodes == ["v01", "v02", "v03", "v04"]
        assert emu.figures is None
        await emu.run_until(1.0)
        assert (emu.now_s, emu.figures.period) == (1.0, 9)
        await emu.run_for(0.55)
        assert emu.figures.period == 14
        assert emu.states().num_rows == 15 * 4
        assert {event.kind for event in emu.events} == {"started"}
        first, second = emu.halves()
        assert sorted(first + second) == emu.nodes and len(first) == len(second)
        judgement = emu.check("conservation", "loss_rate")
        assert judgement.trace_sha256
""").assert_outcomes(passed=1)


@pytest.mark.parametrize("options", [["-p", "no:xdist"], ["-n", "2"], ["-s", "-p", "no:faulthandler"]])
def test_a_fatal_signal_ends_pytest_and_the_vehicle_is_named(pytester: pytest.Pytester, options: list[str]) -> None:
    pytester.makepyfile(f"""
async def test_fatal(vnet_emulation):
    changes = dict(duration=2, settle=0.5, program="tests.emulator.testing.programs:faulty")
    async with vnet_emulation({str(BEACON)!r}, vehicles=3, **changes) as emu:
        await emu.run_until(1.0)
""")
    done = session_of_its_own(pytester, *options)
    assert done.returncode != 0, done.stdout
    assert "vnet: pytest's process ended while the program of v01 ran" in done.stderr.splitlines()


def test_a_session_that_ends_as_it_should_says_nothing(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(f"""
import os
async def test_leaves_in_the_midst(vnet_emulation):
    async with vnet_emulation({str(BEACON)!r}, vehicles=2, duration=2, settle=0.5) as emu:
        await emu.run_until(1.0)
    pid = os.fork()
    if not pid:
        os._exit(0)
    os.waitpid(pid, 0)
""")
    done = session_of_its_own(pytester)
    assert (done.returncode, done.stderr) == (0, "")


def test_a_failed_check_names_the_folder_and_the_command(run_tests: RunTests) -> None:
    result = run_tests("""
async def test_fails(vnet_emulation):
    changes = dict(duration=2, settle=0.5, program="tests.emulator.testing.programs:impatient")
    async with vnet_emulation(BEACON, vehicles=3, **changes) as emu:
        await emu.run_until(1.0)
        with emu.fault("pause", nodes=["v02"]):
            await emu.run_for(0.5)
        await emu.run_until(2.0)
        emu.check()
""")
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(
        [
            "*agents_alive is invalid: v02 crashed at 1.5 s: RuntimeError: where has*",
            "*files: */vnet-1",
            "*again: vnet simulate */vnet-1/scenario.toml",
            "*- vnet -*",
            "files  */vnet-1",
            "again  vnet simulate */vnet-1/scenario.toml",
        ]
    )


def test_a_run_that_is_made_within_another_leaves_it_its_modules(
    pytester: pytest.Pytester, run_tests: RunTests
) -> None:
    program = """
import lent

async def main(node):
    async for fix in node.gnss:
        import lent as again
        node.report(same=again is lent)
"""
    pytester.makepyfile(lent="", lends=program)
    result = run_tests("""
async def test_nested(vnet_emulation):
    changes = dict(vehicles=2, duration=2, settle=0.5, program="lends.py")
    async with vnet_emulation(BEACON, **changes) as emu:
        await emu.run_until(0.5)
        async with vnet_emulation(BEACON, **changes) as other:
            await other.run_until(1.0)
        await emu.run_until(2.0)
        assert all(row["same"] for row in emu.states().to_pylist() if row["same"] is not None)
""")
    result.assert_outcomes(passed=1)


def test_a_program_that_is_ended_and_a_rule_that_fails_fail_their_test(run_tests: RunTests) -> None:
    result = run_tests("""
def raising(frame, state):
    raise ZeroDivisionError

async def test_spins(vnet_emulation):
    spinning = "tests.emulator.testing.programs:spinning"
    async with vnet_emulation(BEACON, vehicles=2, duration=2, settle=0.5, program=spinning) as emu:
        await emu.run_until(2.0)

async def test_raises(vnet_emulation):
    async with vnet_emulation(BEACON, vehicles=2, duration=3, settle=0.5) as emu:
        with emu.rule(raising):
            await emu.run_for(1)
""")
    result.assert_outcomes(failed=2)
    result.stdout.fnmatch_lines_random(["*progress is invalid: *v01*", "*own_rules is invalid: *ZeroDivision*"])


WRONG_STEPS = {
    "await emu.__aenter__()": "*VnetError: an emulation can be entered once*",
    "emu.check('peer_cap')": "*peer_cap is unknown: not exercised: *",
    "emu.check('sped')": "*VnetError: no check is called 'sped'; there are: conservation, *",
    "emu.check('progres')": "*VnetError: no check is called 'progres' (did you mean progress?); there are: *",
    "emu.check('conservation', within_s=1)": "*none of these checks measured a recovery",
    "await emu.run_until(3)": "*run_until(3): the run takes 2 s; give it a longer duration=",
    "await emu.run_until(1); await emu.run_until(0.5)": "*run_until(0.5): it is 1 s already",
    "emu.end(); await emu.run_for(1)": "*run_until: the run is over",
    "with emu.fault('rain'): pass": "*ScenarioError: fault: *'rain'*must be one of*",
    "with emu.fault('kill', nodes=['v9']): pass": "*'v9' is no vehicle of the network*",
    "with emu.fault('emulator_restart'): pass": "*there is nothing here to restart",
    "with emu.fault('partition'): await emu.run_until(2)": "*partition-0 would be healed at 1 s*",
    "await emu.run_until(1)\n        with emu.fault('partition'): pass": "*all have healed by 1 s, *",
}
WRONG_SCENARIOS = {
    "BEACON, durations=3": "*ScenarioError: durations: unknown (did you mean duration?); write section.key, or *",
    "BEACON, **{'radio.lost': 1}": "*ScenarioError: radio.lost: unknown key (did you mean loss?); allowed here:*",
    "BEACON, **{'run.pacing': 'realtime'}": "*a test steps a run in lockstep*",
    "{'network': {'vehicles': 0}}": "*ScenarioError: network.vehicles = 0:*",
    "'nowhere.toml'": "*ScenarioError: nowhere.toml: cannot be read*",
    "BEACON, program='nothing:main'": "*ProgramError: program.entry = 'nothing:main': cannot import*",
}


def test_what_cannot_be_is_said(run_tests: RunTests) -> None:
    steps = [
        f"""
async def test_step_{number}(vnet_emulation):
    async with vnet_emulation(BEACON, vehicles=2, duration=2, settle=1) as emu:
        await emu.run_until(0.2)
        {body}
"""
        for number, body in enumerate(WRONG_STEPS)
    ]
    scenarios = [
        f"""
async def test_scenario_{number}(vnet_emulation):
    async with vnet_emulation({arguments}):
        pass
"""
        for number, arguments in enumerate(WRONG_SCENARIOS)
    ]
    result = run_tests("".join(steps + scenarios))
    result.assert_outcomes(failed=len(WRONG_STEPS) + len(WRONG_SCENARIOS))
    result.stdout.fnmatch_lines([*WRONG_STEPS.values(), *WRONG_SCENARIOS.values()])


def test_a_program_that_crashes_the_test_itself_leaves_a_judged_run(
    pytester: pytest.Pytester, run_tests: RunTests
) -> None:
    run_tests("""
async def test_stops(vnet_emulation):
    async with vnet_emulation(BEACON, vehicles=2, duration=9) as emu:
        await emu.run_until(0.5)
        assert emu.figures.reporting == 99
""").assert_outcomes(failed=1)
    (folder,) = (pytester.path.parent / "basetemp").glob("**/vnet-1")
    assert verdict_of(folder)["emulated_s"] == 0.5


def test_a_crash_fails_a_test_that_has_not_judged_it(run_tests: RunTests) -> None:
    result = run_tests("""
CRASHED = dict(program="tests.emulator.testing.programs:impatient", vehicles=2, duration=3, settle=1)

def expects(emu):
    with pytest.raises(AssertionError, match="crashed"):
        emu.check("agents_alive")

@pytest.mark.parametrize("judge", [None, lambda emu: emu.check("conservation"), lambda emu: emu.end(), expects])
async def test_crash(vnet_emulation, judge):
    async with vnet_emulation(BEACON, **CRASHED) as emu:
        await emu.run_for(1.0)
        with emu.fault("pause", nodes=["v01"]):
            await emu.run_for(0.5)
        await emu.run_for(0.5)
        if judge:
            judge(emu)
""")
    result.assert_outcomes(passed=2, failed=2)
    result.stdout.fnmatch_lines(["*agents_alive is invalid: v01 crashed*"])


def test_plain_tests_may_use_the_fixture_and_leave_others_alone(run_tests: RunTests) -> None:
    result = run_tests("""
import asyncio

def test_plain(vnet_emulation):
    async def steps():
        async with vnet_emulation(BEACON, vehicles=2, duration=1) as emu:
            await emu.run_until(0.1)
    asyncio.run(steps())

def test_never_started(vnet_emulation):
    emu = vnet_emulation(BEACON, vehicles=2)
    for use in (emu.end, emu.check, lambda: asyncio.run(emu.run_until(1)), emu.fault("kill").__enter__):
        with pytest.raises(Exception, match="the run has not started"):
            use()

def test_without_asyncio(vnet_emulation):
    with pytest.raises(Exception, match="needs asyncio"):
        vnet_emulation(BEACON, vehicles=2).__aenter__().send(None)

async def test_of_nobody():
    pass
""")
    result.assert_outcomes(passed=3, failed=1)
    result.stdout.fnmatch_lines(["*async def functions are not natively supported*"])


def test_a_step_that_was_cancelled_goes_on_and_the_next_waits_for_it(run_tests: RunTests) -> None:
    run_tests("""
import asyncio

async def test_cancelled(vnet_emulation):
    async with vnet_emulation(TWELVE, vehicles=3, duration=2, settle=0.2) as emu:
        step = asyncio.ensure_future(emu.run_until(0.5))
        await asyncio.sleep(0)
        step.cancel()
        with pytest.raises(Exception, match="the run is on its way to 0.5 s"), emu.fault("kill"):
            pass
        await emu.run_until(1.0)
        assert emu.figures.period == 9

async def test_left_on_its_way(vnet_emulation):
    async with vnet_emulation(TWELVE, vehicles=3, duration=2) as emu:
        step = asyncio.ensure_future(emu.run_until(0.5))
        await asyncio.sleep(0)
        step.cancel()
    assert emu.end().trace_sha256
    assert emu.now_s == 0.5
""").assert_outcomes(passed=2)


@pytest.mark.parametrize("until_s", [1.0, 0.4], ids=["in a step", "at the end"])
@pytest.mark.parametrize(("live", "sleeps_s"), [(False, 0), (False, 300), (True, 0)])
def test_ctrl_c_ends_a_test_whose_program_does_not_yield(
    pytester: pytest.Pytester, live: bool, sleeps_s: int, until_s: float
) -> None:
    """One that sleeps in the operating system cannot be interrupted: its thread is left to itself."""
    pytester.makepyfile(f"""
import os
from emulator.testing import harness
harness.PATIENCE_S = {0.5 if sleeps_s else 2.0}

async def test_busy(vnet_emulation):
    options = {{"pid": os.getpid(), "sleeps_s": {sleeps_s}}}
    busy = {{"program": "tests.emulator.testing.programs:busy", "options": options, "duration": 9}}
    later = {{"kind": "loss", "at_s": 0, "duration_s": 2, "probability": 0.1}}
    async with vnet_emulation({str(BEACON)!r}, vehicles=2, faults=[later], live={live}, **busy) as emu:
        await emu.run_until({until_s})
""")
    done = session_of_its_own(pytester, "--basetemp=base")
    assert done.returncode == pytest.ExitCode.INTERRUPTED, done.stdout + done.stderr
    (folder,) = (pytester.path / "base").glob("**/vnet-1")
    if not sleeps_s:
        assert "interrupted" in (folder / "events.jsonl").read_text()
        assert verdict_of(folder)["verdict"] == "unknown"


def test_faults_of_all_vehicles_from_the_beginning_on_end_no_run(run_tests: RunTests) -> None:
    run_tests("""
@pytest.mark.parametrize("live", [False, True])
@pytest.mark.parametrize("kind", ["kill", "pause"])
async def test_all(vnet_emulation, kind, live):
    async with vnet_emulation(BEACON, vehicles=2, duration=3, settle=1, live=live) as emu:
        with emu.fault(kind):
            await emu.run_for(0.25)
            await emu.run_for(0.25)
        await emu.run_until(2.0)
        assert emu.figures.period == 19
""").assert_outcomes(passed=4)


def test_a_fault_whose_block_is_left_before_it_begins_never_acts(run_tests: RunTests) -> None:
    run_tests("""
@pytest.mark.parametrize("live", [False, True])
async def test_left(vnet_emulation, live):
    async with vnet_emulation(BEACON, vehicles=2, duration=4, settle=1, live=live) as emu:
        with emu.fault("kill", nodes=["v02"], at_s=2.0):
            await emu.run_until(0.5)
        await emu.run_until(4.0)
    assert "kill-0" not in (emu.folder / "events.jsonl").read_text()
    assert "effect:kill-0" in [check.name for check in emu.end().not_exercised]
""").assert_outcomes(passed=2)


def test_a_block_that_an_error_leaves_ends_its_run_where_it_stands(run_tests: RunTests) -> None:
    run_tests("""
import asyncio

@pytest.mark.parametrize("live", [False, True])
async def test_left(vnet_emulation, live):
    with pytest.raises(KeyError):
        async with vnet_emulation(TWELVE, vehicles=3, duration=900, live=live) as emu:
            with emu.fault("pause", nodes=["v02"]):
                step = asyncio.ensure_future(emu.run_until(800))
                await asyncio.sleep(0)
                step.cancel()
                raise KeyError
    assert 0 < emu.now_s < 800
    assert emu.end().verdict != "invalid"
""").assert_outcomes(passed=2)


def test_hypothesis_calls_a_coroutine_test_again_and_again(run_tests: RunTests) -> None:
    result = run_tests("""
from hypothesis import HealthCheck, given, settings, strategies

@given(at_s=strategies.integers(1, 20))
@settings(
    deadline=None, derandomize=True, max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
async def test_many(vnet_emulation, at_s):
    async with vnet_emulation(BEACON, vehicles=2, duration=3) as emu:
        await emu.run_until(at_s / 10)
        assert at_s < 7
""")
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["*at_s=7*"])


LIVE_OR_NOT = """
@pytest.mark.parametrize("live", [False, True])
async def test_both(vnet_emulation, live):
    async with vnet_emulation(TWELVE, vehicles=3, duration=4, settle=0.5, live=live) as emu:
        with emu.fault("block", senders=["v02"]):
            await emu.run_until(0.5)
        with emu.fault("kill", nodes=["v03"]), emu.fault("skew", nodes=["v01"], offset_ms=40):
            await emu.run_for(0.3)
        with emu.fault("partition", groups=emu.halves()):
            await emu.run_for(0.25)
            with emu.fault("pause"):
                pass
        await emu.run_for(0.3)
        emu.check("conservation")
    print(emu.folder)
"""


def test_live_and_simulated_and_replayed_are_one_run(pytester: pytest.Pytester, run_tests: RunTests) -> None:
    """Check that everything the test did, instant by instant, is in the scenario that it leaves."""
    run_tests(LIVE_OR_NOT).assert_outcomes(passed=2)
    folders = sorted((pytester.path.parent / "basetemp").glob("**/vnet-1"))
    again = pytester.path / "again"
    command = [*VNET, "simulate", str(folders[0] / "scenario.toml")]
    run([*command, "--out", str(again)], cwd=ROOT, capture_output=True, timeout=120)
    fingerprints = [
        (verdict["trace_sha256"], verdict["metrics_sha256"], verdict["emulated_s"])
        for verdict in map(verdict_of, [*folders, again])
    ]
    assert len(folders) == 2
    assert len(set(fingerprints)) == 1, fingerprints
    assert "restarted" in (again / "events.jsonl").read_text()


IMPORTED = """
import signal
from decimal import Decimal, getcontext
from draws_by_name import draw

getcontext().prec = 6


async def main(node):
    signal.signal(signal.SIGUSR1, signal.SIG_IGN)
    async for fix in node.gnss:
        await node.radio.broadcast(f"{Decimal(1) / 7} {draw()}".encode())
"""


@pytest.mark.parametrize("imports", ["", "import imported_before\n"])
def test_a_program_does_what_it_does_in_a_command_whoever_has_imported_it(
    pytester: pytest.Pytester, imports: str
) -> None:
    pytester.makepyfile(imported_before=IMPORTED, draws_by_name="from random import random as draw\n")
    code = """
@pytest.mark.parametrize("again", [1, 2])
async def test_it(vnet_emulation, again):
    async with vnet_emulation(BEACON, vehicles=2, duration=1, program="imported_before.py") as emu:
        await emu.run_until(1.0)
"""
    session = pytester.path / "test_session.py"
    session.write_text(f"import pytest\n{imports}BEACON = {str(BEACON)!r}\n{code}")
    done = session_of_its_own(pytester, "--basetemp=basetemp", session.name)
    folders = sorted((pytester.path / "basetemp").glob("**/vnet-1"))
    assert len(folders) == 2, done.stdout
    command = [*VNET, "simulate", str(folders[0] / "scenario.toml"), "--out", "again"]
    run(command, cwd=pytester.path, capture_output=True, timeout=120)
    verdicts = [verdict_of(folder) for folder in (*folders, pytester.path / "again")]
    assert len({verdict["trace_sha256"] for verdict in verdicts}) == 1
    assert {verdict["verdict"] for verdict in verdicts} == {"valid"}


def test_an_order_is_the_same_when_it_is_reproduced(pytester: pytest.Pytester, run_tests: RunTests) -> None:
    run_tests("""
async def test_order(vnet_emulation):
    changes = {"run.order": "pct", "run.order_depth": 5, "radio.delivery_tick_us": 1000}
    changes["program"] = "tests.support.window_programs:improvises"
    async with vnet_emulation(TWELVE, vehicles=4, duration=1, **changes) as emu:
        await emu.run_until(0.5)
""").assert_outcomes(passed=1)
    (folder,) = (pytester.path.parent / "basetemp").glob("**/vnet-1")
    again = pytester.path / "again"
    command = [*VNET, "simulate", str(folder / "scenario.toml")]
    run([*command, "--out", str(again)], cwd=ROOT, capture_output=True, timeout=120)
    first, second = verdict_of(folder), verdict_of(again)
    assert first["trace_sha256"] == second["trace_sha256"]
    tapes = [(each / "tape.jsonl").read_text() for each in (folder, again)]
    assert tapes[0] == tapes[1] and len(tapes[0].splitlines()) > 1


def test_a_live_run_whose_program_cannot_be_imported_is_refused_before_it_starts(
    pytester: pytest.Pytester, run_tests: RunTests
) -> None:
    result = run_tests("""
async def test_live(vnet_emulation):
    async with vnet_emulation(BEACON, vehicles=2, program="nothing:main", live=True):
        pass
""")
    result.assert_outcomes(failed=1)
    result.stdout.fnmatch_lines(["*ProgramError: program.entry = 'nothing:main': cannot import*"])
    assert not list((pytester.path.parent / "basetemp").glob("**/vnet-1"))


def test_a_live_run_leaves_the_garbage_of_its_process_to_the_collector(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(f"""
import gc

gc.unfreeze()  # what the tests' own server has frozen

async def test_live(vnet_emulation):
    async with vnet_emulation({str(BEACON)!r}, vehicles=2, duration=2, settle=0.5, live=True) as emu:
        await emu.run_until(0.5)
        assert gc.get_freeze_count()

def test_then():
    assert not gc.get_freeze_count()
""")
    done = session_of_its_own(pytester, "-p", "no:xdist")
    assert done.returncode == 0, done.stdout


def test_a_program_that_ends_the_process_late_does_not_make_it_a_success(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(f"""
import atexit, os
async def test_ends(vnet_emulation):
    async with vnet_emulation({str(BEACON)!r}, vehicles=2, duration=2, settle=0.5) as emu:
        await emu.run_until(1.0)
    atexit.register(os._exit, 0)
""")
    assert session_of_its_own(pytester, "-p", "no:xdist").returncode == 71
