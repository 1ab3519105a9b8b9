"""The wire: what is encoded comes back, and whatever else comes is a WireError."""

import contextlib
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vnet.errors import WireError
from vnet.node import Action, Fix
from vnet.radio import SentFrame
from vnet.reports import Report
from vnet.transport import wire
from vnet.transport.wire import Arrived, Deviation, MessageRef, Sent, WireSendResult

times = st.integers(min_value=0, max_value=2**62)
names = st.text(min_size=1, max_size=8)
reals = st.floats(allow_nan=False)
powers = st.none() | reals
packets = st.builds(wire.WirePacket, names, names, times, times, st.binary(max_size=64), powers, powers)
clocks = st.lists(
    st.builds(wire.ClockError, names, times, st.integers(-(2**50), 2**50), st.floats(-0.5, 0.5)), max_size=2
)
busy = st.lists(st.builds(wire.BusyRatios, times, st.lists(st.floats(0, 1), max_size=3)), max_size=2)
fixes = st.builds(
    wire.WireFix, names, times, st.tuples(reals, reals), st.tuples(reals, reals, reals, reals), st.none() | reals
)
reports = st.builds(
    Report,
    times,
    names,
    st.none() | st.tuples(reals, reals),
    st.none() | st.tuples(reals, reals, reals, reals),
    st.dictionaries(names, reals | st.lists(reals, max_size=4), max_size=3),
)
frames = st.builds(SentFrame, names, st.binary(max_size=64), powers, powers, st.none() | names, times)
results = st.lists(st.builds(WireSendResult, names, times, times, st.booleans(), times), max_size=2)
actions = st.builds(Action, names, st.none() | st.floats(-1e6, 1e6), st.integers(-1, 1))
endings = st.builds(
    wire.Ending, names, st.sampled_from(["finished", "crashed", "spun"]), names, names, time_ns=st.none() | times
)
unhandled = st.builds(wire.Unhandled, names, st.none() | times, names, names, names)
notes = st.builds(
    wire.Note,
    names,
    times,
    st.sampled_from(["log", "event"]),
    st.sampled_from(["debug", "info", "warning", "error", "critical"]),
    names,
    st.dictionaries(names, st.booleans() | times | reals | names, max_size=2),
)
refs = st.lists(st.builds(MessageRef, names, times), max_size=2)
unit_messages = st.one_of(
    st.builds(Sent, st.binary(max_size=16), times, st.none() | names, st.binary(max_size=16)),
    st.builds(Arrived, times, names, times, times, st.binary(max_size=16)),
)
deviations = st.builds(Deviation, names, times, times, times, names, names)
traffic = st.builds(
    wire.Traffic,
    st.lists(frames, max_size=3),
    st.lists(reports, max_size=3),
    st.lists(endings, max_size=2),
    st.lists(unhandled, max_size=2),
    st.lists(notes, max_size=2),
    st.lists(deviations, max_size=2),
    st.lists(actions, max_size=2),
    refs,
)
steps = st.builds(wire.Step, times, traffic)
packet_counts = st.integers(0, 2**40)
histograms = st.lists(packet_counts, min_size=wire.LATENESS_BINS, max_size=wire.LATENESS_BINS)
agent_messages = st.one_of(
    st.builds(
        wire.Hello, names, names, st.binary(max_size=16), times, names, st.booleans(), st.none() | names, times
    ),
    st.builds(
        wire.Yield, st.binary(), times, st.none() | times, st.lists(names), st.lists(names), st.lists(steps), times
    ),
    st.builds(
        wire.Frames,
        st.binary(),
        times,
        times,
        st.lists(st.tuples(times, times), max_size=3),
        traffic,
        st.none() | st.builds(wire.Lateness, histograms),
        st.booleans(),
        refs,
        st.lists(st.tuples(times, times), max_size=2),
    ),
    st.builds(wire.Final, st.binary(), traffic),
    st.builds(wire.StackDump, st.binary(), names, st.none() | times, st.none() | times),
)
emulator_messages = st.one_of(
    st.builds(
        wire.Grant,
        times,
        times,
        times,
        st.lists(packets, max_size=3),
        st.lists(fixes, max_size=3),
        clocks,
        times,
        st.lists(fixes, max_size=2),
        st.none() | times,
        busy,
        results,
        refs,
    ),
    st.builds(
        wire.Batch,
        st.lists(fixes, max_size=3),
        times,
        st.lists(packets, max_size=3),
        st.none() | times,
        times,
        st.booleans(),
        clocks,
        busy,
        results,
        refs,
        st.lists(st.tuples(times, times), max_size=2),
    ),
    st.builds(wire.Await, st.floats(0, 60)),
    st.just(wire.StackRequest()),
    st.builds(wire.End, st.none() | st.binary(), names, st.booleans()),
)


@pytest.mark.slow
@given(agent_messages)
def test_what_agents_say_comes_back(message: wire.AgentMessage) -> None:
    assert wire.decode_tx(wire.encode(message)) == message


@pytest.mark.slow
@given(emulator_messages)
def test_what_the_emulator_says_comes_back(message: wire.EmulatorMessage) -> None:
    assert wire.decode_rx(wire.encode(message)) == message


@given(st.binary(max_size=200))
def test_arbitrary_bytes_never_do_harm(data: bytes) -> None:
    for decode in (wire.decode_tx, wire.decode_rx, wire.decode_sent, wire.decode_observation):
        try:
            decode(data)
        except WireError:
            continue


@pytest.mark.slow
@given(agent_messages, st.data())
def test_damaged_messages_never_do_harm(message: wire.AgentMessage, data: st.DataObject) -> None:
    encoded = bytearray(wire.encode(message))
    position = data.draw(st.integers(0, len(encoded) - 1))
    encoded[position] ^= data.draw(st.integers(1, 255))
    try:
        wire.decode_tx(bytes(encoded))
    except WireError:
        return


@pytest.mark.parametrize("time_ns", [-1, 2**62 + 1, 1.5, "1"])
def test_times_are_integers_within_bounds(time_ns: object) -> None:
    grant = wire.encode(wire.Grant(0, time_ns, 9))  # type: ignore[arg-type]
    with pytest.raises(WireError):
        wire.decode_rx(grant)


@pytest.mark.parametrize("bins", [0, wire.LATENESS_BINS - 1, wire.LATENESS_BINS + 1])
def test_a_histogram_of_another_length_is_refused(bins: int) -> None:
    """The emulator adds up the histograms of all processes."""
    frames = wire.Frames(b"n", 0, 0, [], wire.Traffic(), wire.Lateness([0] * bins))
    with pytest.raises(WireError, match="length"):
        wire.decode_tx(wire.encode(frames))


def test_the_sum_of_all_histograms_can_be_told() -> None:
    """Each process says what it likes; ten thousand are the most that a router lets in."""

    def is_taken(count: int) -> bool:
        frames = wire.Frames(b"n", 0, 0, [], wire.Traffic(), wire.Lateness([count] * wire.LATENESS_BINS))
        with contextlib.suppress(WireError):
            return isinstance(wire.decode_tx(wire.encode(frames)), wire.Frames)
        return False

    most = max(count for count in (2**bits for bits in range(64)) if is_taken(count))
    total = 10_000 * wire.LATENESS_BINS * most
    assert wire.decode_observation(wire.encode_observation({"total": total})) == {"total": total}


@pytest.mark.parametrize("decode", [wire.decode_tx, wire.decode_sent])
def test_what_is_too_large_is_not_even_decoded(decode: object, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(wire, "LARGEST_MESSAGE_BYTES", 10)
    with pytest.raises(WireError, match="message of 11 bytes: at most 10 allowed"):
        decode(bytes(11))  # type: ignore[operator]


def test_what_an_error_quotes_is_one_short_line() -> None:
    with pytest.raises(WireError) as caught:
        wire.decode_tx(b"\x91\xda\xff\xff" + b"a\n" * 32767 + b"a")
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 300


def test_a_fix_survives_the_wire_bit_by_bit() -> None:
    fix = Fix(5, np.array([0.1, -1e9 / 3]), np.array([[1.0, 0.1], [0.1, 2.0]]), 0.3, 0.1 + 0.2)
    again = wire.WireFix.of("v1", fix).fix()
    assert again.time_ns == 5
    assert again.heading_rad == 0.3
    assert again.speed_m_s == fix.speed_m_s
    assert np.array_equal(again.position_m, fix.position_m)
    assert np.array_equal(again.covariance_m2, fix.covariance_m2)


def test_lateness_bins_have_an_edge_at_the_limit() -> None:
    at_limit = wire.lateness_bin(wire.LATENESS_LIMIT_NS)
    assert wire.lateness_bin(wire.LATENESS_LIMIT_NS - 1) == at_limit - 1
    assert wire.lateness_edge_ms(at_limit - 1) == pytest.approx(20.0)
    assert wire.lateness_bin(-5) == 0
    assert wire.lateness_bin(2**62) == wire.LATENESS_BINS - 1


@pytest.mark.slow
@given(emulator_messages)
def test_batches_are_told_from_their_first_bytes(message: wire.EmulatorMessage) -> None:
    assert wire.is_batch(wire.encode(message)) == isinstance(message, wire.Batch)
    packets_only = isinstance(message, wire.Batch) and not message.fixes
    assert wire.is_packets_only(wire.encode(message)) == packets_only


def test_a_sender_is_one_object_wherever_its_packets_are_received() -> None:
    batch = wire.decode_rx(wire.encode(wire.Batch([], 0, [wire.WirePacket("v02", "v01", 1, 2, b"x")] * 2)))
    assert isinstance(batch, wire.Batch)
    assert all(each.packet().sender is sys.intern("v01") for each in batch.packets)
