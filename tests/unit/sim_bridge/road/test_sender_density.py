"""Density of senders around vehicles."""

from __future__ import annotations

import pytest

from laneweave.protocol.wire.messages import Sense
from laneweave.sim_bridge.bodies.plant import Plant
from laneweave.sim_bridge.road.sender_density import measure_density
from laneweave.sim_bridge.road.vehicle import RoadVehicle
from support.paper import PAPER
from support.road_vehicles import vehicle_in
from support.states import sent


def vehicles_at(*positions_m: float) -> list[RoadVehicle]:
    vehicles = []
    for position_m in positions_m:
        vehicle = vehicle_in((0, 1), f"v{position_m:g}")
        state = (position_m, *vehicle.state[1:])
        vehicle.controller.plant = Plant(state, PAPER.vehicle, PAPER.runtime.tick_s)
        vehicles.append(vehicle)
    return vehicles


def test_vehicles_within_half_a_kilometre_count() -> None:
    vehicles = vehicles_at(1500.0, 1000.0, 1400.0, 2000.0, 2000.5)
    measure_density(vehicles, 4000.0)
    assert [one.senders_per_km for one in vehicles] == [4.0, 3.0, 3.0, 3.0, 2.0]


@pytest.mark.parametrize(("at_m", "per_km"), [(0.0, 4.0), (100.0, 2.0 / 0.6), (1000.0, 4.0)])
def test_the_road_is_thought_to_continue(at_m: float, per_km: float) -> None:
    vehicles = vehicles_at(at_m, abs(at_m - 400.0))
    measure_density(vehicles, 1000.0)
    assert vehicles[0].senders_per_km == pytest.approx(per_km)


def test_a_vehicle_learns_of_it_by_sense() -> None:
    (vehicle,) = vehicles_at(200.0)
    measure_density([vehicle], 1000.0)
    (sense,) = sent(vehicle.send_sense(0), Sense)
    assert sense.senders_per_km == pytest.approx(1.0 / 0.7)
