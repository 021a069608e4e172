"""Density of the vehicles that send around each vehicle, which is the load of its radio channel."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Collection

from laneweave.sim_bridge.road.vehicle import RoadVehicle

RADIUS_M = 500.0
"""Distance up to which vehicles count: about that at which radios with 23 dBm sense each other."""


def measure_density(vehicles: Collection[RoadVehicle], length_m: float) -> None:
    """Set `senders_per_km` of all vehicles on a road of a given length.

    Near the ends of the road, only the part on the road counts: the road continues there.
    """
    positions_m = sorted(vehicle.state[0] for vehicle in vehicles)
    for vehicle in vehicles:
        s_m = vehicle.state[0]
        first_m, last_m = max(s_m - RADIUS_M, 0.0), min(s_m + RADIUS_M, length_m)
        count = bisect_right(positions_m, last_m) - bisect_left(positions_m, first_m)
        vehicle.senders_per_km = 1000.0 * count / max(last_m - first_m, 1.0)
