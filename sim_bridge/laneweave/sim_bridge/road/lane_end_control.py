"""The roadside at the ends of lanes: brings vehicles that wait there back into the lattice.

For each vehicle that waits at a stop line, the entry meter keeps some columns of the neighbouring
lane free (a *gap*): no vehicle enters them, and no vehicle owns their cells, so no plan leads into
them. When the gap passes the waiting vehicle, its motion controller drives into it, and takes its
cells once it has arrived in one of the last columns. This needs neither agent nor leader nor
message: it is how a vehicle enters at the start of the road.

With formations, the columns are free in all lanes and belong to no formation. The vehicle that
enters them is a formation of its own.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence

from attrs import define, frozen

from laneweave.protocol.lattice import Cell
from laneweave.protocol.road_layout import NO_PARTS, LanePosition, LaneSection, TemporaryClosure
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.vehicle.lane_end import LaneEnd
from laneweave.protocol.vehicle.lane_ends import (
    NEAR_LINE_M,
    START_S,
    LaneEnds,
    lane_beside,
    own_re_entry,
    re_entry,
    sections_to_lines,
)
from laneweave.protocol.vehicle.motion import ARRIVED_ALONG_M
from laneweave.protocol.vehicle.sudden_stops import queue_pitch_m
from laneweave.protocol.vehicle.territory import territory_of
from laneweave.protocol.wire.events import DRIVES_OUT, ENTERED_LATTICE, LEFT_LATTICE, MISSED_EXIT
from laneweave.protocol.wire.messages import Name, OffLattice
from laneweave.sim_bridge.bodies.command_checks import BESIDE_M
from laneweave.sim_bridge.bodies.motion_controller import OffLatticePhase
from laneweave.sim_bridge.bodies.stop_lines import STANDING_MPS
from laneweave.sim_bridge.road.entry import EntryMeter
from laneweave.sim_bridge.road.vehicle import RoadVehicle

OPEN_GAPS, CROWDED_GAPS = 1, 5
"""Number of gap lengths of columns between two gaps of a lane that vehicles may enter, so that its
traffic, and vehicles that change into it, keep most of its cells; and the same while vehicles wait
at the entrance of the lane or, while a part is closed for a time, at any entrance. With fewer, gaps
would use up the capacity of dense traffic."""
USED_SHARE = 0.8
"""Share of the cells past closed parts that gaps and vehicles from the start of the road use
together, as far as `CROWDED_GAPS` allows. With more, vehicles find no way out of the closed lane,
stop, and need gaps in turn."""


@define
class Gap:
    """Columns of a lane that are kept free for a vehicle that waits."""

    lane: int
    columns: range
    vehicle: Name | None = None
    """The vehicle that drives into the gap; None: it has not arrived."""

    @property
    def cells(self) -> tuple[Cell, ...]:
        """All cells, rearmost first."""
        return tuple((column, self.lane) for column in self.columns)


@frozen
class LaneEndChange:
    """What happens to a vehicle at the end of a lane."""

    vehicle: Name
    kind: str
    """`LEFT_LATTICE`, `DRIVES_OUT`, `ENTERED_LATTICE`, `MISSED_EXIT` or `MOVE_TAKEN_BACK`."""
    lane: int


class LaneEndControl:
    """Vehicles without cells, and the gaps that are kept free for them."""

    def __init__(self, scenario: Scenario, meter: EntryMeter) -> None:
        """Begin without vehicles."""
        self._meter = meter
        self._cells_stay_free = territory_of(scenario).given_up_cells_stay_free
        self._scenario = scenario
        self._lattice = scenario.lattice
        self._queue_m = queue_pitch_m(scenario)
        self._any = False
        self._temporary = NO_PARTS
        self._ends: dict[LanePosition, LaneEnd] = {}
        """Dead ends by lane and end; those that have vanished as long as vehicles wait there."""
        self._sections: tuple[LaneSection, ...] = ()
        """Those of the road, up to the stop lines in them."""
        self._columns, self._distance_m, self._room_m = 0, 0.0, 0.0
        self._gaps: dict[LanePosition, list[Gap]] = {}
        self.still_closed: Callable[[float], Sequence[TemporaryClosure]] = lambda _: ()
        """Returns the parts that are closed for a time whose cause lasts, as far as is known, at a
        road time."""
        self._last_gap_column: dict[int, float] = {}
        """Rearmost column of the last gap, by entry point."""
        self._entered_gaps: list[range] = []
        """Columns of gaps that vehicles have entered, since they were last taken."""
        self._end_of: dict[Name, LanePosition | None] = {}
        """Dead end at which each vehicle without cells waits or waited; None: its lane has none."""
        self.close(LaneEnds(scenario))

    def close(self, lane_ends: LaneEnds) -> None:
        """Replace the ends of lanes.

        Args:
            lane_ends: those of the road, and of parts that are closed for a time, which may
                vanish only when no vehicle waits there (`in_use`).
        """
        scenario, self._temporary = self._scenario, lane_ends.temporary
        self._ends = {(end.lane, end.end_m): end for end in lane_ends}
        self._any = bool(lane_ends)
        if self._ends:
            needed = re_entry(scenario)
            self._columns, self._room_m = needed.columns, needed.room_m
            self._distance_m = needed.distance_m
        closed = self._temporary.closed
        self._sections = sections_to_lines(scenario, closed) if self._ends else ()
        # In a lane, those ahead get gaps first.
        farthest_first = sorted(self._ends, key=lambda at: (at[0], -at[1]))
        before, self._gaps = self._gaps, {at: [] for at in farthest_first}
        for at, gaps in before.items():
            merged = self._merged(at)
            if merged is not None:
                self._gaps[merged] += gaps
        for name, its_end in self._end_of.items():
            if its_end is not None:
                self._end_of[name] = self._merged(its_end)

    def _merged(self, at: LanePosition) -> LanePosition | None:
        """Return an end, or that of the part before it, into which its own part has merged."""
        if at in self._ends:
            return at
        lane, end_m = at
        ends = (end for end in self._ends.values() if end.lane == lane)
        return next(((lane, end.end_m) for end in ends if end.end_m <= end_m < end.reopens_m), None)

    @property
    def in_use(self) -> set[LanePosition]:
        """The ends at which vehicles wait, or from which they re-enter."""
        return {at for at in self._end_of.values() if at is not None}

    def is_kept_free(self, cell: Cell) -> bool:
        """Return whether a cell belongs to a gap."""
        return any(
            gap.lane == cell[1] and cell[0] in gap.columns
            for gaps in self._gaps.values()
            for gap in gaps
        )

    def pop_entered_gaps(self) -> list[range]:
        """Return the columns of gaps that vehicles have entered since the last call."""
        gaps, self._entered_gaps = self._entered_gaps, []
        return gaps

    def update(self, vehicles: Mapping[Name, RoadVehicle], t_s: float) -> Iterator[LaneEndChange]:
        """Advance to road time `t_s`; yield what has changed."""
        if not self._any:
            return
        for name in [name for name in self._end_of if name not in vehicles]:
            self._forget(name)
        for name, vehicle in vehicles.items():
            yield from self._leave(name, vehicle, t_s)
        for at, gaps in self._gaps.items():
            waiting = self._waiting(at, vehicles)
            startable = [one for one in waiting if self._may_start(at, one, t_s)]
            if startable and not self._blocking(startable[0], at, vehicles):
                usable = [gap for gap in gaps if self._may_take(gap, at, startable[0], t_s)]
                yield from self._start(startable[0], usable, t_s)
                waiting = self._waiting(at, vehicles)
            startable = [one for one in waiting if self._may_start_at_gap(at, one)]
            yield from self._arrive(gaps, vehicles, t_s)
            blocking = self._blocking(startable[0], at, vehicles) if startable else []
            if not all(self._may_start_at_gap(its_end, one) for its_end, one in blocking):
                startable = []
            last_m = max([self._ends[at].line_m, *(one.state[0] for one in startable[:1])])
            gaps[:] = [gap for gap in gaps if gap.vehicle or not self._is_over(gap, last_m, t_s)]
            free = [gap for gap in gaps if gap.vehicle is None]
            ahead_m = min((one.state[0] for _, one in blocking), default=-math.inf)
            for vehicle in startable:
                own = next((gap for gap in free if self._will_take(gap, at, vehicle)), None)
                if own is None:
                    self._request(at, vehicle, gaps, t_s, ahead_m)
                    break
                free.remove(own)
                ahead_m = vehicle.state[0]

    def _leave(self, name: Name, vehicle: RoadVehicle, t_s: float) -> Iterator[LaneEndChange]:
        """Take a vehicle off the lattice, or back into its own lane, where a lane has ended."""
        controller = vehicle.controller
        missed = controller.has_missed_exit(t_s)
        if missed and controller.return_to_origin():
            yield LaneEndChange(name, MISSED_EXIT, controller.hold_cell[1])
        elif (missed and self._cells_stay_free) or controller.has_lost_cell(t_s):
            # While it re-enters, a vehicle may come to another dead end.
            yield self.take_off(name, vehicle)
        elif controller.off_lattice is OffLatticePhase.WAITING:
            # Parts that are closed for a time come and go ahead of it.
            self._end_of[name] = self._end_ahead(controller.hold_cell[1], vehicle.state[0])

    def bodies(self, vehicles: Mapping[Name, RoadVehicle], t_s: float) -> dict[Name, OffLattice]:
        """Return the lane and the rear of each vehicle without cells, where plans must expect it.

        A vehicle that still drives up to its line counts as where it will stand. One that re-enters
        counts as at the end of the road once it is in the lane of its gap, unless it falls behind:
        no plan leads into the gap, and those behind it will never be nearer to the vehicle.
        """
        found: dict[Name, OffLattice] = {}
        for at, end in self._ends.items():
            for number, vehicle in enumerate(self._waiting(at, vehicles)):
                front_m, speed_mps = vehicle.state[:2]
                if speed_mps > STANDING_MPS or not vehicle.controller.stays:
                    front_m = max(front_m, end.line_m - number * self._queue_m)
                rear_m = front_m - vehicle.size[0]
                found[vehicle.name] = OffLattice(end.lane, rear_m)
        for name in self._end_of:
            if name in vehicles and name not in found:
                vehicle = vehicles[name]
                rear_m, lane = vehicle.state[0] - vehicle.size[0], vehicle.body_lane
                if vehicle.controller.off_lattice is OffLatticePhase.RE_ENTERING:
                    column, its_lane = vehicle.controller.hold_cell
                    min_m = self._lattice.cell_s_m(column, t_s) - ARRIVED_ALONG_M
                    in_gap = lane == its_lane and vehicle.state[0] >= min_m
                    rear_m = self._scenario.road.length_m if in_gap else rear_m
                found[name] = OffLattice(lane, rear_m)
        return found

    def _request(
        self,
        at: LanePosition,
        vehicle: RoadVehicle,
        gaps: list[Gap],
        t_s: float,
        ahead_m: float,
    ) -> None:
        """Keep the next columns free for a vehicle, unless the last gap was too close ahead.

        Args:
            at: dead end at which the vehicle waits.
            vehicle: the vehicle.
            gaps: those of the dead end.
            t_s: road time.
            ahead_m: front of the vehicle that gets the gap before; -inf: there is none.
        """
        arrives_s = self._gap_arrives_s(at[0], vehicle)
        own = self._starts_in_own_lane(at, vehicle, arrives_s)
        lane = at[0] if own else self._beside(at, vehicle, arrives_s)
        if lane is None or (
            not own and lane != self._beside(at, vehicle, self._gap_arrives_s(lane, vehicle))
        ):
            return  # SUMO takes the vehicle back, or it waits until a lane is open
        # Behind the first entry point of the lane, vehicles may own its cells.
        point = lane
        taken = self._meter.points_kept_free(point)
        if own:
            # Others enter the lane only behind it. The vehicle ahead must have started before the
            # gap arrives. The gap before needs the longer to that vehicle the farther ahead it is.
            between = math.ceil(max(ahead_m - vehicle.state[0], 0.0) / self._lattice.pitch_m)
        else:
            between = self._columns_between_gaps(taken, t_s)
        # No vehicle passes a part in the lane of the part; it may pass parts of other lanes there.
        passes_parts = not own or any(part.lane != lane for part in self._temporary.closed)
        last = self._last_gap_column.get(point, math.inf)
        if self._meter.next_column(point) < last - between:
            columns = self._meter.keep_free(point, self._columns, t_s, passes_parts=passes_parts)
            self._last_gap_column |= dict.fromkeys(taken, columns[0])
            gaps.append(Gap(lane, columns))

    def _columns_between_gaps(self, points: Collection[int], t_s: float) -> int:
        """Return the minimum number of columns between two gaps of a lane.

        See `CROWDED_GAPS` and `USED_SHARE`.

        Args:
            points: entry points whose vehicles cannot enter the columns of a gap.
            t_s: road time.
        """
        columns, open_lanes = self._columns, self._meter.most_in_column
        min_columns, max_columns = OPEN_GAPS * columns, CROWDED_GAPS * columns
        waiting = self._meter.waiting
        if any(open_lanes is not None or one.entry_point in points for one in waiting):
            return max_columns
        if open_lanes is None:
            return min_columns
        spare_cells = USED_SHARE * open_lanes - self._meter.vehicles_in_column(t_s)
        gap_cells = columns * min(len(points), open_lanes)
        if gap_cells >= spare_cells * (columns + max_columns):
            return max_columns
        return max(min_columns, math.ceil(gap_cells / spare_cells) - columns)

    def _gap_arrives_s(self, lane: int, vehicle: RoadVehicle) -> float:
        """Return the road time at which the next gap of a lane would begin to pass a vehicle."""
        return self._lattice.passing_time_s(self._meter.next_column(lane), vehicle.state[0])

    def _is_open(self, at: LanePosition, vehicle: RoadVehicle, at_s: float) -> bool:
        """Return whether a vehicle can drive on in its lane at a road time, beyond a dead end.

        The causes of all that is closed there are over, or its body is beyond.
        """
        end, s_m = self._ends[at], vehicle.state[0]
        return s_m >= end.reopens_m or (
            end.sudden
            and not any(
                part.lane == end.lane and s_m < part.to_m and part.from_m < end.reopens_m
                for part in self.still_closed(at_s)
            )
        )

    def _open_lanes(self, vehicle: RoadVehicle, at_s: float) -> list[int]:
        """Return the lanes of a body in which it can drive on beyond the next dead end."""
        ahead = {lane: self._end_ahead(lane, vehicle.state[0]) for lane in vehicle.lanes_used}
        return [lane for lane, at in ahead.items() if at and self._is_open(at, vehicle, at_s)]

    def _later(self, at: LanePosition, vehicle: RoadVehicle) -> Iterator[LaneEnd]:
        """Yield the dead ends of a lane after one of them, ahead of a body."""
        end, s_m = self._ends[at], vehicle.state[0]
        for other in self._ends.values():
            if other.lane == end.lane and other.end_m > end.end_m and s_m < other.reopens_m:
                yield other

    def _starts_in_own_lane(self, at: LanePosition, vehicle: RoadVehicle, at_s: float) -> bool:
        """Return whether a vehicle may start in its own lane at a road time, from where it waits.

        The lane is open, and the vehicle settles before the line of the next dead end.
        """
        settles_m = max(self._ends[at].reopens_m, vehicle.state[0]) + self._distance_m
        return self._is_open(at, vehicle, at_s) and all(
            other.line_m >= settles_m for other in self._later(at, vehicle)
        )

    def _beside(self, at: LanePosition, vehicle: RoadVehicle, at_s: float) -> int | None:
        """Return the lane into which a vehicle at a dead end re-enters at a road time, if any.

        It needs room in its own lane until it is out of it.
        """
        end, s_m = self._ends[at], vehicle.state[0]
        if end.taken_back:
            return None
        if not self._is_before_line(at, vehicle):
            room_m = min((one.end_m for one in self._later(at, vehicle)), default=math.inf) - s_m
            if room_m < self._room_m or not self._is_open(at, vehicle, at_s):
                return None
            starts_m = s_m
        else:
            # Without a part that is closed for a time, it drives up to the line.
            starts_m = min(s_m, end.line_m) if vehicle.controller.stays else end.line_m
        return lane_beside(self._scenario, end.lane, starts_m, self._sections)

    def _is_before_line(self, at: LanePosition, vehicle: RoadVehicle) -> bool:
        """Return whether a vehicle waits at the stop line before a dead end, or before it."""
        return vehicle.state[0] <= self._ends[at].line_m + NEAR_LINE_M

    def _may_start(self, at: LanePosition, vehicle: RoadVehicle, at_s: float) -> bool:
        """Return whether a vehicle that waits may start at a road time, and has room to start.

        One that has broken down may start in its own lane once it is repaired.
        """
        breaks_down = vehicle.controller.broken_mps2 is not None
        if breaks_down and vehicle.state[1] > STANDING_MPS:
            return False
        return self._starts_in_own_lane(at, vehicle, at_s) or (
            not breaks_down
            and (self._is_before_line(at, vehicle) or self._beside(at, vehicle, at_s) is not None)
        )

    def _may_start_at_gap(self, at: LanePosition, vehicle: RoadVehicle) -> bool:
        """Return whether a vehicle may start when the next gap would pass it.

        So those that wait for a part whose end is known get gaps that arrive soon after it.
        """
        return self._may_start(at, vehicle, self._gap_arrives_s(at[0], vehicle))

    def _may_take(self, gap: Gap, at: LanePosition, vehicle: RoadVehicle, at_s: float) -> bool:
        """Return whether a vehicle can start into a gap at a road time from where it waits."""
        if gap.lane == at[0]:
            return self._starts_in_own_lane(at, vehicle, at_s)
        return gap.lane == self._beside(at, vehicle, at_s)

    def _will_take(self, gap: Gap, at: LanePosition, vehicle: RoadVehicle) -> bool:
        """Return whether a vehicle can start into a gap when it passes."""
        passes_s = self._lattice.passing_time_s(gap.columns[-1], vehicle.state[0])
        return self._may_take(gap, at, vehicle, passes_s)

    def take_off(self, name: Name, vehicle: RoadVehicle) -> LaneEndChange:
        """Take a vehicle off the lattice that has broken down, or whose lane ends."""
        self._forget(name)
        vehicle.controller.leave_lattice()
        lane = vehicle.controller.hold_cell[1]
        at = self._end_of[name] = self._end_ahead(lane, vehicle.state[0])
        vehicle.controller.stays = at is not None and self._ends[at].sudden
        return LaneEndChange(name, LEFT_LATTICE, lane)

    def _end_ahead(self, lane: int, s_m: float) -> LanePosition | None:
        """Return the first dead end of a lane that a body has not passed, or else the last one."""
        ends = [at for at in self._ends if at[0] == lane]
        ahead = (at for at in ends if s_m < self._ends[at].reopens_m)
        return next(ahead, ends[-1] if ends else None)

    def _blocking(
        self, vehicle: RoadVehicle, at: LanePosition, vehicles: Mapping[Name, RoadVehicle]
    ) -> list[tuple[LanePosition, RoadVehicle]]:
        """Return the vehicles that leave a vehicle no room to start, with their dead ends.

        They wait ahead of it, at the same dead end or the next ones.
        """
        s_m = vehicle.state[0]
        return [
            (its_end, one)
            for its_end in self._ends
            if its_end[0] == at[0]
            for one in self._waiting(its_end, vehicles)
            if one.state[0] > s_m and one.state[0] - one.size[0] - s_m < self._room_m
        ]

    def _waiting(self, at: LanePosition, vehicles: Mapping[Name, RoadVehicle]) -> list[RoadVehicle]:
        """Return the vehicles that wait at a dead end, foremost first."""
        waiting = [
            vehicles[name]
            for name, its_end in self._end_of.items()
            if its_end == at
            and name in vehicles
            and vehicles[name].controller.off_lattice is OffLatticePhase.WAITING
        ]
        return sorted(waiting, key=lambda vehicle: -vehicle.state[0])

    def _start(
        self, vehicle: RoadVehicle, gaps: Collection[Gap], t_s: float
    ) -> Iterator[LaneEndChange]:
        """Let the foremost waiting vehicle re-enter if a gap is passing it."""
        s_m, speed_mps = vehicle.state[0], vehicle.state[1]
        if speed_mps > STANDING_MPS:
            return
        settles_s = 2.0 * self._distance_m / self._lattice.speed_mps
        for gap in gaps:
            if any(
                part.lane == gap.lane
                and part.speed_mps > STANDING_MPS  # at rest, it may wait for this vehicle
                and part.at(t_s)[0] < s_m + self._distance_m
                and part.at(t_s + settles_s)[1] > s_m - vehicle.size[0]
                for part in self._temporary.cleared
            ):
                continue  # for a fast vehicle of another system
            passed_s = t_s - self._lattice.passing_time_s(gap.columns[-1], s_m)
            if gap.vehicle is None and 0.0 <= passed_s <= START_S and self._is_free(vehicle, gap):
                gap.vehicle = vehicle.name
                # Weak types need more columns than strong ones, which arrive earlier.
                limits = self._scenario.types[vehicle.arrival.vehicle_type].limits
                own = own_re_entry(self._scenario, limits)
                cell = gap.columns[-own.columns], gap.lane
                vehicle.controller.re_enter(cell, self._open_lanes(vehicle, t_s))
                yield LaneEndChange(vehicle.name, DRIVES_OUT, gap.lane)
                return

    def _is_free(self, vehicle: RoadVehicle, gap: Gap) -> bool:
        """Return whether the sensors of a vehicle show that a gap is free."""
        neighbours = vehicle.controller.neighbours
        # The vehicle behind is a column behind the rearmost of the gap.
        behind_m = (len(gap.columns) - 1) * self._lattice.pitch_m - vehicle.size[0]
        slow_mps = 0.5 * self._lattice.speed_mps
        return all(
            other.gap_m > (BESIDE_M if other.speed_mps > slow_mps else self._distance_m)
            for other in neighbours.ahead
            if other.lane == gap.lane
        ) and all(
            other.gap_m > behind_m
            for other in neighbours.behind
            if other.lane == gap.lane
            # Behind a vehicle that starts in its own lane, others wait.
            and (other.speed_mps > STANDING_MPS or gap.lane != vehicle.body_lane)
        )

    def _arrive(
        self, gaps: list[Gap], vehicles: Mapping[Name, RoadVehicle], t_s: float
    ) -> Iterator[LaneEndChange]:
        """Let vehicles that have arrived enter the lattice."""
        for gap in list(gaps):
            name = gap.vehicle
            if name is None or not vehicles[name].controller.has_settled(t_s):
                continue
            vehicles[name].enter_lattice(gap.cells)
            gaps.remove(gap)
            del self._end_of[name]
            self._entered_gaps.append(gap.columns)
            yield LaneEndChange(name, ENTERED_LATTICE, gap.lane)

    def _is_over(self, gap: Gap, last_m: float, t_s: float) -> bool:
        """Return whether all of a gap has passed the line, and the first vehicle that may start."""
        return t_s > self._lattice.passing_time_s(gap.columns[-1], last_m) + START_S

    def _forget(self, name: Name) -> None:
        """Forget a vehicle, and the gap into which it drives."""
        at = self._end_of.pop(name, None)
        if at is not None:
            self._gaps[at][:] = [gap for gap in self._gaps[at] if gap.vehicle != name]
