"""The simplified road: a bridge without SUMO that does not wait for agents.

Every vehicle gets a SENSE in each tick, COMMANDs are executed on arrival, and bodies move in
straight lines to the hold cells of their motion controllers. The real `MotionController`,
`Answers` and `Attendance` decide which process may command a vehicle, which agents are silent, and
what caretakers publish.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

from laneweave.launch.fault_search.checker import Checker
from laneweave.launch.fault_search.stand_ins import Grant, LightVehicle, Visit
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.runtime.node import (
    Announce,
    Arrived,
    Effect,
    Event,
    Listen,
    Send,
    Started,
    Wakeup,
    Watch,
)
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.wire.messages import (
    Census,
    CensusEntry,
    ClosedFormation,
    Command,
    Name,
    Plan,
    Prepare,
    RoadClock,
)
from laneweave.protocol.wire.topics import (
    BRIDGE_ALIVE,
    CENSUS,
    CLOCK,
    COMMAND,
    SENSE,
    VEHICLE_ALIVE,
)
from laneweave.sim_bridge.road.attendance import Absence, Attendance
from laneweave.sim_bridge.road.roadside import CENSUS_EVERY_TICKS

CLOCK_EVERY_TICKS = 2
AGENT_START_S = 1.0
"""Time after which a caretaker takes charge of a vehicle that entered without an agent."""
NONE_CLOSED = -(2**31)
"""Less than all block numbers: no formation has closed."""


class LightRoad:
    """Core of the road."""

    def __init__(
        self,
        scenario: Scenario,
        visits: Iterable[Visit],
        preferred_lanes: dict[Name, int],
        checker: Checker,
        new_incarnation: Callable[[], int],
        move_lasts_s: Callable[[], float],
        lost: Callable[[], bool],
        formations: Iterable[ClosedFormation] = (),
        grants: Iterable[Grant] = (),
    ) -> None:
        """Create an empty road, on which vehicles enter later.

        Args:
            scenario: lattice and timing.
            visits: the vehicles with their times of entry and exit.
            preferred_lanes: preferred lane of each vehicle at its entry.
            checker: checker to inform about events on the road.
            new_incarnation: returns the incarnation number for a caretaker.
            move_lasts_s: draws the duration of the next motion.
            lost: draws whether the next SENSE or COMMAND is lost, in addition to network loss.
            formations: the formations with their blocks and closing times.
            grants: assignments of the empty cells to owners.
        """
        self.tick = -1
        self.vehicles: dict[Name, LightVehicle] = {}
        self.takeovers = 0
        """Number of takeovers by caretakers."""
        self.refused = 0
        """Number of COMMANDs rejected by motion controllers."""
        self._scenario = scenario
        self._tick_s = scenario.runtime.tick_s
        self._visits = sorted(visits, key=lambda visit: (visit.enters_s, visit.vehicle))
        self._grants = sorted(grants, key=lambda grant: (grant.t_s, grant.cell))
        self._open = sorted(formations, key=lambda closed: closed.first_block)
        self._closed: list[ClosedFormation] = []
        self._closed_to = NONE_CLOSED
        self._preferred_lanes = preferred_lanes
        self._checker = checker
        self._move_lasts_s = move_lasts_s
        self._lost = lost
        self._attendance = Attendance(scenario, new_incarnation)
        self._census_due_tick = 0

    @property
    def wakeup_s(self) -> float:
        """Time of the next tick."""
        return (self.tick + 1) * self._tick_s

    def handle(self, event: Event, now_s: float) -> Iterator[Effect]:
        """Handle an event; see `Core`."""
        self._attendance.on_network(event, now_s)
        match event:
            case Arrived(_, _, Command() as command):
                yield from self._on_command(command, now_s)
            case Arrived(_, parameters, (Prepare() | Plan()) as message):
                name = Name(parameters["vehicle"])
                yield from self._attendance.on_message(name, message, self.tick)
                if name in self.vehicles:
                    self._report_ownership(name, now_s)
            case Wakeup() if now_s >= self.wakeup_s:
                yield from self._on_tick(now_s)
            case Started():
                yield Listen(COMMAND)
                yield Watch(VEHICLE_ALIVE)
                yield Announce(BRIDGE_ALIVE, {"incarnation": 1})
            case _:
                pass

    def prefer(self, preferred_lanes: dict[Name, int]) -> None:
        """Change the preferred lanes of all vehicles."""
        self._preferred_lanes = preferred_lanes
        for vehicle in self.vehicles.values():
            vehicle.prefer(preferred_lanes[vehicle.name])
        self._census_due_tick = 0

    def _on_command(self, command: Command, now_s: float) -> Iterator[Effect]:
        vehicle = self.vehicles.get(command.vehicle)
        if vehicle is None or self._lost():
            return
        controller = vehicle.controller
        held = controller.hold_cell
        if self._attendance.register_command(vehicle, command) and not self._lost():
            yield self._sense_of(command.vehicle, vehicle)
        try:
            taken = yield from self._attendance.accept_command(vehicle, command)
        except BadInputError:
            taken = False
        self.refused += not taken
        self._report_ownership(command.vehicle, now_s)
        if controller.hold_cell != held:
            lasts_s = self._move_lasts_s()
            move = (held, controller.hold_cell)
            self._checker.begin(now_s, command.vehicle, command.incarnation, move, lasts_s)
            vehicle.body.go(controller.hold_cell, now_s, lasts_s)

    # --- the tick -----------------------------------------------------------------------------

    def _on_tick(self, now_s: float) -> Iterator[Effect]:
        self.tick += 1
        t_s = self.tick * self._tick_s
        self._checker.advance(now_s)
        self._let_enter(now_s)
        self._close_formations(t_s)
        self._grant_cells(now_s)
        yield from self._let_leave(now_s)
        for vehicle in self.vehicles.values():
            vehicle.body.t_s = t_s
        yield from self._attend(now_s)
        self._attendance.start_tick(self.vehicles, now_s)
        for name, vehicle in self.vehicles.items():
            if not self._lost():
                yield self._sense_of(name, vehicle)
        yield from self._attendance.states(self.tick)
        yield from self._publish_road(t_s)

    def _sense_of(self, name: Name, vehicle: LightVehicle) -> Effect:
        sense = vehicle.sense(self.tick, caretaker=name in self._attendance)
        return Send(SENSE, sense, {"vehicle": name})

    def _let_enter(self, now_s: float) -> None:
        while self._visits and self._visits[0].enters_s <= now_s + 1e-6:
            visit = self._visits.pop(0)
            lane = self._preferred_lanes[visit.vehicle]
            self.vehicles[visit.vehicle] = LightVehicle(visit, lane, self._scenario)
            self._checker.enter(now_s, visit.vehicle, visit.cell)
            self._report_ownership(visit.vehicle, now_s)
            self._census_due_tick = 0

    def _close_formations(self, t_s: float) -> None:
        while self._open and self._open[0].closed_s <= t_s + 1e-6:
            closed = self._open.pop(0)
            self._closed.append(closed)
            self._closed_to = closed.last_block
            for vehicle in self.vehicles.values():
                if vehicle.block in closed.blocks:
                    vehicle.join(closed)
            self._census_due_tick = 0

    def _grant_cells(self, now_s: float) -> None:
        while self._grants and self._grants[0].t_s <= now_s + 1e-6:
            grant = self._grants.pop(0)
            owner = self.vehicles.get(grant.owner)
            if owner is not None:
                owner.controller.assign_cell(grant.cell)
                self._report_ownership(grant.owner, now_s)

    def _report_ownership(self, name: Name, now_s: float) -> None:
        controller = self.vehicles[name].controller
        self._checker.own(now_s, name, controller.owned, controller.transfer)

    def _let_leave(self, now_s: float) -> Iterator[Effect]:
        length_m = self._scenario.road.length_m
        leaving = [
            name
            for name, each in self.vehicles.items()
            if each.leaves_by(now_s) or each.body.state[0] > length_m
        ]
        for name in leaving:
            yield from self._attendance.leave(self.vehicles.pop(name))
            self._checker.leave(now_s, name)
            self._census_due_tick = 0
        yield from self._attendance.notify_departed(self.tick)

    def _attend(self, now_s: float) -> Iterator[Effect]:
        """Let caretakers take charge of vehicles with absent or silent agents."""
        self._attendance.answers.update_durations(now_s)
        for vehicle, absence in self._attendance.unattended(self.vehicles, now_s):
            if absence is Absence.ABSENT and now_s < vehicle.admission.t_s + AGENT_START_S:
                continue
            self.takeovers += 1
            yield from self._attendance.take_charge(vehicle, self.tick)

    def _publish_road(self, t_s: float) -> Iterator[Effect]:
        count = len(self.vehicles)
        if self.tick % CLOCK_EVERY_TICKS == 0:
            yield Send(CLOCK, RoadClock(self.tick, t_s, count, count, count, 0, ended=False))
        if self.tick >= self._census_due_tick:
            self._census_due_tick = self.tick + CENSUS_EVERY_TICKS
            entries = tuple(
                CensusEntry(name, each.admission.cell, each.preferred_lane, each.admission.t_s)
                for name, each in self.vehicles.items()
            )
            on_road = {each.formation for each in self.vehicles.values()}
            formations = tuple(one for one in self._closed if one.first_block in on_road)
            yield Send(CENSUS, Census(t_s, entries, (), formations, self._closed_to))
