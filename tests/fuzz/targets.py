"""What is fuzzed: each target reads bytes of others and may only raise its documented error, said in one line.

To add one, append a `Target` to `TARGETS`: a function bytes -> None, the errors it may raise, and a few inputs that
it accepts. The tests in this folder and `make fuzz` take it from there.
"""

import functools
import io
import json
import os
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from agents.cooperative import frame as cooperative_frame
from emulator.drivers.control import answer
from emulator.drivers.emulation import Emulation
from emulator.drivers.status import Course
from emulator.records.run_folder import RunFolder
from emulator.scenario.faults import KINDS, parse_fault
from emulator.scenario.scenario import Network, Radio, Scenario, dump_scenario, load_scenario
from emulator.scenario.sumo import input_files, read_begin_s
from emulator.world.links import load_links
from emulator.world.maps.files import read_roads
from emulator.world.networks import load_network
from emulator.world.trips.drive import drive
from emulator.world.world import build_world
from tests.support import maps
from vnet.errors import LONGEST_MESSAGE, ScenarioError, TransportError, VnetError, WireError
from vnet.node import Report
from vnet.roads.road_map import RoadMap
from vnet.transport import wire
from vnet.transport.access import Access
from vnet.transport.credentials import Credentials
from vnet.types import Mask

OVERRIDE = b"\n--set "
"""Stands between a scenario file and each override in one input of the scenario target."""


@dataclass(frozen=True)
class Target:
    """Something that reads bytes. `seeds` are inputs it accepts, `words` what its inputs are made of."""

    name: str
    read: Callable[[bytes], None]
    may_raise: type[Exception]
    seeds: tuple[bytes, ...]
    words: tuple[bytes, ...] = ()

    def try_out(self, data: bytes) -> bool:
        """Whether `data` was accepted. Whatever is neither that nor a decent refusal is raised."""
        try:
            self.read(data)
        except self.may_raise as error:
            text = str(error)
            assert text.isprintable(), f"not one line: {text[:200]!r}"
            assert len(text) < LONGEST_MESSAGE, f"{len(text)} characters: {text[:200]!r}"
            return False
        return True


# Messages.


def _read_tx(data: bytes) -> None:
    _comes_back(wire.decode_tx(data), wire.decode_tx)


def _read_rx(data: bytes) -> None:
    message = wire.decode_rx(data)
    if isinstance(message, wire.Grant | wire.Batch):
        for packet in message.packets:
            packet.packet()
        for fix in message.fixes:
            fix.fix()
    _comes_back(message, wire.decode_rx)


def _read_report(data: bytes) -> None:
    _comes_back(wire.decode_report(data), wire.decode_report)


def _comes_back(message: Any, decode: Callable[[bytes], Any]) -> None:
    encoded = wire.encode(message)
    assert wire.encode(decode(encoded)) == encoded


def _read_observation(data: bytes) -> None:
    wire.decode_observation(data)


def _read_frame(data: bytes) -> None:
    frame = cooperative_frame.decode(data)
    if len(frame.heard) == data[1]:  # names that stand there twice are taken once
        assert cooperative_frame.decode(cooperative_frame.encode(frame)).heard == frame.heard


def _read_fault(data: bytes) -> None:
    try:
        plain = json.loads(data)
    except (ValueError, RecursionError):
        return  # what is no JSON never reaches the function
    fault = parse_fault(plain)
    assert parse_fault(fault.model_dump(mode="json")) == fault


# Files.


def temporary_folder() -> tempfile.TemporaryDirectory[str]:
    """A folder, in memory where the system has such a place: a disk takes a millisecond a file."""
    memory = Path("/dev/shm")
    return tempfile.TemporaryDirectory(prefix="vnet-fuzz-", dir=memory if memory.is_dir() else None)


@functools.cache
def _temporary() -> tempfile.TemporaryDirectory[str]:
    return temporary_folder()


def _folder() -> Path:
    return Path(_temporary().name)


def _file(name: str, data: bytes) -> Path:
    path = _folder() / name
    path.write_bytes(data)
    return path


def _read_scenario(data: bytes) -> None:
    text, *overrides = data.split(OVERRIDE)
    _file("network.csv", _NETWORK)
    scenario = load_scenario(_file("scenario.toml", text), [os.fsdecode(override) for override in overrides])
    assert 0 <= scenario.duration_ns < 2**62 and 0 < scenario.period_ns < 2**62
    resolved = dump_scenario(scenario)
    assert dump_scenario(load_scenario(_file("resolved.toml", resolved.encode()))) == resolved


def _read_network(data: bytes) -> None:
    network = load_network(_file("n.csv", data))
    assert len(network.node_ids) == len(network.position_m) == len(network.heading_rad)
    assert np.isfinite(network.position_m).all() and np.isfinite(network.heading_rad).all()


def _read_links(data: bytes) -> None:
    links = load_links(Radio(links=_file("links.csv", data)), 2)
    assert links is not None and links.shape == (2, 2) and not links.diagonal().any()


def _read_trips(name: str, data: bytes) -> None:
    """Trips, as a world of them reads them: the reader that goes with the file's name, and what it makes of it."""
    network = Network(kind="trips", path=_file(name, data), origin_deg=(42.0, -83.0))
    motion = drive(network, 21, 10**8)
    there: Mask = np.logical_and.reduce(np.isfinite(motion.position_m), axis=2)
    assert motion.position_m.shape == (21, len(motion.node_ids), 2) and there[:20].any(axis=0).all()


def _read_map(name: str, data: bytes) -> None:
    """A map, as those who use it have it: its lanes."""
    lanes = read_roads(_file(name, data)).lane_map()
    assert np.isfinite(lanes.point_m).all() and (lanes.length_m > 0).all()
    RoadMap.from_wire(lanes.to_wire())


def _pbf() -> bytes:
    with temporary_folder() as folder:
        return maps.write_pbf(Path(folder) / "town.osm.pbf").read_bytes()


def _read_sumo(data: bytes) -> None:
    path = _file("town.sumocfg", data)
    input_files(path)
    assert np.isfinite(read_begin_s(path))


def _npz(**arrays: Any) -> bytes:
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


def _read_credentials(data: bytes) -> None:
    credentials = Credentials.load(_file("credentials.json", data))
    assert Credentials.load(_file("again.json", credentials.dumps().encode())) == credentials


def _read_access(data: bytes) -> None:
    _file("access.json", data)
    access = Access.load(_folder())
    access.access_control()
    assert len(access.dictionary().splitlines()) == len(access.passwords)
    for user in access.passwords:
        access.credentials(user)


# Seeds.

_TRAFFIC = wire.Traffic(
    [wire.Frame("v01", b"payload")],
    [Report(5, "v01", (1.0, 2.0), (1.0, 0.0, 0.0, 1.0), {"mean_m": [0.5, 0.5], "n": 3.0})],
    [wire.Ending("v01", "crashed", "boom", "Traceback")],
)
_PACKET = wire.WirePacket("v01", "v02", 5, 6, b"payload")
_FIX = wire.WireFix("v01", 5, (1.0, 2.0), (1.0, 0.0, 0.0, 1.0), 0.5)
_TX: tuple[wire.AgentMessage, ...] = (
    wire.Hello("v01", "v01", b"n" * 16, 1, "host", True, None),
    wire.Hello("v01", "v01", b"n" * 16, 1, "host", False, "cannot import"),
    wire.Yield(b"n" * 16, 3, 100, ["v01"], [], _TRAFFIC),
    wire.Frames(b"n" * 16, 3, 3, [(1, 2)], _TRAFFIC, wire.Lateness([1] * wire.LATENESS_BINS), True),
    wire.StackDump(b"n" * 16, "File …"),
)
_RX: tuple[wire.EmulatorMessage, ...] = (
    wire.Welcome(
        "v01",
        b"n" * 16,
        0,
        "lockstep",
        "a:b",
        {"a": [1, 2.5, "x"]},
        [[0, 0], [0], 0.85],
        7,
        10**8,
        1400,
        5.0,
        100,
        "b",
    ),
    wire.Grant(1, 100, [_PACKET], [_FIX], [wire.ClockError("v01", 5, -3, 0.5)]),
    wire.Batch([_FIX], 1, [_PACKET], 12345, 5, True),
    wire.StackRequest(),
    wire.Await(1.5),
    wire.End(None, "over", False),
)
_NETWORK = b"id,x_m,y_m,heading_rad\nv01,0,0,0\nv02,100.5,-2e3,3.14\n"
_SCENARIO = b"""[run]
name = "a"
seed = 3
duration_s = 1.5
pacing = "realtime"
[network]
vehicles = 2
layout = "dense"
[world.common_error]
sigma_m = 3.0
[radio]
loss = 0.1
links = [[0, 1], [0, 0]]
[program]
entry = "a.b:c"
options = { a = 1, b = ["x", 2.5], c = { d = true } }
"""
_FAULTS = b"""[run]
duration_s = 60.0
[[fault]]
kind = "partition"
groups = [["v01"], ["v02"]]
duration_s = 3.0
[[fault]]
kind = "loss"
probability = 0.5
nodes = { fraction = 0.3 }
senders = { disc = [0.0, 0.0, 100.0] }
at_s = 5.0
duration_s = 3
[[program.exceptions]]
nodes = ["v01"]
entry = "a:b"
"""
_FILES = b"""[network]
kind = "file"
path = "network.csv"
[inputs]
x = "sha"
"""
_FAULT_SEEDS = (
    b'{"kind": "kill", "nodes": {"ids": ["v01"]}, "at_s": 1.5, "duration_s": 2}',
    b'{"kind": "partition", "groups": [["v01"], ["v02", "v03"]], "duration_s": 2}',
    b'{"kind": "block", "senders": {"polygon": [[0, 0], [1, 0], [0, 1]]}, "duration_s": 1}',
    b'{"kind": "skew", "offset_ms": -3.5, "nodes": {"degree": [1, 2]}, "duration_s": 1}',
)
_FAULT_WORDS = tuple(
    f'"{word}"'.encode()
    for word in (*KINDS, "kind", "nodes", "ids", "fraction", "random", "disc", "polygon", "degree")
)
_ACCESS = (
    b'{"run": "r", "processes": [["v01", "v02"]], '
    b'"passwords": {"node-v01": "a", "emulator": "b", "observer": "c", "operator": "d"}}'
)


def _frame_seeds() -> tuple[bytes, ...]:
    relayed = np.array([(7, 1, 100, 5, -5)], dtype=cooperative_frame.RELAYED)
    return tuple(
        cooperative_frame.encode(
            cooperative_frame.CooperativeFrame(
                10**8,
                np.array([1.0, 2.0]),
                heading,
                np.array([0.5, -0.5]),
                np.array([[1.0, 0.1], [0.1, 1.0]]),
                3,
                (0.5, -0.5, 1.0),
                heard,
                np.zeros((len(heard), 2)),
                relayed[: len(heard)],
                4,
            )
        )
        for heading, heard in ((None, {}), (1.0, {"00000001": True, "0a0b0c0d": False}))
    )


_MSGPACK_WORDS = (
    *(b"\xa5Hello", b"\xa5Yield", b"\xa6Frames", b"\xa8Standing", b"\xa7Welcome", b"\xa5Grant", b"\xa5Batch"),
    *(b"\xa5Where", b"\xa3End", b"\x93", b"\x90", b"\x80", b"\xc0", b"\xc4\x01", b"\xcf", b"\xcb", b"\xa3v01"),
    *(b"\xdd\x80\x00\x00\x00", b"\xdf\x80\x00\x00\x00", b"\xc6\x80\x00\x00\x00", b"\xdb\x80\x00\x00\x00"),
)
_TOML_WORDS = (
    *(b"[run]", b"[network]", b"[world.gnss]", b"[radio]", b"[program]", b"[program.options]", b"[inputs]", b"[["),
    *(b"name", b"seed", b"duration_s", b"pacing", b"kind", b"path", b"links", b"loss", b"entry", b"options", b"="),
    *(b'"""', b"'''", b"nan", b"inf", b"-inf", b"0x", b"1e999", b"1979-05-27T07:32:00Z", b"07:32:00", b"true"),
    *(b"\\u0000", b"\\U0010ffff", OVERRIDE, b"radio.loss=", b"network.path='network.csv'", b"network.kind='file'"),
)
_CSV_WORDS = (
    b"id,x_m,y_m,heading_rad\n",
    b"nan",
    b"inf",
    b"1e308",
    b'"',
    b"\r",
    b"\0",
    b"\xef\xbb\xbf",
    b"1_0",
    b"0,1\n",
)
_TRIPS = (
    b"id,time_s,x_m,y_m\na,0,0,0\na,1,10,0\na,2,20,0\nb,0.5,5,5\nb,2.5,5,5\n",
    b"id,time_s,lat_deg,lon_deg,speed_mps\na,0,42.0,-83.0,1\na,2,42.0001,-83.0,1\n",
)
_FCD = b"""<fcd-export>
<timestep time="0.00"><vehicle id="a" x="0" y="0" angle="90" speed="10"/></timestep>
<timestep time="2.00"><vehicle id="a" x="20" y="0" angle="90" speed="10"/></timestep>
</fcd-export>
"""
_SUMO = b"""<configuration><input><net-file value="a.net.xml"/></input><time><begin value="1:00:00"/></time>
</configuration>
"""
_XML_WORDS = (
    b"<!DOCTYPE",
    b"<!ENTITY",
    b"&",
    b"<![CDATA[",
    b"]]>",
    b"-->",
    b"<?xml",
    b'encoding="UTF-16"',
    b"nan",
    b"/>",
)
_NET = b"""<net version="1.20"><location netOffset="0,0" projParameter="+proj=utm +zone=17 +datum=WGS84"/>
<edge id="a" from="1" to="2" type="highway.primary"><lane id="a_0" shape="0,0 9,0 9,5" width="3.5"/></edge></net>
"""
_OSM = b"""<osm version="0.6"><node id="1" lat="42.28" lon="-83.74"/><node id="2" lat="42.281" lon="-83.74"/>
<way id="7"><nd ref="1"/><nd ref="2"/><tag k="highway" v="primary"/><tag k="lanes" v="3"/></way></osm>
"""
_GEOJSON = (
    b'{"type": "FeatureCollection", "features": [{"type": "Feature", "properties": {"class": "primary"}, '
    b'"geometry": {"type": "LineString", "coordinates": [[-83.74, 42.28], [-83.73, 42.28]]}}]}'
)
_JSON_WORDS = (
    b'"user"',
    b'"password"',
    b'"run"',
    b'"processes"',
    b'"passwords"',
    b'"tls"',
    b"null",
    b"[[",
    b"{}",
    b"\\u000a",
)


@functools.cache
def _small_run() -> tuple[Emulation, Course]:
    scenario = Scenario.model_validate({"network": {"vehicles": 3}})
    folder = RunFolder.create(Path(tempfile.mkdtemp(prefix="vnet-fuzz-")) / "run", scenario)
    emulation = Emulation(scenario, build_world(scenario), folder)
    return emulation, Course(emulation)


def _read_query(data: bytes) -> None:
    """A query of an operator: its verb, a line, and its payload."""
    verb, _, payload = data.partition(b"\n")
    emulation, course = _small_run()
    try:
        json.dumps(
            answer(emulation, course, verb.decode(errors="replace"), payload, 1_000_000_000, own_router=False)
        )
    finally:
        emulation.faults.faults.clear()


_QUERIES = (
    b"status\n",
    *(b"inject\n" + seed for seed in _FAULT_SEEDS),
    b'heal\n"all"',
)

TARGETS = (  # the slowest first
    Target(
        "scenario",
        _read_scenario,
        ScenarioError,
        (_SCENARIO, _FAULTS, _FILES, b"" + OVERRIDE + b"radio.loss=0.3"),
        _TOML_WORDS,
    ),
    Target(
        "trips CSV", partial(_read_trips, "t.csv"), ScenarioError, _TRIPS, (*_CSV_WORDS, b"lat_deg", b",time_s")
    ),
    Target("trips FCD", partial(_read_trips, "t.xml"), ScenarioError, (_FCD,), _XML_WORDS),
    Target(
        "trips NPZ",
        partial(_read_trips, "t.npz"),
        ScenarioError,
        (_npz(x_m=np.array([[0.0, 1, 2, 3]]), y_m=np.zeros((1, 4)), rate_hz=2.0),),
    ),
    Target("map OSM", partial(_read_map, "m.osm"), ScenarioError, (_OSM,), (*_XML_WORDS, b"lanes:forward", b"-1")),
    Target("map PBF", partial(_read_map, "m.osm.pbf"), ScenarioError, (_pbf(),)),
    Target(
        "map SUMO", partial(_read_map, "m.net.xml"), ScenarioError, (_NET,), (*_XML_WORDS, b"1e308,", b"+proj=")
    ),
    Target("map GeoJSON", partial(_read_map, "m.geojson"), ScenarioError, (_GEOJSON,), _JSON_WORDS),
    Target(
        "map NPZ",
        partial(_read_map, "m.npz"),
        ScenarioError,
        (_npz(node_x_m=np.array([0.0, 9, 9]), node_y_m=np.zeros(3), edges=np.array([(0, 1), (1, 0)])),),
    ),
    Target("sumocfg", _read_sumo, ScenarioError, (_SUMO,), _XML_WORDS),
    Target("network CSV", _read_network, ScenarioError, (_NETWORK,), _CSV_WORDS),
    Target("fault", _read_fault, ScenarioError, _FAULT_SEEDS, _FAULT_WORDS),
    Target("control query", _read_query, VnetError, _QUERIES, _FAULT_WORDS),
    Target("links CSV", _read_links, ScenarioError, (b"0,1\n1,0\n", b"0,1.0\n\n0,0\n"), _CSV_WORDS),
    Target("access.json", _read_access, TransportError, (_ACCESS,), _JSON_WORDS),
    Target(
        "credentials", _read_credentials, TransportError, (b'{"user": "node-v01", "password": "p"}',), _JSON_WORDS
    ),
    Target("cooperative frame", _read_frame, cooperative_frame.FrameError, _frame_seeds()),
    Target(
        "observation", _read_observation, WireError, (wire.encode_observation({"a": [1, b"x"]}),), _MSGPACK_WORDS
    ),
    Target("report", _read_report, WireError, (wire.encode(_TRAFFIC.reports[0]),), _MSGPACK_WORDS),
    Target("tx", _read_tx, WireError, tuple(map(wire.encode, _TX)), _MSGPACK_WORDS),
    Target("rx", _read_rx, WireError, tuple(map(wire.encode, _RX)), _MSGPACK_WORDS),
)
