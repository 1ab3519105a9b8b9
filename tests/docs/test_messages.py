"""docs/messages.md is the wire: an independent reader decodes what vnet says, and vnet what such a writer says.

The reader and the writer are plain msgpack and the page's own tables; neither knows a class of vnet's.
"""

from pathlib import Path
from typing import Any

import msgpack
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from emulator.drivers.observers import Messages
from emulator.drivers.simulate import simulate
from tests.docs.layouts import Field, Layouts, split
from tests.support.paths import ROOT
from tests.support.recorded import prepared
from tests.vnet.transport.test_wire import agent_messages, emulator_messages, names, reports, times, unit_messages
from vnet.errors import WireError
from vnet.node import Action
from vnet.radio import SentFrame, UnitAbilities
from vnet.reports import Report
from vnet.transport import keys, wire
from vnet.transport.wire import Arrived, Deviation, MessageRef, Order, Sent, WireSendResult

PAGE = Layouts()
OF_AGENTS = {kind.__name__: kind for kind in (wire.Hello, wire.Yield, wire.Frames, wire.Final, wire.StackDump)}
OF_THE_EMULATOR = {
    kind.__name__: kind for kind in (wire.Welcome, wire.Grant, wire.Batch, wire.StackRequest, wire.Await, wire.End)
}
ON_THE_BACKBONE = {"Sent": Sent, "Arrived": Arrived}
DECODERS = {
    **dict.fromkeys(OF_AGENTS, wire.decode_tx),
    **dict.fromkeys(OF_THE_EMULATOR, wire.decode_rx),
    "Sent": wire.decode_sent,
    "Arrived": wire.decode_arrived,
}
PARTS = {
    "Step": wire.Step,
    "Traffic": wire.Traffic,
    "Frame": SentFrame,
    "Ending": wire.Ending,
    "Unhandled": wire.Unhandled,
    "Note": wire.Note,
    "Order": Order,
    "Deviation": Deviation,
    "Action": Action,
    "Lateness": wire.Lateness,
    "Packet": wire.WirePacket,
    "Fix": wire.WireFix,
    "ClockError": wire.ClockError,
    "BusyRatios": wire.BusyRatios,
    "SendResult": WireSendResult,
    "MessageRef": MessageRef,
    "UnitAbilities": UnitAbilities,
}
welcomes = st.builds(
    wire.Welcome,
    names,
    st.binary(max_size=16),
    times,
    st.sampled_from(["lockstep", "realtime"]),
    names,
    st.dictionaries(names, times, max_size=2),
    st.lists(times, max_size=2) | st.dictionaries(names, times, max_size=2),
    times,
    st.integers(1, 2**40),
    st.integers(1, 2**20),
    st.floats(0, 60),
    times,
    names,
    st.booleans(),
    times,
)


def test_every_kind_of_message_is_on_the_page() -> None:
    assert set(wire.AgentMessage.__args__) == set(OF_AGENTS.values())
    assert set(wire.EmulatorMessage.__args__) == set(OF_THE_EMULATOR.values())
    documented = {**OF_AGENTS, **OF_THE_EMULATOR, **ON_THE_BACKBONE, **PARTS}
    assert PAGE.by_name.keys() - documented.keys() == {"Report", "Scene", "Period", "RunEnd"}
    for name, kind in documented.items():
        found = getattr(kind, "_fields", None) or getattr(kind, "__struct_fields__", None)
        assert tuple(field.name for field in PAGE.by_name[name]) == found, name
    assert [field.name for field in PAGE.by_name["Report"]] == list(Report.__struct_fields__)


# An independent reader.


@pytest.mark.slow
@given(agent_messages | emulator_messages | unit_messages | welcomes)
def test_a_plain_reader_decodes_what_vnet_encodes(message: Any) -> None:
    kind, *values = msgpack.unpackb(wire.encode(message))
    assert kind == type(message).__name__
    assert PAGE.problem_of(kind, values) == ""
    by_name = dict(zip([field.name for field in PAGE.by_name[kind]], values, strict=True))
    plain = [name for name, value in by_name.items() if isinstance(value, int | str | bytes | float | None)]
    assert all(by_name[name] == getattr(message, name) for name in plain)


@given(reports)
def test_a_plain_reader_decodes_reports(report: Report) -> None:
    assert PAGE.problem_of("Report", msgpack.unpackb(wire.encode(report))) == ""


@pytest.mark.slow
def test_a_plain_reader_decodes_what_observers_get(tmp_path: Path) -> None:
    scenario = {
        "run": {"duration_s": 1.0, "settle_s": 0.2},
        "network": {"vehicles": 3},
        "program": {"entry": "agents.cooperative:main"},
        "fault": [{"kind": "kill", "at_s": 0.3, "duration_s": 0.2, "nodes": {"ids": ["v02"]}}],
    }
    emulation = prepared(scenario, tmp_path / "run")
    messages = Messages(emulation)
    told = [("Scene", messages.scene())]
    emulation.watch(lambda view: told.append(("Period", messages.period(view))))
    simulate(emulation)
    told.append(("RunEnd", messages.end()))
    assert len(told) == 12
    sizes = {"n": 3, "l": len(emulation.world.lane_map)}
    for kind, message in told:
        decoded = msgpack.unpackb(wire.encode_observation(message))
        assert PAGE.problem_of(kind, decoded, sizes) == ""
    events = [event for kind, message in told if kind != "Scene" for event in message["events"]]
    assert all(event.keys() == {"time_ns", "kind", "node", "text", "details"} for event in events)
    assert events


# An independent writer.


@pytest.mark.slow
@pytest.mark.parametrize("kind", DECODERS)
def test_vnet_accepts_what_a_plain_writer_encodes(kind: str) -> None:
    decode: Any = DECODERS[kind]

    @settings(max_examples=20, deadline=None)
    @given(PAGE.values(kind))
    def check(values: list[Any]) -> None:
        message = decode(msgpack.packb([kind, *values]))
        assert type(message).__name__ == kind
        assert msgpack.unpackb(wire.encode(message)) == [kind, *values]
        assert decode(msgpack.packb([kind, *values, "a field of a later version"])) == message

    check()


WRONG: list[Any] = [None, True, -1, 1.5, "text", b"bytes", [1.5], {"a": {}}, {1: 2}]
"""Values of which each field refuses those that its type does not have."""


def fields(kinds: dict[str, Any]) -> list[tuple[str, int, Field]]:
    return [(kind, index, field) for kind in kinds for index, field in enumerate(PAGE.by_name[kind])]


def example(kind: str) -> list[Any]:
    """Values of a message that are as the page says, always the same."""
    zero = {"int": 1, "float": 0.5, "text": "v01", "bytes": b"n", "bool": False, "Traffic": [[]] * 8}

    def value(field: Field) -> Any:
        first = split(field.type, " or ")[0]
        if first.startswith('"'):
            return first.strip('"')
        return [] if first.startswith("[") else {} if first.startswith("{") else zero.get(first)

    return [value(field) for field in PAGE.by_name[kind]]


@pytest.mark.parametrize(("kind", "index", "field"), fields(DECODERS))
def test_vnet_refuses_what_the_page_does_not_allow(kind: str, index: int, field: Field) -> None:
    decode: Any = DECODERS[kind]
    values = example(kind)
    if PAGE.problem_of(kind, values):  # a lateness of nil is one that an example need not have
        values = [
            None if "nil" in each.type else value for each, value in zip(PAGE.by_name[kind], values, strict=True)
        ]
    assert PAGE.problem_of(kind, values) == ""
    decode(msgpack.packb([kind, *values]))
    for wrong in [*WRONG, *field.edges()[1]]:
        altered = [*values[:index], wrong, *values[index + 1 :]]
        if PAGE.problem_of(kind, altered):
            with pytest.raises(WireError):
                decode(msgpack.packb([kind, *altered]))
        else:
            decode(msgpack.packb([kind, *altered]))


def test_an_agent_that_knows_nothing_of_exceptions_is_understood() -> None:
    steps = [[0, [[["v01", b"x"]], [], []]]]
    message = wire.decode_tx(msgpack.packb(["Yield", b"n", 0, None, [], [], steps, 1]))
    assert isinstance(message, wire.Yield)
    assert message.steps == [wire.Step(0, wire.Traffic([SentFrame("v01", b"x")], [], []))]


def test_a_reader_that_is_told_nonsense_says_so() -> None:
    assert "Hello.pid" in PAGE.problem_of("Hello", ["v01", "v01", b"n", "1", "here", False, None, 2, True])
    assert "not 9 values" in PAGE.problem_of("Hello", ["v01"])
    assert "Grant.seq" in PAGE.problem_of("Grant", [-1, 0, 1, [], [], [], 0, [], None, [], [], []])
    assert "Lateness.counts" in PAGE.problem_of("Lateness", [[0] * 79])
    assert "Scene: fields" in PAGE.problem_of("Scene", {"name": "a run"})


def test_the_keys_are_those_of_the_page() -> None:
    text = (ROOT / "docs" / "messages.md").read_text(encoding="utf-8")
    made = [make("RUN", "ID") for make in (keys.node_tx, keys.node_rx, keys.node_report, keys.node_alive)]
    made += [make("RUN", "ID") for make in (keys.backbone_tx, keys.backbone_rx)]
    made += [make("RUN", "NAME") for make in (keys.host_tx, keys.host_rx, keys.host_alive)]
    made += [keys.emulator_alive("RUN"), keys.observe("RUN", "STREAM"), keys.control("RUN", "VERB")]
    assert [key for key in made if f"| `{key}` |" not in text] == []
