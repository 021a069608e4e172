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
from collections.abc import Collection, Iterator, Mapping

from attrs import define, frozen

from laneweave.protocol.lattice import Cell
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.vehicle.lane_ends import (
    START_S,
    LaneEnd,
    LaneEnds,
    lane_beside,
    own_re_entry,
    re_entry,
)
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
at the entrance of the lane. With fewer, gaps would use up the capacity of dense traffic."""


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
    """`LEFT_LATTICE`, `DRIVES_OUT`, `ENTERED_LATTICE` or `MISSED_EXIT`."""
    lane: int


class LaneEndControl:
    """Vehicles without cells, and the gaps that are kept free for them."""

    def __init__(self, scenario: Scenario, meter: EntryMeter) -> None:
        """Begin without vehicles."""
        self._meter = meter
        self._cells_stay_free = territory_of(scenario).given_up_cells_stay_free
        self._scenario = scenario
        self._lattice = scenario.lattice
        ends = LaneEnds(scenario)
        self._any = bool(ends)
        self._ends = tuple(ends)
        self._beside = {
            end: None if end.taken_back else lane_beside(scenario, end) for end in self._ends
        }
        needed = re_entry(scenario) if self._ends else None
        self._columns = needed.columns if needed is not None else 0
        self._distance_m = needed.distance_m if needed is not None else 0.0
        """Distance behind a slow vehicle that is needed for re-entry."""
        self._queue_m = scenario.types.longest_body_m + scenario.tracking.min_gap_m
        """Distance between the fronts of vehicles that stand in a queue."""
        self._gaps: dict[LaneEnd, list[Gap]] = {end: [] for end in self._ends}
        self._last_gap_column: dict[int, float] = {}
        """Rearmost column of the last gap, by entry point."""
        self._entered_gaps: list[range] = []
        """Columns of gaps that vehicles have entered, since they were last taken."""
        self._end_of: dict[Name, LaneEnd | None] = {}
        """Dead end at which each vehicle without cells waits or waited; None: its lane has none."""

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
            controller = vehicle.controller
            missed = controller.has_missed_exit(t_s)
            if missed and controller.return_to_origin(t_s):
                yield LaneEndChange(name, MISSED_EXIT, controller.hold_cell[1])
            elif (missed and self._cells_stay_free) or controller.has_lost_cell(t_s):
                # While it re-enters, a vehicle may come to another dead end.
                self._forget(name)
                yield self._take_off(name, vehicle)
        for end, gaps in self._gaps.items():
            waiting = self._waiting(end, vehicles)
            if waiting:
                yield from self._start(waiting[0], gaps, t_s)
                waiting = self._waiting(end, vehicles)
            yield from self._arrive(gaps, vehicles, t_s)
            gaps[:] = [gap for gap in gaps if gap.vehicle or not self._is_over(gap, end, t_s)]
            coming = sum(gap.vehicle is None for gap in gaps)
            if len(waiting) > coming:
                self._request(end, gaps, t_s)

    def bodies(self, vehicles: Mapping[Name, RoadVehicle]) -> dict[Name, OffLattice]:
        """Return the lane and the rear of each vehicle without cells.

        A vehicle that still drives up to its line counts as where it will stand.
        """
        found: dict[Name, OffLattice] = {}
        for end in self._ends:
            for number, vehicle in enumerate(self._waiting(end, vehicles)):
                stands_m = end.line_m - number * self._queue_m
                rear_m = max(vehicle.state[0], stands_m) - vehicle.size[0]
                found[vehicle.name] = OffLattice(end.lane, rear_m)
        for name in self._end_of:
            if name in vehicles and name not in found:
                s_m, _, _, y_m, _, _ = vehicles[name].state
                lane = int(y_m // self._lattice.lane_width_m)
                found[name] = OffLattice(lane, s_m - vehicles[name].size[0])
        return found

    def _request(self, end: LaneEnd, gaps: list[Gap], t_s: float) -> None:
        """Keep the next columns beside an end free, unless the last gap was too close ahead."""
        lane = self._beside[end]
        if lane is None:
            return  # SUMO takes the vehicle back
        # Behind the first entry point of the lane, vehicles may own its cells.
        point = lane
        taken = self._meter.points_kept_free(point)
        crowded = any(arrival.entry_point in taken for arrival in self._meter.waiting)
        between = (CROWDED_GAPS if crowded else OPEN_GAPS) * self._columns
        last = self._last_gap_column.get(point, math.inf)
        if self._meter.next_column(point) < last - between:
            columns = self._meter.keep_free(point, self._columns, t_s)
            self._last_gap_column |= dict.fromkeys(taken, columns[0])
            gaps.append(Gap(lane, columns))

    def _take_off(self, name: Name, vehicle: RoadVehicle) -> LaneEndChange:
        vehicle.controller.leave_lattice()
        lane, s_m = vehicle.controller.hold_cell[1], vehicle.state[0]
        ends = [end for end in self._ends if end.lane == lane]
        # The first that the body has not passed.
        last = ends[-1] if ends else None
        self._end_of[name] = next((end for end in ends if s_m < end.reopens_m), last)
        return LaneEndChange(name, LEFT_LATTICE, lane)

    def _waiting(self, end: LaneEnd, vehicles: Mapping[Name, RoadVehicle]) -> list[RoadVehicle]:
        """Return the vehicles that wait at a dead end, foremost first."""
        waiting = [
            vehicles[name]
            for name, its_end in self._end_of.items()
            if its_end == end
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
        for gap in gaps:
            passed_s = t_s - self._lattice.passing_time_s(gap.columns[-1], s_m)
            if gap.vehicle is None and 0.0 <= passed_s <= START_S and self._is_free(vehicle, gap):
                gap.vehicle = vehicle.name
                # Weak types need more columns than strong ones, which arrive earlier.
                limits = self._scenario.types[vehicle.arrival.vehicle_type].limits
                own = own_re_entry(self._scenario, limits)
                vehicle.controller.re_enter((gap.columns[-own.columns], gap.lane))
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
        ) and all(other.gap_m > behind_m for other in neighbours.behind if other.lane == gap.lane)

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

    def _is_over(self, gap: Gap, end: LaneEnd, t_s: float) -> bool:
        """Return whether all of a gap has passed the stop line."""
        return t_s > self._lattice.passing_time_s(gap.columns[-1], end.line_m) + START_S

    def _forget(self, name: Name) -> None:
        """Forget a vehicle, and the gap into which it drives."""
        end = self._end_of.pop(name, None)
        if end is not None:
            self._gaps[end][:] = [gap for gap in self._gaps[end] if gap.vehicle != name]
