"""Trajectories between cells, within all limits of the vehicle.

In the moving frame a vehicle goes from rest to rest. A minimum-jerk quintic over one cell in 3.8 s
needs 6 m/s2, more than the vehicle's limit. A move is therefore the solution of a quadratic program
over n ticks of h seconds,

    minimise    sum_k j_s,k^2 + j_y,k^2 + w a_s,k^2
    subject to  z_{k+1} = A z_k + B u_k,  z_0 = 0,  z_n = (ds, 0, 0, dy, 0, 0)
                speed, acceleration, jerk and slip within a fraction of the vehicle's limits

which each process solves once per kind of move. The jerks are then integrated exactly and the
result is checked against all limits, whatever the solver's status.

States are commanded states (`protocol.vehicle.motion`): the body follows them with the lag of its
actuators, and is 0.1 m short of its cell at the end of the move, 0.04 m at the end of the slot
(default lags). A forward move may approach a vehicle that holds in the cell beyond the target; it
stays far enough behind that the emergency brake (`protocol.vehicle.emergency_brake`) does not act,
with a margin for errors:

    s_{k+r} + (lag + r h) v_F + (v_F + v_{k+r})^2 / (2 b)
        <=  2 d_F - L + braking distance of the vehicle ahead - margin - errors

for every tick k, with r ticks of reaction time; the square is replaced by its tangents.

Where the duration permits, moves by a column are *gentle* (decision 76): w is positive, the vehicle
brakes no harder than it may accelerate, and its time to collision with a vehicle that holds beyond
the target, ahead or behind, stays above a bound tau, which is linear too:

    |s_k| + tau |v_k|  <=  2 d_F - L

Otherwise w is 0.
"""

from __future__ import annotations

from contextlib import suppress
from functools import lru_cache, partial
from typing import Any

import numpy as np
from attrs import frozen
from numpy.typing import NDArray
from scipy import sparse

from laneweave.agents.driving.move_bounds import CLOSING_SPEEDUP, Envelope, TtcBound, ttc_bounds
from laneweave.agents.driving.qp_solver import MAX_ITERATIONS, QPSettings, QuadraticProgram
from laneweave.agents.driving.regulator import axis_matrices
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.lattice import displacements
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.vehicle_tables import Vehicle
from laneweave.protocol.wire.messages import CAR

Array = NDArray[np.float64]

LIMIT_SHARE = 0.96
"""Fraction of each limit that a trajectory uses; the tracker needs the rest."""
_END_TOLERANCE = 1e-3
"""Maximum error at the end of a trajectory [m, m/s, m/s2]."""
_LIMIT_TOLERANCE = 1e-4
"""Maximum excess over `LIMIT_SHARE` of a limit [m/s, m/s2, m/s3]."""
_MAX_BEHIND_M = 0.4
"""Maximum distance of a settling vehicle behind its cell; the room beyond is that of others."""
_TANGENTS = 5
_ACCEL_WEIGHT = 5.0
"""Cost of squared accelerations relative to squared jerks in gentle moves [1/s2]."""
_SETTINGS = QPSettings(
    eps_abs=1e-5,  # polishing makes solutions exact
    max_iter=40_000,
    check_termination=25,
    rho=0.3,
    alpha=1.8,
    eps_infeasible=1e-8,
    polishing=True,
    tolerance=1e-4,
)


class InfeasibleTrajectoryError(ValueError):
    """No trajectory of the given duration keeps all limits."""


@frozen(eq=False)
class Trajectory:
    """Samples of a motion in the moving frame; they obey the discrete dynamics exactly."""

    states: Array
    """(n + 1, 6): s [m], v [m/s] and a [m/s2] along the road, s and v relative to the lattice;
    y [m], v_y [m/s], a_y [m/s2]."""
    jerks: Array
    """(n, 2): j_s, j_y [m/s3], constant during each tick."""

    @property
    def ticks(self) -> int:
        """Duration n [ticks]."""
        return len(self.jerks)


@lru_cache(maxsize=256)
def move_profile(
    scenario: Scenario, limits: Vehicle, dx: int, dy: int, ticks: int | None = None
) -> Trajectory:
    """Return the move by `dx` columns and `dy` lanes, from rest at the origin; cached per process.

    It is gentle if the limits allow that in the duration, otherwise of minimum jerk.

    Args:
        scenario: tick, lattice, sensors and brakes.
        limits: those of the vehicle.
        dx: columns, -1 to 1.
        dy: lanes, -1 to 1.
        ticks: duration; None: that of a move in the scenario's shortest T_F.

    Raises:
        InfeasibleTrajectoryError: the move cannot be driven within the limits.
        ValueError: the cells are not neighbours.
    """
    if abs(dx) > 1 or abs(dy) > 1:
        raise ValueError(f"({dx}, {dy}) does not lead to a neighbouring cell")
    if ticks is None:
        ticks = scenario.timing.move_ticks(scenario.timing.cycles_s[0])
    pitch_m, tick_s = scenario.formation.gap_m, scenario.runtime.tick_s
    beyond_m = 2.0 * pitch_m - scenario.types.longest_body_m
    return plan_trajectory(
        limits,
        scenario.formation.speed_mps,
        tick_s,
        ticks,
        dx * pitch_m,
        dy * scenario.road.lane_width_m,
        Envelope.behind(scenario, limits, beyond_m) if dx > 0 else None,
        ttc_bounds(dx, beyond_m, pitch_m, ticks * tick_s),
    )


def check_moves(scenario: Scenario) -> None:
    """Check that all moves of a scenario, for all T_F, can be driven within the types' limits.

    Raises:
        BadInputError: a move cannot be driven.
    """
    for name, own in scenario.types.items():
        whose = "vehicle" if name == CAR else f"vehicle_type of {name}"
        for slot_s in scenario.timing.slots_s:
            for dx, dy in displacements(scenario.formation.mode)[1:]:
                if (dx, dy) not in own.moves:
                    continue
                try:
                    move_profile(scenario, own.limits, dx, dy, scenario.timing.move_ticks(slot_s))
                except InfeasibleTrajectoryError as error:
                    change = f"the lateral limits in table {whose}"
                    if dx != 0:
                        change = f"the limits in table {whose}"
                    if dx > 0:
                        change = "formation.gap_m or the table braking"
                    raise BadInputError(
                        "formation.move_s",
                        slot_s - scenario.formation.slack_s,
                        f"long enough for a move of a {name} by {_distance(dx, dy)} "
                        f"({error}), or change {change}",
                    ) from error


def _distance(dx: int, dy: int) -> str:
    """Return the distance of a move in words."""
    parts = ((dx, "column"), (dy, "lane"))
    return " and ".join(f"{n} {what}" for n, what in parts if n)


@lru_cache(maxsize=256)
def plan_trajectory(
    limits: Vehicle,
    speed_mps: float,
    tick_s: float,
    ticks: int,
    ds_m: float,
    dy_m: float,
    envelope: Envelope | None = None,
    bounds: tuple[TtcBound, ...] = (),
) -> Trajectory:
    """Return the trajectory of minimum cost from rest at (0, 0) to rest at (ds, dy).

    The cache contains the choice of the bound, so that infeasible bounds are tried only once.

    Args:
        limits: the vehicle's limits.
        speed_mps: v_F.
        tick_s: length of a tick.
        ticks: duration.
        ds_m: distance along the road, relative to the lattice.
        dy_m: distance across the road.
        envelope: bound that leaves room to brake; None: no bound.
        bounds: bounds of a gentle move, in the order in which they are tried; if none of them is
            feasible, the trajectory is of minimum jerk.

    Raises:
        InfeasibleTrajectoryError: there is no trajectory within the limits.
        ValueError: a number is not finite.
    """
    if ds_m == 0.0 and dy_m == 0.0:
        return _integrated(np.zeros((ticks, 2)), tick_s)
    plan = partial(_planned, limits, speed_mps, tick_s, ticks, (ds_m, dy_m), envelope)
    for bound in bounds:
        with suppress(InfeasibleTrajectoryError):
            return plan(bound)
    return plan(None)


def _planned(
    limits: Vehicle,
    speed_mps: float,
    tick_s: float,
    ticks: int,
    end_m: tuple[float, float],
    envelope: Envelope | None,
    ttc_bound: TtcBound | None,
) -> Trajectory:
    """Return the trajectory with a bound on the time to collision; None: of minimum jerk.

    Raises:
        InfeasibleTrajectoryError, ValueError: as in `plan_trajectory`.
    """
    ds_m, dy_m = end_m
    # A unit of time of an eighth of the duration gives all states similar magnitudes.
    unit_s = ticks * tick_s / 8.0
    program = _trajectory_program(
        limits, speed_mps, tick_s / unit_s, unit_s, ticks, end_m, envelope, ttc_bound
    )
    what = f"{ds_m:g} m along and {dy_m:g} m across in {ticks * tick_s:g} s"
    if envelope is not None:
        what += ", with room to brake behind a vehicle that holds beyond the target"
    solution = program.solve()
    if not solution.usable:
        why = " found in time" if solution.status == MAX_ITERATIONS else ""
        raise InfeasibleTrajectoryError(
            f"{what}: no trajectory within {LIMIT_SHARE:.0%} of the vehicle's limits{why}"
        )
    jerks = solution.x[6 * ticks :].reshape(2, ticks).T / unit_s**3
    trajectory = _integrated(jerks, tick_s)
    end_error = np.abs(trajectory.states[-1] - (ds_m, 0.0, 0.0, dy_m, 0.0, 0.0)).max()
    excess = _excess(trajectory, limits, speed_mps, ttc_bound)
    if not (end_error < _END_TOLERANCE and excess < _LIMIT_TOLERANCE):
        raise InfeasibleTrajectoryError(
            f"{what}: the best trajectory misses its end by {end_error:.2g} and a limit by "
            f"{excess:.2g}"
        )
    return trajectory


def _trajectory_program(
    limits: Vehicle,
    speed_mps: float,
    h: float,
    unit_s: float,
    n: int,
    end_m: tuple[float, float],
    envelope: Envelope | None,
    ttc_bound: TtcBound | None,
) -> QuadraticProgram:
    """Return the program in units of `unit_s`: x = (z_s [3n], z_y [3n], j_s [n], j_y [n])."""
    constraints = _constraints(limits, speed_mps, h, unit_s, n, envelope, ttc_bound)
    lower, upper = constraints.lower.copy(), constraints.upper.copy()
    lower[constraints.ends] = upper[constraints.ends] = [end_m[0], 0.0, 0.0, end_m[1], 0.0, 0.0]
    cost = _cost(n, 0.0 if ttc_bound is None else _ACCEL_WEIGHT * unit_s**2)
    return QuadraticProgram(cost, constraints.matrix, lower, upper, settings=_SETTINGS)


def _cost(n: int, accel_weight: float = 0.0) -> Any:  # noqa: ANN401 - scipy.sparse has no types
    """Return the cost matrix of the squared jerks, and accelerations a_s, of n ticks."""
    along = np.tile([0.0, 0.0, accel_weight], n)
    return sparse.diags([np.concatenate([along, np.zeros(3 * n), np.ones(2 * n)])], [0])


@frozen(eq=False)
class _Constraints:
    """Linear constraints lower <= matrix x <= upper."""

    matrix: Any
    lower: Array
    upper: Array
    ends: slice
    """Rows of z_n, whose bounds are 0."""


@lru_cache(maxsize=8)  # all bounds, for one duration after another
def _constraints(
    limits: Vehicle,
    speed_mps: float,
    h: float,
    unit_s: float,
    n: int,
    envelope: Envelope | None,
    ttc_bound: TtcBound | None,
) -> _Constraints:
    """Return the constraints that all trajectories of one duration share; cached."""
    transition, effect = axis_matrices(h)
    eye = sparse.eye(n)
    shift = sparse.diags([np.ones(n - 1)], [-1], shape=(n, n)) if n > 1 else sparse.eye(1) * 0.0
    step = sparse.kron(shift, transition) - sparse.eye(3 * n)
    drive = sparse.kron(eye, effect)
    last = sparse.csr_matrix(
        (np.ones(3), (np.arange(3), np.arange(3 * n - 3, 3 * n))), shape=(3, 3 * n)
    )

    def pick(index: int) -> Any:  # noqa: ANN401 - scipy.sparse has no types
        return sparse.kron(eye, np.eye(3)[index : index + 1])

    slip = limits.max_slip_ratio * LIMIT_SHARE
    v_unit, a_unit, j_unit = unit_s * LIMIT_SHARE, unit_s**2 * LIMIT_SHARE, unit_s**3 * LIMIT_SHARE
    infinite = np.inf
    # Columns of x, lower bound, upper bound.
    rows: list[tuple[list[Any], Any, Any]] = [
        ([step, None, drive, None], 0.0, 0.0),
        ([None, step, None, drive], 0.0, 0.0),
        (
            [pick(1), None, None, None],
            -v_unit * speed_mps,
            v_unit * (limits.max_speed_mps - speed_mps),
        ),
        (
            [pick(2), None, None, None],
            a_unit * limits.min_accel_mps2,
            a_unit * limits.max_accel_mps2,
        ),
        ([None, pick(2), None, None], *_both(a_unit * limits.max_lateral_accel_mps2)),
        ([-slip * pick(1), pick(1), None, None], -infinite, slip * speed_mps * unit_s),
        ([slip * pick(1), pick(1), None, None], -slip * speed_mps * unit_s, infinite),
        ([None, None, eye, None], *_both(j_unit * limits.max_jerk_mps3)),
        ([None, None, None, eye], *_both(j_unit * limits.max_lateral_jerk_mps3)),
        ([last, None, None, None], 0.0, 0.0),
        ([None, last, None, None], 0.0, 0.0),
    ]
    ends_after = len(rows)
    if envelope is not None:
        brake, later = envelope.brake_mps2, eye.tocsr()[envelope.ticks - 1 :]
        for share in np.linspace(0.0, CLOSING_SPEEDUP, _TANGENTS):
            speed = speed_mps * (1.0 + share)
            # At this speed: v^2 / (2 b) >= speed (2 v - speed) / (2 b).
            row = sparse.kron(later, np.array([[1.0, speed / brake / unit_s, 0.0]]))
            max_m = envelope.max_m - speed * (2.0 * speed_mps - speed) / (2.0 * brake)
            rows.append(([row, None, None, None], -infinite, max_m))
    if ttc_bound is not None:
        way = np.array([[1.0, ttc_bound.ttc_s / unit_s, 0.0]])
        row = ttc_bound.direction * sparse.kron(eye, way)
        rows.append(([row, None, None, None], -infinite, ttc_bound.gap_m))
        rows.append(([pick(2), None, None, None], -a_unit * _gentle_brake_mps2(limits), infinite))
    heights = [next(m for m in blocks if m is not None).shape[0] for blocks, _, _ in rows]
    end = sum(heights[:ends_after])
    return _Constraints(
        sparse.bmat([blocks for blocks, _, _ in rows]),
        np.concatenate([np.full(m, low) for m, (_, low, _) in zip(heights, rows, strict=True)]),
        np.concatenate([np.full(m, high) for m, (_, _, high) in zip(heights, rows, strict=True)]),
        slice(end - 6, end),
    )


def _gentle_brake_mps2(limits: Vehicle) -> float:
    """Return the hardest braking of gentle moves: no harder than the vehicle may accelerate."""
    return min(limits.max_accel_mps2, -limits.min_accel_mps2)


def _both(limit: float) -> tuple[float, float]:
    return -limit, limit


def settling_trajectory(
    scenario: Scenario, limits: Vehicle, start: Array, ticks: int
) -> Trajectory:
    """Return the trajectory of minimum squared jerk from a state to rest at the origin.

    Vehicles that keep their columns may enter far more slowly than v_F. In the short time that they
    have, only a trajectory that uses the limits throughout is within them; it also stays ahead of
    the cell. If none is found, the limits are ignored: the tracker keeps them.

    Args:
        scenario: source of the tick length.
        limits: those of the vehicle.
        start: state (6,) relative to the final lattice point.
        ticks: duration, at least three.
    """
    tick_s, speed_mps = scenario.runtime.tick_s, scenario.lattice.speed_mps
    reach, power = _reach(tick_s, ticks)
    ends = np.stack([power @ start[:3], power @ start[3:]], axis=1)
    jerks = np.asarray(np.linalg.lstsq(reach, -ends, rcond=None)[0], dtype=np.float64)
    free = _integrated(jerks, tick_s, start)
    behind_m = min(start[0], 0.0) - _MAX_BEHIND_M
    if scenario.formation.change_columns or (
        _excess(free, limits, speed_mps) < _LIMIT_TOLERANCE and free.states[:, 0].min() >= behind_m
    ):
        return free
    unit_s = ticks * tick_s / 8.0
    program = _settling_program(limits, speed_mps, tick_s, ticks, start, behind_m)
    solution = program.solve()
    if not solution.usable:
        return free
    return _integrated(solution.x[6 * ticks :].reshape(2, ticks).T / unit_s**3, tick_s, start)


def _settling_program(
    limits: Vehicle, speed_mps: float, tick_s: float, n: int, start: Array, behind_m: float
) -> QuadraticProgram:
    """Return the program of a motion from a state to rest at the origin; see `settling_trajectory`.

    Its units are those of `_trajectory_program`.
    """
    unit_s = n * tick_s / 8.0
    constraints = _constraints(limits, speed_mps, tick_s / unit_s, unit_s, n, None, None)
    lower, upper = constraints.lower.copy(), constraints.upper.copy()
    transition, _ = axis_matrices(tick_s / unit_s)
    units = np.array([1.0, unit_s, unit_s**2])
    for first, part in ((0, start[:3]), (3 * n, start[3:])):
        rows = slice(first, first + 3)
        lower[rows] = upper[rows] = -transition @ (part * units)
    width = constraints.matrix.shape[1]
    ahead = sparse.csr_matrix((np.ones(n), (np.arange(n), np.arange(0, 3 * n, 3))), (n, width))
    return QuadraticProgram(
        _cost(n),
        sparse.vstack([constraints.matrix, ahead]),
        np.concatenate([lower, np.full(n, behind_m)]),
        np.concatenate([upper, np.full(n, np.inf)]),
        settings=_SETTINGS,
    )


@lru_cache(maxsize=256)
def _reach(tick_s: float, ticks: int) -> tuple[Array, Array]:
    """Return matrices (3, ticks) and (3, 3) that map jerks and initial state to the final state."""
    transition, effect = axis_matrices(tick_s)
    power: Array = np.eye(3)
    effects = []
    for _ in range(ticks):
        effects.append(power @ effect[:, 0])
        power = transition @ power
    return np.array(effects[::-1]).T, power


def _integrated(jerks: Array, tick_s: float, start: Array | None = None) -> Trajectory:
    """Return the trajectory that jerks (n, 2) give from a state, by default rest at the origin."""
    transition, effect = axis_matrices(tick_s)
    states = np.zeros((len(jerks) + 1, 6))
    if start is not None:
        states[0] = start
    effect, first, second = effect[:, 0], states[:, :3], states[:, 3:]
    for k, (along, across) in enumerate(jerks.tolist()):
        first[k + 1] = transition @ first[k] + effect * along
        second[k + 1] = transition @ second[k] + effect * across
    jerks = np.ascontiguousarray(jerks)
    states.flags.writeable = False
    jerks.flags.writeable = False
    return Trajectory(states, jerks)


def _excess(
    trajectory: Trajectory,
    limits: Vehicle,
    speed_mps: float,
    ttc_bound: TtcBound | None = None,
) -> float:
    """Return the maximum excess over `LIMIT_SHARE` of a limit [m/s, m/s2, m/s3]; NaN propagates.

    The excess over the bound on the time to collision is a distance [m].
    """
    s, v, a, _, v_y, a_y = trajectory.states.T
    jerk = np.abs(trajectory.jerks).max(axis=0)
    share = LIMIT_SHARE
    excesses = [
        (-v - share * speed_mps).max(),
        (v - share * (limits.max_speed_mps - speed_mps)).max(),
        (share * limits.min_accel_mps2 - a).max(),
        (a - share * limits.max_accel_mps2).max(),
        (np.abs(a_y) - share * limits.max_lateral_accel_mps2).max(),
        (np.abs(v_y) - share * limits.max_slip_ratio * (speed_mps + v)).max(),
        jerk[0] - share * limits.max_jerk_mps3,
        jerk[1] - share * limits.max_lateral_jerk_mps3,
    ]
    if ttc_bound is not None:
        way_m = ttc_bound.direction * (s + ttc_bound.ttc_s * v)
        excesses += [
            (way_m - ttc_bound.gap_m).max(),
            (-share * _gentle_brake_mps2(limits) - a).max(),
        ]
    return float(np.max(excesses))
