"""Planted bugs of roads whose lanes end, and of ramps and exits."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping

import pytest
from attrs import evolve
from msgspec.structs import replace

from laneweave.agents.core import AgentCore
from laneweave.protocol.lattice import Cell
from laneweave.protocol.road_layout import Exits, TemporaryClosure
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.vehicle_tables import Vehicle
from laneweave.protocol.scenario.vehicle_types import VehicleTypes
from laneweave.protocol.vehicle.lane_end import LaneEnd
from laneweave.protocol.vehicle.lane_ends import LaneEnds
from laneweave.protocol.vehicle.plan_execution import PlanExecution
from laneweave.protocol.vehicle.re_entry import ReEntry, own_re_entry
from laneweave.protocol.vehicle.sudden_stops import stopping_m
from laneweave.protocol.wire.messages import Census, CensusEntry, Command, Name, Sense
from laneweave.sim_bridge.bodies import motion_controller
from laneweave.sim_bridge.bodies.motion_controller import MotionController, OffLatticePhase
from laneweave.sim_bridge.bodies.stop_lines import StopLinesAhead
from laneweave.sim_bridge.road import lane_end_control, restarts
from laneweave.sim_bridge.road.allocation import CellAllocation
from laneweave.sim_bridge.road.entry import EntryMeter
from laneweave.sim_bridge.road.formation_building import (
    ColumnBlocks,
    Entrances,
    GrowingFormations,
)
from laneweave.sim_bridge.road.lane_end_control import LaneEndControl
from laneweave.sim_bridge.road.obstacles import Obstacles
from laneweave.sim_bridge.road.passing_vehicles import PassingVehicle, PassingVehicles
from laneweave.sim_bridge.road.restarts import Waiting
from laneweave.sim_bridge.road.roadside import EntranceRoom, Roadside
from laneweave.sim_bridge.road.vehicle import RoadVehicle
from laneweave.sim_bridge.road.vehicles_in_part import VehiclesInPart
from support.bugs import Bug, breaks
from support.states import set_record

Patch = pytest.MonkeyPatch
Call = Callable[..., None]
"""A method that is replaced."""
Vehicles = Mapping[Name, RoadVehicle]
LANE_ENDS, OBSTACLES, RAMPS = "lane ends", "lanes closed for a time", "ramps, exits"
PASSING_VEHICLES = "vehicles of other systems"
FORMATIONS = "formations on roads"
"""What the bugs are about."""

# --- leaving the lattice, and entering it again -----------------------------------------------


@breaks(LANE_ENDS, LaneEnds, "has_passed")
def never_leaves(*_: object, **__: object) -> bool:
    """A vehicle whose cell has passed the stop line stays in it."""
    return False


@breaks(LANE_ENDS)
def agents_move_vehicles_without_cells(patch: Patch) -> None:
    """The motion controller of a vehicle without cells executes commands."""
    accept_command = MotionController.accept_command

    def accept(self: MotionController, command: Command) -> bool:
        off_lattice, self.off_lattice = self.off_lattice, None
        try:
            return accept_command(self, command)
        finally:
            self.off_lattice = off_lattice

    patch.setattr(MotionController, "accept_command", accept)
    agent_remembers.plant(patch)


@breaks(LANE_ENDS, AgentCore, "_act")
def agent_remembers(
    act: Callable[..., list[object]], self: AgentCore, sense: Sense, **more: bool
) -> list[object]:
    """An agent does not notice that its vehicle has left the lattice."""
    self._sense = blind = replace(sense, off_lattice=False)
    return act(self, blind, **more)


@breaks(LANE_ENDS, LaneEndControl, "is_kept_free")
def gaps_are_given_away(*_: object) -> bool:
    """The roadside assigns the cells of a gap to vehicles near them."""
    return False


@breaks(LANE_ENDS)
def still_listed(patch: Patch) -> None:
    """Leaders plan for vehicles that have left the lattice."""

    def on_lattice(census: Census) -> tuple[CensusEntry, ...]:
        return census.on_road

    patch.setattr(Census, "on_lattice", property(on_lattice))


@breaks(LANE_ENDS, LaneEndControl, "update")
def gap_taken_too_early(
    update: Callable[..., Collection[object]], self: LaneEndControl, vehicles: Vehicles, t_s: float
) -> Collection[object]:
    """A vehicle gets its cells when it begins to re-enter, from another gap."""
    changes = list(update(self, vehicles, t_s))
    for gaps in self._gaps.values():
        for gap in gaps:
            if gap.vehicle is not None and gap.columns[0] > -(10**6):
                gap.columns = range(gap.columns[0] - 2, gap.columns[-1] - 1)
    return changes


# --- stop lines, queues, and gaps for re-entry ---------------------------------------------


@breaks(LANE_ENDS, StopLinesAhead, "lines")
def no_stop_line(*_: object, **__: object) -> list[object]:
    """Vehicles do not stop before the end of their lane."""
    return []


@breaks(LANE_ENDS)
def line_at_the_end(patch: Patch) -> None:
    """There is no room to accelerate before the end of the lane."""
    ahead, ends_of = LaneEnds.ahead, LaneEnds.__iter__

    def at_the_end(end: LaneEnd) -> LaneEnd:
        return evolve(end, line_m=end.end_m, stop_m=end.end_m)

    def ahead_of(self: LaneEnds, lane: int, s_m: float) -> LaneEnd | None:
        end = ahead(self, lane, s_m)
        return None if end is None else at_the_end(end)

    patch.setattr(LaneEnds, "ahead", ahead_of)
    patch.setattr(LaneEnds, "__iter__", lambda self: map(at_the_end, ends_of(self)))


@breaks(LANE_ENDS, MotionController, "leave_lattice")
def keeps_its_cells(leave_lattice: Call, self: MotionController) -> None:
    """A vehicle that leaves the lattice keeps its cells."""
    owned = self.record.owned
    leave_lattice(self)
    set_record(self.store, owned=owned)


@breaks(LANE_ENDS)
def gap_is_entered(patch: Patch) -> None:
    """The entry meter only says that it keeps columns free, and sensors are not asked."""

    def keep_free(self: EntryMeter, lane: int, count: int, *_: object, **__: object) -> range:
        return range(self._columns[lane] - count + 1, self._columns[lane] + 1)

    patch.setattr(LaneEndControl, "_is_free", lambda *_: True)
    patch.setattr(EntryMeter, "keep_free", keep_free)


@breaks(LANE_ENDS, restarts, "re_entry", "own_re_entry")
def gap_too_short(needed: Callable[..., ReEntry], *given: object) -> ReEntry:
    """A gap has room for the vehicle, but not for re-entry."""
    return evolve(needed(*given), columns=1)


@breaks(LANE_ENDS)
def starts_without_a_gap(patch: Patch) -> None:
    """Vehicles re-enter long before their gap passes."""
    can_start: Callable[..., object] = LaneEndControl._can_start

    def mutant(
        self: LaneEndControl, one: object, gap: object, vehicles: object, t_s: float
    ) -> object:
        return can_start(self, one, gap, vehicles, t_s + 30.0)

    patch.setattr(lane_end_control, "START_S", 1e9)
    patch.setattr(LaneEndControl, "_is_free", lambda *_: True)
    patch.setattr(LaneEndControl, "_can_start", mutant)


@breaks(LANE_ENDS)
def waits_forever(patch: Patch) -> None:
    """Only the first gap is asked for."""
    patch.setattr(lane_end_control, "OPEN_GAPS", 10_000)


@breaks(LANE_ENDS, LaneEndControl, "_waiting")
def last_first(waiting: Callable[..., list[object]], *given: object) -> list[object]:
    """The rearmost vehicle of a queue re-enters through the others."""
    return waiting(*given)[::-1]


@breaks(LANE_ENDS, MotionController, "leave_lattice")
def drives_on(leave_lattice: Call, self: MotionController) -> None:
    """A vehicle off the lattice aims at its cell, which is beyond the end of the lane."""
    leave_lattice(self)
    self.off_lattice, self.stop_lines.passed = OffLatticePhase.RE_ENTERING, True


@breaks(LANE_ENDS)
def line_forgotten_when_driving_out(patch: Patch) -> None:
    """The way out is blocked by the line at which the vehicle stands."""
    re_entry = MotionController.re_enter

    def mutant(
        self: MotionController, cell: Cell, passable: Iterable[int], *, keeps_distance: bool
    ) -> None:
        re_entry(self, cell, passable, keeps_distance=keeps_distance)
        self.stop_lines.passed = False

    patch.setattr(MotionController, "re_enter", mutant)
    patch.setattr("laneweave.sim_bridge.bodies.stop_lines.STANDING_MPS", -1.0)


@breaks(LANE_ENDS, EntranceRoom, "full_points")
def full_lanes_are_entered(*_: object) -> set[int]:
    """Vehicles enter a lane whose queue reaches the entrance."""
    return set()


# --- lanes that are closed for a time ---------------------------------------------------------


@breaks(OBSTACLES)
def parts_open_while_vehicles_wait(patch: Patch) -> None:
    """A part is open again as soon as its cause is over, whoever waits there."""
    patch.setattr(LaneEndControl, "in_use", frozenset())


@breaks(OBSTACLES, Obstacles, "_with_room")
def late_vehicles_have_no_room(
    _: Call, self: Obstacles, part: TemporaryClosure, vehicles: Vehicles
) -> TemporaryClosure:
    """Vehicles that cannot stop at the stop line stand in the way of those at the line."""
    del self, vehicles
    return part


@breaks(OBSTACLES, LaneEnds, "heeded")
def late_vehicles_do_not_stop(_: Call, self: LaneEnds, lane: int, s_m: float, v: float) -> object:
    """A vehicle for which the line comes too late does not stop before the part."""
    end = self.ahead(lane, s_m)
    return end if end is None or not end.sudden or s_m + v * v / 10.0 < end.stop_m else None


@breaks(OBSTACLES, motion_controller, "stop_law")
def broken_vehicles_drive_on(*_: object) -> tuple[float, float]:
    """A vehicle that has broken down does not slow down."""
    return 0.0, 0.0


@breaks(OBSTACLES, Obstacles, "in_the_way")
def parts_are_closed_around_vehicles(*_: object) -> VehiclesInPart:
    """A part is closed while vehicles are in it."""
    return VehiclesInPart((), (), ())


@breaks(OBSTACLES, LaneEndControl, "_has_passed")
def gaps_end_at_the_line(
    has_passed: Callable[..., bool], self: LaneEndControl, gap: object, _s_m: float, t_s: float
) -> bool:
    """A gap counts as passed once it has passed the stop line, not a vehicle beyond it."""
    line_m = min(end.line_m for end in self._restarts.ends.values())
    return has_passed(self, gap, line_m, t_s)


@breaks(OBSTACLES, Roadside, "_lanes_past")
def entrances_stay_open(*_: object) -> None:
    """Vehicles enter although all lanes are closed."""


@breaks(OBSTACLES, RoadVehicle, "close")
def controllers_do_not_know(*_: object) -> None:
    """Motion controllers do not learn which parts are closed."""


@breaks(OBSTACLES, StopLinesAhead, "keep_out")
def moves_into_closed_lanes_go_on(*_: object) -> bool:
    """A vehicle whose move into a lane began when it was closed heeds what stands there."""
    return False


@breaks(OBSTACLES, LaneEndControl, "_may_start_at_gap")
def gaps_only_after_the_repair(_: object, control: LaneEndControl, one: Waiting) -> bool:
    """Columns are kept free for a waiting vehicle only once the cause is over."""
    now_s = control._gap_arrives_s(one.at[0], one) - one.s_m / control._lattice.speed_mps
    return control._restarts.may_start(one, now_s)


@breaks(OBSTACLES, restarts, "re_entry_behind")
def late_vehicles_wait_for_the_repair(*_: object) -> None:
    """Vehicles between the line and a vehicle that stands wait until that is repaired."""


@breaks(OBSTACLES, restarts, "re_entry_behind")
def late_vehicles_start_as_others(
    _: object, scenario: Scenario, limits: Vehicle, _room_m: float
) -> ReEntry:
    """A vehicle that has to start slowly gets a gap as at a stop line."""
    return own_re_entry(scenario, limits)


@breaks(OBSTACLES)
def parts_are_closed_before_vehicles_that_start(patch: Patch) -> None:
    """A part is closed although a vehicle has started that heeds no closed part there."""
    patch.setattr(RoadVehicle, "re_enters", False)
    patch.setattr(RoadVehicle, "stops_m", property(_stops_m))


def _stops_m(self: RoadVehicle) -> float:
    return self.state[0] + stopping_m(self.state[1])


@breaks(OBSTACLES, LaneEnds, "enters_cleared")
def cleared_parts_are_entered(*_: object) -> bool:
    """Vehicles change lanes into a part that is cleared."""
    return False


# --- vehicles of other systems ------------------------------------------------------------------


@breaks(PASSING_VEHICLES, PassingVehicles, "_closed_around")
def closed_parts_do_not_move(
    closed_around: Callable[..., TemporaryClosure],
    self: PassingVehicles,
    one: PassingVehicle,
    *rest: object,
) -> TemporaryClosure:
    """The part that is closed around a slow vehicle stays where the vehicle has entered."""
    return one.closed or closed_around(self, one, *rest)


@breaks(PASSING_VEHICLES, PassingVehicle, "step")
def others_brake_for_nobody(
    step: Call, self: PassingVehicle, _gap_m: float, lead_mps: float, tick_s: float
) -> None:
    """A vehicle of another system does not brake for what is ahead of it."""
    step(self, math.inf, lead_mps, tick_s)


@breaks(PASSING_VEHICLES, PassingVehicles, "_has_room")
def others_enter_without_room(*_: object) -> bool:
    """A vehicle of another system enters where a vehicle is."""
    return True


@breaks(PASSING_VEHICLES, EntranceRoom, "closed_points")
def cleared_lanes_are_entered(*_: object) -> set[int]:
    """Vehicles enter a lane that is cleared, and just behind a vehicle of another system."""
    return set()


# --- ramps and exits --------------------------------------------------------------------------


@breaks(RAMPS, Roadside, "assign_empty_cells")
def ramps_are_issued_at_the_start(assign: Call, self: Roadside, vehicles: Vehicles) -> None:
    """The cells of a ramp are also assigned as they pass the start of the road."""
    assign(self, vehicles)
    for one in list(vehicles.values()):
        for lane, entry_m in enumerate(self._meter._entry_m):
            if entry_m > 0.0 and one.arrival.lane != lane:
                one.controller.store.assign_cell((one.admission.cell[0], lane))


@breaks(RAMPS, CellAllocation, "is_free")
def owned_cells_are_entered(*_: object) -> bool:
    """Vehicles enter from a ramp into cells that others may own."""
    return True


@breaks(RAMPS, Roadside, "on_left")
def cells_are_passed_on_twice(
    on_left: Call,
    self: Roadside,
    vehicle: RoadVehicle,
    vehicles: Vehicles,
    t_s: float,
    still_in: int | None = None,
) -> None:
    """Two vehicles get each cell of a vehicle that leaves."""
    on_left(self, vehicle, vehicles, t_s, still_in)
    for one in list(vehicles.values())[:1]:
        for cell in vehicle.controller.store.certain_cells:
            one.controller.store.assign_cell(cell)


@breaks(RAMPS, Exits, "left_by")
def exits_are_closed(left_by: Callable[..., object], self: Exits, lane: int, s_m: float) -> object:
    """Vehicles in the lane of an exit drive on."""
    return left_by(self, lane, s_m) if s_m >= self._length_m else None


@breaks(RAMPS, MotionController, "return_to_origin")
def late_commands_repeat_moves(back: Callable[..., bool], self: MotionController) -> bool:
    """A vehicle that holds its cell again executes a late command for the move."""
    done = back(self)
    self.stop_lines.taken_back = None
    return done


@breaks(RAMPS)
def gates_stay_open(patch: pytest.MonkeyPatch) -> None:
    """An agent waits for ever with a move that can no longer begin."""
    patch.setattr(PlanExecution, "stuck", False)


@breaks(RAMPS, AgentCore, "_has_lost_track")
def agents_insist(*_: object) -> bool:
    """An agent does not notice that its move was taken back."""
    return False


@breaks(RAMPS, VehicleTypes, "moves_of")
def types_are_ignored(*_: object) -> None:
    """Leaders move trucks like cars, and their agents take such plans."""


# --- formations -------------------------------------------------------------------------------


@breaks(FORMATIONS)
def columns_are_not_reserved(patch: Patch) -> None:
    """Vehicles enter the columns that are kept free."""
    reserve = GrowingFormations.reserve

    def growing(self: GrowingFormations, column: int, count: int, t_s: float) -> range:
        reserved = reserve(self, column, count, t_s)
        self.first_open_column = reserved[-1]
        return reserved

    def blocks(self: ColumnBlocks, column: int, count: int, _: float) -> range:
        front = self.lattice.block_range(self.lattice.block_of(column) + 1)[-1]
        return range(front - count + 1, front + 1)

    patch.setattr(GrowingFormations, "reserve", growing)
    patch.setattr(ColumnBlocks, "reserve", blocks)


@breaks(FORMATIONS)
def ramps_are_forgotten(patch: Patch) -> None:
    """Formations are closed before their columns have passed the ramp."""

    def pass_ramps(self: GrowingFormations, _: float) -> None:
        self._ramp_column = -math.inf

    def closing_s(self: ColumnBlocks, block: int) -> float:
        return self.lattice.passing_time_s(self.lattice.block_range(block)[0]) + self.spread_s

    patch.setattr(GrowingFormations, "_pass_ramps", pass_ramps)
    patch.setattr(ColumnBlocks, "_closing_s", closing_s)


@breaks(FORMATIONS, Entrances, "first_column")
def columns_ahead_are_closed(*_: object) -> int:
    """Columns that pass only the ramp, since they were ahead of the road's start, are closed."""
    return 0


ROAD_BUGS: tuple[Bug, ...] = tuple(one for one in [*vars().values()] if isinstance(one, Bug))
