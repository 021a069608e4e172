"""A certificate authority for tests: X.509 certificates with P-256 keys as PEM files.

The authority's key can impersonate every process, so use this authority only in trials and test
beds; elsewhere, use an existing authority with the same common names. The package trustme is not
enough: it would allow every certificate to act as a server, and so as the router.
"""

from __future__ import annotations

import datetime as dt
import ipaddress
import os
from collections.abc import Sequence
from pathlib import Path

from attrs import frozen
from cryptography import x509
from cryptography.exceptions import UnsupportedAlgorithm
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.security.connection import (
    ca_path,
    certificate_path,
    identity_folder,
    key_path,
)
from laneweave.protocol.wire.identities import Identity
from laneweave.protocol.wire.topics import Party

CA_NAME = "laneweave test authority"
CA_DAYS = 3650.0
CLOCKS_APART = dt.timedelta(minutes=10)
"""Time by which validity is backdated, because the clocks of hosts differ."""
LOCAL_HOSTS = ("localhost", "127.0.0.1", "::1")


@frozen
class Authority:
    """Certificate and private key of an authority."""

    certificate: x509.Certificate
    key: ec.EllipticCurvePrivateKey


def make_authority(folder: Path, *, days: float = CA_DAYS) -> Authority:
    """Create an authority and write its files.

    Args:
        folder: folder for the files; created if necessary.
        days: validity of the certificate in days.

    Raises:
        BadInputError: an authority exists, or the files cannot be written.
    """
    if ca_path(folder).exists() or authority_key_path(folder).exists():
        allowed = "a folder without ca.pem and ca.key; or with both, and --keep"
        raise BadInputError("DIR", str(folder), allowed)
    key = ec.generate_private_key(ec.SECP256R1())
    name = _name(CA_NAME)
    certificate = (
        _builder(name, name, key.public_key(), days)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_key_usage(signs_certificates=True), critical=True)
        .sign(key, hashes.SHA256())
    )
    authority = Authority(certificate, key)
    _make_folder(folder)
    _write_key(authority_key_path(folder), key)
    _write_certificate(ca_path(folder), certificate)
    return authority


def load_authority(folder: Path) -> Authority:
    """Read the authority of a folder.

    Raises:
        BadInputError: the folder has no readable authority.
    """
    path = ca_path(folder)
    try:
        certificate = x509.load_pem_x509_certificate(path.read_bytes())
        path = authority_key_path(folder)
        key = serialization.load_pem_private_key(path.read_bytes(), password=None)
    except OSError as error:
        raise BadInputError("DIR", str(path), f"a readable file ({error.strerror})") from error
    except (ValueError, TypeError, UnsupportedAlgorithm) as error:
        raise BadInputError("DIR", str(path), "a file of `laneweave certs init`") from error
    if not isinstance(key, ec.EllipticCurvePrivateKey) or (
        key.public_key() != certificate.public_key()
    ):
        raise BadInputError("DIR", str(path), f"the key of {ca_path(folder)}")
    return Authority(certificate, key)


def issue(
    authority: Authority,
    folder: Path,
    identity: Identity,
    *,
    days: float,
    hosts: Sequence[str] = (),
    separate: bool = False,
) -> None:
    """Create a certificate and its key, and write their files.

    If `folder` has a sub-folder with the identity's name, the files are written there, with the
    authority's certificate beside them.

    Args:
        authority: authority that signs the certificate.
        folder: folder for the files.
        identity: identity of the process.
        days: validity in days.
        hosts: names and addresses of the router; ignored for other processes.
        separate: whether to create the identity's sub-folder if it is missing.

    Raises:
        BadInputError: a certificate exists, or the files cannot be written.
    """
    name = identity.common_name
    if separate:
        _make_folder(folder / name)
    path = certificate_path(folder, name)
    if path.exists():
        raise BadInputError("IDENTITY", name, f"an identity without a certificate in {folder}")
    key = ec.generate_private_key(ec.SECP256R1())
    builder = _builder(_name(name), authority.certificate.subject, key.public_key(), days)
    # Only the router is a server.
    serves = identity.party is Party.ROUTER
    usage = ExtendedKeyUsageOID.SERVER_AUTH if serves else ExtendedKeyUsageOID.CLIENT_AUTH
    builder = (
        builder.add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_key_usage(signs_certificates=False), critical=True)
        .add_extension(x509.ExtendedKeyUsage([usage]), critical=False)
        .add_extension(
            x509.AuthorityKeyIdentifier.from_issuer_public_key(authority.key.public_key()),
            critical=False,
        )
    )
    if serves:
        builder = builder.add_extension(host_names((*hosts, *LOCAL_HOSTS)), critical=False)
    own = identity_folder(folder, name)
    if own != folder:
        _write_certificate(ca_path(own), authority.certificate)
    _write_key(key_path(folder, name), key)
    # Last: a certificate shows that all files of its identity exist.
    _write_certificate(path, builder.sign(authority.key, hashes.SHA256()))


def authority_key_path(folder: Path) -> Path:
    """Return the path of the authority key; roles do not need it."""
    return folder / "ca.key"


def _builder(
    subject: x509.Name, issuer: x509.Name, public_key: ec.EllipticCurvePublicKey, days: float
) -> x509.CertificateBuilder:
    now = dt.datetime.now(dt.UTC)
    end = now + dt.timedelta(days=days)
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(public_key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(min(now, end) - CLOCKS_APART)
        .not_valid_after(end)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(public_key), critical=False)
    )


def _name(common_name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)])


def _key_usage(*, signs_certificates: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs_certificates,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=signs_certificates,
        crl_sign=signs_certificates,
        encipher_only=False,
        decipher_only=False,
    )


def host_names(hosts: Sequence[str]) -> x509.SubjectAlternativeName:
    """Return the subject alternative name of a certificate for these hosts.

    Raises:
        BadInputError: a name is not a valid host name.
    """
    return x509.SubjectAlternativeName([_general_name(host) for host in dict.fromkeys(hosts)])


def _general_name(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        pass
    try:
        return x509.DNSName(host)
    except ValueError as error:
        raise BadInputError("--host", host, "a host's name or address") from error


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BadInputError("DIR", str(folder), f"a folder ({error.strerror})") from error


def _write_key(path: Path, key: ec.EllipticCurvePrivateKey) -> None:
    secret = key.private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption(),
    )
    _write(path, secret, 0o600)


def _write_certificate(path: Path, certificate: x509.Certificate) -> None:
    _write(path, certificate.public_bytes(serialization.Encoding.PEM), 0o644)


def _write(path: Path, content: bytes, mode: int) -> None:
    try:
        # An existing file may have other permissions.
        path.unlink(missing_ok=True)
        number = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
        with os.fdopen(number, "wb") as file:
            file.write(content)
    except OSError as error:
        raise BadInputError(
            "DIR", str(path.parent), f"a writable folder ({error.strerror})"
        ) from error
