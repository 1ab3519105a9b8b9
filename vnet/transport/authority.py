"""Issuing of certificates for one run: a certificate authority, and key pairs for the router and every user.

The authority signs once, when the run's users are created, and its private key is then discarded: no further
certificate that this run's router accepts can be issued. This module needs the package `cryptography` (extra `tls`)
and is imported only to issue certificates. Zenoh reads them as PEM.
"""

from __future__ import annotations

import datetime
import ipaddress
from collections.abc import Iterable, Sequence

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID, ObjectIdentifier

from vnet.errors import TransportError, shown
from vnet.transport.credentials import Certificates, KeyPair, common_name

VALID_DAYS = 365
"""Validity of certificates, longer than any run."""


def issue_certificates(users: Iterable[str], names: Sequence[str]) -> Certificates:
    """Issue all certificates of a run; `names` are the host names and addresses of the router.

    They are valid from a day ago, because clocks differ, for `VALID_DAYS`. Raise TransportError for a bad name.
    """
    authority = _Authority()
    router = authority.issue("router", ExtendedKeyUsageOID.SERVER_AUTH, [_general_name(name) for name in names])
    return Certificates(
        authority.certificate,
        router,
        {user: authority.issue(common_name(user), ExtendedKeyUsageOID.CLIENT_AUTH) for user in users},
    )


def _general_name(name: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(name))
    except ValueError:
        pass
    try:
        return x509.DNSName(name.encode("idna").decode())
    except UnicodeError:
        raise TransportError(f"{shown(name)}: not a host name or an address for a certificate") from None


class _Authority:
    """A certificate authority, whose key exists only as long as this object."""

    def __init__(self) -> None:
        self._key = ec.generate_private_key(ec.SECP256R1())
        self._name = _name("vnet authority")
        builder = self._builder("vnet authority", self._key.public_key())
        builder = builder.add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        self.certificate = self._sign(builder)

    def issue(self, name: str, usage: ObjectIdentifier, alternatives: Sequence[x509.GeneralName] = ()) -> KeyPair:
        """Issue a key pair for `name`, for one side of a connection (server or client) only."""
        key = ec.generate_private_key(ec.SECP256R1())
        builder = self._builder(name, key.public_key())
        builder = builder.add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        builder = builder.add_extension(x509.ExtendedKeyUsage([usage]), critical=False)
        if alternatives:
            builder = builder.add_extension(x509.SubjectAlternativeName(alternatives), critical=False)
        private = key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
        return KeyPair(self._sign(builder), private.decode())

    def _builder(self, name: str, key: ec.EllipticCurvePublicKey) -> x509.CertificateBuilder:
        now = datetime.datetime.now(datetime.UTC)
        return (
            x509.CertificateBuilder()
            .subject_name(_name(name))
            .issuer_name(self._name)
            .public_key(key)
            .serial_number(x509.random_serial_number())
            .not_valid_before(now - datetime.timedelta(days=1))
            .not_valid_after(now + datetime.timedelta(days=VALID_DAYS))
        )

    def _sign(self, builder: x509.CertificateBuilder) -> str:
        return builder.sign(self._key, hashes.SHA256()).public_bytes(Encoding.PEM).decode()


def _name(name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
