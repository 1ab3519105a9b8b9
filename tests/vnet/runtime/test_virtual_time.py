"""asyncio in virtual time: what programs may rely on, and what they are refused."""

import asyncio
import os
import threading
from collections.abc import Awaitable, Callable, Iterator
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vnet.errors import VirtualTimeError
from vnet.runtime.virtual_time import LoopAbandonedError, SpinError, VirtualTimeLoop


class Deadlock(Exception):
    """Nothing is left that could wake the loop."""


@pytest.fixture
def loop() -> Iterator[VirtualTimeLoop]:
    """A loop that is always granted exactly the timer it asks for."""

    def exchange(next_timer_ns: int | None) -> int:
        if next_timer_ns is None:
            raise Deadlock
        return next_timer_ns

    loop = VirtualTimeLoop(exchange, spin_limit=1000)
    yield loop
    loop.close()


def run(loop: VirtualTimeLoop, program: Callable[[], Awaitable[Any]]) -> Any:
    return loop.run_until_complete(program())


@pytest.mark.slow
def test_a_fork_that_comes_back_to_the_loop_ends(loop: VirtualTimeLoop, capfd: pytest.CaptureFixture[str]) -> None:
    async def program() -> int:
        never = loop.create_future()
        child = os.fork()
        if child == 0:
            try:
                await never
            finally:
                os._exit(1)  # where the loop lets it come back, it must not run the tests a second time
        await asyncio.sleep(1)
        return child

    _, status = os.waitpid(run(loop, program), 0)
    assert os.waitstatus_to_exitcode(status) == 70
    said = "vnet: a process that a program forked came back to the event loop; it ends here\n"
    assert capfd.readouterr().err == said


def test_sleep_takes_exactly_the_time_asked_for(loop: VirtualTimeLoop) -> None:
    async def program() -> list[int]:
        times = []
        for _ in range(1000):
            await asyncio.sleep(0.1)
            times.append(loop.now_ns)
        return times

    times = run(loop, program)
    assert all(abs(t - (k + 1) * 100_000_000) <= 1 for k, t in enumerate(times))


def test_wait_for_times_out_on_the_emulated_clock(loop: VirtualTimeLoop) -> None:
    async def program() -> int:
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(asyncio.Event().wait(), timeout=7.25)
        return loop.now_ns

    assert run(loop, program) == 7_250_000_000


def test_tasks_queues_and_locks_work_as_ever(loop: VirtualTimeLoop) -> None:
    async def program() -> list[tuple[int, int]]:
        queue: asyncio.Queue[int] = asyncio.Queue(maxsize=1)
        lock = asyncio.Lock()
        seen = []

        async def produce() -> None:
            for item in range(5):
                await asyncio.sleep(1)
                async with lock:
                    await queue.put(item)

        producer = asyncio.create_task(produce())
        for _ in range(5):
            seen.append((await queue.get(), loop.now_ns))
        await producer
        return seen

    assert run(loop, program) == [(i, (i + 1) * 1_000_000_000) for i in range(5)]


@pytest.mark.slow
@given(st.lists(st.integers(min_value=0, max_value=10**12), min_size=1, max_size=20))
def test_timers_fire_in_order_at_their_nanosecond(delays_ns: list[int]) -> None:
    loop = VirtualTimeLoop(lambda timer: timer if timer is not None else pytest.fail("deadlock"))
    fired: list[tuple[int, int]] = []

    async def sleeper(delay_ns: int) -> None:
        await asyncio.sleep(delay_ns / 1e9)
        fired.append((loop.now_ns, delay_ns))

    async def program() -> None:
        await asyncio.gather(*(sleeper(d) for d in delays_ns))

    try:
        loop.run_until_complete(program())
    finally:
        loop.close()
    assert [t for t, _ in fired] == sorted(t for t, _ in fired)
    assert all(abs(now - delay) <= 1 for now, delay in fired)


def test_waiting_for_nothing_yields_without_a_timer(loop: VirtualTimeLoop) -> None:
    with pytest.raises(Deadlock):
        run(loop, lambda: asyncio.Event().wait())


def test_an_executor_job_costs_no_emulated_time(loop: VirtualTimeLoop) -> None:
    async def program() -> tuple[int, int]:
        await asyncio.sleep(1)
        value = await asyncio.to_thread(lambda: 42)
        return value, loop.now_ns

    assert run(loop, program) == (42, 1_000_000_000)


def test_executor_results_appear_in_the_order_of_submission(loop: VirtualTimeLoop) -> None:
    order: list[int] = []
    last_done = threading.Event()

    def job(index: int) -> int:
        if index < 2:  # the first two end only after the last one
            assert last_done.wait(10)
        else:
            last_done.set()
        return index

    async def one(index: int) -> None:
        order.append(await asyncio.to_thread(job, index))

    async def program() -> None:
        await asyncio.gather(*(one(i) for i in range(3)))

    run(loop, program)
    assert order == [0, 1, 2]


@pytest.mark.parametrize("call", ["call_soon", "call_soon_threadsafe", "call_later"])
def test_a_thread_may_not_call_into_the_loop(loop: VirtualTimeLoop, call: str) -> None:
    """Nothing says at which emulated time what it wants happens, nor in which order with what others do."""

    def job() -> None:
        getattr(loop, call)(*((1.0, int) if call == "call_later" else (int,)))

    async def program() -> None:
        with pytest.raises(RuntimeError, match=r"asyncio\.to_thread"):
            await asyncio.to_thread(job)

    run(loop, program)


def test_a_job_that_raises_stop_iteration_reaches_the_program_as_another_error(loop: VirtualTimeLoop) -> None:
    async def program() -> None:
        with pytest.raises(RuntimeError, match="StopIteration") as raised:
            await asyncio.to_thread(next, iter(()))
        assert isinstance(raised.value.__cause__, StopIteration)

    loop.run_until_complete(program())


def test_an_exception_in_an_executor_reaches_the_program(loop: VirtualTimeLoop) -> None:
    async def program() -> None:
        with pytest.raises(ZeroDivisionError):
            await asyncio.to_thread(lambda: 1 // 0)

    run(loop, program)


@pytest.mark.parametrize("step_s", [0, 1e-10])
def test_spinning_at_one_instant_is_an_error(loop: VirtualTimeLoop, step_s: float) -> None:
    async def program() -> None:
        while True:
            await asyncio.sleep(step_s)

    with pytest.raises(SpinError, match="1000 rounds"):
        run(loop, program)


@pytest.mark.parametrize("ways", ["sleep", "call_at"])
@given(start_s=st.floats(0, 1e4), for_s=st.floats(0, 2))
def test_who_waits_for_the_rest_of_a_time_comes_to_its_end(ways: str, start_s: float, for_s: float) -> None:
    """Deadlines are waited for like this by programs, rate limiters and anyio; times are whole nanoseconds."""
    loop, rounds = VirtualTimeLoop(lambda next_ns: next_ns or 0, spin_limit=1000), 0

    async def program() -> float:
        nonlocal rounds
        await asyncio.sleep(start_s)
        deadline_s = loop.time() + for_s
        while loop.time() < deadline_s:
            rounds += 1
            if ways == "sleep":
                await asyncio.sleep(deadline_s - loop.time())
            else:
                event = asyncio.Event()
                loop.call_at(deadline_s, event.set)
                await event.wait()
        return loop.time() - deadline_s

    try:
        assert 0 <= run(loop, program) <= 1e-8 and rounds <= 3
    finally:
        loop.close()


def test_many_rounds_over_time_are_no_spin(loop: VirtualTimeLoop) -> None:
    async def program() -> None:
        for _ in range(50):
            for _ in range(100):
                await asyncio.sleep(0)
            await asyncio.sleep(0.1)

    run(loop, program)


@pytest.mark.parametrize(
    "forbidden",
    [
        lambda: asyncio.open_connection("127.0.0.1", 1),
        lambda: asyncio.start_server(lambda r, w: None, "127.0.0.1", 0),
        lambda: asyncio.create_subprocess_exec("true"),
        lambda: asyncio.create_subprocess_shell("true"),
        lambda: asyncio.get_running_loop().getaddrinfo("localhost", 1),
    ],
)
def test_the_real_world_is_refused(loop: VirtualTimeLoop, forbidden: Callable[[], Any]) -> None:
    async def program() -> None:
        with pytest.raises(VirtualTimeError, match="realtime"):
            await forbidden()

    run(loop, program)


def test_finish_lets_cleanup_run_but_not_wait(loop: VirtualTimeLoop) -> None:
    done = []

    async def cleanup() -> None:
        await asyncio.sleep(0)
        done.append("cleanup")

    async def stuck() -> None:
        await asyncio.sleep(1)

    loop.finish(cleanup())
    assert done == ["cleanup"]
    with pytest.raises(LoopAbandonedError):
        loop.finish(stuck())
