"""One vehicle loses speed for a moment: how the disturbance travels to the other vehicles.

Real agents, coordinator, motion controllers, sensors and bodies on the simulated network, without
SUMO. The disturbance is physical: for two seconds the actuators of one vehicle follow a set-point
of their own, whatever its motion controller commands; then the vehicle drives by its agent again.
What is measured is how far each body is from a body that follows its reference exactly: the lattice
point of its cell, or the trajectory of the move under way.

`column`: one lane, vehicles in consecutive cells, all on the lane that they need. The foremost one
is disturbed while all hold their cells.
`switching`: three lanes, the paper's formations; vehicles change to the lanes that they need. The
first one that changes lanes is disturbed in the middle of it.
`rolling`: likewise in the rolling operation, at 2000 vehicles/(lane h).
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from attrs import define, field, frozen
from numpy.typing import NDArray

from laneweave.agents.driving.reference import Reference
from laneweave.protocol.config.scenario_files import parse_scenario
from laneweave.protocol.lattice import Cell
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.vehicle_tables import Vehicle
from laneweave.protocol.transports.simulated.virtual_time import Conditions
from laneweave.protocol.vehicle.motion import ARRIVED_ALONG_M, State, cell_state
from laneweave.protocol.wire.messages import Name
from laneweave.sim_bridge.bodies.motion_controller import FallbackLevel, MotionController
from laneweave.sim_bridge.bodies.overlaps_and_gaps import Bodies, pose_of
from laneweave.sim_bridge.bodies.plant import Plant
from laneweave.sim_bridge.road.demand import Arrival
from support.bridge_bench import Street

Array = NDArray[np.float64]

FORMATIONS = ("column", "switching", "rolling")
BRAKING_S = 2.0
MEASURED_S = {"column": 30.0, "switching": 15.0, "rolling": 20.0}
"""How long each formation is measured, from the beginning of the disturbance on."""
HOLDING_S = 5.0
"""The column holds for this long before the disturbance."""
ROLLING_VEH_PER_LANE_H = 2000.0
IN_MOVE_S = 1.0
"""A lane change is this old when its vehicle is disturbed."""


@frozen
class Case:
    """A situation that is driven once."""

    formation: str
    drop_mps: float = 3.0
    """Speed that the vehicle loses; 0: nothing happens."""
    loss: float = 0.0
    """Share of all messages that is lost, at each receiver."""
    seed: int = 1
    vehicles: int = 12

    @property
    def scenario(self) -> Scenario:
        """The default scenario, with one lane for the column.

        Only the rolling operation lets vehicles enter consecutive cells of a lane; the switching
        formations are the paper's.
        """
        operation = "paper" if self.formation == "switching" else "rolling"
        tables: dict[str, dict[str, Any]] = {"formation": {"operation": operation}}
        if self.formation == "column":
            tables["road"] = {"lanes": 1}
        return parse_scenario({"seed": self.seed, **tables})

    def arrivals(self) -> list[Arrival]:
        """Return the arrivals, each with a cell that can be entered."""
        scenario = self.scenario
        lanes, spacing_s = scenario.road.lanes, scenario.formation.entry_spacing_s
        rng = np.random.default_rng(self.seed)
        cells: Iterator[int] = itertools.count()
        if self.formation == "rolling":
            share = ROLLING_VEH_PER_LANE_H * spacing_s / 3600.0
            draws = np.random.default_rng([self.seed, 1])
            cells = (cell for cell in cells if draws.random() < share)
        return [
            Arrival(
                f"v{number + 1:02}",
                cell % lanes,
                int(rng.integers(lanes)),
                (cell // lanes + 1) * spacing_s,
            )
            for number, cell in enumerate(itertools.islice(cells, self.vehicles))
        ]


class DisturbedPlant(Plant):
    """A body whose actuators can be made to follow a set-point of their own."""

    def __init__(self, state: State, limits: Vehicle, tick_s: float) -> None:
        """Obey the motion controller until a set-point is forced."""
        super().__init__(state, limits, tick_s)
        self.forced_mps2: float | None = None
        """Longitudinal acceleration that is forced; None: none."""
        self._length_s = tick_s

    def step(self, jerk_s: float, jerk_y: float, *, parks: bool = False) -> State:
        """Move on by one tick; the forced acceleration replaces the longitudinal jerk."""
        if self.forced_mps2 is not None:
            jerk_s = (self.forced_mps2 - self.setpoint[0]) / self._length_s
        return super().step(jerk_s, jerk_y, parks=parks)


@define
class Ideal:
    """A body that follows the references of one vehicle exactly, lag of actuators included."""

    scenario: Scenario
    _tick: int = 0
    _motion: tuple[Cell, Cell] | None = None
    _reference: Reference = field(init=False)
    _plant: Plant = field(init=False)

    def at(self, controller: MotionController, tick: int) -> State:
        """Return its state at a tick, given what the motion controller knows of the motion."""
        scenario, motion = self.scenario, (controller.motion.origin, controller.hold_cell)
        tick_s = scenario.runtime.tick_s
        if motion != self._motion:
            self._motion, (origin, target) = motion, motion
            self._tick = tick
            self._reference = Reference.hold(scenario, scenario.vehicle, target)
            if origin != target:
                ticks = controller.motion.ticks
                self._tick = controller.motion.end_tick - ticks
                self._reference = Reference.move(
                    scenario, scenario.vehicle, origin, target, self._tick, ticks
                )
            start = cell_state(scenario.lattice, origin, self._tick * tick_s)
            self._plant = Plant(start, scenario.vehicle, tick_s)
        while self._tick < tick:
            self._plant.step(*self._reference.window(self._tick).jerks[0].tolist())
            self._tick += 1
        return self._plant.state


@frozen(eq=False)
class Response:
    """What was measured; vehicles are the disturbed one and those behind it, nearest first."""

    times_s: Array
    """(T,), 0: the disturbance begins."""
    position_m: Array
    """(T, V): position less that of a body that follows the reference exactly."""
    speed_mps: Array
    """(T, V): likewise."""
    accel_mps2: Array
    """(T, V): likewise."""
    gap_m: Array
    """(T, V): likewise of the gap to the body ahead in the lane; 0 where there is none."""
    least_gap_m: float
    """Between two bodies that overlap laterally; infinite: there were none."""
    overlaps: int
    braked: int
    """Vehicle ticks of emergency braking by motion controllers."""
    moves: int
    """Moves that began while it was measured."""

    @property
    def back_s(self) -> float:
        """Time from which all bodies stay within reach of their references; infinite: none."""
        away = np.flatnonzero((np.abs(self.position_m) > ARRIVED_ALONG_M).any(axis=1))
        times_s = [*self.times_s.tolist(), np.inf]
        return times_s[away[-1] + 1] if away.size else 0.0


@define
class _Run:
    """A case while it is driven."""

    case: Case
    street: Street
    begin_tick: int | None = None
    disturbed: Name | None = None
    bodies: dict[Name, tuple[DisturbedPlant, Ideal]] = field(factory=dict)
    rows: list[dict[Name, tuple[State, State]]] = field(factory=list)
    """For each tick, by vehicle: the true state and that of the ideal body."""
    motions: set[tuple[Name, Cell, Cell]] = field(factory=set)
    least_gap_m: float = np.inf
    overlaps: int = 0
    braked: int = 0
    _tick: int = -1
    _over: bool = False

    def look(self) -> bool:
        """Look at all bodies once in each tick; return whether all has been measured."""
        bridge, scenario = self.street.bridge, self.street.scenario
        if bridge.tick == self._tick or self._over:
            return self._over
        self._tick, tick_s = bridge.tick, scenario.runtime.tick_s
        row: dict[Name, tuple[State, State]] = {}
        for name, vehicle in bridge.vehicles.items():
            controller = vehicle.controller
            if name not in self.bodies:
                plant = DisturbedPlant(vehicle.state, scenario.vehicle, tick_s)
                controller.plant = plant
                self.bodies[name] = plant, Ideal(scenario)
            row[name] = vehicle.state, self.bodies[name][1].at(controller, self._tick)
        self._begin()
        if self.begin_tick is None or self._tick < self.begin_tick:
            return False
        since_s = (self._tick - self.begin_tick) * tick_s
        drop_mps, plant = self.case.drop_mps, self.bodies[Name(str(self.disturbed))][0]
        plant.forced_mps2 = -drop_mps / BRAKING_S if drop_mps and since_s < BRAKING_S else None
        self.rows.append(row)
        self._watch()
        self._over = since_s >= MEASURED_S[self.case.formation]
        return self._over

    def _begin(self) -> None:
        """Decide when which vehicle is disturbed, as soon as that can be known."""
        bridge, tick_s = self.street.bridge, self.street.scenario.runtime.tick_s
        if self.begin_tick is not None:
            return
        if self.case.formation == "column":
            if len(bridge.vehicles) == self.case.vehicles:
                self.disturbed = next(iter(bridge.vehicles))
                self.begin_tick = self._tick + round(HOLDING_S / tick_s)
            return
        for name, vehicle in bridge.vehicles.items():
            origin, target = vehicle.controller.motion.origin, vehicle.controller.hold_cell
            if origin[0] == target[0] and origin[1] != target[1]:
                self.disturbed, self.begin_tick = name, self._tick + round(IN_MOVE_S / tick_s)
                return

    def _watch(self) -> None:
        vehicles, size = self.street.bridge.vehicles, self.street.scenario.vehicle
        poses = {str(name): pose_of(one.state) for name, one in vehicles.items()}
        bodies = Bodies(poses, size.length_m, size.width_m)
        self.least_gap_m = min(self.least_gap_m, bodies.min_gaps().gap_m)
        self.overlaps += len(bodies.overlapping_pairs())
        self.braked += sum(
            one.controller.level is FallbackLevel.EMERGENCY for one in vehicles.values()
        )
        self.motions |= {
            (name, one.controller.motion.origin, one.controller.hold_cell)
            for name, one in vehicles.items()
            if one.controller.motion.origin != one.controller.hold_cell
        }

    def response(self) -> Response:
        """Return what was measured."""
        first = self.rows[0]
        own_s_m = first[Name(str(self.disturbed))][0][0]
        names = sorted(
            (name for name, (state, _) in first.items() if state[0] <= own_s_m),
            key=lambda name: -first[name][0][0],
        )
        states = np.array([[row[name] for name in names] for row in self.rows])
        true, ideal = states[:, :, 0], states[:, :, 1]
        errors = true - ideal
        return Response(
            times_s=self.street.scenario.runtime.tick_s
            * np.arange(len(self.rows), dtype=np.float64),
            position_m=errors[:, :, 0],
            speed_mps=errors[:, :, 1],
            accel_mps2=errors[:, :, 2],
            gap_m=_gap_errors(errors[:, :, 0], ideal, self.street.scenario.vehicle.width_m),
            least_gap_m=self.least_gap_m,
            overlaps=self.overlaps,
            braked=self.braked,
            moves=len(self.motions),
        )


def _gap_errors(position_m: Array, ideal: Array, width_m: float) -> Array:
    """Return errors (T, V) of the gap to the nearest ideal body ahead that overlaps laterally."""
    s, y = ideal[:, :, 0], ideal[:, :, 3]
    ahead_m = s[:, None, :] - s[:, :, None]
    in_line = np.abs(y[:, None, :] - y[:, :, None]) < width_m
    ahead_m = np.where((ahead_m > 0.0) & in_line, ahead_m, np.inf)
    nearest = ahead_m.argmin(axis=2)
    error = np.take_along_axis(position_m, nearest, axis=1) - position_m
    return np.where(np.isfinite(ahead_m.min(axis=2)), error, 0.0)


def respond(case: Case) -> Response:
    """Drive a case and return what was measured."""
    with TemporaryDirectory() as folder:
        street = Street(
            case.scenario, Path(folder), case.arrivals(), Conditions(loss=case.loss), seed=case.seed
        )
        street.start_coordinators()
        street.start_shard()
        run = _Run(case, street)
        street.run(run.look)
    return run.response()
