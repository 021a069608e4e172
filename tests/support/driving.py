"""Vehicles in closed loop, without network and SUMO, and what is measured of their true motion.

A `Road` carries the bridge's vehicles (body, motion controller, sensors), each driven by an agent's
real driver. A tick is what it is in a run: sense, begin a move, drive, COMMAND, step, and look
around. There is no protocol: the caller decides when moves begin and when messages stop.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from math import inf
from typing import Any

import numpy as np
from attrs import define, field, frozen
from numpy.typing import NDArray

from laneweave.agents.driving.driver import TrackingDriver
from laneweave.protocol.config.scenario_files import load_scenario
from laneweave.protocol.lattice import Cell, PlannedMove, stretch_of
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.vehicle_tables import Vehicle
from laneweave.protocol.vehicle.motion import State, cell_state
from laneweave.protocol.wire.messages import Command, Motion, Name, VehicleRecord
from laneweave.sim_bridge.bodies.motion_controller import FallbackLevel
from laneweave.sim_bridge.bodies.overlaps_and_gaps import Bodies, Pose, pose_of
from laneweave.sim_bridge.bodies.plant import Plant
from laneweave.sim_bridge.road.vehicle import RoadVehicle
from support.paper import paper
from support.road_vehicles import vehicle_in

Array = NDArray[np.float64]

ROUNDING = 1e-6
"""An excess over a limit that is rounding [m/s, m/s2, m/s3]."""


def road_scenario(seed: int, mode: int = 1, lanes: int = 3) -> Scenario:
    """Return the paper's scenario with another seed, relative motion mode and number of lanes."""
    return paper(load_scenario(None, seed=seed, formation__mode=mode, road__lanes=lanes))


# --- the road -------------------------------------------------------------------------------------


@define
class Driven:
    """A vehicle and what drives it."""

    vehicle: RoadVehicle
    driver: TrackingDriver
    hold_cell: Cell
    moving: bool = False


@define
class Record:
    """What is true of all bodies at the beginning of each tick, and at the end of the last one."""

    states: list[list[State]] = field(factory=list)
    """By tick, then vehicle: (s, v, a, y, v_y, a_y) in m and s."""
    exempt: list[list[bool]] = field(factory=list)
    """By tick, then vehicle: it brakes in emergency in this tick, past its jerk limit."""
    gaps_m: list[float] = field(factory=list)
    """By tick: least gap of two bodies that overlap laterally; infinite if there are none."""
    overlaps: list[tuple[int, str, str]] = field(factory=list)
    """(tick, lesser name, greater name)."""


class Road:
    """Vehicles on the lattice; all of them are at rest in their cells at tick 0."""

    def __init__(self, scenario: Scenario, cells: Mapping[Name, Cell]) -> None:
        """Put vehicles into cells; `scenario.road.lanes` must be enough for them."""
        self.scenario = scenario
        self.move_ticks = scenario.timing.move_ticks(scenario.timing.cycles_s[0])
        """How long each move takes."""
        self.tick = 0
        self.messages = True
        """Whether messages arrive; otherwise motion controllers continue with what they have."""
        self.broadcast = True
        """Whether vehicles publish their motions."""
        self.late = 0
        """Moves that began before the one under way had ended."""
        self.record = Record()
        self._emergencies: set[Name] = set()
        """Vehicles that brake past the jerk limit, or have not recovered from that."""
        self.driven: dict[Name, Driven] = {}
        for name, cell in cells.items():
            vehicle = vehicle_in(cell, name, scenario, exact=False)
            self.driven[vehicle.name] = Driven(
                vehicle, TrackingDriver(scenario, scenario.vehicle), cell
            )
        self.vehicles = {name: one.vehicle for name, one in self.driven.items()}
        self._show()
        for one in self.driven.values():
            one.driver.take_over(one.vehicle.sense(0, caretaker=False))

    @property
    def braked(self) -> int:
        """Vehicle ticks of emergency braking by motion controllers."""
        return sum(
            vehicle.controller.level_ticks[FallbackLevel.EMERGENCY]
            for vehicle in self.vehicles.values()
        )

    @property
    def unusable(self) -> int:
        """Solutions of trackers that could not be used."""
        return sum(one.driver.solver_stats.unusable for one in self.driven.values())

    def step(
        self, begins: Mapping[Name, PlannedMove] | None = None, braking: Collection[Name] = ()
    ) -> None:
        """Go on by one tick.

        Args:
            begins: moves that begin with this tick; none without messages.
            braking: vehicles that brake as hard as they can, whatever their commands.
        """
        if self.messages:
            for name, one in self.driven.items():
                self._drive(one, (begins or {}).get(name))
            if self.broadcast:
                self._publish_motions()
        exempt = []
        for name, vehicle in self.vehicles.items():
            plant = vehicle.controller.plant
            before = name in self._emergencies
            if name in braking:
                plant.brake(0.0)
            else:
                vehicle.step(self.tick)
            braked = name in braking or vehicle.controller.level is FallbackLevel.EMERGENCY
            if braked:
                self._emergencies.add(name)
            elif not recovering(plant, self.scenario.vehicle):
                self._emergencies.discard(name)
            exempt.append(before or name in self._emergencies)
        self.record.exempt.append(exempt)
        self.tick += 1
        self._show()

    def _drive(self, one: Driven, move: PlannedMove | None) -> None:
        """Take the SENSE and answer with a COMMAND, as its agent does."""
        sense = one.vehicle.sense(self.tick, caretaker=False)
        one.moving = one.moving and not one.driver.at_rest(sense)
        if move is not None:
            self.late += one.moving
            one.driver.begin(move, self.tick, self.move_ticks)
            one.moving, one.hold_cell = True, move[2]
        drive = one.driver.drive(sense, moving=one.moving)
        command = Command(
            vehicle=one.vehicle.name,
            record=VehicleRecord(incarnation=1),
            tick=self.tick,
            hold_cell=one.hold_cell,
            motion=drive.motion,
            jerks=drive.jerks,
        )
        if not one.vehicle.controller.accept_command(command):
            raise RuntimeError(f"the motion controller refused {command}")

    def _publish_motions(self) -> None:
        """Publish motions to the other vehicles, as agents do after a tick."""
        for name, one in self.driven.items():
            course = one.driver.motion(self.tick)
            if course is None:
                continue
            motion = Motion(name, 1, stretch_of(course[0][0]), *course, self.tick)
            for other, listener in self.driven.items():
                if other != name:
                    listener.driver.on_motion(motion)

    def _show(self) -> None:
        road, size = self.scenario.road, self.scenario.vehicle
        poses: dict[str, Pose] = {name: pose_of(one.state) for name, one in self.vehicles.items()}
        bodies = Bodies(poses, size.length_m, size.width_m)
        record = self.record
        record.states.append([one.controller.plant.state for one in self.vehicles.values()])
        record.gaps_m.append(bodies.min_gaps().gap_m)
        record.overlaps += [(self.tick, *pair) for pair in bodies.overlapping_pairs()]
        accels_mps2: dict[str, float] = {name: one.state[2] for name, one in self.vehicles.items()}
        around = bodies.exact_neighbours(road.lanes, road.lane_width_m, accels_mps2)
        for name, vehicle in self.vehicles.items():
            vehicle.perceive(around[name])


def recovering(plant: Plant, limits: Vehicle) -> bool:
    """Return whether a body's acceleration changes faster than the jerk limit, after braking."""
    lag = limits.max_jerk_mps3 * limits.actuator_lag_s
    return abs(plant.setpoint[0] - plant.state[2]) > lag + 1e-6


# --- what is measured -----------------------------------------------------------------------------


@frozen
class LimitUse:
    """How much of one limit was used."""

    excess: float
    """Largest excess over the limit, in its unit; negative: what was left of it."""
    violations: int
    """Vehicle ticks with an excess."""


def limit_figures(uses: Sequence[Mapping[str, LimitUse]]) -> dict[str, dict[str, Any]]:
    """Return violations and the largest excess (None: nothing counted) of several runs by limit."""
    excess = {name: max(use[name].excess for use in uses) for name in uses[0]}
    return {
        "violations": {name: sum(use[name].violations for use in uses) for name in uses[0]},
        "excess": {name: most if most > -inf else None for name, most in excess.items()},
    }


def limit_use(
    record: Record, scenario: Scenario, only: Sequence[int] | None = None
) -> dict[str, LimitUse]:
    """Return by name how the limits of motion were kept.

    Jerk is the change of the true acceleration in a tick, divided by the tick; it does not count
    in ticks of emergency braking.

    Args:
        record: of a road.
        scenario: its limits.
        only: numbers of the vehicles that count, in the order of the road; None: all.
    """
    states, exempt = np.array(record.states), np.array(record.exempt)
    if only is not None:
        states, exempt = states[:, only], exempt[:, only]
    limits, tick_s = scenario.vehicle, scenario.runtime.tick_s
    _, v, a, _, v_y, a_y = np.moveaxis(states, 2, 0)
    jerk = np.abs(np.diff(a, axis=0)) / tick_s
    lateral_jerk = np.abs(np.diff(a_y, axis=0)) / tick_s
    excesses = {
        "speed_mps": np.maximum(-v, v - limits.max_speed_mps),
        "accel_mps2": np.maximum(limits.min_accel_mps2 - a, a - limits.max_accel_mps2),
        "jerk_mps3": np.where(exempt, -inf, jerk - limits.max_jerk_mps3),
        "lateral_accel_mps2": np.abs(a_y) - limits.max_lateral_accel_mps2,
        "lateral_jerk_mps3": np.where(exempt, -inf, lateral_jerk - limits.max_lateral_jerk_mps3),
        "slip_mps": np.abs(v_y) - limits.max_slip_ratio * v,
    }
    return {
        name: LimitUse(float(excess.max()), int((excess > ROUNDING).sum()))
        for name, excess in excesses.items()
    }


def lattice_errors_m(
    record: Record, scenario: Scenario, ticks: Sequence[int], cells: Sequence[Sequence[Cell]]
) -> Array:
    """Return how far bodies are from where the lattice wants them, (ticks, vehicles, 2) [m].

    Args:
        record: of a road.
        scenario: its lattice.
        ticks: when.
        cells: by tick, then vehicle in the order of the road: whose lattice point counts.

    Returns:
        Distances along and across, >= 0.
    """
    lattice, tick_s = scenario.lattice, scenario.runtime.tick_s
    errors = np.zeros((len(ticks), len(cells[0]) if cells else 0, 2))
    for row, (tick, each) in enumerate(zip(ticks, cells, strict=True)):
        for column, (state, cell) in enumerate(zip(record.states[tick], each, strict=True)):
            goal = cell_state(lattice, cell, tick * tick_s)
            errors[row, column] = abs(state[0] - goal[0]), abs(state[3] - goal[3])
    return errors
