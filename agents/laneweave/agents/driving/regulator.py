"""The linear-quadratic regulator: the tracking problem without inequality constraints.

Each axis of a vehicle is a triple integrator (position, speed, acceleration) with constant jerk
during a tick. With the weights below, the jerks that minimise the cost over an infinite horizon are
w_k = -K e_k, where K follows from the fixed point S of the Riccati recursion. The multipliers of
the dynamics are the gradients of the cost to go: S e_k for the step to e_k. `Regulator` holds all
of this for a whole horizon as matrices times e_0, with the values of all constraints.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from laneweave.protocol.scenario.vehicle_tables import Vehicle

Array = NDArray[np.float64]

WEIGHTS = np.diag((1.0, 0.4, 0.1))
"""Weights of errors along the road in (s, v, a) [1/m2, s2/m2, s4/m2]."""
LATERAL_WEIGHTS = np.diag((2.0, 0.8, 0.2))
"""Weights of errors across the road in (y, v_y, a_y)."""
JERK_WEIGHT = 0.02

_AT_REST = np.array((0.5, 0.5, 0.5, 0.3, 0.3, 0.5))
"""Assumed errors of a vehicle that holds its cell: several times its sensor errors."""


def axis_matrices(h: float) -> tuple[Array, Array]:
    """Return A (3, 3) and B (3, 1) of one axis: a triple integrator over a tick of length h."""
    transition = np.array([[1.0, h, h * h / 2.0], [0.0, 1.0, h], [0.0, 0.0, 1.0]])
    return transition, np.array([[h**3 / 6.0], [h * h / 2.0], [h]])


def cost_to_go(weights: Array, h: float) -> Array:
    """Return the fixed point (3, 3) of the Riccati recursion of one axis.

    `scipy.linalg.solve_discrete_are` gives gains that differ by 3e-8, enough to change recorded
    trajectories.
    """
    transition, effect = axis_matrices(h)
    cost = weights
    for _ in range(1000):
        following = weights + transition.T @ cost @ (transition - effect @ _gain(cost, h))
        if np.abs(following - cost).max() < 1e-9 * np.abs(following).max():
            break
        cost = (following + following.T) / 2.0
    return cost


def _gain(cost: Array, h: float) -> Array:
    """Return the gain K (1, 3) of a tick, given the cost to go (3, 3) after it."""
    transition, effect = axis_matrices(h)
    gain: Array = effect.T @ cost @ transition / (JERK_WEIGHT + effect.T @ cost @ effect)
    return gain


class Regulator:
    """The unconstrained solution w_k = -K e_k, rolled out over the horizon."""

    def __init__(self, ticks: int, tick_s: float, slip: float) -> None:
        """Roll out both axes from each of the six initial errors.

        Args:
            ticks: horizon N.
            tick_s: length of a tick.
            slip: `max_slip_ratio` of the vehicle.
        """
        transition, effect = axis_matrices(tick_s)
        inputs = np.zeros((ticks, 2, 6))
        errors = np.zeros((ticks, 6, 6))
        costs_to_go = np.zeros((6, 6))
        for axis, weights in enumerate((WEIGHTS, LATERAL_WEIGHTS)):
            to_go = cost_to_go(weights, tick_s)
            gain = _gain(to_go, tick_s)
            block, error = slice(3 * axis, 3 * axis + 3), np.eye(3)
            for k in range(ticks):
                inputs[k, axis, block] = (-gain @ error)[0]
                error = (transition - effect @ gain) @ error
                errors[k, block, block] = error
            costs_to_go[block, block] = to_go
        self.constraints: Array = np.concatenate(
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
        """Matrix (8 N, 6) from e_0 to the values of all constraints except the dynamics, in the
        order of `tracking_problem.ConstraintBounds`."""
        self.inputs = np.ascontiguousarray(self.constraints[5 * ticks : 7 * ticks])
        """Matrix (2 N, 6) from e_0 to the jerks."""
        self.errors = errors.reshape(6 * ticks, 6)
        """Matrix (6 N, 6) from e_0 to e_1 .. e_N."""
        self.multipliers = (costs_to_go @ errors).reshape(6 * ticks, 6)
        """Matrix (6 N, 6) from e_0 to the multipliers of the dynamics."""
        self._ticks = ticks

    def unconstrained_errors(self, limits: Vehicle, speed_mps: float) -> tuple[float, ...]:
        """Return the errors (6,) up to which no limit binds while the vehicle holds a cell.

        Args:
            limits: the vehicle's limits.
            speed_mps: v_F.
        """
        n = self._ticks
        margins = (
            min(speed_mps, limits.max_speed_mps - speed_mps),
            min(-limits.min_accel_mps2, limits.max_accel_mps2),
            limits.max_lateral_accel_mps2,
            limits.max_slip_ratio * speed_mps,
            limits.max_slip_ratio * speed_mps,
        )
        jerks = np.tile([limits.max_jerk_mps3, limits.max_lateral_jerk_mps3], n)
        margin = np.concatenate([np.repeat(margins, n), jerks])
        used = np.abs(self.constraints[: 7 * n]) @ _AT_REST
        share = min(float((margin / np.maximum(used, 1e-12)).min()), 1.0)
        return tuple(share * each for each in _AT_REST.tolist())


@cache
def shared_regulator(ticks: int, tick_s: float, slip: float) -> Regulator:
    """Return the regulator, shared by all vehicles of a process."""
    return Regulator(ticks, tick_s, slip)
