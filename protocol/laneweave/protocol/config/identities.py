"""Who takes part in a deployment: the names that processes bear in their certificates.

    router  bridge  coordinator.NAME  vehicle.NAME  fleet.NAME  client.NAME  observer.NAME

A certificate's common name is its owner's identity, and the router grants rights by it
(`rights.py`).
"""

from __future__ import annotations

from collections.abc import Iterator
from enum import StrEnum

from attrs import frozen

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.scenario.fleets import demanded_vehicles
from laneweave.protocol.scenario.tables import Scenario
from laneweave.protocol.wire.topics import NAME_PATTERN

LONGEST_COMMON_NAME = 64
"""Characters, by X.520."""
IDENTITY_RULE = (
    "router, bridge, or coordinator, vehicle, fleet, client or observer with a dot and a name, "
    f"at most {LONGEST_COMMON_NAME} characters"
)


class Party(StrEnum):
    """Kinds of processes, by what they may do."""

    ROUTER = "router"
    """Carries everything."""
    BRIDGE = "bridge"
    """The simulated world."""
    COORDINATOR = "coordinator"
    """A candidate; it serves plan requests, too."""
    VEHICLE = "vehicle"
    """An agent process of one vehicle."""
    FLEET = "fleet"
    """An agent process of several vehicles, which it may take from the census."""
    CLIENT = "client"
    """Asks the planning service."""
    OBSERVER = "observer"
    """Looks on."""


_ONE_OF_A_KIND = (Party.ROUTER, Party.BRIDGE)


@frozen
class Identity:
    """One process's identity."""

    party: Party
    name: str = ""
    """Empty for the router and the bridge."""

    @property
    def common_name(self) -> str:
        """How it is written in a certificate."""
        return f"{self.party}.{self.name}" if self.name else str(self.party)


def parse_identity(text: str, field: str = "identity") -> Identity:
    """Return an identity from its common name.

    Raises:
        BadInputError: it is none.
    """
    kind, dot, name = text.partition(".")
    if len(text) <= LONGEST_COMMON_NAME and kind in list(Party):
        party = Party(kind)
        alone = party in _ONE_OF_A_KIND
        if not dot if alone else NAME_PATTERN.fullmatch(name):
            return Identity(party, name)
    raise BadInputError(field, text, IDENTITY_RULE)


def coordinator_names(scenario: Scenario) -> tuple[str, ...]:
    """Return the names of a scenario's coordinator candidates, best-ranked first."""
    return tuple(f"c{index + 1}" for index in range(scenario.runtime.coordinators))


def single_vehicles(scenario: Scenario) -> tuple[str, ...]:
    """Return the vehicles that may have a process of their own."""
    return scenario.security.vehicles or demanded_vehicles(scenario)


def identities_of(scenario: Scenario) -> Iterator[Identity]:
    """Yield all identities that a deployment knows."""
    security = scenario.security
    yield Identity(Party.ROUTER)
    yield Identity(Party.BRIDGE)
    for party, names in (
        (Party.COORDINATOR, coordinator_names(scenario)),
        (Party.FLEET, tuple(security.fleets)),
        (Party.CLIENT, security.clients),
        (Party.OBSERVER, security.observers),
        (Party.VEHICLE, single_vehicles(scenario)),
    ):
        for name in names:
            yield Identity(party, name)
