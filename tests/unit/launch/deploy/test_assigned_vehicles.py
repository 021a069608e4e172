"""Whom an agent process drives, and as whom."""

from __future__ import annotations

import pytest

from laneweave.launch.deploy.assigned_vehicles import Crew, crew_of
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.scenario.deployment import Security, Shard

FLEETS: dict[str, str | tuple[str, ...]] = {"even": "0/2", "odd": "1/2", "two": ("a", "b")}
OPEN, SECURED = Security(fleets=FLEETS), Security(mode="mtls", fleets=FLEETS)


@pytest.mark.parametrize("security", [OPEN, SECURED])
def test_fleets(security: Security) -> None:
    assert crew_of(security, (), None, "odd") == Crew("fleet.odd", (), Shard(1, 2))
    assert crew_of(security, (), None, "two") == Crew("fleet.two", ("a", "b"), None)
    assert crew_of(security, ["b"], None, "two") == Crew("fleet.two", ("b",), None)
    assert crew_of(security, (), "0/2", None) == Crew("fleet.even", (), Shard(0, 2))
    assert crew_of(security, ["a"], None, None) == Crew("vehicle.a", ("a",), None)


def test_an_open_deployment_needs_no_fleets() -> None:
    assert crew_of(Security(), (), None, None).shard == Shard(0, 1)
    assert crew_of(Security(), (), "2/3", None).shard == Shard(2, 3)
    assert crew_of(Security(), ["a", "b"], None, None).vehicles == ("a", "b")


@pytest.mark.parametrize(
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
def test_what_does_not_fit(
    security: Security, vehicles: tuple[str, ...], shard: str | None, fleet: str | None, field: str
) -> None:
    with pytest.raises(BadInputError) as caught:
        crew_of(security, vehicles, shard, fleet)
    assert caught.value.field == field


def test_a_vehicle_of_another_shard_is_not_of_the_fleet() -> None:
    vehicles = [f"v{number}" for number in range(20)]
    even = [vehicle for vehicle in vehicles if Shard(0, 2).takes(vehicle)]
    assert crew_of(SECURED, even, None, "even").vehicles == tuple(even)
    with pytest.raises(BadInputError, match="a vehicle of the fleet even"):
        crew_of(SECURED, vehicles, None, "even")
