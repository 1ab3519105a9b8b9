"""Adversarial inputs: no target raises an undocumented error, hangs, or fills the memory."""

import gc
import os
import signal
import tracemalloc
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.fuzz.adversarial_inputs import NASTIES
from tests.fuzz.targets import TARGETS, Target

pytestmark = pytest.mark.slow

LONGEST_CPU_S = 10
LARGEST_PEAK_BYTES = 50_000_000
all_targets = pytest.mark.parametrize("target", TARGETS, ids=lambda target: target.name)


@pytest.fixture(autouse=True)
def _damaged_maps_are_closed() -> Iterator[None]:
    """Close the maps in PBF that pyosmium leaves open where their headers are damaged: a descriptor for each."""
    yield
    gc.collect()
    for descriptor in Path("/proc/self/fd").iterdir():
        with suppress(FileNotFoundError):  # of the listing itself
            if descriptor.readlink().name.endswith(".osm.pbf"):
                os.close(int(descriptor.name))


@contextmanager
def bounded() -> Iterator[None]:
    """Bound the CPU time to `LONGEST_CPU_S` (not the wall-clock time: the machine may be busy)."""

    def too_long(*_: object) -> None:
        raise AssertionError(f"more than {LONGEST_CPU_S} s of processor time")

    before = signal.signal(signal.SIGPROF, too_long)
    signal.setitimer(signal.ITIMER_PROF, LONGEST_CPU_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


@cache
def read_once(target: Target) -> None:
    """Have a target load what its first input loads."""
    target.try_out(target.seeds[0])


def peak_bytes(target: Target, data: bytes) -> int:
    """Return the peak memory of reading `data`, in bytes, without what the first input of a target loads."""
    read_once(target)
    tracemalloc.start()
    try:
        target.try_out(data)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@all_targets
def test_seeds_are_accepted(target: Target) -> None:
    assert all(target.try_out(seed) for seed in target.seeds)


@all_targets
def test_nasty_inputs_do_no_harm_and_do_not_fill_the_memory(target: Target) -> None:
    for name, data in NASTIES.items():
        is_large = len(data) > 50_000 or name.endswith(("in array32", "in map32"))
        try:
            with bounded():
                if is_large and not name.startswith("--set"):  # whose values are in the file's own as well
                    assert peak_bytes(target, data) < LARGEST_PEAK_BYTES
                else:
                    target.try_out(data)
        except Exception as error:
            raise AssertionError(f"{name}: {type(error).__name__}: {str(error)[:500]}") from error


def test_a_claim_of_two_gigabytes_takes_no_memory() -> None:
    claims = [data for name, data in NASTIES.items() if "32 at " in name]
    tx = next(target for target in TARGETS if target.name == "tx")
    assert len(claims) > 100
    assert max(peak_bytes(tx, data) for data in claims) < 1_000_000


@st.composite
def damaged(draw: st.DrawFn, target: Target) -> bytes:
    """A seed of the target with a few bytes replaced, inserted or cut out, or by others' words and nasty bits."""
    data = draw(st.sampled_from(target.seeds))
    bits = [nasty for nasty in NASTIES.values() if len(nasty) < 100]
    for _ in range(draw(st.integers(1, 4))):
        start = draw(st.integers(0, len(data)))
        end = draw(st.sampled_from([start, start + 1, start + 4, len(data)]))
        new = draw(st.sampled_from([b"", *target.words, *bits]) | st.binary(max_size=8))
        data = data[:start] + new + data[end:]
    return data


@all_targets
def test_arbitrary_and_damaged_inputs_do_no_harm(target: Target) -> None:
    @settings(max_examples=150 if os.environ.get("CI") else 60, deadline=None, derandomize=True, database=None)
    @given(st.binary(max_size=200) | damaged(target))
    def harmless(data: bytes) -> None:
        target.try_out(data)

    with bounded():
        harmless()
