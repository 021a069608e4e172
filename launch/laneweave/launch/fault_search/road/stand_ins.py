"""Fast stand-ins for the costly parts of a run: bodies, trajectory drivers, the rolling planner.

Safety does not depend on any of them.
"""

from __future__ import annotations

import math
import random
from collections.abc import Collection, Mapping, Sequence

import attrs
from attrs import frozen
from msgspec.structs import replace

from laneweave.agents.driving.driver import Drive, SolverStats
from laneweave.coordinator.planning.rolling.problem import (
    NO_ENDS,
    CellPath,
    StreamPlan,
    StreamVehicle,
)
from laneweave.coordinator.rolling.checked_planner import stream_road
from laneweave.protocol.lattice import Cell, PlannedMove, displacements, footprint
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.vehicle_tables import Vehicle
from laneweave.protocol.vehicle.motion import State, at_rest_in_cell
from laneweave.protocol.wire.messages import CAR, Motion, Name, Sense
from laneweave.sim_bridge.bodies.motion_controller import MotionController
from laneweave.sim_bridge.bodies.plant import Plant
from laneweave.sim_bridge.road.entry import Admission
from laneweave.sim_bridge.road.vehicle import RoadVehicle

UNNEEDED_MOVES = 0.4
"""Probability with which the planner moves a vehicle that is in its preferred lane."""
SYNC_S = 1.0
"""Interval at which a vehicle's clock is synchronized; it drifts in between."""


@frozen
class Visit:
    """A vehicle's entry cell, entry and exit times, and clock errors."""

    vehicle: Name
    cell: Cell
    """Cell in which the vehicle enters; at the real roadside, only its lane counts."""
    enters_s: float
    """Time of entry, or of arrival at the real roadside."""
    leaves_s: float | None
    """Exit time; None: the vehicle stays until the end of the road."""
    clock_offset_s: float = 0.0
    clock_drift: float = 0.0
    """Error of the clock rate: seconds gained per second."""
    vehicle_type: str = CAR


class LightBody(Plant):
    """Body that moves straight from cell to cell in given times."""

    def __init__(self, scenario: Scenario, limits: Vehicle, cell: Cell) -> None:
        """Start at rest in a cell."""
        super().__init__((0.0, 0.0, 0.0, 0.0, 0.0, 0.0), limits, scenario.runtime.tick_s)
        self.t_s = 0.0
        """Time of the newest tick."""
        self._lattice = scenario.lattice
        self._origin: tuple[float, float] = cell
        self._goal: Cell = cell
        self._begin_s = self._end_s = 0.0
        self._stop_m = math.inf
        """Position at which the body waits; infinite while it is on the lattice."""

    @property
    def state(self) -> State:
        """(s m, v m/s, a m/s2, y m, v_y m/s, a_y m/s2) at the newest tick."""
        column, lane = self._place(self.t_s)
        lattice = self._lattice
        s_m = lattice.speed_mps * self.t_s + column * lattice.pitch_m
        y_m = (lane + 0.5) * lattice.lane_width_m
        if s_m >= self._stop_m:
            return (self._stop_m, 0.0, 0.0, y_m, 0.0, 0.0)
        return (s_m, lattice.speed_mps, 0.0, y_m, 0.0, 0.0)

    def go(self, cell: Cell, now_s: float, lasts_s: float) -> None:
        """Begin a motion to a cell from the current position."""
        self._origin, self._goal = self._place(now_s), cell
        self._begin_s, self._end_s = now_s, now_s + lasts_s

    def stop_at(self, s_m: float) -> None:
        """Drive on to a position, and wait there."""
        self._stop_m = s_m

    def drive_out(self, cell: Cell, now_s: float, lasts_s: float) -> None:
        """Begin a motion from the place where the body waits to a cell."""
        column = (self._stop_m - self._lattice.speed_mps * now_s) / self._lattice.pitch_m
        self._origin, self._goal = (column, self._goal[1]), cell
        self._begin_s, self._end_s = now_s, now_s + lasts_s
        self._stop_m = math.inf

    def has_arrived(self, now_s: float) -> bool:
        """Return whether the body is in the centre of its target cell."""
        return now_s >= self._end_s

    def _place(self, t_s: float) -> tuple[float, float]:
        if t_s >= self._end_s:
            return self._goal
        share = (t_s - self._begin_s) / (self._end_s - self._begin_s)
        (column, lane), (to_column, to_lane) = self._origin, self._goal
        return (column + share * (to_column - column), lane + share * (to_lane - lane))


class LightVehicle(RoadVehicle):
    """Vehicle with a simplified body, its own clock and a variable preferred lane."""

    def __init__(
        self, visit: Visit, admission: Admission, scenario: Scenario, bridge: int = 0
    ) -> None:
        """Start at rest in the cell of the admission."""
        own = scenario.types[admission.arrival.vehicle_type]
        self.drivable = own.moves
        """Moves (columns, lanes) that the type of the vehicle drives."""
        self.body = LightBody(scenario, own.limits, admission.cell)
        super().__init__(
            visit.vehicle,
            admission,
            MotionController(self.body, scenario, admission.cell),
            bridge=bridge,
        )
        self.controller.enter_lattice((admission.cell,))
        if not scenario.formation.closes_by_vehicles:
            self.formation = self.controller.record.joined[0]
        self.clock_jump_s = 0.0
        """Error of the vehicle's clock by jumps, in addition to that of the visit."""
        self.latest_s = 0.0
        """Latest road time that the vehicle's clock has shown."""
        self._visit = visit
        self._speed_mps = scenario.lattice.speed_mps

    @property
    def preferred_lane(self) -> int:
        """Preferred lane."""
        return self.admission.arrival.preferred_lane

    def leaves_by(self, t_s: float) -> bool:
        """Return whether the vehicle leaves the road by a given time."""
        return self._visit.leaves_s is not None and t_s >= self._visit.leaves_s

    def prefer(self, lane: int) -> None:
        """Change the preferred lane."""
        arrival = attrs.evolve(self.admission.arrival, preferred_lane=lane)
        self.admission = attrs.evolve(self.admission, arrival=arrival)

    def sense(self, tick: int, *, caretaker: bool, left: bool = False) -> Sense:
        """Return the SENSE message as seen by the vehicle's own clock.

        The vehicle knows its position in the lattice from its neighbours: a wrong clock makes it
        act early or late, but does not shift its cell.
        """
        sense = super().sense(tick, caretaker=caretaker, left=left)
        visit = self._visit
        drifted_s = visit.clock_offset_s + visit.clock_drift * (sense.t_s % SYNC_S)
        ahead_s = max(drifted_s + self.clock_jump_s, -sense.t_s)
        self.latest_s = max(self.latest_s, sense.t_s + ahead_s)
        if ahead_s == 0.0:
            return sense
        s, v, a, y, v_y, a_y = sense.measured
        state = (s + self._speed_mps * ahead_s, v, a, y, v_y, a_y)
        return replace(sense, t_s=sense.t_s + ahead_s, measured=state)


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
        self._origin, self._goal = sense.motion_origin, sense.hold_cell
        self._end_tick, self._ticks = sense.motion_end_tick, sense.motion_ticks

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
        return Drive(end_tick, self._origin, self._ticks, b"")

    def motion(self, tick: int) -> None:
        """Publish no motion; motions would only slow down the search."""

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
        ends_m: Mapping[int, float] = NO_ENDS,
    ) -> StreamPlan:
        """Return the cells of all vehicles at the start and the end of the next slot."""
        del before, ends_m
        rng = random.Random(f"{self._seed}/{slot}")  # noqa: S311 (simulation, no secrets)
        taken = {vehicle.cell for vehicle in vehicles} | set(blocked)
        paths: dict[str, CellPath] = {vehicle.vehicle: (vehicle.cell,) for vehicle in vehicles}
        in_order = sorted(vehicles, key=lambda one: (not self._away(one, one.cell), rng.random()))
        for vehicle in in_order:
            arrived = not self._away(vehicle, vehicle.cell)
            if vehicle.held or (arrived and rng.random() > UNNEEDED_MOVES):
                continue
            target = self._target(slot, vehicle, taken, rng)
            if target is not None:
                paths[vehicle.vehicle] = (vehicle.cell, target)
                taken |= footprint(vehicle.cell, target)
        return StreamPlan(slot, paths, ())

    def _target(
        self, slot: int, vehicle: StreamVehicle, taken: set[Cell], rng: random.Random
    ) -> Cell | None:
        column, lane = vehicle.cell
        cells = [(column + along, lane + across) for along, across in self._steps]
        free = [
            cell
            for cell in cells
            if 0 <= cell[1] < self._lanes
            and vehicle.drives(cell[0] - column, cell[1] - lane)
            and all(self._is_open(slot, vehicle.cell, cell, each) for each in (lane, cell[1]))
            and not (self._some_end and self._road.has_left(slot + 1, cell))
            and taken.isdisjoint(footprint(vehicle.cell, cell) - {vehicle.cell})
        ]
        if not free:
            return None
        return min(free, key=lambda cell: (self._away(vehicle, cell), rng.random()))

    def _is_open(self, slot: int, origin: Cell, target: Cell, lane: int) -> bool:
        """Return whether a move stays where moves are possible in a lane, if it is an edge."""
        if lane not in self._edges:
            return True
        road = self._road
        rear_m = road.position_m(slot, min(origin[0], target[0])) - road.body_m
        return road.is_open(lane, rear_m, road.position_m(slot + 1, max(origin[0], target[0])))

    def _away(self, vehicle: StreamVehicle, cell: Cell) -> int:
        """Return the number of lanes from a cell to the nearest target."""
        return min(abs(cell[1] - self._sections[number].lane) for number in vehicle.targets)
