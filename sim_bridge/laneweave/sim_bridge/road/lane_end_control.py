"""The roadside at the ends of lanes: brings vehicles that wait there back into the lattice.

For each vehicle that waits at a dead end, the entry meter keeps some columns of a lane beside it
free, or of its own lane once that is open (a *gap*): no vehicle enters them, and no vehicle owns
their cells, so no plan leads into them. When the gap passes the vehicle, its motion controller
drives into it, and takes its cells once it has arrived in one of the last columns; `restarts` says
where it can start. This needs neither agent nor leader nor
message: it is how a vehicle enters at the start of the road.

With formations, the columns are free in all lanes and belong to no formation. The vehicle that
enters them is a formation of its own.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping

from attrs import define, frozen

from laneweave.protocol.lattice import Cell
from laneweave.protocol.road_layout import NO_PARTS, LanePosition
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.vehicle.lane_ends import LaneEnds
from laneweave.protocol.vehicle.motion import ARRIVED_ALONG_M
from laneweave.protocol.vehicle.re_entry import START_S
from laneweave.protocol.vehicle.sudden_stops import queue_pitch_m
from laneweave.protocol.vehicle.territory import territory_of
from laneweave.protocol.wire.events import DRIVES_OUT, ENTERED_LATTICE, LEFT_LATTICE, MISSED_EXIT
from laneweave.protocol.wire.messages import Name, OffLattice
from laneweave.sim_bridge.bodies.command_checks import BESIDE_M
from laneweave.sim_bridge.bodies.motion_controller import OffLatticePhase
from laneweave.sim_bridge.bodies.stop_lines import STANDING_MPS
from laneweave.sim_bridge.road.entry import EntryMeter
from laneweave.sim_bridge.road.restarts import ClosedParts, Restarts, Waiting, WaitingBody
from laneweave.sim_bridge.road.vehicle import RoadVehicle

OPEN_GAPS, CROWDED_GAPS = 1, 5
"""Number of gap lengths of columns between two gaps of a lane that vehicles may enter, so that its
traffic, and vehicles that change into it, keep most of its cells; and the same while vehicles wait
at the entrance of the lane or, while a part is closed for a time, at any entrance. With fewer, gaps
would use up the capacity of dense traffic."""
LAST_S = 60.0
"""Time for which vehicles beyond a stop line get their gaps after those at the line."""
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

    def __init__(self, scenario: Scenario, meter: EntryMeter, closed: ClosedParts) -> None:
        """Begin without vehicles."""
        self._meter = meter
        self._closed = closed
        self._cells_stay_free = territory_of(scenario).given_up_cells_stay_free
        self._scenario = scenario
        self._lattice = scenario.lattice
        self._queue_m = queue_pitch_m(scenario)
        self._any = False
        self._temporary = NO_PARTS
        self._gaps: dict[LanePosition, list[Gap]] = {}
        self._last_gap_column: dict[int, float] = {}
        """Rearmost column of the last gap, by entry point."""
        self._last_passing_gap = math.inf
        """Rearmost column of the last gap in a lane in which vehicles pass closed parts."""
        self._entered_gaps: list[range] = []
        """Columns of gaps that vehicles have entered, since they were last taken."""
        self._end_of: dict[Name, LanePosition | None] = {}
        """Dead end at which each vehicle without cells waits or waited; None: its lane has none."""
        self._since_s: dict[Name, float] = {}
        """Since when each of them has no cells."""
        self.close(LaneEnds(scenario))

    def close(self, lane_ends: LaneEnds) -> None:
        """Replace the ends of lanes.

        Args:
            lane_ends: those of the road, and of parts that are closed for a time, which may
                vanish only when no vehicle waits there (`in_use`).
        """
        self._any, self._temporary = bool(lane_ends), lane_ends.temporary
        self._restarts = Restarts(self._scenario, self._closed, lane_ends)
        # In a lane, those ahead get gaps first.
        farthest_first = sorted(self._restarts.ends, key=lambda at: (at[0], -at[1]))
        before, self._gaps = self._gaps, {at: [] for at in farthest_first}
        for at, gaps in before.items():
            merged = self._restarts.merged(at)
            if merged is not None:
                self._gaps[merged] += gaps
        for name, its_end in self._end_of.items():
            if its_end is not None:
                self._end_of[name] = self._restarts.merged(its_end)

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
        self._since_s = {name: self._since_s.get(name, t_s) for name in self._end_of}
        for at, gaps in self._gaps.items():
            yield from self._arrive(gaps, vehicles, t_s)
            waiting = self._waiting(at, vehicles)
            in_order = self._in_order(waiting, vehicles, t_s)
            assigned = list(self._assign(in_order, gaps, vehicles, t_s))
            used = [gap for _, gap in assigned if gap is not None]
            able = (one.s_m for one in waiting if one.vehicle.controller.broken_mps2 is None)
            last_m = max(self._restarts.ends[at].line_m, next(able, -math.inf))
            gaps[:] = [
                gap
                for gap in gaps
                if gap.vehicle or gap in used or not self._has_passed(gap, last_m, t_s)
            ]
            for one, gap in assigned:
                if gap is None:
                    self._request(one, vehicles, t_s)
                elif self._can_start(one, gap, vehicles, t_s):
                    yield self._start(one, gap, t_s)

    def _in_order(
        self, waiting: list[Waiting], vehicles: Mapping[Name, RoadVehicle], t_s: float
    ) -> list[Waiting]:
        """Return the vehicles at a dead end in the order in which they get gaps.

        Those between the line and a part that is closed need long gaps, which cost others time, so
        they come last for a time, unless they leave no room to those behind them.
        """
        last = [
            one
            for one in waiting
            if self._restarts.is_beyond_line(one, t_s)
            and t_s < self._since_s[one.vehicle.name] + LAST_S
        ]
        first = [one for one in waiting if one not in last]
        at_line = [one for one in first if last and one.s_m < last[-1].s_m]  # foremost first
        if not at_line or any(one in last for one in self._blocking(at_line[0], vehicles, t_s)):
            return waiting
        return first + last

    def _assign(
        self,
        waiting: Iterable[Waiting],
        gaps: Iterable[Gap],
        vehicles: Mapping[Name, RoadVehicle],
        t_s: float,
    ) -> Iterator[tuple[Waiting, Gap | None]]:
        """Yield the vehicles at a dead end that can start when a gap passes, and their gaps.

        Of those that have none, only the first one is yielded, as it will wait when those ahead
        that have gaps have started.
        """
        free = sorted(
            (gap for gap in gaps if gap.vehicle is None), key=lambda gap: -gap.columns[-1]
        )
        before: Waiting | None = None
        given: set[Name] = set()
        requested = False
        for one in waiting:
            then = one if before is None or before.s_m < one.s_m else one.behind(before)
            before = None
            gap = next((gap for gap in free if self._will_take(gap, then, t_s)), None)
            if gap is None and (requested or not self._may_start_at_gap(then.cautious)):
                continue
            at_s = self._gap_arrives_s(one.at[0], then)
            if gap is not None:
                at_s = self._lattice.passing_time_s(gap.columns[-1], one.s_m)
            if not all(
                each.vehicle.name in given or (each.at != one.at and self._may_start_at_gap(each))
                for each in self._blocking(then, vehicles, at_s)
            ):
                continue
            if gap is None:
                requested = True
                yield then.cautious, None
            else:
                yield one, gap
                free.remove(gap)
                given.add(one.vehicle.name)
                before = then

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
            self._end_of[name] = self._restarts.end_ahead(controller.hold_cell[1], vehicle.state[0])

    def bodies(self, vehicles: Mapping[Name, RoadVehicle], t_s: float) -> dict[Name, OffLattice]:
        """Return the lane and the rear of each vehicle without cells, where plans must expect it.

        A vehicle that still drives up to its line counts as where it will stand. One that re-enters
        counts as at the end of the road once it is in the lane of its gap, unless it falls behind:
        no plan leads into the gap, and those behind it will never be nearer to the vehicle.
        """
        found: dict[Name, OffLattice] = {}
        for at, end in self._restarts.ends.items():
            for number, one in enumerate(self._waiting(at, vehicles)):
                vehicle, (front_m, speed_mps) = one.vehicle, one.vehicle.state[:2]
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

    def _request(self, one: Waiting, vehicles: Mapping[Name, RoadVehicle], t_s: float) -> None:
        """Keep the next columns of a lane free for a vehicle, unless gaps are too close ahead."""
        lane = one.at[0]
        arrives_s = self._gap_arrives_s(lane, one)
        if self._restarts.starts_in_own_lane(one, arrives_s):
            # Others enter the lane only behind it. The vehicle ahead must have started before the
            # gap arrives. The gap before needs the longer to that vehicle the farther ahead it is.
            blocking = self._blocking(one, vehicles, arrives_s)
            ahead_m = min((each.s_m for each in blocking), default=-math.inf)
            between = math.ceil(max(ahead_m - one.s_m, 0.0) / self._lattice.pitch_m)
            # No vehicle passes a part in its lane; it may pass parts of other lanes there.
            passes_parts = any(part.lane != lane for part in self._temporary.closed)
            columns = self._restarts.needed.columns
            if self._meter.next_column(lane) < self._last_gap_column.get(lane, math.inf) - between:
                self._keep_free(one, lane, columns, t_s, passes_parts=passes_parts)
            return
        # SUMO may take the vehicle back, or no lane is open yet.
        lanes = self._restarts.lanes_beside(one, arrives_s)
        # The lane whose gap arrives first, or else the one that had no gap for the longest time.
        last = self._last_gap_column
        for lane in sorted(
            lanes,
            key=lambda lane: (self._meter.next_column(lane), last.get(lane, math.inf)),
            reverse=True,
        ):
            needed = self._restarts.needed_by(one, arrives_s := self._gap_arrives_s(lane, one))
            if (
                needed is not None
                and lane in self._restarts.lanes_beside(one, arrives_s)
                and self._is_spaced(lane, needed.columns, t_s)
            ):
                self._keep_free(one, lane, needed.columns, t_s, passes_parts=True)
                return

    def _keep_free(
        self, one: Waiting, lane: int, count: int, t_s: float, *, passes_parts: bool
    ) -> None:
        # Behind the first entry point of the lane, vehicles may own its cells.
        columns = self._meter.keep_free(lane, count, t_s, passes_parts=passes_parts)
        points = self._meter.points_kept_free(lane)
        self._last_gap_column |= dict.fromkeys(points, columns[0])
        if passes_parts:
            self._last_passing_gap = columns[0]
        self._gaps[one.at].append(Gap(lane, columns))

    def _is_spaced(self, lane: int, columns: int, t_s: float) -> bool:
        """Return whether a gap is far enough from the last ones for the other traffic.

        See `CROWDED_GAPS` and `USED_SHARE`.

        Args:
            lane: lane of the gap.
            columns: number of its columns.
            t_s: road time.
        """
        points, open_lanes = self._meter.points_kept_free(lane), self._meter.most_in_column
        in_lane, in_all, most = OPEN_GAPS * columns, 0, CROWDED_GAPS * columns
        if open_lanes is None:
            if any(one.entry_point in points for one in self._meter.waiting):
                in_lane = most
        elif self._meter.waiting:
            in_lane = in_all = most
        else:
            spare_cells = USED_SHARE * open_lanes - self._meter.vehicles_in_column(t_s)
            gap_cells = columns * min(len(points), open_lanes)
            is_full = gap_cells >= spare_cells * (columns + most)
            in_all = most if is_full else max(0, math.ceil(gap_cells / spare_cells) - columns)
        next_column, last = self._meter.next_column(lane), self._last_gap_column.get(lane, math.inf)
        return next_column < min(last - max(in_lane, in_all), self._last_passing_gap - in_all)

    def _gap_arrives_s(self, lane: int, one: Waiting) -> float:
        """Return the road time at which the next gap of a lane would begin to pass a vehicle."""
        return self._lattice.passing_time_s(self._meter.next_column(lane), one.s_m)

    def _may_start_at_gap(self, one: Waiting) -> bool:
        """Return whether a vehicle may start when the next gap would pass it.

        So those that wait for a part whose end is known get gaps that arrive soon after it.
        """
        return self._restarts.may_start(one, self._gap_arrives_s(one.at[0], one))

    def _will_take(self, gap: Gap, one: Waiting, t_s: float) -> bool:
        """Return whether a vehicle can start into a gap when it passes, and it has not passed."""
        at_s = max(t_s, self._lattice.passing_time_s(gap.columns[-1], one.s_m))
        return (
            not self._has_passed(gap, one.s_m, t_s)
            and self._restarts.may_start(one, at_s)
            and self._restarts.may_take(gap.lane, len(gap.columns), one, at_s)
        )

    def take_off(self, name: Name, vehicle: RoadVehicle) -> LaneEndChange:
        """Take a vehicle off the lattice that has broken down, or whose lane ends."""
        self._forget(name)
        vehicle.controller.leave_lattice()
        lane = vehicle.controller.hold_cell[1]
        at = self._end_of[name] = self._restarts.end_ahead(lane, vehicle.state[0])
        vehicle.controller.stays = at is not None and self._restarts.ends[at].sudden
        return LaneEndChange(name, LEFT_LATTICE, lane)

    def _blocking(
        self, one: Waiting, vehicles: Mapping[Name, RoadVehicle], at_s: float
    ) -> list[Waiting]:
        """Return the vehicles that leave a vehicle no room to start.

        They wait ahead of it, at the same dead end or the next ones.
        """
        needed = self._restarts.needed_by(one, at_s) or self._restarts.needed
        return [
            each
            for its_end in self._restarts.ends
            if its_end[0] == one.at[0]
            for each in self._waiting(its_end, vehicles)
            if each.s_m > one.s_m and each.s_m - each.vehicle.size[0] - one.s_m < needed.room_m
        ]

    def _waiting(self, at: LanePosition, vehicles: Mapping[Name, RoadVehicle]) -> list[Waiting]:
        """Return the vehicles that wait at a dead end, foremost first."""
        waiting = [
            Waiting.of(vehicles[name], at)
            for name, its_end in self._end_of.items()
            if its_end == at
            and name in vehicles
            and vehicles[name].controller.off_lattice is OffLatticePhase.WAITING
        ]
        return sorted(waiting, key=lambda one: -one.s_m)

    def _can_start(
        self, one: Waiting, gap: Gap, vehicles: Mapping[Name, RoadVehicle], t_s: float
    ) -> bool:
        """Return whether a waiting vehicle can start into a gap now, which is passing it."""
        passed_s = t_s - self._lattice.passing_time_s(gap.columns[-1], one.s_m)
        if (
            one.vehicle.state[1] > STANDING_MPS
            or not 0.0 <= passed_s <= START_S
            or not self._restarts.may_start(one, t_s)
            or not self._restarts.may_take(gap.lane, len(gap.columns), one, t_s)
            or self._blocking(one, vehicles, t_s)
        ):
            return False
        distance_m = self._restarts.into(gap.lane, one, t_s)[0].distance_m
        settles_s = 2.0 * distance_m / self._lattice.speed_mps
        return self._is_free(one.vehicle, gap, distance_m) and not any(
            part.lane == gap.lane
            and part.speed_mps > STANDING_MPS  # at rest, it may wait for this vehicle
            and part.at(t_s)[0] < one.s_m + distance_m
            and part.at(t_s + settles_s)[1] > one.s_m - one.vehicle.size[0]
            for part in self._temporary.cleared  # for a fast vehicle of another system
        )

    def _start(self, one: Waiting, gap: Gap, t_s: float) -> LaneEndChange:
        """Let a waiting vehicle re-enter into a gap."""
        vehicle = one.vehicle
        gap.vehicle = vehicle.name
        needed, slowly = self._restarts.into(gap.lane, one, t_s)
        cell = gap.columns[-needed.columns], gap.lane
        passable = self._restarts.passable_lanes(vehicle, t_s)
        vehicle.controller.re_enter(cell, passable, keeps_distance=slowly)
        return LaneEndChange(vehicle.name, DRIVES_OUT, gap.lane)

    def _is_free(self, vehicle: WaitingBody, gap: Gap, distance_m: float) -> bool:
        """Return whether the sensors of a vehicle show that a gap is free."""
        neighbours = vehicle.controller.neighbours
        # The vehicle behind is a column behind the rearmost of the gap.
        behind_m = (len(gap.columns) - 1) * self._lattice.pitch_m - vehicle.size[0]
        slow_mps = 0.5 * self._lattice.speed_mps
        return all(
            other.gap_m > (BESIDE_M if other.speed_mps > slow_mps else distance_m)
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

    def _has_passed(self, gap: Gap, s_m: float, t_s: float) -> bool:
        """Return whether it is too late to start into a gap at a position."""
        return t_s > self._lattice.passing_time_s(gap.columns[-1], s_m) + START_S

    def _forget(self, name: Name) -> None:
        """Forget a vehicle, and the gap into which it drives."""
        at = self._end_of.pop(name, None)
        if at is not None:
            self._gaps[at][:] = [gap for gap in self._gaps[at] if gap.vehicle != name]
