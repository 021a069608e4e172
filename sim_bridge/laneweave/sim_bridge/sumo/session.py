"""SUMO with the road of a scenario."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path

from laneweave.protocol.scenario.fields import Scenario
from laneweave.sim_bridge.bodies.overlaps_and_gaps import Pose
from laneweave.sim_bridge.sumo.network import write_network
from laneweave.sim_bridge.sumo.simulation import SumoProcess


class SumoSession(SumoProcess):
    """SUMO with the road of a scenario."""

    def __init__(self, scenario: Scenario, folder: Path, *, sumo_drives: bool = False) -> None:
        """Write the network and start SUMO; see `SumoProcess`.

        Args:
            scenario: road, vehicles and tick.
            folder: folder for SUMO's input files.
            sumo_drives: whether SUMO drives; see `write_network`.
        """
        super().__init__(write_network(scenario, folder, sumo_drives=sumo_drives))
        self._types = scenario.types
        self._half_bodies_m: dict[str, float] = {}

    def set_type(self, vehicle: str, vehicle_type: str) -> None:
        """Set the type of a vehicle that is about to be added."""
        self._half_bodies_m[vehicle] = 0.5 * self._types[vehicle_type].limits.length_m

    def forget(self, vehicle: str) -> None:
        """Remove a vehicle from SUMO."""
        del self._half_bodies_m[vehicle]
        self.vehicle.remove(vehicle)

    def half_body_m(self, vehicle: str) -> float:
        """Return half of the length of a vehicle's body."""
        return self._half_bodies_m[vehicle]

    def poses(self, vehicles: Iterable[str]) -> dict[str, Pose]:
        """Return the poses of vehicles after the last step."""
        api = self.vehicle
        position, angle, speed = api.getPosition, api.getAngle, api.getSpeed
        poses = {}
        for vehicle in vehicles:
            s_m, front_y_m = position(vehicle)
            heading = math.radians(90.0 - angle(vehicle))
            y_m = front_y_m - self._half_bodies_m[vehicle] * math.sin(heading)
            poses[vehicle] = (s_m, y_m, heading, speed(vehicle))
        return poses
