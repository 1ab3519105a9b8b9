"""Who may do what on the router: users, passwords and rules for one run.

The router denies by default. Roles: *node* (one user an agent process, granted exactly its nodes' keys),
*observer* (receives only), *operator* (queries `control`) and *emulator* (all of the run's keys; needed only where
the emulator is a client of a separate router). Rules have no templating by user name, so that there is a set for
each process.
"""

from __future__ import annotations

import json
import os
import secrets
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vnet.errors import LinkError
from vnet.link import keys

Rule = dict[str, Any]

EMULATOR = "emulator"
OBSERVER = "observer"
OPERATOR = "operator"


@dataclass(frozen=True)
class Credentials:
    """A user of the router and its password. Kept in 0600 files or passed by an inherited descriptor."""

    user: str
    password: str

    def dumps(self) -> str:
        """The form of a credentials file."""
        return json.dumps({"user": self.user, "password": self.password}) + "\n"

    @classmethod
    def load(cls, path: Path) -> Credentials:
        """Read a credentials file. Raises LinkError."""
        try:
            data = json.loads(path.read_text())
            return cls(str(data["user"]), str(data["password"]))
        except OSError as error:
            raise LinkError(f"credentials {path}: cannot be read: {error.strerror}") from None
        except (ValueError, KeyError, TypeError):
            raise LinkError(f"credentials {path}: not a credentials file of vnet") from None


@dataclass(frozen=True)
class Access:
    """All users of a run. `processes` are the node ids of each agent process, its lead first."""

    run: str
    processes: tuple[tuple[str, ...], ...]
    passwords: dict[str, str]

    @classmethod
    def create(cls, run: str, processes: Sequence[Sequence[str]]) -> Access:
        """Draw new passwords for every process and role of a run."""
        users = [node_user(nodes[0]) for nodes in processes] + [EMULATOR, OBSERVER, OPERATOR]
        return cls(
            run,
            tuple(tuple(nodes) for nodes in processes),
            {user: secrets.token_urlsafe(24) for user in users},
        )

    def credentials(self, user: str) -> Credentials:
        """One user's credentials; node users are named by `node_user(lead)`."""
        return Credentials(user, self.passwords[user])

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
            subjects.append({"id": user, "usernames": [user]})
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

        `zenohd.json5`, `users.txt` (its dictionary) and `credentials/{role or lead node}.json`, all 0600.
        `router_folder` is where the router sees the folder, which in a container is somewhere else.
        """
        try:
            (folder / "credentials").mkdir(parents=True, exist_ok=True)
            write_private(folder / "users.txt", self.dictionary())
            config = router_config([listen], router_folder / "users.txt", self.access_control())
            write_private(folder / "zenohd.json5", json.dumps(config, indent=1) + "\n")
            for user, password in self.passwords.items():
                name = user.removeprefix("node-") + ".json"
                write_private(folder / "credentials" / name, Credentials(user, password).dumps())
            manifest = {"run": self.run, "processes": self.processes, "passwords": self.passwords}
            write_private(folder / "access.json", json.dumps(manifest) + "\n")
        except OSError as error:
            raise LinkError(f"access folder {folder}: {error.strerror}") from None

    @classmethod
    def load(cls, folder: Path) -> Access:
        """Restore what `save` wrote. Raises LinkError."""
        try:
            data = json.loads((folder / "access.json").read_text())
            return cls(data["run"], tuple(tuple(nodes) for nodes in data["processes"]), data["passwords"])
        except OSError as error:
            raise LinkError(f"access folder {folder}: {error.strerror}; write it with: vnet access") from None
        except (ValueError, KeyError, TypeError):
            raise LinkError(f"access folder {folder}: access.json is not what vnet access writes") from None


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


def node_user(lead: str) -> str:
    """The user name of an agent process, by the first of its nodes."""
    return f"node-{lead}"


def write_private(path: Path, text: str) -> None:
    """Write a file that only its owner may read."""
    path.unlink(missing_ok=True)
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    with os.fdopen(descriptor, "w") as file:
        file.write(text)


def router_config(listen: Sequence[str], dictionary: Path, access_control: dict[str, Any]) -> dict[str, Any]:
    """The configuration of a router that lets in only the run's users, embedded or separate."""
    return {
        "mode": "router",
        "listen": {"endpoints": list(listen)},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {
            "shared_memory": {"enabled": False},
            "auth": {"usrpwd": {"dictionary_file": str(dictionary)}},
        },
        "access_control": access_control,
    }


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
