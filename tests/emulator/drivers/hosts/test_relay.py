"""The bundles of a host: yields wait for each other, and nothing else waits."""

from emulator.drivers.hosts.host import FULL_BYTES, Relay
from vnet.transport import wire

YIELD = wire.encode(wire.Yield(b"nonce", 0, None, [], [], [], 1))
FINAL = wire.encode(wire.Final(b"nonce", wire.Traffic()))


def granted(*process_ids: str) -> Relay:
    made = Relay()
    made.awaited.update(process_ids)
    return made


def test_the_yields_of_a_barrier_are_one_bundle() -> None:
    host = granted("v01", "v02", "v03")
    for node in ("v02", "v01"):
        host.take(node, YIELD)
        assert host.take_bundle() == []
    host.take("v03", YIELD)
    assert host.take_bundle() == [("message", node, YIELD) for node in ("v02", "v01", "v03")]
    assert host.take_bundle() == []


def test_what_a_unit_sends_over_the_backbone_goes_with_the_yield_that_refers_to_it() -> None:
    host = granted("v01", "rsu01")
    host.take_unit("rsu01", b"message")
    host.take("rsu01", YIELD)
    assert host.take_bundle() == []
    host.take("v01", YIELD)
    yields = [("message", node, YIELD) for node in ("rsu01", "v01")]
    assert host.take_bundle() == [("backbone", "rsu01", b"message"), *yields]
    host.take_unit("rsu01", b"late")
    assert host.take_bundle() == [("backbone", "rsu01", b"late")]


def test_who_ends_owes_nothing() -> None:
    host = granted("v01", "v02")
    host.take("v01", YIELD)
    host.awaited.discard("v02")
    assert host.take_bundle() == [("message", "v01", YIELD)]


def test_what_is_no_yield_goes_at_once_and_takes_along_what_is_there() -> None:
    host = granted("v01", "v02")
    host.take("v01", YIELD)
    host.take("v02", FINAL)
    assert host.take_bundle() == [("message", "v01", YIELD), ("message", "v02", FINAL)]
    host.add(("token", "v02", False))
    assert host.take_bundle() == [("token", "v02", False)]
    assert host.awaited == {"v02"}, "it still owes its yield"


def test_an_emulator_that_asks_does_not_wait_for_those_that_are_stuck() -> None:
    host = granted("v01", "v02")
    host.take("v01", YIELD)
    host.is_urgent = True
    assert host.take_bundle() == [("message", "v01", YIELD)]


def test_a_bundle_does_not_grow_without_bound() -> None:
    host = granted("v01", "v02")
    large = YIELD + bytes(FULL_BYTES)
    host.take("v01", large)
    assert host.take_bundle() == [("message", "v01", large)]


def test_yields_are_told_by_their_first_bytes() -> None:
    assert wire.is_yield(YIELD)
    assert not wire.is_yield(FINAL)
    assert not wire.is_yield(b"")
