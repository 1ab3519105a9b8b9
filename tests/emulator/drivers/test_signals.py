"""Signal handlers are set for a block, and given back on every way out of it."""

import asyncio
import os
import signal
import threading
from collections.abc import Callable, Iterator

import pytest

from emulator.drivers.live.processes import to_its_end
from emulator.drivers.signals import (
    ENDING,
    cancelled_by_signals,
    first_interrupt_told,
    gets_signals,
    signals_handled,
    signals_ignored,
)


def usual(number: int, frame: object) -> None:
    """A handler of the caller's."""


@pytest.fixture(params=[usual, signal.SIG_IGN, signal.SIG_DFL], ids=["own", "ignored", "default"], autouse=True)
def before(request: pytest.FixtureRequest) -> Iterator[object]:
    """Each of the ways in which a caller may handle signals."""
    earlier = {number: signal.signal(number, request.param) for number in ENDING}
    yield request.param
    for number, handler in earlier.items():
        signal.signal(number, handler)


def test_handlers_are_restored_however_the_block_is_left(before: object) -> None:
    with signals_ignored():
        for number in ENDING:
            os.kill(os.getpid(), number)
    assert [signal.getsignal(number) for number in ENDING] == [before] * 2
    with pytest.raises(ZeroDivisionError), signals_ignored():
        raise ZeroDivisionError
    assert [signal.getsignal(number) for number in ENDING] == [before] * 2


@pytest.mark.parametrize("number", ENDING)
def test_a_signal_of_before_the_run_ends_the_run(number: signal.Signals) -> None:
    async def work(send_again: Callable[[], None]) -> None:
        async with cancelled_by_signals():
            send_again()
            await asyncio.sleep(60)

    with signals_ignored() as send_again, pytest.raises(asyncio.CancelledError):
        os.kill(os.getpid(), number)
        asyncio.run(work(send_again))


@pytest.mark.parametrize("number", ENDING)
def test_the_first_signal_cancels_the_task_and_a_second_one_does_not_disturb_its_end(
    number: signal.Signals, before: object
) -> None:
    steps = []

    async def work() -> None:
        async with cancelled_by_signals():
            try:
                os.kill(os.getpid(), number)
                await asyncio.sleep(60)
            except asyncio.CancelledError:
                os.kill(os.getpid(), number)
                for _ in range(5):
                    await asyncio.sleep(0)
                steps.append("records are written")
                raise

    with pytest.raises(asyncio.CancelledError):
        asyncio.run(work())
    assert steps == ["records are written"]
    assert [signal.getsignal(number) for number in ENDING] == [before] * 2


def test_a_handler_of_the_caller_s_loop_goes_on_afterwards() -> None:
    heard: list[str] = []

    async def work() -> None:
        loop = asyncio.get_running_loop()
        loop.add_signal_handler(signal.SIGTERM, heard.append, "SIGTERM")
        async with cancelled_by_signals():
            pass
        os.kill(os.getpid(), signal.SIGTERM)
        while not heard:
            await asyncio.sleep(0)

    asyncio.run(asyncio.wait_for(work(), 30))
    assert heard == ["SIGTERM"]


def test_on_another_thread_nothing_is_set(before: object) -> None:
    seen: list[object] = []

    async def work() -> None:
        async with cancelled_by_signals():
            seen.append(signal.getsignal(signal.SIGINT))

    def run() -> None:
        seen.append(gets_signals())
        with signals_handled(usual, signal.SIGUSR2):
            seen.append(signal.getsignal(signal.SIGUSR2) is usual)
        asyncio.run(work())

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    assert seen == [False, False, before]


def test_a_run_that_is_over_ends_its_programs_whatever_interrupts_it() -> None:
    async def interrupted(signals: int) -> bool:
        go_on, ended = asyncio.Event(), []

        async def shut_down() -> None:
            await go_on.wait()
            ended.append(True)

        task = asyncio.create_task(to_its_end(shut_down()))
        for _ in range(signals):
            await asyncio.sleep(0)
            task.cancel()
        await asyncio.sleep(0)
        go_on.set()
        was_interrupted = await task
        assert ended == [True]
        return was_interrupted

    assert [asyncio.run(interrupted(signals)) for signals in range(3)] == [False, True, True]


def test_what_fails_as_programs_end_is_told() -> None:
    async def shut_down() -> None:
        raise ValueError("no")

    with pytest.raises(ValueError, match="no"):
        asyncio.run(to_its_end(shut_down()))


def test_one_while_a_run_is_judged_is_told_once() -> None:
    said = threading.Event()
    with pytest.raises(KeyboardInterrupt), first_interrupt_told(said.set) as is_told:
        assert not is_told()
        os.kill(os.getpid(), signal.SIGINT)
        assert is_told() and said.wait()
        os.kill(os.getpid(), signal.SIGINT)
