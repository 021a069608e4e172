"""How a process gets onto the network: where, in which realm, and as whom."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

from attrs import field, frozen

from laneweave.protocol.config.identities import identities_of, parse_identity
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.scenario.tables import Scenario

CA_FILE = "LANEWEAVE_CA_FILE"
CERTIFICATE_FILE = "LANEWEAVE_CERTIFICATE_FILE"
PRIVATE_KEY_FILE = "LANEWEAVE_PRIVATE_KEY_FILE"
PRIVATE_KEY = "LANEWEAVE_PRIVATE_KEY"
"""Environment variables that go before the files in `security.folder`."""
KNOWN_RULE = (
    "somebody whom this configuration knows: runtime.coordinators, security.fleets, "
    "security.vehicles, security.clients, security.observers"
)
"""Whoever else comes gets a session and may do nothing in it, without a word from anybody."""


@frozen
class Credentials:
    """What a process shows of itself, and by what it knows the others: X.509, in PEM.

    Each is the path of a file, except `private_key_pem`, which is the key's text itself.
    """

    ca: str
    certificate: str
    private_key: str
    """Empty where `private_key_pem` is given."""
    private_key_pem: str = field(default="", repr=False)


@frozen
class Access:
    """How a process gets onto the network."""

    endpoint: str
    """Zenoh endpoint of the router."""
    realm: str = "default"
    lease_s: float = 1.0
    """After this time of silence the others give this process up."""
    credentials: Credentials | None = None
    """None: the network is not secured."""
    identity: str = ""
    """The process's name in its certificate."""
    connect_timeout_s: float = 0.0
    """How long a role tries to connect; 0: once."""


def access_of(
    scenario: Scenario, identity: str, environment: Mapping[str, str] = os.environ
) -> Access:
    """Return how a process gets onto the network of a deployment.

    Args:
        scenario: the deployment.
        identity: the process's name in its certificate, such as `coordinator.c1`.
        environment: where secrets may be.

    Raises:
        BadInputError: the identity is none, or the environment contradicts itself.
    """
    network = scenario.network
    return Access(
        network.endpoint,
        network.realm,
        network.lease_s,
        credentials_of(scenario, identity, environment),
        identity,
        network.connect_timeout_s,
    )


def credentials_of(
    scenario: Scenario, identity: str, environment: Mapping[str, str] = os.environ
) -> Credentials | None:
    """Return what a process shows of itself; None where the network is not secured.

    Raises:
        BadInputError: the identity is none, or the environment contradicts itself.
    """
    if scenario.security.mode == "off":
        return None
    known = parse_identity(identity)
    if known not in set(identities_of(scenario)):
        raise BadInputError("identity", identity, KNOWN_RULE)
    name = known.common_name
    folder = Path(scenario.security.folder)
    key_pem, key_file = environment.get(PRIVATE_KEY, ""), environment.get(PRIVATE_KEY_FILE, "")
    if key_pem and key_file:
        raise BadInputError(PRIVATE_KEY_FILE, key_file, f"nothing, as {PRIVATE_KEY} is set")
    return Credentials(
        ca=environment.get(CA_FILE) or str(ca_path(folder)),
        certificate=environment.get(CERTIFICATE_FILE) or str(certificate_path(folder, name)),
        private_key="" if key_pem else key_file or str(key_path(folder, name)),
        private_key_pem=key_pem,
    )


def ca_path(folder: Path) -> Path:
    """Return where a folder of certificates has that of its authority."""
    return folder / "ca.pem"


def certificate_path(folder: Path, identity: str) -> Path:
    """Return where it has an identity's certificate."""
    return folder / f"{identity}.pem"


def key_path(folder: Path, identity: str) -> Path:
    """Return where it has an identity's private key."""
    return folder / f"{identity}.key"
