"""The vehicles that an agent process drives, and its identity."""

from __future__ import annotations

import pytest

from laneweave.launch.deploy.assigned_vehicles import AssignedVehicles, assigned_vehicles
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.scenario.deployment_fields import Security, Shard
from support.tables import for_each

FLEETS: dict[str, str | tuple[str, ...]] = {"even": "0/2", "odd": "1/2", "two": ("a", "b")}
OPEN, SECURED = Security(fleets=FLEETS), Security(mode="mtls", fleets=FLEETS)


@for_each("security", [OPEN, SECURED])
@for_each(
    ("vehicles", "shard", "fleet", "expected"),
    [
        ((), None, "odd", AssignedVehicles("fleet.odd", (), Shard(1, 2))),
        ((), None, "two", AssignedVehicles("fleet.two", ("a", "b"), None)),
        (("b",), None, "two", AssignedVehicles("fleet.two", ("b",), None)),
        ((), "0/2", None, AssignedVehicles("fleet.even", (), Shard(0, 2))),
        (("a",), None, None, AssignedVehicles("vehicle.a", ("a",), None)),
    ],
)
def test_fleets(
    security: Security,
    vehicles: tuple[str, ...],
    shard: str | None,
    fleet: str | None,
    expected: AssignedVehicles,
) -> None:
    assert assigned_vehicles(security, vehicles, shard, fleet) == expected


def test_an_open_deployment_needs_no_fleets() -> None:
    assert assigned_vehicles(Security(), (), None, None).shard == Shard(0, 1)
    assert assigned_vehicles(Security(), (), "2/3", None).shard == Shard(2, 3)
    assert assigned_vehicles(Security(), ["a", "b"], None, None).vehicles == ("a", "b")


@for_each(
    ("security", "vehicles", "shard", "fleet", "field"),
    [
        (SECURED, (), None, None, "--shard"),
        (SECURED, (), "1/3", None, "--shard"),
        (SECURED, ("a", "b"), None, None, "VEHICLE"),
        (OPEN, ("a/b",), None, None, "VEHICLE"),
        (OPEN, ("c",), None, "two", "VEHICLE"),
        (OPEN, (), "0/2", "even", "--shard"),
        (OPEN, (), None, "three", "--fleet"),
        (OPEN, (), "3/2", None, "--shard"),
    ],
)
def test_contradictions_are_refused(
    security: Security, vehicles: tuple[str, ...], shard: str | None, fleet: str | None, field: str
) -> None:
    with pytest.raises(BadInputError) as caught:
        assigned_vehicles(security, vehicles, shard, fleet)
    assert caught.value.field == field


def test_a_vehicle_of_another_shard_is_refused() -> None:
    vehicles = [f"v{number}" for number in range(20)]
    even = [vehicle for vehicle in vehicles if Shard(0, 2).contains(vehicle)]
    assert assigned_vehicles(SECURED, even, None, "even").vehicles == tuple(even)
    with pytest.raises(BadInputError, match="a vehicle of the fleet even"):
        assigned_vehicles(SECURED, vehicles, None, "even")
