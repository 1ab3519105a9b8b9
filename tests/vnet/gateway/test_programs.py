"""Surroundings of unmodified programs on virtual time: their classes by name, their configuration, themselves."""

import json
import os
import signal
import sys
from pathlib import Path
from textwrap import dedent
from types import ModuleType
from typing import Any
from zipapp import create_archive

import pytest

import emulator
from emulator.checks.judge import check_run
from emulator.records.verdicts import Verdict
from emulator.scenario.scenario import Scenario
from tests.vnet.gateway.conftest import Drive, events, log, printed
from vnet.gateway import client_config
from vnet.gateway.emulated.modules import CLIENT_CONFIG, ENDPOINT
from vnet.gateway.emulated.shown import hide, show

pytestmark = pytest.mark.slow


def test_classes_of_a_program_are_found_by_the_names_of_their_modules(drive: Drive, tmp_path: Path) -> None:
    """Pickles, annotations as text and sources name a module, of which each vehicle has its own."""
    package = tmp_path / "shapes"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "data.txt").write_text("round")
    (package / "parts.py").write_text("class Wheel:\n    def __init__(self, size):\n        self.size = size\n")
    text = """
        from __future__ import annotations
        import asyncio, importlib.resources, inspect, pickle, pkgutil, sys, time
        import msgspec, pydantic
        from shapes.parts import Wheel

        class Car(pydantic.BaseModel):
            wheels: list[Part]

        class Part(pydantic.BaseModel):
            size: int

        class Frame(msgspec.Struct):
            parts: list[Bolt]

        class Bolt(msgspec.Struct):
            size: int

        class Pose:
            name = sys.argv[1]

        def again(thing):
            return pickle.loads(pickle.dumps(thing))

        async def later():
            done = asyncio.Event()
            def call():
                print(type(again(Pose())) is Pose, again(Wheel(3)).size)
                done.set()
            asyncio.get_running_loop().call_later(0.2, call)
            await done.wait()

        time.sleep(0.1)  # another vehicle has the classes by now, too
        print(again(Pose()).name, type(again(Wheel(3))) is Wheel)
        print(Car(wheels=[{"size": 3}]), msgspec.json.decode(b'{"parts":[{"size":3}]}', type=Frame))
        print(inspect.getmodule(Wheel).__name__, "class Wheel" in inspect.getsource(Wheel))
        print(importlib.resources.files("shapes").joinpath("data.txt").read_text())
        print(pkgutil.get_data("shapes", "data.txt"))
        asyncio.run(later())
        """
    before = dict(sys.modules)
    run = drive(text, vehicles=2)
    for node in ("v01", "v02"):
        assert log(run, node)[:-1] == [
            f"{node} True",
            "wheels=[Part(size=3)] Frame(parts=[Bolt(size=3)])",
            "shapes.parts True",
            "round",
            "b'round'",
            "True 3",
        ]
    assert sys.modules["__main__"] is before["__main__"]
    assert sys.modules.get("shapes") is before.get("shapes"), "what a run has shown is gone after it"


def test_what_is_kept_of_a_module_that_was_shown_has_nothing_afterwards() -> None:
    """As `multiprocessing` keeps `__main__` under another name, where the end of a forked process finds it."""
    show("brief", lambda name: ModuleType(name))
    kept = sys.modules["brief"]
    assert vars(kept)["__name__"] == "brief"
    hide("brief")
    with pytest.raises(TypeError):
        vars(kept)


def test_workers_that_wait_when_the_run_ends_say_nothing(drive: Drive) -> None:
    run = drive("""
        import logging, time
        from concurrent.futures import ThreadPoolExecutor

        logging.basicConfig()
        pool = ThreadPoolExecutor(2)
        print(pool.submit(lambda: 7).result())
        time.sleep(100)
        """)
    assert log(run)[0] == "7"
    assert not any("Exception in worker" in line for line in log(run))


def test_configuration_is_where_a_gateway_gives_it(drive: Drive) -> None:
    run = drive("""
        import json, os, zenoh
        assert zenoh.Config.DEFAULT_CONFIG_PATH_ENV == "ZENOH_CONFIG"
        for config in (zenoh.Config.from_env(), zenoh.Config.from_file(os.environ["ZENOH_CONFIG"])):
            print(config.get_json("mode"), config.get_json("connect/endpoints"))
            zenoh.open(config).close()
        config = zenoh.Config()
        for setting in os.environ["ZENOH_CONFIG_OVERRIDE"].split(";"):
            config.insert_json5(*setting.split("=", 1))
        print(config.get_json("mode"), config.get_json("connect/endpoints"))
        os.environ["ZENOH_CONFIG"] = "missing.json5"
        try:
            zenoh.Config.from_env()
        except zenoh.ZError:
            print("refused")
        """)
    assert printed(run) == [f'"client" ["{ENDPOINT}"]'] * 3 + ["refused"]
    assert json.loads(CLIENT_CONFIG.read_text()) == client_config(ENDPOINT)


def test_variables_of_the_scenario_are_in_the_environment_of_each_vehicles_commands(
    drive: Drive, tmp_path: Path
) -> None:
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "wheel.py").write_text("SIZE = 3\n")
    variables = {"NAME": "car-{id}", "ROUTER": "{endpoint}", "PYTHONPATH": str(tmp_path / "parts")}
    text = """
        import os, subprocess, sys, wheel
        print(os.environ["NAME"], os.environ["ROUTER"], wheel.SIZE)
        os.environ["NAME"] = "another"
        child = "import os, wheel; print(os.environ['NAME'], wheel.SIZE)"
        print(subprocess.run([sys.executable, "-c", child], capture_output=True, text=True).stdout)
        """
    run = drive(text, vehicles=2, program={"environment": variables})
    for node in ("v01", "v02"):
        assert log(run, node)[0] == f"car-{node} {ENDPOINT} 3"
        assert "another 3" in log(run, node)


def test_modules_that_vehicles_share_find_the_variables_of_each(drive: Drive) -> None:
    before = dict(os.environ)
    text = """
        import getpass, os, shutil, threading
        from pathlib import Path
        print(Path.home(), os.path.expandvars("$HOME"), shutil.get_terminal_size()[0], os.get_exec_path()[0])
        thread = threading.Thread(target=lambda: print(os.path.expanduser("~"), getpass.getuser()))
        thread.start()
        thread.join()
        os.environ["HOME"] = "/elsewhere"
        print(Path.home(), os.environb[b"HOME"], os.getenvb(b"HOME"), "HOME" in os.environ)
        del os.environ["HOME"]
        print(os.path.expandvars("$HOME"), os.environb.get(b"HOME"))
        """
    run = drive(
        text,
        vehicles=2,
        program={"environment": {"HOME": "/home/{id}", "COLUMNS": "33", "PATH": "/x-{id}:/bin", "LOGNAME": "{id}"}},
    )
    for node in ("v01", "v02"):
        assert log(run, node)[:4] == [
            f"/home/{node} /home/{node} 33 /x-{node}",
            f"/home/{node} {node}",
            "/elsewhere b'/elsewhere' b'/elsewhere' True",
            "$HOME None",
        ]
    assert dict(os.environ) == before


@pytest.mark.parametrize(
    ("environment", "text"),
    [
        ({"A": "{name}"}, "{name} is none of {id}"),
        ({"A=B": "c"}, "A=B"),
        ({"": "c"}, "environment"),
        ({"A": "\0"}, "NUL"),
        ({"VNET_NODE": "v07"}, "VNET_NODE is vnet's"),
        ({"1A": "b"}, "1A"),
    ],
)
def test_variables_that_cannot_be_are_refused_when_the_scenario_is_read(
    environment: dict[str, str], text: str
) -> None:
    command = ["python", "talker.py"]
    with pytest.raises(ValueError, match=text):
        Scenario.model_validate({"program": {"kind": "zenoh", "command": command, "environment": environment}})
    with pytest.raises(ValueError, match="environment goes with a command"):
        Scenario.model_validate({"program": {"environment": {"A": "b"}}})


def test_an_exception_has_variables_of_its_own() -> None:
    command = ["python", "talker.py"]
    exception = {"nodes": ["v02"], "command": command, "environment": {"B": "2"}}
    program = {"kind": "zenoh", "command": command, "environment": {"A": "1"}, "exceptions": [exception]}
    scenario = Scenario.model_validate({"network": {"vehicles": 2}, "program": program})
    assert [scenario.options_of(node)["environment"] for node in ("v01", "v02")] == [{"A": "1"}, {"B": "2"}]


def test_chance_of_numpy_is_the_vehicles_own(drive: Drive) -> None:
    text = """
        import numpy as np, sys
        from numpy.random import default_rng, normal
        print(np.random.rand(), normal(), default_rng().random(), np.random.RandomState().rand())
        print(np.random.SeedSequence().entropy, np.random.Generator(np.random.PCG64()).random())
        np.random.seed(3)
        print(np.random.rand(), default_rng(3).random(), np.random.RandomState(3).rand(), np.random.get_state()[0])
        print(isinstance(default_rng(), np.random.Generator), np.asarray([1.0]).dtype, sys.modules["numpy"] is np)
        """
    first, again = (drive(text, vehicles=2) for _ in range(2))
    lines, other = log(first), log(first, "v02")
    assert lines == log(again)
    assert all(mine != its for mine, its in zip(lines[:2], other[:2], strict=True))
    assert lines[2] == other[2] == "0.5507979025745755 0.08564916714362436 0.5507979025745755 MT19937"
    assert lines[3] == "True float64 True"


@pytest.mark.parametrize(
    "waits",
    [
        "while samples.try_recv() is None: pass",
        "while not came.is_set(): pass",
        "while items.empty(): pass",
        """while True:
            try:
                items.get_nowait()
                break
            except queue.Empty:
                pass""",
        "while not pool.done(): pass",
        "while thread.is_alive(): pass",
        "while thread.is_alive(): thread.join(0)",
        "while not lock.acquire(blocking=False): pass",
        "while lock.locked(): pass",
        "while not wait([pool], timeout=0)[0]: pass",
        "while not items.qsize(): pass",
        "while not items.full(): pass",
        "while not semaphore.acquire(blocking=False): pass",
        "while not semaphore.acquire(timeout=0): pass",
        "while threading.active_count() > 2: pass",
        "while thread in threading.enumerate(): pass",
        "while not told: time.sleep(0)",
    ],
)
def test_a_program_that_polls_without_a_pause_comes_to_its_time(drive: Drive, waits: str) -> None:
    run = drive(f"""
        import queue, threading, time, zenoh
        from concurrent.futures import ThreadPoolExecutor, wait
        session, lock = zenoh.open(zenoh.Config()), threading.Lock()
        samples, came, items = session.declare_subscriber("a"), threading.Event(), queue.Queue(1)
        semaphore, told = threading.Semaphore(0), []
        def put():
            time.sleep(0.1)
            told.append("a variable")
            session.put("a", "b")
            came.set()
            items.put(1)
            lock.release()
            semaphore.release()
        lock.acquire()
        thread, pool = threading.Thread(target=put), ThreadPoolExecutor(1).submit(time.sleep, 0.1)
        thread.start()
        {waits}
        print(f"{{time.monotonic():.2f}}")
        """)
    assert log(run)[0] == "0.10"


def test_signals_to_itself_and_hard_exits_end_a_program_alone(drive: Drive) -> None:
    """They are of the whole process to Python, which has all vehicles and the emulator."""
    text = """
        import os, signal, sys, threading, time
        def stop(number, frame):
            print("stop", number == signal.SIGTERM)
        signal.signal(signal.SIGTERM, stop)
        os.kill(os.getpid(), signal.SIGTERM)
        signal.raise_signal(signal.SIGTERM)
        os.kill(os.getpid(), 0)
        try:
            os.kill(os.getpid(), signal.SIGINT)
        except KeyboardInterrupt:
            print("interrupted")
        threading.Timer(0.5, os.kill, [os.getpid(), signal.SIGINT]).start()
        try:
            time.sleep(100)
        except KeyboardInterrupt:
            print(f"interrupted {time.monotonic():.1f}")
        for call in (os.fork, lambda: os.execv("/bin/true", ["true"])):
            try:
                call()
            except OSError as error:
                print("refused", error.errno is not None)
        try:
            if sys.argv[1] == "v01":
                os._exit(0)
            if sys.argv[1] == "v02":
                threading.Timer(0.5, os._exit, [3]).start()
            else:
                os.kill(os.getpid(), signal.SIGKILL)
            time.sleep(100)
        finally:
            print("never")
        """
    run = drive(text, vehicles=3, duration_s=4.0)
    common = ["stop True"] * 2 + ["interrupted", "interrupted 0.5", "refused True", "refused True"]
    for node, ends in (("v01", "v01 finished"), ("v02", "v02 crashed"), ("v03", "v03 crashed")):
        assert log(run, node)[:7] == [*common, ends]
        assert "never" not in log(run, node)
    crashes = {event["node"]: event["error"] for event in events(run, "crashed")}
    assert "3" in crashes["v02"]
    assert "-9" in crashes["v03"] and "program0.py" in crashes["v03"]


def test_an_interrupt_that_ends_a_program_is_told_with_its_line(drive: Drive) -> None:
    text = """
        import os, signal, sys, threading, time
        interrupt = lambda: os.kill(os.getpid(), signal.SIGINT)
        if sys.argv[1] == "v01":
            interrupt()
        threading.Timer(0.5, interrupt).start()
        time.sleep(100)
        """
    told = {event["node"]: event for event in events(drive(text, vehicles=2), "crashed")}
    assert {node: each["place"] for node, each in told.items()} == {"v01": "program0.py:3", "v02": "program0.py:7"}
    assert all(each["error"].endswith("ended with 130") for each in told.values())


def test_alarms_ring_by_emulated_time_and_end_a_wait(drive: Drive) -> None:
    run = drive("""
        import signal, time
        def ring(number, frame):
            print(type(number).__name__, f"{time.monotonic():.1f}", signal.getitimer(signal.ITIMER_REAL)[1])
        def stop(number, frame):
            raise TimeoutError
        signal.signal(signal.SIGALRM, ring)
        signal.setitimer(signal.ITIMER_REAL, 0.2, 0.1)
        time.sleep(0.35)
        signal.signal(signal.SIGALRM, stop)
        print(round(signal.setitimer(signal.ITIMER_REAL, 0.5)[0], 2), signal.alarm(1))
        try:
            time.sleep(10)
        except TimeoutError:
            print(f"{time.monotonic():.2f}")
        """)
    assert printed(run) == ["int 0.2 0.1", "int 0.3 0.1", "0.05 1", "1.35"]


def test_a_signal_handler_runs_as_the_main_thread(drive: Drive) -> None:
    run = drive("""
        import signal, threading, time
        lock, own, seen = threading.RLock(), threading.local(), set()
        own.name = "main's"
        def ring(number, frame):
            with lock:
                seen.add((threading.current_thread() is threading.main_thread(), own.name, frame.f_code.co_name))
                now.append(f"{time.monotonic():.1f}")
        now = []
        signal.signal(signal.SIGALRM, ring)
        signal.setitimer(signal.ITIMER_REAL, 0.1, 0.1)
        with lock:
            time.sleep(0.35)
        print(seen, now, threading.active_count())
        for wrong in ((signal.ITIMER_REAL, -1), (77, 1), (signal.ITIMER_REAL, 1, -1)):
            try:
                signal.setitimer(*wrong)
            except signal.ItimerError:
                print("refused")
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(1)
        time.sleep(5)
        """)
    lines = log(run)
    assert lines[:4] == ["{(True, \"main's\", '<module>')} ['0.1', '0.2', '0.3'] 1", *["refused"] * 3]
    crashed = events(run, "crashed")[0]["error"]
    assert "-14" in crashed and "program0.py" in crashed


def test_a_program_waits_for_signals(drive: Drive) -> None:
    run = drive("""
        import signal, threading, time
        def now():
            return f"{time.monotonic():.1f}"
        signal.signal(signal.SIGALRM, lambda number, frame: print("rang", now()))
        signal.setitimer(signal.ITIMER_REAL, 0.1)
        print(signal.pause(), now())
        print(signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGALRM]))
        signal.setitimer(signal.ITIMER_REAL, 0.1)
        print(signal.sigwait([signal.SIGALRM]), now())
        print(signal.sigtimedwait([signal.SIGALRM], 0.2), now())
        signal.setitimer(signal.ITIMER_REAL, 0.1)
        print(signal.sigtimedwait([signal.SIGALRM], 0.2).si_signo, now())
        signal.setitimer(signal.ITIMER_REAL, 0.1)
        time.sleep(0.2)
        print(signal.sigpending(), now())
        print(signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGALRM]), signal.sigpending())
        """)
    alarm = {signal.SIGALRM}
    assert run.verdict == "valid"
    assert printed(run) == [
        "rang 0.1",
        "None 0.1",
        "set()",
        f"{signal.SIGALRM} 0.2",
        "None 0.4",
        "14 0.5",
        f"{alarm} 0.7",
        "rang 0.7",
        f"{alarm} set()",
    ]


def test_output_that_a_program_takes_for_itself_is_its_own(drive: Drive) -> None:
    text = """
        import contextlib, io, sys, time
        def hook(kind, error, trace):
            print("hook", kind.__name__)
        sys.excepthook = hook
        taken = io.StringIO()
        with contextlib.redirect_stdout(taken):
            print("taken", sys.argv[1])
            time.sleep(0.1)
            sys.stdout.write("too")
        sys.stdout = io.StringIO()
        print("swallowed")
        sys.stdout = sys.__stdout__
        print(repr(taken.getvalue()))
        1 / 0
        """
    run = drive(text, vehicles=2)
    for node in ("v01", "v02"):
        assert log(run, node)[:2] == [f"'taken {node}\\ntoo'", "hook ZeroDivisionError"]


def test_child_processes_are_real_and_pools_of_processes_are_threads(drive: Drive) -> None:
    text = """
        import multiprocessing, os, subprocess, threading, time
        from concurrent.futures import ProcessPoolExecutor, as_completed
        def work(number):
            time.sleep(0.01)
            return number * number
        def tell(end):
            time.sleep(0.01)
            lock = threading.Lock()
            end.send((work(3), lock.acquire(False), lock.acquire(False), lock.locked()))
        ours, theirs = multiprocessing.Pipe()
        child = multiprocessing.get_context("fork").Process(target=tell, args=(theirs,))
        child.start()
        print(ours.recv(), time.monotonic())
        child.join()
        os.environ["OWN"] = "own"
        print(subprocess.check_output("echo $OWN $VNET_NODE", shell=True), subprocess.Popen(["true"]).wait())
        with ProcessPoolExecutor(2) as pool:
            jobs = [pool.submit(work, 4)]
            print(list(pool.map(work, range(3))), [job.result() for job in as_completed(jobs)])
        multiprocessing.set_start_method("spawn")
        with multiprocessing.Pool(2) as pool, multiprocessing.get_context().get_context("fork").Pool(2) as other:
            print(pool.map(lambda number: work(number), [5]), other.map(work, [6]))
        """
    run = drive(text, vehicles=2)
    assert log(run, "v02")[-2] == "[25] [36]", "each has a start method of its own"
    lines = [line for line in printed(run) if "child processes" not in line]
    assert lines == ["(9, True, False, True) 0.0", "b'own v01\\n' 0", "[0, 1, 4] [16]", "[25] [36]"]


@pytest.mark.parametrize("way", ["get_context('spawn')", "get_context('forkserver')", "set_start_method('spawn')"])
def test_queues_and_locks_are_of_the_start_method_that_a_program_chooses(drive: Drive, way: str) -> None:
    run = drive(f"""
        import multiprocessing
        def put(queue, event, lock):
            with lock:
                queue.put(7)
            event.set()
        if __name__ == "__main__":
            context = multiprocessing.{way} or multiprocessing
            queue, event, lock = context.Queue(), context.Event(), context.Lock()
            child = context.Process(target=put, args=(queue, event, lock))
            child.start()
            print(queue.get(), event.wait(), context.Value("i", 5).value)
            child.join()
            print(child.exitcode)
        """)
    assert log(run, "v01")[-3:-1] == ["7 True 5", "0"]


@pytest.mark.parametrize("method", ["spawn", "fork"])
def test_zenoh_of_a_child_process_opens_no_session_and_says_that_it_is_outside(drive: Drive, method: str) -> None:
    """It would be a peer of whatever is on the machine's network."""
    text = f"""
        import multiprocessing, subprocess, sys, zenoh
        def open_there(end):
            try:
                zenoh.open(zenoh.Config())
            except Exception as error:
                end.send(str(error))
        if __name__ == "__main__":
            ours, theirs = multiprocessing.Pipe()
            child = multiprocessing.get_context("{method}").Process(target=open_there, args=(theirs,))
            child.start()
            print(ours.recv())
            child.join()
            for _ in range(2):
                code = "import zenoh; zenoh.open(zenoh.Config())"
                command = [sys.executable, "-c", code]
                done = subprocess.run(command, capture_output=True, text=True, env={{"PYTHONPATH": "/nowhere"}})
                print(done.stderr.splitlines()[-1])
        """
    run = drive(text, vehicles=2)
    for node in ("v01", "v02"):
        by_fork, *_, by_run, _, _ = lines = log(run, node)
        assert "outside of the emulation" in by_fork and "opens no session" in by_run
        assert sum("child processes are outside" in line for line in lines) == 1
    assert "VNET_OUTSIDE" not in os.environ


def test_a_program_that_ignores_its_end_is_ended(drive: Drive) -> None:
    run = drive("""
        import queue, sys, threading, time, zenoh
        session, items = zenoh.open(zenoh.Config()), queue.Queue()
        def work(wait):
            while True:
                try:
                    session.put("a", "b")
                    wait()
                except:
                    pass
        for wait in (lambda: time.sleep(0.1), lambda: items.get(timeout=0.1), session.declare_subscriber("b").recv):
            threading.Thread(target=work, args=(wait,)).start()
        """)
    assert run.verdict == "valid"


def test_configuration_of_a_session_counts_or_is_refused_by_name(
    drive: Drive, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RUST_BACKTRACE", "1")  # with which the last one crashed the process
    run = drive("""
        import time, zenoh
        def config(key, value):
            config = zenoh.Config()
            config.insert_json5(key, value)
            return config
        session = zenoh.open(config("queries_default_timeout", "300"))
        kept = session.declare_queryable("asked")
        print([reply.err.payload.to_string() for reply in session.get("asked")], round(time.monotonic(), 1))
        for key, value in (("namespace", '"cars"'), ("downsampling", "[{}]")):
            try:
                zenoh.open(config(key, value))
            except zenoh.ZError as error:
                print(error)
        print(zenoh.open(config("id", '"ab02"')).zid())
        """)
    assert log(run)[0] == "['Timeout'] 0.3"
    assert log(run)[1].startswith("namespace")
    assert "missing field" in log(run)[2]
    assert log(run)[3] == "ab02"


def test_nothing_is_no_payload(drive: Drive) -> None:
    """As at Zenoh itself, where the end of such a program is seen."""
    run = drive("import zenoh; zenoh.open(zenoh.Config()).put('a', None)")
    assert run.verdict == "invalid"


def test_a_program_has_a_working_directory_and_sleeps_of_its_own(drive: Drive) -> None:
    text = """
        import asyncio, os, select, sys, time, zenoh
        home = os.getcwd()
        folder = os.path.join(os.path.dirname(os.path.abspath(__file__)), sys.argv[1])
        os.mkdir(folder)
        os.chdir(folder)
        session = zenoh.open(zenoh.Config())
        kept = session.declare_subscriber("a", lambda sample: print(os.getcwd() == folder))
        select.select([], [], [], 0.5)
        open("data", "w").close()
        session.put("a", "b")
        time.sleep(0.1)
        print(os.path.exists(os.path.join(folder, "data")), time.monotonic())
        """
    run = drive(text, vehicles=2, radio={"keys": ["none"]})
    for node in ("v01", "v02"):
        assert log(run, node)[:2] == ["True", "True 0.6"]


def test_input_and_output_are_not_closed_by_a_program(drive: Drive) -> None:
    run = drive("""
        import os, sys, time
        os.dup2(os.dup(0), 99, False)
        ends = [lambda: os.close(1), lambda: os.dup2(os.dup(0), fd2=2), lambda: os.closerange(0, 9)]
        sys.stdout.close()
        for end in ends:
            try:
                end()
            except OSError as error:
                print(error)
        try:
            time.sleep(float("nan"))
        except ValueError as error:
            print(error)
        """)
    assert ["virtual time" in line for line in log(run)[:3]] == [True] * 3, log(run)
    assert log(run)[3] == "Invalid value NaN (not a number)"


def test_cancelling_a_query_waits_for_its_callback_and_refuses_the_next(drive: Drive) -> None:
    text = """
        import time, zenoh
        session, done = zenoh.open(zenoh.Config()), []
        kept = session.declare_queryable("asked", lambda query: query.reply("asked", "yes"))
        token = session.liveliness().declare_token("alive")
        def answered(reply):
            time.sleep(0.3)
            done.append(str(reply.ok.key_expr))
        for ask, key in ((session.get, "asked"), (session.liveliness().get, "alive")):
            cancel = zenoh.CancellationToken()
            ask(key, answered, cancellation_token=cancel)
            time.sleep(0.1)
            cancel.cancel()
            print(done, round(time.monotonic(), 1), cancel.is_cancelled)
            try:
                ask(key, cancellation_token=cancel)
            except zenoh.ZError:
                print("refused")
        """
    run = drive(text, radio={"keys": ["none"]})
    assert log(run)[:4] == ["['asked'] 0.3 True", "refused", "['asked', 'alive'] 0.6 True", "refused"]


def test_timestamps_of_one_instant_rise_and_order_replies(drive: Drive) -> None:
    text = """
        import sys, time, zenoh
        session = zenoh.open(zenoh.Config())
        times = [session.new_timestamp() for _ in range(3)]
        print(times[0] < times[1] < times[2])

        def answer(query):
            for number in range(3):
                query.reply(query.key_expr, str(number), timestamp=session.new_timestamp())
            query.drop()

        if sys.argv[1] == "v01":
            session.declare_queryable("count", answer)
            time.sleep(3)
        else:
            time.sleep(0.5)
            print([reply.ok.payload.to_string() for reply in session.get("count", timeout=1) if reply.ok])
        """
    run = drive(text, vehicles=2)
    assert log(run, "v01")[0] == "True"
    assert log(run, "v02")[:2] == ["True", "['2']"]


def test_a_run_is_judged_again_without_its_programs(drive: Drive, tmp_path: Path) -> None:
    run = drive("import zenoh; zenoh.open(zenoh.Config()).put('a', b'x')")
    (tmp_path / "program0.py").unlink()
    assert check_run(run.folder, False, ()).verdict is Verdict.VALID


def test_imports_are_halted_and_locks_are_those_of_threading(drive: Drive) -> None:
    run = drive("""
        import sys
        from _thread import RLock
        with RLock():
            pass
        sys.modules["colorsys"] = None
        try:
            import colorsys
        except ModuleNotFoundError as error:
            print(error)
        """)
    assert log(run)[0] == "import of colorsys halted; None in sys.modules"


def test_a_status_that_is_a_crash_has_the_line_that_gave_it(drive: Drive) -> None:
    run = drive("import sys, zenoh\n\nsys.exit(3)\n")
    (crash,) = events(run, "crashed")
    assert crash["error"].endswith("ended with 3") and 'program0.py", line 3' in crash["where"]


@pytest.mark.parametrize(
    ("declared", "goes_on"),
    [
        ('session.declare_subscriber("a", print)', True),
        ('session.declare_queryable("a", print)', True),
        ('session.liveliness().declare_subscriber("a", print)', True),
        ('(p := session.declare_publisher("a")).declare_matching_listener(print)', True),
        ('session.declare_subscriber("a")', False),
        ('session.declare_subscriber("a", zenoh.handlers.Callback(print, indirect=False))', False),
        ('session.declare_subscriber("a", print).undeclare()', False),
        ('session.declare_subscriber("a", print), session.close()', False),
        ('session.get("nobody", print)', False),
    ],
)
def test_a_program_goes_on_while_callbacks_are_declared(drive: Drive, declared: str, goes_on: bool) -> None:
    """Zenoh calls each in a thread of Python that is no daemon; only to wait for calls is no deadlock."""
    run = drive(f"import zenoh\nsession = zenoh.open(zenoh.Config())\nkept = {declared}\n", duration_s=5.0)
    assert [event["kind"] for event in events(run, "finished")] == ["finished"] * (not goes_on)
    assert events(run, "exception") == events(run, "crashed") == []


def test_what_a_program_leaves_ends_with_it(drive: Drive) -> None:
    """The vehicle's other program goes on: daemons stop where they are, no `finally` runs, sessions are closed."""
    first = """
        import threading, time, zenoh
        session = zenoh.open(zenoh.Config())
        token = session.liveliness().declare_token("token")
        direct = zenoh.handlers.Callback(print, lambda: print("dropped"), indirect=False)
        subscriber = session.declare_subscriber("a", direct)

        def work():
            try:
                while True:
                    time.sleep(0.3)
                    print("working")
            finally:
                print("finally")

        threading.Thread(target=work, daemon=True).start()
        time.sleep(0.5)
        """
    second = """
        import time, zenoh
        session = zenoh.open(zenoh.Config())
        told = session.liveliness().declare_subscriber("token", history=True)
        time.sleep(0.4)
        print(told.recv().kind)
        print(told.recv().kind, time.monotonic())
        time.sleep(1.0)
        session.put("a", b"nobody")
        """
    assert printed(drive(first, second)) == ["working", "SampleKind.PUT", "SampleKind.DELETE 0.5"]


def test_threads_see_the_end_of_the_main_one_before_its_callbacks_end(drive: Drive) -> None:
    run = drive("""
        import threading, time, zenoh
        session = zenoh.open(zenoh.Config())
        kept = session.declare_subscriber("a", print)

        def close_at_the_end():
            while threading.main_thread().is_alive():
                time.sleep(0.1)
            print("closes")
            session.close()

        threading.Thread(target=close_at_the_end, daemon=True).start()
        """)
    assert log(run) == ["closes", "v01 finished"]


@pytest.mark.parametrize("broken", ["import nothing_there", "class : pass"])
def test_the_way_to_a_failed_import_is_the_programs_own(drive: Drive, broken: str) -> None:
    run = drive(f"""
        import pathlib
        pathlib.Path(__file__).with_name("part.py").write_text("{broken}")
        import part
        """)
    (crash,) = events(run, "crashed")
    places = [line for line in crash["where"].splitlines() if line.startswith("  File")]
    assert [line.rpartition("/")[2].partition('"')[0] for line in places[-2:]] == ["program0.py", "part.py"]


def test_programs_that_open_no_session_are_named(drive: Drive) -> None:
    run = drive(
        "import time; time.sleep(9)",
        "print('done')",
        "import zenoh; zenoh.open(zenoh.Config())",
        "raise ValueError",
    )
    lines = [event["text"] for event in events(run, "log")]
    named = [line for line in lines if line.endswith("v01 has opened no Zenoh session")]
    assert len(named) == len(lines) == 2 and "program1.py" in named[0] and "program0.py" in named[1], lines


def test_ids_texts_and_refusals_are_those_of_zenoh(drive: Drive) -> None:
    run = drive("""
        import time, zenoh, zenoh.ext
        session = zenoh.open(zenoh.Config())
        zid, publisher = session.zid(), session.declare_publisher("a")
        print(len(str(zid)), len(bytes(zid)), repr(zid) == str(zid))
        print(str(session) == f"Session(Session {{ id: {zid} }})")
        print(repr(publisher.id) == f"EntityGlobalId {{ zid: {zid}, eid: {publisher.id.eid} }}")
        print(publisher.matching_status)
        for act in (
            lambda: session.put("a", "b", priority=5),
            lambda: session.get("a", target=5),
            lambda: session.declare_querier("a", target=5),
            lambda: zenoh.open("a"),
            lambda: zenoh.open(None),
            publisher.undeclare,
            publisher.undeclare,
            lambda: zenoh.ext.declare_advanced_publisher(session, "a").matching_status,
        ):
            try:
                act()
            except (zenoh.ZError, TypeError, AttributeError) as error:
                print(type(error).__name__, error)
        token = session.liveliness().declare_token("t/a")
        session.liveliness().declare_subscriber("t/*", lambda sample: print(sample.kind), history=True)
        time.sleep(0.1)
        session.close()
        time.sleep(0.1)
        """)
    assert printed(run) == [
        "32 16 True",
        "True",
        "True",
        "MatchingStatus { matching: true }",
        "TypeError argument 'priority': 'int' object cannot be converted to 'Priority'",
        "TypeError argument 'target': 'int' object cannot be converted to 'QueryTarget'",
        "TypeError argument 'target': 'int' object cannot be converted to 'QueryTarget'",
        "TypeError argument 'config': 'str' object cannot be converted to 'Config'",
        "TypeError argument 'config': 'NoneType' object cannot be converted to 'Config'",
        "ZError Undeclared publisher",
        "AttributeError 'AdvancedPublisher' object has no such attribute in Zenoh",
        "SampleKind.PUT",
    ]


def test_a_session_tells_none_that_a_token_is_new_which_it_has_told_one_of_its_subscribers(drive: Drive) -> None:
    """As Zenoh 1.10 does, with which these programs were compared."""
    token = """
        import time, zenoh
        session = zenoh.open(zenoh.Config())
        time.sleep({})
        token = session.liveliness().declare_token("t/a")
        time.sleep(0.3)
        token.undeclare()
        """
    watch = """
        import time, zenoh
        session = zenoh.open(zenoh.Config())
        time.sleep(0.2)
        declare = session.liveliness().declare_subscriber
        held = [declare("t/*", lambda sample, name=name: print(name, str(sample.kind)[11:]), history=name == "all")
                for name in {}]
        time.sleep(0.8)
        """
    run = drive(token.format(0.1), token.format(0.3), watch.format(["all", "new"]), duration_s=3.0)
    assert printed(run) == ["all PUT", "all DELETE", "new DELETE"]
    run = drive(token.format(0.1), token.format(0.3), watch.format(["new"]), duration_s=3.0)
    assert printed(run) == ["new PUT", "new DELETE"]


def test_a_session_undeclares_what_it_has_declared_which_then_shows_nothing(drive: Drive) -> None:
    """As Zenoh 1.10 does, with which this program was compared."""
    run = drive("""
        import time, zenoh
        session = zenoh.open(zenoh.Config())
        held = []

        def answer(query):
            held.append(query)
            with query:
                query.reply(query.key_expr, "there")

        entities = {
            "subscriber": session.declare_subscriber("a/b", lambda sample: print("heard")),
            "queryable": session.declare_queryable("a/b", answer),
            "publisher": session.declare_publisher("a/b"),
            "querier": session.declare_querier("a/b"),
            "token": session.liveliness().declare_token("t/a"),
        }
        session.liveliness().declare_subscriber("t/*", lambda sample: print(sample.kind))
        print([reply.ok.payload.to_string() for reply in session.get("a/b")])

        def attempt(act):
            try:
                act()
            except (zenoh.ZError, AttributeError) as error:
                print(type(error).__name__, str(error).partition(':')[0])

        for name in ("selector", "key_expr", "parameters", "payload", "encoding", "attachment", "source_info"):
            attempt(lambda: getattr(held[0], name))
        for entity in entities.values():
            session.undeclare(entity)
            attempt(lambda: session.undeclare(entity))
            for name in ("id", "key_expr") if entity is not entities["token"] else ():
                attempt(lambda: getattr(entity, name))
        session.put("a/b", "x")
        print([reply.ok for reply in session.get("a/b", timeout=0.1)])
        key = session.declare_keyexpr("k/k")
        session.undeclare(key)
        for what in (zenoh.KeyExpr("x/y"), "k/k", 3):
            attempt(lambda: session.undeclare(what))
        time.sleep(0.1)
        session.close()
        attempt(lambda: session.declare_keyexpr("k/k"))
        """)
    lines = printed(run)
    assert lines[0] == "['there']" and lines[1:8] == ["ZError Dropped query"] * 7
    for place, name in enumerate(["subscriber", "queryable", "publisher", "querier"]):
        assert lines[8 + 3 * place : 11 + 3 * place] == [f"ZError Undeclared {name}"] * 3
    assert lines[20:] == [
        "ZError Undeclared LivelinessToken", "SampleKind.DELETE", "[None]", "ZError Failed to undeclare x/y",
        "ZError Failed to undeclare k/k",
        "AttributeError 'int' object has no attribute 'undeclare'", "ZError session closed",
    ]  # fmt: skip


def test_the_end_of_a_run_is_no_failure_of_a_thread(drive: Drive) -> None:
    run = drive("""
        import threading, time
        threading.excepthook = lambda failed: print("failed", failed.exc_type.__name__)
        threading.Thread(target=lambda: 1 / 0).start()
        threading.Thread(target=lambda: time.sleep(9), daemon=True).start()
        time.sleep(9)
        """)
    assert log(run) == ["failed ZeroDivisionError"]


def test_the_end_of_a_run_is_no_failure_of_a_task_that_blocks(drive: Drive) -> None:
    """A coroutine that waits for a channel, and so holds its loop up, as public programs have them."""
    run = drive("""
        import asyncio, zenoh

        async def watch(subscriber):
            for sample in subscriber:
                print("heard")

        async def main():
            session = zenoh.open(zenoh.Config())
            asyncio.create_task(watch(session.declare_subscriber("a")))
            print("begins", flush=True)
            await asyncio.sleep(9)

        asyncio.run(main())
        """)
    assert log(run) == ["begins"]


def test_a_command_may_name_a_folder_and_no_archive(drive: Drive, tmp_path: Path) -> None:
    folder, archive = tmp_path / "car", tmp_path / "car.pyz"
    folder.mkdir()
    (folder / "wheel.py").write_text("SIZE = 3\n")
    (folder / "__main__.py").write_text("import sys, wheel\nprint(sys.argv, __file__, wheel.SIZE)\n")
    run = drive(program={"command": ["python", str(folder), "{id}"]})
    assert log(run)[0] == f"{[str(folder), 'v01']} {folder / '__main__.py'} 3"
    create_archive(folder, archive)
    beside = tmp_path / "beside.toml"
    beside.write_text('network.vehicles = 1\nprogram = { kind = "zenoh", command = ["python", "car"] }\n')
    found = emulator.simulate(beside, duration_s=1, set={"run.settle_s": 0}, out=tmp_path / "beside")
    assert log(found)[0].endswith(" 3"), "it is looked for beside the scenario, as a script is"
    (crash,) = events(drive(program={"command": ["python", str(archive)]}), "crashed")
    assert "car.pyz': no script in Python" in crash["error"]


@pytest.mark.parametrize(
    ("words", "fault", "text"),
    [
        (["python", "-W", "ignore", "talker.py"], [], "in lockstep a command is .*, perhaps with -B -E"),
        (["python", "-O", "talker.py"], [], "python SCRIPT …"),
        (["python3", "-um", "talker"], [], "python SCRIPT"),
        (["python", "-m"], [], "python SCRIPT"),
        (["ruby", "talker.rb"], [], "python SCRIPT"),
        (
            ["/elsewhere/.venv/bin/python3.12", "a.py"],
            [{"kind": "router_restart", "at_s": 1.0, "down_s": 0.5}],
            'router_restart" needs',
        ),
    ],
)
def test_what_virtual_time_does_not_have_is_refused_when_the_scenario_is_read(
    words: list[str], fault: list[dict[str, Any]], text: str
) -> None:
    with pytest.raises(ValueError, match=text):
        Scenario.model_validate({"program": {"kind": "zenoh", "command": words}, "fault": fault})


@pytest.mark.parametrize(
    ("held", "handled"),
    [
        ("asyncio.create_task(fails())", False),
        ("asyncio.get_running_loop().run_in_executor(None, int, 'x')", False),
        ("asyncio.create_task(fails())", True),
        ("asyncio.get_running_loop().set_exception_handler(print) or asyncio.create_task(fails())", True),
    ],
)
def test_what_has_failed_in_a_task_that_the_program_holds_is_judged_at_its_end(
    drive: Drive, held: str, handled: bool
) -> None:
    text = f"""
        import asyncio
        async def fails():
            raise LookupError("fails")
        async def main():
            global task
            task = {held}
            await asyncio.sleep(1)
            {"await asyncio.wait([task]); task.exception()" if handled and "print" not in held else ""}
        asyncio.run(main())
        """
    assert bool(events(drive(text), "exception")) is not handled


def test_who_matches_is_told_as_by_zenoh_itself(drive: Drive) -> None:
    """Zenoh 1.10.2: of queryables of others those that answer all keys, of one's own those that answer some."""
    run = drive(
        """
        import zenoh
        one, other = zenoh.open(zenoh.Config()), zenoh.open(zenoh.Config())
        targets = zenoh.QueryTarget.BEST_MATCHING, zenoh.QueryTarget.ALL_COMPLETE
        queriers = [one.declare_querier("a/*", target=target) for target in targets]
        publisher = one.declare_publisher("a/x")
        for session in other, one:
            for key, complete in ("a/*", False), ("a/**", True), ("a/x", True):
                for origin in zenoh.Locality.ANY, zenoh.Locality.SESSION_LOCAL:
                    with session.declare_queryable(key, print, complete=complete, allowed_origin=origin):
                        print(*[int(each.matching_status.matching) for each in queriers], end=" ")
                    with session.declare_subscriber(key, print, allowed_origin=origin):
                        print(int(publisher.matching_status.matching))
        """,
        radio={"keys": []},
    )
    others, own = ["1 0 1", "0 0 0", "1 1 1", "0 0 0", "0 0 1", "0 0 0"], ["1 0 1", "1 1 1", "1 0 1"]
    assert printed(run) == [*others, *(line for line in own for _ in range(2))]


def test_what_is_closed_ends_what_waits_as_at_zenoh_itself(drive: Drive) -> None:
    run = drive("""
        import threading, time, zenoh
        def say(*words):
            print(f"{time.monotonic():.1f}", *words)
        def told(name):
            return zenoh.handlers.Callback(lambda item: None, lambda: say("dropped", name))
        asked, session, held = zenoh.open(zenoh.Config()), zenoh.open(zenoh.Config()), []
        asked.declare_queryable("slow", held.append)
        publisher = session.declare_publisher("a")
        publisher.declare_matching_listener(told("first listener"))
        publisher.undeclare()
        time.sleep(0.1)
        session.get("slow", told("get"), timeout=3)
        replies = session.get("slow", timeout=3)
        left = session.declare_publisher("a")
        left.declare_matching_listener(told("listener"))
        session.declare_subscriber("a", told("subscriber"))
        time.sleep(0.4)
        session.close()
        say("closed", list(replies))

        session = zenoh.open(zenoh.Config())
        for declare in (session.declare_subscriber, session.declare_queryable):
            channel = declare("b")
            thread = threading.Thread(target=lambda: say(type(channel.recv()).__name__))
            thread.start()
            time.sleep(0.1)
            try:
                channel.undeclare()
            except RuntimeError as error:
                say(error)
            asked.put("b", "x")
            asked.get("b")
            thread.join()
            channel.undeclare()
            for use in (channel.recv, channel.try_recv, lambda: channel.handler, channel.undeclare):
                try:
                    use()
                except zenoh.ZError as error:
                    print(error)
        """)
    first, *drops, closed = log(run)[:5]
    assert first == "0.0 dropped first listener"
    assert sorted(drops) == [f"0.5 dropped {name}" for name in ("get", "listener", "subscriber")]
    assert closed == "0.5 closed []"
    lines = [line for line in printed(run)[5:] if "warning: undeclare()" not in line]
    assert len(lines) == len(printed(run)) - 7, "each undeclare() under a reader is told"
    assert [line[4:] for line in lines if line[0] == "0"] == [
        *("Already borrowed", "Sample"),
        *("Already borrowed", "Query"),
    ]
    assert [line for line in lines if line[0] != "0"] == ["Undeclared subscriber"] * 4 + [
        "Undeclared queryable"
    ] * 4


@pytest.mark.parametrize(
    ("callback", "error", "place", "printed"),
    [
        (
            "lambda sample: print(1 / int(sample.payload.to_string()))",
            "ZeroDivisionError",
            "in a callback",
            ["1.0", "0.5"],
        ),
        ("lambda sample: sys.exit(5)", "SystemExit(5)", "in a callback", []),
        ("cancelled", "CancelledError", "in a callback", []),
        ("aborted", "GeneratorExit", "in a callback", []),
        ("lambda: None", "TypeError", "program0.py:9", []),
    ],
)
def test_a_callback_that_fails_is_told_and_zenoh_goes_on(
    drive: Drive, callback: str, error: str, place: str, printed: list[str]
) -> None:
    run = drive(f"""
        import asyncio, sys, time, zenoh
        def cancelled(sample):
            asyncio.run(asyncio.sleep(0.01))
            raise asyncio.CancelledError
        def aborted(sample):
            raise GeneratorExit
        session = zenoh.open(zenoh.Config())
        session.declare_subscriber("a", {callback})
        session.declare_subscriber("a", lambda sample: print("another", sample.payload.to_string()))
        for number in ("1", "0", "2"):
            session.put("a", number)
        time.sleep(0.1)
        print("goes on")
        """)
    told = events(run, "exception")
    assert len(told) == 3 - len(printed)
    assert error in told[0]["error"] and place in told[0]["place"]
    assert {*printed, "another 1", "another 0", "another 2", "goes on"} <= set(
        log(run)
    ) and run.verdict == "invalid"


def test_what_the_program_lets_go_of_has_ended_as_at_zenoh_itself(drive: Drive) -> None:
    """Sessions, queriers and advanced publishers end what they do; rings of what has ended are lost."""
    text = """
        import time, zenoh
        from zenoh import *
        from zenoh.ext import CacheConfig, declare_advanced_publisher
        from zenoh.handlers import RingChannel
        def say(*words):
            print(f"{time.monotonic():.1f}", *words)
        def talker():
            session = zenoh.open(Config())
            session.declare_subscriber("a", lambda sample: say("heard by nobody's session"))
            return session.declare_publisher("a"), session.declare_subscriber("a")
        def cache():
            declare_advanced_publisher(session, "c", cache=CacheConfig(3)).put("x")
        def answer(query):
            time.sleep(0.1)
            query.reply("q", "x")
        publisher, subscriber = talker()
        config = Config()
        config.insert_json5("timestamping/enabled", "true")
        session, other = zenoh.open(config), zenoh.open(Config())
        session.put("a", "x")
        for use in (lambda: publisher.put("x"), subscriber.recv):
            try:
                use()
            except ZError as error:
                say(error)
        queryable = session.declare_queryable("q", answer)
        querier, told = other.declare_querier("q"), other.declare_querier("q")
        say(len(list(querier.get())), len(list(other.declare_querier("q").get())))
        told.declare_matching_listener(lambda status: None)
        replies, told = told.get(), None
        say(len(list(replies)), len(list(session.get("q", RingChannel(3)))), "for a reader that waits")
        held = [zenoh.open(Config())]
        held[0].declare_queryable("late", lambda query: (time.sleep(0.1), query.reply("late", "x")))
        replies = other.get("late", allowed_destination=Locality.REMOTE)
        time.sleep(0.05)
        held.clear()
        say(len(list(replies)), "of who has ended")
        cache()
        say(len(list(other.get("c/@adv/**", consolidation=ConsolidationMode.NONE))))
        ring = session.declare_subscriber("r", RingChannel(2))
        reader = ring.handler
        session.put("r", "x")
        ring.undeclare()
        try:
            reader.try_recv()
        except ZError as error:
            say(error)
        """
    run = drive(text, program={"zenoh": {"query_s": 0.3}})
    assert [line.split(" ", 1)[1] for line in printed(run)] == [
        "session closed", "channel is empty and closed", "1 0", "0 1 for a reader that waits",
        "0 of who has ended", "0", "The ringbuffer has been deleted",
    ]  # fmt: skip


def test_a_session_in_a_cycle_ends_as_it_is_collected_and_leaves_others_alone(drive: Drive) -> None:
    run = drive("""
        import gc, time, zenoh
        class Agent:
            def __init__(self):
                self.me, self.session = self, zenoh.open(zenoh.Config())
                self.token = self.session.liveliness().declare_token("agent/first")
        session = zenoh.open(zenoh.Config())
        tell = lambda sample: print(sample.key_expr, sample.kind)
        watching = session.liveliness().declare_subscriber("agent/*", tell)
        Agent()
        time.sleep(0.1)
        gc.collect()
        time.sleep(0.1)
        later = session.liveliness().declare_token("agent/later")
        time.sleep(0.1)
        """)
    told = ["first SampleKind.PUT", "first SampleKind.DELETE", "later SampleKind.PUT"]
    assert printed(run) == [f"agent/{each}" for each in told]


SLOW = """
    import sys, time, zenoh
    from zenoh.handlers import Callback, FifoChannel

    heard = {"slow": [], "fast": []}

    def slow(sample):
        heard["slow"].append(f"{time.monotonic():.1f}")
        time.sleep(0.2)

    here, there = (zenoh.open(zenoh.Config.from_env()) for _ in range(2))
"""


@pytest.mark.parametrize(
    ("handler", "samples", "at_once", "slow", "last_s"),
    [
        ("slow", 10, 10, 10, "0.0"),
        ("slow", 300, 257, 300, "8.6"),
        ("Callback(slow, indirect=False)", 10, 0, 10, "2.0"),
        ("FifoChannel(3)", 10, 3, 0, "0.0"),
        ("None", 300, 256, 0, "0.0"),
        ("zenoh.handlers.RingChannel(3)", 300, 300, 0, "0.0"),
    ],
)
def test_what_takes_no_more_stops_its_session_as_at_zenoh_itself(
    drive: Drive, handler: str, samples: int, at_once: int, slow: int, last_s: str
) -> None:
    program = f"""
        first = there.declare_subscriber("k", {handler})
        there.declare_subscriber("k", lambda sample: heard["fast"].append(f"{{time.monotonic():.1f}}"))
        for number in range({samples}):
            here.put("k", str(number))
        time.sleep(70)
        print(heard["fast"].count("0.0"), len(heard["slow"]), heard["fast"][-1])
        if not heard["slow"] and len(heard["fast"]) < {samples}:
            before = len(heard["fast"])
            print(first.recv().payload.to_string())
            time.sleep(0.1)
            print(len(heard["fast"]) - before)
        """
    run = drive(dedent(SLOW) + dedent(program), duration_s=80.0, radio={"keys": ["none"]})
    more = ["0", "1"] if not slow and at_once < samples else []
    assert printed(run) == [f"{at_once} {slow} {last_s}", *more]


def test_who_puts_into_a_full_channel_of_the_same_session_waits(drive: Drive) -> None:
    run = drive(
        dedent(SLOW)
        + dedent("""
        import threading
        channel, puts = here.declare_subscriber("k"), []
        def put():
            for number in range(300):
                here.put("k", str(number))
                puts.append(number)
        threading.Thread(target=put).start()
        time.sleep(0.1)
        print(len(puts), channel.recv().payload.to_string())
        time.sleep(0.1)
        print(len(puts))
        there.declare_subscriber("d", Callback(slow, indirect=False))
        there.put("d", "")
        print(heard["slow"], f"{time.monotonic():.1f}")
        channel.undeclare()
        """)
    )
    assert printed(run) == ["256 0", "257", "['0.2'] 0.4"]


def test_queries_that_lie_unread_are_concluded_when_their_queryable_is_undeclared(drive: Drive) -> None:
    run = drive("""
        import threading, time, zenoh
        here, there = (zenoh.open(zenoh.Config.from_env()) for _ in range(2))
        queryable = here.declare_queryable("k", zenoh.handlers.FifoChannel(3))
        threading.Timer(0.3, queryable.undeclare).start()
        print(list(there.get("k", timeout=5)), f"{time.monotonic():.1f}")
        """)
    assert printed(run) == ["[] 1.0"], "of other vehicles it hears for radio.query_s"


def test_a_full_channel_that_is_undeclared_lets_all_go_on_that_wait(drive: Drive) -> None:
    run = drive("""
        import threading, time, zenoh
        session, done = zenoh.open(zenoh.Config.from_env()), []
        channel = session.declare_subscriber("k", zenoh.handlers.FifoChannel(1))
        def put(number):
            for _ in range(2):
                session.put("k", "")
            done.append(number)
        for number in range(3):
            threading.Thread(target=put, args=[number]).start()
        time.sleep(0.1)
        print(done)
        channel.undeclare()
        time.sleep(0.1)
        print(sorted(done))
        """)
    assert printed(run) == ["[]", "[0, 1, 2]"]


def test_a_querier_that_is_undeclared_ends_its_queries(drive: Drive) -> None:
    run = drive("""
        import time, zenoh
        session, held = zenoh.open(zenoh.Config.from_env()), []
        queryable = session.declare_queryable("q", held.append)
        querier = session.declare_querier("q", timeout=3.0)
        channel = querier.get()
        querier.get(zenoh.handlers.Callback(print, lambda: print("dropped", time.monotonic())))
        time.sleep(0.5)
        querier.undeclare()
        print(list(channel))
        time.sleep(0.1)
        publisher = session.declare_publisher("p")
        for _ in range(50):
            publisher.declare_matching_listener(lambda status: None).undeclare()
        print(len(publisher._ends))
        try:
            publisher.declare_matching_listener(3)
        except ValueError as error:
            print(error)
        """)
    assert printed(run) == ["[]", "dropped 0.5", "0", "Invalid handler type int"]


def test_a_get_as_long_as_replies_are_awaited_does_not_time_out(drive: Drive) -> None:
    text = """
        import sys, time, zenoh
        session = zenoh.open(zenoh.Config.from_env())
        if sys.argv[1] == "v01":
            session.declare_queryable("q", lambda query: query.reply("q", "yes"))
            time.sleep(1.9)
        else:
            time.sleep(0.1)
            print([reply.ok and reply.ok.payload.to_string() for reply in session.get("q", timeout=1.0)])
        """
    run = drive(text, vehicles=2)
    assert log(run, "v02")[0] == "['yes']"


def test_timers_ring_at_fractions_of_a_second_again_and_again(drive: Drive) -> None:
    text = """
        import signal, time
        signal.signal(signal.SIGALRM, lambda number, frame: print("rings", time.monotonic()))
        signal.setitimer(signal.ITIMER_REAL, 1.5, 1.5)
        time.sleep(3.2)
        left = [round(each, 3) for each in signal.setitimer(signal.ITIMER_REAL, 0)]
        print(left, signal.alarm(1), signal.alarm(0))
        time.sleep(2)
        """
    run = drive(text, duration_s=6.0)
    assert printed(run) == ["rings 1.5", "rings 3.0", "[1.3, 1.5] 0 1"]
