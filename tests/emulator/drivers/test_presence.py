"""Presence: one state a node, whatever faults, trips and programs do."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from emulator.drivers.emulation import NodeState, Presence

IDS = ["v01", "v02", "v03"]
OUTSIDE = {NodeState.NEW, NodeState.OUTSIDE, NodeState.ENTERING, NodeState.ENDED_OUTSIDE}


def states(presence: Presence) -> list[NodeState]:
    return [presence.state(node) for node in IDS]


def test_a_vehicle_enters_leaves_and_enters_again_as_another_incarnation() -> None:
    presence = Presence(IDS, absent={"v02"})
    assert presence.up == {"v01": True, "v02": False, "v03": True}
    assert presence.is_outside("v02") and not presence.is_outside("v01")
    assert presence.change(set(), set()).started == ["v02"]
    assert presence.state("v02") is NodeState.ENTERING and not presence.up["v02"]
    assert presence.come_up(["v02"]) == {"v02": True}
    assert presence.up["v02"] and not presence.is_outside("v02")
    assert presence.incarnation["v02"] == 0, "the first start"
    changes = presence.change(set(), {"v02"})
    assert (changes.stopped, changes.left, changes.started) == (["v02"], ["v02"], [])
    assert presence.state("v02") is NodeState.OUTSIDE
    assert presence.change(set(), set()).started == ["v02"]
    assert presence.come_up(["v02"]) == {"v02": True}
    assert presence.incarnation["v02"] == 1


def test_a_fault_stops_a_node_and_its_end_starts_it_again() -> None:
    presence = Presence(IDS)
    changes = presence.change({"v03", "v01"}, set())
    assert (changes.stopped, changes.left, changes.started) == (["v01", "v03"], [], [])
    assert presence.change({"v03", "v01"}, set()).stopped == [], "it is stopped once"
    assert presence.change({"v03"}, set()).started == ["v01"]
    assert states(presence) == [NodeState.RESTARTING, NodeState.UP, NodeState.DOWN]
    assert presence.come_up(IDS) == {"v01": False}, "only a node that was started comes up, and it enters nothing"
    assert presence.incarnation == {"v01": 1, "v02": 0, "v03": 0}


def test_a_node_that_is_stopped_while_it_starts_is_started_once_more() -> None:
    presence = Presence(IDS, absent={"v02"})
    presence.change({"v01"}, {"v02"})
    assert presence.change(set(), set()).started == ["v01", "v02"]
    assert presence.change({"v01", "v02"}, set()).stopped == ["v01", "v02"]
    assert states(presence)[:2] == [NodeState.DOWN, NodeState.OUTSIDE]
    assert presence.change(set(), set()).started == ["v01", "v02"]
    assert presence.come_up(IDS) == {"v01": False, "v02": True}
    assert presence.incarnation == {"v01": 2, "v02": 1, "v03": 0}


def test_a_vehicle_that_leaves_while_a_fault_has_it_down_comes_back_when_both_are_over() -> None:
    presence = Presence(IDS)
    presence.change({"v01"}, set())
    assert presence.change({"v01"}, {"v01"}).left == ["v01"]
    assert presence.change(set(), {"v01"}).started == []
    assert presence.change(set(), set()).started == ["v01"]
    assert presence.come_up(["v01"]) == {"v01": True}


def test_a_program_that_has_ended_is_never_started_again() -> None:
    presence = Presence(IDS)
    assert presence.end("v01")
    assert not presence.end("v01"), "once"
    assert presence.has_ended("v01") and not presence.up["v01"]
    assert presence.change({"v01"}, set()).stopped == []
    assert presence.change(set(), set()).started == []
    assert presence.change(set(), {"v01"}).left == ["v01"], "its vehicle drives on, and leaves"
    assert presence.is_outside("v01") and presence.has_ended("v01")
    assert presence.change(set(), set()).started == []
    assert presence.come_up(["v01"]) == {}


def test_a_program_that_is_down_does_not_end() -> None:
    presence = Presence(IDS)
    presence.change({"v01"}, set())
    assert not presence.end("v01")
    assert presence.change(set(), set()).started == ["v01"]
    assert presence.starting() == ["v01"] and presence.end("v01"), "but one that was started again may"
    assert presence.has_ended("v01") and presence.come_up(["v01"]) == {}


nodes = st.sets(st.sampled_from(IDS))
steps = st.lists(
    st.one_of(
        st.tuples(st.just("change"), nodes, nodes),
        st.tuples(st.just("come_up"), nodes, nodes),
        st.tuples(st.just("end"), nodes, nodes),
    )
)


@pytest.mark.slow
@given(absent=nodes, steps=steps)
def test_in_any_course_of_events_what_is_said_is_what_is_so(
    absent: set[str], steps: list[tuple[str, set[str], set[str]]]
) -> None:
    presence = Presence(IDS, absent)
    runs = {node: int(node not in absent) for node in IDS}
    for verb, some, others in steps:
        ended = {node for node in IDS if presence.has_ended(node)}
        if verb == "change":
            was_outside = {node for node in IDS if presence.is_outside(node)}
            changes = presence.change(some, others)
            for node in changes.started:
                runs[node] += 1
            assert not any(presence.up[node] for node in some | others)
            assert set(changes.left) == others - was_outside
            assert not {*changes.stopped, *changes.started} & ended
            assert not set(changes.started) & (some | others)
        elif verb == "come_up":
            came = presence.come_up(some)
            assert came.keys() <= some and all(presence.up[node] for node in came)
        else:
            alive = {node for node in IDS if presence.up[node]} | {*presence.starting()}
            assert {node for node in some if presence.end(node)} == some & alive
            assert all(presence.has_ended(node) for node in ended | (some & alive))
        for node in IDS:
            assert presence.up[node] == (presence.state(node) is NodeState.UP)
            assert presence.is_outside(node) == (presence.state(node) in OUTSIDE)
            assert presence.incarnation[node] == max(runs[node] - 1, 0)


@pytest.mark.parametrize("verb", ["come_up", "end"])
def test_what_is_new_neither_comes_up_nor_ends_before_it_is_started(verb: str) -> None:
    presence = Presence(IDS, absent=IDS)
    assert not (presence.end("v01") if verb == "end" else presence.come_up(["v01"]))
    assert presence.state("v01") is NodeState.NEW
