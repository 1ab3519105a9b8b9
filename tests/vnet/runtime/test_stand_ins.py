"""Chance without a seed: each node's own, and the same in any division into processes."""

import asyncio
import copy
import faulthandler
import gc
import importlib
import os
import pickle
import random
import secrets
import sys
import tempfile
import uuid
from collections.abc import Callable
from functools import partial
from pathlib import Path
from random import Random, gauss
from random import random as drawn_by_name
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.random import normal

import emulator
from vnet import Node
from vnet.runtime import own_asyncio
from vnet.runtime.own_asyncio import current_node

DRAWS: dict[str, Callable[[], Any]] = {
    "random": lambda: random.random(),
    "choice": lambda: random.choice(range(10**9)),
    "by name": lambda: drawn_by_name(),
    "gauss": lambda: gauss(0, 1),
    "Random()": lambda: random.Random().random(),
    "class by name": lambda: Random().random(),
    "SystemRandom": lambda: random.SystemRandom().random(),
    "urandom": lambda: os.urandom(8).hex(),
    "secrets": lambda: secrets.token_hex(),
    "uuid4": lambda: uuid.uuid4().int,
    "normal": lambda: np.random.normal(),  # noqa: NPY002  # the shared generator is what is asked about
    "by name of numpy": lambda: normal(),  # noqa: NPY002
    "sample": lambda: np.random.sample(),  # noqa: NPY002
    "networkx": lambda: random._inst.random(),
    "scipy": lambda: np.random.mtrand._rand.standard_normal(),  # which scipy asks for at each draw
    "default_rng": lambda: np.random.default_rng().integers(10**9),
    "RandomState": lambda: np.random.RandomState().random_sample(),
}


async def draws(node: Node) -> None:
    """Log one draw of each sort in each period, between draws of threads."""
    while True:
        await asyncio.sleep(0.1)
        await asyncio.gather(*(asyncio.to_thread(random.random) for _ in range(3)))
        node.log(" ".join(map(repr, [*(draw() for draw in DRAWS.values()), node.rng.random()])))


def drawn_in(folder: Path, **options: Any) -> list[tuple[str | None, str]]:
    scenario = {"run": {"duration_s": 0.5}, "network": {"vehicles": 3}, "program": {"entry": f"{__name__}:draws"}}
    run = emulator.simulate(scenario, out=folder, **options)
    return [(event.node, event.text) for event in run.events if event.kind == "log"]


@pytest.mark.slow
def test_what_is_drawn_without_a_seed_is_that_of_the_run_in_any_division(tmp_path: Path) -> None:
    alone, divided = drawn_in(tmp_path / "one"), drawn_in(tmp_path / "two", processes=2)
    assert alone == divided
    said = [text.split()[1:] for _, text in alone]  # the first word is the vehicle
    assert len(said) >= 9
    assert all(len({*column}) == len(said) for column in zip(*said, strict=True)), "nothing is drawn twice"


class Fake:
    """A node as far as chance asks for it."""

    def __init__(self, seed: int) -> None:
        self.seed = seed


def as_node(node: Any, draw: Callable[[], Any]) -> Any:
    """Draw on behalf of a node, on a loop."""

    async def program() -> Any:
        current_node.set(node)
        return draw()

    return asyncio.run(program())


@pytest.fixture(autouse=True)
def attached() -> Any:
    """Names as they are while programs run."""
    own_asyncio.attach()
    own_asyncio.use_stand_ins(draws)
    yield
    own_asyncio.detach()


@given(st.lists(st.tuples(st.sampled_from([1, 2]), st.sampled_from(sorted(DRAWS))), max_size=30))
def test_a_node_draws_the_same_whatever_others_draw_between(drawn: list[tuple[int, str]]) -> None:
    def all_of(*seeds: int) -> list[Any]:
        nodes = {seed: Fake(seed) for seed in seeds}
        return [repr(as_node(nodes[seed], DRAWS[name])) for seed, name in drawn if seed in nodes]

    both, alone = all_of(1, 2), iter(all_of(1))
    assert all(both[n] == next(alone) for n, (seed, _) in enumerate(drawn) if seed == 1)


def test_who_imports_a_module_draws_what_others_do_and_so_does_the_module(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "lucky.py").write_text(
        "import random, uuid\nfrom lucky_inner import draw\nX = uuid.uuid4(), draw()\n"
        "exec('import random; random.random()', {})\n"
    )
    (tmp_path / "lucky_inner.py").write_text(
        "import random\nY = random.random()\ndef draw(): return random.random()\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    modules = ["lucky", "lucky_inner"]

    def imports_and_draws() -> Any:
        kept = [importlib.import_module(name) for name in modules]
        return kept, [draw() for name, draw in DRAWS.items() if name != "SystemRandom"]

    first, second, third = Fake(1), Fake(2), Fake(1)
    kept, drawn = as_node(first, imports_and_draws)
    values = kept[0].X, kept[1].Y
    for name in modules:
        del sys.modules[name]
    again, of_another = as_node(second, imports_and_draws)
    assert as_node(third, imports_and_draws) == (again, drawn) != of_another
    assert values == (again[0].X, again[1].Y)
    for name in modules:
        del sys.modules[name]


def test_names_that_a_process_shares_are_nobodys_draws() -> None:
    names: Any = tempfile._RandomNameSequence()  # type: ignore[attr-defined]  # multiprocessing has another
    first = as_node(Fake(1), lambda: (next(names), DRAWS["uuid4"]()))
    other = as_node(Fake(1), lambda: (next(names), DRAWS["uuid4"]()))
    assert first[0] != other[0] and first[1] == other[1]


def test_a_program_in_virtual_time_leaves_to_the_loop_when_garbage_is_collected(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    before = gc.get_threshold()
    as_node(Fake(1), lambda: gc.set_threshold(before[0] + 1))
    assert gc.get_threshold()[0] == before[0] + 1, "in real time they are its own"
    gc.set_threshold(*before)
    monkeypatch.setattr(asyncio.SelectorEventLoop, "start_at", 0, raising=False)
    as_node(Fake(1), lambda: gc.set_threshold(7))
    assert gc.get_threshold() == before


def test_the_watchdog_of_a_program_ends_with_the_programs(monkeypatch: pytest.MonkeyPatch) -> None:
    cancelled: list[bool] = []
    monkeypatch.setattr("faulthandler.cancel_dump_traceback_later", lambda: cancelled.append(True))
    monkeypatch.setattr(own_asyncio, "_watch_later", lambda *_, **__: None)
    monkeypatch.setattr(own_asyncio, "_users", 1)  # not those of processes that were killed, as tests play them
    for use, ends in ((lambda: None, []), (lambda: faulthandler.dump_traceback_later(60, exit=True), [True])):
        as_node(Fake(1), use)
        own_asyncio.detach()
        own_asyncio.attach()
        assert cancelled == ends, "that of others stays"


def test_a_seed_of_a_program_is_its_nodes_alone() -> None:
    first, second = Fake(1), Fake(2)
    for seed, draw in (random.seed, random.random), (np.random.seed, np.random.random_sample):
        as_node(first, partial(seed, 7))
        unseeded = as_node(second, draw)
        own = as_node(first, draw)
        seed(7)
        assert draw() == own != unseeded


@pytest.mark.parametrize("module", [random, np.random])
def test_each_function_draws_as_that_of_a_generator_with_its_seed(module: ModuleType) -> None:
    arguments = {"betavariate": (1, 2), "binomialvariate": (3,), "choice": ([1, 2],), "choices": ([1, 2],)}
    arguments |= {"gammavariate": (1, 2), "getrandbits": (8,), "lognormvariate": (0, 1), "normalvariate": (0, 1)}
    arguments |= {"expovariate": (1,), "gauss": (0, 1), "paretovariate": (1,), "randbytes": (3,), "randint": (1, 9)}
    arguments |= {"randrange": (9,), "uniform": (1, 2), "vonmisesvariate": (0, 1), "weibullvariate": (1, 1)}
    ours = {
        name: own
        for where, name, own, _ in own_asyncio._STAND_INS
        if where is module and not name.startswith(("_", "seed", "set_state", "setstate"))
    }
    assert "sample" in ours
    node = Fake(1)
    for name in sorted(ours):
        given = {"sample": ([1, 2, 3], 2)}.get(name, arguments.get(name, ())) if module is random else ()
        as_node(node, partial(module.seed, 7))
        try:
            drawn = as_node(node, partial(getattr(module, name), *given))
        except TypeError as error:
            assert "required" in str(error) or "argument" in str(error), (name, error)
            continue
        module.seed(7)
        assert repr(drawn) == repr(ours[name](*given)), name


def test_a_class_by_name_is_itself() -> None:
    assert Random is random.Random and type(random.Random(1)) is Random


def test_functions_can_be_pickled() -> None:
    for function in (random.random, random.choice, np.random.normal, np.random.ranf, np.random.seed):
        assert pickle.loads(pickle.dumps(function)) is function


def test_what_scipy_keeps_of_numpy_can_be_copied_and_pickled() -> None:
    kept = np.random.mtrand._rand
    assert copy.deepcopy(kept) is pickle.loads(pickle.dumps(kept)) is kept
    assert isinstance(kept, np.random.RandomState)


@pytest.mark.slow
def test_a_child_process_draws_other_numbers() -> None:
    def draw() -> tuple[float, str]:
        return random.random(), secrets.token_hex()

    def child() -> str:
        ours, theirs = os.pipe()
        if os.fork() == 0:
            os.write(theirs, repr(draw()).encode())
            os._exit(0)
        os.wait()
        return os.read(ours, 1000).decode()

    node = Fake(1)
    told = [as_node(node, child), as_node(node, child), repr(as_node(node, draw)), as_node(node, child)]
    assert len({*told}) == 4
    assert told[2] == repr(as_node(Fake(1), draw)), "what a child draws changes nothing"


def test_names_are_the_modules_own_when_no_program_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(own_asyncio, "_users", 1)  # runs of other tests may not have been closed
    own_asyncio.detach()
    assert random.random.__self__ is random._inst  # type: ignore[attr-defined]
    assert os.urandom.__module__ == "posix"
    own_asyncio.attach()
    assert not hasattr(random.random, "__self__")
