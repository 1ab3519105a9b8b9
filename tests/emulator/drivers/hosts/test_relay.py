"""The bundles of a host: yields wait for each other, and nothing else waits."""

from emulator.drivers.hosts.host import FULL_BYTES, Relay
from vnet.transport import wire

YIELD = wire.encode(wire.Yield(b"nonce", 0, None, [], [], [], 1))
FINAL = wire.encode(wire.Final(b"nonce", wire.Traffic()))


def granted(*process_ids: str) -> Relay:
    made = Relay()
    for process_id in process_ids:
        made.granted(process_id)
    return made


def test_what_a_unit_sends_over_the_backbone_goes_with_the_yield_that_refers_to_it() -> None:
    host = granted("v01", "rsu01")
    host.take_unit("rsu01", b"message")
    host.take("rsu01", YIELD)
    assert host.take_bundle() == []
    host.take("v01", YIELD)
    assert host.take_bundle() == [
        ("backbone", "rsu01", b"message"),
        ("message", "rsu01", YIELD),
        ("message", "v01", YIELD),
    ]
    host.take_unit("rsu01", b"late")
    assert host.take_bundle() == [("backbone", "rsu01", b"late")]


def test_a_bundle_does_not_grow_without_bound() -> None:
    host = granted("v01", "v02")
    large = YIELD + bytes(FULL_BYTES)
    host.take("v01", large)
    assert host.take_bundle() == [("message", "v01", large)]


def test_yields_are_told_by_their_first_bytes() -> None:
    assert wire.is_yield(YIELD)
    assert not wire.is_yield(FINAL)
    assert not wire.is_yield(b"")
