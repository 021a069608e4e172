"""Checks of a process's certificate, key and authority before it uses them.

The check is a TLS handshake of the process with itself, in memory, by the standard library: what
OpenSSL accepts here, its peers accept as well. A fault is reported in one line instead of as a
connection that cannot be established.
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

SOON_S = 7 * 86400.0
"""Certificates that expire within this time cause a warning."""
_EXPIRED, _NOT_YET = 10, 9
"""OpenSSL's codes for a certificate outside its validity period."""


@frozen
class Findings:
    """Properties of valid credentials."""

    valid_until_s: float
    """Unix time at which the certificate expires."""
    warnings: tuple[str, ...]
    """One line each."""


def check_credentials(credentials: Credentials, identity: str, host: str = "") -> Findings:
    """Check credentials as far as possible without the network, and log the warnings.

    Raises:
        BadInputError: see `examine`.
    """
    found = examine(credentials, identity, host)
    for warning in found.warnings:
        _warn(identity, warning)
    return found


@cache
def _warn(identity: str, warning: str) -> None:
    """Log a warning once, however often the process tries to connect."""
    log.warning("certificate", identity=identity, warning=warning)


def examine(credentials: Credentials, identity: str, host: str = "") -> Findings:
    """Check credentials as far as possible without the network.

    Args:
        credentials: those of a process.
        identity: common name that the certificate must have.
        host: host at which clients reach a router, for which its certificate must be valid; empty:
            not checked. Ignored for other identities.

    Raises:
        BadInputError: names the file and what is wrong with it.
    """
    is_router = identity == Party.ROUTER
    _check_readable("certificate authority", credentials.ca)
    _check_readable("certificate", credentials.certificate)
    if not credentials.private_key_pem:
        _check_readable("private key", credentials.private_key)
    showing = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER if is_router else ssl.PROTOCOL_TLS_CLIENT)
    _load_own(showing, credentials)
    judging = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT if is_router else ssl.PROTOCOL_TLS_SERVER)
    judging.check_hostname = is_router and bool(host)
    judging.verify_mode = ssl.CERT_REQUIRED
    try:
        judging.load_verify_locations(credentials.ca)
    except ssl.SSLError as error:
        raise BadInputError(
            "certificate authority", credentials.ca, "a certificate in PEM"
        ) from error
    if not is_router:
        # The judging side is the server of this handshake and needs a certificate, too.
        _load_own(judging, credentials)
        showing.check_hostname = False
        showing.verify_mode = ssl.CERT_NONE
    shown = _handshake(showing, judging, credentials, host)
    names = [value for part in shown["subject"] for key, value in part if key == "commonName"]
    if names != [identity]:
        raise BadInputError(
            "certificate",
            credentials.certificate,
            f"a certificate of {identity}; this one is of {', '.join(names) or 'no name'}",
        )
    until_s = float(ssl.cert_time_to_seconds(shown["notAfter"]))
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
            # Refuse an encrypted key instead of asking for a password at the terminal.
            context.load_cert_chain(credentials.certificate, key, password=lambda: "")
        except ssl.SSLError as error:
            if error.reason == "KEY_VALUES_MISMATCH":
                name, allowed = "private key", f"the key of {credentials.certificate}"
            else:
                name, allowed = "certificate", "a certificate and its key, in PEM, not encrypted"
            key_name = credentials.private_key or "of the environment"
            at_fault = credentials.certificate if name == "certificate" else key_name
            raise BadInputError(name, at_fault, allowed) from error


@contextlib.contextmanager
def _key_file(credentials: Credentials) -> Iterator[str]:
    """Yield a path of the private key; one that came as text stays in memory."""
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
    showing: ssl.SSLContext, judging: ssl.SSLContext, credentials: Credentials, host: str
) -> dict[str, Any]:
    """Shake hands between two contexts; return the certificate that the judging side received.

    Raises:
        BadInputError: it refused the certificate.
    """
    there, back = ssl.MemoryBIO(), ssl.MemoryBIO()
    router_shows = judging.protocol == ssl.PROTOCOL_TLS_CLIENT
    judge = judging.wrap_bio(
        there,
        back,
        server_side=not router_shows,
        server_hostname=host or None if router_shows else None,
    )
    shower = showing.wrap_bio(back, there, server_side=router_shows)
    waiting = [judge, shower]
    try:
        # Each side takes at most three turns.
        for _ in range(4):
            for side in tuple(waiting):
                with contextlib.suppress(ssl.SSLWantReadError):
                    side.do_handshake()
                    waiting.remove(side)
    except ssl.SSLCertVerificationError as error:
        raise _refusal(error, credentials, host) from error
    except ssl.SSLError as error:
        raise BadInputError(
            "certificate", credentials.certificate, f"one that TLS accepts ({error.reason})"
        ) from error
    shown: dict[str, Any] = judge.getpeercert() or {}
    return shown


def _refusal(
    error: ssl.SSLCertVerificationError, credentials: Credentials, host: str
) -> BadInputError:
    code, words = error.verify_code, error.verify_message
    if code == _EXPIRED:
        allowed = "one that is still valid; this one, or its authority's, has expired"
    elif code == _NOT_YET:
        allowed = "one that is already valid; this one, or its authority's, is not yet"
    elif "match" in words:
        allowed = f"one that is valid for {host}, where clients look for the router"
    else:
        allowed = f"one for this purpose that the authority {credentials.ca} has signed ({words})"
    return BadInputError("certificate", credentials.certificate, allowed)


def _warnings(credentials: Credentials, until_s: float) -> Iterator[str]:
    left_s = until_s - time.time()
    if left_s < SOON_S:
        yield f"{credentials.certificate} expires in {left_s / 86400.0:.1f} days"
    if not credentials.private_key_pem:
        mode = Path(credentials.private_key).stat().st_mode
        if mode & (stat.S_IRWXG | stat.S_IRWXO):
            yield f"{credentials.private_key} is readable by other users: chmod 600"
