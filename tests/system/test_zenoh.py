"""Unmodified Zenoh programs as vehicles of a run in real time."""

import json
import re
import socket
import subprocess
import sys
import threading
import time
from collections import Counter
from pathlib import Path
from typing import Any, cast

import pyarrow.parquet as pq
import pytest
import zenoh

from emulator.records.disk import LARGEST_LOG_BYTES, log_is_full
from tests.support.forked_commands import VNET, Command
from tests.support.paths import ROOT
from tests.system.by_hand import finish, line_of
from tests.system.conftest import Finished, Vnet
from vnet.transport.authority import issue_certificates

PAGE = (ROOT / "docs/how-to/zenoh.md").read_text()
WAITS = (
    "import sys, time, zenoh; session = zenoh.open(zenoh.Config.from_env()); name = sys.argv[1]; {}; time.sleep({})"
)
"""A program of one line: what it does after it has connected, and for how long it stays."""
CLIENT = "config.insert_json5('mode', json.dumps('client')); config.insert"
SHORT = (
    ("at_s = 3.0", "at_s = 2.0"),
    ("duration_s = 2.0", "duration_s = 0.5"),
    ("duration_s = 8.0", "duration_s = 3.0"),
)
"""The page's run without the time that it takes to show faults."""
SLOW = (0, 3)
"""Exit statuses of a run that is as it should be: a slow machine makes one in real time unknown."""


def scenario(folder: Path, *changes: tuple[str, str]) -> str:
    """Write the page's scenario and program, with texts changed; returns the path."""
    blocks = dict(re.findall(r"```\w+\n# (\S+)\n(.*?)```", PAGE, re.DOTALL))
    (folder / "talker.py").write_text(blocks["talker.py"])
    text = blocks["talkers.toml"]
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    (folder / "talkers.toml").write_text(text)
    return str(folder / "talkers.toml")


def command(does: str, stays_s: float = 100.0) -> tuple[str, str]:
    words = ["python", "-c", WAITS.format(does, stays_s), "{id}"]
    return '["python", "talker.py", "{id}"]', json.dumps(words)


def heard(done: Finished, node: str) -> Counter[str]:
    return Counter(re.findall(r"heard car/(\w+)/pose", (done.folder / f"logs/{node}.log").read_text()))


def test_a_program_hears_of_other_vehicles_what_the_radio_has_delivered_and_no_more(
    vnet: Vnet, tmp_path: Path
) -> None:
    done = vnet("run", scenario(tmp_path), "--report")
    assert done.status in SLOW
    assert done.check("conservation")["verdict"] == "valid"
    assert done.check("isolation")["verdict"] == "valid"
    assert done.check("partition_respected")["verdict"] != "invalid"
    delivered = Counter((row["receiver"], row["sender"]) for row in done.trace() if row["outcome"] == "delivered")
    for node in ("v01", "v02", "v03", "v04"):
        told = heard(done, node)
        assert node in told, "programs of one vehicle talk past the radio"
        for other in told.keys() - {node}:
            assert told[other] <= delivered[node, other]
    assert sum(delivered.values()) > 0
    sent = Counter(row["sender"] for row in pq.read_table(done.folder / "samples.parquet").to_pylist())
    offered = {(row["sender"], row["seq"]) for row in done.trace()}
    assert sent == Counter(sender for sender, _ in offered)
    assert "car/v01/pose" in (done.folder / "report.html").read_text()


def test_faults_end_pause_and_start_the_commands_with_their_vehicle(vnet: Vnet, tmp_path: Path) -> None:
    """A killed vehicle's program is started again at the same endpoint, as are all after a restart of routers."""
    faults = "".join(
        f'\n[[fault]]\nkind = "{kind}"\nat_s = {at_s}\n{more}\n'
        for kind, at_s, more in [
            ("kill", 1.0, 'duration_s = 1.0\nnodes = { ids = ["v01"] }'),
            ("pause", 1.0, 'duration_s = 1.0\nnodes = { ids = ["v02"] }'),
            ("router_restart", 4.0, "down_s = 0.5"),
        ]
    )
    token = ("    while True:", "    token = session.liveliness().declare_token(f'alive/{name}')\n    while True:")
    often = ('kind = "zenoh"', 'kind = "zenoh"\nzenoh = { liveliness_s = 0.2 }')
    old = PAGE[PAGE.index('[[fault]]\nkind = "partition"') : PAGE.index('"v04"]]\n') + len('"v04"]]\n')]
    path = scenario(tmp_path, (old, faults), often)
    talker = tmp_path / "talker.py"
    talker.write_text(talker.read_text().replace(*token))
    done = vnet("run", path)
    assert done.status in SLOW
    assert done.check("pause_respected")["verdict"] == "valid", "a gateway tells no tokens of a paused vehicle"
    assert [event["node"] for event in done.events_of("restarted")] == ["v01"]
    assert done.events_of("router_restarted")
    assert not done.events_of("died")
    last = max(row["sent_ns"] for row in done.trace() if row["sender"] == "v01" and row["outcome"] == "delivered")
    assert last > 4_500_000_000, "programs find their router again by themselves"
    silent = [row["sender"] for row in done.trace() if 1.1e9 < row["sent_ns"] < 1.9e9]
    assert not {"v01", "v02"} & set(silent)


def test_what_programs_say_before_the_start_is_sent_then(vnet: Vnet, tmp_path: Path) -> None:
    """A program that puts once, or asks once, may do so as soon as it has connected."""
    does = (
        "told = lambda sample: print('told', sample.key_expr, sample.payload.to_string()); "
        "answer = lambda query: query.reply('asked/' + name, 'yes'); "
        "kept = session.declare_subscriber('once/**', told), session.declare_queryable('asked/' + name, answer); "
        "[session.put('once/' + name, text) for text in ('first', 'last')]; "
        "[print('answered', reply.ok.key_expr) for reply in session.get('asked/**')]"
    )
    patient = 'kind = "zenoh"', 'kind = "zenoh"\nzenoh = { query_s = 4.0 }'
    changes = (
        patient,
        ("loss = 0.1", "loss = 0.0"),
        ("at_s = 3.0", "at_s = 4.5"),
        ("duration_s = 2.0", "duration_s = 0.5"),
        ("duration_s = 8.0", "duration_s = 5.0"),
    )
    done = vnet("run", scenario(tmp_path, command(does), *changes))
    assert done.status in SLOW
    for node in ("v01", "v02", "v03", "v04"):
        log = (done.folder / f"logs/{node}.log").read_text()
        others = [other for other in ("v01", "v02", "v03", "v04") if other != node]
        assert {f"once/{other} last" for other in others} <= set(re.findall(r"told (.*)", log))
        assert {f"asked/{other}" for other in others} <= set(re.findall(r"answered (.*)", log))


def test_a_command_that_fails_is_a_crash_of_its_vehicle_alone(vnet: Vnet, tmp_path: Path) -> None:
    fails = command("time.sleep(1); sys.exit(3 if name == 'v02' else 0)")
    done = vnet("run", scenario(tmp_path, fails, *SHORT))
    (crash,) = done.events_of("crashed")
    assert (done.status, crash["node"]) == (1, "v02")
    assert "ended with 3" in crash["error"]
    assert sorted(event["node"] for event in done.events_of("finished")) == ["v01", "v03", "v04"]


def test_a_main_thread_that_fails_is_a_crash_in_the_words_of_virtual_time(vnet: Vnet, tmp_path: Path) -> None:
    """Zenoh's thread of a callback would keep the process: v06, whose main thread returns, stays."""
    lines = (
        "import signal, sys, zenoh",
        "session = zenoh.open(zenoh.Config.from_env())",
        "session.declare_subscriber('car/**', print)",
        "session.declare_subscriber('vnet/fix').recv()",
        "name, fail = sys.argv[1], lambda: fail()",
        "if name == 'v01': raise RuntimeError('motor failed')",
        "if name == 'v02': sys.exit(7)",
        "if name == 'v03': sys.exit('no camera')",
        "if name == 'v04': fail()",
        "if name == 'v05': signal.raise_signal(signal.SIGINT)",
    )
    (tmp_path / "fails.py").write_text("\n".join(lines))
    words = '["python", "talker.py", "{id}"]', '["python", "fails.py", "{id}"]'
    path = scenario(tmp_path, words, ("vehicles = 4", "vehicles = 6"), *SHORT)
    live, simulated = vnet("run", path), vnet("simulate", path)
    assert (live.status, simulated.status) == (1, 1)
    told = {event["node"]: (event["error"], event["place"]) for event in live.events_of("crashed")}
    file = tmp_path / "fails.py"
    assert told == {
        "v01": ("RuntimeError: motor failed", "fails.py:6"),
        "v02": (f"ProgramError: python {file} v02 ended with 7", "fails.py:7"),
        "v03": (f"ProgramError: python {file} v03 ended with 'no camera'", "fails.py:8"),
        "v04": ("RecursionError: maximum recursion depth exceeded", "fails.py:5"),
        "v05": (f"ProgramError: python {file} v05 ended with 130", "fails.py:10"),
    }
    errors = {event["node"]: event["error"] for event in simulated.events_of("crashed")}
    assert errors == {node: error for node, (error, _) in told.items()}
    assert not live.events_of("died") + live.events_of("finished")


def test_the_log_of_a_command_is_cut_while_it_writes(vnet: Vnet, tmp_path: Path) -> None:
    """It floods its log until that has become shorter: who writes waits for nobody."""
    lines = (
        "import os, zenoh",
        "session, before = zenoh.open(zenoh.Config.from_env()), 0",
        "while before <= (now := os.fstat(1).st_size) < 1e9:",
        "    before = now",
        "    print('x' * 10_000)",
        "assert now < before",
    )
    (tmp_path / "floods.py").write_text("\n".join(lines))
    words = '["python", "talker.py", "{id}"]', '["python", "floods.py"]'
    done = vnet("run", scenario(tmp_path, words, *SHORT))
    assert done.status in SLOW
    log = (done.folder / "logs/v01.log").read_bytes()
    assert (len(log), log.endswith(log_is_full().encode())) == (LARGEST_LOG_BYTES + 1 + len(log_is_full()), True)


def test_a_session_at_another_vehicles_endpoint_is_no_isolation(vnet: Vnet, tmp_path: Path) -> None:
    """The cheater finds the endpoint of another vehicle in the run's folder, and puts a sample there."""
    (tmp_path / "cheater.py").write_text(
        "import json, os, pathlib, sys, time\n"
        "import zenoh\n"
        "own = zenoh.open(zenoh.Config.from_env())\n"
        "del os.environ['ZENOH_CONFIG_OVERRIDE']\n"
        "if sys.argv[1] == 'v01':\n"
        "    while not (found := list(pathlib.Path(sys.argv[2]).rglob('endpoints.json'))):\n"
        "        time.sleep(0.1)\n"
        "    config = zenoh.Config()\n"
        "    config.insert_json5('mode', '\"client\"')\n"
        "    config.insert_json5('connect/endpoints', json.dumps([json.loads(found[0].read_text())['v02']]))\n"
        "    other = zenoh.open(config)\n"
        "    other.put('car/x/pose', b'past the radio')\n"
        "time.sleep(100)\n"
    )
    words = json.dumps(["python", "cheater.py", "{id}", str(tmp_path)])
    done = vnet("run", scenario(tmp_path, ('["python", "talker.py", "{id}"]', words), *SHORT))
    assert done.status == 1
    assert {event["node"] for event in done.events_of("extra_session")} == {"v02"}
    assert done.check("isolation")["verdict"] == "invalid"
    assert done.check("isolation")["text"] == "more sessions than commands (program.zenoh.sessions) at v02"


def test_a_peer_that_others_find_by_multicast_is_no_isolation(vnet: Vnet, tmp_path: Path) -> None:
    """Zenoh's default mode: peers of two vehicles find each other, and talk whatever the radio loses."""
    seen = threading.Event()
    with zenoh.open(zenoh.Config()):
        scout = zenoh.scout(cast(Any, lambda hello: seen.set()), what="peer")
        has_multicast = seen.wait(5.0)
        scout.stop()  # type: ignore[no-untyped-call]
    if not has_multicast:
        pytest.skip("no multicast on this machine: peers do not find each other")
    program = (
        "import json, os, sys, time, zenoh; config = zenoh.Config(); del os.environ['ZENOH_CONFIG_OVERRIDE']; "
        "config.insert_json5('connect/endpoints', json.dumps([sys.argv[1]])); session = zenoh.open(config); "
        "time.sleep(100)"
    )
    words = ('["python", "talker.py", "{id}"]', json.dumps(["python", "-c", program, "{endpoint}"]))
    done = vnet("run", scenario(tmp_path, words, *SHORT))
    assert done.status == 1
    assert {event["node"] for event in done.events_of("found_session")} == {"v01", "v02", "v03", "v04"}
    assert done.check("isolation")["verdict"] == "invalid"
    client = json.dumps(["python", "-c", program.replace("config.insert", CLIENT, 1), "{endpoint}"])
    done = vnet("run", scenario(tmp_path, (words[0], client), *SHORT))
    assert not done.events_of("found_session")


def test_programs_in_python_are_clients_of_their_vehicle_whatever_they_open(vnet: Vnet, tmp_path: Path) -> None:
    """Two are peers by default, two connect and listen elsewhere: they reach others by the radio alone."""
    elsewhere = {"connect": {"endpoints": ["tcp/localhost:7447"]}, "listen": {"endpoints": ["tcp/127.0.0.1:0"]}}
    other = f"zenoh.Config() if name < 'v03' else zenoh.Config.from_json5(str({elsewhere}))"
    path = scenario(tmp_path, *SHORT, ("loss = 0.1", "loss = 0.5"))
    talker = tmp_path / "talker.py"
    talker.write_text(talker.read_text().replace("zenoh.Config.from_env()", other))
    done = vnet("run", path)
    assert done.status in SLOW
    assert not done.events_of("found_session") + done.events_of("extra_session")
    delivered = Counter((row["receiver"], row["sender"]) for row in done.trace() if row["outcome"] == "delivered")
    assert 0 < heard(done, "v01")["v02"] <= delivered["v01", "v02"]
    assert 0 < heard(done, "v03")["v04"] <= delivered["v03", "v04"]


def test_who_has_no_program_any_more_makes_the_run_unknown(tmp_path: Path) -> None:
    """Others have started the program, so that nothing but its session tells that it has ended."""
    path = scenario(tmp_path, *SHORT, ("vehicles = 4", "vehicles = 2"), ('"v02"], ["v03", "v04"]]', '"v02"]]'))
    words = [*VNET, "emulator", path, "--listen", "tcp/127.0.0.1:0", "--out", str(tmp_path / "run")]
    with Command(words, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as emulator:
        line_of(emulator, "waiting for")
        endpoints = json.loads((tmp_path / "run" / "endpoints.json").read_text())
        ways = [{"mode": "client", "connect": {"endpoints": [at]}} for at in endpoints.values()]
        talker, listener = (zenoh.open(zenoh.Config.from_json5(json.dumps(way))) for way in ways)
        samples = listener.declare_subscriber("pose", zenoh.handlers.FifoChannel(1000))
        while samples.try_recv() is None:
            talker.put("pose", "here")
            time.sleep(0.01)
        listener.close()  # type: ignore[no-untyped-call]
        while emulator.poll() is None:
            talker.put("pose", "here")
            time.sleep(0.01)
        talker.close()  # type: ignore[no-untyped-call]
        done = finish(emulator, tmp_path / "run")
    assert [event["node"] for event in done.events_of("session_gone")] == ["v02"]
    assert done.check("transport")["verdict"] == "unknown" and done.status == 3


def test_a_program_that_never_connects_and_a_port_that_is_taken_are_named(vnet: Vnet, tmp_path: Path) -> None:
    sleeps = ('["python", "talker.py", "{id}"]', '["sleep", "100"]')
    done = vnet("run", scenario(tmp_path, sleeps), "--set", "run.join_timeout_s=1")
    assert done.status == 2
    assert "v01 at tcp/127.0.0.1:" in done.stderr
    both = '["python", "talker.py", "{id}"]', '[["python", "talker.py", "{id}"], ["sleep", "100"]]'
    done = vnet("run", scenario(tmp_path, both), "--set", "run.join_timeout_s=4")
    assert re.search(r"vehicles have not connected within 4 s: v01 at \S+ \('sleep 100'\), v02 at", done.stderr)
    by_hand = "--listen=tcp/127.0.0.1:0", "--set=run.join_timeout_s=1"
    done = vnet("emulator", scenario(tmp_path), *by_hand)
    assert done.status == 2 and "endpoints.json in the run's folder" in done.stderr
    assert "VNET_ENDPOINT" not in done.stderr and "agents" not in done.stderr
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        endpoint = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        done = vnet("run", scenario(tmp_path), "--set", f"program.zenoh.listen={endpoint}")
    assert done.status == 2
    assert f"v01: cannot listen at {endpoint}" in done.stderr


def test_commands_that_cannot_be_or_end_too_early_are_named_at_once(vnet: Vnet, tmp_path: Path) -> None:
    for words, text in (('["nosuch"]', "'nosuch' is no command"), ('["true"]', "ended before they had connected")):
        done = vnet("run", scenario(tmp_path, ('["python", "talker.py", "{id}"]', words)))
        assert (done.status, text in done.stderr) == (2, True), done.stderr


@pytest.mark.parametrize("trusts", ["its authority", "another"])
def test_commands_connect_by_tls_if_they_trust_the_authority_of_their_endpoint(
    vnet: Vnet, tmp_path: Path, trusts: str
) -> None:
    issued = issue_certificates([], ["127.0.0.1"])
    trusted = issued if trusts == "its authority" else issue_certificates([], ["127.0.0.1"])
    (tmp_path / "router.pem").write_text(issued.router.certificate)
    (tmp_path / "router.key").write_text(issued.router.private_key)
    (tmp_path / "authority.pem").write_text(trusted.authority)
    options = (
        'listen = "tls/127.0.0.1:0", certificate = "router.pem", private_key = "router.key", '
        'authority = "authority.pem"'
    )
    path = scenario(tmp_path, ('kind = "zenoh"', f'kind = "zenoh"\nzenoh = {{ {options} }}'), *SHORT)
    if trusted is not issued:
        refused = vnet("run", path)
        assert refused.status == 2 and "authority.pem' has issued" in refused.stderr
        return
    done = vnet("run", path)
    assert done.status in SLOW
    assert heard(done, "v01").keys() > {"v01"}
    endpoints = json.loads((done.folder / "endpoints.json").read_text())
    assert all(endpoint.startswith("tls/127.0.0.1:") for endpoint in endpoints.values())


@pytest.mark.parametrize("program", ["sh", "talker.py"])
def test_users_and_several_commands_of_one_vehicle(vnet: Vnet, tmp_path: Path, program: str) -> None:
    """A command has the first user's password; one without it is not let in."""
    (tmp_path / "users.txt").write_text("car:secret\n")
    secured = ('kind = "zenoh"', 'kind = "zenoh"\nzenoh = { users = "users.txt" }')
    again = '["sh", "-c", "exec $TALKER $NAME"]'
    variables = f'environment = {{ TALKER = "{sys.executable} {tmp_path}/talker.py", NAME = "{{id}}b" }}'
    both = f'[["python", "talker.py", "{{id}}"], {again}]\n{variables}'
    alone = '["sh", "-c", "unset ZENOH_CONFIG; exec sleep 100"]'
    words = both if program == "talker.py" else alone
    limit = [] if words == both else ["--set", "run.join_timeout_s=1"]
    done = vnet("run", scenario(tmp_path, ('["python", "talker.py", "{id}"]', words), secured, *SHORT), *limit)
    assert done.status in (SLOW if words == both else (2,))
    if words == both:
        assert heard(done, "v01")["v01"] > 0
        assert "heard car/v01/pose" in (done.folder / "logs/v01~2.log").read_text()
        assert "heard car/v01b/pose" in (done.folder / "logs/v01.log").read_text()
