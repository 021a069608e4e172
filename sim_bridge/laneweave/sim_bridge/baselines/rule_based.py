"""The rule-based method: `rules` move the vehicles, SUMO displays them.

Longitudinal acceleration is constant during a tick and within the vehicle's limits. A lane change
has constant lateral speed within the slip limit, or is instantaneous.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.scenario.fields import Scenario
from laneweave.sim_bridge.baselines.reference_method import ReferenceMethod, check_no_lane_rules
from laneweave.sim_bridge.baselines.reference_road import Entrance, ReferenceVehicle, Traffic
from laneweave.sim_bridge.baselines.rules import Lanes, Rules, priority, safe_change_m
from laneweave.sim_bridge.bodies.overlaps_and_gaps import Pose
from laneweave.sim_bridge.road.demand import Arrival
from laneweave.sim_bridge.sumo.sumo_world import SumoWorld
from laneweave.sim_bridge.world_interface import World

_ROUNDING_M = 1e-9


class RuleMethod(ReferenceMethod):
    """The rule-based method; subclasses may have other rules."""

    def check(self, scenario: Scenario) -> None:
        """Check that vehicles can follow the rules; see `check_rule`."""
        check_rule(scenario)

    @contextmanager
    def open(self, scenario: Scenario, folder: Path) -> Iterator[Traffic]:
        """Yield traffic that follows the rules, displayed by SUMO."""
        with SumoWorld(scenario, folder) as world:
            yield RuleTraffic(scenario, world, self.rules(scenario))

    def rules(self, scenario: Scenario) -> Rules:
        """Return the rules for a scenario."""
        return Rules(scenario)


class RuleTraffic:
    """The vehicles on the road, moved by the rules; a `Traffic`."""

    def __init__(self, scenario: Scenario, world: World, rules: Rules) -> None:
        """Begin with an empty road in an empty world."""
        self._world = world
        self._rules = rules
        self._lanes = Lanes(scenario.road.lanes)
        self._vehicles: dict[str, ReferenceVehicle] = {}
        self._limits = scenario.vehicle
        self._rule = scenario.rule
        self._road = scenario.road
        self._points = scenario.geometry.entry_points
        self._centre_m = scenario.lattice.cell_y_m
        self._speed_mps = scenario.formation.speed_mps
        self._tick_s = scenario.runtime.tick_s

    @property
    def vehicles(self) -> Collection[ReferenceVehicle]:
        """All vehicles on the road, in order of entry."""
        return self._vehicles.values()

    def step(self, t_s: float, entrance: Entrance) -> list[ReferenceVehicle]:
        """Move all vehicles to their positions at `t_s`; admit and return new ones."""
        slowing = self._rules.sort(self._lanes)
        leaders = self._lanes.leaders()
        for vehicle in sorted(self._vehicles.values(), key=priority):
            self._move_along(vehicle, leaders.get(vehicle, ()), slows_before_m=slowing.get(vehicle))
            self._move_across(vehicle)
        entered = self._admit(t_s, entrance)
        for vehicle in self._vehicles.values():
            self._world.place(vehicle.name, vehicle.state)
        self._world.step()
        return entered

    def poses(self) -> dict[str, Pose]:
        """Return the pose of each vehicle."""
        return self._world.positions()

    def collisions(self) -> list[tuple[str, str]]:
        """Return the pairs that the world reports as colliding."""
        return self._world.collisions()

    def remove(self, vehicle: ReferenceVehicle) -> None:
        """Remove a vehicle from the road."""
        del self._vehicles[vehicle.name]
        self._lanes.leave(vehicle)
        self._world.remove(vehicle.name)

    def _move_along(
        self,
        vehicle: ReferenceVehicle,
        leaders: Iterable[ReferenceVehicle],
        *,
        slows_before_m: float | None,
    ) -> None:
        """Move a vehicle along the road by one tick, once all vehicles ahead have moved.

        By rule 3 it slows down before the position `slows_before_m`, if there is one.
        """
        s_m, before_mps, tick_s = vehicle.s_m, vehicle.speed_mps, self._tick_s
        wanted_mps = min(
            self._rules.approach_speed_mps(vehicle),
            before_mps + self._limits.max_accel_mps2 * tick_s,
        )
        if slows_before_m is not None:
            braked_mps = before_mps - self._rule.slow_down_mps2 * tick_s
            slow_mps = self._rules.slow_speed_mps(s_m, slows_before_m)
            wanted_mps = min(wanted_mps, max(slow_mps, braked_mps))
        follow = self._rules.following.speed_mps
        for ahead in leaders:
            safe_mps = follow(s_m, before_mps, ahead.s_m, ahead.speed_mps)
            if safe_mps < wanted_mps:
                wanted_mps = safe_mps
        min_mps = before_mps + self._limits.min_accel_mps2 * tick_s
        after_mps = max(wanted_mps, min_mps, 0.0)
        vehicle.speed_mps = after_mps
        vehicle.s_m = s_m + 0.5 * (before_mps + after_mps) * tick_s
        vehicle.accel_mps2 = (after_mps - before_mps) / tick_s

    def _move_across(self, vehicle: ReferenceVehicle) -> None:
        """Move a vehicle across the road by one tick."""
        target_m = self._centre_m(vehicle.lane)
        if vehicle.previous_lane is None:
            vehicle.y_m, vehicle.lateral_speed_mps = target_m, 0.0
            return
        distance_m = target_m - vehicle.y_m
        slip_mps = self._limits.max_slip_ratio * vehicle.speed_mps
        max_mps = min(self._road.lane_width_m / self._rule.lane_change_s, slip_mps)
        if abs(distance_m) <= max_mps * self._tick_s + _ROUNDING_M:
            vehicle.y_m, vehicle.lateral_speed_mps = target_m, 0.0
            self._lanes.end_change(vehicle)
        else:
            vehicle.lateral_speed_mps = math.copysign(max_mps, distance_m)
            vehicle.y_m += vehicle.lateral_speed_mps * self._tick_s

    def _admit(self, t_s: float, entrance: Entrance) -> list[ReferenceVehicle]:
        entered = []
        for number, point in enumerate(self._points):
            lane = point.lane
            while (arrival := entrance.next_at(number)) is not None:
                s_m = self._room_m(arrival, entrance.max_entry_m(arrival, t_s))
                if s_m is None:
                    break
                y_m = self._centre_m(lane)
                vehicle = entrance.enter(number, t_s, s_m, y_m, self._speed_mps)
                self._vehicles[vehicle.name] = vehicle
                self._lanes.enter(vehicle, lane)
                self._world.add(vehicle.name, vehicle.state)
                entered.append(vehicle)
        return entered

    def _room_m(self, arrival: Arrival, max_entry_m: float) -> float | None:
        """Return the position at which a vehicle can enter its lane at v_F; None if it cannot."""
        entry_m, speed_mps = self._points[arrival.entry_point].at_m, self._speed_mps
        beyond = [one for one in self._lanes[arrival.lane] if one.s_m >= entry_m]
        if not beyond:
            return max_entry_m
        ahead, following = beyond[-1], self._rules.following
        s_m = min(max_entry_m, ahead.s_m - following.gap_m(speed_mps) - _ROUNDING_M)
        if s_m < entry_m or not following.is_safe(s_m, speed_mps, ahead.s_m, ahead.speed_mps):
            return None
        return s_m


def check_rule(scenario: Scenario) -> None:
    """Check that vehicles can follow the rules in a scenario.

    Raises:
        BadInputError: a field is unsuitable.
    """
    if scenario.vehicle_type:
        names = [one.name for one in scenario.vehicle_type]
        raise BadInputError(
            "vehicle_type", names, "none with --method rule, which drives cars only"
        )
    check_no_lane_rules(scenario, "rule")
    rule, road, speed_mps = scenario.rule, scenario.road, scenario.formation.speed_mps
    # Speed decreases in proportion to the remaining distance, once per tick.
    braking_m = speed_mps**2 / -scenario.vehicle.min_accel_mps2
    min_m = braking_m + 3.0 * speed_mps * scenario.runtime.tick_s
    sorting_m, sorting = road.s3_m, f"road.s3_m = {road.s3_m:g}"
    for number, closure in enumerate(road.closures):
        if 0.0 < closure.from_m < road.sorting_start_m + sorting_m:
            sorting_m = closure.from_m - road.sorting_start_m
            sorting = f"{sorting_m:g}, the part of S3 before road.closures[{number}]"
    if not min_m <= rule.stop_distance_m < sorting_m:
        raise BadInputError(
            "rule.stop_distance_m",
            rule.stop_distance_m,
            f"at least {min_m:g}, to stop there from formation.speed_mps = {speed_mps:g}, and "
            f"less than {sorting}",
        )
    change_m = safe_change_m(scenario)
    for section in scenario.geometry.sections:
        begins_m = max(section.from_m, section.moves_from_m) + scenario.vehicle.length_m
        if section.to_m < road.length_m and section.to_m - begins_m <= change_m:
            raise BadInputError(
                "rule.lane_change_s",
                rule.lane_change_s,
                f"so short that a lane change of {change_m:g} m fits into lane {section.lane} from "
                f"{begins_m:g} to {section.to_m:g} m",
            )
    changes_m = (road.lanes - 1) * speed_mps * rule.lane_change_s
    if rule.stop_distance_m + changes_m > sorting_m:
        raise BadInputError(
            "rule.lane_change_s",
            rule.lane_change_s,
            f"so short that {road.lanes - 1} lane changes at formation.speed_mps = {speed_mps:g} "
            f"and rule.stop_distance_m fit into {sorting}",
        )
