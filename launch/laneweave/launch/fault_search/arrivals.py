"""The end of a run: whether vehicles arrive once all faults have ended, and when a run is over.

In formations all vehicles must come to rest in their preferred lanes. In the rolling operation
slots must be planned, and vehicles that plans move must move: one that has moved need not be in its
preferred lane, which may be full.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Sequence

from laneweave.coordinator.planning.rolling.problem import OpenRoad, StreamPlan, StreamVehicle
from laneweave.coordinator.rolling.checked_planner import Planner
from laneweave.launch.fault_search.checks.checker import Checker
from laneweave.launch.fault_search.road.light_road import LightRoad
from laneweave.launch.fault_search.road.light_vehicle import LightVehicle
from laneweave.launch.fault_search.setup import Setup
from laneweave.protocol.lattice import Cell
from laneweave.protocol.wire.messages import Name

PATIENCE_S = 90.0
"""Time limit for all vehicles to arrive after the fault phase."""
STANDING_S = 120.0
"""Additional time in which vehicles that stand before the end of a lane must drive on."""
HEALTHY_SLOTS = 8
"""Number of slots after the fault phase (rolling operation)."""
MAX_FUTILE_PLANS = 5
"""Number of plans after which a vehicle that has not moved counts as stuck."""
MIN_ROAD_S = 10.0
"""Time after its beginning at which slots of a road must have been planned."""


class Arrivals:
    """Vehicles that have still to arrive since the fault phase of a run."""

    def __init__(self, setup: Setup, fault_s: float) -> None:
        """Begin before the fault phase, which lasts `fault_s`."""
        scenario = setup.scenario
        self.healed = False
        """Whether all faults have ended."""
        self._fault_s = fault_s
        self._rolling = setup.road.rolling
        self._free = () if self._rolling else setup.leaving
        """Vehicles without a preferred lane: they have missed their exit (formations)."""
        self._healthy_s = HEALTHY_SLOTS * scenario.timing.cycles_s[0]
        """Time after the fault phase for which slots are planned (rolling operation)."""
        changes_m = {
            position_m
            for section in scenario.geometry.sections
            for position_m in (section.from_m, section.to_m)
            if 0.0 < position_m < scenario.road.length_m
        }
        self._last_change_m = max(changes_m, default=0.0)
        """Position behind which the lanes of the road do not change any more; 0: they never do."""
        self._proposed: Counter[str] = Counter()
        """Number of plans that move or hold each vehicle."""
        self._planned_slots = 0
        self._first_cells: dict[Name, Cell] = {}
        """First cell of each vehicle since the fault phase."""
        self._moved: set[Name] = set()

    @property
    def limit_s(self) -> float:
        """Time at which the run ends in any case."""
        if self._rolling:
            return self._fault_s + self._healthy_s + STANDING_S
        return self._fault_s + PATIENCE_S + (STANDING_S if self._last_change_m else 0.0)

    def counted(self, planner: Planner) -> Planner:
        """Return a planner whose plans count (rolling operation)."""

        def plan(
            slot: int,
            vehicles: Sequence[StreamVehicle],
            before: StreamPlan | None,
            blocked: Collection[Cell],
            now: OpenRoad | None,
        ) -> StreamPlan:
            table = planner(slot, vehicles, before, blocked, now)
            if self.healed:
                self._planned_slots += 1
                paths = table.paths.items()
                self._proposed.update(vehicle.vehicle for vehicle in vehicles if vehicle.held)
                self._proposed.update(
                    name for name, path in paths if len(path) > 1 and path[0] != path[1]
                )
            return table

        return plan

    def complete(self, now_s: float, road: LightRoad) -> bool:
        """Return whether nothing has to be waited for any more."""
        vehicles = road.vehicles
        if self._rolling:
            if self.healed:
                for name, vehicle in vehicles.items():
                    if self._first_cells.setdefault(name, vehicle.cell) != vehicle.cell:
                        self._moved.add(name)
            healthy = now_s >= self._fault_s + self._healthy_s
            return healthy and not any(map(_stands, vehicles.values()))
        # Lanes may still change for vehicles that have not passed all places where they do.
        under_way = any(each.state[0] < self._last_change_m for each in vehicles.values())
        return self.healed and not under_way and not self._missing(road)

    def check(self, now_s: float, road: LightRoad, checker: Checker) -> None:
        """Report vehicles that have not arrived, unless something else has been violated."""
        if checker.violations:
            return
        for name, vehicle in self._missing(road) if self.healed else ():
            text = f"in {vehicle.cell}, prefers lane {vehicle.preferred_lane}"
            checker.stuck(now_s, name, text)
        if not self._rolling or checker.violations:
            return
        for name, vehicle in road.vehicles.items():
            if _stands(vehicle):
                checker.stuck(now_s, name, "it stands before the end of its lane")
        if road.vehicles and road.t_s > MIN_ROAD_S and not self._planned_slots:
            checker.stuck(now_s, next(iter(road.vehicles)), "no slot is planned")

    def _missing(self, road: LightRoad) -> list[tuple[Name, LightVehicle]]:
        """Return the vehicles on the lattice that should have arrived, but have not."""
        return [
            (name, vehicle)
            for name, vehicle in road.vehicles.items()
            if not _stands(vehicle)
            and (
                (vehicle.cell[1] != vehicle.preferred_lane and name not in self._free)
                or not vehicle.body.has_arrived(road.t_s)
            )
            and not (
                self._rolling and (name in self._moved or self._proposed[name] < MAX_FUTILE_PLANS)
            )
        ]


def _stands(vehicle: LightVehicle) -> bool:
    """Return whether a vehicle has stopped before the end of its lane."""
    return not vehicle.has_cell
