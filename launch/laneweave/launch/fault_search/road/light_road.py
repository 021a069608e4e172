"""The simplified road: a bridge without SUMO that does not wait for agents.

Every vehicle gets a SENSE in each tick, COMMANDs are executed on arrival, and bodies move in
straight lines to the hold cells of their motion controllers. The real `MotionController`,
`Answers` and `Attendance` decide which process may command a vehicle, which agents are silent, and
what caretakers publish. Vehicles enter through an `Entrance`, which may be the real roadside.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from enum import Enum

from laneweave.launch.fault_search.checks.checker import Checker
from laneweave.launch.fault_search.road.drawn_entrance import Entrance
from laneweave.launch.fault_search.road.stand_ins import LightVehicle, Visit
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.road_layout import Exits
from laneweave.protocol.runtime.node import (
    Announce,
    Arrived,
    Effect,
    Event,
    Listen,
    Refuse,
    Send,
    Started,
    Wakeup,
    Watch,
)
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.vehicle.lane_ends import LaneEnds
from laneweave.protocol.wire.bounds import check_ballot
from laneweave.protocol.wire.events import DRIVES_OUT, ENTERED_LATTICE, LEFT_LATTICE, MISSED_EXIT
from laneweave.protocol.wire.messages import Command, Name, Plan, Prepare
from laneweave.protocol.wire.topics import BRIDGE_ALIVE, COMMAND, SENSE, VEHICLE_ALIVE
from laneweave.sim_bridge.road.attendance import Absence, Attendance

DRIVE_OUT_S = 8.0
"""Time in which a vehicle drives from standing into its cell."""
AGENT_START_S = 1.0
"""Time after which a caretaker takes charge of a vehicle that entered without an agent."""


class Reception(Enum):
    """What happens to a SENSE or a COMMAND."""

    LOST = "lost"
    LATE = "late"
    """Too late for its tick: what the agent asks to store is stored, its motion is refused."""
    IN_TIME = "in time"


class LightRoad:
    """Core of the road."""

    def __init__(
        self,
        scenario: Scenario,
        entrance: Entrance,
        visits: Mapping[Name, Visit],
        checker: Checker,
        new_incarnation: Callable[[], int],
        move_lasts_s: Callable[[], float],
        reception: Callable[[Name], Reception],
        *,
        bridge: int = 1,
        began_s: float = 0.0,
    ) -> None:
        """Create an empty road, on which vehicles enter later.

        Args:
            scenario: lattice and timing.
            entrance: admits vehicles, publishes clock and census.
            visits: clock errors and time of exit of each vehicle.
            checker: checker to inform about events on the road.
            new_incarnation: returns the incarnation number for a caretaker.
            move_lasts_s: draws the duration of the next motion.
            reception: draws what happens to the next SENSE or COMMAND of a vehicle, in addition
                to network loss.
            bridge: incarnation of this road's bridge.
            began_s: virtual time at road time 0.
        """
        self.tick = -1
        self.vehicles: dict[Name, LightVehicle] = {}
        self.takeovers = 0
        """Number of takeovers by caretakers."""
        self.refused = 0
        """Number of COMMANDs rejected by motion controllers."""
        self._scenario = scenario
        self._tick_s = scenario.runtime.tick_s
        self._entrance = entrance
        self._visits = visits
        self._checker = checker
        self._move_lasts_s = move_lasts_s
        self._reception = reception
        self.bridge = bridge
        self.began_s = began_s
        self._preferred_lanes: Mapping[Name, int] = {}
        """Newest preferred lanes; empty: those at the entrance."""
        self._attendance = Attendance(scenario, new_incarnation)
        self._bounds = scenario.runtime.bounds(bridge)
        self._lane_ends = LaneEnds(scenario)
        self._exits = Exits(scenario.geometry.sections, scenario.road.length_m)
        self._tick_m = 1.5 * scenario.lattice.speed_mps * self._tick_s
        """Distance beyond an exit at which a vehicle has left the road."""

    @property
    def wakeup_s(self) -> float:
        """Time of the next tick."""
        return self.began_s + (self.tick + 1) * self._tick_s

    @property
    def t_s(self) -> float:
        """Road time of the newest tick."""
        return self.tick * self._tick_s

    def handle(self, event: Event, now_s: float) -> Iterator[Effect]:
        """Handle an event; see `Core`."""
        try:
            yield from self._on_event(event, now_s)
        except BadInputError as error:
            yield Refuse(error)

    def _on_event(self, event: Event, now_s: float) -> Iterator[Effect]:
        self._attendance.on_network(event, now_s)
        match event:
            case Arrived(_, _, Command() as command):
                yield from self._on_command(command, now_s)
            case Arrived(_, parameters, (Prepare() | Plan()) as message):
                name = Name(parameters["vehicle"])
                check_ballot(message.ballot, self.t_s)
                yield from self._attendance.on_message(name, message, self.tick)
                if name in self.vehicles:
                    self._report_stored(name, now_s)
            case Wakeup() if now_s >= self.wakeup_s:
                yield from self._on_tick(now_s)
            case Started():
                yield Listen(COMMAND)
                yield Watch(VEHICLE_ALIVE)
                yield Announce(BRIDGE_ALIVE, {"incarnation": self.bridge})
            case _:
                pass

    def prefer(self, preferred_lanes: Mapping[Name, int]) -> None:
        """Change the preferred lanes of all vehicles, also of those that enter later."""
        self._preferred_lanes = preferred_lanes
        for name, vehicle in self.vehicles.items():
            vehicle.prefer(preferred_lanes[name])

    def _on_command(self, command: Command, now_s: float) -> Iterator[Effect]:
        vehicle = self.vehicles.get(command.vehicle)
        reception = self._reception(command.vehicle)
        if vehicle is None or reception is Reception.LOST or command.tick > self.tick:
            return
        controller = vehicle.controller
        held, name = controller.hold_cell, command.vehicle
        self._bounds.check(command, self.t_s, now_s)
        self._bounds.check_claim(command.record.incarnation, controller.record.incarnation, now_s)
        if self._attendance.register_command(vehicle, command):
            self._report_stored(name, now_s)
            if self._reception(name) is not Reception.LOST:
                yield self._sense_of(name, vehicle)
        if reception is Reception.LATE:
            return
        try:
            taken = yield from self._attendance.accept_command(vehicle, command)
        except BadInputError:
            taken = False
        self.refused += not taken
        self._report_stored(name, now_s)
        if controller.hold_cell != held:
            lasts_s = self._move_lasts_s()
            move = (held, controller.hold_cell)
            self._checker.begin(
                now_s, name, command.record.incarnation, move, lasts_s, vehicle.latest_s
            )
            (column, lane), (to_column, to_lane) = move
            if (to_column - column, to_lane - lane) not in vehicle.drivable:
                self._checker.undrivable(now_s, name, move)
            vehicle.body.go(controller.hold_cell, now_s - self.began_s, lasts_s)

    # --- the tick -----------------------------------------------------------------------------

    def _on_tick(self, now_s: float) -> Iterator[Effect]:
        self.tick += 1
        t_s = self.t_s
        self._checker.advance(now_s)
        self._let_enter(now_s)
        self._control_lane_ends(now_s)
        self._close_formations()
        self._entrance.assign_empty_cells(self.vehicles)
        yield from self._let_leave(now_s)
        for name, vehicle in self.vehicles.items():
            self._report_stored(name, now_s)
            vehicle.body.t_s = t_s
            self._check_lane(name, vehicle, now_s)
        yield from self._attend(now_s)
        self._attendance.start_tick(self.vehicles, now_s)
        for name, vehicle in self.vehicles.items():
            if self._reception(name) is not Reception.LOST:
                yield self._sense_of(name, vehicle)
        yield from self._attendance.states(self.tick)
        yield from self._entrance.publish(self.tick, t_s, self.vehicles.values())

    def _sense_of(self, name: Name, vehicle: LightVehicle) -> Effect:
        sense = vehicle.sense(self.tick, caretaker=name in self._attendance)
        return Send(SENSE, sense, {"vehicle": name})

    def _let_enter(self, now_s: float) -> None:
        for admission in self._entrance.admit(self.t_s):
            name = Name(admission.arrival.vehicle)
            vehicle = LightVehicle(self._visits[name], admission, self._scenario, self.bridge)
            self.vehicles[name] = vehicle
            if name in self._preferred_lanes:
                vehicle.prefer(self._preferred_lanes[name])
            self._checker.enter(now_s, name, admission.cell, vehicle.block)

    def _close_formations(self) -> None:
        for closed in self._entrance.close_formations(self.t_s):
            for vehicle in self.vehicles.values():
                if vehicle.block in closed.blocks:
                    vehicle.join(closed)

    def _control_lane_ends(self, now_s: float) -> None:
        """Let vehicles stop before the end of their lane, and come back; see `LaneEndControl`.

        For the checker, a vehicle without cells has left the road.
        """
        for change in self._entrance.control_lane_ends(self.vehicles, self.t_s):
            vehicle = self.vehicles[change.vehicle]
            self._attendance.begin_anew(vehicle, self.tick)
            cell = vehicle.controller.hold_cell
            if change.kind == MISSED_EXIT:
                self._checker.give_up_move(now_s, change.vehicle, cell)
                vehicle.body.go(cell, self.t_s, self._tick_s)
            elif change.kind == LEFT_LATTICE:
                self._checker.leave(now_s, change.vehicle)
                end = self._lane_ends.ahead(change.lane, vehicle.body.state[0])
                vehicle.body.stop_at(math.inf if end is None else end.line_m)
            elif change.kind == DRIVES_OUT:
                vehicle.body.drive_out(cell, self.t_s, DRIVE_OUT_S)
            elif change.kind == ENTERED_LATTICE:
                self._checker.enter(now_s, change.vehicle, cell, vehicle.block)

    def _check_lane(self, name: Name, vehicle: LightVehicle, now_s: float) -> None:
        """Report a body in a lane that has ended, also partly at an exit."""
        s_m, _, _, y_m, _, _ = vehicle.body.state
        touched = self._scenario.lattice.lanes_touched(y_m, self._scenario.vehicle.width_m)
        for lane in {*touched}:
            exit_lane = self._lane_ends.exit_ahead(lane, s_m)
            if exit_lane is not None and s_m > exit_lane.end_m + self._tick_m:
                self._checker.beyond_end(
                    now_s, name, f"in lanes {touched} at {s_m:.1f} m, exit at {exit_lane.end_m:g} m"
                )
        end = self._lane_ends.ahead(int(y_m // self._scenario.road.lane_width_m), s_m)
        if end is not None and s_m > end.end_m:
            self._checker.beyond_end(
                now_s, name, f"at {s_m:.1f} m, its lane ends at {end.end_m:g} m"
            )

    def _report_stored(self, name: Name, now_s: float) -> None:
        controller = self.vehicles[name].controller
        if controller.off_lattice is not None:
            return
        self._checker.store(now_s, name, controller.record)

    def _let_leave(self, now_s: float) -> Iterator[Effect]:
        leaving = [
            name
            for name, each in self.vehicles.items()
            if each.leaves_by(self.t_s)
            or self._exits.left_by(each.body_lane, each.body.state[0]) is not None
        ]
        for name in leaving:
            vehicle = self.vehicles.pop(name)
            yield from self._attendance.leave(vehicle)
            if vehicle.controller.off_lattice is None:
                self._checker.leave(now_s, name)
            self._entrance.on_left(vehicle, self.vehicles, self.t_s)
        yield from self._attendance.notify_departed(self.tick)

    def _attend(self, now_s: float) -> Iterator[Effect]:
        """Let caretakers take charge of vehicles with absent or silent agents."""
        self._attendance.answers.update_durations(now_s)
        for vehicle, absence in self._attendance.unattended(self.vehicles, now_s):
            if absence is Absence.ABSENT and self.t_s < vehicle.admission.t_s + AGENT_START_S:
                continue
            self.takeovers += 1
            yield from self._attendance.take_charge(vehicle, self.tick)
            self._report_stored(vehicle.name, now_s)
