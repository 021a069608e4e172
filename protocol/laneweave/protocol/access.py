"""How a process gets onto the network: where, in which realm, and as whom."""

from __future__ import annotations

from attrs import frozen

from laneweave.protocol.scenario import Scenario


@frozen
class Credentials:
    """What a process shows of itself, and by what it knows the others: X.509, in PEM.

    Each is the path of a file, except `private_key_pem`, which is the key's text itself.
    """

    ca: str
    certificate: str
    private_key: str
    private_key_pem: str = ""


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


def access_of(scenario: Scenario, identity: str) -> Access:
    """Return how a process gets onto the network of a deployment.

    Args:
        scenario: the deployment.
        identity: the process's name in its certificate, such as `coordinator.c1`.
    """
    del identity  # every network is open so far
    network = scenario.network
    return Access(network.endpoint, network.realm, network.lease_s)
