"""The tracker: jerks that keep the vehicle on its reference, by model predictive control.

At each tick it solves the quadratic program of `tracking_problem` for the commanded state
(`protocol.vehicle.motion`), which compensates for actuator lag.

OSQP starts from the regulator's solution, w_k = -K e_k, which is optimal if no inequality
constraint binds, and ends after one iteration then.

**Shortcut** (`tracking.shortcut`, for sweeps). Jerks and values of all constraints are one
precomputed matrix times e_0. If they satisfy all constraints, OSQP does not run.

**Other references.** A reference that runs into the vehicle ahead yields
(`reference.yield_behind`). Far from the reference (for example after an emergency brake), or
without a usable solution, the hold law's path to the reference replaces it, and the bounds are
widened so that zero is feasible. Both measures keep errors small and OSQP fast.

Solutions are checked: the returned jerks have been integrated exactly, and limited by
`limited_jerk` tick by tick where necessary.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from functools import cache
from threading import get_ident

import numpy as np
from attrs import define
from numpy.typing import NDArray

from laneweave.agents.driving.reference import Window, yield_behind
from laneweave.agents.driving.regulator import axis_matrices, shared_regulator
from laneweave.agents.driving.stopping_points import StoppingPoints
from laneweave.agents.driving.tracking_problem import (
    NO_GAPS,
    ErrorBounds,
    Gaps,
    ProgramKind,
    TrackingProgram,
    shared_program,
)
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.vehicle_tables import Vehicle
from laneweave.protocol.vehicle.motion import State, hold_law, integrate, limited_jerk

Array = NDArray[np.float64]

_NEAR = (8.0, 4.0, 6.0, 3.0, 2.5, 6.0)
"""Maximum errors of (s, v, a, y, v_y, a_y) at which the reference is tracked directly, small
compared with `tracking_problem.FAR_M`."""
_LIMIT_TOLERANCE = 1e-3
"""Maximum excess over a limit [m/s, m/s2]; beyond it, jerks are limited tick by tick."""


@define(eq=False)  # created at each tick: frozen objects take three times as long
class TrackResult:
    """Result of one tick."""

    jerk: Array
    """Jerks (N, 2) from now on [m/s3], within the vehicle's limits if the state allows this; zero
    unless `usable`."""
    usable: bool
    """Whether `jerk` may be executed; otherwise the last usable result continues."""
    iterations: int
    """Iterations of OSQP; 0 with the shortcut."""
    solve_ms: float
    """CPU time of the calling thread [ms], including the set-up of OSQP at its first use."""
    violation: float
    """Maximum violation of a constraint by the solver's solution, before `limited_jerk`, or an
    upper bound of it."""
    on_reference: bool = True
    """Whether the jerks follow the reference itself, and not one that replaces it."""


class Tracker:
    """Tracks the references of one vehicle."""

    def __init__(
        self,
        scenario: Scenario,
        limits: Vehicle,
        stopwatch: Callable[[], float] = time.thread_time,
    ) -> None:
        """Prepare the program, and the shortcut if `tracking.shortcut` is set.

        Args:
            scenario: tick, horizon.
            limits: those of the vehicle.
            stopwatch: clock [s] that measures how long solves take.
        """
        self._stopwatch = stopwatch
        n = self._n = scenario.timing.horizon_ticks
        self._tick_s = scenario.runtime.tick_s
        self._axis = axis_matrices(self._tick_s)
        self._limits = limits
        self._shapes = (n + 1, 6), (n, 2)
        self._kept = np.empty(14 * n, dtype=np.bool_)
        """Buffer for comparisons with bounds for the shortcut; its blocks follow as views."""
        kept = self._kept
        self._kept_low, self._kept_high = kept[: 10 * n].reshape(2, 5, n)
        self._kept_low_jerk, self._kept_high_jerk = kept[10 * n :].reshape(2, n, 2)
        self._stopping_points = StoppingPoints(scenario, limits)
        self._max_jerk = np.array([[limits.max_jerk_mps3], [limits.max_lateral_jerk_mps3]])
        self._rollout, self._values = _rollout(n, self._tick_s), np.zeros((2, n + 2))
        self._kind = ProgramKind(n, self._tick_s, scenario.formation.speed_mps, limits)
        self._program: TrackingProgram | None = None
        self._regulator = None
        self.unconstrained_errors: tuple[float, ...] = ()
        """Errors up to which no constraint binds while a cell is held."""
        if scenario.tracking.shortcut:
            self._regulator = shared_regulator(n, self._tick_s, limits.max_slip_ratio)
            self.unconstrained_errors = self._regulator.unconstrained_errors(
                limits, scenario.formation.speed_mps
            )

    @property
    def program(self) -> TrackingProgram:
        """The program, shared by the trackers of this thread with the same limits."""
        program = self._program
        if program is None or program.thread != get_ident():
            program = self._program = shared_program(self._kind)
        return program

    def solve(self, commanded: State, window: Window, gaps: Gaps = NO_GAPS) -> TrackResult:
        """Return the jerks that take a vehicle from its commanded state to its reference.

        Raises:
            ValueError: a shape is wrong, a number is NaN, or the state is not finite.
        """
        start = self._stopwatch()
        shapes = window.states.shape, window.jerks.shape
        if shapes != self._shapes:
            raise ValueError(f"window has shapes {shapes}, not {self._n} ticks")
        # A finite sum implies finite numbers, which is the usual case.
        if not math.isfinite(sum(commanded)) and not all(map(math.isfinite, commanded)):
            raise ValueError(f"state is not finite: {commanded}")
        if gaps is not NO_GAPS:
            gaps.check(self._n)
        program = self.program
        target = self._yielding(commanded, window, gaps)
        iterations = 0
        error = _error(commanded, target)
        usable = _is_near(error)
        on_reference = usable and target is window
        if usable:
            jerk = self._regulated(error, target, gaps)
            if jerk is not None:
                elapsed_ms = (self._stopwatch() - start) * 1e3
                return TrackResult(jerk, True, 0, elapsed_ms, 0.0, on_reference)
            program.write_bounds(
                error, target.states, target.jerks, target.defect, gaps, holds=target.holds
            )
            result = program.solve(error)
            usable, iterations = result.usable, result.iterations
        if not usable:
            on_reference = False
            back = self._path_back(commanded, window.states)
            target = self._yielding(commanded, back, gaps)
            error = _error(commanded, target)
            program.write_bounds(error, target.states, target.jerks, target.defect, gaps)
            program.admit_zero()
            result = program.solve(error)
            usable, iterations = result.usable, iterations + result.iterations
        if usable:
            jerk = self._limited(commanded, target.jerks + program.jerks(result))
        else:
            jerk = np.zeros((self._n, 2))
        elapsed_ms = (self._stopwatch() - start) * 1e3
        return TrackResult(jerk, usable, iterations, elapsed_ms, result.violation, on_reference)

    def rest(self, commanded: State, goal: State) -> TrackResult | None:
        """Return the jerks that keep a vehicle in its cell while no other vehicle is near.

        Near `goal`, the state at rest in the cell, no constraint can bind, and `solve` would return
        the same jerks, but more slowly. Returns None if the commanded state is too far from `goal`.
        """
        if self._regulator is None:
            return None
        start = self._stopwatch()
        # Unrolled, since it runs every tick for every vehicle.
        max_s, max_v, max_a, max_y, max_vy, max_ay = self.unconstrained_errors
        s = commanded[0] - goal[0]
        if not -max_s <= s <= max_s:
            return None
        v = commanded[1] - goal[1]
        if not -max_v <= v <= max_v:
            return None
        a = commanded[2] - goal[2]
        if not -max_a <= a <= max_a:
            return None
        y = commanded[3] - goal[3]
        if not -max_y <= y <= max_y:
            return None
        v_y = commanded[4] - goal[4]
        if not -max_vy <= v_y <= max_vy:
            return None
        a_y = commanded[5] - goal[5]
        if not -max_ay <= a_y <= max_ay:
            return None
        jerk = self._regulator.inputs.dot((s, v, a, y, v_y, a_y)).reshape(-1, 2)
        return TrackResult(jerk, True, 0, (self._stopwatch() - start) * 1e3, 0.0)

    def _regulated(self, error: State, target: Window, gaps: Gaps) -> Array | None:
        """Return the jerks (N, 2) of the unconstrained solution if all constraints hold."""
        if self._regulator is None or target.defect is not None:
            return None
        bounds = target.bounds or ErrorBounds.around(target.states[1:], target.jerks, self._limits)
        n = self._n
        values = self._regulator.constraints.dot(error)
        free, free_jerk = values[: 5 * n].reshape(5, n), values[5 * n : 7 * n].reshape(n, 2)
        np.less_equal(bounds.low, free, self._kept_low)
        np.less_equal(free, bounds.high, self._kept_high)
        np.less_equal(bounds.low_jerk, free_jerk, self._kept_low_jerk)
        np.less_equal(free_jerk, bounds.high_jerk, self._kept_high_jerk)
        if not self._kept.all():
            return None
        if gaps is not NO_GAPS:
            program = self.program
            program.write_gaps(target.states, gaps)
            free_gap = values[7 * n :]
            if not program.keeps_gaps(free_gap):
                return None
        answer: Array = target.jerks + free_jerk
        return answer

    def _yielding(self, commanded: State, window: Window, gaps: Gaps) -> Window:
        """Return the reference, with a yielding path if it violates a gap."""
        if not self._violates(window.states, gaps):
            return window
        states, jerks, points = window.states.copy(), window.jerks.copy(), self._stopping_points
        yield_behind(commanded, states, jerks, gaps, points, self._tick_s, self._limits)
        transition, effect = self._axis
        along = states[:, :3]
        defect = along[:-1] @ transition.T + jerks[:, :1] * effect[:, 0] - along[1:]
        return Window(states, jerks, None, defect)

    def _violates(self, states: Array, gaps: Gaps) -> bool:
        """Return whether states (N + 1, 6) pass an upper bound."""
        s, latest, stopping = states[:, 0], gaps.latest, gaps.stopping
        if latest is not None and (s > latest).any():
            return True
        if stopping is None:
            return False
        return bool((s + self._stopping_points.distances_m(states) > stopping).any())

    def _path_back(self, commanded: State, states: Array) -> Window:
        """Return the hold law's path from a state to a reference."""
        path, inputs = [commanded], []
        for row in states[:-1].tolist():
            jerk = hold_law(path[-1], tuple(row), self._limits, self._tick_s)
            path.append(integrate(path[-1], jerk, self._tick_s))
            inputs.append(jerk)
        return Window(np.array(path), np.array(inputs))

    def _limited(self, commanded: State, jerk: Array) -> Array:
        """Return jerks (N, 2) that keep the limits exactly, if the state allows this."""
        values = self._values
        jerks = values[:, : self._n]
        np.maximum(jerk.T, -self._max_jerk, out=jerks)
        np.minimum(jerks, self._max_jerk, out=jerks)
        if self._excess(commanded, values) <= _LIMIT_TOLERANCE:
            return jerks.T.copy()
        now = commanded
        for k, (along, across) in enumerate(jerk.tolist()):
            allowed = limited_jerk(now, (along, across), self._limits, self._tick_s)
            jerk[k] = allowed
            now = integrate(now, allowed, self._tick_s)
        return jerk

    def _excess(self, commanded: State, values: Array) -> float:
        """Return the maximum excess over a limit of the states that result from jerks.

        Args:
            commanded: commanded state now.
            values: jerks along and across (2, N), and room for two more columns.
        """
        limits = self._limits
        _, v, a, _, v_y, a_y = commanded
        values[:, -2:] = (a, v), (a_y, v_y)
        states = values.dot(self._rollout).reshape(2, 2, self._n)
        (max_a, max_v), (max_ay, max_vy) = states.max(axis=2).tolist()
        (min_a, min_v), (min_ay, min_vy) = states.min(axis=2).tolist()
        excess: float = max(
            max_a - limits.max_accel_mps2,
            limits.min_accel_mps2 - min_a,
            max(max_ay, -min_ay) - limits.max_lateral_accel_mps2,
            max_v - limits.max_speed_mps,
            -min_v,
        )
        slip: float = max(max_vy, -min_vy) - limits.max_slip_ratio * min_v
        if slip > excess:  # this bound is usually enough
            slip = float((np.abs(states[1, 1]) - limits.max_slip_ratio * states[0, 1]).max())
        return max(excess, slip)


@cache
def _rollout(n: int, tick_s: float) -> Array:
    """Return the matrix (N + 2, 2 N) from jerks, acceleration and speed to later ones.

    The first N columns give the accelerations at the next ticks, the others the speeds.
    """
    later = np.arange(1, n + 1)
    ticks = np.maximum(later - np.arange(n)[:, None], 0)  # since the beginning of a jerk
    matrix = np.zeros((n + 2, 2 * n))
    matrix[:n, :n] = tick_s * (ticks > 0)
    matrix[:n, n:] = tick_s * tick_s * np.maximum(ticks - 0.5, 0.0)
    matrix[n, :n] = matrix[n + 1, n:] = 1.0
    matrix[n, n:] = tick_s * later
    return matrix


def _error(commanded: State, target: Window) -> State:
    s, v, a, y, v_y, a_y = target.states[0].tolist()
    return (
        commanded[0] - s,
        commanded[1] - v,
        commanded[2] - a,
        commanded[3] - y,
        commanded[4] - v_y,
        commanded[5] - a_y,
    )


def _is_near(error: State) -> bool:
    s, v, a, y, v_y, a_y = error
    max_s, max_v, max_a, max_y, max_vy, max_ay = _NEAR
    return (
        -max_s <= s <= max_s
        and -max_v <= v <= max_v
        and -max_a <= a <= max_a
        and -max_y <= y <= max_y
        and -max_vy <= v_y <= max_vy
        and -max_ay <= a_y <= max_ay
    )
