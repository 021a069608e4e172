"""The stop lines that a vehicle's motion controller sees, as vehicles that stand there."""

from __future__ import annotations

from attrs import define

from laneweave.protocol.lattice import Cell, Lattice
from laneweave.protocol.scenario.vehicle_tables import Vehicle
from laneweave.protocol.vehicle.lane_ends import LaneEnds
from laneweave.protocol.vehicle.motion import State
from laneweave.protocol.wire.messages import Neighbour

MAX_LINE_GAP_M = 200.0
"""Distance from which stop lines are seen; more than any stopping distance."""
STANDING_MPS = 0.3
"""Speed below which a vehicle stands."""


@define
class StopLinesAhead:
    """The stop lines ahead of one vehicle."""

    _lane_ends: LaneEnds
    _limits: Vehicle
    _lattice: Lattice
    passed: bool = False
    """Whether the vehicle has started from standing at a stop line, into another lane."""

    def lines(
        self, measured: State, hold_cell: Cell, t_s: float, *, enters: bool
    ) -> list[Neighbour]:
        """Return the stop lines of the lanes that the body touches or enters, as vehicles.

        For a vehicle that starts from standing and is partly in another lane, or drives into
        it, the end of the lane counts instead.

        Args:
            measured: measured state of the body.
            hold_cell: cell that the vehicle holds or moves to.
            t_s: road time.
            enters: whether the body may enter the lane of this cell.
        """
        s_m, speed_mps, goal = measured[0], measured[1], hold_cell[1]
        first, last = self._lattice.lanes_touched(measured[3], self._limits.width_m)
        in_lane_m = dict.fromkeys(range(first, last + 1), s_m)
        if goal not in in_lane_m and enters:
            # The lane may open ahead, behind the end of another section.
            in_lane_m[goal] = self._lane_ends.in_section_m(hold_cell, t_s)
        ends = [
            end
            for lane, at_m in in_lane_m.items()
            if (end := self._lane_ends.ahead(lane, at_m)) is not None
        ]
        if all(end.lane == goal for end in ends):
            self.passed = False
        elif speed_mps < STANDING_MPS and first <= goal <= last:
            self.passed = True
        lines = [
            (end.lane, (end.end_m if self.passed and end.lane != goal else end.stop_m) - s_m)
            for end in ends
        ]
        if first != last:
            # Where an exit lane parts from the road, a body must not be in both.
            exits = [self._lane_ends.exit_ahead(lane, s_m) for lane in (first, last)]
            lines += [(each.lane, each.stop_m - s_m) for each in exits if each is not None]
        return [Neighbour(lane, gap_m, 0.0) for lane, gap_m in lines if gap_m < MAX_LINE_GAP_M]
