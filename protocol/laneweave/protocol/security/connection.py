"""What a process needs to join the network: plain values, without knowledge of scenarios.

`rights` derives them from a scenario; `transports.zenoh` uses them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from attrs import field, frozen


@frozen
class Credentials:
    """Certificate and private key of a process, and the authority that it trusts: X.509 in PEM.

    Each is the path of a file, except `private_key_pem`, which is the text of the key.
    """

    ca: str
    certificate: str
    private_key: str
    """Empty if `private_key_pem` is given."""
    private_key_pem: str = field(default="", repr=False)


@frozen
class Access:
    """How a client joins the network."""

    endpoint: str
    """Zenoh endpoint of the router."""
    realm: str = "default"
    lease_s: float = 1.0
    """The others give this process up after this time of silence."""
    credentials: Credentials | None = None
    """None: the network is not secured."""
    identity: str = ""
    """Common name of the process's certificate."""
    connect_timeout_s: float = 0.0
    """How long to try to connect; 0: once."""


@frozen
class RouterGuard:
    """What a router enforces on a secured network."""

    credentials: Credentials
    host: str
    """Host at which clients reach the router; empty if the configuration does not say."""
    access_control: dict[str, Any]
    """Zenoh's setting of this name."""
    size_limits: list[dict[str, Any]]
    """Zenoh's `low_pass_filter`."""


def ca_path(folder: Path) -> Path:
    """Return the path of the authority's certificate in a folder of certificates."""
    return folder / "ca.pem"


def certificate_path(folder: Path, identity: str) -> Path:
    """Return the path of an identity's certificate."""
    return folder / f"{identity}.pem"


def key_path(folder: Path, identity: str) -> Path:
    """Return the path of an identity's private key."""
    return folder / f"{identity}.key"
