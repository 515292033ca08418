"""TLS certificates and node keys of a deployment.

TLS: a new certificate authority (CA) signs the server's certificate; nodes and users get the CA's certificate and check
the server against it. Node authentication: each node has a private key, the server has the public keys. The
certificates are valid for a week; for a permanent deployment use those of your own CA.
"""

# The package `trustme` would be shorter but is meant for tests only: its CA stays valid until the year 3000, and the
# certificates it issues are also valid for clients and code signing.

import ipaddress
import os
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID

Key, Extension = ec.EllipticCurvePrivateKey, x509.ExtensionType
PEM, PKCS8 = serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8
NO_PASSWORD = serialization.NoEncryption()
AUTHORITY, DAYS = "federation authority", 7
LOCAL_HOSTS = ("localhost", "127.0.0.1")
CA_USAGE = x509.KeyUsage(
    digital_signature=True, key_cert_sign=True, crl_sign=True, content_commitment=False, key_encipherment=False,
    data_encipherment=False, key_agreement=False, encipher_only=False, decipher_only=False,
)  # fmt: skip


@dataclass(frozen=True)
class ServerFiles:
    """Paths of the CA's certificate, the server's certificate and its private key. Nodes get only `authority`."""

    authority: Path
    certificate: Path
    key: Path


@dataclass(frozen=True)
class NodeKey:
    """Paths of a node's private key, which never leaves the node, and of its public key, which the server registers."""

    private: Path
    public: Path


def make_server(folder: Path, hosts: Sequence[str] = (), *, until: datetime | None = None) -> ServerFiles:
    """Make a CA and a server certificate signed by it; the CA's private key is not kept.

    Args:
        folder: where the files are written.
        hosts: names and addresses at which other machines reach the server. The local ones are added, because a
            SuperLink also connects to itself.
        until: end of validity, with a time zone; default a week from now. A past date makes an expired certificate.
    """
    until = until or datetime.now(UTC) + timedelta(days=DAYS)
    authority_key, server_key = ec.generate_private_key(ec.SECP384R1()), ec.generate_private_key(ec.SECP384R1())
    names = [_host(host) for host in dict.fromkeys([*hosts, *LOCAL_HOSTS])]
    folder.mkdir(parents=True, exist_ok=True)
    files = ServerFiles(folder / "ca.crt", folder / "server.pem", folder / "server.key")
    files.authority.write_bytes(_certificate(AUTHORITY, authority_key, authority_key, until, {
        x509.BasicConstraints(ca=True, path_length=0): True, CA_USAGE: True,
        x509.SubjectKeyIdentifier.from_public_key(authority_key.public_key()): False,
    }))  # fmt: skip
    files.certificate.write_bytes(_certificate("federation server", server_key, authority_key, until, {
        x509.SubjectAlternativeName(names): False, x509.BasicConstraints(ca=False, path_length=None): True,
        x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH]): False,
        x509.AuthorityKeyIdentifier.from_issuer_public_key(authority_key.public_key()): False,
    }))  # fmt: skip
    _write_secret(files.key, server_key.private_bytes(PEM, PKCS8, NO_PASSWORD))
    return files


def make_node_key(folder: Path, name: str) -> NodeKey:
    """Make a P-384 key pair in OpenSSH format, which Flower reads, as files `name` and ``name.pub``."""
    folder.mkdir(parents=True, exist_ok=True)
    key, files = ec.generate_private_key(ec.SECP384R1()), NodeKey(folder / name, folder / f"{name}.pub")
    _write_secret(files.private, key.private_bytes(PEM, serialization.PrivateFormat.OpenSSH, NO_PASSWORD))
    openssh = serialization.Encoding.OpenSSH, serialization.PublicFormat.OpenSSH
    files.public.write_bytes(key.public_key().public_bytes(*openssh) + b"\n")
    return files


def _certificate(subject: str, key: Key, signer: Key, until: datetime, extensions: dict[Extension, bool]) -> bytes:
    """Return a certificate (PEM) of the authority with these extensions, each critical or not."""
    builder = (
        x509.CertificateBuilder()
        .subject_name(x509.Name.from_rfc4514_string(f"CN={subject}"))
        .issuer_name(x509.Name.from_rfc4514_string(f"CN={AUTHORITY}"))
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(min(datetime.now(UTC), until) - timedelta(days=1))  # clocks differ
        .not_valid_after(until)
    )
    for extension, critical in extensions.items():
        builder = builder.add_extension(extension, critical)
    return builder.sign(signer, hashes.SHA256()).public_bytes(PEM)


def _host(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _write_secret(path: Path, content: bytes) -> None:
    """Write a file that only its owner can read."""
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "wb") as file:
        file.write(content)
