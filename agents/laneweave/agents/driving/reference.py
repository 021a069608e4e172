"""References: motions in road time, which the tracker follows.

A `Reference` is a hold, one move to a neighbouring cell, or settling in a cell. Where it would
run into the vehicle ahead, it is replaced by a yielding path (`yield_behind`).
"""

from __future__ import annotations

import math

import numpy as np
from attrs import define
from numpy.typing import NDArray

from laneweave.agents.driving.stopping_points import StoppingPoints
from laneweave.agents.driving.tracking_problem import ErrorBounds, Gaps
from laneweave.agents.driving.trajectory import Trajectory, move_profile, settling_trajectory
from laneweave.protocol.lattice import Cell
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.vehicle_tables import Vehicle
from laneweave.protocol.vehicle.motion import State, cell_state, integrate, limited_jerk

Array = NDArray[np.float64]

_BUFFER_M = 0.5
"""Extra distance kept by a yielding path, so that gap constraints stay inactive."""
_REACT_S = 1.0
"""Time allowed to restore a violated gap."""
_BRAKE_SHARE = 0.9
_ACCEL_SHARE = 0.6
"""Fractions of the vehicle's limits that a yielding path may use."""
_LATERAL_GAINS = (1.3, 3.6, 3.0)
"""Jerk per error in (y, v_y, a_y) [1/s3, 1/s2, 1/s]: poles near -0.6 and -1.2 +- 0.8i 1/s."""


@define(eq=False)
class Window:
    """N consecutive ticks of a reference."""

    states: Array
    """States (N + 1, 6): s, v, a, y, v_y, a_y on the road, in SI units."""
    jerks: Array
    """Jerks (N, 2): j_s, j_y [m/s3]."""
    bounds: ErrorBounds | None = None
    """Admissible errors from the next tick on; None: not computed."""
    defect: Array | None = None
    """Violation c (N, 3) of the dynamics along the road; None: zero."""
    holds: bool = False
    """Whether the reference holds a cell throughout."""


class Reference:
    """Reference that holds a cell, follows at most one trajectory, then holds its last cell."""

    def __init__(
        self,
        scenario: Scenario,
        limits: Vehicle,
        origin: Cell,
        trajectory: Trajectory | None = None,
        start_tick: int = 0,
    ) -> None:
        """Build the reference.

        Args:
            scenario: lattice, tick and horizon.
            limits: those of the vehicle.
            origin: cell held before the motion; the trajectory is relative to it.
            trajectory: the motion; None: hold the cell.
            start_tick: tick at which the trajectory begins.
        """
        n = self._horizon = scenario.timing.horizon_ticks
        self._advance_m = scenario.formation.speed_mps * scenario.runtime.tick_s
        self.origin = origin
        self.start_tick = start_tick
        """Tick at which the motion begins."""
        self.end_tick = start_tick
        """Tick from which the last cell is held."""
        rest = np.zeros((1, 6))
        states, jerks = [np.zeros((n, 6))], [np.zeros((n, 2))]
        if trajectory is not None:
            self.end_tick += trajectory.ticks
            states.append(trajectory.states[:-1])
            jerks.append(trajectory.jerks)
            rest = trajectory.states[-1:] * (1.0, 0.0, 0.0, 1.0, 0.0, 0.0)
        self.rest_tick = self.end_tick
        """Tick from which the body is at rest in the last cell."""
        states.append(np.repeat(rest, n + 1, axis=0))
        jerks.append(np.zeros((n, 2)))
        self._states = np.concatenate(states)
        self._states += cell_state(scenario.lattice, origin, 0.0)
        self._jerks = np.concatenate(jerks)
        self._jerks.flags.writeable = False
        self._ramp = self._advance_m * np.arange(n + 1)
        self._limits = limits
        self._bounds: ErrorBounds | None = None
        """Bounds for the whole reference, independent of road time; None: not computed."""

    @classmethod
    def hold(cls, scenario: Scenario, limits: Vehicle, cell: Cell) -> Reference:
        """Return the reference that holds a cell."""
        return cls(scenario, limits, cell)

    @classmethod
    def move(
        cls,
        scenario: Scenario,
        limits: Vehicle,
        origin: Cell,
        target: Cell,
        start_tick: int,
        ticks: int | None = None,
    ) -> Reference:
        """Return the reference for one move to a neighbouring cell; see `move_profile`.

        Raises:
            InfeasibleTrajectoryError: the move cannot be driven within the limits.
            ValueError: the cells are not neighbours.
        """
        dx, dy = target[0] - origin[0], target[1] - origin[1]
        profile = move_profile(scenario, limits, dx, dy, ticks)
        return cls(scenario, limits, origin, profile, start_tick)

    @classmethod
    def settling(
        cls,
        scenario: Scenario,
        limits: Vehicle,
        cell: Cell,
        commanded: State,
        tick: int,
        end_tick: int,
    ) -> Reference:
        """Return the reference from a commanded state at `tick` to rest in a cell at `end_tick`.

        The motion must last at least three ticks; see `settling_trajectory`.
        """
        goal = cell_state(scenario.lattice, cell, tick * scenario.runtime.tick_s)
        error = np.array(commanded) - goal
        trajectory = settling_trajectory(scenario, limits, error, end_tick - tick)
        return cls(scenario, limits, cell, trajectory, tick)

    def settle_meanwhile(self, before: Reference) -> None:
        """Add what is left of an earlier motion along the road into the origin of this move."""
        if self.start_tick >= before.end_tick:
            return
        first = self.start_tick - before.start_tick + self._horizon
        left = before._states[first:, :3] - before._states[-1, :3]
        n, padding = self._horizon, max(0, self._horizon + len(left) - len(self._states))
        rest = self._states[-1:] * (1.0, 1.0, 0.0, 1.0, 0.0, 0.0)
        self._states = np.concatenate([self._states, np.repeat(rest, padding, axis=0)])
        self._states[n : n + len(left), :3] += left
        jerks = np.concatenate([self._jerks, np.zeros((padding, 2))])
        along = before._jerks[first:, 0]
        jerks[n : n + len(along), 0] += along
        jerks.flags.writeable = False
        self._jerks = jerks
        self.rest_tick = max(self.end_tick, before.end_tick)

    def window(self, tick: int) -> Window:
        """Return the part of the reference from `tick` on; its jerks are read-only."""
        n = self._horizon
        first = tick - self.start_tick + n
        last = len(self._jerks) - n
        first = min(max(first, 0), last)
        states = self._states[first : first + n + 1].copy()
        s = states[:, 0]
        s += self._ramp
        s += self._advance_m * tick
        bounds = self._bounds
        if bounds is None:
            bounds = ErrorBounds.around(self._states[1:], self._jerks, self._limits)
            self._bounds = bounds
        jerks = self._jerks[first : first + n]
        return Window(states, jerks, bounds.part(first, first + n), holds=first == last)


def yield_behind(
    commanded: State,
    states: Array,
    jerks: Array,
    gaps: Gaps,
    points: StoppingPoints,
    tick_s: float,
    limits: Vehicle,
) -> None:
    """Replace the part of a reference that is beyond the yielding path, in place.

    The gap constraints alone would suffice, but the program takes ten times as long if the
    reference is far beyond them. The yielding path is the gentlest constant deceleration from the
    vehicle's own state that stays behind, and whose stopping points do (`StoppingPoints`):

        d = max over t of 2 (s + v t - latest(t)) / t^2

    The path reaches d with limited jerk, ends at standstill, never goes backwards, and applies
    until the reference is behind it. The next tick's d makes up the distance lost to limited jerk.
    Across the road the vehicle follows the reference as well as possible at its speed, without
    sliding sideways. Along the road the result may violate the dynamics where the path begins or
    ends.

    Args:
        commanded: commanded state of the vehicle.
        states: states of the reference (N + 1, 6).
        jerks: jerks of the reference (N, 2).
        gaps: bounds set by vehicles ahead.
        points: stopping points of the vehicle.
        tick_s: length of the tick [s].
        limits: the vehicle's limits.
    """
    s, v = commanded[0], max(commanded[1], 0.0)
    decel = -np.inf
    if gaps.latest is not None:
        # Rounded down: `latest` may be infinite at all later ticks.
        first = min(max(math.floor(_REACT_S / tick_s + 1e-9), 1), len(jerks))
        t = tick_s * np.arange(first, len(states))
        needed = 2.0 * (s + v * t - gaps.latest[first:] + _BUFFER_M) / (t * t)
        decel = float(needed.max())
    if gaps.stopping is not None:
        decel = max(decel, points.needed_decel_mps2(commanded, gaps.stopping))
    decel = min(decel, -_BRAKE_SHARE * limits.min_accel_mps2)
    decel = max(decel, -_ACCEL_SHARE * limits.max_accel_mps2)
    now, path, inputs = commanded, [commanded], []
    p_y, p_v, p_a = _LATERAL_GAINS
    for (_, _, _, y, v_y, a_y), (_, j_y) in zip(states[:-1].tolist(), jerks.tolist(), strict=True):
        back = p_y * (y - now[3]) + p_v * (v_y - now[4]) + p_a * (a_y - now[5])
        jerk = limited_jerk(now, ((-decel - now[2]) / tick_s, j_y + back), limits, tick_s)
        now = integrate(now, jerk, tick_s)
        path.append(now)
        inputs.append(jerk)
    yielding, driving = np.array(path), np.array(inputs)
    beyond = states[:, 0] >= yielding[:, 0]
    states[beyond, :3] = yielding[beyond, :3]
    states[:, 3:] = yielding[:, 3:]
    jerks[beyond[1:], 0] = driving[beyond[1:], 0]
    jerks[:, 1] = driving[:, 1]
