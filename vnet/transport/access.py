"""Who may do what on the router: users, passwords, certificates and rules for one run.

The router denies by default. Roles: *node* (one user an agent process, granted exactly its nodes' keys),
*observer* (receives only), *operator* (queries `control`) and *emulator* (all of the run's keys; needed only where
the emulator is a client of a separate router). Rules have no templating by user name, so that there is a set for
each process.
"""

from __future__ import annotations

import base64
import hashlib
import json
import os
import secrets
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from vnet.bounded import read_bounded
from vnet.errors import LinkError
from vnet.transport import keys

Rule = dict[str, Any]

EMULATOR = "emulator"
OBSERVER = "observer"
OPERATOR = "operator"


LARGEST_FILE_BYTES = 64 * 2**20
"""Of a file with credentials; ten thousand users with certificates take 22 of the 64 MiB."""


@dataclass(frozen=True)
class KeyPair:
    """A certificate and its private key, as PEM."""

    certificate: str
    private_key: str = field(repr=False)


@dataclass(frozen=True)
class Certificates:
    """All of a run: the certificate of its authority (PEM), the router's key pair and each user's."""

    authority: str
    router: KeyPair
    users: dict[str, KeyPair]


@dataclass(frozen=True)
class Identity:
    """What a client needs for TLS: whose certificates it believes (PEM), and its own key pair."""

    authority: str
    own: KeyPair


@dataclass(frozen=True)
class Credentials:
    """A user of the router, its password and, for TLS, its certificate.

    Kept in 0600 files or passed by an inherited descriptor; never shown.
    """

    user: str
    password: str = field(repr=False)
    tls: Identity | None = None

    def dumps(self) -> str:
        """The form of a credentials file."""
        return _dumps(self)

    @classmethod
    def load(cls, path: Path) -> Credentials:
        """Read a credentials file. Raises LinkError."""
        try:
            credentials = _load(path, cls)
            _check_user(credentials.user, credentials.password)
        except OSError as error:
            raise LinkError(f"credentials {path}: cannot be read: {error.strerror}") from None
        except ValueError:
            raise LinkError(f"credentials {path}: not a credentials file of vnet") from None
        return credentials


@dataclass(frozen=True)
class Access:
    """All users of a run. `processes` are the node ids of each agent process, its lead first.

    With `tls`, the router speaks only TLS, and believes a user only with its own certificate beside its password.
    """

    run: str
    processes: tuple[tuple[str, ...], ...]
    passwords: dict[str, str] = field(repr=False)
    tls: Certificates | None = None

    @classmethod
    def create(
        cls,
        run: str,
        processes: Sequence[Sequence[str]],
        tls_listen: str | None = None,
        tls_names: Sequence[str] = (),
    ) -> Access:
        """Draw new passwords for every process and role of a run; and certificates, if `tls_listen` is given.

        That is where the router listens, and `tls_names` are further names or addresses that it goes by: clients
        verify that they met one of these. Raises LinkError where certificates cannot be made.
        """
        users = _users(processes)
        return cls(
            run,
            tuple(tuple(nodes) for nodes in processes),
            {user: secrets.token_urlsafe(24) for user in users},
            None if tls_listen is None else _issue_certificates(users, tls_listen, tls_names),
        )

    def credentials(self, user: str) -> Credentials:
        """One user's credentials; node users are named by `node_user(lead)`."""
        identity = None if self.tls is None else Identity(self.tls.authority, self.tls.users[user])
        return Credentials(user, self.passwords[user], identity)

    def dictionary(self) -> str:
        """The router's dictionary file: a line `user:password` each."""
        return "".join(f"{user}:{password}\n" for user, password in self.passwords.items())

    def access_control(self) -> dict[str, Any]:
        """The `access_control` section of a router's configuration."""
        rules: list[Rule] = []
        subjects: list[dict[str, Any]] = []
        policies: list[dict[str, Any]] = []
        for user, user_rules in self._roles():
            rules += user_rules
            subject: dict[str, Any] = {"id": user, "usernames": [user]}
            if self.tls is not None:  # Zenoh wants both of a subject: another's password or certificate is no use
                subject["cert_common_names"] = [common_name(user)]
            subjects.append(subject)
            policies.append({"rules": [rule["id"] for rule in user_rules], "subjects": [user]})
        return {
            "enabled": True,
            "default_permission": "deny",
            "rules": rules,
            "subjects": subjects,
            "policies": policies,
        }

    def _roles(self) -> list[tuple[str, list[Rule]]]:
        roles = [(node_user(nodes[0]), _node_rules(self.run, nodes)) for nodes in self.processes]
        observed = [
            keys.observe(self.run, "**"),
            keys.node_report(self.run, "*"),
            keys.emulator_alive(self.run),
        ]
        return [
            *roles,
            (
                OBSERVER,
                [
                    _rule("observer-in", ["ingress"], [*SUBSCRIBE, *WATCH_TOKENS], observed),
                    _rule("observer-out", ["egress"], ["put", "delete", "liveliness_token"], observed),
                ],
            ),
            (
                OPERATOR,
                [
                    _rule("operator-ask", ["ingress"], ["query"], [keys.control(self.run, "*")]),
                    _rule("operator-told", ["egress"], ["reply"], [keys.control(self.run, "*")]),
                ],
            ),
            (EMULATOR, [_rule("emulator", ["ingress", "egress"], EVERYTHING, [f"vnet/{self.run}/**"])]),
        ]

    def save(self, folder: Path, listen: str, router_folder: Path) -> None:
        """Write what a separate `zenohd` and hand-started agents need. Raises LinkError if it cannot.

        `zenohd.json5`, `users.txt` (its dictionary) and `credentials/{role or lead node}.json`, all 0600, in
        folders of 0700 (an existing `folder` keeps its mode). Certificates and keys stand in these files.
        `router_folder` is where the router sees the folder, which in a container is somewhere else.
        """
        self.check_endpoint(listen)
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            (folder / "credentials").mkdir(exist_ok=True)
            (folder / "credentials").chmod(0o700)
            write_private(folder / "users.txt", self.dictionary())
            config = router_config([listen], router_folder / "users.txt", self.access_control(), self.tls)
            write_private(folder / "zenohd.json5", json.dumps(config, indent=1) + "\n")
            for user in self.passwords:
                name = user.removeprefix("node-") + ".json"
                write_private(folder / "credentials" / name, self.credentials(user).dumps())
            write_private(folder / "access.json", _dumps(self))
        except OSError as error:
            raise LinkError(f"access folder {folder}: {error.strerror}") from None

    @classmethod
    def load(cls, folder: Path) -> Access:
        """Restore what `save` wrote. Raises LinkError."""
        try:
            access = _load(folder / "access.json", cls)
            access._check()
        except OSError as error:
            raise LinkError(f"access folder {folder}: {error.strerror}; write it with: vnet access") from None
        except ValueError:
            raise LinkError(f"access folder {folder}: access.json is not what vnet access writes") from None
        return access

    def _check(self) -> None:
        """Raises ValueError if this is not what `create` makes: rules and the dictionary are written from it."""
        names = [self.run, *(node for nodes in self.processes for node in nodes)]
        if not all(map(keys.is_segment, names)) or not all(self.processes):
            raise ValueError
        users = sorted(_users(self.processes))
        if users != sorted(self.passwords) or (self.tls is not None and users != sorted(self.tls.users)):
            raise ValueError
        for user, password in self.passwords.items():
            _check_user(user, password)

    def check_endpoint(self, listen: str) -> None:
        """Raises LinkError unless a router at `listen` speaks TLS if and only if its users have certificates."""
        if self.tls is None and is_tls(listen):
            raise LinkError(
                f"{listen}: the users have no certificates; write them with: vnet access --listen tls/…"
            )
        if self.tls is not None and not is_tls(listen):
            raise LinkError(f"{listen}: the users have certificates; only at tls/HOST:PORT are they asked for them")


SUBSCRIBE = ["declare_subscriber"]
WATCH_TOKENS = ["declare_liveliness_subscriber", "liveliness_query"]
EVERYTHING = [
    "put",
    "delete",
    "declare_subscriber",
    "query",
    "declare_queryable",
    "reply",
    "liveliness_token",
    "declare_liveliness_subscriber",
    "liveliness_query",
]


def _users(processes: Sequence[Sequence[str]]) -> list[str]:
    """All users of a run: one for each process, and the other roles."""
    return [*(node_user(nodes[0]) for nodes in processes), EMULATOR, OBSERVER, OPERATOR]


def node_user(lead: str) -> str:
    """The user name of an agent process, by the first of its nodes."""
    return f"node-{lead}"


def is_tls(endpoint: str) -> bool:
    """Whether an endpoint is one of TLS."""
    return endpoint.startswith("tls/")


def common_name(user: str) -> str:
    """The name of a user in its certificate, where there is room for 64 characters."""
    if len(user) <= 64:
        return user
    return f"user-{hashlib.blake2b(user.encode(), digest_size=16).hexdigest()}"


def write_private(path: Path, text: str) -> None:
    """Write a file that only its owner may read."""
    path.unlink(missing_ok=True)
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    with os.fdopen(descriptor, "w") as file:
        file.write(text)


def router_config(
    listen: Sequence[str], dictionary: Path, access_control: dict[str, Any], tls: Certificates | None
) -> dict[str, Any]:
    """The configuration of a router that lets in only the run's users, embedded or separate."""
    config: dict[str, Any] = {
        "mode": "router",
        "listen": {"endpoints": list(listen)},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {
            "shared_memory": {"enabled": False},
            "auth": {"usrpwd": {"dictionary_file": str(dictionary)}},
        },
        "access_control": access_control,
    }
    if tls is not None:
        config["transport"]["link"] = {
            "tls": {
                "root_ca_certificate_base64": as_base64(tls.authority),
                "listen_certificate_base64": as_base64(tls.router.certificate),
                "listen_private_key_base64": as_base64(tls.router.private_key),
                "enable_mtls": True,
            }
        }
    return config


def as_base64(pem: str) -> str:
    """PEM as Zenoh takes it within a configuration."""
    return base64.b64encode(pem.encode()).decode()


def _issue_certificates(users: Sequence[str], listen: str, names: Sequence[str]) -> Certificates:
    try:
        from vnet.transport.certificates import issue_certificates, router_names
    except ImportError:
        raise LinkError("certificates need the package cryptography: pip install 'vnet-emulator[tls]'") from None
    return issue_certificates(users, router_names(listen, names))


_T = TypeVar("_T")


def _dumps(record: Any) -> str:
    return msgspec.json.encode(record).decode() + "\n"


def _load(path: Path, kind: type[_T]) -> _T:
    """Restore `_dumps`. Raises OSError, and ValueError if the file holds anything else."""
    try:
        return msgspec.json.decode(read_bounded(path, LARGEST_FILE_BYTES), type=kind)
    except (msgspec.DecodeError, RecursionError) as error:
        raise ValueError from error


def _check_user(user: str, password: str) -> None:
    """Raises ValueError for what would not stay one entry in the router's dictionary."""
    if not user or not password or ":" in user or not (user + password).isprintable():
        raise ValueError


def _node_rules(run: str, nodes: Sequence[str]) -> list[Rule]:
    lead = nodes[0]
    tx = [keys.node_tx(run, node) for node in nodes]
    rx = [keys.node_rx(run, node) for node in nodes]
    report = [keys.node_report(run, node) for node in nodes]
    alive = [keys.node_alive(run, node) for node in nodes]
    emulator = [keys.emulator_alive(run)]
    return [
        _rule(f"{lead}-put", ["ingress"], ["put"], tx + report),
        _rule(f"{lead}-token", ["ingress"], ["liveliness_token"], alive),
        _rule(f"{lead}-subscribe", ["ingress"], SUBSCRIBE, rx),
        _rule(f"{lead}-receive", ["egress"], ["put"], rx),
        # That the emulator and observers listen (they do so to all nodes at once) is what opens a publisher.
        _rule(f"{lead}-matching", ["egress"], SUBSCRIBE, [keys.node_tx(run, "*"), keys.node_report(run, "*")]),
        _rule(f"{lead}-watch", ["ingress"], WATCH_TOKENS, emulator),
        _rule(f"{lead}-watched", ["egress"], ["liveliness_token"], emulator),
    ]


def _rule(name: str, flows: list[str], messages: list[str], key_exprs: list[str]) -> Rule:
    return {
        "id": name,
        "permission": "allow",
        "flows": flows,
        "messages": messages,
        "key_exprs": key_exprs,
    }
