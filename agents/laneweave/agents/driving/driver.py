"""The driver: from the cell to hold, or the move to make, to jerks for the motion controller.

It lays the reference through the lattice points (`trajectory`) and tracks it (`tracker`). When a
solution is not usable it has nothing to say: the motion controller goes on with the last good
trajectory, and knows how to go on from there (`sim_bridge.motion_controller`: the ladder). It knows
nothing of the protocol.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
from attrs import define, frozen

from laneweave.agents.driving.motions import REPEAT_TICKS
from laneweave.agents.driving.reference import Reference
from laneweave.agents.driving.surroundings import NOBODY, Surroundings
from laneweave.agents.driving.tracker import Tracker
from laneweave.protocol.lattice import Cell, Move
from laneweave.protocol.scenario.tables import Scenario
from laneweave.protocol.vehicle.motion import at_rest_in_cell, cell_state, commanded_state
from laneweave.protocol.wire.messages import Motion, Sense

_FLOAT32 = np.dtype("<f4")


@define  # made at each tick: frozen ones take three times as long
class Drive:
    """What the motion controller should play from this tick on."""

    motion_end_tick: int
    """End of the motion under way; 0 when the vehicle holds."""
    motion_origin: Cell
    motion_ticks: int
    """How long the move takes; 0: it settles in its cell, or holds."""
    jerks: bytes
    """Little-endian float32 pairs (along, across) in m/s3, one for each tick of the horizon; none
    when there is nothing better than what is being played."""


@frozen
class Course:
    """A motion, as it is told to others."""

    origin: Cell
    target: Cell
    begin_tick: int
    ticks: int


@frozen
class Effort:
    """What driving has cost so far."""

    solves: int = 0
    unusable: int = 0
    osqp_solves: int = 0
    """Of the solves, those for which OSQP ran."""
    solve_ms: bytes = b""
    """Little-endian float32 CPU milliseconds, one for each solve."""


class Driver(Protocol):
    """Drives one vehicle; `TrackingDriver` in every real agent."""

    def take_over(self, sense: Sense) -> None:
        """Go on with what the motion controller is doing."""

    def begin(self, move: Move, tick: int, ticks: int) -> None:
        """Begin a move at this tick; it takes `ticks` of them."""

    def at_rest(self, sense: Sense) -> bool:
        """Tell whether the motion under way has ended."""

    def drive(self, sense: Sense, *, moving: bool) -> Drive:
        """Return what to play from this tick on."""

    def motion(self, tick: int) -> Course | None:
        """Return what to tell others at this tick of the motion under way; None: nothing."""

    def hear(self, motion: Motion) -> None:
        """Take what another vehicle says of its motion."""

    @property
    def effort(self) -> Effort:
        """What it has cost so far."""


class TrackingDriver:
    """Tracks references with a quadratic program at each tick."""

    def __init__(
        self, scenario: Scenario, make_tracker: Callable[[Scenario], Tracker] = Tracker
    ) -> None:
        """Make a driver that knows nothing of its vehicle yet."""
        self._scenario = scenario
        self._tracker = make_tracker(scenario)
        self._reference: Reference | None = None
        self._goal: Cell = (0, 0)
        self._durations = scenario.move_durations
        self._ticks = 0
        """How long the newest move takes."""
        self._lattice = scenario.lattice
        self._vehicle = scenario.vehicle
        self._speed_mps = scenario.lattice.speed_mps
        self._surroundings = Surroundings(scenario)
        self._solve_ms: list[float] = []
        self._unusable = self._osqp_solves = 0

    @property
    def effort(self) -> Effort:
        """What it has cost so far."""
        solve_ms = np.array(self._solve_ms, dtype="<f4").tobytes()
        return Effort(len(self._solve_ms), self._unusable, self._osqp_solves, solve_ms)

    def take_over(self, sense: Sense) -> None:
        """Go on with what the motion controller is doing."""
        scenario = self._scenario
        self._goal = sense.hold_cell
        if sense.motion_origin == sense.hold_cell and sense.motion_end_tick > sense.tick + 3:
            state = commanded_state(
                sense.state, sense.setpoint, scenario.vehicle, self._lattice.speed_mps
            )
            self._reference = Reference.settling(
                scenario, sense.hold_cell, state, sense.tick, sense.motion_end_tick
            )
        elif sense.motion_end_tick > sense.tick and sense.motion_ticks in self._durations:
            self._ticks = sense.motion_ticks
            self._reference = Reference.move(
                scenario,
                sense.motion_origin,
                sense.hold_cell,
                sense.motion_end_tick - self._ticks,
                self._ticks,
            )
        else:
            self._reference = Reference.hold(scenario, sense.hold_cell)

    def begin(self, move: Move, tick: int, ticks: int) -> None:
        """Begin a move at this tick; it takes `ticks` of them."""
        self._goal, self._ticks = move[2], ticks
        self._reference = Reference.move(self._scenario, move[1], move[2], tick, ticks)

    def at_rest(self, sense: Sense) -> bool:
        """Tell whether the motion's time is over and the body is at its target.

        A body that is late still moves, though the time of its motion is over.
        """
        return sense.tick >= self._path.end_tick and at_rest_in_cell(
            sense.state, self._lattice, self._goal, sense.t_s
        )

    def drive(self, sense: Sense, *, moving: bool) -> Drive:
        """Track the reference."""
        reference, tick = self._path, sense.tick
        state = commanded_state(sense.state, sense.setpoint, self._vehicle, self._speed_mps)
        gaps = self._surroundings.gaps(sense, state, self._goal[1])
        result = None
        if gaps is NOBODY and tick >= reference.end_tick:
            goal = cell_state(self._lattice, self._goal, sense.t_s)
            result = self._tracker.rest(state, goal)
        if result is None:
            result = self._tracker.solve(state, reference.window(tick), gaps)
        self._solve_ms.append(result.solve_ms)
        self._unusable += not result.usable
        self._osqp_solves += result.iterations > 0
        return Drive(
            # Past its time but not there yet: still moving, for whoever takes the vehicle over.
            motion_end_tick=max(reference.end_tick, tick + 1) if moving else 0,
            motion_origin=reference.origin,
            motion_ticks=self._ticks if reference.origin != self._goal else 0,
            jerks=result.jerk.astype(_FLOAT32).tobytes() if result.usable else b"",
        )

    def motion(self, tick: int) -> Course | None:
        """Return the motion when it begins and now and then while it lasts."""
        path = self._reference
        if path is None or path.origin == self._goal:
            return None
        if tick >= path.end_tick or (tick - path.start_tick) % REPEAT_TICKS:
            return None
        return Course(path.origin, self._goal, path.start_tick, self._ticks)

    def hear(self, motion: Motion) -> None:
        """Reckon with another vehicle's motion."""
        self._surroundings.hear(motion)

    @property
    def _path(self) -> Reference:
        assert self._reference is not None  # noqa: S101 (it has taken over)
        return self._reference
