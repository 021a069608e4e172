"""Vehicles and identity of an agent process, from the command line."""

from __future__ import annotations

from collections.abc import Sequence

from attrs import frozen

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.names import NAME_PATTERN, NAME_RULE
from laneweave.protocol.scenario.deployment_fields import FleetMembers, Security, Shard, parse_shard
from laneweave.protocol.wire.identities import Identity
from laneweave.protocol.wire.topics import Party

ALL_VEHICLES = "0/1"


@frozen
class AssignedVehicles:
    """Vehicles and identity of an agent process."""

    identity: str
    """Identity of the process."""
    vehicles: tuple[str, ...]
    """Names of the vehicles; empty: the announced vehicles of the shard."""
    shard: Shard | None


def assigned_vehicles(
    security: Security, vehicles: Sequence[str], shard: str | None, fleet: str | None
) -> AssignedVehicles:
    """Return the vehicles and identity of an agent process from its command-line arguments.

    Raises:
        BadInputError: arguments contradict each other, or a secured deployment lacks the fleet.
    """
    for vehicle in vehicles:
        if not NAME_PATTERN.fullmatch(vehicle):
            raise BadInputError("VEHICLE", vehicle, NAME_RULE)
    if fleet is not None:
        return _of_fleet(security, vehicles, shard, fleet)
    if vehicles:
        if len(vehicles) > 1 and security.mode != "off":
            raise BadInputError(
                "VEHICLE",
                list(vehicles),
                "one vehicle, or several with --fleet, because security.mode is mtls",
            )
        identity = Identity(Party.VEHICLE, vehicles[0])
        return AssignedVehicles(identity.common_name, tuple(vehicles), None)
    taken = parse_shard(shard or ALL_VEHICLES, "--shard")
    return AssignedVehicles(_fleet(_fleet_of_shard(security, taken)), (), taken)


def _of_fleet(
    security: Security, vehicles: Sequence[str], shard: str | None, fleet: str
) -> AssignedVehicles:
    if shard is not None:
        raise BadInputError("--shard", shard, "only without --fleet")
    members = security.fleets.get(fleet)
    if members is None:
        known = ", ".join(security.fleets) or "none"
        raise BadInputError("--fleet", fleet, f"one of security.fleets: {known}")
    taken = _shard(members)
    for vehicle in vehicles:
        if not (taken.contains(vehicle) if taken is not None else vehicle in members):
            raise BadInputError("VEHICLE", vehicle, f"a vehicle of the fleet {fleet}")
    if vehicles:
        return AssignedVehicles(_fleet(fleet), tuple(vehicles), None)
    return AssignedVehicles(_fleet(fleet), () if isinstance(members, str) else members, taken)


def _fleet_of_shard(security: Security, shard: Shard) -> str:
    """Return the name of the fleet defined as a shard; without security, any name."""
    for name, members in security.fleets.items():
        if _shard(members) == shard:
            return name
    text = f"{shard.index}/{shard.count}"
    if security.mode != "off":
        raise BadInputError(
            "--shard", text, "a shard of security.fleets, because security.mode is mtls"
        )
    return shard.name


def _shard(members: FleetMembers) -> Shard | None:
    return parse_shard(members, "security.fleets") if isinstance(members, str) else None


def _fleet(name: str) -> str:
    return Identity(Party.FLEET, name).common_name
