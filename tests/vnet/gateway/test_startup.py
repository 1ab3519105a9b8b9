"""Start of Python in the commands of vehicles: `zenoh.open` heeds the environment, and loses nothing."""

import base64
import json
import os
import subprocess
import sys
from pathlib import Path

import msgspec
import pytest

from vnet.gateway import FAILURE, STARTUP
from vnet.runtime.error_text import write_report
from vnet.transport.authority import issue_certificates

pytestmark = pytest.mark.slow

OPENS = """
session = zenoh.open(config)
print([str(reply.ok.key_expr).rpartition("/")[2] for reply in session.get(f"@/{session.zid()}/*")])
session.close()
"""
"""A session that says its mode if its administration space is enabled, as it is by the environment alone."""
OVERRIDE = 'mode="peer";adminspace/enabled=true;scouting/multicast/enabled=false'
SAYS = "['peer']\n"


def start(*paths: Path, code: str) -> subprocess.CompletedProcess[str]:
    """Run a program as a command of a vehicle is run, with `paths` of the user's own."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, (STARTUP, *paths)))}
    environment |= {"ZENOH_CONFIG_OVERRIDE": OVERRIDE}
    return subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)


@pytest.mark.parametrize(
    "imports",
    [
        "import zenoh",
        "import importlib.util; assert importlib.util.find_spec('zenoh'); import zenoh",
        "import importlib, zenoh; importlib.reload(zenoh)",
        "import zenoh; from zenoh import *",
    ],
)
def test_zenoh_heeds_the_environment_however_it_is_found(imports: str) -> None:
    done = start(code=f"{imports}\nconfig = zenoh.Config(){OPENS}")
    assert done.stdout == SAYS, done.stderr


def test_open_takes_all_that_zenohs_takes() -> None:
    code = OPENS.replace("open(config)", "open(config=config, timestamp_callback=None)")
    done = start(code=f"import zenoh\nconfig = zenoh.Config(){code}")
    assert done.stdout == SAYS, done.stderr


def test_what_is_no_configuration_is_refused_by_zenoh_itself() -> None:
    assert "argument 'config': 'str' object" in start(code="import zenoh\nzenoh.open('config.json5')").stderr


def test_a_configuration_keeps_the_keys_of_tls_that_zenoh_does_not_write() -> None:
    """Without its private key a session cannot listen."""
    router = issue_certificates([], ["127.0.0.1"]).router
    settings: dict[str, object] = {"listen/endpoints": ["tls/127.0.0.1:0"]}
    for name, pem in (("certificate", router.certificate), ("private_key", router.private_key)):
        settings[f"transport/link/tls/listen_{name}_base64"] = base64.b64encode(pem.encode()).decode()
    fill = f"for setting in {settings!r}.items(): config.insert_json5(setting[0], json.dumps(setting[1]))"
    done = start(code=f"import json, zenoh\nconfig = zenoh.Config()\n{fill}{OPENS}")
    assert done.stdout == SAYS, done.stderr


@pytest.mark.parametrize(
    ("code", "says"), [("print('own')", "own\nstarted\n"), (None, "started\n"), ("import nosuch", "started\n")]
)
def test_a_sitecustomize_of_the_users_own_runs_and_its_errors_are_told(
    tmp_path: Path, code: str | None, says: str
) -> None:
    if code is not None:
        (tmp_path / "sitecustomize.py").write_text(code)
    done = start(tmp_path, code="print('started')")
    assert done.stdout == says
    assert ("nosuch" in done.stderr) == (code == "import nosuch")


def test_a_zenoh_of_another_protocol_is_named(tmp_path: Path) -> None:
    """Alone it would only say that nobody answers."""
    (tmp_path / "zenoh.py").write_text("def open(): ...")
    done = start(tmp_path, code="import zenoh")
    assert done.returncode == 1
    assert str(tmp_path / "zenoh.py") in done.stderr.splitlines()[-1]


@pytest.mark.parametrize("name", ["calendar", "csv", "email", "random", "string", "tempfile"])
def test_a_module_of_the_program_is_found_before_pythons(tmp_path: Path, name: str) -> None:
    """It would not be if the start had loaded Python's."""
    (tmp_path / f"{name}.py").write_text("OWN = True")
    assert start(tmp_path, code=f"import zenoh, {name}; print({name}.OWN)").stdout == "True\n"


STAYS = """import sys
try: sys.exit(1)
except SystemExit as error: assert error.code == 1
import threading, zenoh
threading.Thread(target=threading.Event().wait).start()"""
"""A program that Python alone would not end."""


@pytest.mark.parametrize(
    ("ends", "status", "told"),
    [
        ("raise SystemExit(3)", 3, "SystemExit: 3"),
        ("try: sys.exit(4)\nfinally: print(end='')", 4, "SystemExit: 4"),
        ("sys.excepthook = lambda *error: None; 1 / 0", 1, "ZeroDivisionError: division by zero"),
    ],
)
def test_a_main_thread_that_fails_ends_its_program_and_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ends: str, status: int, told: str
) -> None:
    monkeypatch.setenv(FAILURE, str(tmp_path / "failure"))
    done = start(code=f"{STAYS}\nimport atexit; atexit.register(print, 'bye')\n{ends}")
    assert (done.returncode, done.stdout) == (status, "bye\n")
    assert json.loads((tmp_path / "failure").read_text())["error"] == told


@pytest.mark.parametrize(
    "ends",
    [
        "sys.exit()",
        "try: sys.exit(5)\nexcept SystemExit as error: assert error.code == 5",
        "import subprocess; subprocess.run([sys.executable, '-c', 'import zenoh; 1 / 0'])",
        "import os; os.fork() or sys.exit(6); os.wait()",
        "thread = threading.Thread(target=sys.exit, args=[7]); thread.start()",
    ],
)
def test_no_other_end_is_a_failure_of_the_main_thread(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ends: str
) -> None:
    monkeypatch.setenv(FAILURE, str(tmp_path / "failure"))
    assert start(code=f"import sys, threading, zenoh\n{ends}").returncode == 0
    assert not (tmp_path / "failure").exists()


def test_a_failure_is_told_whatever_letters_it_has(tmp_path: Path) -> None:
    """Names of files that are no UTF-8 have lone surrogates."""
    write_report(str(tmp_path / "failure"), OSError("\udcff"), "\udcff", "a.py:1")
    told = msgspec.json.decode((tmp_path / "failure").read_bytes(), type=dict[str, str])
    assert told["error"] == "OSError: \\udcff" and "\\udcff" in told["details"]
