"""Threads, clocks and chance of programs on virtual time."""

import datetime
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from textwrap import dedent

import pytest

from emulator.records.tape import TAPE_FILE, described, read_tape
from tests.vnet.gateway.conftest import Drive, events, log, printed

pytestmark = pytest.mark.slow


def test_threads_wait_on_emulated_time_for_queues_locks_events_and_each_other(drive: Drive) -> None:
    run = drive("""
        import queue, threading, time
        started = time.monotonic()
        items, lock, over = queue.Queue(maxsize=1), threading.RLock(), threading.Event()

        def produce():
            for number in range(3):
                time.sleep(0.25)
                items.put(number)
            over.set()

        def consume():
            while not (over.is_set() and items.empty()):
                try:
                    with lock, lock:
                        print(items.get(timeout=0.2), f"{time.monotonic() - started:.2f}")
                except queue.Empty:
                    print("nothing", f"{time.monotonic() - started:.2f}")

        threads = [threading.Thread(target=each, name=each.__name__) for each in (produce, consume)]
        for thread in threads:
            thread.start()
        print([thread.name for thread in threading.enumerate()])
        for thread in threads:
            thread.join()
        print("joined", f"{time.monotonic() - started:.2f}", threading.active_count())
        """)
    assert run.verdict == "valid"
    assert printed(run) == [
        "['MainThread', 'produce', 'consume']", "nothing 0.20", "0 0.25", "nothing 0.45", "1 0.50",
        "nothing 0.70", "2 0.75", "joined 0.75 1",
    ]  # fmt: skip
    assert "finished" in log(run)[-1]


def test_conditions_barriers_semaphores_timers_locals_and_pools_work(drive: Drive) -> None:
    run = drive("""
        import concurrent.futures, threading, time
        barrier, condition, local = threading.Barrier(3), threading.Condition(), threading.local()
        slots, order = threading.BoundedSemaphore(2), []

        def work(number):
            local.number = number
            with slots:
                time.sleep(0.1)
            barrier.wait()
            with condition:
                order.append(local.number)
                condition.notify_all()
            return number * number

        with concurrent.futures.ThreadPoolExecutor(3) as pool:
            jobs = [pool.submit(work, number) for number in range(3)]
            with condition:
                condition.wait_for(lambda: len(order) == 3)
            print(sorted(order), [job.result() for job in jobs], hasattr(local, "number"))
        print(list(concurrent.futures.ThreadPoolExecutor().map(work, range(3))), round(time.perf_counter(), 3))
        timer = threading.Timer(0.3, print, ["timer"])
        timer.start()
        """)
    assert printed(run) == ["[0, 1, 2] [0, 1, 4] False", "[0, 1, 4] 0.4", "timer"]


def test_asyncio_program_runs_with_threads_timeouts_and_executor(drive: Drive) -> None:
    before = signal.getsignal(signal.SIGINT)
    run = drive("""
        import asyncio, signal, time

        async def tick(name, period):
            for number in range(2):
                await asyncio.sleep(period)
                print(name, number, round(asyncio.get_running_loop().time(), 2))

        async def main():
            loop = asyncio.get_running_loop()
            loop.add_signal_handler(signal.SIGINT, loop.stop)
            async with asyncio.TaskGroup() as tasks:
                tasks.create_task(tick("a", 0.1))
                tasks.create_task(tick("b", 0.15))
                await asyncio.to_thread(time.sleep, 0.05)
                print("slept", round(loop.time(), 2))
            queue = asyncio.Queue()
            await loop.run_in_executor(None, lambda: loop.call_soon_threadsafe(queue.put_nowait, "put"))
            print(await queue.get())
            try:
                await asyncio.wait_for(queue.get(), 0.5)
            except TimeoutError:
                print("timeout", round(loop.time(), 2))
            time.sleep(0.1)
            endless = asyncio.create_task(asyncio.sleep(1e6))
            print(len(asyncio.all_tasks()))
            return endless

        left = asyncio.run(main())
        print(left.cancelled(), round(time.monotonic(), 2))
        loop = asyncio.new_event_loop()
        print(loop.run_until_complete(asyncio.sleep(0.1, "slept")))
        try:
            asyncio.get_running_loop()
        except RuntimeError as error:
            print(error)
        """)
    assert signal.getsignal(signal.SIGINT) is before, "signals of the process are not the program's"
    assert printed(run) == [
        "slept 0.05", "a 0 0.1", "b 0 0.15", "a 1 0.2", "b 1 0.3", "put", "timeout 0.8", "2", "True 0.9",
        "slept", "no running event loop",
    ]  # fmt: skip


def test_asyncio_is_pythons_own(drive: Drive) -> None:
    """A coroutine that blocks holds up its loop, which closes generators and takes signals."""
    run = drive("""
        import asyncio, os, signal, threading, time

        async def numbers():
            try:
                while True:
                    yield 1
            finally:
                await asyncio.sleep(0.1)
                print("closed", round(time.monotonic(), 2))

        async def main():
            loop = asyncio.get_running_loop()
            tick = asyncio.create_task(asyncio.sleep(0.1, "tick"))
            await asyncio.sleep(0)
            time.sleep(0.5)
            print(await tick, round(loop.time(), 2))
            async for number in numbers():
                break
            tasks = {asyncio.create_task(asyncio.sleep(0, number)) for number in range(20)}
            print([await each for each in asyncio.as_completed(tasks)] == list(range(20)))
            told = asyncio.Event()
            loop.add_signal_handler(signal.SIGTERM, told.set)
            threading.Timer(0.3, os.kill, [os.getpid(), signal.SIGTERM]).start()
            threading.Thread(target=asyncio.run, args=[asyncio.sleep(0.1)]).start()
            await told.wait()
            print("told", round(loop.time(), 2), loop.remove_signal_handler(signal.SIGTERM))
            asyncio.create_task(fail())
            await asyncio.sleep(0)
            try:
                await asyncio.open_connection("localhost", 1)
            except Exception as error:
                print("refused" if "sockets" in str(error) else error)
            await asyncio.sleep(100)

        async def fail():
            1 / 0

        asyncio.run(main())
        """)
    assert log(run)[:4] == ["tick 0.5", "True", "closed 0.6", "told 0.8 True"]
    assert "refused" in log(run)
    (told,) = events(run, "exception")
    assert "in a task or a callback of asyncio" in told["place"]


def test_joinable_threads_of_later_pythons_work(drive: Drive) -> None:
    run = drive("""
        import _thread, time
        handles = [_thread.start_joinable_thread(lambda: time.sleep(0.2), daemon=False) for _ in range(2)]
        handles[0].join(0.1)
        print(handles[0].is_done(), round(time.monotonic(), 2))
        handles[0].join()
        print(handles[0].is_done(), handles[0].ident != handles[1].ident, round(time.monotonic(), 2))
        _thread.start_joinable_thread(lambda: time.sleep(0.3), daemon=False)
        _thread._shutdown()
        print(round(time.monotonic(), 2), _thread._make_thread_handle(7).ident, _thread._get_main_thread_ident())
        """)
    assert printed(run) == ["False 0.1", "True True 0.2", "0.5 7 1"]


CHANCE = """
    import datetime, logging, os, random, secrets, sys, time, uuid
    print(random.random(), random.Random().random(), random.SystemRandom().random(), random.Random(1).random())
    print(uuid.uuid4(), uuid.uuid1(), os.urandom(4), secrets.token_hex(4))
    print(time.time(), datetime.datetime.now(), datetime.date.today(), time.strftime("%H:%M:%S"), time.ctime())
    print(isinstance(datetime.datetime.now(), datetime.datetime), sys.argv[1:], __name__)
    print(os.getpid() if os.sched_getaffinity(os.getpid()) else "unknown")
    logging.basicConfig(format="%(asctime)s %(name)s %(message)s", level=logging.INFO)
    time.sleep(0.5)
    logging.getLogger("car").info("moves")
    """


def test_chance_is_the_vehicles_own_and_replays(drive: Drive) -> None:
    first, again = (drive(CHANCE, vehicles=2) for _ in range(2))
    lines = log(first)
    assert lines == log(again)
    other = log(first, "v02")
    assert all(lines[n] != other[n] for n in (0, 1, 4)), "its process has a number of its own, too"
    assert lines[0].endswith("0.13436424411240122"), "a seed of one's own is kept"
    assert lines[2].startswith("1735689600.0 2025-01-01 00:00:00 2025-01-01 00:00:00 Wed Jan  1 00:00:00 2025")
    assert lines[3] == "True ['v01'] __main__"
    assert int(lines[4]) > 1 << 22, "no process of the machine has that number"
    assert lines[5] == "2025-01-01 00:00:00,500 car moves"


@pytest.fixture
def elsewhere(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Another time zone."""
    monkeypatch.setenv("TZ", "EST5")
    time.tzset()
    yield
    monkeypatch.undo()
    time.tzset()


@pytest.mark.usefixtures("elsewhere")
def test_moments_are_of_the_classes_that_compiled_code_looks_for(drive: Drive) -> None:
    run = drive("""
        import datetime, functools, msgspec, pickle, pydantic, time

        class Mine(datetime.datetime):
            @classmethod
            def fromtimestamp(cls, timestamp, tz=None):
                return cls.now(tz)

        class Model(pydantic.BaseModel):
            at: datetime.datetime

        @functools.singledispatch
        def name(value):
            return "object"

        name.register(datetime.datetime, lambda value: "moment")
        now = datetime.datetime.now()
        print(type(now) is datetime.datetime, type(Mine.now()) is Mine, isinstance(now, Mine), name(now), repr(now))
        pickle.loads(pickle.dumps([datetime.datetime.now, datetime.datetime.utcnow, datetime.date.today]))
        print(pickle.loads(pickle.dumps(now)) == now == Model(at=now).at, msgspec.json.encode(now).decode())
        print(datetime.datetime.fromtimestamp(time.time()) - now, type(datetime.date.today()) is datetime.date)
        while datetime.datetime.now() < now + datetime.timedelta(milliseconds=20):
            pass
        print("waited", datetime.datetime.today() >= now + datetime.timedelta(milliseconds=20))
        """)
    assert printed(run) == [
        "True True False moment datetime.datetime(2025, 1, 1, 0, 0)", 'True "2025-01-01T00:00:00"', "0:00:00 True",
        "waited True",
    ]  # fmt: skip
    assert datetime.datetime.now().year > 2025, "of the tests' own"


@pytest.mark.usefixtures("elsewhere")
def test_local_time_is_utc_by_name_too(drive: Drive) -> None:
    run = drive("""
        import datetime, time
        now, zone = time.localtime(), datetime.datetime.now().astimezone().tzname()
        print(time.strftime("%Z"), time.strftime("%Z %z", now), now.tm_zone, *time.tzname, zone)
        print(now == time.gmtime() == time.localtime(time.time()), time.ctime())
        """)
    assert printed(run) == ["UTC UTC +0000 UTC UTC UTC UTC", "True Wed Jan  1 00:00:00 2025"]


def test_modules_beside_the_script_are_each_vehicles_own(drive: Drive, tmp_path: Path) -> None:
    package = tmp_path / "cars"
    package.mkdir()
    (package / "__init__.py").write_text("from . import parts\nfrom .parts import *\nname = None\n")
    (package / "parts.py").write_text(
        "from __future__ import annotations\n"
        "import time, dataclasses\nfrom typing import ClassVar, NamedTuple, TypedDict, get_type_hints\n"
        "class Place(NamedTuple):\n    x: int\n"
        "class Table(TypedDict):\n    x: int\n"
        "__all__ = ['Wheel', 'wait']\n"
        "@dataclasses.dataclass\nclass Wheel:\n    size: int\n    kind: ClassVar[str] = 'round'\n"
        "def wait():\n    time.sleep(0.5)\n    return get_type_hints(Wheel)['size']\n"
    )
    text = """
        import importlib, sys
        import cars.parts
        assert cars.name is None
        cars.name = sys.argv[1]
        print(cars.wait(), importlib.import_module("cars").name, cars.Wheel(3), "cars.parts" in sys.modules)
        """
    run = drive(text, vehicles=2)
    assert log(run)[0] == "<class 'int'> v01 Wheel(size=3) True"
    assert log(run, "v02")[0] == "<class 'int'> v02 Wheel(size=3) True"


def test_modules_that_import_each_other_get_the_programs_own(drive: Drive, tmp_path: Path) -> None:
    package = tmp_path / "round"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "one.py").write_text("from . import two\n")
    (package / "two.py").write_text("from . import one\n")
    (package / "broken.py").write_text("import missing\n")
    run = drive("""
        import asyncio.tasks, sys, types
        import round.one
        for _ in range(2):
            try:
                from round import broken
            except ImportError as error:
                print(error, "round.broken" in sys.modules)
        print(type(round.two.one) is types.ModuleType, round.two.one is sys.modules["round.one"])
        timeouts = sys.modules["asyncio.timeouts"]
        print(timeouts.tasks is asyncio.tasks)
        """)
    assert log(run)[:4] == ["No module named 'missing' False"] * 2 + ["True True", "True"]


def test_classes_made_by_functions_of_typing_work(drive: Drive) -> None:
    run = drive("""
        import typing
        from typing import NamedTuple
        class Pose(NamedTuple):
            x: float
            y: float = 2.0
        class Options(typing.TypedDict, total=False):
            x: float
        print(Pose(1.0)._asdict(), Options(x=3.0))
    """)
    assert log(run)[0] == "{'x': 1.0, 'y': 2.0} {'x': 3.0}"


def test_sys_exit_finishes_or_crashes_by_its_status(drive: Drive) -> None:
    text = "import atexit, sys\natexit.register(print, 'bye')\nsys.exit(int(sys.argv[1] == 'v02') * 3)"
    run = drive(text, vehicles=2)
    (crash,) = events(run, "crashed")
    assert crash["node"] == "v02"
    assert "3" in crash["error"]
    assert log(run)[0] == "bye"


def test_crash_of_main_is_a_crash_of_its_vehicle_with_its_line(drive: Drive) -> None:
    run = drive("import time\ntime.sleep(0.5)\n1 / 0\n")
    (crash,) = events(run, "crashed")
    assert (crash["node"], crash["place"]) == ("v01", "program0.py:3")
    assert "ZeroDivisionError" in crash["error"]
    files = [line.split('"')[1] for line in log(run) if line.startswith("  File")]
    assert [Path(file).name for file in files] == ["program0.py"], "frames of vnet's own tell nothing"


def test_what_is_to_be_done_at_exit_is_done_after_a_failure_and_beside_one(drive: Drive) -> None:
    text = """
        import atexit, sys
        atexit.register(print, "bye")
        atexit.register(sys.exit, 9)
        atexit.register(lambda: 1 / 0)
        1 / (sys.argv[1] == "v01")
        """
    run = drive(text, vehicles=2)
    assert [(event["node"], event["place"]) for event in events(run, "crashed")] == [("v02", "program0.py:6")]
    for node in ("v01", "v02"):
        (told,) = (event for event in events(run, "exception") if event["node"] == node)
        assert "ZeroDivisionError" in told["error"] and "atexit" in str(told)
        assert "bye" in log(run, node)


def test_the_standard_library_has_the_programs_clock_output_and_waits(drive: Drive) -> None:
    run = drive("""
        import contextlib, http.cookies, io, mailbox, pprint, select, selectors, signal, threading, time
        import traceback

        def written(stream, act, *given):
            with getattr(contextlib, f"redirect_{stream}")(io.StringIO()) as into:
                act(*given)
            return bool(into.getvalue())

        print(written("stdout", pprint.pprint, 1), written("stderr", traceback.print_stack))
        cookie = http.cookies.SimpleCookie({"a": "b"})
        cookie["a"]["expires"] = 0
        print("01 Jan 2025" in cookie.output(), mailbox.MaildirMessage().get_date() == time.time())
        for selector in (selectors.DefaultSelector(), selectors.SelectSelector()):
            started = time.monotonic()
            selector.select(0.3)
            print(round(time.monotonic() - started, 2))
        signal.signal(signal.SIGUSR1, lambda *_: print(threading.current_thread() is threading.main_thread()))
        thread = threading.Thread(target=signal.raise_signal, args=(signal.SIGUSR1,))
        thread.start()
        thread.join()
        time.sleep(0.1)
        """)
    assert printed(run) == ["True True", "True True", "0.3", "0.3", "True"]


def test_handlers_of_signals_are_refused_as_by_python(drive: Drive) -> None:
    run = drive("""
        import signal, threading

        def attempt(*given):
            try:
                print(signal.signal(*given))
            except (ValueError, OSError, TypeError) as error:
                print(type(error).__name__)

        for given in ((0, print), (signal.NSIG, print), (signal.SIGKILL, print), (signal.SIGTERM, "handler")):
            attempt(*given)
        thread = threading.Thread(target=attempt, args=(signal.SIGTERM, print))
        thread.start()
        thread.join()
        attempt(signal.SIGTERM, print)
        """)
    refusals = ["ValueError", "ValueError", "OSError", "TypeError", "ValueError"]
    assert printed(run) == [*refusals, str(signal.SIG_DFL)]


def test_crash_of_a_thread_is_told_and_the_program_goes_on(drive: Drive) -> None:
    run = drive("""
        import threading, time
        threading.Thread(target=lambda: 1 / 0).start()
        time.sleep(0.5)
        print("goes on")
        """)
    (told,) = events(run, "exception")
    assert "ZeroDivisionError" in told["error"]
    assert "in a thread" in told["place"]
    assert sum(line.startswith("Traceback") for line in log(run)) == 1
    assert "goes on" in log(run)


def test_deadlock_of_threads_is_found_with_their_lines(drive: Drive) -> None:
    run = drive("""
        import threading, time
        locks = threading.Lock(), threading.Lock()

        def take(first, second):
            with first:
                time.sleep(0.1)
                with second:
                    pass

        threads = [threading.Thread(target=take, args=pair) for pair in (locks, locks[::-1])]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        """)
    (told,) = events(run, "exception")
    assert "DeadlockError" in told["error"]
    assert "program0.py:8" in told["place"]


def test_program_that_does_not_let_time_advance_is_ended(drive: Drive) -> None:
    run = drive("""
        import queue, threading

        def play(take, give):
            while True:
                give.put(take.get())

        here, there = queue.Queue(), queue.Queue()
        threading.Thread(target=play, args=(here, there), daemon=True).start()
        here.put("ball")
        play(there, here)
        """)
    assert [event["node"] for event in events(run, "spun")] == ["v01"]


def test_end_of_the_run_leaves_with_blocks_and_runs_finally(drive: Drive) -> None:
    run = drive("""
        import threading, time, zenoh

        def wait():
            try:
                time.sleep(1e6)
            except Exception:
                print("never")
            finally:
                print("thread over")

        thread = threading.Thread(target=wait)
        thread.start()
        with zenoh.open(zenoh.Config()) as session:
            try:
                while True:
                    try:
                        time.sleep(1e3)
                    except Exception:
                        print("never")
            finally:
                print("main over")
                thread.join()
        """)
    assert run.verdict == "valid"
    assert log(run) == ["thread over", "main over"] or log(run) == ["main over", "thread over"]


def test_kill_pause_and_restart_of_a_vehicle(drive: Drive) -> None:
    text = """
    import threading, time
    def tick(name):
        try:
            while True:
                print(name, round(time.time() % 100, 2), flush=True)
                time.sleep(0.5)
        finally:
            print("never")
    threading.Thread(target=tick, args=("thread",), daemon=True).start()
    tick("main")
    """
    faults = [
        {"kind": "kill", "at_s": 0.7, "duration_s": 1.0, "nodes": ["v01"]},
        {"kind": "pause", "at_s": 2.4, "duration_s": 1.0, "nodes": ["v01"]},
        {"kind": "restart", "at_s": 4.0, "duration_s": 0.5, "nodes": ["v01"]},
    ]
    run = drive(text, duration_s=5.0, fault=faults)
    times = [float(found[1]) for line in log(run) if (found := re.match(r"main (\S+)", line))]
    assert times == [0.0, 0.5, 1.7, 2.2, 3.4, 3.9, 4.5]
    assert log(run).count("never") == 2, "as by SIGTERM, which Python does not handle; the run's end is its own"


@pytest.mark.slow
@pytest.mark.parametrize(
    "begin",
    [
        "asyncio.run(wait())",
        "wait_in_thread()",
        "leave_a_cycle()",
        "asyncio.run(catch_all())",
    ],
)
def test_nothing_of_a_killed_program_is_done_afterwards(tmp_path: Path, begin: str) -> None:
    text = f"""
        import asyncio, os, time

        def over():
            print("never", flush=True)
            os.mkdir("never")

        async def wait():
            try:
                await asyncio.sleep(9)
            finally:
                over()

        def wait_in_thread():
            try:
                time.sleep(9)
            finally:
                over()

        class Cycle:
            def __init__(self):
                self.me = self

            def __del__(self):
                over()

        def leave_a_cycle():
            cycle = Cycle()
            time.sleep(9)

        async def catch_all():
            while True:
                try:
                    await asyncio.sleep(9)
                except BaseException:
                    pass

        {begin}
        """
    (tmp_path / "program.py").write_text(dedent(text))
    (tmp_path / "killed.toml").write_text("""
        run = { duration_s = 1.0, settle_s = 0.0 }
        network.vehicles = 1
        program = { kind = "zenoh", command = ["python", "program.py"] }
        fault = [{ kind = "kill", at_s = 0.7, duration_s = 9.0, nodes = ["v01"] }]
        """)
    command = [sys.executable, "-m", "emulator", "simulate", "killed.toml"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert done.returncode == 3, done.stderr
    assert "never" not in done.stdout + done.stderr and not (tmp_path / "never").exists()


def test_a_finalizer_that_waits_while_its_program_collects_is_nobody_else_s(drive: Drive) -> None:
    text = """
    import gc, sys, time, zenoh
    session = zenoh.open(zenoh.Config.from_env())
    class Robot:
        def __init__(self):
            self.me = self
        def __del__(self):
            session.put("bye", sys.argv[1])
            time.sleep(0.2)
            print("gone")
    if sys.argv[1] == "v01":
        Robot()
        time.sleep(0.2)
        gc.collect()
        print("collected")
    else:
        time.sleep(0.3)
        session.close()
    """
    run = drive(text, vehicles=2)
    assert (run.verdict, printed(run, "v01")[:2]) == ("valid", ["gone", "collected"])
    assert log(run, "v02")[-1].endswith("finished")


def test_a_thread_waits_for_a_module_that_another_executes(drive: Drive, tmp_path: Path) -> None:
    (tmp_path / "slow.py").write_text("import time\ntime.sleep(0.5)\nREADY = 7\n")
    (tmp_path / "one.py").write_text("import time\ntime.sleep(0.1)\nimport two\n")
    (tmp_path / "two.py").write_text("import time\ntime.sleep(0.1)\nimport one\n")
    run = drive("""
        import threading, time
        def load(name):
            time.sleep(0.1)
            import slow
            print(name, slow.READY, round(time.monotonic(), 1))
        threads = [threading.Thread(target=load, args=[n]) for n in range(2)]
        for thread in threads:
            thread.start()
        import slow
        for thread in threads:
            thread.join()
        circle = threading.Thread(target=__import__, args=["two"])
        circle.start()
        import one
        circle.join()
        print("done", round(time.monotonic(), 1))
        """)
    assert printed(run) == ["0 7 0.5", "1 7 0.5", "done 0.6"]


def test_clock_error_of_a_vehicle_is_that_of_its_program(drive: Drive) -> None:
    """A skew sets the time of day alone, a drift is that of all clocks and waits."""
    text = """
    import asyncio, time
    def show(name):
        print(name, round(time.time() % 100, 3), round(time.monotonic(), 3))
    async def main():
        for seconds in (0.5, 2.0, 2.5):
            asyncio.get_running_loop().call_later(seconds, show, seconds)
        await asyncio.sleep(3.0)
    show("begin")
    asyncio.run(main())
    time.sleep(1.0)
    show("end")
    """
    faults = [
        {"kind": "skew", "at_s": 0.2, "duration_s": 1.0, "nodes": ["v01"], "offset_ms": 250.0},
        {"kind": "drift", "at_s": 2.0, "duration_s": 4.0, "nodes": ["v01"], "rate_ppm": 100_000},
    ]
    run = drive(text, duration_s=5.0, fault=faults)
    assert printed(run) == ["begin 0.0 0.0", "0.5 0.75 0.5", "2.0 2.0 2.0", "2.5 2.5 2.5", "end 4.0 4.0"]


def test_a_program_that_waits_busily_comes_to_its_time(drive: Drive) -> None:
    run = drive("import time\nend = time.monotonic() + 0.05\nwhile time.monotonic() < end: pass\nprint('done')")
    assert log(run)[0] == "done"
    (end,) = events(run, "finished")
    assert 0.05 <= end["time_ns"] / 1e9 < 0.052


def test_options_of_python_that_change_nothing_are_no_script(drive: Drive, tmp_path: Path) -> None:
    (tmp_path / "hello.py").write_text("import sys; print(sys.argv[1:])")
    command = ["/elsewhere/bin/python", "-u", "-B", str(tmp_path / "hello.py"), "{id}"]
    run = drive(program={"command": [command]})
    assert f"/elsewhere/bin/python is taken for {sys.executable}" in log(run)[0]
    assert log(run)[1] == "['v01']"


def test_a_command_is_told_an_endpoint_which_its_sessions_do_not_need(drive: Drive) -> None:
    text = (
        "import json, os, sys, zenoh; config = zenoh.Config(); "
        "config.insert_json5('connect/endpoints', json.dumps([sys.argv[2]])); zenoh.open(config).close(); "
        "print(sys.argv[1], sys.argv[2].endswith(':' + sys.argv[3]), sys.argv[2] == os.environ['VNET_ENDPOINT'])"
    )
    run = drive(program={"command": ["python", "-c", text, "{id}", "{endpoint}", "{port}"]}, duration_s=0.2)
    assert log(run)[0] == "v01 True True"


def test_the_words_of_a_command_are_read_by_the_standard_library_too(drive: Drive) -> None:
    text = """
        import argparse, fileinput, optparse
        parser = argparse.ArgumentParser()
        parser.add_argument("name")
        print(parser.prog, parser.parse_args().name, optparse.OptionParser().parse_args()[1])
        print(fileinput.input().__dict__["_files"])
        """
    assert log(drive(text))[:2] == ["program0.py v01 ['v01']", "('v01',)"]


def test_a_module_of_a_program_is_loaded_again(drive: Drive, tmp_path: Path) -> None:
    (tmp_path / "settings.py").write_text("import time\nnumber = int(10 * time.monotonic())\n")
    run = drive("""
        import importlib, json, settings, time
        from importlib import reload
        before = settings.number
        time.sleep(0.5)
        print(before, importlib.reload(settings) is settings, settings.number, reload(json) is json)
        with open(settings.__file__, "w") as file:
            file.write("1 / 0")
        try:
            reload(settings)
        except ZeroDivisionError:
            print(importlib.import_module("settings") is settings)
        """)
    assert log(run)[:2] == ["0 True 5 True", "True"]


def test_a_program_that_puts_without_a_pause_comes_to_the_end_of_the_run(drive: Drive) -> None:
    """As Zenoh's `z_pub_thr`; its own subscriber hears all, and other vehicles what the radio's queue takes."""
    text = """
        import zenoh
        session, heard = zenoh.open(zenoh.Config()), []
        subscriber = session.declare_subscriber("flood", lambda sample: heard.append(sample.payload.to_string()))
        publisher = session.declare_publisher("flood")
        try:
            while True:
                publisher.put(str(len(heard)))
        finally:
            print(len(heard) // 1000)
        """
    run = drive(text, duration_s=0.02)
    assert run.verdict != "invalid"
    assert log(run)[0] in ("19", "20")


def test_locks_of_multiprocessing_wait_on_emulated_time(drive: Drive) -> None:
    run = drive("""
        import multiprocessing, threading, time
        def begin(*shared):
            global lock, event, value
            lock, event, value = shared
        def work(number):
            event.wait()
            with lock, value.get_lock():
                before = value.value
                time.sleep(0.1)
                value.value = before + 1
        shared = multiprocessing.Lock(), multiprocessing.Event(), multiprocessing.Value("i", 0)
        with multiprocessing.Pool(3, begin, shared) as pool:
            jobs = pool.map_async(work, range(6))
            time.sleep(0.2)
            shared[1].set()
            jobs.get()
        print(shared[2].value, f"{time.monotonic():.2f}")
        condition, semaphore = multiprocessing.Condition(), multiprocessing.Semaphore(0)
        with condition:
            print(condition.wait(0.2), f"{time.monotonic():.2f}")
        threading.Timer(0.1, semaphore.release).start()
        print(semaphore.acquire(timeout=0.05), semaphore.acquire(), f"{time.monotonic():.2f}")
        lock = multiprocessing.RLock()
        with lock, lock:
            print(multiprocessing.pool.ThreadPool(1).apply(lock.acquire, (False,)))
        def release():
            try:
                lock.release()
            except AssertionError as error:
                print("not owned" in str(error))
        lock.acquire()
        multiprocessing.pool.ThreadPool(1).apply(release)
        lock.release()
        polled = multiprocessing.Event()
        threading.Timer(0.1, polled.set).start()
        while not polled.is_set():
            pass
        print(f"{time.monotonic():.1f}")
        done = multiprocessing.Event()
        child = multiprocessing.get_context("fork").Process(target=lambda: time.sleep(0.01) or done.set())
        child.start()
        with lock:
            print(done.wait(5), f"{time.monotonic():.1f}")
            child.join()
            print(lock.acquire(), lock.release())
        """)
    assert printed(run) == [
        "6 0.80",
        "False 1.00",
        "False True 1.10",
        "False",
        "True",
        "1.2",
        "True 1.2",
        "True None",
    ]


def test_pools_of_multiprocessing_are_threads_on_emulated_time(drive: Drive) -> None:
    text = """
        import multiprocessing, multiprocessing.dummy, threading, time
        from multiprocessing.pool import Pool, ThreadPool
        def work(number, wait_s=0.1):
            time.sleep(wait_s)
            return number * number
        with ThreadPool(3) as pool:
            print(pool.map(work, range(6)), round(time.monotonic(), 3))
            print(list(pool.imap_unordered(lambda each: work(each, 0.3 - each / 10), range(3))))
        job = (pool := ThreadPool(1)).apply_async(work, (3,))
        try:
            job.get(0.05)
        except multiprocessing.TimeoutError:
            print("late", job.get(1))
        pool.close()
        pool.join()
        for kind in multiprocessing.Pool, Pool, multiprocessing.dummy.Pool:
            with kind(2) as pool:
                print(pool.starmap(work, [(1,), (2,)]))
        left = ThreadPool(2)
        left.apply_async(work, (1, 60.0))
        print(round(time.monotonic(), 3), len(multiprocessing.active_children()))
        """
    run = drive(text, vehicles=2)
    for node in ("v01", "v02"):
        lines = log(run, node)
        assert lines[:3] == ["[0, 1, 4, 9, 16, 25] 0.2", "[4, 1, 0]", "late 9"]
        assert lines[3:7] == [*["[1, 4]"] * 3, "0.9 0"]
        assert lines[7].endswith("finished")
    assert run.verdict != "invalid"


def test_results_of_pools_and_compressed_bytes_replay(drive: Drive) -> None:
    program = """
        import email.utils, gzip, io, os, tarfile, threading, time, timeit, zipfile, zenoh
        from concurrent.futures import ThreadPoolExecutor, as_completed, wait
        with ThreadPoolExecutor(4) as pool:
            for collect in (lambda jobs: wait(jobs).done), as_completed:
                time.sleep(0.25)
                jobs = [pool.submit(lambda number=number: number, number=number) for number in range(20)]
                print([job.result() for job in collect(jobs)])
        print([int(each.name[7:].split()[0]) for each in {threading.Thread(target=print) for _ in range(20)}])
        session = zenoh.open(zenoh.Config())
        named = {session.declare_publisher(f"k/{number}") for number in range(20)}
        print([str(each.key_expr) for each in named])
        print(gzip.compress(b"x").hex(), timeit.default_timer(), email.utils.formatdate(), os.getrandom(4).hex())
        for opened in zipfile.ZipFile(archive := io.BytesIO(), "w"), tarfile.open(fileobj=archive, mode="w:gz"):
            with opened:
                if isinstance(opened, zipfile.ZipFile):
                    opened.writestr("a", "x")
            print(archive.getvalue().hex())
        """
    first, again = drive(program), drive(program)
    assert log(first) == log(again)
    assert "0.5 Wed, 01 Jan 2025 00:00:00" in log(first)[4]


def test_modules_that_the_standard_library_loads_are_the_programs_own(drive: Drive, tmp_path: Path) -> None:
    (tmp_path / "plugin.py").write_text("import datetime\ndef year():\n    return datetime.datetime.now().year\n")
    (tmp_path / "script.py").write_text("import time\nyear = time.gmtime().tm_year\n")
    text = """
        import importlib.machinery, importlib.metadata, importlib.util, pkgutil, pydoc, runpy, sys, time, types
        from pathlib import Path
        from unittest import mock
        here = Path(__file__).parent
        spec = importlib.util.spec_from_file_location("loaded", here / "plugin.py")
        module = importlib.util.module_from_spec(spec)
        sys.modules["loaded"] = module
        spec.loader.exec_module(module)
        print(module.year(), importlib.util.find_spec("plugin").name, importlib.util.find_spec("no_such") is None)
        script = runpy.run_path(here / "script.py")
        print(pkgutil.resolve_name("plugin:year")(), pydoc.locate("plugin.year")(), script["year"])
        loader = importlib.machinery.SourceFileLoader("again", str(here / "plugin.py"))
        loader.exec_module(again := types.ModuleType("again"))
        print(again.year())
        point = importlib.metadata.EntryPoint("a", "plugin:year", "plugs")
        print(point.load()(), point.load() is __import__("plugin").year, runpy.run_module("script")["year"])
        try:
            import plugin.none
        except ModuleNotFoundError as error:
            print(error)
        with mock.patch("plugin.year", lambda: "patched"), mock.patch("time.time", lambda: "patched"):
            print(__import__("plugin").year(), time.time())
        """
    run = drive(text, vehicles=2)
    for node in ("v01", "v02"):
        assert log(run, node)[:6] == [
            "2025 plugin True",
            "2025 2025 2025",
            "2025",
            "2025 True 2025",
            "No module named 'plugin.none'; 'plugin' is not a package",
            "patched patched",
        ]


def test_what_is_left_is_finalized_at_the_end_of_a_program(drive: Drive) -> None:
    text = """
        import weakref
        class Thing: pass
        thing = Thing()
        weakref.finalize(thing, print, "finalized")
        try:
            input("sure? ")
        except EOFError:
            print("nobody")
        """
    run = drive(text, vehicles=2)
    for node in ("v01", "v02"):
        assert log(run, node)[:2] == ["sure? nobody", "finalized"]


def test_a_server_that_nobody_asks_lets_time_go_on(drive: Drive) -> None:
    text = """
        import http.server, threading, time, wsgiref.simple_server, xmlrpc.server
        for kind in http.server.ThreadingHTTPServer, wsgiref.simple_server.WSGIServer:
            server = kind(("127.0.0.1", 0), None)
            thread = threading.Thread(target=server.serve_forever, daemon=True)
            thread.start()
            time.sleep(1.2)
            server.shutdown()
            thread.join()
            print(round(time.monotonic(), 1))
            server.server_close()
        """
    run = drive(text, duration_s=4.0)
    assert log(run)[:2] == ["1.5", "3.0"]


def test_other_event_loops_are_refused_or_stood_for(drive: Drive, tmp_path: Path) -> None:
    (tmp_path / "uvloop.py").write_text("raise ImportError('the loop in C')")
    run = drive("""
        import asyncio, time
        try:
            import trio
        except ImportError as error:
            print(error)
        import uvloop
        uvloop.install()
        uvloop.run(asyncio.sleep(0.5))
        with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
            runner.run(asyncio.sleep(0.5))
        print(time.monotonic())
        """)
    assert log(run)[:2] == ["trio is not available on virtual time, whose event loops are those of asyncio", "1.0"]


def test_a_module_that_is_not_the_programs_own_opens_no_session_of_zenoh_itself(drive: Drive) -> None:
    """It would talk past the radio, and in the time of the machine."""
    run = drive("""
        import sys, zenoh
        outside = {}
        exec("import zenoh", {"__builtins__": __import__("types").__builtins__}, outside)
        try:
            outside["zenoh"].open(zenoh.Config())
        except zenoh.ZError as error:
            print(error)
        vars(__import__("os").environ)
        print(sys.stdin.read(), sys.stdin.fileno() > 2)
        """)
    assert log(run)[:2] == ["this module is not the program's own: its Zenoh is outside of the emulation", " True"]


def test_orders_name_threads_as_the_program_does(drive: Drive) -> None:
    program = """
        import threading, time
        def work():
            time.sleep(0.1)
            print(threading.current_thread().name)
        for name in ("teller", "measurer"):
            threading.Thread(target=work, name=name).start()
        """
    labels = set()
    for seed in range(6):
        run = drive(program, run={"order": "shuffle", "seed": seed})
        labels |= {described(each).split(": ")[1].split(" before")[0] for each in read_tape(run.folder / TAPE_FILE)}
    assert "timer of measurer" in labels


def test_each_thread_has_the_context_that_python_gives_it(drive: Drive) -> None:
    """An empty one: they once shared decimal's, so that the precision of one was that of all."""
    run = drive("""
        import asyncio, contextvars, decimal, threading, time, zenoh
        from concurrent.futures import ThreadPoolExecutor
        told = contextvars.ContextVar("told", default="nothing")
        session = zenoh.open(zenoh.Config())

        def look(who, digits):
            before = told.get(), decimal.getcontext().prec
            told.set(who)
            decimal.getcontext().prec = digits
            time.sleep(0.2)
            print(who, *before, told.get(), decimal.getcontext().prec)

        told.set("main")
        decimal.getcontext().prec = 10
        subscriber = session.declare_subscriber("a", lambda sample: look("callback", 3))
        threads = [threading.Thread(target=look, args=(f"thread {digits}", digits)) for digits in (4, 5)]
        threads.append(threading.Timer(0.01, look, ("timer", 6)))
        for thread in threads:
            thread.start()
        session.put("a", b"")
        with ThreadPoolExecutor(1) as jobs:
            jobs.submit(look, "job", 7).result()
        for thread in threads:
            thread.join()
        print("main", told.get(), decimal.getcontext().prec)

        async def asks():
            told.set("loop")
            loop = asyncio.get_running_loop()
            print(await asyncio.to_thread(told.get), await loop.run_in_executor(None, told.get))

        asyncio.run(asks())
        session.close()
        """)
    threads = [("callback", 3), ("job", 7), *((f"thread {digits}", digits) for digits in (4, 5)), ("timer", 6)]
    seen = [f"{who} nothing 28 {who} {digits}" for who, digits in threads]
    assert sorted(printed(run)) == sorted([*seen, "main main 10", "loop nothing"])


def test_a_thread_that_any_exception_ends_is_told(drive: Drive) -> None:
    """`asyncio.run` in a thread raises CancelledError, which is no Exception."""
    run = drive("""
        import asyncio, threading, zenoh

        async def awaits():
            task = asyncio.create_task(asyncio.sleep(1))
            task.cancel()
            await task

        session = zenoh.open(zenoh.Config())
        thread = threading.Thread(target=asyncio.run, args=(awaits(),))
        thread.start()
        thread.join()
        session.close()
        """)
    (told,) = events(run, "exception")
    assert told["error"].startswith("CancelledError")
