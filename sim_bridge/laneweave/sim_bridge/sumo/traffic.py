"""Vehicles that SUMO drives with its own car following and lane changing.

The calls in each tick are

    offer() waiting vehicles  ->  advance(), which returns those that entered  ->  positions()

An offered vehicle waits in SUMO until there is room at its entry position. Its route, which SUMO's
lane changing follows, leads to its exit, or to that of its preferred lane; a vehicle that does not
reach a lane of its exit stops before it. A vehicle that does not leave a lane before it ends stops
there.
"""

from __future__ import annotations

from pathlib import Path

from laneweave.protocol.scenario.fields import Scenario
from laneweave.sim_bridge.bodies.overlaps_and_gaps import Pose
from laneweave.sim_bridge.road.demand import Arrival
from laneweave.sim_bridge.sumo.road_edges import road_edges, route_of
from laneweave.sim_bridge.sumo.session import SumoSession

_NO_LANE_CHANGES = 0
_ALL_LANE_CHANGES = 0b011001010101
"""SUMO's default lane change mode."""


class SumoTraffic(SumoSession):
    """One road with vehicles that SUMO drives. Close it, or use it as a context manager."""

    def __init__(self, scenario: Scenario, folder: Path) -> None:
        """Start SUMO with an empty road; see `SumoSession`."""
        super().__init__(scenario, folder, sumo_drives=True)
        self._scenario = scenario
        self._edges = road_edges(scenario)
        self._speed_mps = scenario.formation.speed_mps
        self._on_road: dict[str, None] = {}

    def offer(self, arrival: Arrival, s_m: float) -> None:
        """Let SUMO insert a vehicle at v_F in the first step with sufficient room.

        Args:
            arrival: the vehicle.
            s_m: entry position of the front bumper.
        """
        self.set_type(arrival.vehicle, arrival.vehicle_type)
        edge = self._edges.entry(self._scenario.geometry.entry_points[arrival.entry_point].entrance)
        self.vehicle.add(
            arrival.vehicle,
            route_of(self._scenario, arrival),
            typeID=arrival.vehicle_type,
            depart="now",
            departLane=str(edge.index(arrival.lane)),
            departPos=f"{s_m - edge.from_m:.9f}",
            departSpeed=f"{self._speed_mps:.9f}",
        )

    def allow_lane_changes(self, vehicle: str, *, allowed: bool) -> None:
        """Allow (SUMO's default) or forbid a vehicle to change lanes."""
        mode = _ALL_LANE_CHANGES if allowed else _NO_LANE_CHANGES
        self.vehicle.setLaneChangeMode(vehicle, mode)

    def advance(self) -> tuple[str, ...]:
        """Advance by one tick and return the vehicles that have entered the road."""
        self.step()
        entered: tuple[str, ...] = self._sumo.simulation.getDepartedIDList()
        self._on_road.update(dict.fromkeys(entered))
        return entered

    def positions(self) -> dict[str, Pose]:
        """Return the pose of each vehicle, in order of entry."""
        return self.poses(self._on_road)

    def remove(self, vehicle: str) -> None:
        """Remove a vehicle from the road."""
        del self._on_road[vehicle]
        self.forget(vehicle)
