"""The stop lines that a vehicle's motion controller sees, as vehicles that stand there."""

from __future__ import annotations

from collections.abc import Iterable

from attrs import Factory, define, field

from laneweave.protocol.lattice import Cell
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.vehicle_tables import Vehicle
from laneweave.protocol.vehicle.lane_end import LaneEnd
from laneweave.protocol.vehicle.lane_ends import NEAR_LINE_M, LaneEnds
from laneweave.protocol.vehicle.motion import State
from laneweave.protocol.wire.messages import Command, Neighbour

MAX_LINE_GAP_M = 200.0
"""Distance from which stop lines are seen; more than any stopping distance."""
STANDING_MPS = 0.3
"""Speed below which a vehicle stands."""
SLOWER_MPS = 2.0
"""A vehicle that is slower than another one by this much holds it up."""


@define
class StopLinesAhead:
    """The stop lines ahead of one vehicle."""

    _scenario: Scenario
    _limits: Vehicle
    lane_ends: LaneEnds = Factory(lambda self: LaneEnds(self._scenario), takes_self=True)
    passed: bool = False
    """Whether the vehicle has started from standing, so that in the lane that it leaves the end
    counts, not the stop line, and it brakes for what is ahead there only if it must."""
    keeps_distance: bool = False
    """Whether it has started slowly: it keeps its distance to what is ahead there all the same."""
    _kept_out_of: Cell | None = None
    """Cell in a lane that has ended, which the body may not enter; see `keep_out`."""
    taken_back: Cell | None = None
    """Target of a move that was taken back, which its process may repeat until it learns of it."""
    _past: dict[int, LaneEnd] = field(factory=dict)
    """Beginnings of parts by lane that it passes, since it has started there: they are open again,
    or only vehicles, which it senses, are in them."""

    def keep_out(
        self,
        hold_cell: Cell,
        body_lane: int,
        t_s: float,
        ahead: Iterable[Neighbour],
        speed_mps: float,
    ) -> bool:
        """Return whether the body may not enter the lane of its hold cell, which has ended.

        The vehicle drives past in its own lane, and the cells of its move stay its own. A closed
        part grows while a vehicle breaks down: beyond it, slower vehicles ahead in the other lane
        keep the vehicle out, too.

        Args:
            hold_cell: cell that the vehicle holds or moves to.
            body_lane: its lane if the body touches it, otherwise that of the body.
            t_s: road time.
            ahead: measured neighbours ahead.
            speed_mps: speed of the vehicle.
        """
        goal = hold_cell[1]
        kept_out = body_lane != goal and (
            self.lane_ends.has_passed(hold_cell, t_s)
            or (
                hold_cell == self._kept_out_of
                and any(
                    one.lane == goal and one.speed_mps < speed_mps - SLOWER_MPS for one in ahead
                )
            )
        )
        self._kept_out_of = hold_cell if kept_out else None
        return kept_out

    def start(
        self, goal: int, passable: Iterable[int], s_m: float, *, keeps_distance: bool
    ) -> None:
        """Start from standing towards a lane.

        Args:
            goal: the lane.
            passable: lanes that the body touches in which it may drive past the next dead end.
            s_m: position of the body.
            keeps_distance: whether it starts slowly; see `re_entry_behind`.
        """
        self.passed, self.keeps_distance = True, keeps_distance
        for lane in passable:
            end = self.lane_ends.ahead(lane, s_m)
            if end is not None and end.sudden and (goal == lane or s_m > end.line_m + NEAR_LINE_M):
                self._past[lane] = end

    def brakes_early(self, lane: int, goal: int) -> bool:
        """Return whether a vehicle with a goal lane keeps its distance to what is ahead in a lane.

        One that starts into another lane brakes for the end of its own only if it must.
        """
        return not self.passed or self.keeps_distance or lane == goal

    def section_m(self, lane: int, s_m: float) -> float:
        """Return a position in the section of a lane whose end counts for a body there."""
        past = self._past.get(lane)
        return s_m if past is None else max(s_m, past.reopens_m)

    def allow(self, command: Command, t_s: float) -> bool:
        """Return whether a move may begin: not again, in time, and into no cleared part."""
        if command.hold_cell == self.taken_back:
            return False
        ends, move = self.lane_ends, (command.motion.origin, command.hold_cell)
        takes_s = command.motion.end_tick * self._scenario.runtime.tick_s - t_s
        return not ends or (
            ends.may_begin(*move, t_s)
            and not ends.reaches_line(*move, t_s, takes_s)
            and not ends.enters_cleared(*move, t_s, takes_s)
        )

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
        first, last = self._scenario.lattice.lanes_touched(measured[3], self._limits.width_m)
        self._past = {
            lane: end
            for lane, end in self._past.items()
            if first <= lane <= last and s_m < end.reopens_m
        }
        in_lane_m = {lane: self.section_m(lane, s_m) for lane in range(first, last + 1)}
        if goal not in in_lane_m and enters:
            # The lane may open ahead, behind the end of another section.
            in_lane_m[goal] = self.lane_ends.in_section_m(hold_cell, t_s)
        ends = [
            end
            for lane, at_m in in_lane_m.items()
            if (end := self.lane_ends.heeded(lane, at_m, speed_mps)) is not None
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
            exits = [self.lane_ends.exit_ahead(lane, s_m) for lane in (first, last)]
            lines += [(each.lane, each.stop_m - s_m) for each in exits if each is not None]
        return [Neighbour(lane, gap_m, 0.0) for lane, gap_m in lines if gap_m < MAX_LINE_GAP_M]
