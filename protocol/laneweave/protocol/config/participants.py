"""Names of all processes and vehicles of a deployment, derived from its scenario.

The bridge numbers vehicles in order of arrival. The launcher needs their names in advance to start
agents, and the router to grant rights.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator

from laneweave.protocol.scenario.deployment_fields import FleetMembers, parse_shard
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.wire.identities import Identity
from laneweave.protocol.wire.topics import Party


def vehicle_name(number: int) -> str:
    """Return the name of a vehicle, given its number in order of arrival, from 1."""
    return f"v{number:04d}"


def max_vehicles(scenario: Scenario) -> int:
    """Return an upper bound on the number of arriving vehicles.

    The number of arrivals varies less than a Poisson variable with the same mean, so it exceeds the
    mean by more than six standard deviations in fewer than one in 10^8 cases. In addition, each
    lane has at most one arrival per `demand.min_headway_s`.
    """
    demand = scenario.demand
    volumes = [inflow.volume_veh_per_h for inflow in scenario.flow.inflows.values()]
    lanes = len(volumes)
    mean = sum(volumes) * demand.duration_s / 3600.0
    likely = math.ceil(mean + 6.0 * math.sqrt(mean)) + 10
    if demand.min_headway_s <= 0.0:
        return likely
    return min(likely, lanes * math.floor(demand.duration_s / demand.min_headway_s + 1e-9))


def demanded_vehicles(scenario: Scenario) -> tuple[str, ...]:
    """Return the names of all vehicles that may arrive in a scenario."""
    return tuple(vehicle_name(number) for number in range(1, max_vehicles(scenario) + 1))


def members_of(members: FleetMembers, vehicles: Iterable[str]) -> tuple[str, ...]:
    """Return the vehicles of a fleet; a shard selects from `vehicles`."""
    if isinstance(members, str):
        shard = parse_shard(members, "security.fleets")
        return tuple(vehicle for vehicle in vehicles if shard.contains(vehicle))
    return members


def coordinator_names(scenario: Scenario) -> tuple[str, ...]:
    """Return the names of a scenario's coordinator candidates, highest-ranked first."""
    return tuple(f"c{index + 1}" for index in range(scenario.runtime.coordinators))


def identities_of(scenario: Scenario) -> Iterator[Identity]:
    """Yield all identities of a deployment: the named ones, and the vehicles of its demand."""
    yield from named_identities(scenario)
    if not scenario.security.vehicles:
        for name in demanded_vehicles(scenario):
            yield Identity(Party.VEHICLE, name)


def named_identities(scenario: Scenario) -> Iterator[Identity]:
    """Yield the identities that the deployment itself names."""
    security = scenario.security
    yield Identity(Party.ROUTER)
    yield Identity(Party.BRIDGE)
    for party, names in (
        (Party.COORDINATOR, coordinator_names(scenario)),
        (Party.FLEET, tuple(security.fleets)),
        (Party.CLIENT, security.clients),
        (Party.OPERATOR, security.operators),
        (Party.OBSERVER, security.observers),
        (Party.VEHICLE, security.vehicles),
    ):
        for name in names:
            yield Identity(party, name)
