"""SUMO's own lane changing (LC2013) and car following (Krauss), for automated vehicles.

Headway and desired speed are those of the other methods; vehicles are identical, with no driver
imperfection. A vehicle's route leads to its exit, or to that of its preferred lane. In S1 and S2,
lane changes are disabled unless the scenario allows them everywhere.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.scenario.fields import Scenario
from laneweave.sim_bridge.baselines.reference_method import ReferenceMethod, check_no_lane_rules
from laneweave.sim_bridge.baselines.reference_road import Entrance, ReferenceVehicle, Traffic
from laneweave.sim_bridge.bodies.overlaps_and_gaps import Pose
from laneweave.sim_bridge.sumo.road_edges import lane_end_m
from laneweave.sim_bridge.sumo.traffic import SumoTraffic


class Lc2013Method(ReferenceMethod):
    """SUMO's own driving."""

    def check(self, scenario: Scenario) -> None:
        """Check that SUMO can drive the vehicles; see `check_lc2013`."""
        check_lc2013(scenario)

    @contextmanager
    def open(self, scenario: Scenario, folder: Path) -> Iterator[Traffic]:
        """Yield traffic that SUMO drives."""
        with SumoTraffic(scenario, folder) as sumo:
            yield Lc2013Traffic(scenario, sumo)


class Lc2013Traffic:
    """The vehicles on the road, driven by SUMO; a `Traffic`."""

    def __init__(self, scenario: Scenario, sumo: SumoTraffic) -> None:
        """Begin with an empty road."""
        self._sumo = sumo
        self._vehicles: dict[str, ReferenceVehicle] = {}
        self._offered: dict[str, int] = {}
        """Entry point of each vehicle that SUMO is to insert, at most one at each of them."""
        self._entry_points = len(scenario.geometry.entry_points)
        self._kept_in_lane: set[ReferenceVehicle] = set()
        """Vehicles that must not change lanes yet."""
        self._poses: dict[str, Pose] = {}
        self._road = scenario.road
        self._everywhere = scenario.lc2013.lane_changes == "everywhere"
        self._tick_s = scenario.runtime.tick_s

    @property
    def vehicles(self) -> Collection[ReferenceVehicle]:
        """All vehicles on the road, in order of entry."""
        return self._vehicles.values()

    def step(self, t_s: float, entrance: Entrance) -> list[ReferenceVehicle]:
        """Let SUMO advance to `t_s`; return the vehicles that it has inserted."""
        self._offer(t_s, entrance)
        entered = self._sumo.advance()
        self._poses = self._sumo.positions()
        new_vehicles = [self._entered(name, t_s, entrance) for name in sorted(entered)]
        for vehicle in self._vehicles.values():
            self._update(vehicle)
        for vehicle in list(self._kept_in_lane):
            if vehicle.s_m >= self._road.sorting_start_m:
                self._kept_in_lane.remove(vehicle)
                self._sumo.allow_lane_changes(vehicle.name, allowed=True)
        return new_vehicles

    def poses(self) -> dict[str, Pose]:
        """Return the pose of each vehicle in SUMO."""
        return self._poses

    def collisions(self) -> list[tuple[str, str]]:
        """Return the pairs that SUMO reports as colliding."""
        return self._sumo.collisions()

    def remove(self, vehicle: ReferenceVehicle) -> None:
        """Remove a vehicle from the road."""
        del self._vehicles[vehicle.name]
        self._kept_in_lane.discard(vehicle)
        self._sumo.remove(vehicle.name)

    def _offer(self, t_s: float, entrance: Entrance) -> None:
        """Offer the next vehicle of each queue to SUMO, which inserts it when there is room."""
        for point in range(self._entry_points):
            arrival = entrance.next_at(point)
            if arrival is not None and arrival.vehicle not in self._offered:
                self._sumo.offer(arrival, entrance.max_entry_m(arrival, t_s))
                if not self._everywhere:
                    self._sumo.allow_lane_changes(arrival.vehicle, allowed=False)
                self._offered[arrival.vehicle] = point

    def _entered(self, name: str, t_s: float, entrance: Entrance) -> ReferenceVehicle:
        s_m, y_m, _, speed_mps = self._poses[name]
        vehicle = entrance.enter(self._offered.pop(name), t_s, s_m, y_m, speed_mps)
        self._vehicles[name] = vehicle
        if not self._everywhere:
            self._kept_in_lane.add(vehicle)
        return vehicle

    def _update(self, vehicle: ReferenceVehicle) -> None:
        """Read a vehicle's state from SUMO."""
        s_m, y_m, _, speed_mps = self._poses[vehicle.name]
        vehicle.accel_mps2 = (speed_mps - vehicle.speed_mps) / self._tick_s
        vehicle.s_m, vehicle.y_m, vehicle.speed_mps = s_m, y_m, speed_mps
        vehicle.lane = int(y_m // self._road.lane_width_m)


def check_lc2013(scenario: Scenario) -> None:
    """Check that SUMO can drive the vehicles.

    Raises:
        BadInputError: a field is unsuitable.
    """
    headway_s, tick_s = scenario.lc2013.headway_s, scenario.runtime.tick_s
    if headway_s < tick_s:
        raise BadInputError(
            "lc2013.headway_s",
            headway_s,
            f"at least runtime.tick_s = {tick_s:g}: a vehicle reacts once per tick",
        )
    limits = scenario.vehicle
    for name, value, limit, whose in (
        ("accel_mps2", scenario.lc2013.accel_mps2, limits.max_accel_mps2, "max_accel_mps2"),
        ("decel_mps2", scenario.lc2013.decel_mps2, -limits.min_accel_mps2, "min_accel_mps2"),
    ):
        if value is not None and value > limit:
            raise BadInputError(
                f"lc2013.{name}", value, f"at most {limit:g}, the limit vehicle.{whose}"
            )
    _check_closures(scenario)
    check_no_lane_rules(scenario, "lc2013")


def _check_closures(scenario: Scenario) -> None:
    """Check that vehicles can leave lanes before they end, and use them again."""
    road = scenario.road
    numbers = {(one.lane, one.from_m): number for number, one in enumerate(road.closures)}
    sorting_m = 0.0 if scenario.lc2013.lane_changes == "everywhere" else road.sorting_start_m
    for section in scenario.geometry.sections:
        if section.exit:
            continue
        changes_from_m = max(sorting_m, section.from_m, section.moves_from_m)
        min_m = changes_from_m + section.to_m - lane_end_m(scenario, section.to_m)
        if section.to_m <= min_m:
            name = f"road.closures[{numbers[section.lane, section.to_m]}].from_m"
            allowed = f"more than {min_m:g}, so that vehicles can change lanes before"
            raise BadInputError(name, section.to_m, allowed)
    max_m = road.length_m - scenario.types.longest_body_m
    for number, closure in enumerate(road.closures):
        if max_m <= closure.to_m < road.length_m:
            name = f"road.closures[{number}].to_m"
            allowed = f"less than {max_m:g}, or at least {road.length_m:g}: a vehicle must fit in"
            raise BadInputError(name, closure.to_m, allowed)
