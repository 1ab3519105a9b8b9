"""Credentials: users' passwords, key pairs and certificates, and the private files that hold them."""

from __future__ import annotations

import base64
import hashlib
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from vnet.bounded import read_bounded
from vnet.errors import TransportError

LARGEST_FILE_BYTES = 64 * 2**20
"""Largest file with credentials: ten thousand users with certificates take 22 of the 64 MiB."""


@dataclass(frozen=True)
class KeyPair:
    """A certificate and its private key, as PEM."""

    certificate: str
    private_key: str = field(repr=False)


@dataclass(frozen=True)
class Certificates:
    """All certificates of a run: that of its authority (PEM), and the key pairs of the router and each user."""

    authority: str
    router: KeyPair
    users: dict[str, KeyPair]


@dataclass(frozen=True)
class Identity:
    """A client's TLS identity: the certificate of the authority that it trusts (PEM), and its own key pair."""

    authority: str
    own: KeyPair


@dataclass(frozen=True)
class Credentials:
    """A user of the router, its password and, for TLS, its certificate.

    They are kept in files of mode 0600 or passed by an inherited descriptor, and never shown.
    """

    user: str
    password: str = field(repr=False)
    tls: Identity | None = None

    def dumps(self) -> str:
        """Return the text of a credentials file."""
        return dump_record(self)

    @classmethod
    def load(cls, path: Path) -> Credentials:
        """Read a credentials file. Raise TransportError if it is missing or bad."""
        try:
            credentials = load_record(path, cls)
            check_user(credentials.user, credentials.password)
        except OSError as error:
            raise TransportError(f"credentials {path}: cannot be read: {error.strerror}") from None
        except ValueError:
            raise TransportError(f"credentials {path}: not a credentials file of vnet") from None
        return credentials


def common_name(user: str) -> str:
    """Return the name of a user in its certificate, which holds 64 characters."""
    if len(user) <= 64:
        return user
    return f"user-{hashlib.blake2b(user.encode(), digest_size=16).hexdigest()}"


def write_private(path: Path, text: str) -> None:
    """Write a file that only its owner may read. Raise OSError with its name, also where the disk is full."""
    path.unlink(missing_ok=True)
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    try:
        with os.fdopen(descriptor, "w") as file:
            file.write(text)
    except OSError as error:
        error.filename = str(path)
        raise


def as_base64(pem: str) -> str:
    """Return PEM in the form of Zenoh's configuration."""
    return base64.b64encode(pem.encode()).decode()


_T = TypeVar("_T")


def dump_record(record: Any) -> str:
    return msgspec.json.encode(record).decode() + "\n"


def load_record(path: Path, kind: type[_T]) -> _T:
    """Restore a file of `dump_record`. Raise OSError, or ValueError if the file holds anything else."""
    try:
        return msgspec.json.decode(read_bounded(path, LARGEST_FILE_BYTES), type=kind)
    except (msgspec.DecodeError, RecursionError) as error:
        raise ValueError from error


def check_user(user: str, password: str) -> None:
    """Raise ValueError unless user and password make exactly one entry of the router's dictionary."""
    if not user or not password or ":" in user or not (user + password).isprintable():
        raise ValueError
