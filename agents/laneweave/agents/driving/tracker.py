"""The tracker: a quadratic program per tick that keeps the vehicle on its reference.

Model predictive control over N ticks of h seconds, in error coordinates z = z_ref + e,
u = u_ref + w, with z = (s, v, a, y, v_y, a_y), the commanded state (`protocol.motion`: so the lag
of the actuators is compensated), and u = (j_s, j_y):

    minimise    sum_k 1/2 (e_k' Q e_k + w_k' R w_k) + 1/2 e_N' S e_N + 1/2 G sum_k g_k^2
    subject to  e_{k+1} = A e_k + B w_k + c_k                  exact: jerks are constant per tick
                0 <= v_k <= v_max,  a_min <= a_k <= a_max,  |a_y,k| <= a_y,max
                |v_y,k| <= slip v_k                            no sliding sideways
                |j_s,k| <= j_max,  |j_y,k| <= j_y,max
                earliest_k <= s_k - g_k <= latest_k            those behind and ahead (`Gaps`)

c is zero for a reference that obeys the dynamics. S is the cost to go of the unlimited problem,
so without active rows this is the infinite-horizon linear-quadratic regulator: w_k = -K e_k. **The
fast path** is that regulator: the solution without rows is one precomputed matrix times e_0, and
so are all rows. Where it keeps every row it *is* the solution, and OSQP does not run, unless
`tracking.always_solve` asks for it.

On the reference the solution is zero, which the solver's tolerance cannot spoil; in absolute
coordinates it leaves 1.6 m/s3 of noise on the jerk. The slack g is quadratic: an exact (linear)
penalty takes four times as long. All matrices are set up once; a tick changes bounds only.

Three things keep the program small in its numbers, and with them the solver quick. A reference
that runs into the vehicle ahead yields (see `yielding`). Near standstill the prediction has some
play in speed and slip. And far from the reference (after an emergency brake, say) or when the
program has no usable answer, the hold law's way back is the reference: zero is then a solution
whatever the state, even one from which no jerk keeps a limit, since bounds are widened to admit it.

The solver's answer is not the last word: the jerks that are returned have been integrated exactly
and held within the limits by `limited_jerk`, tick by tick where that is needed.
"""

from __future__ import annotations

import math
import time
from functools import cache
from typing import Any

import numpy as np
from attrs import define
from numpy.typing import NDArray
from scipy import sparse

from laneweave.agents.driving.bounds import SLIP_PLAY_MPS, SPEED_PLAY_MPS, Rooms
from laneweave.agents.driving.qp import QPResult, QPScale, QPSettings, QuadraticProgram
from laneweave.agents.driving.reference import Window, axis_matrices
from laneweave.agents.driving.surroundings import NOBODY, Gaps
from laneweave.agents.driving.yielding import yield_behind
from laneweave.protocol.scenario.tables import Scenario, Vehicle
from laneweave.protocol.vehicle.motion import State, hold_law, integrate, limited_jerk

Array = NDArray[np.float64]

_WEIGHTS = (1.0, 0.4, 0.1)
"""Of (s, v, a) errors [1/m2, s2/m2, s4/m2]."""
_LATERAL_WEIGHTS = (2.0, 0.8, 0.2)
_JERK_WEIGHT = 0.02
_GAP_WEIGHT = 10.0

# A fixed rho leaves nothing behind but the warm start, so a reset is complete.
SETTINGS = QPSettings(
    eps_abs=6e-3,
    max_iter=100,
    check_termination=4,
    rho=0.1,
    adaptive_rho_interval=0,
    alpha=1.25,
    row_tolerance=2e-2,
)
_GAP_SCALE, _JERK_SCALE = 20.0, 0.4
"""Of these rows for OSQP; others have 1. With 1 for all, pressing gap rows take 300 iterations."""
_STATE_SCALE = 0.3
"""Of states and slacks for OSQP; jerks have 1, since theirs is the gradient that must vanish."""
_FAR_M = 1e4
"""Stands for nobody there: finite, so that the row keeps its kind and OSQP its factors."""
_PUSH_M = 1.0
"""Those behind push a vehicle ahead of its reference by no more: they have brakes, too."""
_NEAR = (8.0, 4.0, 6.0, 3.0, 2.5, 6.0)
"""Largest errors of (s, v, a, y, v_y, a_y) at which the reference is tracked as it is; none of them
takes the vehicle as far as `_FAR_M`."""
_LIMIT_TOLERANCE = 1e-3
"""Jerks whose states exceed a limit by more are held within it tick by tick [m/s, m/s2]."""


@define(eq=False)  # made at each tick: frozen ones take three times as long
class TrackResult:
    """The plan of one tick."""

    jerk: Array
    """Jerks (N, 2) from now on [m/s3], within the vehicle's limits as far as the state allows; zero
    unless `usable`."""
    usable: bool
    """Whether to drive by `jerk`; otherwise play the rest of the last good one."""
    iterations: int
    """OSQP's; 0 on the fast path."""
    solve_ms: float
    """CPU time of the calling thread [ms]; the first one that needs OSQP sets it up."""
    row_violation: float
    """Largest violation of a row by the solver's answer, before limits were applied."""


@define(eq=False)
class _Path:
    """What is tracked in this tick."""

    states: Array
    """(N + 1, 6)."""
    jerks: Array
    """(N, 2)."""
    defect: Array | None
    """c (N, 3) of the axis along the road; None for zero."""
    rooms: Rooms | None = None
    """What the limits leave beside it; None: that is not known yet."""


class Tracker:
    """Tracks references; see the module for the program. One object per vehicle."""

    def __init__(self, scenario: Scenario) -> None:
        """Set the program up.

        Args:
            scenario: horizon, tick, limits; `tracking.always_solve` turns the fast path off.
        """
        n = self._n = scenario.horizon_ticks
        self._tick_s = scenario.runtime.tick_s
        self._axis = axis_matrices(self._tick_s)
        self._limits = scenario.vehicle
        self._jerk_limits = np.array(
            [self._limits.max_jerk_mps3, self._limits.max_lateral_jerk_mps3]
        )
        self._low, self._high = _first_bounds(n)
        self._gaps = NOBODY
        self._shapes = (n + 1, 6), (n, 2)
        self._unwritten: tuple[State, _Path, Gaps] | None = None
        """Of the newest program, if its bounds were not written because the fast path was taken."""
        self._kept = np.empty(14 * n, dtype=np.bool_)
        """Whether bounds are kept on the fast path, and the blocks, as views."""
        kept = self._kept
        self._kept_low, self._kept_high = kept[: 10 * n].reshape(2, 5, n)
        self._kept_low_jerk, self._kept_high_jerk = kept[10 * n :].reshape(2, n, 2)
        self._stale = False
        """Whether the fast path was taken since OSQP ran."""
        always_solve = scenario.tracking.always_solve
        self._regulator = (
            None if always_solve else _regulator(n, self._tick_s, self._limits.max_slip_ratio)
        )
        self.harmless = (
            self._regulator.harmless(self._limits, scenario.formation.speed_mps)
            if self._regulator is not None
            else ()
        )
        """Errors so small that no row binds while a cell is held."""
        self._cost = _cost(n, self._tick_s)
        self._rows = _rows(n, self._tick_s, self._limits.max_slip_ratio)
        self._settings = SETTINGS
        self._qp: QuadraticProgram | None = self._set_up() if always_solve else None
        """None until it is needed: most vehicles never leave the fast path, and to set it up takes
        as long as hundreds of ticks."""

    def solve(self, state: State, window: Window, gaps: Gaps = NOBODY) -> TrackResult:
        """Return the jerks that bring the vehicle to its reference.

        Args:
            state: commanded state (s, v, a, y, v_y, a_y) now.
            window: the reference from now on, N + 1 states and N jerks.
            gaps: what the others leave.

        Raises:
            ValueError: a shape is wrong, a number is NaN or the state not finite.
        """
        start = time.thread_time()
        states, jerks = window.states, window.jerks
        if (states.shape, jerks.shape) != self._shapes:
            raise ValueError(
                f"window has shapes {states.shape}, {jerks.shape}, not {self._n} ticks"
            )
        # A finite sum is one of finite numbers, which is the usual case.
        if not math.isfinite(sum(state)) and not all(map(math.isfinite, state)):
            raise ValueError(f"state is not finite: {state}")
        if gaps is not NOBODY:
            gaps.check(self._n)
        path = self._give_way(state, states, jerks, gaps.latest)
        if path.states is states:
            path.rooms = window.rooms
        iterations = 0
        error = _error(state, path)
        usable = _is_near(error)
        if usable:
            jerk = self._regulated(error, path, gaps)
            if jerk is not None:
                self._stale = True
                self._unwritten = state, path, gaps
                elapsed_ms = (time.thread_time() - start) * 1e3
                return TrackResult(jerk, True, 0, elapsed_ms, 0.0)
            self._set_bounds(state, path, gaps)
            result = self._solve_program()
            usable, iterations = result.usable, result.iterations
        if not usable:
            path = self._give_way(state, *self._way_back(state, states), gaps.latest)
            self._set_bounds(state, path, gaps)
            np.minimum(self._low.limits, 0.0, out=self._low.limits)
            np.maximum(self._high.limits, 0.0, out=self._high.limits)
            result = self._solve_program()
            usable, iterations = result.usable, iterations + result.iterations
        if usable:
            answer = result.x[6 * self._n : 8 * self._n].reshape(-1, 2)
            jerk = self._limited(state, path.jerks + answer)
        else:
            jerk = np.zeros((self._n, 2))
        elapsed_ms = (time.thread_time() - start) * 1e3
        return TrackResult(jerk, usable, iterations, elapsed_ms, result.row_violation)

    def rest(self, state: State, goal: State) -> TrackResult | None:
        """Return the jerks that keep a vehicle in the cell that it holds, if nobody is near.

        They are those of `solve`, for a fraction of its time: so close to its cell none of its rows
        can come into question.

        Args:
            state: commanded state now.
            goal: that of a vehicle which holds the cell, now.

        Returns:
            None: it is not so close.
        """
        if self._regulator is None:
            return None
        start = time.thread_time()
        # Written out, as whatever is done at each tick for each vehicle.
        most_s, most_v, most_a, most_y, most_vy, most_ay = self.harmless
        s = state[0] - goal[0]
        if not -most_s <= s <= most_s:
            return None
        v = state[1] - goal[1]
        if not -most_v <= v <= most_v:
            return None
        a = state[2] - goal[2]
        if not -most_a <= a <= most_a:
            return None
        y = state[3] - goal[3]
        if not -most_y <= y <= most_y:
            return None
        v_y = state[4] - goal[4]
        if not -most_vy <= v_y <= most_vy:
            return None
        a_y = state[5] - goal[5]
        if not -most_ay <= a_y <= most_ay:
            return None
        self._stale = True
        jerk = self._regulator.inputs.dot((s, v, a, y, v_y, a_y)).reshape(-1, 2)
        return TrackResult(jerk, True, 0, (time.thread_time() - start) * 1e3, 0.0)

    def _regulated(self, error: State, path: _Path, gaps: Gaps) -> Array | None:
        """Return the jerks (N, 2) of the solution without rows if it keeps all of them."""
        if self._regulator is None or path.defect is not None:
            return None
        # Without play, exactly: that is for OSQP, whose answers are limited afterwards.
        rooms = path.rooms or Rooms.beside(path.states[1:], path.jerks, self._limits)
        n = self._n
        values = self._regulator.rows.dot(error)
        free, free_jerk = values[: 5 * n].reshape(5, n), values[5 * n : 7 * n].reshape(n, 2)
        np.less_equal(rooms.low, free, self._kept_low)
        np.less_equal(free, rooms.high, self._kept_high)
        np.less_equal(rooms.low_jerk, free_jerk, self._kept_low_jerk)
        np.less_equal(free_jerk, rooms.high_jerk, self._kept_high_jerk)
        if not self._kept.all():
            return None
        if gaps is not NOBODY:
            self._set_gaps(path.states, gaps)
            free_gap = values[7 * n :]
            if not ((self._low.gap <= free_gap).all() and (free_gap <= self._high.gap).all()):
                return None
        answer: Array = path.jerks + free_jerk
        return answer

    def last_program(self) -> tuple[Any, Any, Array, Array]:
        """Return the program that was solved last, for benchmarks: P, A, lower, upper.

        P and A are sparse and the same for all programs of a tracker; the bounds are copies. The
        unknowns are x = (e_1 .. e_N, w_0 .. w_N-1, g_1 .. g_N), the first 6 N rows the dynamics.
        """
        if self._unwritten is not None:
            self._set_bounds(*self._unwritten)
        return self._cost, self._rows, self._low.all.copy(), self._high.all.copy()

    def _set_up(self) -> QuadraticProgram:
        """Set OSQP up, whatever has been written into the bounds by now."""
        low, high = _first_bounds(self._n)
        scale = program_scale(self._n)
        return QuadraticProgram(
            self._cost, self._rows, low.all, high.all, settings=self._settings, scale=scale
        )

    def _solve_program(self) -> QPResult:
        program = self._qp
        if program is None:
            program = self._qp = self._set_up()
        if self._stale:
            # A solution of another situation is a worse start than none.
            program.reset()
            self._stale = False
        program.update(self._low.all, self._high.all)
        return program.solve()

    def _give_way(self, state: State, states: Array, jerks: Array, latest: Array | None) -> _Path:
        """Return the reference as it is, or yielding if it violates a gap."""
        if latest is None or not (states[:, 0] > latest).any():
            return _Path(states, jerks, None)
        states, jerks = states.copy(), jerks.copy()
        yield_behind(state, states, jerks, latest, self._tick_s, self._limits)
        transition, effect = self._axis
        along = states[:, :3]
        defect = along[:-1] @ transition.T + jerks[:, :1] * effect[:, 0] - along[1:]
        return _Path(states, jerks, defect)

    def _set_bounds(self, state: State, path: _Path, gaps: Gaps) -> None:
        """Write all bounds."""
        self._unwritten = None
        states, jerks = path.states, path.jerks
        low, high, limits = self._low, self._high, self._limits
        low.dynamics[:] = 0.0
        if path.defect is not None:
            low.dynamics[:, :3] -= path.defect
        self._set_gaps(states, gaps)
        low.dynamics[0] -= integrate(_error(state, path), (0.0, 0.0), self._tick_s)
        high.dynamics[:] = low.dynamics

        _, speed, accel, _, slip, lateral_accel = states[1:].T
        np.subtract(-SPEED_PLAY_MPS, speed, out=low.speed)
        np.subtract(limits.max_speed_mps, speed, out=high.speed)
        np.subtract(limits.min_accel_mps2, accel, out=low.accel)
        np.subtract(limits.max_accel_mps2, accel, out=high.accel)
        np.subtract(-limits.max_lateral_accel_mps2, lateral_accel, out=low.lateral_accel)
        np.subtract(limits.max_lateral_accel_mps2, lateral_accel, out=high.lateral_accel)
        room = limits.max_slip_ratio * speed
        room += SLIP_PLAY_MPS
        np.subtract(room, slip, out=high.slip_left)
        np.add(room, slip, out=low.slip_right)
        np.negative(low.slip_right, out=low.slip_right)
        np.subtract(self._jerk_limits, jerks, out=high.jerk)
        np.add(self._jerk_limits, jerks, out=low.jerk)
        np.negative(low.jerk, out=low.jerk)

    def _set_gaps(self, states: Array, gaps: Gaps) -> None:
        """Write the bounds of the gap rows."""
        low, high = self._low.gap, self._high.gap
        if gaps.latest is not None:
            np.subtract(gaps.latest[1:], states[1:, 0], out=high)
            # A gap that even the yielding path cannot keep asks for no more than the path.
            high.clip(0.0, _FAR_M, out=high)
        elif self._gaps.latest is not None:
            high[:] = _FAR_M
        if gaps.earliest is not None:
            np.subtract(gaps.earliest[1:], states[1:, 0], out=low)
            low.clip(-_FAR_M, _PUSH_M, out=low)
            np.minimum(low, high, out=low)
        elif self._gaps.earliest is not None:
            low[:] = -_FAR_M
        self._gaps = gaps

    def _way_back(self, state: State, states: Array) -> tuple[Array, Array]:
        """Return the hold law's way from a state to a reference: states (N + 1, 6), jerks."""
        way, inputs = [state], []
        for row in states[:-1].tolist():
            jerk = hold_law(way[-1], tuple(row), self._limits, self._tick_s)
            way.append(integrate(way[-1], jerk, self._tick_s))
            inputs.append(jerk)
        return np.array(way), np.array(inputs)

    def _limited(self, state: State, jerk: Array) -> Array:
        """Return jerks (N, 2) that keep the limits exactly, as far as the state allows."""
        clipped = np.clip(jerk, -self._jerk_limits, self._jerk_limits)
        if self._excess(state, clipped) <= _LIMIT_TOLERANCE:
            return clipped
        now = state
        for k, (along, across) in enumerate(jerk.tolist()):
            allowed = limited_jerk(now, (along, across), self._limits, self._tick_s)
            jerk[k] = allowed
            now = integrate(now, allowed, self._tick_s)
        return jerk

    def _excess(self, state: State, jerk: Array) -> float:
        """Return by how much the states that follow from jerks (N, 2) exceed a limit, at most."""
        limits, h = self._limits, self._tick_s
        rate = np.cumsum(jerk, axis=0)
        rate *= h
        rate += (state[2], state[5])
        change = rate - jerk * (h / 2.0)
        speed = np.cumsum(change, axis=0)
        speed *= h
        speed += (state[1], state[4])
        v, a, a_y = speed[:, 0], rate[:, 0], rate[:, 1]
        return max(
            float(a.max()) - limits.max_accel_mps2,
            limits.min_accel_mps2 - float(a.min()),
            float(np.abs(a_y).max()) - limits.max_lateral_accel_mps2,
            float(v.max()) - limits.max_speed_mps,
            -float(v.min()),
            float((np.abs(speed[:, 1]) - limits.max_slip_ratio * v).max()),
        )


_AT_REST = (0.5, 0.5, 0.5, 0.3, 0.3, 0.5)
"""Errors of a vehicle that holds: some times those of its sensors."""


class Regulator:
    """The solution of the program without rows: w_k = -K e_k, rolled out over the horizon."""

    def __init__(self, ticks: int, tick_s: float, slip: float) -> None:
        """Roll out both axes from each of the six initial errors, over N ticks.

        Args:
            ticks: N.
            tick_s: length of a tick.
            slip: `max_slip_ratio` of the vehicle.
        """
        transition, effect = axis_matrices(tick_s)
        inputs = np.zeros((ticks, 2, 6))
        errors = np.zeros((ticks, 6, 6))
        for axis, weights in enumerate((np.diag(_WEIGHTS), np.diag(_LATERAL_WEIGHTS))):
            gain = _gain(_cost_to_go(weights, tick_s), tick_s)
            block, error = slice(3 * axis, 3 * axis + 3), np.eye(3)
            for k in range(ticks):
                inputs[k, axis, block] = (-gain @ error)[0]
                error = (transition - effect @ gain) @ error
                errors[k, block, block] = error
        self.rows: Array = np.concatenate(
            [
                errors[:, 1],
                errors[:, 2],
                errors[:, 5],
                errors[:, 4] - slip * errors[:, 1],
                errors[:, 4] + slip * errors[:, 1],
                inputs.reshape(2 * ticks, 6),
                errors[:, 0],
            ]
        )
        """What all rows but the dynamics come to, (8 N, 6) times e_0, in the order of `_Bounds`."""
        self.inputs = np.ascontiguousarray(self.rows[5 * ticks : 7 * ticks])
        """Those that are jerks, (2 N, 6)."""
        self._ticks = ticks

    def harmless(self, limits: Vehicle, speed_mps: float) -> tuple[float, ...]:
        """Return the greatest errors (6,) with which no row but gaps binds while a cell is held.

        Args:
            limits: the vehicle.
            speed_mps: v_F.
        """
        n = self._ticks
        rooms = (
            min(speed_mps, limits.max_speed_mps - speed_mps),
            min(-limits.min_accel_mps2, limits.max_accel_mps2),
            limits.max_lateral_accel_mps2,
            limits.max_slip_ratio * speed_mps,
            limits.max_slip_ratio * speed_mps,
        )
        jerks = np.tile([limits.max_jerk_mps3, limits.max_lateral_jerk_mps3], n)
        room = np.concatenate([np.repeat(rooms, n), jerks])
        used = np.abs(self.rows[: 7 * n]) @ np.array(_AT_REST)
        share = min(float((room / np.maximum(used, 1e-12)).min()), 1.0)
        return tuple(share * each for each in _AT_REST)


@cache
def _regulator(ticks: int, tick_s: float, slip: float) -> Regulator:
    """Return that of a scenario: every vehicle of a process has the same."""
    return Regulator(ticks, tick_s, slip)


def _error(state: State, path: _Path) -> State:
    s, v, a, y, v_y, a_y = path.states[0].tolist()
    return (
        state[0] - s,
        state[1] - v,
        state[2] - a,
        state[3] - y,
        state[4] - v_y,
        state[5] - a_y,
    )


def _is_near(error: State) -> bool:
    s, v, a, y, v_y, a_y = error
    most_s, most_v, most_a, most_y, most_vy, most_ay = _NEAR
    return (
        -most_s <= s <= most_s
        and -most_v <= v <= most_v
        and -most_a <= a <= most_a
        and -most_y <= y <= most_y
        and -most_vy <= v_y <= most_vy
        and -most_ay <= a_y <= most_ay
    )


class _Bounds:
    """One bound vector (14 N,) and its blocks, as views."""

    def __init__(self, n: int) -> None:
        self.all = np.zeros(14 * n)
        self.dynamics = self.all[: 6 * n].reshape(n, 6)
        self.speed = self.all[6 * n : 7 * n]
        self.accel = self.all[7 * n : 8 * n]
        self.lateral_accel = self.all[8 * n : 9 * n]
        self.slip_left = self.all[9 * n : 10 * n]
        self.slip_right = self.all[10 * n : 11 * n]
        self.jerk = self.all[11 * n : 13 * n].reshape(n, 2)
        self.limits = self.all[6 * n : 13 * n]
        self.gap = self.all[13 * n :]
        self.rows = self.all[6 * n :]
        """All but the dynamics."""


def _first_bounds(n: int) -> tuple[_Bounds, _Bounds]:
    """Return lower and upper bounds before the first program: those that never change are right."""
    low, high = _Bounds(n), _Bounds(n)
    low.slip_left[:] = -np.inf
    high.slip_right[:] = np.inf
    low.gap[:], high.gap[:] = -_FAR_M, _FAR_M
    return low, high


def program_scale(n: int) -> QPScale:
    """Return the units of the program over n ticks in which OSQP is quick."""
    rows = _Bounds(n)
    rows.all[:] = 1.0
    rows.jerk[:] = _JERK_SCALE
    rows.gap[:] = _GAP_SCALE
    unknowns = np.full(9 * n, _STATE_SCALE)
    unknowns[6 * n : 8 * n] = 1.0
    return QPScale(rows.all, unknowns)


@cache
def _rows(n: int, h: float, slip: float) -> Any:  # noqa: ANN401 - scipy.sparse has no types
    """Return A over x = (e_1 .. e_N, w_0 .. w_N-1, g_1 .. g_N), rows in the order of `_Bounds`."""
    transition, effect = axis_matrices(h)
    eye = sparse.eye(n)
    shift = sparse.diags([np.ones(n - 1)], [-1], shape=(n, n))
    step = sparse.kron(shift, np.kron(np.eye(2), transition)) - sparse.eye(6 * n)
    drive = sparse.kron(eye, np.kron(np.eye(2), effect))

    def pick(*row: float) -> Any:  # noqa: ANN401
        return sparse.kron(eye, np.array([row]))

    return sparse.bmat(
        [
            [step, drive, None],
            [pick(0, 1, 0, 0, 0, 0), None, None],
            [pick(0, 0, 1, 0, 0, 0), None, None],
            [pick(0, 0, 0, 0, 0, 1), None, None],
            [pick(0, -slip, 0, 0, 1, 0), None, None],
            [pick(0, slip, 0, 0, 1, 0), None, None],
            [None, sparse.eye(2 * n), None],
            [pick(1, 0, 0, 0, 0, 0), None, -eye],
        ],
        format="csc",
    )


@cache
def _cost(n: int, h: float) -> Any:  # noqa: ANN401
    """Return P over the same x."""
    along, across = np.diag(_WEIGHTS), np.diag(_LATERAL_WEIGHTS)
    stage = sparse.block_diag([along, across])
    last = sparse.block_diag([_cost_to_go(along, h), _cost_to_go(across, h)])
    return sparse.block_diag(
        [
            sparse.kron(sparse.eye(n - 1), stage),
            last,
            _JERK_WEIGHT * sparse.eye(2 * n),
            _GAP_WEIGHT * sparse.eye(n),
        ],
        format="csc",
    )


def _cost_to_go(weights: Array, h: float) -> Array:
    """Return the fixed point (3, 3) of the Riccati recursion of one axis."""
    transition, effect = axis_matrices(h)
    cost = weights
    for _ in range(1000):
        following = weights + transition.T @ cost @ (transition - effect @ _gain(cost, h))
        if np.abs(following - cost).max() < 1e-9 * np.abs(following).max():
            break
        cost = (following + following.T) / 2.0
    return cost


def _gain(cost: Array, h: float) -> Array:
    """Return K (1, 3) of the last tick before a cost to go (3, 3)."""
    transition, effect = axis_matrices(h)
    gain: Array = effect.T @ cost @ transition / (_JERK_WEIGHT + effect.T @ cost @ effect)
    return gain
