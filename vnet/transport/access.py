"""Access control of the router: users, passwords, certificates and rules of one run.

The router denies by default. Roles: *node* (a user for each agent process, with access to exactly its nodes' keys),
*host* (a user for each host of a run on several hosts, in place of its agents, with access to its own keys),
*observer* (receives only), *operator* (queries `control`) and *emulator* (all keys of the run; used only if the
emulator is a client of a separate router). Zenoh's rules have no templates by user name, so each process and each
host has its own.
"""

from __future__ import annotations

import json
import re
import secrets
import socket
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from vnet.errors import TransportError, shown
from vnet.extras import require
from vnet.transport import keys, wire
from vnet.transport.credentials import (
    Certificates,
    Credentials,
    Identity,
    as_base64,
    check_user,
    common_name,
    dump_record,
    load_record,
    write_private,
)

Rule = dict[str, Any]

MOST_SESSIONS = 10_100
"""Most sessions of a router, and most that may log in at once: a run's processes and roles. Zenoh's defaults, 1000
and 100, refuse agents that start together."""

_ENDPOINT = re.compile(r"(?:tcp|tls|udp)/[^\s/?#]+:([0-9]{1,5})(?:[?#]\S*)?\Z")
"""Endpoint of a router, with its port; settings of Zenoh's may follow, as `#iface=eth0`."""

EMULATOR = "emulator"
OBSERVER = "observer"
OPERATOR = "operator"


@dataclass(frozen=True)
class Access:
    """All users of a run. `processes` are the node ids of each agent process; the first is the process's id.

    With `tls` the router accepts only TLS, and a user needs its own certificate as well as its password. `hosts`
    are the ids of the processes on each host by its name, all of the run; empty if agents connect to the router.
    `units` are the nodes that have keys of the backbone.
    """

    run: str
    processes: tuple[tuple[str, ...], ...]
    passwords: dict[str, str] = field(repr=False)
    tls: Certificates | None = None
    hosts: dict[str, tuple[str, ...]] = field(default_factory=dict)
    units: tuple[str, ...] = ()

    @classmethod
    def create(
        cls,
        run: str,
        processes: Sequence[Sequence[str]],
        certify: Callable[[Sequence[str]], Certificates] | None = None,
        hosts: Sequence[str] = (),
        units: Sequence[str] = (),
    ) -> Access:
        """Draw new passwords for every process and role of a run.

        `certify` issues the certificates of all users for a router that accepts only TLS; see
        `certificates.certifier`. With `hosts` (names) the processes are on these, in equal parts in the order of
        both, and each host has a user in place of its processes. `units` are the nodes that are roadside units.
        Raise TransportError for what cannot be done.
        """
        shares = _share([nodes[0] for nodes in processes], hosts)
        users = _users(processes, shares)
        return cls(
            run,
            tuple(tuple(nodes) for nodes in processes),
            {user: secrets.token_urlsafe(24) for user in users},
            None if certify is None else certify(users),
            shares,
            tuple(units),
        )

    def processes_on(self, host: str) -> list[list[str]]:
        """Return the node ids of each process on a host."""
        return [list(nodes) for nodes in self.processes if nodes[0] in self.hosts[host]]

    def credentials(self, user: str) -> Credentials:
        """Return a user's credentials; node users are named by `node_user(process_id)`."""
        identity = None if self.tls is None else Identity(self.tls.authority, self.tls.users[user])
        return Credentials(user, self.passwords[user], identity)

    def dictionary(self) -> str:
        """Return the router's dictionary file: a line `user:password` for each user."""
        return "".join(f"{user}:{password}\n" for user, password in self.passwords.items())

    def access_control(self) -> dict[str, Any]:
        """Return the `access_control` section of a router's configuration."""
        rules: list[Rule] = []
        subjects: list[dict[str, Any]] = []
        policies: list[dict[str, Any]] = []
        for user, user_rules in self._roles():
            rules += user_rules
            subject: dict[str, Any] = {"id": user, "usernames": [user]}
            if self.tls is not None:  # Zenoh then requires both from the same user
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
        if self.hosts:
            roles = [(host_user(host), _host_rules(self.run, host)) for host in self.hosts]
        else:
            roles = [(node_user(nodes[0]), self._process_rules(nodes)) for nodes in self.processes]
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

    def _process_rules(self, nodes: Sequence[str]) -> list[Rule]:
        units = [node for node in nodes if node in self.units]
        return _node_rules(self.run, nodes) + (_unit_rules(self.run, nodes[0], units) if units else [])

    def save(self, folder: Path, listen: str, router_folder: Path) -> None:
        """Write the files for a separate `zenohd` and manually started agents. Raise TransportError on failure.

        `zenohd.json5`, `users.txt` (its dictionary) and `credentials/{role or process id}.json`, all with mode
        0600, in folders of 0700 (an existing `folder` keeps its mode). These files contain certificates and keys.
        `router_folder` is the folder's path on the router, which may differ in a container.
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
            write_private(folder / "access.json", dump_record(self))
        except OSError as error:
            raise TransportError(f"access folder {folder}: {error.strerror}") from None

    @classmethod
    def load(cls, folder: Path) -> Access:
        """Restore what `save` wrote. Raise TransportError if a file is missing or bad."""
        try:
            access = load_record(folder / "access.json", cls)
            access._check()
        except OSError as error:
            raise TransportError(f"access folder {folder}: {error.strerror}; write it with: vnet access") from None
        except ValueError:
            raise TransportError(f"access folder {folder}: access.json is not what vnet access writes") from None
        return access

    def _check(self) -> None:
        """Raise ValueError if `create` cannot have made this: rules and the dictionary are written from it."""
        names = [self.run, *self.hosts, *self.units, *(node for nodes in self.processes for node in nodes)]
        if not all(map(keys.is_segment, names)) or not all(self.processes):
            raise ValueError
        hosted = sorted(process_id for share in self.hosts.values() for process_id in share)
        if self.hosts and hosted != sorted(nodes[0] for nodes in self.processes):
            raise ValueError
        users = sorted(_users(self.processes, self.hosts))
        if users != sorted(self.passwords) or (self.tls is not None and users != sorted(self.tls.users)):
            raise ValueError
        for user, password in self.passwords.items():
            check_user(user, password)

    def check_endpoint(self, listen: str) -> None:
        """Raise TransportError unless `listen` is an endpoint, of TLS exactly if the users have certificates."""
        endpoint = _ENDPOINT.match(listen)
        if endpoint is None or int(endpoint[1]) > 65535:
            raise TransportError(f"cannot listen on {listen}: an endpoint is HOST:PORT after tcp/, tls/ or udp/")
        if self.tls is None and is_tls(listen):
            raise TransportError(
                f"{listen}: the users have no certificates; write them with: vnet access --listen tls/…"
            )
        if self.tls is not None and not is_tls(listen):
            raise TransportError(f"{listen}: the users have certificates, which are used only at tls/HOST:PORT")


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


def _users(processes: Sequence[Sequence[str]], hosts: Mapping[str, Sequence[str]]) -> list[str]:
    """Return all users of a run: one for each process, or for each host if there are any, and the other roles."""
    own = [host_user(host) for host in hosts] or [node_user(nodes[0]) for nodes in processes]
    return [*own, EMULATOR, OBSERVER, OPERATOR]


def _share(process_ids: Sequence[str], hosts: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Return the processes of each host: parts whose lengths differ by at most one. Raise TransportError."""
    for host in hosts:
        if not keys.is_segment(host):
            raise TransportError(f"host {shown(host)}: {keys.SEGMENTS}")
        if hosts.count(host) > 1:
            raise TransportError(f"host {host}: named {hosts.count(host)} times; each host needs a name of its own")
    if len(hosts) > len(process_ids):
        raise TransportError(
            f"{len(hosts)} hosts for {len(process_ids)} agent processes: at most one host for each"
        )
    edges = [len(process_ids) * number // len(hosts) for number in range(len(hosts) + 1)] if hosts else []
    return {host: tuple(process_ids[edges[i] : edges[i + 1]]) for i, host in enumerate(hosts)}


def node_user(process_id: str) -> str:
    """Return the user name of an agent process, whose id is the first of its nodes."""
    return f"node-{process_id}"


def host_user(host: str) -> str:
    """Return the user name of a host."""
    return f"host-{host}"


def is_tls(endpoint: str) -> bool:
    """Return true for a TLS endpoint."""
    return endpoint.startswith("tls/")


LEASE_MS = 3_600_000
"""Time after which a silent connection ends. Long: who is paused or starved is not dead, a connection that closes
is seen at once, and silence is judged by the emulator, which knows what it waits for."""


def queues(lease_ms: int) -> dict[str, Any]:
    """Return the leases, and queues as long as Zenoh allows: in real time messages to a full queue are dropped."""
    return {"tx": {"lease": lease_ms, "keep_alive": 4, "queue": {"size": {"data": 16}}}}


def router_config(
    listen: Sequence[str], dictionary: Path, access_control: dict[str, Any], tls: Certificates | None
) -> dict[str, Any]:
    """Return the configuration of a router, embedded or separate, that admits only the run's users."""
    # Zenoh drops a larger message without a word: those of agents are refused by name up to twice their bound.
    link: dict[str, Any] = {**queues(LEASE_MS), "rx": {"max_message_size": wire.LARGEST_BUNDLE_BYTES}}
    config: dict[str, Any] = {
        "mode": "router",
        "listen": {"endpoints": list(listen)},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {
            "shared_memory": {"enabled": False},
            "auth": {"usrpwd": {"dictionary_file": str(dictionary)}},
            "unicast": {"accept_pending": MOST_SESSIONS, "max_sessions": MOST_SESSIONS},
            "link": link,
        },
        "access_control": access_control,
    }
    if tls is not None:
        link["tls"] = {
            "root_ca_certificate_base64": as_base64(tls.authority),
            "listen_certificate_base64": as_base64(tls.router.certificate),
            "listen_private_key_base64": as_base64(tls.router.private_key),
            "enable_mtls": True,
        }
    return config


def _node_rules(run: str, nodes: Sequence[str]) -> list[Rule]:
    tx, rx, report, alive = (
        [key(run, node) for node in nodes]
        for key in (keys.node_tx, keys.node_rx, keys.node_report, keys.node_alive)
    )
    matched = [keys.node_tx(run, "*"), keys.node_report(run, "*")]
    return _client_rules(nodes[0], run, tx + report, rx, alive, matched)


def _host_rules(run: str, host: str) -> list[Rule]:
    tx, rx, alive = ([key(run, host)] for key in (keys.host_tx, keys.host_rx, keys.host_alive))
    return _client_rules(host_user(host), run, tx, rx, alive, [keys.host_tx(run, "*")])


def _client_rules(
    name: str, run: str, tx: list[str], rx: list[str], alive: list[str], matched: list[str]
) -> list[Rule]:
    """Rules of a process or host: keys on which it sends and receives, and those of its tokens.

    A publisher sends only once it knows the subscriptions of the emulator and observers, which are for all nodes:
    `matched`.
    """
    emulator = [keys.emulator_alive(run)]
    return [
        _rule(f"{name}-put", ["ingress"], ["put"], tx),
        _rule(f"{name}-token", ["ingress"], ["liveliness_token"], alive),
        _rule(f"{name}-subscribe", ["ingress"], SUBSCRIBE, rx),
        _rule(f"{name}-receive", ["egress"], ["put"], rx),
        _rule(f"{name}-matching", ["egress"], SUBSCRIBE, matched),
        _rule(f"{name}-watch", ["ingress"], WATCH_TOKENS, emulator),
        _rule(f"{name}-watched", ["egress"], ["liveliness_token"], emulator),
    ]


def _unit_rules(run: str, process_id: str, units: Sequence[str]) -> list[Rule]:
    """Rules of a process for the backbone of its roadside units. No other process has any there."""
    rx = [keys.backbone_rx(run, unit) for unit in units]
    return [
        _rule(f"{process_id}-send", ["ingress"], ["put"], [keys.backbone_tx(run, unit) for unit in units]),
        _rule(f"{process_id}-listen", ["ingress"], SUBSCRIBE, rx),
        _rule(f"{process_id}-hear", ["egress"], ["put"], rx),
        _rule(f"{process_id}-matched", ["egress"], SUBSCRIBE, [keys.backbone_tx(run, "*")]),
    ]


def _rule(name: str, flows: list[str], messages: list[str], key_exprs: list[str]) -> Rule:
    return {
        "id": name,
        "permission": "allow",
        "flows": flows,
        "messages": messages,
        "key_exprs": key_exprs,
    }


_LOOPBACK = ("localhost", "127.0.0.1", "::1")
"""Names of this machine for itself."""
_ANY_ADDRESS = ("0.0.0.0", "::", "*")
"""Hosts of endpoints that listen on all addresses."""


def certifier(listen: str, names: Sequence[str] = ()) -> Callable[[Sequence[str]], Certificates]:
    """Return a function that issues the certificates of the users of a router that listens at `listen`.

    `names` are further host names or addresses of the router, which clients verify. Raise TransportError if the
    package cryptography is missing; the function raises it for a bad name.
    """
    require("a certificate", "cryptography", error=TransportError)
    from vnet.transport.authority import issue_certificates

    return lambda users: issue_certificates(users, router_names(listen, names))


def router_names(endpoint: str, more: Sequence[str] = ()) -> list[str]:
    """Return the names of a router that listens at `endpoint`, of which clients verify one.

    They are loopback, the endpoint's host (or, if it listens on all addresses, this machine's names), and `more`.
    """
    host = endpoint.partition("/")[2].rpartition(":")[0].strip("[]")
    names = [*_LOOPBACK, *(_own_names() if host in _ANY_ADDRESS else [host]), *more]
    return list(dict.fromkeys(names))


def _own_names() -> list[str]:
    name = socket.gethostname()
    try:
        return [name, *sorted({str(address[4][0]) for address in socket.getaddrinfo(name, None)})]
    except OSError:  # the machine's name does not resolve
        return [name]
