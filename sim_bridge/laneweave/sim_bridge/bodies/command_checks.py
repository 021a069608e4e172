"""Checks of commands: what a motion controller refuses, and why.

Some commands are refused because of the situation: others are in the way, or it is too late. A
`Refusal` is for commands that no correct agent sends.
"""

from __future__ import annotations

import math
import sys
from array import array
from collections.abc import Collection, Sequence
from enum import Enum
from typing import Protocol

from attrs import frozen

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.lattice import Cell, Lattice, displacements
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.vehicle.emergency_brake import EmergencyBrake
from laneweave.protocol.wire.bounds import MAX_COLUMN, MAX_MOTION_TICKS, blocks_in_range
from laneweave.protocol.wire.messages import Command, Neighbour

NEIGHBOURING = frozenset(displacements(2)[1:])
"""All moves (columns, lanes) to neighbouring cells."""
BESIDE_M = 1.0
"""Net gap along the road below which another body is beside this one."""
BEFORE_ENTERING = 0.4
"""Share of a move before a body touches the other lane."""
ERRORS_M = 1.0
"""Spare distance that may be missing because of measurement errors."""
STOPPING_MPS = 3.0
"""Speed below v_F from which a body is about to stop."""
STOPPING_MPS2 = -3.0
"""The same for its acceleration; moves need less."""
CATCHING_UP_MPS = 1.0
"""Speed above v_F from which a body that keeps its column catches up with its cell."""

Sides = tuple[Sequence[Neighbour], Sequence[Neighbour]]
"""Neighbours ahead and behind."""


class Problem(Enum):
    """What is wrong with a command."""

    VALUES = "values"
    """Its numbers are out of range."""
    MOVE = "move"
    """It begins a move that the vehicle cannot make: too far, for another type, from another cell,
    or before the last one is complete."""
    NOT_OWNED = "not-owned"
    """It leads to a cell that the vehicle does not own."""
    OCCUPIED = "occupied"
    """It leads through a cell that another vehicle occupies."""
    LEAVES_CELLS = "leaves-cells"
    """Its trajectory leads out of the cells of the vehicle."""


@frozen
class Refusal:
    """Why a motion controller has refused a command that no correct agent sends."""

    problem: Problem
    excess_m: float = 0.0
    """Distance by which the body would have left its cells."""
    occupant: str | None = None
    """The vehicle that occupies a cell on the way."""


class LaneGaps:
    """Checks whether the bodies in another lane leave room for a lane change."""

    def __init__(self, scenario: Scenario) -> None:
        """Check for the vehicles of a scenario."""
        self._keeps_columns = not scenario.formation.change_columns
        self._speed_mps = scenario.lattice.speed_mps
        self._touching_s = BEFORE_ENTERING * scenario.timing.move_s
        self._leaving_s = scenario.timing.move_s - self._touching_s
        self._min_gap_m = scenario.tracking.min_gap_m
        weakest = scenario.types.weakest_braking
        self._weakest_brake = EmergencyBrake(weakest, scenario.braking, scenario.runtime.tick_s)

    def allow(self, own_lane: int, lane: int, neighbours: Sides, speed_mps: float) -> bool:
        """Return whether a lane change may begin: no body is in the way, and none will be.

        Args:
            own_lane: the lane of the body.
            lane: the other lane.
            neighbours: measured neighbours ahead and behind.
            speed_mps: speed of this vehicle.
        """
        ahead, behind = neighbours
        return not (
            self.blocked(lane, neighbours, speed_mps)
            or any(one.lane == lane and self._cuts_in(one, speed_mps) for one in behind)
            or any(one.lane == own_lane and self._holds_up(one, speed_mps) for one in ahead)
        )

    def blocked(self, lane: int, neighbours: Sides, speed_mps: float) -> bool:
        """Return whether a body is beside this one, or could not brake for it now.

        In cells that are free there is none beside it; a body may have stopped there meanwhile.
        Arguments as above.
        """
        ahead, behind = neighbours
        return any(one.lane == lane and one.gap_m < BESIDE_M for one in (*ahead, *behind)) or any(
            one.lane == lane and self._spare_m(one, speed_mps, one.gap_m) < -ERRORS_M
            for one in behind
        )

    def _holds_up(self, ahead: Neighbour, speed_mps: float) -> bool:
        """Return whether one that stops ahead would stop this vehicle before it has left the lane.

        It would then stand in both lanes, and no vehicle could pass it.
        """
        if ahead.speed_mps > self._speed_mps - STOPPING_MPS and ahead.accel_mps2 > STOPPING_MPS2:
            return False
        drives_s = self._leaving_s
        if ahead.accel_mps2 < 0.0:
            drives_s = min(drives_s, -ahead.speed_mps / ahead.accel_mps2)
        drives_m = ahead.speed_mps * drives_s + 0.5 * min(ahead.accel_mps2, 0.0) * drives_s**2
        return ahead.gap_m + drives_m - speed_mps * self._leaving_s < self._min_gap_m

    def _cuts_in(self, behind: Neighbour, speed_mps: float) -> bool:
        """Return whether one that catches up in the other lane could not brake for this vehicle.

        It has had to stop, and passes the cells of others: vehicles that keep their columns change
        lanes in them.
        """
        if not self._keeps_columns or behind.speed_mps < self._speed_mps + CATCHING_UP_MPS:
            return False
        closes_m = max(0.0, behind.speed_mps - speed_mps) * self._touching_s
        return self._spare_m(behind, speed_mps, behind.gap_m - closes_m) < 0.0

    def _spare_m(self, behind: Neighbour, speed_mps: float, gap_m: float) -> float:
        """Return the spare distance of one behind, at a gap, if this vehicle brakes."""
        body = Neighbour(behind.lane, gap_m, speed_mps, 0.0)
        state = (0.0, behind.speed_mps, 0.0, 0.0, 0.0, 0.0)
        return self._weakest_brake.spare_m(state, 0.0, (0.0, 0.0), [body])


class Occupancy(Protocol):
    """Knows the cells that vehicles occupy."""

    def occupant(self, cells: Collection[Cell], vehicle: object) -> str | None:
        """Return what occupies any of the cells, other than a vehicle; None: they are free.

        `vehicle` is the motion controller of the vehicle that needs them.
        """


def checked_jerks(command: Command, lattice: Lattice) -> array[float]:
    """Return the jerks of a command whose numbers are all in range.

    They are pairs (along, across) for successive ticks [m/s3].

    Raises:
        BadInputError: they are not pairs of finite numbers, a cell is not in a lane, or a number
            is out of range.
    """
    for cell in (command.hold_cell, command.motion.origin):
        if not (0 <= cell[1] < lattice.lanes and abs(cell[0]) <= MAX_COLUMN):
            raise BadInputError("Command", cell, f"cells in {lattice.lanes} lanes")
    motion, until = command.motion, command.tick + MAX_MOTION_TICKS
    if not (motion.end_tick <= until and 0 <= motion.ticks <= MAX_MOTION_TICKS):
        raise BadInputError("Command.motion", motion, f"an end until tick {until}")
    joined = command.record.joined
    if not blocks_in_range(joined):
        raise BadInputError("Command.record.joined", joined, f"at most {MAX_COLUMN}")
    if len(command.jerks) % 8:
        raise BadInputError("Command.jerks", f"{len(command.jerks)} bytes", "float32 pairs")
    jerks = array("f", command.jerks)
    if sys.byteorder == "big":
        jerks.byteswap()
    # Finite 32-bit numbers have a finite sum.
    if not math.isfinite(sum(jerks)):
        raise BadInputError("Command.jerks", "NaN or infinity", "finite numbers")
    return jerks
