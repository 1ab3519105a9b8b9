"""Inputs that fuzzing starts from: accepted inputs of each target, and words of their formats."""

import io
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from agents.cooperative import frame as cooperative_frame
from agents.cooperative import information_frame
from emulator.drivers.hosts import messages
from emulator.scenario.faults import KINDS
from tests.support import maps
from vnet.radio import SentFrame
from vnet.reports import Report
from vnet.transport import wire
from vnet.transport.wire import Sent

OVERRIDE = b"\n--set "
"""Separator between a scenario file and each override in one input of the scenario target."""


def temporary_folder() -> tempfile.TemporaryDirectory[str]:
    """Return a temporary folder, in memory if the system has one: a disk takes a millisecond a file."""
    memory = Path("/dev/shm")
    return tempfile.TemporaryDirectory(prefix="vnet-fuzz-", dir=memory if memory.is_dir() else None)


def npz(**arrays: Any) -> bytes:
    """Return an NPZ file with these arrays."""
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


def pbf() -> bytes:
    """Return a small town as an OpenStreetMap PBF file."""
    with temporary_folder() as folder:
        return maps.write_pbf(Path(folder) / "town.osm.pbf").read_bytes()


TRAFFIC = wire.Traffic(
    [SentFrame("v01", b"payload")],
    [Report(5, "v01", (1.0, 2.0), (1.0, 0.0, 0.0, 1.0), {"mean_m": [0.5, 0.5], "n": 3.0})],
    [wire.Ending("v01", "crashed", "boom", "Traceback")],
    [wire.Unhandled("v01", 5, "boom", "in a task", "Traceback")],
    [wire.Note("v01", 5, "event", "info", "turned", {"left": True, "n": 1})],
)
PACKET = wire.WirePacket("v01", "v02", 5, 6, b"payload")
FIX = wire.WireFix("v01", 5, (1.0, 2.0), (1.0, 0.0, 0.0, 1.0), 0.5, 13.9)
TX: tuple[wire.AgentMessage, ...] = (
    wire.Hello("v01", "v01", b"n" * 16, 1, "host", True, None, 2),
    wire.Hello("v01", "v01", b"n" * 16, 1, "host", False, "cannot import", 2),
    wire.Yield(b"n" * 16, 3, 100, ["v01"], [], [wire.Step(50, TRAFFIC)], 1),
    wire.Frames(b"n" * 16, 3, 3, [(1, 2)], TRAFFIC, wire.Lateness([1] * wire.LATENESS_BINS), True),
    wire.Final(b"n" * 16, TRAFFIC),
    wire.StackDump(b"n" * 16, "File …", 5),
)
UNIT_SENT = Sent(b"nonce", 3, "rsu02", b"payload")
HOST_TX: tuple[messages.FromHost, ...] = (
    messages.HostHello("a", b"n" * 16, 1, "there", "digest", True, None),
    messages.Calls(
        b"n" * 16,
        [
            ("message", "v01", wire.encode(TX[2])),
            ("token", "v01", True),
            ("ended", "v01", 1, -9, "a line", None),
            ("log_tail", "v01", "a line"),
            ("part", "file", "v01", "a/b", b"data"),
            ("left_out", "file", "v01", 1, ["a: a link"]),
            ("figures", {"v01": 5}, [("v01", [0.0, 0.5], [1, 2])]),
            ("handing_in",),
            ("handed_in",),
        ],
    ),
)
RX: tuple[wire.EmulatorMessage, ...] = (
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
    wire.Grant(1, 100, 200, [PACKET], [FIX], [wire.ClockError("v01", 5, -3, 0.5)]),
    wire.Batch([FIX], 1, [PACKET], 12345, 5, True),
    wire.StackRequest(),
    wire.Await(1.5),
    wire.End(None, "over", False),
)
NETWORK = b"id,x_m,y_m,heading_rad\nv01,0,0,0\nv02,100.5,-2e3,3.14\n"
SCENARIO = b"""[run]
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
FAULTS = b"""[run]
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
FILES = b"""[network]
kind = "file"
path = "network.csv"
[inputs]
x = "sha"
"""
FAULT_SEEDS = (
    b'{"kind": "kill", "nodes": {"ids": ["v01"]}, "at_s": 1.5, "duration_s": 2}',
    b'{"kind": "partition", "groups": [["v01"], ["v02", "v03"]], "duration_s": 2}',
    b'{"kind": "block", "senders": {"polygon": [[0, 0], [1, 0], [0, 1]]}, "duration_s": 1}',
    b'{"kind": "skew", "offset_ms": -3.5, "nodes": {"degree": [1, 2]}, "duration_s": 1}',
)
FAULT_WORDS = tuple(
    f'"{word}"'.encode()
    for word in (*KINDS, "kind", "nodes", "ids", "fraction", "count", "disc", "polygon", "degree")
)
ACCESS = (
    b'{"run": "r", "processes": [["v01", "v02"]], '
    b'"passwords": {"node-v01": "a", "emulator": "b", "observer": "c", "operator": "d"}}'
)


def frame_seeds() -> tuple[bytes, ...]:
    """Return frames of the cooperative positioning program."""
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


def information_frame_seeds() -> tuple[bytes, ...]:
    """Return frames of vehicles that exchange information."""
    one, passed = (1.0, 0.1, 1.0, 0.5, -0.5), np.ones(2, dtype=information_frame.PASSED)
    passed["information"] = one
    return tuple(
        information_frame.encode(
            information_frame.InformationFrame(
                "0a0b0c0d", 10**8, one, one, 3, (0.5, -0.5, 1.0), heard, passed[: len(heard)], 4
            )
        )
        for heard in ({}, {"00000001": True, "00000002": False})
    )


MSGPACK_WORDS = (
    *(b"\xa5Hello", b"\xa5Yield", b"\xa6Frames", b"\xa9StackDump", b"\xa7Welcome", b"\xa5Grant", b"\xa5Batch"),
    *(
        b"\xacStackRequest",
        b"\xa3End",
        b"\x93",
        b"\x90",
        b"\x80",
        b"\xc0",
        b"\xc4\x01",
        b"\xcf",
        b"\xcb",
        b"\xa3v01",
    ),
    *(b"\xdd\x80\x00\x00\x00", b"\xdf\x80\x00\x00\x00", b"\xc6\x80\x00\x00\x00", b"\xdb\x80\x00\x00\x00"),
)
TOML_WORDS = (
    *(b"[run]", b"[network]", b"[world.gnss]", b"[radio]", b"[program]", b"[program.options]", b"[inputs]", b"[["),
    *(b"name", b"seed", b"duration_s", b"pacing", b"kind", b"path", b"links", b"loss", b"entry", b"options", b"="),
    *(b'"""', b"'''", b"nan", b"inf", b"-inf", b"0x", b"1e999", b"1979-05-27T07:32:00Z", b"07:32:00", b"true"),
    *(b"\\u0000", b"\\U0010ffff", OVERRIDE, b"radio.loss=", b"network.path='network.csv'", b"network.kind='file'"),
)
CSV_WORDS = (
    b"id,x_m,y_m,heading_rad\n", b"nan", b"inf", b"1e308", b'"', b"\r", b"\0", b"\xef\xbb\xbf", b"1_0",
    b"0,1\n",
)  # fmt: skip
TRIPS = (
    b"id,time_s,x_m,y_m\na,0,0,0\na,1,10,0\na,2,20,0\nb,0.5,5,5\nb,2.5,5,5\n",
    b"id,time_s,lat_deg,lon_deg,speed_mps\na,0,42.0,-83.0,1\na,2,42.0001,-83.0,1\n",
)
FCD = b"""<fcd-export>
<timestep time="0.00"><vehicle id="a" x="0" y="0" angle="90" speed="10"/></timestep>
<timestep time="2.00"><vehicle id="a" x="20" y="0" angle="90" speed="10"/></timestep>
</fcd-export>
"""
SUMO = b"""<configuration><input><net-file value="a.net.xml"/></input><time><begin value="1:00:00"/></time>
</configuration>
"""
XML_WORDS = (
    b"<!DOCTYPE", b"<!ENTITY", b"&", b"<![CDATA[", b"]]>", b"-->", b"<?xml", b'encoding="UTF-16"', b"nan",
    b"/>",
)  # fmt: skip
NET = b"""<net version="1.20"><location netOffset="0,0" projParameter="+proj=utm +zone=17 +datum=WGS84"/>
<edge id="a" from="1" to="2" type="highway.primary"><lane id="a_0" shape="0,0 9,0 9,5" width="3.5"/></edge></net>
"""
OSM = b"""<osm version="0.6"><node id="1" lat="42.28" lon="-83.74"/><node id="2" lat="42.281" lon="-83.74"/>
<way id="7"><nd ref="1"/><nd ref="2"/><tag k="highway" v="primary"/><tag k="lanes" v="3"/></way></osm>
"""
OSM_BUILDING = b"""<osm version="0.6"><node id="1" lat="42.28" lon="-83.74"/>
<node id="2" lat="42.281" lon="-83.74"/><node id="3" lat="42.281" lon="-83.741"/>
<way id="7"><nd ref="1"/><nd ref="2"/><nd ref="3"/><nd ref="1"/>
<tag k="building" v="yes"/></way></osm>
"""
BUILDINGS = b"building,x_m,y_m\na,0,0\na,9,0\na,9,9\nb,20,0\nb,29,0\nb,29,9\nb,20,0\n"
SUMO_POLYGONS = b"""<additional><poly id="1" type="building" shape="0,0 9,0 9,9"/></additional>"""
LINK_TABLE = b"time_s,sender,receiver,loss\n0,a,b,0.5\n0,b,a,0\n1.5,a,b,\n"
POLYGON = (
    b'{"type": "FeatureCollection", "features": [{"type": "Feature", "properties": {"building": "yes"}, '
    b'"geometry": {"type": "Polygon", "coordinates": [[[-83.74, 42.28], [-83.73, 42.28], [-83.73, 42.29]]]}}]}'
)
GEOJSON = (
    b'{"type": "FeatureCollection", "features": [{"type": "Feature", "properties": {"class": "primary"}, '
    b'"geometry": {"type": "LineString", "coordinates": [[-83.74, 42.28], [-83.73, 42.28]]}}]}'
)
JSON_WORDS = (
    b'"user"', b'"password"', b'"run"', b'"processes"', b'"passwords"', b'"tls"', b"null", b"[[", b"{}",
    b"\\u000a",
)  # fmt: skip


QUERIES = (b"status\n", *(b"inject\n" + seed for seed in FAULT_SEEDS), b'heal\n"all"')
