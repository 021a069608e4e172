"""Vehicles that SUMO itself drives: its car following, its lane changing.

Each tick goes

    offer() whom the road shall take  ->  step() returns whom it took  ->  shown()

A vehicle that is offered waits in SUMO until there is room for it, then stands where it was
offered. Each vehicle is on the route that leaves the road on its preferred lane, which is what
SUMO's lane changing goes by; one that does not reach that lane stops at the end of the road.

There is one `SumoTraffic` per process at a time, see `sumo/simulation.py`.
"""

from __future__ import annotations

import math
from pathlib import Path
from types import TracebackType
from typing import Self

from laneweave.protocol.scenario.tables import Scenario
from laneweave.sim_bridge.bodies.footprints import Pose
from laneweave.sim_bridge.sumo.network import (
    VEHICLE_TYPE,
    exit_route,
    margin_m,
    write_network_with_exits,
)
from laneweave.sim_bridge.sumo.simulation import SumoSession

_NO_LANE_CHANGES = 0
_ALL_LANE_CHANGES = 0b011001010101
"""SUMO's default lane change mode: it changes lanes for every reason that it has."""


class SumoTraffic:
    """One road with vehicles that SUMO drives. Close it, or use it as a context manager."""

    def __init__(self, scenario: Scenario, folder: Path) -> None:
        """Write the network into a folder and start SUMO on it.

        Args:
            scenario: road, vehicles, tick, and the table `lc2013`.
            folder: where to write SUMO's input files.

        Raises:
            SumoUnavailableError: libsumo cannot be loaded.
            RuntimeError: another simulation is open in this process.
        """
        self._sumo = SumoSession(lambda: write_network_with_exits(scenario, folder).options)
        self._margin_m = margin_m(scenario)
        self._half_body_m = 0.5 * scenario.vehicle.length_m
        self._speed_mps = scenario.formation.speed_mps
        self._on_road: dict[str, None] = {}

    def offer(self, vehicle: str, lane: int, preferred_lane: int, s_m: float) -> None:
        """Let SUMO put a vehicle on the road at v_F in the first step in which there is room.

        Args:
            vehicle: its name.
            lane: lane on which it enters.
            preferred_lane: lane on which it leaves.
            s_m: where its front is then.
        """
        self._sumo.vehicle.add(
            vehicle,
            exit_route(preferred_lane),
            typeID=VEHICLE_TYPE,
            depart="now",
            departLane=str(lane),
            departPos=f"{self._margin_m + s_m:.9f}",
            departSpeed=f"{self._speed_mps:.9f}",
        )

    def allow_lane_changes(self, vehicle: str, *, allowed: bool) -> None:
        """Say whether a vehicle may change lanes from now on; on its own it may."""
        mode = _ALL_LANE_CHANGES if allowed else _NO_LANE_CHANGES
        self._sumo.vehicle.setLaneChangeMode(vehicle, mode)

    def step(self) -> tuple[str, ...]:
        """Advance by one tick and return the vehicles that have entered the road."""
        self._sumo.step()
        entered = self._sumo.departed()
        self._on_road.update(dict.fromkeys(entered))
        return entered

    def positions(self) -> dict[str, Pose]:
        """Return where each vehicle is: (s m, y m, heading rad, speed m/s), in order of entry."""
        api = self._sumo.vehicle
        position, angle, speed = api.getPosition, api.getAngle, api.getSpeed
        poses = {}
        for vehicle in self._on_road:
            s_m, front_y_m = position(vehicle)
            heading = math.radians(90.0 - angle(vehicle))
            y_m = front_y_m - self._half_body_m * math.sin(heading)
            poses[vehicle] = (s_m, y_m, heading, speed(vehicle))
        return poses

    def collisions(self) -> list[tuple[str, str]]:
        """Return the pairs that SUMO reports as colliding in the last step, sorted, each once."""
        return self._sumo.collisions()

    def remove(self, vehicle: str) -> None:
        """Take a vehicle off the road."""
        del self._on_road[vehicle]
        self._sumo.vehicle.remove(vehicle)

    def close(self) -> None:
        """End SUMO; a second call does nothing."""
        self._on_road.clear()
        self._sumo.close()

    def __enter__(self) -> Self:
        """Return this traffic."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close this traffic."""
        self.close()
