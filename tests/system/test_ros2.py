"""Two independent clients of ROS 2 as vehicles of a run in real time."""

import re
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from rosbags.typesys import Stores, get_typestore

from tests.system.conftest import Finished, Vnet
from tests.system.ros2_nodes import FIRST_OF_PAMOJA, PAMOJA_GID, TWIST
from tests.system.test_zenoh import SLOW
from vnet.gateway.ros2 import ATTACHMENT, CLOCK_TYPE, FIX_TYPE, parse_topic

NODES = Path(__file__).parent / "ros2_nodes.py"
SCENARIO = f"""
[run]
name = "ros2"
pacing = "realtime"
duration_s = 8.0
settle_s = 0.0

[network]
vehicles = 2

[radio]
range_m = 100000.0
profile = "ros2"
ros2 = {{ domain = 7, graph = "GRAPH" }}

[program]
kind = "zenoh"
command = ["python", "{NODES}", "sdk", "v01", "v02"]
zenoh = {{ liveliness_s = 0.3 }}

[[program.exceptions]]
nodes = ["v02"]
command = ["python", "{NODES}", "pamoja", "v02", "v01"]

[[fault]]
kind = "partition"
at_s = 3.0
duration_s = 3.0
groups = [["v01"], ["v02"]]
"""


def lines(done: Finished, node: str, word: str) -> list[list[str]]:
    text = (done.folder / f"logs/{node}.log").read_text()
    return [line.split()[1:] for line in text.splitlines() if line.startswith(f"{word} ")]


@pytest.mark.parametrize("graph", ["range", "always"])
def test_two_clients_hear_ask_and_see_each_other_as_far_as_the_radio_carries(
    vnet: Vnet, tmp_path: Path, graph: str
) -> None:
    (tmp_path / "ros2.toml").write_text(SCENARIO.replace("GRAPH", graph))
    done = vnet("run", str(tmp_path / "ros2.toml"), "--report")
    assert done.status in SLOW
    assert done.check("conservation")["verdict"] == done.check("isolation")["verdict"] == "valid"
    sent = pq.read_table(done.folder / "samples.parquet").to_pylist()
    rows = [row for row in done.trace() if row["outcome"] == "delivered" and row["receiver"] != row["sender"]]
    delivered = {(row["sender"], row["seq"]) for row in rows}

    def arrived(sender: str, kind: str, name: str) -> int:
        """Return the messages on a topic or service that have arrived at the other vehicle."""
        topics = [(row, parse_topic(row["key"])) for row in sent if (row["sender"], row["kind"]) == (sender, kind)]
        return sum(
            all((sender, row["seq"] + part) in delivered for part in range(row["frames"]))
            for row, topic in topics
            if topic is not None and (topic.domain, topic.topic) == (7, name)
        )

    # Topics, both ways, each message with its attachment.
    ((gid,),) = lines(done, "v01", "gid")
    attached = lines(done, "v02", "heard")
    heard = [(int(number), ATTACHMENT.unpack(bytes.fromhex(hexed))) for number, hexed in attached]
    of_sdk = [number for number, (*_, sender) in heard if sender.hex() == gid]
    assert of_sdk == [number for number, _ in heard if number < FIRST_OF_PAMOJA]
    assert 0 < len(of_sdk) <= arrived("v01", "put", "/cmd_vel")
    for number, (sequence, *_, sender) in heard:
        assert (sequence, sender.hex()) in [(number, gid), (number - FIRST_OF_PAMOJA, PAMOJA_GID.hex())]
    of_pamoja = [number for (number,) in lines(done, "v01", "heard") if int(number) >= FIRST_OF_PAMOJA]
    assert 0 < len(of_pamoja) <= arrived("v02", "put", "/cmd_vel")

    # Services, both ways.
    for node, other in (("v01", "v02"), ("v02", "v01")):
        answers = lines(done, node, "answered")
        assert 0 < len(answers) <= arrived(other, "reply", f"/{other}/add")
        assert all(int(total) == int(number) + 1 for number, total, *_ in answers)
    for asked, _, hexed in lines(done, "v02", "answered"):
        sequence, *_, sender = ATTACHMENT.unpack(bytes.fromhex(hexed))
        assert (sequence, sender) == (int(asked), PAMOJA_GID)

    # The graph.
    seen: dict[str, list[str]] = {}
    for change, key in lines(done, "v02", "token"):
        seen.setdefault(key, []).append(change)
    nodes = [changes for key, changes in seen.items() if re.search(r"/0/NN/%/%/v01$", key)]
    assert nodes == [["there", "gone", "there"] if graph == "range" else ["there"]]
    assert any("/SS/%/%/v01/%v01%add/" in key for key in seen)
    assert ("tokens" in {row["kind"] for row in sent}) == (graph == "range")

    if graph == "range":
        page = (done.folder / "report.html").read_text()
        assert f"/cmd_vel {TWIST} in domain 7" in page
        assert "v01 /v01" in page

    # What stays inside, and what vnet tells.
    assert not [row for row in sent for name in ("/tf", "clock", "/vnet/") if name in row["key"]]
    store = get_typestore(Stores.ROS2_JAZZY)
    told: dict[str, list[float]] = {}
    for key, hexed in lines(done, "v02", "own"):
        topic = parse_topic(key)
        assert topic is not None
        message: Any = store.deserialize_cdr(bytes.fromhex(hexed), topic.type)
        stamp = message.clock if topic.type == CLOCK_TYPE else message.header.stamp
        told.setdefault(topic.type, []).append(stamp.sec + stamp.nanosec / 1e9)
    assert told.keys() == {CLOCK_TYPE, FIX_TYPE}
    for times in told.values():
        assert times == sorted(times)
        assert times[-1] <= 8.0
