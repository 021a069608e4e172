"""How vehicles that stand get back into the lattice, and what they need for it.

The motion controller drives with its hold law towards a cell of the neighbouring lane behind the
one that passes the vehicle when it starts.
"""

from __future__ import annotations

import math
from collections.abc import Hashable
from functools import lru_cache, reduce
from typing import Protocol

from attrs import frozen

from laneweave.protocol.lattice import Cell, Lattice
from laneweave.protocol.scenario.deployment_fields import Runtime
from laneweave.protocol.scenario.formation_table import FormationSettings
from laneweave.protocol.scenario.vehicle_tables import Braking, Sensing, Tracking, Vehicle
from laneweave.protocol.scenario.vehicle_types import VehicleTypes
from laneweave.protocol.vehicle.emergency_brake import ERROR_SIGMAS, EmergencyBrake, spare_error_m
from laneweave.protocol.vehicle.motion import (
    ARRIVED_ALONG_M,
    State,
    cell_state,
    commanded_state,
    has_settled,
    hold_law,
    integrate,
    keep_gap,
)
from laneweave.protocol.wire.messages import Neighbour

START_S = 0.3
"""Time after the front of a gap has passed in which a waiting vehicle may start into it."""
_MAX_COLUMNS = 48
"""Upper bound on the columns that a vehicle needs to re-enter."""
_MORE_COLUMNS = 4
"""Columns that a vehicle may need in addition if it starts behind another one."""
_MAX_RE_ENTRY_S = 120.0
_FAR_M = 1000.0


class Conditions(Hashable, Protocol):
    """The settings that determine re-entry; a `Scenario` contains them."""

    @property
    def lattice(self) -> Lattice:
        """The moving lattice."""

    @property
    def types(self) -> VehicleTypes:
        """Types of vehicles."""

    @property
    def formation(self) -> FormationSettings:
        """Settings of formations, with the speed v_F."""

    @property
    def runtime(self) -> Runtime:
        """Length of a tick."""

    @property
    def sensing(self) -> Sensing:
        """Errors of sensors."""

    @property
    def braking(self) -> Braking:
        """Assumptions of the emergency brake."""

    @property
    def tracking(self) -> Tracking:
        """Distance to the vehicle ahead."""


@frozen
class ReEntry:
    """How a vehicle gets from standing at a stop line into the neighbouring lane."""

    room_m: float
    """Distance to the end of the lane, or to the vehicle ahead, at which it starts."""
    columns: int
    """Number of free columns that it needs in the neighbouring lane; it settles in the rearmost."""
    distance_m: float
    """Distance in which it settles in its cell."""

    def covering(self, other: ReEntry) -> ReEntry:
        """Return what suffices for both."""
        return ReEntry(
            max(self.room_m, other.room_m),
            max(self.columns, other.columns),
            max(self.distance_m, other.distance_m),
        )


def re_entry(scenario: Conditions) -> ReEntry:
    """Return what every type of vehicle needs to drive from standing into the neighbouring lane.

    The motion controller drives with its hold law towards a cell of the neighbouring lane behind
    the one that passes the vehicle when it starts. Until the body has left its lane, it must be
    able to stop before the end with the emergency brake, which bounds the room from below.

    Raises:
        ValueError: the vehicle does not arrive in a cell (its limits are too low).
    """
    first, *others = (own_re_entry(scenario, one.limits) for one in scenario.types.values())
    return reduce(ReEntry.covering, others, first)


@lru_cache(maxsize=256)
def own_re_entry(scenario: Conditions, limits: Vehicle) -> ReEntry:
    """Return what vehicles with some limits need; see `re_entry`.

    Raises:
        ValueError: the vehicle does not arrive in a cell.
    """
    for columns in range(2, _MAX_COLUMNS + 1):
        needed = _needed(scenario, limits, columns)
        if needed is not None:
            return needed
    raise ValueError("vehicles that stand cannot get into the lattice within their limits")


@lru_cache(maxsize=256)
def re_entry_behind(scenario: Conditions, limits: Vehicle, room_m: int) -> ReEntry | None:
    """Return what a vehicle needs that stands behind another one.

    It starts slowly, and keeps its distance to the one ahead until it has left the lane.

    Args:
        scenario: lattice, tick, sensors and brakes.
        limits: those of the vehicle.
        room_m: distance to the vehicle ahead, rounded down, since results are kept.

    Returns:
        None: the room is too small, as less than 27 m are with the default vehicle.
    """
    first = own_re_entry(scenario, limits).columns
    for columns in range(first, first + _MORE_COLUMNS + 1):
        needed = _needed(scenario, limits, columns, room_m)
        if needed is not None:
            return needed if needed.room_m <= room_m else None
    return None


def _needed(
    scenario: Conditions, limits: Vehicle, columns: int, room_m: float = math.inf
) -> ReEntry | None:
    """Return what a vehicle needs for re-entry into a gap; None: the gap has too few columns."""
    found = [_re_entry(scenario, limits, columns, late_s, room_m) for late_s in (0.0, START_S)]
    possible = [each for each in found if each is not None]
    if len(possible) < len(found):
        return None
    used_m, distance_m = (max(each) for each in zip(*possible, strict=True))
    # Settling takes up to a second longer for starts between the two.
    distance_m += scenario.formation.speed_mps
    return ReEntry(math.ceil(used_m), columns, math.ceil(distance_m))


def _re_entry(
    scenario: Conditions, limits: Vehicle, columns: int, late_s: float, ahead_m: float
) -> tuple[float, float] | None:
    """Return the `room_m` and `distance_m` of one motion of `re_entry`, not rounded.

    Args:
        scenario: lattice, tick, sensors and brakes.
        limits: those of the vehicle.
        columns: number of free columns; the vehicle is to settle in the rearmost.
        late_s: time between the foremost column passing the vehicle and the start.
        ahead_m: distance to a vehicle that stands ahead; inf: the vehicle brakes for nothing.

    Returns:
        None: the vehicle falls behind the columns, or does not settle.
    """
    lattice, tick_s = scenario.lattice, scenario.runtime.tick_s
    assumed, noise = scenario.braking, scenario.sensing
    goal: Cell = (1 - columns, 1)
    brake, lag_s = EmergencyBrake(limits, assumed, tick_s), limits.actuator_lag_s
    standing: State = (0.0, 0.0, 0.0, lattice.cell_y_m(0), 0.0, 0.0)
    state = commanded_state(standing, (0.0, 0.0), limits, lattice.speed_mps)
    clear_m = 0.5 * (lattice.lane_width_m + limits.width_m)
    room_m = distance_m = settled_s = 0.0
    s_m, clear = 0.0, False
    for tick in range(1, round(_MAX_RE_ENTRY_S / tick_s)):
        t_s = late_s + tick * tick_s
        jerk = hold_law(state, cell_state(lattice, goal, t_s - tick_s), limits, tick_s)
        if not clear and ahead_m < math.inf:
            standing_ahead = [(ahead_m - s_m - lag_s * state[1], 0.0)]
            min_gap_m = scenario.tracking.min_gap_m
            jerk = keep_gap(state, jerk, standing_ahead, limits, min_gap_m, tick_s)
        state = integrate(state, jerk, tick_s)
        # The body is at most this far: it follows its commanded state.
        s_m = state[0] + lag_s * (lattice.speed_mps - state[1]) + lag_s * max(state[2], 0.0)
        if s_m < lattice.cell_s_m(goal[0], t_s) - ARRIVED_ALONG_M:
            return None
        if not clear:
            speed_mps = state[1]
            ahead = Neighbour(0, _FAR_M, 0.0)
            body = (0.0, speed_mps, 0.0, 0.0, 0.0, 0.0)
            needed_m = _FAR_M - brake.spare_m(body, state[2], jerk, [ahead])
            errors_m = ERROR_SIGMAS * spare_error_m(
                limits, assumed, noise, speed_mps, lattice.speed_mps
            )
            # A tick of travel covers starts between the two that are computed.
            room_m = max(room_m, s_m + needed_m + errors_m + speed_mps * tick_s)
            clear = state[3] - lattice.cell_y_m(0) > clear_m
        if not has_settled(state, lattice, goal, t_s):
            distance_m, settled_s = s_m, t_s + tick_s
    if not clear or settled_s > _MAX_RE_ENTRY_S - 1.0:
        return None
    return room_m, distance_m
