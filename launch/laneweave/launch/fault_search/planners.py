"""Planners of simulated runs of the rolling operation.

The light one plans the next slot only, towards the wished lanes or just anywhere. It is fast, and
moves whoever can be moved, so that more cells change hands than under the stream planner. What
safety needs is not the planner's work.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Collection, Sequence

from laneweave.coordinator.planning.grid import displacements
from laneweave.coordinator.planning.rolling.planner import StreamPlan, StreamVehicle, Way
from laneweave.coordinator.rolling.planner import Planner, stream_road
from laneweave.protocol.lattice import Cell, footprint
from laneweave.protocol.scenario.tables import Scenario

RESTLESS = 0.4
"""Share of vehicles on their lanes that are moved all the same."""
Listener = Callable[[Sequence[str]], None]
"""Is told who is to move, or may not."""


class LightPlanner:
    """Plans a slot; equal arguments give equal plans."""

    def __init__(self, scenario: Scenario) -> None:
        """Make a planner for a road."""
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
        """Return where everybody is at the beginning of the next slot and at its end."""
        del before
        rng = random.Random(f"{self._seed}/{slot}")  # noqa: S311 (simulation, no secrets)
        taken = {vehicle.cell for vehicle in vehicles} | set(blocked)
        ways: dict[str, Way] = {vehicle.vehicle: (vehicle.cell,) for vehicle in vehicles}
        first = sorted(vehicles, key=lambda one: (one.cell[1] == one.lane, rng.random()))
        for vehicle in first:
            if vehicle.held or (vehicle.cell[1] == vehicle.lane and rng.random() > RESTLESS):
                continue
            target = self._target(vehicle, taken, rng)
            if target is not None:
                ways[vehicle.vehicle] = (vehicle.cell, target)
                taken |= footprint(vehicle.cell, target)
        return StreamPlan(slot, ways, ())

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


class Watched:
    """A planner that tells a listener who is to move in the next slot, and who is held."""

    def __init__(self, planner: Planner, listener: Listener) -> None:
        """Listen to a planner."""
        self._planner = planner
        self._listener = listener

    def plan(
        self,
        slot: int,
        vehicles: Sequence[StreamVehicle],
        before: StreamPlan | None = None,
        blocked: Collection[Cell] = (),
    ) -> StreamPlan:
        """Return what the planner returns."""
        plan = self._planner.plan(slot, vehicles, before, blocked)
        held = [vehicle.vehicle for vehicle in vehicles if vehicle.held]
        ways = plan.ways.items()
        movers = [name for name, way in ways if len(way) > 1 and way[0] != way[1]]
        self._listener([*held, *movers])
        return plan
