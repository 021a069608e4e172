"""The cell guard: no commanded motion leads a body out of the cells of its vehicle.

In each tick the guard predicts the commanded state after the tick (`protocol.vehicle.motion`) and
how far it would still go, relative to the lattice, if the vehicle then stopped as hard as its
limits allow: forwards, and to both sides. The body follows the commanded state through a low-pass
filter, so it goes no farther. A jerk with which the vehicle could no longer stop within its cells
is not executed. As the vehicle can always still stop, this holds for any sequence of jerks: it is
the argument of the emergency brake, with the edge of a cell in place of the vehicle ahead.

Backwards there is no bound: vehicles must be able to brake, and those behind have their emergency
brakes.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from attrs import define, field

from laneweave.protocol.lattice import Cell, Lattice, footprint
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.vehicle_tables import Vehicle
from laneweave.protocol.vehicle.motion import (
    ARRIVED_ACROSS_M,
    DISPLACED_ALONG_M,
    Jerk,
    State,
    at_rest_in_cell,
    integrate,
    limited_jerk,
)

LEAD_TOLERANCE_M = 0.5
"""Tolerance for a body that falls back to its cell and gets ahead again."""
_SLACK_M = 1e-3
"""Growth of an excess in a tick that is tolerated."""
_SLOW_MPS = 1.0
"""Minimum speed in the computation of a body's heading."""


def stopping_distance_m(speed: float, accel: float, max_jerk: float, max_accel: float) -> float:
    """Return how far a body still moves forwards if it stops with limited jerk.

    It reduces speed and acceleration to zero at the same time, with at most `max_accel`. All
    quantities are in SI units, and relative to a frame of constant speed. The result is an upper
    bound, and at least zero.
    """
    if speed <= 0.0 and accel <= 0.0:
        return 0.0
    lost = accel * abs(accel) / (2.0 * max_jerk)
    if speed + lost <= 0.0:
        # It stops even if it ceases to brake now; the speed falls at least linearly at first.
        return speed * speed / -accel if speed > 0.0 else 0.0
    fade_s = abs(accel) / max_jerk
    # The speed at the time without acceleration, before or after now.
    top = speed + accel * accel / (2.0 * max_jerk)
    peak = math.sqrt(max_jerk * top)
    lasts_s = 2.0 * peak / max_jerk if peak <= max_accel else top / max_accel + max_accel / max_jerk
    stops_m = 0.5 * top * lasts_s
    if accel >= 0.0:
        stops_m += fade_s * (speed + accel * fade_s / 3.0)
    else:
        stops_m -= fade_s * (top + accel * fade_s / 6.0)
    return max(stops_m, 0.0)


def stopping_jerk(
    speed: float, accel: float, max_jerk: float, max_accel: float, tick_s: float
) -> float:
    """Return the jerk for a tick with which a body stops; other arguments as above."""
    if speed + accel * abs(accel) / (2.0 * max_jerk) <= 0.0:
        return min(max(-accel / tick_s, 0.0), max_jerk)
    return max(-max_jerk, -(accel + max_accel) / tick_s)


class _Excess(NamedTuple):
    """How far a body leaves its cells before it can stop [m]; at most zero: it does not."""

    ahead_m: float
    left_m: float
    right_m: float


@define
class CellGuard:
    """The guard of one vehicle.

    Cells are given as the two between which the body moves, in any order; equal if it holds.
    """

    _scenario: Scenario
    _limits: Vehicle
    moving_from: Cell | None = None
    """Cell in which the move in progress began; None: the body has come to rest in its cell."""
    lead_m: float = math.inf
    """Allowed distance ahead of its cell, for a body that entered there; it only decreases."""
    _lattice: Lattice = field(init=False)
    _tick_s: float = field(init=False)
    _ahead_m: float = field(init=False)
    _half_m: float = field(init=False)
    _across_m: float = field(init=False)
    _along: tuple[float, float] = field(init=False)
    """Limits of jerk and deceleration along the road."""
    _across: tuple[float, float] = field(init=False)
    """Limits of jerk and acceleration across the road."""

    def __attrs_post_init__(self) -> None:
        """Compute the tolerances: how far a body may be from the cells of its vehicle."""
        scenario, limits = self._scenario, self._limits
        self._lattice, self._tick_s = scenario.lattice, scenario.runtime.tick_s
        self._ahead_m = max(DISPLACED_ALONG_M, scenario.types.room_ahead_m)
        self._half_m = 0.5 * limits.length_m
        widths_m = 0.5 * (limits.width_m + scenario.types.widest_body_m)
        self._across_m = min(ARRIVED_ACROSS_M, 0.5 * (self._lattice.lane_width_m - widths_m))
        self._along = limits.max_jerk_mps3, -limits.min_accel_mps2
        self._across = limits.max_lateral_jerk_mps3, limits.max_lateral_accel_mps2

    def update(self, measured: State, hold_cell: Cell, t_s: float) -> None:
        """End the move in progress if the body rests in its cell.

        A body that has entered ahead of its cell must not get farther ahead again.
        """
        if self.moving_from is None and self.lead_m <= self._ahead_m:
            return
        ahead_m = measured[0] - self._lattice.cell_s_m(hold_cell[0], t_s)
        self.lead_m = min(self.lead_m, max(ahead_m, 0.0) + LEAD_TOLERANCE_M)
        room_ahead_m = self._scenario.types.room_ahead_m
        if at_rest_in_cell(measured, self._lattice, hold_cell, t_s, room_ahead_m):
            self.moving_from = None

    def region(self, hold_cell: Cell) -> frozenset[Cell]:
        """Return the cells of the vehicle: its cell, or the footprint of the move in progress."""
        return footprint(self.moving_from or hold_cell, hold_cell)

    def cells(self, measured: State, hold_cell: Cell) -> tuple[Cell, Cell]:
        """Return the cells between which the body may move.

        Other bodies may come beside one that has left the lane in which its move began.
        """
        origin = self.moving_from or hold_cell
        if origin[1] != hold_cell[1]:
            first, last = self._lattice.lanes_touched(measured[3], self._limits.width_m)
            if not first <= origin[1] <= last:
                return (origin[0], hold_cell[1]), hold_cell
        return origin, hold_cell

    def excess_m(self, commanded: State, jerk: Jerk, cells: tuple[Cell, Cell], t_s: float) -> float:
        """Return how far a jerk leads a body out of its cells; at most zero: it does not.

        For a body that is outside already, only the growth of its excess counts.

        Args:
            commanded: commanded state in road coordinates.
            jerk: the jerk for this tick.
            cells: see the class.
            t_s: road time at the beginning of the tick.
        """
        return max(self._excess_after(commanded, jerk, cells, t_s))

    def keep_in_cells(
        self, commanded: State, jerk: Jerk, cells: tuple[Cell, Cell], t_s: float
    ) -> Jerk:
        """Return a jerk, or one that stops the body where this one leads out of its cells."""
        excess = self._excess_after(commanded, jerk, cells, t_s)
        if max(excess) <= 0.0:
            return jerk
        (along, across), tick_s = jerk, self._tick_s
        _, v, a, _, v_y, a_y = commanded
        if excess.ahead_m > 0.0:
            along = stopping_jerk(v - self._lattice.speed_mps, a, *self._along, tick_s)
        if excess.left_m > 0.0:
            across = stopping_jerk(v_y, a_y, *self._across, tick_s)
        elif excess.right_m > 0.0:
            across = -stopping_jerk(-v_y, -a_y, *self._across, tick_s)
        return along, across

    def _excess_after(
        self, commanded: State, jerk: Jerk, cells: tuple[Cell, Cell], t_s: float
    ) -> _Excess:
        """Return the excess after a tick of a jerk; if the body is outside, what it grows by."""
        then_s = t_s + self._tick_s
        # The plant clips a jerk beyond the vehicle's limits. The clipped jerk is between this one
        # and the hardest stop: if this one keeps the body inside, so does that one.
        after = self._excess(integrate(commanded, jerk, self._tick_s), cells, then_s)
        if max(after) <= 0.0:
            return after
        limited = limited_jerk(commanded, jerk, self._limits, self._tick_s)
        next_state = integrate(commanded, limited, self._tick_s)
        now = self._excess(commanded, cells, t_s, turns=False)
        # A body outside its lane has to turn to get back, so only its centre counts.
        turns = max(now.left_m, now.right_m) <= 0.0
        if turns:
            now = self._excess(commanded, cells, t_s)
        after = self._excess(next_state, cells, then_s, turns=turns)
        return _Excess(
            *(then - max(was, 0.0) - _SLACK_M for then, was in zip(after, now, strict=True))
        )

    def _excess(
        self, commanded: State, cells: tuple[Cell, Cell], t_s: float, *, turns: bool = True
    ) -> _Excess:
        """Return the excess of a state; `turns`: whether corners count, or only the centre."""
        s_m, v, a, y_m, v_y, a_y = commanded
        lattice = self._lattice
        (column, lane), (other_column, other_lane) = cells
        ahead_m = s_m - lattice.cell_s_m(max(column, other_column), t_s)
        ahead_m -= max(self._ahead_m, self.lead_m)
        turned_m = self._half_m * abs(v_y) / max(v, _SLOW_MPS) if turns else 0.0
        left_m = y_m - lattice.cell_y_m(max(lane, other_lane)) - self._across_m
        right_m = lattice.cell_y_m(min(lane, other_lane)) - y_m - self._across_m
        return _Excess(
            ahead_m + stopping_distance_m(v - lattice.speed_mps, a, *self._along),
            left_m + turned_m + stopping_distance_m(v_y, a_y, *self._across),
            right_m + turned_m + stopping_distance_m(-v_y, -a_y, *self._across),
        )
