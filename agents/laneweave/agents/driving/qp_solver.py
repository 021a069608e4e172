"""Quadratic programs, solved with OSQP; only this module imports it.

    minimise    1/2 x' P x
    subject to  lower <= A x <= upper

P and A are set up once; the bounds change between solves. OSQP 1.1 accepts vectors of the wrong
length, prints a message and uses old data if lower > upper, keeps a NaN in its warm start, and
returns a finite x for infeasible programs. The module therefore checks all inputs and solutions.
"""

from __future__ import annotations

import math
import signal
from typing import Any

import numpy as np
from attrs import define, evolve, frozen
from numpy.typing import NDArray
from osqp import ext_builtin
from scipy import sparse

Vector = NDArray[np.float64]

SOLVED = 1
SOLVED_INACCURATE = 2
MAX_ITERATIONS = 7
_WITH_SOLUTION = (SOLVED, SOLVED_INACCURATE, MAX_ITERATIONS)
INTERRUPTED = 10
"""Status after OSQP has caught a SIGINT."""

_INFINITY = float(ext_builtin.OSQP_INFTY)


@frozen
class QPSettings:
    """OSQP settings; there is no time limit, because equal inputs must give equal results."""

    eps_abs: float = 1e-3
    """Maximum primal (in units of the constraints) and dual residual of an accepted iterate."""
    max_iter: int = 400
    check_termination: int = 5
    """Iterations between termination tests."""
    rho: float = 0.1
    """Initial step size of ADMM."""
    adaptive_rho_interval: int = 50
    """Iterations between updates of rho; 0: rho is fixed."""
    alpha: float = 1.6
    """Over-relaxation parameter of ADMM, in (0, 2)."""
    eps_infeasible: float = 1e-4
    """Tolerance of the infeasibility certificate."""
    polishing: bool = False
    """Whether OSQP polishes solutions on the active set, usually to machine precision."""
    tolerance: float = 2e-3
    """Maximum violation of a constraint by a usable result, independent of OSQP's status."""


@frozen(eq=False)
class QPScale:
    """Units in which OSQP receives a program, in addition to its own scaling (Ruiz).

    The units determine OSQP's speed: a constraint with a large factor is enforced with a large step
    size, and both kinds of units weight the residuals in the termination test.
    """

    constraints: Vector
    """Positive factors (m,) of the constraints and their bounds."""
    unknowns: Vector
    """Positive units (n,) of x, also used for the gradient."""


@define(eq=False)  # created at each tick: frozen objects take three times as long
class QPResult:
    """Result of one solve."""

    x: Vector
    """Solution (n,); meaningless unless `usable`."""
    usable: bool
    """Whether OSQP terminated and x satisfies all constraints within the tolerance."""
    status: int
    """OSQP's status: 1 solved, 2 inaccurate, 7 out of iterations; others: no solution."""
    iterations: int
    violation: float
    """Maximum violation of a constraint by x, or an upper bound of it; infinite without a
    solution."""


class QuadraticProgram:
    """One quadratic program, set up once and solved repeatedly with changing bounds.

    Use one object per thread. Equal sequences of calls give bit-identical results.
    """

    def __init__(
        self,
        cost: Any,  # noqa: ANN401 - scipy.sparse has no types
        constraints: Any,  # noqa: ANN401
        lower: Vector,
        upper: Vector,
        settings: QPSettings | None = None,
        scale: QPScale | None = None,
    ) -> None:
        """Set up the solver: scaling and factorisation happen here.

        Args:
            cost: P, sparse (n, n), symmetric and positive semidefinite; both triangles.
            constraints: A, sparse (m, n).
            lower: lower bounds (m,); -inf for none.
            upper: upper bounds (m,); +inf for none.
            settings: OSQP settings; None: the defaults.
            scale: units in which OSQP receives the program; None: the caller's units.

        Raises:
            ValueError: the shapes do not match, a matrix is not finite, a bound is NaN,
                lower > upper, or a scale is not positive.
        """
        m, n = constraints.shape
        if cost.shape != (n, n):
            raise ValueError(f"cost has shape {cost.shape}, but there are {n} unknowns")
        self._settings = settings or QPSettings()
        self._scale = _checked_scale(scale or QPScale(np.ones(m), np.ones(n)), m, n)
        self._min_scale = float(self._scale.constraints.min(initial=1.0))
        by_constraints = sparse.diags(self._scale.constraints)
        by_unknowns = sparse.diags(self._scale.unknowns)
        cost_csc = (by_unknowns @ cost @ by_unknowns).tocsc()
        constraints_csc = (by_constraints @ constraints @ by_unknowns).tocsc()
        self._constraints = constraints_csc.tocsr()
        for name, matrix in (("cost", cost_csc), ("constraints", constraints_csc)):
            if not np.isfinite(matrix.data).all():
                raise ValueError(f"{name} has entries that are not finite")
        self._lower, self._upper = np.zeros(m), np.zeros(m)
        self._new_lower, self._new_upper = np.zeros(m), np.zeros(m)
        self._above, self._below = np.zeros(m), np.zeros(m)
        self._zero_x, self._zero_y = np.zeros(n), np.zeros(m)
        self._check_bounds(lower, upper)
        # OSQP reads the upper triangle, sorted by row within each column.
        triangle = cost_csc.copy()
        columns = np.repeat(np.arange(n), np.diff(triangle.indptr))
        triangle.data[triangle.indices > columns] = 0.0
        triangle.eliminate_zeros()
        triangle.sort_indices()
        constraints_csc.sort_indices()
        self._osqp_settings = _osqp_settings(self._settings)
        self._one_iteration_settings = _osqp_settings(
            evolve(self._settings, max_iter=1, check_termination=1)
        )
        self._solver = ext_builtin.OSQPSolver(
            ext_builtin.CSC(triangle),
            self._zero_x,
            ext_builtin.CSC(constraints_csc),
            self._lower,
            self._upper,
            m,
            n,
            self._osqp_settings,
        )

    def update(self, lower: Vector, upper: Vector) -> None:
        """Replace the bounds (m,).

        Raises:
            ValueError: a shape is wrong, a number is NaN, a lower bound is +inf, an upper bound
                is -inf, or lower > upper. The program is then unchanged.
        """
        self._check_bounds(lower, upper)
        self._pass_bounds()

    def replace_equalities(self, constraints: slice, values: Vector) -> None:
        """Replace both bounds of some constraints by equal values, which must be finite."""
        values = values * self._scale.constraints[constraints]
        self._lower[constraints] = self._upper[constraints] = values
        self._pass_bounds()

    def _pass_bounds(self) -> None:
        if self._solver.update_data_vec(q=None, l=self._lower, u=self._upper):
            raise ValueError("OSQP refused the vectors")

    def solve(self) -> QPResult:
        """Solve, warm-started from the previous solution."""
        return self._result(self._run())

    def solve_from(self, x: Vector, multipliers: Vector, *, optimal: bool = True) -> QPResult:
        """Solve, starting from x (n,) and the multipliers (m,) of the constraints.

        The result does not depend on earlier solves unless rho is adaptive. OSQP tests for
        termination after every `check_termination` iterations.

        Args:
            x: in the units of the scale, x / `QPScale.unknowns`.
            multipliers: likewise, divided by `QPScale.constraints`.
            optimal: whether this may be the optimum: OSQP then tests after one iteration, too.
        """
        solver = self._solver
        solver.warm_start(x, multipliers)
        iterations = 0
        if optimal:
            solver.update_settings(self._one_iteration_settings)
            iterations = self._run()
            solver.update_settings(self._osqp_settings)
        if not optimal or int(solver.info.status_val) != SOLVED:
            iterations += self._run()
        return self._result(iterations)

    def _run(self) -> int:
        """Let OSQP iterate from where it is; return the number of iterations."""
        solver = self._solver
        solver.solve()
        if int(solver.info.status_val) == INTERRUPTED:
            # The signal was meant for the process, not for OSQP.
            signal.raise_signal(signal.SIGINT)
            solver.solve()
        return int(solver.info.iter)

    def _result(self, iterations: int) -> QPResult:
        solver = self._solver
        status = int(solver.info.status_val)
        scaled: Vector = solver.solution.x
        violation = math.inf
        if status == SOLVED:
            # A bound: OSQP measures the violation where it terminates.
            violation = float(solver.info.prim_res) / self._min_scale
        if not violation <= self._settings.tolerance and status in _WITH_SOLUTION:
            violation = self._violation(scaled)
        usable = violation <= self._settings.tolerance
        result = QPResult(scaled * self._scale.unknowns, usable, status, iterations, violation)
        if not usable:
            self.reset()
        return result

    def reset(self) -> None:
        """Discard the previous solution, so that the next solve starts from zero."""
        self._solver.warm_start(self._zero_x, self._zero_y)
        if self._settings.adaptive_rho_interval:
            self._solver.update_rho(self._settings.rho)

    def _violation(self, scaled: Vector) -> float:
        values = self._constraints @ scaled
        np.subtract(values, self._upper, out=self._above)
        np.subtract(self._lower, values, out=self._below)
        np.maximum(self._above, self._below, out=self._above)
        self._above /= self._scale.constraints
        # A NaN anywhere propagates and fails every comparison.
        return max(float(self._above.max()), 0.0) if self._above.size else 0.0

    def _check_bounds(self, lower: Vector, upper: Vector) -> None:
        """Check and store the bounds, clipped to OSQP's infinity; on an error, change nothing."""
        shape = self._lower.shape
        if lower.shape != shape or upper.shape != shape:
            raise ValueError(f"bounds have shapes {lower.shape}, {upper.shape}, expected {shape}")
        np.multiply(lower, self._scale.constraints, out=self._new_lower)
        np.multiply(upper, self._scale.constraints, out=self._new_upper)
        np.maximum(self._new_lower, -_INFINITY, out=self._new_lower)
        np.minimum(self._new_upper, _INFINITY, out=self._new_upper)
        if not (self._new_lower <= self._new_upper).all():
            row = int(np.argmin(self._new_lower <= self._new_upper))
            raise ValueError(f"constraint {row}: bounds [{lower[row]}, {upper[row]}] are empty")
        self._lower, self._new_lower = self._new_lower, self._lower
        self._upper, self._new_upper = self._new_upper, self._upper


def _checked_scale(scale: QPScale, m: int, n: int) -> QPScale:
    for name, factors, size in (
        ("constraint", scale.constraints, m),
        ("unknown", scale.unknowns, n),
    ):
        if factors.shape != (size,) or not (np.isfinite(factors) & (factors > 0.0)).all():
            raise ValueError(f"{name} scale is not {size} positive numbers")
    return scale


def _osqp_settings(settings: QPSettings) -> Any:  # noqa: ANN401 - OSQP's own type has no stub
    osqp = ext_builtin.OSQPSettings()
    ext_builtin.osqp_set_default_settings(osqp)
    osqp.verbose = 0
    osqp.eps_abs = settings.eps_abs
    osqp.eps_rel = 0.0
    osqp.max_iter = settings.max_iter
    osqp.check_termination = settings.check_termination
    osqp.rho = settings.rho
    osqp.alpha = settings.alpha
    osqp.adaptive_rho = 1 if settings.adaptive_rho_interval else 0
    osqp.adaptive_rho_interval = settings.adaptive_rho_interval
    osqp.check_dualgap = 0
    osqp.polishing = int(settings.polishing)
    osqp.eps_prim_inf = settings.eps_infeasible
    return osqp
