"""A little town in every kind of map file, written by code.

Metres are around `ORIGIN`: Main Street from (0, 0) by (200, 0) to (400, 0), primary, and from its middle Side
Street, one way north to (200, 150), residential.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
import osmium

from emulator.world.projection import CoordinateFrame

ORIGIN = (42.28, -83.74)
FRAME = CoordinateFrame.around(*ORIGIN)
NODES = {1: (0.0, 0.0), 2: (200.0, 0.0), 3: (200.0, 150.0), 4: (400.0, 0.0)}
WAYS: dict[int, tuple[Sequence[int], dict[str, str]]] = {
    10: ((1, 2, 4), {"highway": "primary", "name": "Main Street"}),
    11: ((2, 3), {"highway": "residential", "oneway": "yes", "name": "Side Street"}),
}
UTM = "+proj=utm +zone=17 +ellps=WGS84 +datum=WGS84 +units=m +no_defs"
Ways = Mapping[int, tuple[Sequence[int], Mapping[str, str]]]


def degrees(node: int) -> tuple[float, float]:
    """Longitude and latitude of a node."""
    latitude, longitude = FRAME.to_wgs84(np.array(NODES[node]))
    return float(longitude), float(latitude)


def osm_xml(ways: Ways = WAYS, nodes: Sequence[int] = tuple(NODES)) -> str:
    """OpenStreetMap's XML."""
    lines = ['<?xml version="1.0" encoding="UTF-8"?>', '<osm version="0.6">']
    for node in nodes:
        lon, lat = degrees(node)
        lines.append(f'<node id="{node}" lat="{lat:.7f}" lon="{lon:.7f}" version="1"/>')
    for way, (along, tags) in ways.items():
        lines.append(f'<way id="{way}" version="1">')
        lines += [f'<nd ref="{node}"/>' for node in along]
        lines += [f"<tag k={quoteattr(key)} v={quoteattr(value)}/>" for key, value in tags.items()]
        lines.append("</way>")
    return "\n".join([*lines, "</osm>", ""])


def write_pbf(path: Path, ways: Ways = WAYS) -> Path:
    """OpenStreetMap's PBF, by pyosmium's own writer."""
    with osmium.SimpleWriter(path) as writer:
        for node in NODES:
            writer.add_node(osmium.osm.mutable.Node(id=node, version=1, location=degrees(node)))
        for way, (along, tags) in ways.items():
            writer.add_way(osmium.osm.mutable.Way(id=way, version=1, nodes=along, tags=dict(tags)))
    return path


def line(points: Sequence[Sequence[Any]], **properties: object) -> dict[str, Any]:
    """A feature of GeoJSON."""
    geometry = {"type": "LineString", "coordinates": points}
    return {"type": "Feature", "properties": properties, "geometry": geometry}


def collection(*features: object) -> str:
    """A document of GeoJSON."""
    return json.dumps({"type": "FeatureCollection", "features": features})


def geojson(**more: str) -> str:
    """The town as GeoJSON; properties are those of OpenStreetMap, and more."""
    return collection(*(line([degrees(node) for node in along], **tags, **more) for along, tags in WAYS.values()))


def arrays(**changes: Any) -> dict[str, Any]:
    """The town as nodes and edges: numbers from 0, classes and lanes not stated. None leaves an array out."""
    lon, lat = np.array([degrees(node) for node in NODES]).T
    edges = np.array([(0, 1), (1, 0), (1, 3), (3, 1), (1, 2)])
    found = {"node_lon_deg": lon, "node_lat_deg": lat, "edges": edges, **changes}
    return {name: array for name, array in found.items() if array is not None}


def sumo_net(location: str = "", more: str = "") -> str:
    """The town as SUMO knows it: lanes of 3.2 m, right of the middle; a crossing in the middle, and a pavement."""
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<net version="1.20" junctionCornerDetail="5">
    {location}
    <edge id=":2_0" function="internal">
        <lane id=":2_0_0" index="0" speed="13.89" length="8.00" shape="196.00,-1.60 204.00,-1.60"/>
    </edge>
    <edge id=":2_c0" function="crossing">
        <lane id=":2_c0_0" index="0" allow="pedestrian" width="4.00" shape="195.00,-4.00 195.00,4.00"/>
    </edge>
    <edge id="west" from="1" to="2" priority="9" type="highway.primary">
        <lane id="west_0" index="0" allow="pedestrian" width="2.00" shape="0.00,-4.20 196.00,-4.20"/>
        <lane id="west_1" index="1" disallow="tram rail" speed="13.89" shape="0.00,-1.60,3.0 196.00,-1.60,3.0"/>
    </edge>
    <edge id="-west" from="2" to="1" priority="9" type="highway.primary">
        <lane id="-west_0" index="0" speed="13.89" shape="196.00,1.60 0.00,1.60"/>
    </edge>
    <edge id="east" from="2" to="4" type="highway.primary">
        <lane id="east_0" index="0" speed="13.89" width="3.50" shape="204.00,-1.60 400.00,-1.60"/>
    </edge>
    <junction id="2" type="priority" x="200.00" y="0.00" incLanes="west_1" intLanes=":2_0_0" shape="0,0 1,1"/>
    {more}
</net>
"""
