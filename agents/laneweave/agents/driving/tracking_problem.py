"""The tracker's quadratic program: costs, constraints and their bounds.

In error coordinates z = z_ref + e, u = u_ref + w, over N ticks of h seconds:

    minimise    sum_k 1/2 (e_k' Q e_k + w_k' R w_k) + 1/2 e_N' S e_N + 1/2 G sum_k g_k^2
    subject to  e_{k+1} = A e_k + B w_k + c_k                  exact: jerks are constant per tick
                0 <= v_k <= v_max,  a_min <= a_k <= a_max,  |a_y,k| <= a_y,max
                |v_y,k| <= slip v_k                            no sliding sideways
                |j_s,k| <= j_max,  |j_y,k| <= j_y,max
                earliest_k <= s_k - g_k <= latest_k            vehicles behind and ahead (`Gaps`)

c is zero for a reference that obeys the dynamics. S is the cost to go of the unconstrained problem.
On the reference the solution is exactly zero; in absolute coordinates, the solver's tolerance would
leave noise of 1.6 m/s3 on the jerk. The slack g has a quadratic penalty, because an exact (linear)
one takes four times as long. All matrices are set up once; each tick changes only bounds.
"""

from __future__ import annotations

import threading
from functools import cache
from typing import Any

import numpy as np
from attrs import define, frozen
from numpy.typing import NDArray
from scipy import sparse

from laneweave.agents.driving.qp_solver import QPResult, QPScale, QPSettings, QuadraticProgram
from laneweave.agents.driving.regulator import (
    JERK_WEIGHT,
    LATERAL_WEIGHTS,
    WEIGHTS,
    axis_matrices,
    cost_to_go,
    shared_regulator,
)
from laneweave.protocol.scenario.vehicle_tables import Vehicle
from laneweave.protocol.vehicle.motion import State, integrate

Array = NDArray[np.float64]

_GAP_WEIGHT = 10.0
# With a fixed rho, a solve depends only on where it starts. Most need one iteration.
SETTINGS = QPSettings(
    eps_abs=6e-3,
    max_iter=100,
    check_termination=4,
    rho=0.1,
    adaptive_rho_interval=0,
    alpha=1.25,
    tolerance=2e-2,
)
_GAP_SCALE, _JERK_SCALE = 20.0, 0.4
"""Scales of gap and jerk constraints, 1 for others; at 1, active gaps take 300 iterations."""
_STATE_SCALE = 0.3
"""Scale of states and slacks for OSQP; 1 for jerks, because their gradient must vanish."""
_MAX_PROGRAMS = 32
"""Maximum number of programs kept in a thread, of 0.7 MB each."""
FAR_M = 1e4
"""Bound where there is no vehicle: finite, so that OSQP keeps the constraint's type."""
_MAX_PUSH_M = 1.0
"""Maximum distance by which vehicles behind can push this one past its reference."""
_SPEED_TOLERANCE_MPS = 0.3
_SLIP_TOLERANCE_MPS = 0.1
"""Amounts by which OSQP's predictions may violate speed >= 0 and the slip limit."""


@frozen(eq=False)
class Gaps:
    """Bounds set by other vehicles, now and at the next N ticks [m].

    Commanded positions (N + 1,), infinite at ticks without a bound; of the front bumper unless
    noted.
    """

    earliest: Array | None = None
    """Lower bounds set by vehicles behind; None: there are none."""
    latest: Array | None = None
    """Upper bounds set by vehicles ahead; None: there are none."""
    stopping: Array | None = None
    """Upper bounds of the stopping points (`StoppingPoints`); None: there are none."""

    def check(self, ticks: int) -> None:
        """Check the shapes for a horizon of N ticks.

        Raises:
            ValueError: a shape is not (N + 1,).
        """
        shape = (ticks + 1,)
        for name in ("earliest", "latest", "stopping"):
            positions = getattr(self, name)
            if positions is not None and positions.shape != shape:
                raise ValueError(f"{name} has shape {positions.shape}, expected {shape}")


NO_GAPS = Gaps()


@define(eq=False)
class ErrorBounds:
    """Bounds, for n ticks, within which errors from a reference exceed no limit.

    Unlike the program's bounds, they have no tolerance near standstill, so that the tracker's
    shortcut is exact.
    """

    low: Array
    """Lower bounds (5, n) of v, a, a_y, v_y - slip v and v_y + slip v; -inf for none."""
    high: Array
    """Upper bounds (5, n); +inf for none."""
    low_jerk: Array
    """Lower bounds (n, 2) of the jerks."""
    high_jerk: Array

    @classmethod
    def around(cls, states: Array, jerks: Array, limits: Vehicle) -> ErrorBounds:
        """Return the bounds for a reference with states (n, 6) and jerks (n, 2).

        The tolerance is added and subtracted to get the same rounding as in the program's bounds.
        """
        _, speed, accel, _, slip, lateral_accel = states.T
        low, high = np.full((5, len(states)), -np.inf), np.full((5, len(states)), np.inf)
        low[0] = (-_SPEED_TOLERANCE_MPS - speed) + _SPEED_TOLERANCE_MPS
        high[0] = limits.max_speed_mps - speed
        low[1] = limits.min_accel_mps2 - accel
        high[1] = limits.max_accel_mps2 - accel
        low[2] = -limits.max_lateral_accel_mps2 - lateral_accel
        high[2] = limits.max_lateral_accel_mps2 - lateral_accel
        margin = limits.max_slip_ratio * speed + _SLIP_TOLERANCE_MPS
        high[3] = (margin - slip) - _SLIP_TOLERANCE_MPS
        low[4] = -(margin + slip) + _SLIP_TOLERANCE_MPS
        max_jerk = np.array([limits.max_jerk_mps3, limits.max_lateral_jerk_mps3])
        return cls(low, high, -(max_jerk + jerks), max_jerk - jerks)

    def part(self, first: int, end: int) -> ErrorBounds:
        """Return the bounds for ticks `first` (inclusive) to `end` (exclusive)."""
        return ErrorBounds(
            self.low[:, first:end],
            self.high[:, first:end],
            self.low_jerk[first:end],
            self.high_jerk[first:end],
        )


class ConstraintBounds:
    """Lower or upper bounds (14 N,) of all constraints, with a view of each block."""

    def __init__(self, n: int) -> None:
        """Initialise with zeros for N ticks."""
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


@frozen
class ProgramKind:
    """Parameters that distinguish programs."""

    ticks: int
    """Horizon N."""
    tick_s: float
    speed_mps: float
    """v_F."""
    limits: Vehicle
    settings: QPSettings = SETTINGS


class TrackingProgram:
    """The quadratic program of all vehicles with the same limits; each tick writes its bounds.

    A solve does not depend on earlier ones, so vehicles can share a program, and OSQP's memory
    stays in the processor's caches. A program belongs to one thread (`shared_program`).
    """

    def __init__(self, kind: ProgramKind) -> None:
        """Prepare the bounds; OSQP is set up on first use."""
        self._kind, self.thread = kind, threading.get_ident()
        n, tick_s, limits = kind.ticks, kind.tick_s, kind.limits
        self._n, self._tick_s, self._limits = n, tick_s, limits
        self._max_jerk = np.array([limits.max_jerk_mps3, limits.max_lateral_jerk_mps3])
        self.cost = _cost(n, tick_s)
        """P, sparse, over x = (e_1 .. e_N, w_0 .. w_N-1, g_1 .. g_N)."""
        self.constraints = _constraints(n, tick_s, limits.max_slip_ratio)
        """A, sparse; the first 6 N constraints are the dynamics."""
        self.low, self.high = _initial_bounds(n)
        self._gaps = NO_GAPS
        self._holds = False
        """Whether the bounds are those of a vehicle that holds a cell, with no other vehicle."""
        self._osqp_holds = False
        """Whether OSQP has such bounds, for some e_0."""
        self._qp: QuadraticProgram | None = None
        regulator, scale = shared_regulator(n, tick_s, limits.max_slip_ratio), program_scale(n)
        solution = np.concatenate([regulator.errors, regulator.inputs])
        self._solution = solution / scale.unknowns[: 8 * n, None]
        self._gradients = regulator.multipliers / scale.constraints[: 6 * n, None]
        self._start, self._multipliers = np.zeros(9 * n), np.zeros(14 * n)
        """Where OSQP starts; slacks and the multipliers of inequalities stay zero."""

    def __reduce__(self) -> tuple[Any, ...]:
        """Return how to restore the program: copies share it, too."""
        return shared_program, (self._kind,)

    def solve(self, error: State) -> QPResult:
        """Solve with the most recently written bounds, starting from the regulator's solution.

        If no inequality binds, this is the solution, and OSQP ends after one iteration.

        Args:
            error: e_0, as in `write_bounds`.
        """
        qp = self._qp
        if qp is None:
            qp = self.set_up()
        if self._holds and self._osqp_holds:
            qp.replace_equalities(slice(6), self.low.dynamics[0])
        else:
            self._osqp_holds = False
            qp.update(self.low.all, self.high.all)
            self._osqp_holds = self._holds
        n = self._n
        self._solution.dot(error, out=self._start[: 8 * n])
        self._gradients.dot(error, out=self._multipliers[: 6 * n])
        optimal = self._gaps is NO_GAPS or self.keeps_gaps(self._start[: 6 * n : 6] * _STATE_SCALE)
        return qp.solve_from(self._start, self._multipliers, optimal=optimal)

    def keeps_gaps(self, positions: Array) -> bool:
        """Return whether position errors (N,) are within the gap bounds written last."""
        low, high = self.low.gap, self.high.gap
        return bool((low <= positions).all() and (positions <= high).all())

    def set_up(self) -> QuadraticProgram:
        """Set up OSQP with initial bounds; results then do not depend on the time of the set-up."""
        low, high = _initial_bounds(self._n)
        self._osqp_holds = False
        self._qp = QuadraticProgram(
            self.cost,
            self.constraints,
            low.all,
            high.all,
            settings=self._kind.settings,
            scale=program_scale(self._n),
        )
        return self._qp

    def jerks(self, result: QPResult) -> Array:
        """Return the jerks w (N, 2) of a solution."""
        return result.x[6 * self._n : 8 * self._n].reshape(-1, 2)

    def write_bounds(
        self,
        error: State,
        states: Array,
        jerks: Array,
        defect: Array | None,
        gaps: Gaps,
        *,
        holds: bool = False,
    ) -> None:
        """Write all bounds.

        Args:
            error: e_0.
            states: states of the reference (N + 1, 6).
            jerks: jerks of the reference (N, 2).
            defect: c (N, 3) along the road; None: zero.
            gaps: bounds set by other vehicles.
            holds: whether the reference holds a cell throughout.
        """
        low, high, limits = self.low, self.high, self._limits
        first, holds = low.dynamics[0], holds and gaps is NO_GAPS
        # False until all bounds are written.
        held, self._holds = self._holds and self._gaps is NO_GAPS, False
        if holds and held:
            self._holds = True
            np.negative(integrate(error, (0.0, 0.0), self._tick_s), out=first)
            high.dynamics[0] = first
            return
        low.dynamics[:] = 0.0
        if defect is not None:
            low.dynamics[:, :3] -= defect
        self.write_gaps(states, gaps)
        low.dynamics[0] -= integrate(error, (0.0, 0.0), self._tick_s)
        high.dynamics[:] = low.dynamics

        _, speed, accel, _, slip, lateral_accel = states[1:].T
        np.subtract(-_SPEED_TOLERANCE_MPS, speed, out=low.speed)
        np.subtract(limits.max_speed_mps, speed, out=high.speed)
        np.subtract(limits.min_accel_mps2, accel, out=low.accel)
        np.subtract(limits.max_accel_mps2, accel, out=high.accel)
        np.subtract(-limits.max_lateral_accel_mps2, lateral_accel, out=low.lateral_accel)
        np.subtract(limits.max_lateral_accel_mps2, lateral_accel, out=high.lateral_accel)
        margin = limits.max_slip_ratio * speed
        margin += _SLIP_TOLERANCE_MPS
        np.subtract(margin, slip, out=high.slip_left)
        np.add(margin, slip, out=low.slip_right)
        np.negative(low.slip_right, out=low.slip_right)
        np.subtract(self._max_jerk, jerks, out=high.jerk)
        np.add(self._max_jerk, jerks, out=low.jerk)
        np.negative(low.jerk, out=low.jerk)
        self._holds = holds

    def write_gaps(self, states: Array, gaps: Gaps) -> None:
        """Write the bounds of the gap constraints for a reference (N + 1, 6)."""
        low, high = self.low.gap, self.high.gap
        if gaps.latest is not None:
            np.subtract(gaps.latest[1:], states[1:, 0], out=high)
            # Where even the yielding path violates a gap, the bound is that path.
            high.clip(0.0, FAR_M, out=high)
        elif self._gaps.latest is not None:
            high[:] = FAR_M
        if gaps.earliest is not None:
            np.subtract(gaps.earliest[1:], states[1:, 0], out=low)
            low.clip(-FAR_M, _MAX_PUSH_M, out=low)
            np.minimum(low, high, out=low)
        elif self._gaps.earliest is not None:
            low[:] = -FAR_M
        self._gaps = gaps

    def admit_zero(self) -> None:
        """Widen the bounds of the limits so that zero, the reference itself, is feasible."""
        self._holds = False
        np.minimum(self.low.limits, 0.0, out=self.low.limits)
        np.maximum(self.high.limits, 0.0, out=self.high.limits)


def shared_program(kind: ProgramKind) -> TrackingProgram:
    """Return the program of a kind in this thread."""
    programs = _THREAD.programs
    program = programs.get(kind)
    if program is None:
        if len(programs) >= _MAX_PROGRAMS:
            del programs[next(iter(programs))]
        program = programs[kind] = TrackingProgram(kind)
    return program


class _Thread(threading.local):
    """Programs of one thread, oldest first."""

    def __init__(self) -> None:
        """Begin without programs; called once in each thread."""
        self.programs: dict[ProgramKind, TrackingProgram] = {}


_THREAD = _Thread()


def program_scale(n: int) -> QPScale:
    """Return units in which OSQP solves the program over n ticks quickly."""
    factors = ConstraintBounds(n)
    factors.all[:] = 1.0
    factors.jerk[:] = _JERK_SCALE
    factors.gap[:] = _GAP_SCALE
    unknowns = np.full(9 * n, _STATE_SCALE)
    unknowns[6 * n : 8 * n] = 1.0
    return QPScale(factors.all, unknowns)


def _initial_bounds(n: int) -> tuple[ConstraintBounds, ConstraintBounds]:
    """Return lower and upper bounds, with the constant ones filled in."""
    low, high = ConstraintBounds(n), ConstraintBounds(n)
    low.slip_left[:] = -np.inf
    high.slip_right[:] = np.inf
    low.gap[:], high.gap[:] = -FAR_M, FAR_M
    return low, high


@cache
def _constraints(n: int, h: float, slip: float) -> Any:  # noqa: ANN401 - scipy.sparse has no types
    """Return A, with constraints in the order of `ConstraintBounds`."""
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
    """Return the matrix P."""
    stage = sparse.block_diag([WEIGHTS, LATERAL_WEIGHTS])
    last = sparse.block_diag([cost_to_go(WEIGHTS, h), cost_to_go(LATERAL_WEIGHTS, h)])
    return sparse.block_diag(
        [
            sparse.kron(sparse.eye(n - 1), stage),
            last,
            JERK_WEIGHT * sparse.eye(2 * n),
            _GAP_WEIGHT * sparse.eye(n),
        ],
        format="csc",
    )
