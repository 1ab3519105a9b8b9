"""Messages on the radio: cut into frames and put together again, whatever is lost or changed."""

import contextlib

import msgspec
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from vnet.gateway.frames import (
    MOST_UNFINISHED,
    CrossingQuery,
    CrossingReply,
    CrossingSample,
    CrossingTokens,
    Fragments,
    Message,
    Reassembly,
    TooLargeError,
)

KEYS = st.text(min_size=1, max_size=20)
SAMPLES = st.builds(
    CrossingSample,
    key=KEYS,
    payload=st.binary(max_size=400),
    encoding=KEYS,
    is_delete=st.booleans(),
    attachment=st.none() | st.binary(max_size=33),
    priority=st.sampled_from(["REAL_TIME", "DATA", "BACKGROUND"]),
    congestion=st.sampled_from(["DROP", "BLOCK", "BLOCK_FIRST"]),
    express=st.booleans(),
    time=st.none() | st.tuples(st.integers(0, 2**32 - 1), st.integers(0, 10**9 - 1), st.just(b"\x01")),
    source=st.none() | st.tuples(st.binary(max_size=20), st.integers(0, 2**62)),
)
MESSAGES: st.SearchStrategy[Message] = st.one_of(
    SAMPLES,
    st.builds(CrossingQuery, st.integers(0, 2**62), KEYS, st.binary(max_size=300), st.none(), st.none()),
    st.builds(CrossingReply, KEYS, st.integers(0, 99), SAMPLES),
    st.builds(CrossingTokens, st.lists(KEYS, max_size=20).map(tuple)),
)


@pytest.mark.slow
@given(st.lists(MESSAGES, max_size=8), st.integers(60, 500), st.data())
def test_a_message_arrives_as_it_was_if_all_its_frames_do_and_else_not_at_all(
    messages: list[Message], max_payload: int, data: st.DataObject
) -> None:
    fragments, reassembly = Fragments(max_payload), Reassembly()
    expected, heard = [], []
    for message in messages:
        frames = list(fragments.of(message))
        assert all(len(frame) <= max_payload for frame in frames)
        lost = data.draw(st.sets(st.integers(0, len(frames) - 1), max_size=2))
        if not lost:
            expected.append(message)
        for frame in data.draw(st.permutations([each for n, each in enumerate(frames) if n not in lost])):
            if (whole := reassembly.take("v01", frame)) is not None:
                heard.append(whole)
    assert heard == expected


@pytest.mark.slow
@given(SAMPLES, st.data())
def test_a_message_of_which_a_part_was_changed_is_that_message_or_none(
    message: CrossingSample, data: st.DataObject
) -> None:
    """Most changes leave bytes that can be decoded: of a payload, or the number of a part."""
    frames, reassembly = list(Fragments(100).of(message)), Reassembly()
    assume(len(frames) > 1)
    flips = data.draw(st.lists(st.tuples(*(st.integers(0, size) for size in (len(frames) - 1, 49, 7))), min_size=1))
    for frame, place, bit in flips:
        changed = bytearray(frames[frame])
        changed[place % len(changed)] ^= 1 << bit
        frames[frame] = bytes(changed)
    heard = []
    for frame in frames:
        with contextlib.suppress(msgspec.MsgspecError, LookupError):
            heard.append(reassembly.take("v01", frame))
    assert set(heard) <= {None, message}


@pytest.mark.slow
@given(st.binary(max_size=100))
def test_bytes_of_anybody_are_refused_or_are_a_message(content: bytes) -> None:
    with contextlib.suppress(msgspec.MsgspecError, LookupError):
        Reassembly().take("v01", content)


def test_parts_of_an_earlier_incarnation_do_not_complete_a_message_of_the_next() -> None:
    before, after = (
        list(Fragments(60, incarnation).of(CrossingQuery(0, "key", bytes([incarnation]) * 100, None, None)))
        for incarnation in (0, 1)
    )
    assert len(before) == len(after) > 2
    reassembly = Reassembly()
    heard = [reassembly.take("v01", frame) for frame in [before[1], after[0], *after[2:]]]
    assert heard == [None] * len(heard)
    assert reassembly.take("v01", after[1]) == CrossingQuery(0, "key", b"\1" * 100, None, None)


def test_unfinished_messages_do_not_fill_the_memory() -> None:
    fragments, reassembly = Fragments(100), Reassembly()
    message = CrossingQuery(0, "key", bytes(300), None, None)
    first = list(fragments.of(message))
    reassembly.take("v01", first[0])
    for _ in range(MOST_UNFINISHED):
        reassembly.take("v01", next(iter(fragments.of(message))))
    assert [reassembly.take("v01", frame) for frame in first[1:]] == [None] * (len(first) - 1)


def test_what_needs_too_many_frames_is_refused_by_its_size() -> None:
    with pytest.raises(TooLargeError, match=r"321 bytes .*radio.max_payload_bytes = 20"):
        Fragments(20).of(CrossingQuery(0, "key", bytes(300), None, None))


def test_a_message_of_more_frames_than_the_queue_takes_is_told_once() -> None:
    told: list[str] = []
    fragments = Fragments(100, queue_frames=4, warn=told.append)
    for size in (200, 400, 400):
        list(fragments.of(CrossingQuery(0, "key", bytes(size), None, None)))
    assert told == ["a message of 6 frames, which cannot arrive: radio.queue_frames = 4"]
