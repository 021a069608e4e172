"""Are a process's certificate, key and authority in order? Asked before it uses them.

The answer comes from a TLS handshake of the process with itself, in memory: what OpenSSL accepts
there, and Zenoh's library beyond, is what the others are going to accept. So it takes nothing but
the standard library, and what is wrong is one line instead of a connection that does not come up.
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
from laneweave.protocol.security.access import Credentials
from laneweave.protocol.wire.topics import Party

log = structlog.get_logger(__name__)

SOON_S = 7 * 86400.0
"""Certificates that end so soon are warned of."""
_EXPIRED, _NOT_YET = 10, 9
"""OpenSSL's numbers for a certificate out of its time."""


@frozen
class Findings:
    """What was found about credentials that are in order."""

    valid_until_s: float
    """Unix time at which the certificate ends."""
    warnings: tuple[str, ...]
    """One line each."""


def check_credentials(credentials: Credentials, identity: str, host: str = "") -> Findings:
    """Check credentials as far as can be done without the network, and log the warnings.

    Args:
        credentials: of this process.
        identity: whom they must be of.
        host: under which clients look for this process; a router's certificate must be valid for
            it. Empty, or for any other identity: not looked at.

    Raises:
        BadInputError: names the file, and what is wrong with it.
    """
    found = examine(credentials, identity, host)
    for warning in found.warnings:
        _warn(identity, warning)
    return found


@cache
def _warn(identity: str, warning: str) -> None:
    """Log a warning once, however often somebody tries to connect."""
    log.warning("certificate", identity=identity, warning=warning)


def examine(credentials: Credentials, identity: str, host: str = "") -> Findings:
    """Check as `check_credentials` does, without a log.

    Raises:
        BadInputError: names the file, and what is wrong with it.
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
        # Whoever judges is the server of the handshake, and has to show something.
        _load_own(judging, credentials)
        showing.check_hostname = False
        showing.verify_mode = ssl.CERT_NONE
    shown = _handshake(showing, judging, credentials, host)
    names = [value for part in shown["subject"] for key, value in part if key == "commonName"]
    if names != [identity]:
        raise BadInputError(
            "certificate",
            credentials.certificate,
            f"a certificate of {identity}, this one is of {', '.join(names) or 'nobody'}",
        )
    until_s = float(ssl.cert_time_to_seconds(shown["notAfter"]))
    return Findings(until_s, tuple(_warnings(credentials, until_s)))


def _check_readable(name: str, path: str) -> None:
    try:
        text = Path(path).read_bytes()
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise BadInputError(name, path, f"a file that can be read ({reason})") from error
    if b"-----BEGIN " not in text:
        raise BadInputError(name, path, "a file in PEM")


def _load_own(context: ssl.SSLContext, credentials: Credentials) -> None:
    """Have a context show the process's certificate."""
    with _key_file(credentials) as key:
        try:
            # An encrypted key is refused, not asked for at the terminal.
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
    """Give the private key as a file, which is none on a disk if it came as text."""
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
    """Let one side show its certificate to the other; return what that one saw.

    Raises:
        BadInputError: it refused what it saw.
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
        # Each side needs to be heard three times at most.
        for _ in range(4):
            for side in tuple(waiting):
                with contextlib.suppress(ssl.SSLWantReadError):
                    side.do_handshake()
                    waiting.remove(side)
    except ssl.SSLCertVerificationError as error:
        raise _refusal(error, credentials, host) from error
    except ssl.SSLError as error:
        raise BadInputError(
            "certificate", credentials.certificate, f"one that TLS takes ({error.reason})"
        ) from error
    shown: dict[str, Any] = judge.getpeercert() or {}
    return shown


def _refusal(
    error: ssl.SSLCertVerificationError, credentials: Credentials, host: str
) -> BadInputError:
    code, words = error.verify_code, error.verify_message
    if code == _EXPIRED:
        allowed = "one that is still valid, this one, or its authority's, has expired"
    elif code == _NOT_YET:
        allowed = "one that is valid already, this one, or its authority's, is not yet"
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
            yield f"{credentials.private_key} may be read by others: chmod 600"
