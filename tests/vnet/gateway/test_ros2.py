"""ROS 2's format on Zenoh, against independent readers and writers of it."""

import io
import math
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from pamoja import ros2 as pamoja
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from zenoh_ros2_sdk import attachment as sdk_attachment
from zenoh_ros2_sdk import entity as sdk_entity
from zenoh_ros2_sdk import keyexpr as sdk_keys

import emulator
from emulator.export.mcap_file import _definition, _typestores, write_mcap
from emulator.records.recorded_run import RecordedRun
from emulator.records.samples import key_figures
from tests.support.paths import ROOT
from tests.system.ros2_nodes import FIRST_OF_PAMOJA
from tests.vnet.gateway.conftest import Drive, log
from vnet.errors import VnetError
from vnet.gateway.ros2 import (
    ATTACHMENT,
    CLOCK_TYPE,
    FIX_TYPE,
    GID_BYTES,
    TYPE_HASHES,
    UNKNOWN_HEADING_RAD2,
    Endpoint,
    GraphToken,
    Ros2,
    TopicKey,
    clock_message,
    dds_type,
    fix_message,
    parse_token,
    parse_topic,
)
from vnet.node import Fix

pytestmark = pytest.mark.slow

STORE = get_typestore(Stores.ROS2_JAZZY)
STRING_HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
QOS = "::,7:,:,:,,"
DESIGN_TOKENS = [
    "@ros2_lv/0/aac3178e146ba6f1fc6e6a4085e77f21/0/0/NN/%/%/listener",
    "@ros2_lv/0/8b20917502ee955ac4476e0266340d5c/0/10/MP/%/%/talker/%chatter/std_msgs::msg::dds_::String_/"
    f"{STRING_HASH}/{QOS}",
]
"""Examples of rmw_zenoh's design document."""

names = st.from_regex(r"[a-z][a-z0-9]{0,8}(_[a-z0-9]{1,4})?", fullmatch=True)
paths = st.lists(names, min_size=1, max_size=4).map(lambda parts: "/" + "/".join(parts))
types = st.tuples(names, st.sampled_from(["msg", "srv", "action"]), names.map(str.capitalize)).map("/".join)
hashes = st.one_of(st.binary(min_size=32, max_size=32).map(lambda each: f"RIHS01_{each.hex()}"))
numbers = st.integers(0, 2**31)
topic_keys = st.builds(TopicKey, st.integers(0, 232), paths, types, st.just("TypeHashNotSupported") | hashes)
endpoints = st.builds(Endpoint, paths, types, hashes, st.just(QOS))


@st.composite
def graph_tokens(draw: st.DrawFn) -> GraphToken:
    kind = draw(st.sampled_from(["NN", "MP", "MS", "SS", "SC"]))
    endpoint = None if kind == "NN" else draw(endpoints)
    session = draw(st.binary(min_size=16, max_size=16)).hex()
    where = draw(st.integers(0, 232)), session, draw(numbers), draw(numbers)
    return GraphToken(*where, kind, "/", draw(st.just("/") | paths), draw(names), endpoint)  # type: ignore[arg-type]


@given(topic_keys)
def test_a_topics_key_reads_as_composed_and_others_compose_the_same(topic: TopicKey) -> None:
    assert parse_topic(topic.key) == topic
    assert parse_topic(f"{topic.key}/@adv/pub/8b20917502ee/3/_") == topic
    assert sdk_keys.topic_keyexpr(topic.domain, topic.topic, dds_type(topic.type), topic.type_hash) == topic.key
    assert dds_type(topic.type) == pamoja.dds_type_name(topic.type)
    if topic.type_hash.startswith("RIHS01_"):
        assert pamoja.entity_key(topic.domain, topic.topic, topic.type, topic.type_hash) == topic.key


@given(graph_tokens())
def test_a_token_reads_as_composed_and_others_compose_the_same(token: GraphToken) -> None:
    assert parse_token(token.key) == token
    assert parse_topic(token.key) is None
    node = sdk_entity.NodeEntity(token.domain, token.session, token.node_id, token.node, token.namespace)
    if token.endpoint is not None:
        kind = sdk_entity.EntityKind(token.kind)
        topic, ros_type, type_hash, qos = token.endpoint
        entity = sdk_entity.EndpointEntity(node, token.entity_id, kind, topic, dds_type(ros_type), type_hash, qos)
        assert sdk_keys.endpoint_liveliness_keyexpr(entity) == token.key
        assert f"/{pamoja.percent_mangle(topic)}/" in token.key
    elif token.entity_id == token.node_id:
        assert sdk_keys.node_liveliness_keyexpr(node) == token.key


@given(st.integers(0, 2**63 - 1), st.integers(0, 2**63 - 1), st.binary(min_size=16, max_size=16))
def test_an_attachment_is_composed_as_by_others(seq: int, time_ns: int, gid: bytes) -> None:
    assert ATTACHMENT.size == 33
    assert sdk_attachment.Attachment(seq, time_ns, gid).to_bytes() == ATTACHMENT.pack(seq, time_ns, GID_BYTES, gid)


@given(st.text() | st.text("@ros2_lv/0aMPSNC%:").map("@ros2_lv/".__add__))
def test_no_text_fails_to_be_read(text: str) -> None:
    token = parse_token(text)
    assert token is None or token.key.count("/") == text.count("/")
    parse_topic(text)
    Ros2("v01", [], 0).crosses(text)


@pytest.mark.parametrize("key", DESIGN_TOKENS)
def test_examples_of_the_design_document_compose_byte_by_byte(key: str) -> None:
    token = parse_token(key)
    assert token is not None
    assert token.key == key
    assert token.node_name in ("/listener", "/talker")


@pytest.mark.parametrize(
    "key",
    [
        DESIGN_TOKENS[0].replace("NN", "MP"),
        DESIGN_TOKENS[1].replace("MP", "NN"),
        DESIGN_TOKENS[1].replace("MP", "XX"),
        DESIGN_TOKENS[1].replace("/10/", "/x/"),
        DESIGN_TOKENS[1].replace("::dds_", ""),
        f"{DESIGN_TOKENS[0]}/more",
        "0/chatter/std_msgs::msg::String_/hash",
        "x/chatter/std_msgs::msg::dds_::String_/hash",
        "0/std_msgs::msg::dds_::String_/hash",
    ],
)
def test_what_only_resembles_ros_2_is_no_part_of_it(key: str) -> None:
    assert parse_token(key) is None
    assert parse_topic(key) is None


@pytest.mark.parametrize("ros_type", [CLOCK_TYPE, FIX_TYPE])
@pytest.mark.parametrize("distribution", [Stores.ROS2_JAZZY, Stores.LATEST])
def test_hashes_of_published_types_are_those_of_their_definitions(ros_type: str, distribution: Stores) -> None:
    assert get_typestore(distribution).hash_rihs01(ros_type) == TYPE_HASHES[ros_type]
    assert pamoja.type_hash_digest(TYPE_HASHES[ros_type]) is not None


@given(st.integers(0, 2**31 * 10**9 - 1))
def test_a_clock_reads_as_written(time_ns: int) -> None:
    message: Any = STORE.deserialize_cdr(clock_message(time_ns), CLOCK_TYPE)
    clock = message.clock
    assert clock.sec * 10**9 + clock.nanosec == time_ns
    assert bytes(STORE.serialize_cdr(STORE.types[CLOCK_TYPE](clock), CLOCK_TYPE)) == clock_message(time_ns)


@pytest.mark.parametrize("heading_rad", [None, 0.0, 2.0, -3.0])
def test_a_fix_reads_as_written(heading_rad: float | None) -> None:
    fix = Fix(12_000_000_034, np.array([3.0, -4.0]), np.array([[2.0, 0.5], [0.5, 1.0]]), heading_rad)
    content = fix_message(fix)
    message: Any = STORE.deserialize_cdr(content, FIX_TYPE)
    assert bytes(STORE.serialize_cdr(message, FIX_TYPE)) == content
    assert (message.header.stamp.sec, message.header.stamp.nanosec, message.header.frame_id) == (12, 34, "map")
    pose, covariance = message.pose.pose, message.pose.covariance.reshape(6, 6)
    assert (pose.position.x, pose.position.y, pose.position.z) == (3.0, -4.0, 0.0)
    assert 2 * math.atan2(pose.orientation.z, pose.orientation.w) == pytest.approx(heading_rad or 0.0)
    assert covariance[:2, :2].tolist() == [[2.0, 0.5], [0.5, 1.0]]
    assert covariance[5, 5] == (UNKNOWN_HEADING_RAD2 if heading_rad is None else 0.0)


def test_topics_cross_with_their_tokens_or_stay_inside_with_them() -> None:
    rules = Ros2("v01", ["/tf", "/camera/**", "/*/get_parameters"], 0)
    crosses = {
        "/chatter": True,
        "/tf": False,
        "/tf_static": True,
        "/v01/tf": True,
        "/camera/left/image": False,
        "/talker/get_parameters": False,
        "/clock": False,
        "/vnet/fix": False,
    }
    for topic, expected in crosses.items():
        assert rules.crosses(TopicKey(3, topic, "std_msgs/msg/String", STRING_HASH).key) == expected
        endpoint = Endpoint(topic, "std_msgs/msg/String", STRING_HASH, QOS)
        assert rules.crosses(GraphToken(3, "ab", 0, 1, "MS", "/", "/", "node", endpoint).key) == expected
    assert rules.crosses(DESIGN_TOKENS[0])
    assert rules.crosses("car/v01/pose")


def test_vnets_own_topics_are_published_in_its_domain_in_sequence_and_never_cross() -> None:
    ros2 = Ros2("v01", [], 7)
    tokens = [parse_token(key) for key in ros2.tokens("ab")]
    assert [token and (token.domain, token.session, token.kind) for token in tokens] == [
        (7, "ab", kind) for kind in ("NN", "MP", "MP")
    ]
    published = [ros2.clock(10), ros2.clock(20)]
    attachments = [ATTACHMENT.unpack(each.attachment) for each in published]
    assert [each[:2] for each in attachments] == [(1, 10), (2, 20)]
    assert len({gid for *_, gid in attachments}) == 1
    other = ATTACHMENT.unpack(Ros2("v02", [], 7).clock(10).attachment)
    assert other[-1] != attachments[0][-1]
    topic = parse_topic(published[0].key)
    assert topic is not None and (topic.domain, topic.topic, topic.type) == (7, "/clock", CLOCK_TYPE)
    announced = {token.endpoint[:3] for token in tokens if token is not None and token.endpoint is not None}
    assert topic[1:] in announced
    assert not any(map(ros2.crosses, [published[0].key, *ros2.tokens("ab")]))


NODE = """
    import sys, time, zenoh
    session, own = zenoh.open(zenoh.Config()), sys.argv[1]
    KEY = "0/{}/std_msgs::msg::dds_::String_/TypeHashNotSupported"
    hear = lambda sample: print(own, "heard", sample.key_expr, len(sample.payload), sample.attachment is not None)
    subscribers = [session.declare_subscriber(KEY.format(topic), hear) for topic in ("chatter", "tf")]
    subscribers += [session.declare_subscriber(key, hear) for key in ("0/clock/**", "0/vnet/**")]
    serve = lambda query: query.reply(query.key_expr, b"yes")
    service = None if own == "v01" else session.declare_queryable(KEY.format("serve"), serve, complete=True)
    tokens = []
    for number, (kind, topic) in enumerate([("MP", "chatter"), ("SC" if own == "v01" else "SS", "serve")]):
        endpoint = f"%{topic}/std_msgs::msg::dds_::String_/TypeHashNotSupported/::,10:,:,:,,"
        key = f"@ros2_lv/0/{own}/0/{number}/{kind}/%/%/node/{endpoint}"
        tokens.append(session.liveliness().declare_token(key))
    time.sleep(0.5)
    if own == "v01":
        for topic in ("chatter", "tf"):
            session.put(KEY.format(topic), b"hello", attachment=b"33")
        client = session.declare_querier(KEY.format("serve"), target=zenoh.QueryTarget.ALL_COMPLETE)
        print("may be served", client.matching_status.matching)
        for reply in client.get():
            print("answered", reply.ok.payload.to_string())
    time.sleep(1)
"""


def test_rules_services_clock_and_fixes_hold_on_virtual_time(drive: Drive) -> None:
    run = drive(NODE, vehicles=2, radio={"profile": "ros2", "ros2": {"clock_hz": 4.0}})
    assert {"may be served True", "answered yes"} <= set(log(run))
    heard = [line.split()[2:] for line in log(run, "v02") if " heard " in line]
    topics = {topic.topic: (size, attached) for key, size, attached in heard if (topic := parse_topic(key))}
    assert topics == {"/chatter": ("5", "True"), "/clock": ("12", "True"), "/vnet/fix": ("364", "True")}
    assert 5 <= sum(key.startswith("0/clock/") for key, *_ in heard) <= 7


def test_two_clients_that_share_no_code_run_unmodified_on_virtual_time(tmp_path: Path) -> None:
    """All of it replays: who hears whom, who answers, and what is seen of the graph."""
    nodes = str(ROOT / "tests/system/ros2_nodes.py")
    scenario = {
        "run": {"duration_s": 8.0, "settle_s": 0.0},
        "network": {"vehicles": 2},
        "radio": {"range_m": 1e5, "profile": "ros2", "ros2": {"domain": 7}},
        "program": {
            "kind": "zenoh",
            "command": ["python", nodes, "sdk", "v01", "v02"],
            "exceptions": [{"nodes": ["v02"], "command": ["python", nodes, "pamoja", "v02", "v01"]}],
            "zenoh": {"liveliness_s": 0.3},
        },
        "fault": [{"kind": "partition", "at_s": 3.0, "duration_s": 3.0, "groups": [["v01"], ["v02"]]}],
    }
    first, again = (emulator.simulate(scenario, out=tmp_path / name) for name in ("first", "again"))
    assert first.trace.to_pylist() == again.trace.to_pylist()
    told = {node: [line.split() for line in log(first, node)] for node in ("v01", "v02")}
    assert told == {node: [line.split() for line in log(again, node)] for node in ("v01", "v02")}
    heard = [int(line[1]) for line in told["v02"] if line[0] == "heard"]
    of_sdk = [number for number in heard if number < FIRST_OF_PAMOJA]
    (cut,) = [number for number, after in pairwise(of_sdk) if after != number + 1]
    assert of_sdk[: of_sdk.index(cut) + 1] == list(range(cut + 1)), "all are heard before the partition"
    assert max(int(line[1]) for line in told["v01"] if line[0] == "heard") > FIRST_OF_PAMOJA + 20
    for lines in told.values():
        answers = [line for line in lines if line[0] == "answered"]
        assert len(answers) >= 3
        assert all(int(total) == int(number) + 1 for _, number, total, *_ in answers)
    seen = [change for word, change, *key in told["v02"] if word == "token" and key[0].endswith("/0/NN/%/%/v01")]
    assert seen == ["there", "gone", "there"]


def test_mcap_has_messages_with_schemas_of_ros_2_where_the_definition_is_known(drive: Drive) -> None:
    program = f"""
        import sys, zenoh
        session, own = zenoh.open(zenoh.Config()), sys.argv[1]
        hashes = {{"chatter": "{STRING_HASH}", "old": "TypeHashNotSupported", "odd": "RIHS01_00"}}
        for name, type_hash in hashes.items():
            key = f"0/{{name}}/std_msgs::msg::dds_::String_/{{type_hash}}"
            session.put(key, bytes.fromhex("000100000c000000") + b"hello from \\0")
    """
    run = drive(program, radio={"profile": "ros2", "max_payload_bytes": 120}, run={"keep_payloads": True})
    file = io.BytesIO()
    write_mcap(RecordedRun.open(run.folder), file)
    file.seek(0)
    schemas = {}
    for schema, channel, message in make_reader(file).iter_messages():
        if channel.message_encoding == "cdr":
            told: Any = STORE.deserialize_cdr(message.data, "std_msgs/msg/String")
            assert told.data == "hello from "
            schemas[channel.topic] = schema and (schema.name, schema.encoding, schema.data.decode())
    known = ("std_msgs/msg/String", "ros2msg", "string data\n")
    assert schemas == {"/v01/chatter": known, "/v01/old": known, "/v01/odd": None}


def test_given_definitions_come_first_where_a_message_has_no_hash(tmp_path: Path) -> None:
    """A folder may have all types of a distribution, other definitions of which rosbags has."""
    (tmp_path / "sensor_msgs/msg").mkdir(parents=True)
    (tmp_path / "sensor_msgs/msg/Range.msg").write_text("float32 range")
    stores = _typestores(tmp_path)
    assert _definition(stores, "sensor_msgs/msg/Range", "TypeHashNotSupported") == b"float32 range\n"
    newest = get_typestore(Stores.LATEST)
    expected = newest.generate_msgdef("sensor_msgs/msg/Range", ros_version=2)[0].encode()
    assert _definition(stores, "sensor_msgs/msg/Range", newest.hash_rihs01("sensor_msgs/msg/Range")) == expected


@pytest.mark.parametrize("named", ["HUMBLE", "JAZZY", "LATEST"])
def test_a_type_has_the_definition_of_its_own_distribution(named: str) -> None:
    """Humble tells no hashes, and its Range has no variance."""
    store = get_typestore(Stores.LATEST if named == "LATEST" else Stores[f"ROS2_{named}"])
    name = "sensor_msgs/msg/Range"
    type_hash = "TypeHashNotSupported" if named == "HUMBLE" else store.hash_rihs01(name)
    found = _definition(_typestores(None), name, type_hash)
    assert found == store.generate_msgdef(name, ros_version=2)[0].encode()
    assert (b"variance" in found) == (named != "HUMBLE")


def test_mcap_has_schemas_of_own_types_whose_definitions_are_given(drive: Drive, tmp_path: Path) -> None:
    (tmp_path / "fleet/msg").mkdir(parents=True)
    (tmp_path / "fleet/msg/Status.msg").write_text("string name\nfleet/Speed speed\n")
    own = get_typestore(Stores.LATEST)
    own.register(get_types_from_msg("float64 m_s\n", "fleet/msg/Speed"))
    own.register(get_types_from_msg("string name\nfleet/Speed speed\n", "fleet/msg/Status"))
    program = f"""
        import zenoh
        key = "0/status/fleet::msg::dds_::Status_/{own.hash_rihs01("fleet/msg/Status")}"
        zenoh.open(zenoh.Config()).put(key, b"content")
    """
    run = RecordedRun.open(drive(program, radio={"profile": "ros2"}, run={"keep_payloads": True}).folder)
    told: list[str] = []
    write_mcap(run, io.BytesIO(), tell=told.append)
    write_mcap(run, io.BytesIO(), tmp_path / "fleet", told.append)  # which lacks a type that it uses
    assert [text.partition(" has no")[0] for text in told] == ["fleet/msg/Status of v01/status"] * 2
    (tmp_path / "fleet/msg/Speed.msg").write_text("float64 m_s\n")
    write_mcap(run, file := io.BytesIO(), tmp_path, told.append)
    file.seek(0)
    schemas = {channel.topic: schema for schema, channel, _ in make_reader(file).iter_messages()}
    assert (found := schemas["/v01/status"]) is not None and found.name == "fleet/msg/Status" and len(told) == 2
    (tmp_path / "fleet/msg/Speed.msg").write_text("float64/// m_s\n")
    for folder, text in (
        (tmp_path / "none", "has no PACKAGE/msg"),
        (tmp_path, "is no definition of fleet/msg/Speed"),
    ):
        with pytest.raises(VnetError, match=text):
            write_mcap(run, io.BytesIO(), folder)


def test_figures_are_by_topic_and_type_with_the_nodes_that_send(drive: Drive) -> None:
    run = drive(NODE, vehicles=2, radio={"profile": "ros2"})
    found = {(each.kind, each.key): each for each in key_figures(RecordedRun.open(run.folder))}
    for kind, topic, nodes in (
        ("put", "/chatter", {"v01 /node"}),
        ("query", "/serve", {"v01 /node"}),
        ("reply", "/serve", {"v02 /node"}),
    ):
        figures = found.pop((kind, f"{topic} std_msgs/msg/String"))
        assert (figures.messages, figures.arrived, figures.nodes) == (1, 1, nodes)
    assert found.keys() == {("tokens", "/node")}
