"""Tasks and futures of programs: whose they are and how they hash, also in a loop that others share."""

import asyncio
import sys
from collections.abc import Awaitable, Callable
from contextvars import Context, copy_context
from typing import Any
from weakref import WeakKeyDictionary, WeakSet

import pytest

from tests.vnet.runtime.test_host import World
from vnet import Node
from vnet.runtime import own_asyncio
from vnet.runtime.own_asyncio import present_node

OWN = asyncio.Future, asyncio.Task, asyncio.all_tasks, asyncio.as_completed, asyncio.wrap_future
Program = Callable[[Node], Awaitable[None]]


async def nothing() -> None:
    """Be what a task is made of."""


async def makes_much(node: Node) -> None:
    """Make tasks and futures beside another program, as many as it likes."""
    while True:
        kept = [asyncio.create_task(nothing()), asyncio.Future(), asyncio.gather(nothing(), nothing())]
        await asyncio.sleep(0.1)
        del kept


def alone_and_beside_another(program: Program) -> None:
    """Run the program in a loop of its own, and in one that another shares."""

    async def either(node: Node) -> None:
        await (program if node.id == "v1" else makes_much)(node)

    World("v1").run(program)
    World("v2", "v1").run(either)


def made_in_all_ways() -> list[Any]:
    loop = asyncio.get_running_loop()
    tasks = [asyncio.create_task(nothing()), asyncio.ensure_future(nothing()), asyncio.Task(nothing())]
    tasks += [loop.create_task(nothing()), Context().run(asyncio.create_task, nothing())]
    futures = [loop.create_future(), asyncio.Future(), asyncio.Future(loop=loop)]
    return [*tasks, *futures, asyncio.gather(*tasks), asyncio.shield(futures[0])]


def test_what_a_program_makes_hashes_the_same_whoever_shares_its_loop() -> None:
    seen: list[list[int]] = []

    async def program(node: Node) -> None:
        await asyncio.sleep(0.25)
        seen.append([hash(each) for each in made_in_all_ways()])

    alone_and_beside_another(program)
    alone, beside = seen
    assert alone == beside
    assert len({*alone}) == len(alone)


@pytest.mark.parametrize("kind", [set, WeakSet, lambda made: WeakKeyDictionary(dict.fromkeys(made))])
def test_sets_of_what_a_program_makes_have_one_order(kind: Callable[[list[Any]], Any]) -> None:
    orders: list[list[int]] = []

    async def program(node: Node) -> None:
        await asyncio.sleep(0.25)
        made = [each for _ in range(5) for each in made_in_all_ways()]
        node.rng.shuffle(made)
        orders.append([made.index(each) for each in kind(made)])

    alone_and_beside_another(program)
    assert orders[0] == orders[1]


def test_a_programs_tasks_are_named_the_same_whoever_shares_its_loop() -> None:
    names: list[str] = []

    async def program(node: Node) -> None:
        await asyncio.sleep(0.25)
        names.append(asyncio.create_task(nothing()).get_name())

    alone_and_beside_another(program)
    assert names[0] == names[1]


def test_all_tasks_are_those_of_the_program_that_asks() -> None:
    seen: dict[str, set[str]] = {}

    async def program(node: Node) -> None:
        kept = asyncio.create_task(asyncio.sleep(1), name=f"{node.id} sleeps")
        await asyncio.sleep(0.1)
        seen[node.id] = {task.get_name() for task in asyncio.all_tasks()}
        await kept

    World("v1", "v2").run(program)
    assert seen == {node: {f"{node} main", f"{node} sleeps"} for node in ("v1", "v2")}


def test_coroutines_that_are_done_at_one_instant_come_in_the_order_given() -> None:
    orders: list[list[int]] = []

    async def value(number: int) -> int:
        await asyncio.sleep(0.1)
        return number

    async def program(node: Node) -> None:
        orders.append([await each for each in asyncio.as_completed([value(number) for number in range(20)])])

    World("v1").run(program)
    assert orders == [[*range(20)]]


@pytest.mark.parametrize("context", [Context, copy_context])
def test_a_task_is_of_the_program_that_makes_it_whatever_its_context(context: Callable[[], Context]) -> None:
    owners: list[Node | None] = []

    async def ticks() -> None:
        while True:
            owners.append(present_node())
            await asyncio.sleep(0.1)

    async def program(node: Node) -> None:
        loop = asyncio.get_running_loop()
        task = asyncio.create_task(ticks(), context=context())
        loop.call_soon(lambda: owners.append(present_node()), context=context())
        context().run(loop.call_later, 0.1, lambda: owners.append(present_node()))
        await asyncio.sleep(0.35)
        task.add_done_callback(lambda task: owners.append(present_node()), context=context())
        task.cancel()
        await asyncio.sleep(0.1)
        owners.append(node)

    World("v1").run(program)
    assert len(owners) == 8
    assert len({*owners}) == 1


def test_a_task_in_an_empty_context_ends_with_its_program() -> None:
    ticked: list[int] = []

    async def ticks(node: Node) -> None:
        while True:
            ticked.append(node.now_ns)
            await asyncio.sleep(0.1)

    async def program(node: Node) -> None:
        node.kept = asyncio.create_task(ticks(node), context=Context())  # type: ignore[attr-defined]
        await asyncio.sleep(0.25)

    World("v1").run(program)
    assert ticked == [0, 100_000_000, 200_000_000]


def test_names_of_asyncio_stand_for_others_only_while_programs_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(own_asyncio, "_users", 0)  # runs of other tests may not have been closed
    own_asyncio._set_names(own=True)
    during: list[tuple[Any, ...]] = []

    async def program(node: Node) -> None:
        names = asyncio.Future, asyncio.Task, asyncio.all_tasks, asyncio.as_completed, asyncio.wrap_future
        during.append(names)
        assert isinstance(OWN[0](loop=asyncio.get_running_loop()), asyncio.Future)
        assert isinstance(asyncio.current_task(), asyncio.Task)
        assert issubclass(OWN[1], asyncio.Future)

    World("v1").run(program)
    assert all(name is not own for name, own in zip(during[0], OWN, strict=True))
    assert (asyncio.Future, asyncio.Task, asyncio.all_tasks, asyncio.as_completed, asyncio.wrap_future) == OWN


def test_other_loops_have_asyncios_own_behaviour_while_programs_run() -> None:
    async def elsewhere() -> bool:
        future, task = asyncio.Future[None](), asyncio.create_task(asyncio.sleep(0))
        whole = asyncio.gather(task)
        await whole
        return all(hash(each) == object.__hash__(each) for each in (future, task, whole))

    own_asyncio.attach()
    try:
        assert asyncio.run(elsewhere())
    finally:
        own_asyncio.detach()


@pytest.mark.skipif(sys.version_info < (3, 12), reason="eager tasks came with Python 3.12")
@pytest.mark.parametrize("own_factory", [False, True])
def test_eager_tasks_are_their_programs(own_factory: bool) -> None:
    seen: list[Any] = []

    async def begins(node: Node) -> None:
        seen.append((present_node() is node, {task.get_name() for task in asyncio.all_tasks()}))
        await asyncio.sleep(0.1)

    async def program(node: Node) -> None:
        await asyncio.sleep(0.25)
        factory = asyncio.create_eager_task_factory(asyncio.Task) if own_factory else asyncio.eager_task_factory  # type: ignore[attr-defined,unused-ignore]
        asyncio.get_running_loop().set_task_factory(factory)
        done, waits = asyncio.create_task(nothing()), asyncio.create_task(begins(node))
        assert done.done()
        assert not waits.done()
        async with asyncio.TaskGroup() as group:
            children = [group.create_task(begins(node), name=f"{number}") for number in range(3)]
        await waits
        seen.append([hash(each) for each in (done, waits, *children)])

    alone_and_beside_another(program)
    assert seen[: len(seen) // 2] == seen[len(seen) // 2 :]
    assert all(each[0] is True for each in seen if isinstance(each, tuple))


def test_a_program_runs_a_loop_of_its_own_in_a_thread_alone() -> None:
    names: list[set[str]] = []

    async def elsewhere() -> None:
        kept = [asyncio.Task(asyncio.sleep(0), name="made"), asyncio.create_task(asyncio.sleep(0), name="created")]
        names.append({task.get_name() for task in asyncio.all_tasks()})
        await asyncio.wait(kept)

    def run() -> None:
        with asyncio.Runner() as runner:
            runner.get_loop().run_until_complete(runner.get_loop().create_task(elsewhere(), name="main"))

    async def program(node: Node) -> None:
        coroutine = nothing()
        with pytest.raises(RuntimeError, match="running event loop"):
            asyncio.Runner().run(coroutine)
        coroutine.close()
        await asyncio.to_thread(run)

    World("v1").run(program)
    assert names == [{"main", "made", "created"}]


def test_a_loop_that_a_library_runs_within_itself_says_so() -> None:
    """As nest_asyncio does: vehicles of one process would wait for each other."""

    said: list[str] = []

    async def program(node: Node) -> None:
        loop: Any = asyncio.get_running_loop()
        try:
            loop._run_once()
        except RuntimeError as error:
            said.append(str(error))

    World("v1").run(program)
    assert said == ["the event loop runs already, and v1 main runs it again: await instead"]


def test_names_that_a_programs_module_has_imported_are_replaced_too() -> None:
    module: dict[str, Any] = {"Future": OWN[0], "waits": OWN[3], "other": asyncio.sleep}
    exec("async def main(node): pass", module)
    own_asyncio.use_stand_ins(module["main"])
    assert module["Future"] is own_asyncio.Future
    assert module["waits"] is own_asyncio.as_completed
    assert module["other"] is asyncio.sleep
