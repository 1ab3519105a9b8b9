"""Certificates of a TLS router: its names, and a function that issues the certificates of a run."""

from __future__ import annotations

import socket
from collections.abc import Callable, Sequence

from vnet.errors import TransportError
from vnet.transport.credentials import Certificates

_LOOPBACK = ("localhost", "127.0.0.1", "::1")
"""Names of this machine for itself."""
_ANY_ADDRESS = ("0.0.0.0", "::", "*")
"""Hosts of endpoints that listen on all addresses."""


def certifier(listen: str, names: Sequence[str] = ()) -> Callable[[Sequence[str]], Certificates]:
    """Return a function that issues the certificates of the users of a router that listens at `listen`.

    `names` are further host names or addresses of the router, which clients verify. Raise TransportError if the
    package cryptography is missing; the function raises it for a bad name.
    """
    try:
        from vnet.transport.authority import issue_certificates
    except ImportError:
        message = "certificates need the package cryptography: pip install 'vnet-emulator[tls]'"
        raise TransportError(message) from None
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
