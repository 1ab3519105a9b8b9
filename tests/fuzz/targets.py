"""Fuzzing targets: each reads untrusted bytes and may only raise its documented error, in one line.

To add one, append a `Target` to `TARGETS`: a function bytes -> None, the errors it may raise, and a few inputs that
it accepts. The tests in this folder and `make fuzz` take it from there.
"""

import functools
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
from agents.cooperative import information_frame
from agents.cooperative.frame import FrameError
from emulator.drivers.control import answer
from emulator.drivers.emulation import Emulation
from emulator.drivers.hosts import messages
from emulator.drivers.status import Course
from emulator.records.run_folder import RunFolder
from emulator.scenario.faults import parse_fault
from emulator.scenario.loading import dump_scenario, load_scenario
from emulator.scenario.network import Network, input_files, read_begin_s
from emulator.scenario.program import Program
from emulator.scenario.scenario import Radio, Scenario
from emulator.world.buildings import LEAST_CORNERS
from emulator.world.maps.files import read_buildings, read_roads
from emulator.world.networks import load_network
from emulator.world.projection import CoordinateFrame
from emulator.world.radio_inputs import LinkTable, load_links
from emulator.world.trips.drive import drive
from emulator.world.world import build_world
from tests.fuzz.seeds import (
    ACCESS,
    BUILDINGS,
    CSV_WORDS,
    FAULT_SEEDS,
    FAULT_WORDS,
    FAULTS,
    FCD,
    FILES,
    GEOJSON,
    HOST_TX,
    JSON_WORDS,
    LINK_TABLE,
    MSGPACK_WORDS,
    NET,
    NETWORK,
    OSM,
    OSM_BUILDING,
    OVERRIDE,
    POLYGON,
    QUERIES,
    RX,
    SCENARIO,
    SUMO,
    SUMO_POLYGONS,
    TOML_WORDS,
    TRIPS,
    TX,
    UNIT_SENT,
    XML_WORDS,
    frame_seeds,
    information_frame_seeds,
    npz,
    pbf,
    temporary_folder,
)
from vnet.errors import LONGEST_MESSAGE, ScenarioError, TransportError, VnetError, WireError
from vnet.roads.road_map import RoadMap
from vnet.transport import wire
from vnet.transport.access import Access
from vnet.transport.credentials import Credentials
from vnet.types import Mask


@dataclass(frozen=True)
class Target:
    """A function that reads untrusted bytes. `seeds` are inputs it accepts, `words` parts of its format."""

    name: str
    read: Callable[[bytes], object]
    may_raise: type[Exception]
    seeds: tuple[bytes, ...]
    words: tuple[bytes, ...] = ()

    def try_out(self, data: bytes) -> bool:
        """Return true if `data` was accepted, false if it was refused as documented. Raise anything else."""
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


def _read_host_tx(data: bytes) -> None:
    message = messages.decode_from_host(data)
    assert messages.decode_from_host(messages.encode(message)) == message


def _read_unit_tx(data: bytes) -> None:
    sent = wire.decode_sent(data)
    assert wire.decode_sent(wire.encode(sent)) == sent
    sent.message("rsu01")


def _read_rx(data: bytes) -> None:
    message = wire.decode_rx(data)
    if isinstance(message, wire.Grant | wire.Batch):
        for packet in message.packets:
            packet.packet()
        for fix in message.fixes:
            fix.fix()
    _comes_back(message, wire.decode_rx)


def _comes_back(message: Any, decode: Callable[[bytes], Any]) -> None:
    encoded = wire.encode(message)
    assert wire.encode(decode(encoded)) == encoded


def _read_frame(module: Any, data: bytes) -> None:
    frame = module.decode(data)
    if len(frame.heard) == data[1]:  # repeated names count once
        assert module.decode(module.encode(frame)).heard == frame.heard


def _read_fault(data: bytes) -> None:
    try:
        plain = json.loads(data)
    except (ValueError, RecursionError):
        return  # the function only gets valid JSON
    fault = parse_fault(plain)
    assert parse_fault(fault.model_dump(mode="json")) == fault


# Files.


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
    _file("network.csv", NETWORK)
    scenario = load_scenario(_file("scenario.toml", text), [os.fsdecode(override) for override in overrides])
    assert 0 <= scenario.duration_ns < 2**62 and 0 < scenario.period_ns < 2**62
    resolved = dump_scenario(scenario)
    assert dump_scenario(load_scenario(_file("resolved.toml", resolved.encode()))) == resolved


def _read_network(data: bytes) -> None:
    network = load_network(_file("n.csv", data))
    assert len(network.node_ids) == len(network.position_m) == len(network.heading_rad)
    assert np.isfinite(network.position_m).all() and np.isfinite(network.heading_rad).all()


def _read_links(data: bytes) -> None:
    links = load_links(Radio(links=_file("links.csv", data)), ["a", "b"])
    if isinstance(links, LinkTable):
        assert (np.diff(links.time_ns, prepend=0) >= 0).all() and (links.sender != links.receiver).all()
        assert len(links.loss_at(2**62)) == len(links.pairs[0])
    else:
        assert links is not None and links.shape == (2, 2) and not links.diagonal().any()


def _read_buildings(name: str, data: bytes) -> None:
    buildings = read_buildings(_file(name, data), lambda: CoordinateFrame.around(42.0, -83.0))
    assert len(buildings) and np.isfinite(buildings.corner_m).all()
    assert (np.diff(buildings.first) >= LEAST_CORNERS).all() and len(buildings.edges_m()) == buildings.first[-1]


def _read_trips(name: str, data: bytes) -> None:
    """Read trips as a world does, with the reader for the file's name, and drive them."""
    network = Network(kind="trips", path=_file(name, data), origin_deg=(42.0, -83.0))
    motion = drive(network, Program(), 21, 10**8)
    there: Mask = np.logical_and.reduce(np.isfinite(motion.position_m), axis=2)
    assert motion.position_m.shape == (21, len(motion.node_ids), 2) and there[:20].any(axis=0).all()


def _read_map(name: str, data: bytes) -> None:
    """Read a map and build its lanes."""
    lanes = read_roads(_file(name, data)).lane_map()
    assert np.isfinite(lanes.point_m).all() and (lanes.length_m > 0).all()
    RoadMap.from_wire(lanes.to_wire())


def _read_sumo(data: bytes) -> None:
    path = _file("town.sumocfg", data)
    input_files(path)
    assert np.isfinite(read_begin_s(path))


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


@functools.cache
def _small_run() -> tuple[Emulation, Course]:
    scenario = Scenario.model_validate({"network": {"vehicles": 3}})
    folder = RunFolder.create(Path(tempfile.mkdtemp(prefix="vnet-fuzz-")) / "run", scenario)
    emulation = Emulation(scenario, build_world(scenario), folder)
    return emulation, Course(emulation)


def _read_query(data: bytes) -> None:
    """Answer an operator's query: its verb, a line break, and its payload."""
    verb, _, payload = data.partition(b"\n")
    emulation, course = _small_run()
    try:
        json.dumps(
            answer(emulation, course, verb.decode(errors="replace"), payload, 1_000_000_000, own_router=False)
        )
    finally:
        emulation.faults.faults.clear()


TARGETS = (  # the slowest first
    Target(
        "scenario",
        _read_scenario,
        ScenarioError,
        (SCENARIO, FAULTS, FILES, b"" + OVERRIDE + b"radio.loss=0.3"),
        TOML_WORDS,
    ),
    Target("trips CSV", partial(_read_trips, "t.csv"), ScenarioError, TRIPS, (*CSV_WORDS, b"lat_deg", b",time_s")),
    Target("trips FCD", partial(_read_trips, "t.xml"), ScenarioError, (FCD,), XML_WORDS),
    Target(
        "trips NPZ",
        partial(_read_trips, "t.npz"),
        ScenarioError,
        (npz(x_m=np.array([[0.0, 1, 2, 3]]), y_m=np.zeros((1, 4)), rate_hz=2.0),),
    ),
    Target("map OSM", partial(_read_map, "m.osm"), ScenarioError, (OSM,), (*XML_WORDS, b"lanes:forward", b"-1")),
    Target("map PBF", partial(_read_map, "m.osm.pbf"), ScenarioError, (pbf(),)),
    Target("map SUMO", partial(_read_map, "m.net.xml"), ScenarioError, (NET,), (*XML_WORDS, b"1e308,", b"+proj=")),
    Target("map GeoJSON", partial(_read_map, "m.geojson"), ScenarioError, (GEOJSON,), JSON_WORDS),
    Target(
        "map NPZ",
        partial(_read_map, "m.npz"),
        ScenarioError,
        (npz(node_x_m=np.array([0.0, 9, 9]), node_y_m=np.zeros(3), edges=np.array([(0, 1), (1, 0)])),),
    ),
    Target("sumocfg", _read_sumo, ScenarioError, (SUMO,), XML_WORDS),
    Target("network CSV", _read_network, ScenarioError, (NETWORK,), CSV_WORDS),
    Target("fault", _read_fault, ScenarioError, FAULT_SEEDS, FAULT_WORDS),
    Target("control query", _read_query, VnetError, QUERIES, FAULT_WORDS),
    Target("links CSV", _read_links, ScenarioError, (b"0,1\n1,0\n", b"0,1.0\n\n0,0\n", LINK_TABLE), CSV_WORDS),
    Target("buildings CSV", partial(_read_buildings, "b.csv"), ScenarioError, (BUILDINGS,), CSV_WORDS),
    Target("buildings SUMO", partial(_read_buildings, "b.poly.xml"), ScenarioError, (SUMO_POLYGONS,), XML_WORDS),
    Target("buildings OSM", partial(_read_buildings, "b.osm"), ScenarioError, (OSM_BUILDING,), XML_WORDS),
    Target("buildings GeoJSON", partial(_read_buildings, "b.geojson"), ScenarioError, (POLYGON,), JSON_WORDS),
    Target("access.json", _read_access, TransportError, (ACCESS,), JSON_WORDS),
    Target(
        "credentials", _read_credentials, TransportError, (b'{"user": "node-v01", "password": "p"}',), JSON_WORDS
    ),
    Target("cooperative frame", partial(_read_frame, cooperative_frame), FrameError, frame_seeds()),
    Target("information frame", partial(_read_frame, information_frame), FrameError, information_frame_seeds()),
    Target(
        "observation",
        wire.decode_observation,
        WireError,
        (wire.encode_observation({"a": [1, b"x"]}),),
        MSGPACK_WORDS,
    ),
    Target("tx", _read_tx, WireError, tuple(map(wire.encode, TX)), MSGPACK_WORDS),
    Target("host tx", _read_host_tx, WireError, tuple(map(messages.encode, HOST_TX)), MSGPACK_WORDS),
    Target("unit tx", _read_unit_tx, WireError, (wire.encode(UNIT_SENT),), MSGPACK_WORDS),
    Target("rx", _read_rx, WireError, tuple(map(wire.encode, RX)), MSGPACK_WORDS),
)
