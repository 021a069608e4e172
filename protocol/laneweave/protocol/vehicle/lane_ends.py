"""Ends of lanes: where vehicles stop that cannot leave a lane before it ends.

Before each dead end there is a *stop line*, so far from the end that a vehicle standing at it can
accelerate and change lanes before the end (`re_entry`). All cells of the lane beyond the line are
useless: no plan leads there, and a vehicle whose cell has passed the line has left the lattice.

An exit before the end of the road needs no stop line: a vehicle in its lane leaves the road. But
lane changes end as far before it (`LaneEnd.line_m`), so that a body that was stopped in one can
complete it before the lanes part. docs/SAFETY.md derives the rules.

In a corridor of a SUMO simulation, a section may be too short for a lane change before the line.
Then vehicles do not re-enter: SUMO takes back each one that has not begun to change lanes in time
(`LaneEnd.taken_back`). The line is only so far from the end that a body can stop before it until
it has left the lane.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence

from attrs import evolve

from laneweave.protocol.lattice import Cell
from laneweave.protocol.road_layout import (
    NO_PARTS,
    LaneSection,
    TemporaryClosure,
    TemporaryParts,
    cut,
)
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.vehicle.emergency_brake import own_braking_mps2, stopping_distance_m
from laneweave.protocol.vehicle.lane_end import LaneEnd
from laneweave.protocol.vehicle.re_entry import ReEntry, re_entry

BEFORE_TOUCHING = 0.6
"""Share of a move by which a body that changes lanes touches the other lane (by default 0.36)."""
LATE_S = 0.2
"""Delay with which a move that leads out of a lane may still begin; longer ones could end with the
body partly in the lane at its stop line."""
HANDOVER_M = 4.0
"""Length of the lane behind an exit of a SUMO simulation, where SUMO takes vehicles back."""
TAKEN_BACK_M = 1.0
"""Distance of the line from a dead end before which SUMO takes vehicles back."""
TRACKING_SHARE = 0.9
"""Share of the time before a body touches the other lane by which a move may begin early; the rest
is kept for tracking errors."""
HEEDED_BRAKING_MPS2 = 8.0
"""Deceleration up to which a vehicle brakes for a part of a lane that is closed suddenly."""
SOON_S = 16.0
"""Time before the line of a lane that has just been closed in which no vehicle should still enter
it: it would need a new plan, for which others have to complete their moves, and another move."""
NEAR_LINE_M = 1.0
"""Distance past a line at which a vehicle still stands at it."""
CLEAR_M = 1.0
"""Distance from a closed part at which a vehicle stops for which the line came too late."""
ROUNDING_M = 1e-6
"""Tolerance for comparing positions."""


class LaneEnds:
    """The ends of lanes before the end of a scenario's road: dead ends and exits."""

    def __init__(self, scenario: Scenario, temporary: TemporaryParts = NO_PARTS) -> None:
        """Derive the stop lines, also those before parts that are closed for a time."""
        closed = temporary.closed
        self.temporary = temporary
        self._longest_m = scenario.types.longest_body_m
        self._lattice = scenario.lattice
        lanes = range(scenario.road.lanes)
        self._dead_ends = _by_lane(dead_ends(scenario, closed), lanes)
        self._exits = _by_lane(exit_lanes(scenario, closed), lanes)
        self._late = {end: evolve(end, stop_m=end.end_m - CLEAR_M) for end in self if end.sudden}
        """Dead ends for vehicles that cannot stop at the line."""
        self._touching_s = (1.0 - BEFORE_TOUCHING) * scenario.timing.move_s
        early_m = 0.0 if scenario.formation.change_columns else early_start_m(scenario)
        self._begins_m = [
            [
                (
                    max(section.from_m, section.moves_from_m)
                    + scenario.types.longest_body_m
                    - early_m,
                    section.from_m,
                    section.to_m,
                )
                for section in cut(scenario.geometry.sections, closed)
                if section.lane == lane
            ]
            for lane in lanes
        ]
        """Where fronts may begin moves in the sections of each lane; where these begin and end."""
        self._any = any(self._dead_ends) or any(self._exits) or bool(temporary.cleared)

    def __bool__(self) -> bool:
        """Return whether any lane ends before the road, or parts of lanes are cleared."""
        return self._any

    def __iter__(self) -> Iterator[LaneEnd]:
        """Yield the dead ends in order of lane, then of position."""
        for ends in self._dead_ends:
            yield from ends

    def may_begin(self, origin: Cell, target: Cell, t_s: float) -> bool:
        """Return whether a move is where moves may begin in both lanes."""
        front_m, lanes = self._lattice.cell_s_m(origin[0], t_s), {origin[1], target[1]}
        return len(lanes) == 1 or all(self._begun_m(lane, front_m) for lane in lanes)

    def _begun_m(self, lane: int, front_m: float) -> list[float]:
        """Return where the section begins in which moves may begin; empty: they may not."""
        return [
            from_m
            for begins_m, from_m, to_m in self._begins_m[lane]
            if begins_m - ROUNDING_M <= front_m < to_m
        ]

    def opens_s(self, cell: Cell, t_s: float) -> float:
        """Return the road time from which moves may begin in the lane of a cell.

        This is `t_s` if they may begin already, and infinite if no section is ahead.
        """
        s_m, speed_mps = self._lattice.cell_s_m(cell[0], t_s), self._lattice.speed_mps
        begins_m = [begins_m for begins_m, _, to_m in self._begins_m[cell[1]] if s_m < to_m]
        return t_s + max(0.0, min(begins_m, default=math.inf) - s_m) / speed_mps

    def in_section_m(self, cell: Cell, t_s: float) -> float:
        """Return the position of a cell, moved into the section in which it may begin a move.

        A move may begin so early that the body does not touch the lane before it opens.
        """
        s_m = self._lattice.cell_s_m(cell[0], t_s)
        return max([s_m, *self._begun_m(cell[1], s_m)])

    def heeded(self, lane: int, s_m: float, speed_mps: float) -> LaneEnd | None:
        """Return the dead end ahead of a vehicle, with the position at which it stops.

        If a lane is closed suddenly, this may be beyond the line. None: it cannot stop before the
        closed part either, so it drives on, and stops behind what it senses.
        """
        end = self.ahead(lane, s_m)
        if end is None or not end.sudden:
            return end
        stops_m = s_m + max(speed_mps, 0.0) ** 2 / (2.0 * HEEDED_BRAKING_MPS2)
        if stops_m <= end.stop_m + NEAR_LINE_M:
            return end
        return self._late[end] if stops_m <= end.end_m else None

    def ahead(self, lane: int, s_m: float) -> LaneEnd | None:
        """Return the dead end of the section in which a position is, or which it has passed."""
        return _end_ahead(self._dead_ends, lane, s_m)

    def exit_ahead(self, lane: int, s_m: float) -> LaneEnd | None:
        """Return the exit of the section in which a position is, or which it has passed."""
        return _end_ahead(self._exits, lane, s_m)

    def has_passed(self, cell: Cell, t_s: float, body_m: float | None = None) -> bool:
        """Return whether a cell has passed the stop line of its section.

        Args:
            cell: the cell.
            t_s: road time.
            body_m: a position in the section; None: that of the cell.
        """
        if body_m is None:
            body_m = self.in_section_m(cell, t_s)
        return self._is_beyond(self.ahead(cell[1], body_m), cell, t_s)

    def too_late(self, origin: Cell, target: Cell, t_s: float, slot_s: float | None = None) -> bool:
        """Return whether it is too late for a move, because one of its lanes ends.

        Everything that begins, continues or gives up moves on a road asks this; planners use the
        same lines (`sections_to_lines`).

        Args:
            origin: cell in whose lane the body is.
            target: cell into which it moves.
            t_s: road time from which the move can begin.
            slot_s: T_F. The whole move must end before the stop or exit lines of both lanes. None:
                the vehicle moves already, but its body is not in the other lane; it must touch it
                in time for an exit. Before a dead end it is stopped at the line.
        """
        lanes = origin[1], target[1]
        if slot_s is None:
            return lanes[0] != lanes[1] and any(
                self._ends_changes(cell, t_s + self._touching_s, self.in_section_m(cell, t_s))
                for cell in (origin, target)
            )
        if self.enters_cleared(origin, target, t_s, slot_s):
            return True
        front = max(origin[0], target[0])
        if lanes[0] == lanes[1]:
            cell = front, lanes[0]
            return self.has_passed(cell, t_s + slot_s - LATE_S, self.in_section_m(cell, t_s))
        # It may be planned for later in its slot, when both lanes are open (`may_begin`).
        opens_s = max(self.opens_s((origin[0], lane), t_s) for lane in lanes)
        begin_s = opens_s if opens_s < t_s + slot_s else t_s
        end_s = begin_s + slot_s - LATE_S
        for lane in lanes:
            # A move may begin before its lane opens: what ended before does not concern it.
            body_m = self.in_section_m((origin[0], lane), begin_s)
            for is_beyond in (self.has_passed, self._ends_changes):
                if is_beyond((front, lane), end_s, body_m):
                    return True
        return False

    def reaches_line(self, origin: Cell, target: Cell, t_s: float, takes_s: float) -> bool:
        """Return whether a dead end of one of its lanes is too near for a move of a duration."""
        front, lanes = max(origin[0], target[0]), {origin[1], target[1]}
        body_m = {lane: self.in_section_m((origin[0], lane), t_s) for lane in lanes}
        end_s = t_s + takes_s - LATE_S
        return any(self.has_passed((front, lane), end_s, body_m[lane]) for lane in lanes)

    def enters_cleared(self, origin: Cell, target: Cell, t_s: float, takes_s: float) -> bool:
        """Return whether a lane change of a duration leads into a part that is cleared."""
        lattice, columns = self._lattice, (origin[0], target[0])
        if origin[1] == target[1]:
            return False
        for part in self.temporary.cleared:
            if part.lane == target[1]:
                times = [(at_s, part.at(at_s)) for at_s in (t_s, t_s + takes_s)]
                # Both move uniformly, so that the beginning and the end suffice.
                if any(
                    lattice.cell_s_m(min(columns), at_s) - self._longest_m < to_m
                    for at_s, (_, to_m) in times
                ) and any(
                    lattice.cell_s_m(max(columns), at_s) > from_m for at_s, (from_m, _) in times
                ):
                    return True
        return False

    def closed_soon(self, cell: Cell, t_s: float, soon_s: float = SOON_S) -> bool:
        """Return whether a cell will reach the line of a part closed for a time in `soon_s`."""
        end = self.ahead(cell[1], self._lattice.cell_s_m(cell[0], t_s))
        return end is not None and end.sudden and self._is_beyond(end, cell, t_s + soon_s)

    def _ends_changes(self, cell: Cell, t_s: float, body_m: float) -> bool:
        """Return whether a cell is where lane changes have ended before the exit of a section."""
        return self._is_beyond(self.exit_ahead(cell[1], body_m), cell, t_s)

    def _is_beyond(self, end: LaneEnd | None, cell: Cell, t_s: float) -> bool:
        """Return whether a cell has passed the line of an end, if there is one."""
        return end is not None and self._lattice.cell_s_m(cell[0], t_s) > end.line_m


def dead_ends(scenario: Scenario, closed: Sequence[TemporaryClosure] = ()) -> tuple[LaneEnd, ...]:
    """Return the dead ends of a road in order of lane, then of position; see `LaneEnds`."""
    return _in_order(end for section, end in _ends(scenario, closed) if not section.exit)


def exit_lanes(scenario: Scenario, closed: Sequence[TemporaryClosure] = ()) -> tuple[LaneEnd, ...]:
    """Return the lanes of exits before the end of a road in order of lane, then of position."""
    return _in_order(end for section, end in _ends(scenario, closed) if section.exit)


def _in_order(ends: Iterable[LaneEnd]) -> tuple[LaneEnd, ...]:
    return tuple(sorted(ends, key=lambda end: (end.lane, end.end_m)))


def _ends(
    scenario: Scenario, closed: Sequence[TemporaryClosure] = ()
) -> Iterator[tuple[LaneSection, LaneEnd]]:
    """Yield the sections that end before the road, and their ends."""
    always = len(scenario.geometry.sections)
    sections = cut(scenario.geometry.sections, closed)
    late_m = {(one.lane, one.from_m): one.late_m for one in closed}
    for number, section in enumerate(sections):
        if not section.exit or section.to_m < scenario.road.length_m:
            later = [
                each.from_m
                for each in sections
                if each.lane == section.lane and each.from_m >= section.to_m
            ]
            line_m = section.to_m - re_entry(scenario).room_m
            line_m -= late_m.get((section.lane, section.to_m), 0.0)
            stop_m = section.to_m if section.exit else line_m
            taken_back = bool(scenario.sumo.config) and line_m < first_step_m(
                scenario, max(section.from_m, section.moves_from_m)
            )
            if taken_back:
                stop_m = section.to_m + (HANDOVER_M if section.exit else -TAKEN_BACK_M)
                line_m = stop_m - _stopping_room_m(scenario)
            yield (
                section,
                LaneEnd(
                    lane=section.lane,
                    from_m=section.from_m,
                    line_m=line_m,
                    stop_m=stop_m,
                    end_m=section.to_m,
                    reopens_m=min(later, default=math.inf),
                    moves_from_m=section.moves_from_m,
                    taken_back=taken_back,
                    sudden=number >= always,
                ),
            )


def _stopping_room_m(scenario: Scenario) -> float:
    """Return the distance from the end of a lane change to where a body stops.

    It brakes as it leaves its lane. The motion of a lane change is symmetric: the body leaves the
    lane as long before the end as it begins to touch the other one after the beginning.
    """
    speed_mps, assumed, timing = scenario.formation.speed_mps, scenario.braking, scenario.timing
    braking_m = max(
        stopping_distance_m(
            speed_mps, 0.0, own_braking_mps2(one.limits, assumed), one.limits.actuator_lag_s
        )
        for one in scenario.types.values()
    )
    # A move begins up to a tick late, and the brake acts a reaction time later.
    late_s = scenario.runtime.tick_s + assumed.reaction_s
    spare_s = timing.cycles_s[0] - timing.move_s - late_s
    after_m = early_start_m(scenario) + spare_s * speed_mps
    return max(0.0, braking_m + assumed.margin_m - after_m)


def first_step_m(scenario: Scenario, begins_m: float) -> float:
    """Return where a move ends, at the earliest, that may begin from a position on."""
    return max(begins_m, scenario.geometry.moves_from_m) + scenario.types.step_m


def _by_lane(ends: Iterable[LaneEnd], lanes: range) -> tuple[tuple[LaneEnd, ...], ...]:
    listed = tuple(ends)
    return tuple(tuple(end for end in listed if end.lane == lane) for lane in lanes)


def _end_ahead(by_lane: Sequence[Sequence[LaneEnd]], lane: int, s_m: float) -> LaneEnd | None:
    """Return the end of the section in which a position is, or which it has passed."""
    if not 0 <= lane < len(by_lane):
        return None
    for end in by_lane[lane]:
        if end.from_m <= s_m < end.reopens_m:
            return end
    return None


def lanes_beside(
    scenario: Scenario,
    lane: int,
    at_m: float,
    sections: Iterable[LaneSection],
    needed: ReEntry | None = None,
) -> tuple[int, ...]:
    """Return the lanes into which a vehicle can re-enter.

    They are open from before the vehicle until that has arrived in its cell, and the first vehicles
    enter them before that position: there, their cells can be kept free.

    Args:
        scenario: lattice and road.
        lane: lane in which the vehicle waits.
        at_m: position of its front.
        sections: those of the road, up to the stop lines in them; see `sections_to_lines`.
        needed: what it needs; None: `re_entry`.
    """
    needed = needed or re_entry(scenario)
    pitch_m = scenario.lattice.pitch_m
    from_m = at_m - needed.columns * pitch_m - scenario.types.longest_body_m
    to_m = min(at_m + needed.distance_m, scenario.road.length_m)
    entry_m = dict(enumerate(scenario.geometry.entry_m))
    open_lanes = {
        section.lane
        for section in sections
        if max(section.from_m, section.moves_from_m) <= from_m and to_m <= section.to_m
    }
    return tuple(
        beside
        for beside in (lane + 1, lane - 1)
        if beside in open_lanes and entry_m.get(beside, math.inf) <= at_m
    )


def sections_to_lines(
    scenario: Scenario, closed: Sequence[TemporaryClosure] = ()
) -> tuple[LaneSection, ...]:
    """Return the sections of a road as far as plans may use them, up to the lines before ends."""
    lines_m = {section: end.line_m for section, end in _ends(scenario, closed)}
    return tuple(
        evolve(section, to_m=lines_m.get(section, section.to_m))
        for section in cut(scenario.geometry.sections, closed)
    )


def stop_line_m(part: TemporaryClosure, scenario: Scenario) -> float:
    """Return the position of the stop line before a part that is closed for a time."""
    return part.from_m - re_entry(scenario).room_m - part.late_m


def early_start_m(scenario: Scenario) -> float:
    """Return the distance driven in a lane change before any body touches the other lane.

    A minimum-jerk motion from rest to rest has covered 10 x^3 - 15 x^4 + 6 x^5 of its way at the
    share x of its time.
    """
    lane_m = scenario.road.lane_width_m
    untouched = 0.5 * (lane_m - scenario.types.widest_body_m) / lane_m
    ticks = scenario.timing.move_ticks(scenario.timing.cycles_s[0])
    shares = (tick / ticks for tick in range(ticks + 1))
    before = [x for x in shares if x**3 * (10.0 - 15.0 * x + 6.0 * x * x) <= untouched]
    return TRACKING_SHARE * max(before) * scenario.timing.move_s * scenario.formation.speed_mps
