"""A run in other tools' formats, read back by readers that know nothing of vnet; and the commands for it."""

import csv
import io
import json
import math
import shutil
import struct
from base64 import b64decode
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from mcap.reader import make_reader
from typer.testing import CliRunner

from emulator.export.mcap_file import SCHEMAS, _state, write_mcap
from emulator.export.pcapng import write_pcapng
from emulator.export.tables import flat, measured_links, write_csv
from emulator.radio.trace import payload_digest
from emulator.records.recorded_run import OpenedRun, RecordedRun
from emulator.scenario.scenario import Scenario
from emulator.world.radio_inputs import read_link_table
from tests.emulator.checks.test_judge import run_scenario
from tests.support.command_line import app
from tests.support.exchange_programs import COPYING, exchange_run
from tests.support.motion import along, scenario_of_trips, still, write_trips

pytestmark = pytest.mark.slow

VEHICLES = {
    "v1": [(0, 5, along(0, 10))],
    "v2": [(0, 5, still(50))],
    "v3": [(1, 5, still(80))],  # enters
    "v4": [(0, 2, still(20))],  # leaves
}
FAULTS: list[dict[str, Any]] = [
    {"kind": "DoS", "at_s": 1.0, "duration_s": 1.0, "factor": 3, "nodes": {"ids": ["v2"]}},
    {"kind": "duplicate", "at_s": 0.5, "duration_s": 3.0, "probability": 0.5},
    {"kind": "gnss_outage", "at_s": 2.0, "duration_s": 0.7, "nodes": {"ids": ["v1"]}},
    {"kind": "block", "at_s": 3.0, "duration_s": 0.6, "senders": {"ids": ["v1"]}},
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with everything: vehicles that come and go, outcomes of several kinds, copies."""
    folder = tmp_path_factory.mktemp("export")
    scenario = scenario_of_trips(
        write_trips(folder / "t.csv", VEHICLES), 4.0, program=f"{__name__}:reports", faults=FAULTS
    )
    run_scenario(folder / "run", scenario)
    return folder / "run"


async def reports(node: Any) -> None:
    """Say a few bytes and report numbers of all shapes."""
    async for fix in node.gnss:
        await node.radio.broadcast(node.id.encode() * 10)
        node.report(fix.position_m, fix.covariance_m2, several=[1.0, 2.0], one=float("inf"))


@pytest.fixture(scope="module")
def recorded(folder: Path) -> OpenedRun:
    return RecordedRun.open(folder)


# pcapng, as its draft describes it.


def blocks(data: bytes) -> Iterator[tuple[int, bytes]]:
    place = 0
    while place < len(data):
        kind, length = struct.unpack_from("<II", data, place)
        assert length % 4 == 0 and struct.unpack_from("<I", data, place + length - 4)[0] == length
        yield kind, data[place + 8 : place + length - 4]
        place += length
    assert place == len(data)


def options(data: bytes) -> dict[int, bytes]:
    found: dict[int, bytes] = {}
    place = 0
    while True:
        code, length = struct.unpack_from("<HH", data, place)
        if code == 0:
            assert length == 0 and place + 4 == len(data)
            return found
        found[code] = data[place + 4 : place + 4 + length]
        place += 4 + length + -length % 4


def packets(data: bytes) -> list[dict[str, Any]]:
    found = []
    for kind, body in list(blocks(data)):
        if kind != 6:
            continue
        interface, high, low, captured, length = struct.unpack_from("<IIIII", body)
        end = 20 + captured + -captured % 4
        said = options(body[end:])
        found.append(
            {
                "interface": interface,
                "time_ns": (high << 32) + low,
                "bytes": body[20 : 20 + captured],
                "length": length,
                "comment": said[1].decode(),
                "direction": struct.unpack("<I", said[2])[0],
            }
        )
    return found


@pytest.fixture(scope="module")
def capture(recorded: OpenedRun) -> bytes:
    file = io.BytesIO()
    count = write_pcapng(recorded, file)
    assert count == len(packets(file.getvalue()))
    return file.getvalue()


def test_a_capture_has_an_interface_for_each_vehicle(capture: bytes, recorded: OpenedRun) -> None:
    (first, section), *rest = blocks(capture)
    assert first == 0x0A0D0D0A and struct.unpack_from("<IHH", section) == (0x1A2B3C4D, 1, 0)
    interfaces = [body for kind, body in rest if kind == 1]
    assert [options(body[8:])[2].decode() for body in interfaces] == recorded.node_ids
    assert {struct.unpack_from("<H", body)[0] for body in interfaces} == {127}
    assert {options(body[8:])[9] for body in interfaces} == {b"\x09"}, "nanoseconds"


def test_every_delivery_is_an_inbound_packet_and_every_emission_an_outbound_one(
    capture: bytes, recorded: OpenedRun
) -> None:
    found = packets(capture)
    assert [packet["time_ns"] for packet in found] == sorted(packet["time_ns"] for packet in found)
    inbound = sorted((p["interface"], p["time_ns"]) for p in found if p["direction"] == 1)
    rows = recorded.trace.to_pylist()
    number = recorded.number
    heard = [(number[r["receiver"]], r["arrival_ns"]) for r in rows if r["outcome"] == "delivered"]
    assert inbound == sorted(heard)
    outbound = sorted((p["interface"], p["time_ns"]) for p in found if p["direction"] == 2)
    own = [r for r in rows if not (r["copy"] and r["cause"].startswith("duplicate"))]
    sent = {(number[r["sender"]], r["sent_ns"], r["seq"], r["copy"]) for r in own}
    assert outbound == sorted(emission[:2] for emission in sent)


def test_packets_are_frames_of_802_11p_whose_payload_is_cut_off(capture: bytes, recorded: OpenedRun) -> None:
    for packet in packets(capture):
        data = packet["bytes"]
        version, length, present = struct.unpack_from("<BxHI", data)
        assert (version, length, present) == (0, 14, 0b1110)
        flags, rate, channel_mhz, channel = struct.unpack_from("<BBHH", data, 8)
        assert (flags, rate / 2, channel_mhz) == (0, recorded.scenario.radio.bitrate_mbps, 5900)
        assert channel & 0x4000, "10 MHz"
        mac, llc = data[14:40], data[40:]
        assert mac[:2] == b"\x88\x00", "QoS data, to and from no distribution system"
        assert mac[4:10] == mac[16:22] == b"\xff" * 6, "to all, in no BSS"
        assert llc == b"\xaa\xaa\x03\x00\x00\x00\x88\xb5"
        assert packet["length"] == len(data) + 20, "20 bytes of payload, which no run keeps"
        sender, seq = packet["comment"].split(";")[0].replace(",", "").split(" frame ")
        assert mac[10:16] == b"\x02\x00\0\0\0" + bytes([recorded.number[sender] + 1])
        assert struct.unpack_from("<H", mac, 22)[0] >> 4 == int(seq.split()[0]) % 4096


def test_a_frame_to_one_vehicle_has_its_address_retries_and_acknowledgements(tmp_path: Path) -> None:
    recorded = exchange_run(tmp_path, COPYING)
    file = io.BytesIO()
    write_pcapng(recorded, file)
    rows = [row for row in recorded.trace.to_pylist() if not row["cause"].startswith("duplicate")]
    address = {name: b"\x02\x00\0\0\0" + bytes([number + 1]) for name, number in recorded.number.items()}
    data, acks = set(), set()
    for packet in packets(file.getvalue()):
        who, mac = (recorded.node_ids[packet["interface"]], packet["direction"]), packet["bytes"][14:]
        control, duration_us = struct.unpack_from("<HH", mac)
        if control == 0x00D4:
            assert (duration_us, len(mac), packet["length"]) == (0, 10, 24) and "ack" in packet["comment"]
            acks.add((*who, packet["time_ns"], mac[4:]))
        elif packet["direction"] == 2:
            assert (control & 0xFF, duration_us, mac[16:22], mac[24:26]) == (0x88, 32 + 64, b"\xff" * 6, b"\0\0")
            data.add((*who, packet["time_ns"], mac[4:10], bool(control & 0x0800)))
    assert data == {(r["sender"], 2, r["on_air_ns"], address[r["receiver"]], r["attempt"] > 1) for r in rows}
    sent = {(r["receiver"], 2, r["ack_on_air_ns"], address[r["sender"]]) for r in rows if r["ack_on_air_ns"]}
    heard = {(r["sender"], 1, r["ack_on_air_ns"] + 64_000, address[r["sender"]]) for r in rows if r["acked"]}
    assert len(heard) > 30 and acks == sent | heard


def test_a_frame_of_c_v2x_has_an_ethernet_header(tmp_path: Path) -> None:
    radio = {"path_loss": {"kind": "winner_b1", "floor_dbm": -150.0}, "mac": {"kind": "lte-mode4"}}
    radio["congestion"] = {"kind": "cr_limit", "busy": [0.0], "most": [0.001]}
    run = {"duration_s": 1.0, "settle_s": 0.1, "keep_payloads": True}
    scenario = {"run": run, "network": {"vehicles": 2, "layout": "dense"}, "radio": radio}
    program = {"entry": "agents.beacon:main"}
    run_scenario(tmp_path / "run", Scenario.model_validate({**scenario, "program": program}))
    recorded, file = OpenedRun.open(tmp_path / "run"), io.BytesIO()
    write_pcapng(recorded, file)
    assert {struct.unpack_from("<H", body)[0] for kind, body in blocks(file.getvalue()) if kind == 1} == {1}
    found = packets(file.getvalue())
    assert {packet["interface"] for packet in found} == {0, 1}
    for packet in found:
        sender = recorded.node_ids.index(packet["comment"].split(" ")[0])
        header = b"\xff" * 6 + bytes([2, 0, 0, 0, 0, sender + 1]) + b"\x88\xb5"
        assert packet["bytes"].startswith(header) and packet["length"] == len(packet["bytes"]) > len(header)
    assert "no_grant" in set(recorded.trace["outcome"].to_pylist())
    assert not any("no_grant" in packet["comment"] for packet in found), "it was never on air"


# MCAP.


def test_mcap_has_no_fix_in_an_outage() -> None:
    row = {"node": "v01", "position_m": [1.0, 2.0], "fix_m": [math.nan] * 2, "estimate_m": None, "values": ()}
    expected = {"node": "v01", "position_m": [1.0, 2.0], "values": {}}
    assert _state(row, ["position_m", "fix_m", "estimate_m"], ()) == expected


def test_mcap_has_every_period_frame_and_event_in_order(recorded: OpenedRun) -> None:
    file = io.BytesIO()
    count = write_mcap(recorded, file)
    file.seek(0)
    reader = make_reader(file)
    messages: dict[str, list[tuple[int, dict[str, Any]]]] = {topic: [] for topic in SCHEMAS}
    for schema, channel, message in reader.iter_messages(log_time_order=False):
        assert schema is not None and schema.encoding == "jsonschema" and channel.message_encoding == "json"
        assert json.loads(schema.data)["title"] == schema.name == SCHEMAS[channel.topic][0]
        messages[channel.topic].append((message.log_time, json.loads(message.data)))
    assert sum(map(len, messages.values())) == count
    for told in messages.values():
        assert [time_ns for time_ns, _ in told] == sorted(time_ns for time_ns, _ in told)
    assert len(messages["/states"]) == len(messages["/metrics"]) == 20
    rows = recorded.trace.to_pylist()
    frames = {(row["sender"], row["seq"], row["copy"]) for row in rows}
    told_frames = {(m["sender"], m["seq"], m["copy"]): m for _, m in messages["/frames"]}
    assert told_frames.keys() == frames
    listed = {
        (*frame, receiver, outcome)
        for frame, told in told_frames.items()
        for outcome, receivers in told["outcomes"].items()
        for receiver in receivers
    }
    assert listed == {(r["sender"], r["seq"], r["copy"], r["receiver"], r["outcome"]) for r in rows}
    assert [m["kind"] for _, m in messages["/events"] if m["node"]] == ["entered", "left"]
    (attachment,) = reader.iter_attachments()
    assert attachment.name == "scenario.toml" and b"[network]" in attachment.data


def test_a_frame_that_a_fault_alters_at_some_receivers_is_the_one_that_was_sent(tmp_path: Path) -> None:
    data = {
        "run": {"duration_s": 1.0, "settle_s": 0.1, "keep_payloads": True},
        "network": {"vehicles": 5, "layout": "dense"},
        "program": {"entry": "agents.beacon:main"},
        "fault": [{"kind": "corrupt", "at_s": 0.2, "duration_s": 0.7, "probability": 0.5}],
    }
    run_scenario(tmp_path / "run", Scenario.model_validate(data))
    recorded, mcap, capture = OpenedRun.open(tmp_path / "run"), io.BytesIO(), io.BytesIO()
    altered = {(r["sender"], r["seq"], r["receiver"]) for r in recorded.trace.to_pylist() if r["cause"]}
    write_mcap(recorded, mcap)
    mcap.seek(0)
    frames = [
        json.loads(m.data) for _, channel, m in make_reader(mcap).iter_messages() if channel.topic == "/frames"
    ]
    sent = {(m["sender"], m["seq"]): m for m in frames if not m["cause"]}
    for message in sent.values():
        assert f"{payload_digest(b64decode(message['payload'])):016x}" == message["payload_digest"]
    told = {(*frame, receiver) for frame, m in sent.items() for receiver in m["altered"]}
    assert len(told) > 20 and told == {row for row in altered if row[:2] in sent}
    write_pcapng(recorded, capture)
    for packet in packets(capture.getvalue()):
        sender, _, number = packet["comment"].split(";")[0].split(" ")
        if packet["direction"] == 2 and (sender, int(number)) in sent:
            assert sent[sender, int(number)]["payload_digest"] in packet["comment"]
            assert "corrupt" not in packet["comment"]


# CSV.


def test_csv_has_every_row_of_every_table_in_plain_columns(recorded: OpenedRun, tmp_path: Path) -> None:
    tables = {}
    for name in write_csv(recorded, tmp_path):
        with (tmp_path / name).open(newline="") as file:
            tables[name.removesuffix(".csv")] = list(csv.DictReader(file))
    assert len(tables["trace"]) == len(recorded.trace) and len(tables["metrics"]) == 20
    for told, row in zip(tables["trace"], recorded.trace.to_pylist(), strict=True):
        assert {key: value or None for key, value in told.items() if key != "cause"} == {
            key: None if value is None else str(value) for key, value in row.items() if key != "cause"
        }
    state = tables["states"][0]
    assert float(state["fix_m_x"]) == recorded.vectors("fix_m")[0, 0, 0]
    assert float(state["covariance_m2_yy"]) == 1.0
    assert json.loads(state["values"])["several"] == [1.0, 2.0]
    assert {"links", "vehicles", "distances", "events"} <= tables.keys()
    nothing = pa.table({"values": pa.array([[]], pa.map_(pa.string(), pa.float64()))})
    assert flat(nothing)["values"].to_pylist() == ["{}"], "an object as any other"


# The commands.

RUNNER = CliRunner()


@pytest.mark.parametrize(
    ("name", "begins"), [("x.pcapng", b"\x0a\x0d\x0d\x0a"), ("X.MCAP", b"\x89MCAP"), ("x", None)]
)
def test_without_to_the_file_s_name_says_the_format(
    folder: Path, tmp_path: Path, name: str, begins: bytes | None
) -> None:
    out = tmp_path / name
    assert RUNNER.invoke(app, ["export", str(folder), "--out", str(out)]).exit_code == 0
    assert out.is_dir() if begins is None else out.read_bytes().startswith(begins)


@pytest.mark.parametrize("to", ["pcapng", "mcap", "csv", "links"])
def test_an_export_goes_where_it_is_told_and_never_over_something_else(
    folder: Path, tmp_path: Path, to: str
) -> None:
    out = tmp_path / "out"
    done = RUNNER.invoke(app, ["export", str(folder), "--to", to, "--out", str(out)])
    assert done.exit_code == 0 and str(out) in done.stdout.replace("\n", "")
    again = RUNNER.invoke(app, ["export", str(folder), "--to", to, "--out", str(out)])
    assert again.exit_code == 2 and "exists; remove it" in again.stderr
    nowhere = RUNNER.invoke(app, ["export", str(folder), "--to", to, "--out", str(out / "no" / "no")])
    assert nowhere.exit_code == 2 or to == "csv"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out"], "nothing half-written is left"


@pytest.mark.parametrize(("every", "every_s"), [([], 1.0), (["--every", "0.5"], 0.5), (["--every", "0"], 0.0)])
def test_the_links_of_a_run_are_what_the_file_says(
    folder: Path, recorded: OpenedRun, tmp_path: Path, every: list[str], every_s: float
) -> None:
    out = tmp_path / "links.csv"
    done = RUNNER.invoke(app, ["export", str(folder), "--to", "links", "--out", str(out), *every])
    assert done.exit_code == 0, done.stderr
    written, expected = read_link_table(out, recorded.node_ids), measured_links(recorded, round(every_s * 1e9))
    assert f"{len(expected.time_ns)} rows in" in done.stdout
    for name in ("time_ns", "sender", "receiver"):
        assert np.array_equal(getattr(written, name), getattr(expected, name))
    assert np.allclose(written.loss, expected.loss, rtol=1e-8, equal_nan=True)
    blocked = [row for row in recorded.trace.to_pylist() if row["cause"].startswith("block") and not row["copy"]]
    at_ns, index = blocked[0]["sent_ns"], recorded.number[blocked[0]["receiver"]]
    before = (expected.time_ns <= at_ns) & (expected.sender == recorded.number["v1"]) & (expected.receiver == index)
    assert expected.loss[before][-1] > 0


def test_links_of_frames_to_one_vehicle_are_those_of_attempts_and_acknowledgements(tmp_path: Path) -> None:
    recorded = exchange_run(tmp_path, COPYING)
    table = measured_links(recorded, 10**9)
    names = recorded.node_ids
    links = {
        (names[s], names[r]): loss for s, r, loss in zip(table.sender, table.receiver, table.loss, strict=True)
    }
    assert links.keys() == {("a", "b"), ("b", "a")}, "far is out of range"
    rows = [row for row in recorded.trace.to_pylist() if row["receiver"] == "b" and not row["cause"]]
    came = [row for row in rows if row["outcome"] in ("delivered", "duplicate")]
    assert len(rows) > 50 and links["a", "b"] == pytest.approx(1 - len(came) / len(rows))
    assert links["b", "a"] == pytest.approx(1 - sum(row["acked"] for row in rows) / len(came))


def test_a_run_without_frames_has_no_links(tmp_path: Path) -> None:
    trips = write_trips(tmp_path / "t.csv", {"a": [(0, 2, still(0))]})
    run_scenario(tmp_path / "run", scenario_of_trips(trips, 1.0, program=f"{__name__}:reports"))
    done = RUNNER.invoke(app, ["export", str(tmp_path / "run"), "--to", "links"])
    assert done.exit_code == 2 and "there are no links" in done.stderr
    assert not (tmp_path / "run" / "links.csv").exists()


def test_an_export_of_a_damaged_run_says_so(folder: Path, tmp_path: Path) -> None:
    whole = RUNNER.invoke(app, ["export", str(folder), "--out", str(tmp_path / "whole")])
    assert whole.exit_code == 0 and not whole.stderr
    run = shutil.copytree(folder, tmp_path / "run")
    (run / "events.jsonl").write_text("")
    done = RUNNER.invoke(app, ["export", str(run), "--out", str(tmp_path / "csv")])
    assert done.exit_code == 0 and "run: events.jsonl has other contents; vnet check says more" in done.stderr
    (run / "manifest.json").write_text("")
    done = RUNNER.invoke(app, ["export", str(run), "--out", str(tmp_path / "again")])
    assert done.exit_code == 0 and "manifest.json: not a table of digests by file; vnet check" in done.stderr


def test_what_is_no_run_is_refused_in_one_line(tmp_path: Path) -> None:
    exports = [["export", str(tmp_path / "none"), "--to", form] for form in ("pcapng", "mcap", "csv", "links")]
    for command in (["export", str(tmp_path)], ["radio", str(tmp_path)], *exports):
        done = RUNNER.invoke(app, command)
        assert done.exit_code == 2 and done.stderr.count("\n") == 1 and "not a run's folder" in done.stderr
