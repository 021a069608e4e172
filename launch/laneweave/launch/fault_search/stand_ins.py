"""Fast stand-ins for the two costly parts of a run: the trajectory driver and the rolling planner.

Safety does not depend on either of them.
"""

from __future__ import annotations

import random
from collections.abc import Collection, Sequence

from laneweave.agents.driving.driver import Drive, SolverStats
from laneweave.coordinator.planning.rolling.path_search import CellPath, StreamPlan, StreamVehicle
from laneweave.coordinator.rolling.checked_planner import stream_road
from laneweave.protocol.lattice import Cell, PlannedMove, displacements, footprint
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.vehicle.motion import at_rest_in_cell
from laneweave.protocol.wire.messages import Motion, Sense

RESTLESS = 0.4
"""Probability that a vehicle on its preferred lane is moved nevertheless."""


class LightDriver:
    """Driver of an agent without trajectories; it only names cells and ticks.

    Like `TrackingDriver`, it considers a motion ended when its time is over and the body is in the
    target cell.
    """

    def __init__(self, scenario: Scenario) -> None:
        """Create a driver without knowledge of its vehicle."""
        self._lattice = scenario.lattice
        self._origin: Cell = (0, 0)
        self._goal: Cell = (0, 0)
        self._end_tick = self._ticks = 0

    @property
    def solver_stats(self) -> SolverStats:
        """Empty statistics: nothing is solved."""
        return SolverStats()

    def take_over(self, sense: Sense) -> None:
        """Continue the motion that the motion controller performs."""
        self._origin, self._goal = sense.motion_origin, sense.hold_cell
        self._end_tick, self._ticks = sense.motion_end_tick, sense.motion_ticks

    def begin(self, move: PlannedMove, tick: int, ticks: int) -> None:
        """Begin a move of `ticks` ticks at a tick."""
        _, self._origin, self._goal = move
        self._end_tick, self._ticks = tick + ticks, ticks

    def at_rest(self, sense: Sense) -> bool:
        """Return whether the time of the motion is over and the body is in its target cell."""
        return sense.tick >= self._end_tick and at_rest_in_cell(
            sense.state, self._lattice, self._goal, sense.t_s
        )

    def drive(self, sense: Sense, *, moving: bool) -> Drive:
        """Return the end of the current motion, without jerks."""
        end_tick = max(self._end_tick, sense.tick + 1) if moving else 0
        return Drive(end_tick, self._origin, self._ticks, b"")

    def motion(self, tick: int) -> None:
        """Announce no motions: they would only slow the search down."""

    def on_motion(self, motion: Motion) -> None:
        """Ignore motions of other vehicles."""


class LightPlanner:
    """Rolling planner for one slot, towards the preferred lanes or at random.

    It moves as many vehicles as it can, so that more cells are transferred than with the stream
    planner. Equal arguments give equal plans.
    """

    def __init__(self, scenario: Scenario) -> None:
        """Create a planner for a road."""
        road = stream_road(scenario)
        self._lanes = road.lanes
        self._steps = [step for step in displacements(road.mode) if step != (0, 0)]
        self._seed = scenario.seed

    def plan(
        self,
        slot: int,
        vehicles: Sequence[StreamVehicle],
        before: StreamPlan | None = None,
        blocked: Collection[Cell] = (),
    ) -> StreamPlan:
        """Return the cells of all vehicles at the beginning and at the end of the next slot."""
        del before
        rng = random.Random(f"{self._seed}/{slot}")  # noqa: S311 (simulation, no secrets)
        taken = {vehicle.cell for vehicle in vehicles} | set(blocked)
        paths: dict[str, CellPath] = {vehicle.vehicle: (vehicle.cell,) for vehicle in vehicles}
        in_order = sorted(vehicles, key=lambda one: (one.cell[1] == one.lane, rng.random()))
        for vehicle in in_order:
            if vehicle.held or (vehicle.cell[1] == vehicle.lane and rng.random() > RESTLESS):
                continue
            target = self._target(vehicle, taken, rng)
            if target is not None:
                paths[vehicle.vehicle] = (vehicle.cell, target)
                taken |= footprint(vehicle.cell, target)
        return StreamPlan(slot, paths, ())

    def _target(self, vehicle: StreamVehicle, taken: set[Cell], rng: random.Random) -> Cell | None:
        column, lane = vehicle.cell
        cells = [(column + along, lane + across) for along, across in self._steps]
        free = [
            cell
            for cell in cells
            if 0 <= cell[1] < self._lanes
            and taken.isdisjoint(footprint(vehicle.cell, cell) - {vehicle.cell})
        ]
        if not free:
            return None
        return min(free, key=lambda cell: (abs(cell[1] - vehicle.lane), rng.random()))
