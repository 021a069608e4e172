"""Checks of a process's certificate, key and authority before they are used.

The process performs a TLS handshake with itself in memory: peers accept what OpenSSL accepts here.
An error is reported in one line instead of as a failed connection.
"""

from __future__ import annotations

import contextlib
import os
import ssl
import stat
import time
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import structlog
from attrs import frozen

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.security.connection import Credentials
from laneweave.protocol.wire.topics import Party

log = structlog.get_logger(__name__)

EXPIRY_WARNING_S = 7 * 86400.0
"""Remaining validity of a certificate below which a warning is logged."""
_EXPIRED, _NOT_YET = 10, 9
"""OpenSSL's error codes for certificates outside their validity period."""


@frozen
class Findings:
    """Properties of valid credentials."""

    valid_until_s: float
    """Expiry of the certificate (Unix time)."""
    warnings: tuple[str, ...]
    """One-line warnings."""


def check_credentials(credentials: Credentials, identity: str, host: str = "") -> Findings:
    """Check credentials offline, and log warnings.

    Raises:
        BadInputError: see `examine`.
    """
    found = examine(credentials, identity, host)
    for warning in found.warnings:
        _warn(identity, warning)
    return found


@cache
def _warn(identity: str, warning: str) -> None:
    """Log a warning only once, even over several attempts to connect."""
    log.warning("certificate", identity=identity, warning=warning)


def examine(credentials: Credentials, identity: str, host: str = "") -> Findings:
    """Check credentials offline.

    Args:
        credentials: credentials of a process.
        identity: required common name of the certificate.
        host: host for which a router's certificate must be valid; empty: not checked. Ignored for
            other identities.

    Raises:
        BadInputError: a file is invalid; the message names the file and the reason.
    """
    is_router = identity == Party.ROUTER
    _check_readable("certificate authority", credentials.ca)
    _check_readable("certificate", credentials.certificate)
    if not credentials.private_key_pem:
        _check_readable("private key", credentials.private_key)
    presenter = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER if is_router else ssl.PROTOCOL_TLS_CLIENT)
    _load_own(presenter, credentials)
    verifier = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT if is_router else ssl.PROTOCOL_TLS_SERVER)
    verifier.check_hostname = is_router and bool(host)
    verifier.verify_mode = ssl.CERT_REQUIRED
    try:
        verifier.load_verify_locations(credentials.ca)
    except ssl.SSLError as error:
        raise BadInputError(
            "certificate authority", credentials.ca, "a certificate in PEM"
        ) from error
    if not is_router:
        # The verifier is the server of this handshake and needs a certificate, too.
        _load_own(verifier, credentials)
        presenter.check_hostname = False
        presenter.verify_mode = ssl.CERT_NONE
    presented = _handshake(presenter, verifier, credentials, host)
    names = [value for part in presented["subject"] for key, value in part if key == "commonName"]
    if names != [identity]:
        raise BadInputError(
            "certificate",
            credentials.certificate,
            f"a certificate for {identity}; this one is for {', '.join(names) or 'no name'}",
        )
    until_s = float(ssl.cert_time_to_seconds(presented["notAfter"]))
    return Findings(until_s, tuple(_warnings(credentials, until_s)))


def _check_readable(name: str, path: str) -> None:
    try:
        text = Path(path).read_bytes()
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise BadInputError(name, path, f"a readable file ({reason})") from error
    if b"-----BEGIN " not in text:
        raise BadInputError(name, path, "a file in PEM")


def _load_own(context: ssl.SSLContext, credentials: Credentials) -> None:
    """Load the process's certificate and key into a context."""
    with _key_file(credentials) as key:
        try:
            # Reject an encrypted key instead of requesting its password at the terminal.
            context.load_cert_chain(credentials.certificate, key, password=lambda: "")
        except ssl.SSLError as error:
            if error.reason == "KEY_VALUES_MISMATCH":
                name, allowed = "private key", f"the key of {credentials.certificate}"
            else:
                name, allowed = "certificate", "a certificate and its key, in PEM, not encrypted"
            key_name = credentials.private_key or "of the environment"
            invalid = credentials.certificate if name == "certificate" else key_name
            raise BadInputError(name, invalid, allowed) from error


@contextlib.contextmanager
def _key_file(credentials: Credentials) -> Iterator[str]:
    """Yield a path to the private key; a key given as text stays in memory."""
    if not credentials.private_key_pem:
        yield credentials.private_key
        return
    number = os.memfd_create("key")
    try:
        os.write(number, credentials.private_key_pem.encode())
        yield f"/proc/self/fd/{number}"
    finally:
        os.close(number)


def _handshake(
    presenter: ssl.SSLContext, verifier: ssl.SSLContext, credentials: Credentials, host: str
) -> dict[str, Any]:
    """Perform a handshake between two contexts; return the certificate that the verifier received.

    Raises:
        BadInputError: the verifier rejected the certificate.
    """
    there, back = ssl.MemoryBIO(), ssl.MemoryBIO()
    router_presents = verifier.protocol == ssl.PROTOCOL_TLS_CLIENT
    verifying_side = verifier.wrap_bio(
        there,
        back,
        server_side=not router_presents,
        server_hostname=host or None if router_presents else None,
    )
    presenting_side = presenter.wrap_bio(back, there, server_side=router_presents)
    pending = [verifying_side, presenting_side]
    try:
        # Each side takes at most three turns.
        for _ in range(4):
            for side in tuple(pending):
                with contextlib.suppress(ssl.SSLWantReadError):
                    side.do_handshake()
                    pending.remove(side)
    except ssl.SSLCertVerificationError as error:
        raise _refusal(error, credentials, host) from error
    except ssl.SSLError as error:
        raise BadInputError(
            "certificate", credentials.certificate, f"one that TLS accepts ({error.reason})"
        ) from error
    presented: dict[str, Any] = verifying_side.getpeercert() or {}
    return presented


def _refusal(
    error: ssl.SSLCertVerificationError, credentials: Credentials, host: str
) -> BadInputError:
    code, words = error.verify_code, error.verify_message
    if code == _EXPIRED:
        allowed = "one that is still valid; this one, or its authority's, has expired"
    elif code == _NOT_YET:
        allowed = "one that is already valid; this one, or its authority's, is not yet"
    elif "match" in words:
        allowed = f"one that is valid for {host}, where clients connect to the router"
    else:
        allowed = f"one for this purpose that the authority {credentials.ca} has signed ({words})"
    return BadInputError("certificate", credentials.certificate, allowed)


def _warnings(credentials: Credentials, until_s: float) -> Iterator[str]:
    left_s = until_s - time.time()
    if left_s < EXPIRY_WARNING_S:
        yield f"{credentials.certificate} expires in {left_s / 86400.0:.1f} days"
    if not credentials.private_key_pem:
        mode = Path(credentials.private_key).stat().st_mode
        if mode & (stat.S_IRWXG | stat.S_IRWXO):
            yield f"{credentials.private_key} is readable by other users: chmod 600"
