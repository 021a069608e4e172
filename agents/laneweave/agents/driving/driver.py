"""The driver: computes the jerks with which the motion controller holds a cell or makes a move.

It plans a reference through the lattice points (`reference`) and tracks it (`tracker`). If a
solution is unusable, the driver returns no jerks, and the motion controller continues with the last
usable trajectory and its fallbacks (`sim_bridge.bodies.motion_controller`). The driver is
independent of the protocol.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Protocol

import numpy as np
from attrs import define, frozen

from laneweave.agents.driving.motions import REPEAT_TICKS
from laneweave.agents.driving.reference import Reference
from laneweave.agents.driving.stop_lines import StopLines
from laneweave.agents.driving.surroundings import Surroundings
from laneweave.agents.driving.tracker import Tracker
from laneweave.agents.driving.tracking_problem import NO_GAPS
from laneweave.protocol.lattice import Cell, PlannedMove
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.vehicle_tables import Vehicle
from laneweave.protocol.vehicle.lane_ends import LaneEnds
from laneweave.protocol.vehicle.motion import (
    State,
    at_rest_in_cell,
    cell_state,
    commanded_state,
    nearly_settled,
)
from laneweave.protocol.wire.messages import CurrentMotion, Motion, Sense

_FLOAT32 = np.dtype("<f4")
Course = tuple[Cell, Cell, int, int]
"""(origin, target, first tick, ticks) of a motion, as published to other vehicles."""


@define  # created at each tick: frozen objects take three times as long
class Drive:
    """Output to the motion controller at one tick."""

    motion: CurrentMotion
    """Its end is 0 if the vehicle holds."""
    jerks: bytes
    """Little-endian float32 pairs (along, across) [m/s3], one per tick of the horizon; empty if no
    solution is usable."""
    free: bool = False
    """Whether the vehicle is at rest in its cell, and follows its own reference."""


@frozen
class SolverStats:
    """Solve counters and solve times."""

    solves: int = 0
    unusable: int = 0
    osqp_solves: int = 0
    """Solves in which OSQP ran."""
    solve_ms: bytes = b""
    """CPU time of each solve [ms], as little-endian float32."""


class Driver(Protocol):
    """Drives one vehicle; agents use `TrackingDriver`, the fault search a cheaper driver."""

    def take_over(self, sense: Sense) -> None:
        """Continue the motion controller's current motion."""

    def begin(self, move: PlannedMove, tick: int, ticks: int) -> None:
        """Begin a move at `tick` that lasts `ticks` ticks."""

    def at_rest(self, sense: Sense) -> bool:
        """Return whether the current motion is complete."""

    def drive(self, sense: Sense, *, moving: bool) -> Drive:
        """Return the motion and the jerks from this tick on."""

    def motion(self, tick: int) -> Course | None:
        """Return the motion to publish at a tick, or None if none is due."""

    def on_motion(self, motion: Motion) -> None:
        """Handle another vehicle's announced motion."""

    def close(self, lane_ends: LaneEnds) -> None:
        """Replace the ends of lanes: parts of lanes are closed for a time."""

    @property
    def solver_stats(self) -> SolverStats:
        """Solve counters and solve times."""


class TrackingDriver:
    """Driver that tracks a reference at each tick."""

    def __init__(
        self,
        scenario: Scenario,
        limits: Vehicle,
        stopwatch: Callable[[], float] = time.thread_time,
    ) -> None:
        """Make a driver without a reference; call `take_over` first.

        Args:
            scenario: lattice, timing, sizes of other vehicles.
            limits: those of the vehicle's type.
            stopwatch: clock [s] that measures how long solves take.
        """
        self._own, self._limits = (scenario, limits), limits
        self._room_ahead_m = scenario.types.room_ahead_m
        self._tracker = Tracker(scenario, limits, stopwatch)
        self._shortcut = scenario.tracking.shortcut
        self._reference: Reference | None = None
        self._settling: Reference | None = None
        """The reference with which the vehicle settles in the cell in which it has entered."""
        self._origin: Cell = (0, 0)
        """Cell in which the newest motion began; the goal once that motion has ended."""
        self._goal: Cell = (0, 0)
        self._durations = scenario.timing.move_durations
        self._ticks = 0
        """Duration of the newest move [ticks]."""
        self._lattice = scenario.lattice
        self._speed_mps = scenario.lattice.speed_mps
        self._surroundings = Surroundings(scenario, limits)
        self._stop_lines = StopLines(scenario, limits)
        self._solve_ms: list[float] = []
        self._unusable = self._osqp_solves = 0

    @property
    def solver_stats(self) -> SolverStats:
        """Solve counters and solve times."""
        solve_ms = np.array(self._solve_ms, dtype=_FLOAT32).tobytes()
        return SolverStats(len(self._solve_ms), self._unusable, self._osqp_solves, solve_ms)

    def take_over(self, sense: Sense) -> None:
        """Continue the motion controller's current motion."""
        self._origin = self._goal = sense.hold_cell
        self._settling, motion = None, sense.motion
        (column, lane), (origin_column, origin_lane) = sense.hold_cell, motion.origin
        is_move = max(abs(column - origin_column), abs(lane - origin_lane)) <= 1
        if motion.origin == sense.hold_cell and motion.end_tick > sense.tick + 3:
            commanded = self._commanded(sense)
            self._reference = self._settling = Reference.settling(
                *self._own, sense.hold_cell, commanded, sense.tick, motion.end_tick
            )
        elif is_move and motion.end_tick > sense.tick and motion.ticks in self._durations:
            begin_tick = motion.end_tick - motion.ticks
            self.begin((0, motion.origin, sense.hold_cell), begin_tick, motion.ticks)
        else:
            self._reference = Reference.hold(*self._own, sense.hold_cell)

    def begin(self, move: PlannedMove, tick: int, ticks: int) -> None:
        """Begin a move at `tick` that lasts `ticks` ticks."""
        self._reference = Reference.move(*self._own, move[1], move[2], tick, ticks)
        # The same move may begin again, if the command with its beginning was lost.
        if self._settling is not None and self._settling.origin == move[1]:
            self._reference.settle_meanwhile(self._settling)
        self._origin, self._goal, self._ticks = move[1], move[2], ticks

    def at_rest(self, sense: Sense) -> bool:
        """Return whether the motion's time has passed and the body has arrived.

        One that settles may still fall back to its cell if others have the room.
        """
        reference, room_ahead_m = self._current, self._room_ahead_m
        measured, lattice, goal, t_s = sense.measured, self._lattice, self._goal, sense.t_s
        if room_ahead_m > 0.0 and reference.origin == goal:
            return nearly_settled(measured, lattice, goal, t_s, room_ahead_m)
        return sense.tick >= reference.rest_tick and at_rest_in_cell(measured, lattice, goal, t_s)

    def drive(self, sense: Sense, *, moving: bool) -> Drive:
        """Track the reference; return the motion and the jerks from this tick on."""
        reference, tick = self._current, sense.tick
        commanded = self._commanded(sense)
        gaps = self._surroundings.gaps(sense, commanded, self._goal[1])
        window = None
        if self._stop_lines:
            window = reference.window(tick)
            gaps = self._stop_lines.limit(gaps, window.states, sense.measured)
        result = None
        if self._shortcut and gaps is NO_GAPS and tick >= reference.rest_tick:
            goal = cell_state(self._lattice, self._goal, sense.t_s)
            result = self._tracker.rest(commanded, goal)
        if result is None:
            result = self._tracker.solve(commanded, window or reference.window(tick), gaps)
        self._solve_ms.append(result.solve_ms)
        self._unusable += not result.usable
        self._osqp_solves += result.iterations > 0
        # A late body is still moving; an agent that takes over must know this.
        end_tick = max(reference.end_tick, tick + 1) if moving else 0
        if reference is self._settling and tick < reference.end_tick:
            end_tick = reference.end_tick  # ready for plans, but still settling
        at_rest = tick >= reference.rest_tick and not moving
        if at_rest:
            self._origin = self._goal
        ticks = self._ticks if self._origin != self._goal else 0
        return Drive(
            motion=CurrentMotion(self._origin, end_tick, ticks),
            jerks=result.jerk.astype(_FLOAT32).tobytes() if result.usable else b"",
            free=at_rest and result.usable and result.on_reference,
        )

    def motion(self, tick: int) -> Course | None:
        """Return the motion when it begins and every `REPEAT_TICKS` while it lasts."""
        reference = self._reference
        if reference is None or reference.origin == self._goal:
            return None
        if tick >= reference.end_tick or (tick - reference.start_tick) % REPEAT_TICKS:
            return None
        return reference.origin, self._goal, reference.start_tick, self._ticks

    def on_motion(self, motion: Motion) -> None:
        """Handle another vehicle's announced motion."""
        self._surroundings.on_motion(motion)

    def close(self, lane_ends: LaneEnds) -> None:
        """Replace the ends of lanes: parts of lanes are closed for a time."""
        self._stop_lines.ends = lane_ends

    def _commanded(self, sense: Sense) -> State:
        return commanded_state(sense.measured, sense.setpoint, self._limits, self._speed_mps)

    @property
    def _current(self) -> Reference:
        assert self._reference is not None  # noqa: S101 (it has taken over)
        return self._reference
