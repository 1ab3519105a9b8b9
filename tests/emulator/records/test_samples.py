"""Messages of Zenoh programs in a run's records, and what became of them by key."""

from pathlib import Path

import pytest

import emulator
from emulator.records.recorded_run import RecordedRun
from emulator.records.samples import key_figures
from emulator.records.tables import SAMPLES

pytestmark = pytest.mark.slow


def test_every_message_has_a_row_and_one_fate_at_each_receiver(tmp_path: Path) -> None:
    scenario = {
        "run": {"duration_s": 2.0, "settle_s": 0.0},
        "network": {"vehicles": 3},
        "radio": {"loss": 0.3, "max_payload_bytes": 100, "range_m": 1e6},
        "program": {"kind": "zenoh", "command": ["python", str(tmp_path / "zenoh_speaks.py"), "{id}"]},
    }
    (tmp_path / "zenoh_speaks.py").write_text(
        "import time, zenoh\n"
        "session = zenoh.open(zenoh.Config())\n"
        "session.put('small', bytes(3))\n"
        "session.put('large', bytes(200))\n"
        "session.delete('small')\n"
        "time.sleep(10)\n"
    )
    run = emulator.simulate(scenario, out=tmp_path / "run")
    recorded = RecordedRun.open(run.folder)
    table = recorded.table(SAMPLES)
    assert table is not None
    rows = table.to_pylist()
    told = {(row["kind"], row["key"], row["payload_bytes"]) for row in rows}
    assert told == {("put", "small", 3), ("put", "large", 200), ("delete", "small", 0)}
    figures = {(each.kind, each.key): each for each in key_figures(recorded)}
    assert all(each.messages == 3 for each in figures.values())
    assert figures["put", "large"].frames > 3
    for each in figures.values():
        assert each.arrived + sum(each.lost.values()) == 3 * 2, "each message has one fate at each receiver"
    outcomes = recorded.trace["outcome"].to_pylist()
    lost = sum(sum(each.lost.values()) for each in figures.values())
    assert 0 < lost <= outcomes.count("lost")


def test_a_reply_that_the_mac_has_repeated_arrives_with_any_attempt(tmp_path: Path) -> None:
    (tmp_path / "zenoh_asks.py").write_text(
        "import sys, time, zenoh\n"
        "session = zenoh.open(zenoh.Config())\n"
        "if sys.argv[1] == 'v02':\n"
        "    session.declare_queryable('service', lambda query: query.reply('service', b'yes'))\n"
        "    time.sleep(10)\n"
        "time.sleep(0.5)\n"
        "while True:\n"
        "    print(sum(reply.ok is not None for reply in session.get('service', timeout=0.2)), flush=True)\n"
        "    time.sleep(0.1)\n"
    )
    scenario = {
        "run": {"duration_s": 6.0, "settle_s": 0.0},
        "network": {"vehicles": 2},
        "radio": {"loss": 0.4, "range_m": 1e6, "mac": {"kind": "80211p"}},
        "program": {"kind": "zenoh", "command": ["python", str(tmp_path / "zenoh_asks.py"), "{id}"]},
    }
    run = emulator.simulate(scenario, out=tmp_path / "run")
    (reply,) = (each for each in key_figures(RecordedRun.open(run.folder)) if each.kind == "reply")
    answers = (run.folder / "logs" / "v01.log").read_text().split().count("1")
    assert reply.messages > 10 and reply.arrived == answers
    assert reply.arrived + sum(reply.lost.values()) == reply.messages
