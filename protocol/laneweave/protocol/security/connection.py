"""Connection settings of a process, independent of scenarios.

`access_control` derives them from a scenario; `transports.zenoh` uses them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from attrs import field, frozen


@frozen
class Credentials:
    """Certificate, private key and trusted authority of a process: X.509 in PEM.

    All fields are paths, except `private_key_pem`, which is the key itself.
    """

    ca: str
    certificate: str
    private_key: str
    """Empty if `private_key_pem` is given."""
    private_key_pem: str = field(default="", repr=False)


@frozen
class Access:
    """Connection settings of a client."""

    endpoint: str
    """Zenoh endpoint of the router."""
    realm: str = "default"
    lease_s: float = 1.0
    """Duration of silence after which other processes consider this one lost."""
    credentials: Credentials | None = None
    """None: the network is not secured."""
    identity: str = ""
    """Common name of the process's certificate."""
    connect_timeout_s: float = 0.0
    """Time for which to retry connecting; 0: one attempt."""


@frozen
class RouterGuard:
    """Restrictions that a router enforces on a secured network."""

    credentials: Credentials
    host: str
    """Host at which clients reach the router; empty if unknown."""
    access_control: dict[str, Any]
    """Zenoh's `access_control`."""
    size_limits: list[dict[str, Any]]
    """Zenoh's `low_pass_filter`."""


def identity_folder(folder: Path, identity: str) -> Path:
    """Return the folder of an identity's files: its sub-folder if there is one, else `folder`."""
    own = folder / identity
    try:
        return own if own.is_dir() else folder
    except OSError:  # not readable
        return folder


def ca_path(folder: Path) -> Path:
    """Return the path of the authority's certificate."""
    return folder / "ca.pem"


def certificate_path(folder: Path, identity: str) -> Path:
    """Return the path of an identity's certificate."""
    return identity_folder(folder, identity) / f"{identity}.pem"


def key_path(folder: Path, identity: str) -> Path:
    """Return the path of an identity's private key."""
    return identity_folder(folder, identity) / f"{identity}.key"
