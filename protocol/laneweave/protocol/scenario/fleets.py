"""Which vehicles there are, by name, and which of them a process drives.

The bridge names vehicles in the order in which they arrive. Who starts agents, and who grants
rights to them, has to know the names before.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

from laneweave.protocol.scenario.deployment import FleetMembers, parse_shard
from laneweave.protocol.scenario.tables import Demand, Scenario


def vehicle_name(number: int) -> str:
    """Return the name of a vehicle by its number in order of arrival, from 1."""
    return f"v{number:04d}"


def most_vehicles(demand: Demand, lanes: int) -> int:
    """Return how many vehicles at most arrive in a demand.

    Arrivals are random. A lane's number of them varies less than a Poisson variable of the same
    mean, so six standard deviations of one are exceeded in less than one of 10^8 demands; and
    there is never more than one in `demand.min_headway_s`.
    """
    mean = lanes * demand.volume_veh_per_lane_h * demand.duration_s / 3600.0
    likely = math.ceil(mean + 6.0 * math.sqrt(mean)) + 10
    if demand.min_headway_s <= 0.0:
        return likely
    return min(likely, lanes * math.floor(demand.duration_s / demand.min_headway_s + 1e-9))


def demanded_vehicles(scenario: Scenario) -> tuple[str, ...]:
    """Return the names of all vehicles that may arrive in a scenario."""
    count = most_vehicles(scenario.demand, scenario.road.lanes)
    return tuple(vehicle_name(number) for number in range(1, count + 1))


def members_of(members: FleetMembers, vehicles: Iterable[str]) -> tuple[str, ...]:
    """Return whom a fleet drives, of all `vehicles` where it is a shard."""
    if isinstance(members, str):
        shard = parse_shard(members, "security.fleets")
        return tuple(vehicle for vehicle in vehicles if shard.takes(vehicle))
    return members
