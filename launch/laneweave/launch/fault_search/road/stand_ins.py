"""Fast stand-ins for the costly parts of agents and coordinators: trajectories, rolling planner.

Safety does not depend on either of them.
"""

from __future__ import annotations

import math
import random
from collections.abc import Collection, Sequence

from laneweave.agents.driving.driver import Drive, SolverStats
from laneweave.coordinator.planning.rolling.problem import (
    CellPath,
    OpenRoad,
    StreamPlan,
    StreamRoad,
    StreamVehicle,
)
from laneweave.coordinator.rolling.checked_planner import stream_road
from laneweave.protocol.lattice import Cell, PlannedMove, displacements, footprint
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.vehicle_tables import Vehicle
from laneweave.protocol.vehicle.lane_ends import LaneEnds
from laneweave.protocol.vehicle.motion import at_rest_in_cell
from laneweave.protocol.wire.messages import CurrentMotion, Motion, Sense

UNNEEDED_MOVES = 0.4
"""Probability with which the planner moves a vehicle that is in its preferred lane."""


class LightDriver:
    """Driver without trajectories; its commands contain only cells and ticks.

    Like `TrackingDriver`, it considers a motion complete when its time is over and the body is in
    the target cell.
    """

    def __init__(self, scenario: Scenario, limits: Vehicle) -> None:
        """Create a driver that has not taken over a vehicle yet."""
        del limits
        self._lattice = scenario.lattice
        self._origin: Cell = (0, 0)
        self._goal: Cell = (0, 0)
        self._end_tick = self._ticks = 0

    @property
    def solver_stats(self) -> SolverStats:
        """Empty statistics, because nothing is solved."""
        return SolverStats()

    def take_over(self, sense: Sense) -> None:
        """Continue the current motion of the motion controller."""
        motion, self._goal = sense.motion, sense.hold_cell
        self._origin, self._end_tick, self._ticks = motion.origin, motion.end_tick, motion.ticks

    def begin(self, move: PlannedMove, tick: int, ticks: int) -> None:
        """Begin a move of `ticks` ticks at a tick."""
        _, self._origin, self._goal = move
        self._end_tick, self._ticks = tick + ticks, ticks

    def at_rest(self, sense: Sense) -> bool:
        """Return whether the time of the motion is over and the body is in its target cell."""
        return sense.tick >= self._end_tick and at_rest_in_cell(
            sense.measured, self._lattice, self._goal, sense.t_s
        )

    def drive(self, sense: Sense, *, moving: bool) -> Drive:
        """Return a command with the end of the current motion, and without jerks."""
        end_tick = max(self._end_tick, sense.tick + 1) if moving else 0
        return Drive(CurrentMotion(self._origin, end_tick, self._ticks), b"", free=not moving)

    def motion(self, tick: int) -> None:
        """Publish no motion; motions would only slow down the search."""

    def close(self, lane_ends: LaneEnds) -> None:
        """Do nothing: it drives without stop lines."""

    def on_motion(self, motion: Motion) -> None:
        """Ignore motions of other vehicles."""


class LightPlanner:
    """Planner for one slot of the rolling operation: moves to preferred lanes, or random moves.

    It moves as many vehicles as possible, to transfer more cells than the stream planner would.
    The same arguments give the same plan.
    """

    def __init__(self, scenario: Scenario) -> None:
        """Create a planner for a road."""
        road = self._road = stream_road(scenario)
        self._lanes = road.lanes
        self._sections = road.sections
        self._some_end = any(not section.exit for section in road.sections)
        self._edges = {
            section.lane
            for section in road.sections
            if section.moves_from_m > -math.inf
            or section.from_m > 0.0
            or (section.exit and section.to_m < road.length_m)
        }
        """Lanes in which lane changes begin or end in the middle of the road."""
        self._steps = [step for step in displacements(road.mode) if step != (0, 0)]
        self._seed = scenario.seed

    def plan(
        self,
        slot: int,
        vehicles: Sequence[StreamVehicle],
        before: StreamPlan | None = None,
        blocked: Collection[Cell] = (),
        now: OpenRoad | None = None,
    ) -> StreamPlan:
        """Return the cells of all vehicles at the start and the end of the next slot."""
        del before
        road = self._road.as_open(now)
        rng = random.Random(f"{self._seed}/{slot}")  # noqa: S311 (simulation, no secrets)
        taken = {vehicle.cell for vehicle in vehicles} | set(blocked)
        paths: dict[str, CellPath] = {vehicle.vehicle: (vehicle.cell,) for vehicle in vehicles}
        in_order = sorted(vehicles, key=lambda one: (not self._away(one, one.cell), rng.random()))
        for vehicle in in_order:
            arrived = not self._away(vehicle, vehicle.cell)
            if vehicle.held or (arrived and rng.random() > UNNEEDED_MOVES):
                continue
            target = self._target(road, slot, vehicle, taken, rng)
            if target is not None:
                paths[vehicle.vehicle] = (vehicle.cell, target)
                taken |= footprint(vehicle.cell, target)
        return StreamPlan(slot, paths, ())

    def _target(
        self,
        road: StreamRoad,
        slot: int,
        vehicle: StreamVehicle,
        taken: set[Cell],
        rng: random.Random,
    ) -> Cell | None:
        column, lane = vehicle.cell
        cells = [(column + along, lane + across) for along, across in self._steps]
        some_end = self._some_end or road is not self._road
        free = [
            cell
            for cell in cells
            if 0 <= cell[1] < self._lanes
            and vehicle.drives(cell[0] - column, cell[1] - lane)
            and self._is_open(road, slot, vehicle, cell)
            and not (some_end and road.has_left(slot + 1, cell))
            and taken.isdisjoint(footprint(vehicle.cell, cell) - {vehicle.cell})
        ]
        if not free:
            return None
        return min(free, key=lambda cell: (self._away(vehicle, cell), rng.random()))

    def _is_open(self, road: StreamRoad, slot: int, vehicle: StreamVehicle, target: Cell) -> bool:
        """Return whether a move stays where moves are possible in its lanes.

        Without closed or cleared parts, this is certain but for lanes at the edges.
        """
        (column, lane), now = vehicle.cell, road is not self._road
        lanes = [each for each in {lane, target[1]} if now or each in self._edges]
        if not lanes:
            return True
        rear_m = road.position_m(slot, min(column, target[0])) - road.body_m
        front_m = road.position_m(slot + 1, max(column, target[0]))
        change = lane, target[1]
        return all(road.is_open(each, rear_m, front_m) for each in lanes) and not (
            now and road.forbids(vehicle.vehicle_type, change, slot, rear_m, front_m)
        )

    def _away(self, vehicle: StreamVehicle, cell: Cell) -> int:
        """Return the number of lanes from a cell to the nearest target."""
        return min(abs(cell[1] - self._sections[number].lane) for number in vehicle.targets)
