"""Trajectories between cells: the least jerk that keeps every limit.

In the moving frame a vehicle goes from rest to rest. A minimum-jerk quintic over one cell needs
6 m/s2 in 3.8 s, more than the vehicle has; and waypoints that need only be passed, not rested at,
let the vehicle leave its cell while it should stay. So every waypoint is passed at rest, which
splits a path into legs, and each leg is the quadratic program over n ticks of h seconds

    minimise    sum_k j_s,k^2 + j_y,k^2
    subject to  z_{k+1} = A z_k + B u_k,  z_0 = 0,  z_n = (ds, 0, 0, dy, 0, 0)
                speed, acceleration, jerk and slip within a share of the vehicle's limits

that is solved once per kind of leg and process. Its jerks are integrated again, exactly, and the
result is checked, whatever the solver said.

States are commanded states (`protocol.motion`): the body follows them with its actuators' lag and
is 0.1 m short of its cell when the time of the move is over, 0.04 m at the end of the slot (default
lags). A move forwards closes up on whoever holds in the cell beyond its target. It keeps so far
behind that the emergency brake (`protocol.braking`) need not act, with room for errors:

    s_k+r + (lag + r h) v_F + (v_F + v_k+r)^2 / (2 b)
        <=  2 d_F - L + way of the vehicle ahead - margin - errors

for every tick k and r ticks of reaction; the square is replaced by its tangents.

A `Reference` is what the tracker follows: trajectories strung along the road clock, cell to cell.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
from attrs import define, frozen
from numpy.typing import NDArray
from scipy import sparse

from laneweave.agents.driving.bounds import Rooms
from laneweave.agents.driving.qp import MAX_ITERATIONS, QPSettings, QuadraticProgram
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.lattice import Cell
from laneweave.protocol.scenario.tables import Scenario, Vehicle
from laneweave.protocol.vehicle.braking import (
    ERROR_SIGMAS,
    last_tick_m,
    lead_way_m,
    own_braking_mps2,
    spare_error_m,
)
from laneweave.protocol.vehicle.motion import State, cell_state

Array = NDArray[np.float64]

LIMIT_SHARE = 0.96
"""Share of each limit that a trajectory uses; the rest is the tracker's."""
_END_TOLERANCE = 1e-3
"""Accepted error of a leg's end [m, m/s, m/s2]."""
_LIMIT_TOLERANCE = 1e-4
"""Accepted excess over a limit's share [m/s, m/s2, m/s3]."""
_TRACKING_ERROR_M = 0.25
"""Room that it leaves for errors of tracking."""
_CLOSING_SPEEDUP = 0.5
"""Greatest closing speed to speak of, as a share of v_F."""
_TANGENTS = 5
_SETTINGS = QPSettings(
    eps_abs=1e-6,
    max_iter=40_000,
    check_termination=25,
    rho=0.3,
    alpha=1.8,
    eps_infeasible=1e-8,
    polishing=True,
    row_tolerance=1e-4,
)


class InfeasibleTrajectoryError(ValueError):
    """No trajectory keeps all limits in the time given."""


@frozen
class Waypoint:
    """A point to be passed at rest in the moving frame."""

    tick: int
    position_m: float
    """Position along the road, relative to the lattice."""
    lateral_m: float
    """Position across the road, from where the caller likes."""


@frozen(eq=False)
class Trajectory:
    """Samples of a motion in the moving frame; obeys the discrete dynamics exactly."""

    states: Array
    """(n + 1, 6): s [m], v [m/s] and a [m/s2] along the road, s and v relative to the lattice;
    y [m], v_y [m/s], a_y [m/s2]."""
    jerks: Array
    """(n, 2): j_s, j_y [m/s3], constant during each tick."""

    @property
    def ticks(self) -> int:
        """Duration n."""
        return len(self.jerks)


@define(eq=False)
class Window:
    """A reference from some tick on, for N ticks."""

    states: Array
    """(N + 1, 6): s, v, a, y, v_y, a_y on the road [m, s]."""
    jerks: Array
    """(N, 2): j_s, j_y [m/s3]."""
    rooms: Rooms | None = None
    """What the limits leave beside it, from the next tick on; None: that is not known yet."""


@frozen
class Leg:
    """One trajectory of a reference."""

    start_tick: int
    trajectory: Trajectory


@frozen
class Envelope:
    """How far and how fast a leg may go behind somebody who holds, so that braking is in time."""

    ticks: int
    """Ticks of reaction."""
    brake_mps2: float
    most_m: float
    """Greatest s + (v_F + v)^2 / (2 brake), with s and v relative to the lattice."""

    @classmethod
    def behind(cls, scenario: Scenario, room_m: float) -> Envelope:
        """Return the envelope of a leg that starts with a net gap of `room_m` to who is ahead."""
        speed_mps, braking = scenario.formation.speed_mps, scenario.braking
        ticks = max(round(braking.reaction_s / scenario.runtime.tick_s), 1)
        lost_s = scenario.vehicle.actuator_lag_s + ticks * scenario.runtime.tick_s
        errors_m = ERROR_SIGMAS * spare_error_m(scenario, (1.0 + _CLOSING_SPEEDUP) * speed_mps)
        brake_mps2, tick_s = own_braking_mps2(scenario), scenario.runtime.tick_s
        kept_m = braking.margin_m + errors_m + _TRACKING_ERROR_M + last_tick_m(brake_mps2, tick_s)
        most_m = room_m + lead_way_m(scenario, speed_mps) - kept_m - lost_s * speed_mps
        return cls(ticks, brake_mps2, most_m)


def plan_trajectory(
    scenario: Scenario, waypoints: Sequence[Waypoint], room_m: float | None = None
) -> Trajectory:
    """Return the trajectory of least jerk that rests at every waypoint.

    Args:
        scenario: limits, tick and lattice speed.
        waypoints: at least two, ticks ascending; the first is the start, where the vehicle rests.
        room_m: net gap at the start to somebody ahead who holds, and behind whom it must be able
            to stop; None: there is nobody.

    Raises:
        InfeasibleTrajectoryError: a leg cannot be driven within the limits.
        ValueError: fewer than two waypoints, ticks not ascending, or numbers not finite.
    """
    if len(waypoints) < 2:
        raise ValueError("a trajectory needs two waypoints or more")
    states, jerks = [], []
    for start, end in pairwise(waypoints):
        if end.tick <= start.tick:
            raise ValueError(f"waypoint ticks do not ascend: {start.tick}, {end.tick}")
        gone_m = start.position_m - waypoints[0].position_m
        leg = _leg(
            scenario.vehicle,
            scenario.formation.speed_mps,
            scenario.runtime.tick_s,
            end.tick - start.tick,
            end.position_m - start.position_m,
            end.lateral_m - start.lateral_m,
            None if room_m is None else Envelope.behind(scenario, room_m - gone_m),
        )
        shifted = leg.states + np.array([start.position_m, 0.0, 0.0, start.lateral_m, 0.0, 0.0])
        states.append(shifted[:-1] if end is not waypoints[-1] else shifted)
        jerks.append(leg.jerks)
    trajectory = Trajectory(np.concatenate(states), np.concatenate(jerks))
    trajectory.states.flags.writeable = trajectory.jerks.flags.writeable = False
    return trajectory


@lru_cache(maxsize=256)
def move_profile(scenario: Scenario, dx: int, dy: int, ticks: int | None = None) -> Trajectory:
    """Return the move by `dx` columns and `dy` lanes, from the origin; cached per process.

    Args:
        scenario: limits, tick, lattice.
        dx: columns, at most one either way.
        dy: lanes, likewise.
        ticks: how long it takes; None: as long as in the scenario's shortest T_F.

    Raises:
        InfeasibleTrajectoryError: the move cannot be driven within the limits.
        ValueError: the cells are not neighbours.
    """
    if abs(dx) > 1 or abs(dy) > 1:
        raise ValueError(f"({dx}, {dy}) does not lead to a neighbouring cell")
    if ticks is None:
        ticks = scenario.move_ticks(scenario.cycles_s[0])
    along_m, across_m = dx * scenario.formation.gap_m, dy * scenario.road.lane_width_m
    beyond_m = 2.0 * scenario.formation.gap_m - scenario.vehicle.length_m
    return plan_trajectory(
        scenario,
        (Waypoint(0, 0.0, 0.0), Waypoint(ticks, along_m, across_m)),
        room_m=beyond_m if dx > 0 else None,
    )


def check_moves(scenario: Scenario) -> None:
    """Check that every move of the scenario can be driven within the vehicle's limits.

    All of them are planned, for every T_F that a plan may have, and stay in the cache.

    Raises:
        BadInputError: one cannot.
    """
    for slot_s in scenario.slots_s:
        for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, 1), (1, -1), (-1, -1)):
            if dx and dy and scenario.formation.mode == 1:
                continue
            try:
                move_profile(scenario, dx, dy, scenario.move_ticks(slot_s))
            except InfeasibleTrajectoryError as error:
                raise BadInputError(
                    "formation.move_s",
                    slot_s - scenario.formation.slack_s,
                    f"long enough for a move by {dx} columns and {dy} lanes ({error}), or change "
                    + ("formation.gap_m or the table braking" if dx > 0 else "the table vehicle"),
                ) from error


class Reference:
    """A path on the road clock: rest in a cell, then legs with rests between them, then rest."""

    def __init__(self, scenario: Scenario, origin: Cell, legs: Sequence[Leg] = ()) -> None:
        """Lay out the path.

        Args:
            scenario: lattice, tick and horizon.
            origin: the cell held before the first leg; trajectories are relative to it.
            legs: in order of time, not overlapping, each beginning where the one before ended.

        Raises:
            ValueError: legs overlap in time.
        """
        n = scenario.horizon_ticks
        self._horizon = n
        self._advance_m = scenario.formation.speed_mps * scenario.runtime.tick_s
        self.origin = origin
        self.start_tick = legs[0].start_tick if legs else 0
        """Tick at which the first leg begins."""
        states: list[Array] = [np.zeros((n, 6))]
        jerks: list[Array] = [np.zeros((n, 2))]
        tick, rest = self.start_tick, np.zeros((1, 6))
        for leg in legs:
            if leg.start_tick < tick:
                raise ValueError(f"leg at tick {leg.start_tick} begins before {tick}")
            wait = leg.start_tick - tick
            states += [np.repeat(rest, wait, axis=0), leg.trajectory.states[:-1]]
            jerks += [np.zeros((wait, 2)), leg.trajectory.jerks]
            tick = leg.start_tick + leg.trajectory.ticks
            rest = leg.trajectory.states[-1:] * (1.0, 0.0, 0.0, 1.0, 0.0, 0.0)
        self.end_tick = tick
        """Tick from which on the last cell is held."""
        states.append(np.repeat(rest, n + 1, axis=0))
        jerks.append(np.zeros((n, 2)))
        column, lane = origin
        lattice = scenario.lattice
        self._states = np.concatenate(states)
        self._states += (
            lattice.cell_s_m(column, 0.0),
            lattice.speed_mps,
            0.0,
            lattice.cell_y_m(lane),
            0.0,
            0.0,
        )
        self._jerks = np.concatenate(jerks)
        self._jerks.flags.writeable = False
        self._ramp = self._advance_m * np.arange(n + 1)
        self._limits = scenario.vehicle
        self._rooms: Rooms | None = None
        """Of all of it; None until a window is wanted."""

    @classmethod
    def hold(cls, scenario: Scenario, cell: Cell) -> Reference:
        """Return the reference that holds `cell` for ever."""
        return cls(scenario, cell)

    @classmethod
    def move(
        cls,
        scenario: Scenario,
        origin: Cell,
        target: Cell,
        start_tick: int,
        ticks: int | None = None,
    ) -> Reference:
        """Return the reference of one move: `origin`, from `start_tick` on the move, `target`.

        Args:
            scenario: lattice, tick and horizon.
            origin: where it begins.
            target: a neighbouring cell.
            start_tick: when it begins.
            ticks: how long it takes; see `move_profile`.

        Raises:
            InfeasibleTrajectoryError: the move cannot be driven within the limits.
            ValueError: the cells are not neighbours.
        """
        return cls.moves(scenario, origin, [(start_tick, target)], ticks)

    @classmethod
    def moves(
        cls,
        scenario: Scenario,
        origin: Cell,
        moves: Sequence[tuple[int, Cell]],
        ticks: int | None = None,
    ) -> Reference:
        """Return the reference of several moves, each (start tick, target cell), all as long.

        Raises:
            InfeasibleTrajectoryError: a move cannot be driven within the limits.
            ValueError: a target is not a neighbour, or moves overlap in time.
        """
        legs, cell = [], origin
        for start_tick, target in moves:
            profile = move_profile(scenario, target[0] - cell[0], target[1] - cell[1], ticks)
            offset = (
                (cell[0] - origin[0]) * scenario.formation.gap_m,
                0.0,
                0.0,
                (cell[1] - origin[1]) * scenario.road.lane_width_m,
                0.0,
                0.0,
            )
            legs.append(Leg(start_tick, Trajectory(profile.states + offset, profile.jerks)))
            cell = target
        return cls(scenario, origin, legs)

    @classmethod
    def settling(
        cls, scenario: Scenario, cell: Cell, state: State, tick: int, end_tick: int
    ) -> Reference:
        """Return the reference that leads into a cell, at rest there from a tick on.

        It has the least sum of squared jerks that does, whatever the limits: who enters the road
        has so long for one and a half columns that no limit comes into question.

        Args:
            scenario: lattice and tick.
            cell: where it leads.
            state: commanded state at `tick`.
            tick: when it begins.
            end_tick: when it ends, at least three ticks later.
        """
        goal = cell_state(scenario.lattice, cell, tick * scenario.runtime.tick_s)
        start = np.array(state) - goal
        ticks = end_tick - tick
        jerks = _least_jerks(scenario.runtime.tick_s, ticks, start)
        return cls(scenario, cell, [Leg(tick, _frozen(jerks, scenario.runtime.tick_s, start))])

    def window(self, tick: int) -> Window:
        """Return the reference from `tick` on: states (N + 1, 6), jerks (N, 2, read-only)."""
        n = self._horizon
        first = tick - self.start_tick + n
        first = min(max(first, 0), len(self._jerks) - n)
        states = self._states[first : first + n + 1].copy()
        s = states[:, 0]
        s += self._ramp
        s += self._advance_m * tick
        rooms = self._rooms
        if rooms is None:
            rooms = self._rooms = Rooms.beside(self._states[1:], self._jerks, self._limits)
        return Window(states, self._jerks[first : first + n], rooms.part(first, first + n))


@lru_cache(maxsize=256)
def _leg(
    limits: Vehicle,
    speed_mps: float,
    tick_s: float,
    ticks: int,
    ds_m: float,
    dy_m: float,
    envelope: Envelope | None,
) -> Trajectory:
    """Return the motion from rest at (0, 0) to rest at (ds, dy) in `ticks` ticks.

    Raises:
        InfeasibleTrajectoryError: it cannot be driven within the limits.
        ValueError: a number is not finite.
    """
    if ds_m == 0.0 and dy_m == 0.0:
        return _frozen(np.zeros((ticks, 2)), tick_s)
    # With a unit of time near an eighth of the leg, all states are of similar size.
    unit_s = ticks * tick_s / 8.0
    program = _leg_program(
        limits, speed_mps, tick_s / unit_s, unit_s, ticks, (ds_m, dy_m), envelope
    )
    what = f"{ds_m:g} m along and {dy_m:g} m across in {ticks * tick_s:g} s"
    if envelope is not None:
        what += ", with room to brake behind whoever holds beyond"
    solution = program.solve()
    if not solution.usable:
        out = solution.status == MAX_ITERATIONS
        why = "out of iterations" if out else f"solver status {solution.status}"
        raise InfeasibleTrajectoryError(
            f"{what}: no trajectory within {LIMIT_SHARE:.0%} of the vehicle's limits ({why})"
        )
    jerks = solution.x[6 * ticks :].reshape(2, ticks).T / unit_s**3
    trajectory = _frozen(jerks, tick_s)
    end_error = np.abs(trajectory.states[-1] - (ds_m, 0.0, 0.0, dy_m, 0.0, 0.0)).max()
    excess = _excess(trajectory, limits, speed_mps)
    if not (end_error < _END_TOLERANCE and excess < _LIMIT_TOLERANCE):
        raise InfeasibleTrajectoryError(
            f"{what}: the best trajectory misses its end by {end_error:.2g} and a limit by "
            f"{excess:.2g}"
        )
    return trajectory


def _leg_program(
    limits: Vehicle,
    speed_mps: float,
    h: float,
    unit_s: float,
    n: int,
    end_m: tuple[float, float],
    envelope: Envelope | None,
) -> QuadraticProgram:
    """Set up a leg in units of `unit_s`: x = (z_s [3n], z_y [3n], j_s [n], j_y [n])."""
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
    infinite, ends = np.inf, np.array([[d, 0.0, 0.0] for d in end_m])
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
        ([last, None, None, None], ends[0], ends[0]),
        ([None, last, None, None], ends[1], ends[1]),
    ]
    if envelope is not None:
        brake, later = envelope.brake_mps2, eye.tocsr()[envelope.ticks - 1 :]
        for share in np.linspace(0.0, _CLOSING_SPEEDUP, _TANGENTS):
            speed = speed_mps * (1.0 + share)
            # At this speed: v^2 / (2 b) >= speed (2 v - speed) / (2 b).
            row = sparse.kron(later, np.array([[1.0, speed / brake / unit_s, 0.0]]))
            most = envelope.most_m - speed * (2.0 * speed_mps - speed) / (2.0 * brake)
            rows.append(([row, None, None, None], -infinite, most))
    heights = [next(m for m in blocks if m is not None).shape[0] for blocks, _, _ in rows]
    return QuadraticProgram(
        sparse.diags([np.concatenate([np.zeros(6 * n), np.ones(2 * n)])], [0]),
        sparse.bmat([blocks for blocks, _, _ in rows]),
        np.concatenate([np.full(m, low) for m, (_, low, _) in zip(heights, rows, strict=True)]),
        np.concatenate([np.full(m, high) for m, (_, _, high) in zip(heights, rows, strict=True)]),
        settings=_SETTINGS,
    )


def axis_matrices(h: float) -> tuple[Array, Array]:
    """Return A (3, 3) and B (3, 1) of one axis: a triple integrator over a tick of length h."""
    transition = np.array([[1.0, h, h * h / 2.0], [0.0, 1.0, h], [0.0, 0.0, 1.0]])
    return transition, np.array([[h**3 / 6.0], [h * h / 2.0], [h]])


def _both(limit: float) -> tuple[float, float]:
    return -limit, limit


def _least_jerks(tick_s: float, ticks: int, start: Array) -> Array:
    """Return the jerks (ticks, 2) of least norm that lead from a state to rest at the origin."""
    reach, power = _reach(tick_s, ticks)
    ends = np.stack([power @ start[:3], power @ start[3:]], axis=1)
    return np.asarray(np.linalg.lstsq(reach, -ends, rcond=None)[0], dtype=np.float64)


@lru_cache(maxsize=256)
def _reach(tick_s: float, ticks: int) -> tuple[Array, Array]:
    """Return what each tick's jerk (3, ticks), and the state at first (3, 3), add to the last."""
    transition, effect = axis_matrices(tick_s)
    power: Array = np.eye(3)
    effects = []
    for _ in range(ticks):
        effects.append(power @ effect[:, 0])
        power = transition @ power
    return np.array(effects[::-1]).T, power


def _frozen(jerks: Array, tick_s: float, start: Array | None = None) -> Trajectory:
    """Integrate jerks (n, 2) from a state, or rest at the origin; the arrays become read-only."""
    transition, effect = axis_matrices(tick_s)
    states = np.zeros((len(jerks) + 1, 6))
    if start is not None:
        states[0] = start
    lasting, first, second = effect[:, 0], states[:, :3], states[:, 3:]
    for k, (along, across) in enumerate(jerks.tolist()):
        first[k + 1] = transition @ first[k] + lasting * along
        second[k + 1] = transition @ second[k] + lasting * across
    jerks = np.ascontiguousarray(jerks)
    states.flags.writeable = False
    jerks.flags.writeable = False
    return Trajectory(states, jerks)


def _excess(trajectory: Trajectory, limits: Vehicle, speed_mps: float) -> float:
    """Return the largest excess over a limit's share [m/s, m/s2, m/s3]; NaN if a sample is."""
    _, v, a, _, v_y, a_y = trajectory.states.T
    jerk = np.abs(trajectory.jerks).max(axis=0)
    share = LIMIT_SHARE
    return float(
        np.max(
            [
                (-v - share * speed_mps).max(),
                (v - share * (limits.max_speed_mps - speed_mps)).max(),
                (share * limits.min_accel_mps2 - a).max(),
                (a - share * limits.max_accel_mps2).max(),
                (np.abs(a_y) - share * limits.max_lateral_accel_mps2).max(),
                (np.abs(v_y) - share * limits.max_slip_ratio * (speed_mps + v)).max(),
                jerk[0] - share * limits.max_jerk_mps3,
                jerk[1] - share * limits.max_lateral_jerk_mps3,
            ]
        )
    )
