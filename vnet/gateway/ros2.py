"""ROS 2 on Zenoh as rmw_zenoh has it: keys, liveliness tokens, attachments, and which topics cross the radio.

docs/design.md of https://github.com/ros2/rmw_zenoh describes the format; docs/how-to/ros2.md is the guide.
"""

from __future__ import annotations

import math
import re
import struct
from collections import Counter
from collections.abc import Sequence
from functools import lru_cache
from hashlib import blake2b
from typing import Literal, NamedTuple

import zenoh

from vnet.gateway.keys import OWN_KEYS, RADIO_KEYS
from vnet.node import Fix
from vnet.units import NS_PER_S

TOKENS = "@ros2_lv"
"""First part of the keys of liveliness tokens, which make up ROS 2's graph."""
ROS2_KEYS = (*RADIO_KEYS, f"{TOKENS}/**")
"""Key expressions that cross the radio with `radio.profile = "ros2"` if `radio.keys` is left out."""
OWN_NAMESPACE = f"/{OWN_KEYS.rstrip('/')}"
CLOCK_TOPIC, FIX_TOPIC = "/clock", f"{OWN_NAMESPACE}/fix"
CLOCK_TYPE, FIX_TYPE = "rosgraph_msgs/msg/Clock", "geometry_msgs/msg/PoseWithCovarianceStamped"
TYPE_HASHES = {
    CLOCK_TYPE: "RIHS01_692f7a66e93a3c83e71765d033b60349ba68023a8c689a79e48078bcb5c58564",
    FIX_TYPE: "RIHS01_26432f9803e43727d3c8f668d1fdb3c630f548af631e2f4e31382371bfea3b6e",
}
"""Hashes of the types that vnet publishes: those of Iron and all later distributions."""
FRAME = b"map\0"
"""Name of the frame of fixes: the network's, x to the east and y to the north."""
UNKNOWN_HEADING_RAD2 = math.pi**2 / 3
"""Variance of a heading of which nothing is known."""
QOS = "::,10:,:,:,,"
"""Quality of service of what vnet publishes, as tokens have it: reliable, volatile, the last 10 samples."""
MOST_KEYS = 4096
"""Keys for which it is remembered whether they cross."""

EntityKind = Literal["NN", "MP", "MS", "SS", "SC"]
"""Node, publisher, subscription, service, client."""

_TYPE = r"(\w+)::(\w+)::dds_::(\w+)_"
_DATA = re.compile(rf"(\d{{1,9}})/(.+?)/{_TYPE}/([^/@]+)(?:/@adv/.*)?", re.ASCII)
_NUMBER, _NAME = r"(\d{1,19})", "([^/]*)"
_TOKEN = re.compile(
    rf"{TOKENS}/{_NUMBER}/{_NAME}/{_NUMBER}/{_NUMBER}/(NN|MP|MS|SS|SC)/{_NAME}/{_NAME}/{_NAME}"
    rf"(?:/{_NAME}/{_TYPE}/{_NAME}/{_NAME})?",
    re.ASCII,
)
_TIME = struct.Struct("<4siI")
_POSE = struct.Struct("<4siII4s7d36d")
_CDR_LITTLE_ENDIAN = b"\x00\x01\x00\x00"
ATTACHMENT, GID_BYTES = struct.Struct("<qqB16s"), 16
"""Attachment of each sample, request and response: sequence number, time in ns, length of the sender's id, id."""


def dds_type(ros_type: str) -> str:
    """Return the name of a type in keys: `std_msgs::msg::dds_::String_` of `std_msgs/msg/String`."""
    package, kind, name = ros_type.split("/")
    return f"{package}::{kind}::dds_::{name}_"


class TopicKey(NamedTuple):
    """The key of a topic's samples, or of a service's queries. `topic` begins with a slash."""

    domain: int
    topic: str
    type: str
    type_hash: str

    @property
    def key(self) -> str:
        """The key on Zenoh."""
        return f"{self.domain}{self.topic}/{dds_type(self.type)}/{self.type_hash}"


def parse_topic(key: str) -> TopicKey | None:
    """Return what a key of ROS 2 says, or a key below it of an advanced publisher; None for any other key."""
    found = _DATA.fullmatch(key)
    if found is None:
        return None
    domain, topic, *names, type_hash = found.groups()
    return TopicKey(int(domain), f"/{topic}", "/".join(names), type_hash)


class Endpoint(NamedTuple):
    """Topic or service of a token, with its type and its quality of service."""

    topic: str
    type: str
    type_hash: str
    qos: str


class GraphToken(NamedTuple):
    """A node, or what it publishes, subscribes to, serves or asks. Names are ROS 2's, with slashes."""

    domain: int
    session: str
    node_id: int
    entity_id: int
    kind: EntityKind
    enclave: str
    namespace: str
    node: str
    endpoint: Endpoint | None = None
    """The topic or service; None of a node."""

    @property
    def key(self) -> str:
        """The key on Zenoh."""
        numbers = f"{TOKENS}/{self.domain}/{self.session}/{self.node_id}/{self.entity_id}/{self.kind}"
        parts = [numbers, *map(_mangled, (self.enclave, self.namespace, self.node))]
        if self.endpoint is not None:
            topic, ros_type, type_hash, qos = self.endpoint
            parts += [_mangled(topic), dds_type(ros_type), type_hash, qos]
        return "/".join(parts)

    @property
    def node_name(self) -> str:
        """The node's full name."""
        return f"{self.namespace.rstrip('/')}/{self.node}"


def parse_token(key: str) -> GraphToken | None:
    """Return what a token of ROS 2's graph says; None for any other key."""
    found = _TOKEN.fullmatch(key)
    if found is None:
        return None
    domain, session, node_id, entity_id, kind, *names, topic, package, part, name, type_hash, qos = found.groups()
    is_node = kind == "NN"
    if is_node == (topic is not None):
        return None
    endpoint = None if is_node else Endpoint(_demangled(topic), f"{package}/{part}/{name}", type_hash, qos)
    enclave, namespace, node = map(_demangled, names)
    numbers = int(domain), session, int(node_id), int(entity_id)
    return GraphToken(*numbers, kind, enclave, namespace, node, endpoint)  # type: ignore[arg-type]


def _mangled(name: str) -> str:
    return name.replace("/", "%")


def _demangled(name: str) -> str:
    return name.replace("%", "/")


class Published(NamedTuple):
    """A sample that vnet publishes at a vehicle's own programs."""

    key: str
    payload: bytes
    attachment: bytes


class Ros2:
    """ROS 2 in one vehicle: what of its topics and services crosses the radio, and what vnet publishes there.

    Topics that `inside` matches stay in the vehicle, with their tokens, and so do `/clock` and `/vnet/**`.
    """

    def __init__(self, vehicle: str, inside: Sequence[str], domain: int) -> None:
        self._vehicle, self._domain = vehicle, domain
        own = (CLOCK_TOPIC, f"{OWN_NAMESPACE}/**")
        self._inside = [zenoh.KeyExpr.autocanonize(name.removeprefix("/")) for name in (*inside, *own)]
        self._sequences: Counter[str] = Counter()
        self.fix_key = self._key(FIX_TOPIC, FIX_TYPE)
        """Key under which fixes are published."""
        self.crosses = lru_cache(MOST_KEYS)(self._crosses)
        """Return whether what has this key is sent by the radio, as far as topics say."""

    def _crosses(self, key: str) -> bool:
        token = parse_token(key)
        if token is not None and token.endpoint is None:
            return token.namespace != OWN_NAMESPACE
        named = parse_topic(key) if token is None else token.endpoint
        if named is None:
            return True
        topic = named.topic.removeprefix("/")
        return not any(expression.intersects(topic) for expression in self._inside)

    def tokens(self, session: str) -> list[str]:
        """Return the tokens of vnet's own node, whose topics a session publishes."""
        place = (self._domain, session, 0)
        names = ("/", OWN_NAMESPACE, "gateway")
        tokens = [GraphToken(*place, 0, "NN", *names)]
        for number, (topic, ros_type) in enumerate([(CLOCK_TOPIC, CLOCK_TYPE), (FIX_TOPIC, FIX_TYPE)], start=1):
            endpoint = Endpoint(topic, ros_type, TYPE_HASHES[ros_type], QOS)
            tokens.append(GraphToken(*place, number, "MP", *names, endpoint))
        return [token.key for token in tokens]

    def clock(self, time_ns: int) -> Published:
        """Return the sample that tells emulated time."""
        return self._published(CLOCK_TOPIC, CLOCK_TYPE, clock_message(time_ns), time_ns)

    def fix(self, fix: Fix) -> Published:
        """Return the sample of a fix."""
        return self._published(FIX_TOPIC, FIX_TYPE, fix_message(fix), fix.time_ns)

    def _published(self, topic: str, ros_type: str, payload: bytes, time_ns: int) -> Published:
        self._sequences[topic] += 1
        gid = blake2b(f"{self._vehicle}{topic}".encode(), digest_size=GID_BYTES).digest()
        attachment = ATTACHMENT.pack(self._sequences[topic], time_ns, GID_BYTES, gid)
        return Published(self._key(topic, ros_type), payload, attachment)

    def _key(self, topic: str, ros_type: str) -> str:
        return TopicKey(self._domain, topic, ros_type, TYPE_HASHES[ros_type]).key


def clock_message(time_ns: int) -> bytes:
    """Return a `rosgraph_msgs/msg/Clock` in CDR."""
    return _TIME.pack(_CDR_LITTLE_ENDIAN, *divmod(time_ns, NS_PER_S))


def fix_message(fix: Fix) -> bytes:
    """Return a fix as `geometry_msgs/msg/PoseWithCovarianceStamped` in CDR, in the metres of the network.

    z, roll and pitch are 0, and exactly so. An unknown heading is 0 with the variance of a uniform one.
    """
    x, y = fix.position_m.tolist()
    half = (fix.heading_rad or 0.0) / 2
    (xx, xy), (yx, yy) = fix.covariance_m2.tolist()
    covariance = [0.0] * 36
    covariance[0], covariance[1], covariance[6], covariance[7] = xx, xy, yx, yy
    covariance[35] = UNKNOWN_HEADING_RAD2 if fix.heading_rad is None else 0.0
    pose = (x, y, 0.0, 0.0, 0.0, math.sin(half), math.cos(half))
    stamp = divmod(fix.time_ns, NS_PER_S)
    return _POSE.pack(_CDR_LITTLE_ENDIAN, *stamp, len(FRAME), FRAME, *pose, *covariance)
