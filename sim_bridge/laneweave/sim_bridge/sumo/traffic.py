"""Vehicles that SUMO itself drives, with its own car following and lane changing.

Each tick runs

    offer() vehicles that should enter  ->  advance() returns those that did  ->  positions()

An offered vehicle waits in SUMO until there is room for it at the position where it was offered.
Each vehicle has the route that leaves the road on its preferred lane, which SUMO's lane changing
follows; a vehicle that does not reach that lane stops at the end of the road.

There is one `SumoTraffic` per process at a time, see `simulation`.
"""

from __future__ import annotations

from pathlib import Path

from laneweave.protocol.scenario.fields import Scenario
from laneweave.sim_bridge.bodies.overlaps_and_gaps import Pose
from laneweave.sim_bridge.sumo.network import VEHICLE_TYPE, exit_route, margin_m
from laneweave.sim_bridge.sumo.simulation import SumoSession

_NO_LANE_CHANGES = 0
_ALL_LANE_CHANGES = 0b011001010101
"""SUMO's default lane change mode: all kinds of lane changes."""


class SumoTraffic(SumoSession):
    """One road with vehicles that SUMO drives. Close it, or use it as a context manager."""

    def __init__(self, scenario: Scenario, folder: Path) -> None:
        """Start SUMO on an empty road; see `SumoSession`."""
        super().__init__(scenario, folder, exits=True)
        self._margin_m = margin_m(scenario)
        self._speed_mps = scenario.formation.speed_mps
        self._on_road: dict[str, None] = {}

    def offer(self, vehicle: str, lane: int, preferred_lane: int, s_m: float) -> None:
        """Let SUMO insert a vehicle at v_F in the first step in which there is room.

        Args:
            vehicle: its name.
            lane: lane on which it enters.
            preferred_lane: lane on which it leaves.
            s_m: position of its front bumper then.
        """
        self.vehicle.add(
            vehicle,
            exit_route(preferred_lane),
            typeID=VEHICLE_TYPE,
            depart="now",
            departLane=str(lane),
            departPos=f"{self._margin_m + s_m:.9f}",
            departSpeed=f"{self._speed_mps:.9f}",
        )

    def allow_lane_changes(self, vehicle: str, *, allowed: bool) -> None:
        """Allow or forbid lane changes of a vehicle; they are allowed by default."""
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
        """Take a vehicle off the road."""
        del self._on_road[vehicle]
        self.vehicle.remove(vehicle)
