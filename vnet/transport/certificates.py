"""Certificates of a run, for a router that speaks TLS: the names it goes by, and how to have them issued."""

from __future__ import annotations

import socket
from collections.abc import Callable, Sequence

from vnet.errors import TransportError
from vnet.transport.credentials import Certificates

_LOOPBACK = ("localhost", "127.0.0.1", "::1")
_ANYWHERE = ("0.0.0.0", "::", "*")


def certifier(listen: str, names: Sequence[str] = ()) -> Callable[[Sequence[str]], Certificates]:
    """Return a function that issues the certificates of the users of a router that listens at `listen`.

    `names` are further names or addresses that the router goes by: clients verify that they met one of these.
    Raises TransportError where the package cryptography is missing; the function raises it for what is no name.
    """
    try:
        from vnet.transport.authority import issue_certificates
    except ImportError:
        message = "certificates need the package cryptography: pip install 'vnet-emulator[tls]'"
        raise TransportError(message) from None
    return lambda users: issue_certificates(users, router_names(listen, names))


def router_names(endpoint: str, more: Sequence[str] = ()) -> list[str]:
    """What a router that listens at `endpoint` goes by: its clients verify that they met one of these.

    Loopback, the endpoint's host (where that is all addresses: what this machine knows itself by), and `more`.
    """
    host = endpoint.partition("/")[2].rpartition(":")[0].strip("[]")
    names = [*_LOOPBACK, *(_own_names() if host in _ANYWHERE else [host]), *more]
    return list(dict.fromkeys(names))


def _own_names() -> list[str]:
    name = socket.gethostname()
    try:
        return [name, *sorted({str(address[4][0]) for address in socket.getaddrinfo(name, None)})]
    except OSError:  # a machine that does not know its own address
        return [name]
