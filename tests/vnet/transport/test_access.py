"""Users, passwords and certificates: files only for their owner, nothing that shows a secret, one-line errors."""

import os
import resource
import stat
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from vnet.errors import TransportError
from vnet.transport.access import EMULATOR, OBSERVER, Access, certifier, node_user, router_names
from vnet.transport.credentials import Credentials, common_name, write_private
from vnet.transport.session import open_client, open_router

TLS = "tls/127.0.0.1:7447"
TCP = "tcp/127.0.0.1:7447"
PROCESSES = [["v01", "v02"], ["v03"]]
endpoints = pytest.mark.parametrize("listen", [TCP, TLS])


def create(listen: str) -> Access:
    return Access.create("r", PROCESSES, certifier(listen) if listen == TLS else None)


@pytest.fixture
def careless_umask() -> Iterator[None]:
    before = os.umask(0)
    yield
    os.umask(before)


@endpoints
def test_files_with_credentials_are_for_their_owner_only(listen: str, tmp_path: Path, careless_umask: None) -> None:
    folder = tmp_path / "access"
    create(listen).save(folder, listen, folder)
    create(listen).save(folder, listen, folder)  # also where they are written again
    modes = {path: stat.S_IMODE(path.stat().st_mode) for path in [folder, *folder.rglob("*")]}
    assert len(modes) == 10
    assert {modes[path] for path in modes if path.is_dir()} == {0o700}
    assert {modes[path] for path in modes if path.is_file()} == {0o600}


@endpoints
def test_what_is_saved_comes_back(listen: str, tmp_path: Path) -> None:
    access = create(listen)
    access.save(tmp_path, listen, tmp_path)
    assert Access.load(tmp_path) == access
    for user, file in ((node_user("v01"), "v01"), (EMULATOR, "emulator"), (OBSERVER, "observer")):
        credentials = Credentials.load(tmp_path / "credentials" / f"{file}.json")
        assert credentials == access.credentials(user)
        assert (credentials.tls is not None) == (listen == TLS)


def test_nothing_shows_a_secret() -> None:
    access = create(TLS)
    shown = repr(access) + repr([access.credentials(user) for user in access.passwords])
    assert not any(password in shown for password in access.passwords.values())
    assert "PRIVATE" not in shown


def test_every_user_has_a_key_pair_and_a_rule_of_its_own() -> None:
    access = create(TLS)
    assert access.tls is not None
    pairs = [access.tls.router, *access.tls.users.values()]
    assert len({pair.private_key for pair in pairs}) == len({pair.certificate for pair in pairs}) == 6
    subjects = access.access_control()["subjects"]
    assert all(subject["usernames"] == subject["cert_common_names"] == [subject["id"]] for subject in subjects)


def test_a_certificate_has_room_for_every_name() -> None:
    process_id = "v" * 64
    assert len(common_name(node_user(process_id))) <= 64
    assert common_name(node_user(process_id)) != common_name(node_user("v" * 63 + "w"))
    assert Access.create("r", [[process_id]], certifier(TLS)).tls is not None


def test_a_router_goes_by_where_it_listens() -> None:
    assert router_names("tls/10.0.0.7:7447", ["zenohd"]) == ["localhost", "127.0.0.1", "::1", "10.0.0.7", "zenohd"]
    assert router_names("tls/[::1]:7447") == ["localhost", "127.0.0.1", "::1"]
    assert len(router_names("tls/0.0.0.0:7447")) > 3


def test_what_cannot_stand_in_a_certificate_is_one_line() -> None:
    with pytest.raises(TransportError, match="not a host name or an address"):
        Access.create("r", PROCESSES, certifier(TLS, ["a" * 300]))


def test_without_cryptography_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cryptography", None)
    with pytest.raises(TransportError, match=r"pip install 'vnet-emulator\[tls\]'"):
        create(TLS)


def test_certificates_and_endpoint_go_together(tmp_path: Path) -> None:
    with pytest.raises(TransportError, match="only at tls/HOST:PORT"), open_router(TCP, create(TLS)):
        pass
    with pytest.raises(TransportError, match="vnet access --listen tls/"):
        create(TCP).save(tmp_path, TLS, tmp_path)
    own = create(TLS).credentials(EMULATOR)
    with pytest.raises(TransportError, match="connect to tls/HOST:PORT"), open_client(TCP, own, 1000):
        pass
    for credentials in (None, create(TCP).credentials(EMULATOR)):
        with pytest.raises(TransportError, match="have no certificate"), open_client(TLS, credentials, 1000):
            pass


def test_an_endless_file_is_refused() -> None:
    with pytest.raises(TransportError, match="not a credentials file"):
        Credentials.load(Path("/dev/zero"))


def test_a_file_for_which_there_is_no_room_is_named(tmp_path: Path) -> None:
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, limits[1]))
    try:
        with pytest.raises(OSError, match="File too large") as raised:
            write_private(tmp_path / "users.txt", "v01:secret")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert raised.value.filename == str(tmp_path / "users.txt")
