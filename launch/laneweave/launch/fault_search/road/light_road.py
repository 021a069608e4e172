"""The road of the fault search: the bridge's simulated road with light vehicles, at a fixed rate.

`LightRoad` waits for no agent, unlike the bridge: a tick begins every `tick_s`, and COMMANDs are
executed when they arrive, also those for earlier ticks. It tells the checker what happens, and
moves bodies accordingly.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from enum import Enum

from laneweave.launch.fault_search.checks.checker import Checker
from laneweave.launch.fault_search.road.light_vehicle import LightVehicle, Visit
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.lattice import Cell
from laneweave.protocol.road_layout import LanePosition
from laneweave.protocol.runtime.node import Arrived, Effect, Event, Refuse, Send, Started, Wakeup
from laneweave.protocol.runtime.transport import LinkUp
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.vehicle.lane_ends import LaneEnds
from laneweave.protocol.vehicle.sudden_stops import stopping_m
from laneweave.protocol.wire.events import (
    DRIVES_OUT,
    ENTERED_LATTICE,
    LEFT_LATTICE,
    MISSED_EXIT,
    MOVE_TAKEN_BACK,
)
from laneweave.protocol.wire.messages import ClosedFormation, Command, Name, Plan, Prepare, Sense
from laneweave.protocol.wire.obstacle_messages import Obstacle
from laneweave.sim_bridge.bodies.command_checks import Refusal
from laneweave.sim_bridge.recording.run_record import RecordedVehicle
from laneweave.sim_bridge.road.demand import Arrival
from laneweave.sim_bridge.road.entry import Admission
from laneweave.sim_bridge.road.passing_vehicles import PREDICTED_M, gap_needed_m
from laneweave.sim_bridge.road.roadside import Roadside
from laneweave.sim_bridge.simulated_road import SimulatedRoad

RE_ENTRY_S = 8.0
"""Time in which a vehicle drives from standing into its cell."""

TOUCH_M = 0.1
"""How far a body may reach into a closed part."""


class Reception(Enum):
    """What happens to a SENSE or a COMMAND."""

    LOST = "lost"
    LATE = "late"
    """Too late for its tick: what the agent asks to store is stored, its motion is refused."""
    IN_TIME = "in time"


class LightRoad:
    """Core of the road; it implements `RoadRecord`, too.

    For the checker, a vehicle without cells has left the road.
    """

    def __init__(
        self,
        scenario: Scenario,
        roadside: Roadside,
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
            roadside: admits vehicles, publishes clock and census.
            visits: clock errors and time of exit of each vehicle.
            checker: checker to inform about events on the road.
            new_incarnation: returns the incarnation number for a caretaker.
            move_lasts_s: draws the duration of the next motion.
            reception: draws what happens to the next SENSE or COMMAND of a vehicle, in addition
                to network loss.
            bridge: incarnation of this road's bridge.
            began_s: virtual time at road time 0.
        """
        self.began_s = began_s
        self.takeovers = 0
        """Number of takeovers by caretakers."""
        self._road = SimulatedRoad(
            scenario,
            roadside,
            self,
            new_incarnation,
            self._new_vehicle,
            bridge,
            checks_occupancy=False,
        )
        self.vehicles = self._road.vehicles
        self._scenario = scenario
        self._checker = checker
        self._roadside = roadside
        self._inside: dict[LanePosition, set[Name]] = {}
        """Vehicles that were in each part when it was closed."""
        self._visits = visits
        self._move_lasts_s = move_lasts_s
        self._reception = reception
        self._preferred_lanes: Mapping[Name, int] = {}
        """Newest preferred lanes; empty: those at the entrance."""

    @property
    def tick(self) -> int:
        """Number of completed ticks."""
        return self._road.tick

    @property
    def t_s(self) -> float:
        """Road time of the newest tick."""
        return self._road.t_s

    @property
    def wakeup_s(self) -> float:
        """Time of the next tick."""
        return self.began_s + (self.tick + 1) * self._scenario.runtime.tick_s

    def prefer(self, preferred_lanes: Mapping[Name, int]) -> None:
        """Change the preferred lanes of all vehicles, also of those that enter later."""
        self._preferred_lanes = preferred_lanes
        for name, vehicle in self.vehicles.items():
            vehicle.prefer(preferred_lanes[name])

    def _new_vehicle(
        self, admission: Admission, t_s: float, scenario: Scenario, bridge: int
    ) -> LightVehicle:
        name = Name(admission.arrival.vehicle)
        vehicle = LightVehicle.visiting(self._visits[name], admission, t_s, scenario, bridge)
        if name in self._preferred_lanes:
            vehicle.prefer(self._preferred_lanes[name])
        return vehicle

    def handle(self, event: Event, now_s: float) -> Iterator[Effect]:
        """Handle an event; see `Core`."""
        try:
            for effect in self._on_event(event, now_s):
                if not (isinstance(effect, Send) and self._loses(effect)):
                    yield effect
        except BadInputError as error:
            yield Refuse(error)

    def _loses(self, effect: Send) -> bool:
        message = effect.message
        return isinstance(message, Sense) and self._reception(message.vehicle) is Reception.LOST

    def _on_event(self, event: Event, now_s: float) -> Iterator[Effect]:
        road = self._road
        road.on_network(event, now_s)
        match event:
            case Arrived(_, _, Command() as command):
                yield from self._on_command(command, now_s)
            case Arrived(_, parameters, (Prepare() | Plan()) as message):
                name = Name(parameters["vehicle"])
                yield from road.on_ballot(name, message)
                if name in self.vehicles:
                    self._report_stored(now_s, self.vehicles[name])
            case Wakeup() if now_s >= self.wakeup_s:
                yield from self._end_tick()
                yield from self._begin_tick(now_s)
            case Started():
                # The agents start at the same time.
                road.on_network(LinkUp(), now_s)
                yield from road.connect()
                yield from self._begin_tick(now_s)
            case _:
                pass

    def _on_command(self, command: Command, now_s: float) -> Iterator[Effect]:
        vehicle = self.vehicles.get(command.vehicle)
        reception = self._reception(command.vehicle)
        if vehicle is None or reception is Reception.LOST or command.tick > self.tick:
            return
        held = vehicle.cell
        in_time = reception is Reception.IN_TIME
        yield from self._road.on_command(command, now_s, in_time=in_time)
        self._report_stored(now_s, vehicle)
        if vehicle.cell != held:
            self._begin_move(vehicle, held, now_s, self._move_lasts_s())

    def _begin_tick(self, now_s: float) -> Iterator[Effect]:
        self._checker.advance(now_s)
        self._road.admit()
        self._road.enter()
        yield from self._road.begin_tick(now_s)
        self._check_lanes(now_s)
        self._check_parts(now_s)
        for vehicle in self.vehicles.values():
            self._report_stored(now_s, vehicle)

    def _end_tick(self) -> Iterator[Effect]:
        self._road.step()
        for vehicle in self._road.departed():
            yield from self._road.remove(vehicle)

    # --- what happens on the road -------------------------------------------------------------

    def event(self, t_s: float, kind: str, /, **data: object) -> None:
        """Do nothing."""

    def on_demanded(self, arrival: Arrival) -> None:
        """Do nothing."""

    def on_closed(self, closed: ClosedFormation, members: Sequence[Name]) -> None:
        """Do nothing."""

    def on_agent_took_over(self, t_s: float, vehicle: Name, previous: str) -> None:
        """Do nothing."""

    def on_caretaker_took_over(self, t_s: float, vehicle: Name, reason: str) -> None:
        """Count a takeover."""
        del t_s, vehicle, reason
        self.takeovers += 1

    def on_entered(self, vehicle: RecordedVehicle) -> None:
        """Let a vehicle enter."""
        one = self.vehicles[Name(vehicle.name)]
        self._checker.enter(self.began_s + one.body.t_s, one.name, one.cell, one.block)

    def on_left(self, vehicle: RecordedVehicle, t_s: float, *, attended: bool) -> None:
        """Let a vehicle leave the road."""
        del attended
        if self.vehicles[Name(vehicle.name)].has_cell:
            self._checker.leave(self.began_s + t_s, vehicle.name)

    def on_refused(self, t_s: float, vehicle: Name, refusal: Refusal) -> None:
        """Report a refused command, which is a violation: all agents are correct here."""
        self._checker.refused(self.began_s + t_s, vehicle, refusal.problem.value)

    def on_obstacle(self, t_s: float, kind: str, obstacle: Obstacle) -> None:
        """Do nothing."""

    def on_lane_end(self, t_s: float, vehicle: Name, lane: int, kind: str, s_m: float) -> None:
        """Let a body stop before the end of its lane, and come back; see `LaneEndControl`."""
        del s_m
        one, now_s = self.vehicles[vehicle], self.began_s + t_s
        body, cell = one.body, one.cell
        if kind in {MISSED_EXIT, MOVE_TAKEN_BACK}:
            self._checker.give_up_move(now_s, vehicle, cell)
            body.go(cell, t_s, self._scenario.runtime.tick_s)
        elif kind == LEFT_LATTICE:
            self._checker.leave(now_s, vehicle)
            body.stop_at(self._stops_m(one, lane))
        elif kind == DRIVES_OUT:
            body.re_enter(cell, t_s, RE_ENTRY_S)
        elif kind == ENTERED_LATTICE:
            self._checker.enter(now_s, vehicle, cell, one.block)

    def _begin_move(self, vehicle: LightVehicle, held: Cell, now_s: float, lasts_s: float) -> None:
        """Begin the motion from the cell that a vehicle held to the cell that it holds now."""
        name, cell, in_charge = vehicle.name, vehicle.cell, vehicle.controller.record.incarnation
        move = (held, cell)
        self._checker.begin(now_s, name, in_charge, move, lasts_s, vehicle.latest_s)
        along, across = cell[0] - held[0], cell[1] - held[1]
        if (along, across) not in self._scenario.types[vehicle.arrival.vehicle_type].moves:
            self._checker.undrivable(now_s, name, move)
        if across:
            self._check_change(vehicle, held, now_s)
        vehicle.body.go(cell, now_s - self.began_s, lasts_s)

    def _report_stored(self, now_s: float, vehicle: LightVehicle) -> None:
        """Report the record of a vehicle on the lattice."""
        if vehicle.has_cell:
            self._checker.store(now_s, vehicle.name, vehicle.controller.record)

    @property
    def _lane_ends(self) -> LaneEnds:
        """Ends of lanes now."""
        return self._roadside.lane_ends

    def _stops_m(self, vehicle: LightVehicle, lane: int) -> float:
        """Return where a body stops that has no cell any more: light bodies stop at once."""
        s_m = vehicle.body.state[0]
        end = self._lane_ends.ahead(lane, s_m)
        if vehicle.controller.broken_mps2 is not None:
            return s_m
        if end is None:
            return math.inf
        # Before a part that is closed suddenly, the line may have come too late.
        return max(end.line_m, s_m) if end.sudden else end.line_m

    def _check_parts(self, now_s: float) -> None:
        """Report vehicles with cells in closed parts, or beside a vehicle of another system."""
        obstacles = self._roadside.obstacles
        on_lattice = [vehicle for vehicle in self.vehicles.values() if vehicle.has_cell]
        for one in obstacles.active:
            if one.is_over(self.t_s):
                continue  # those that have waited start there
            lane, from_m, to_m, _ = one.part
            # In the short slots of the fault search, a body that falls back a column moves
            # backwards on the road, perhaps past all of a short part.
            back_m = to_m - self._scenario.lattice.pitch_m
            to_m = max(back_m, from_m + TOUCH_M)
            inside = {
                vehicle.name
                for vehicle in on_lattice
                if lane in vehicle.lanes_used
                and _is_beside(vehicle, from_m, back_m if vehicle.body.falls_back else to_m)
            }
            # Those that were inside when the part was closed drive out of it.
            known = self._inside.setdefault(
                one.begins_at, inside | self._without_room(one.part.from_m)
            )
            for name in sorted(inside - known):
                if lane in self.vehicles[name].lanes_touched:
                    text = f"in lane {lane}, which is closed from {from_m:g} to {to_m:g} m"
                    self._checker.beyond_end(now_s, name, text)

    def _check_change(self, vehicle: LightVehicle, held: Cell, now_s: float) -> None:
        """Report a lane change that begins beside a fast vehicle of another system, or before it.

        Sensors do not look back, and the fast one would have to brake.
        """
        lattice = self._scenario.lattice
        lane, t_s = vehicle.cell[1], now_s - self.began_s
        for other in self._roadside.obstacles.passing.on_road:
            if other.passage.lane != lane or other.speed_mps < lattice.speed_mps:
                continue
            ahead_m = lattice.cell_s_m(max(held[0], vehicle.cell[0]), t_s) - other.rear_m
            needed_m = gap_needed_m(other.speed_mps, lattice.speed_mps) - 2.0 * PREDICTED_M
            if 0.0 < ahead_m < other.length_m + vehicle.size[0] + needed_m:
                text = f"changes to lane {lane} {ahead_m:.1f} m before the rear of {other.name}"
                self._checker.beyond_end(now_s, vehicle.name, text)

    def _without_room(self, from_m: float) -> set[Name]:
        """Return the vehicles that would brake for what they sense, unlike light bodies.

        They have no cells, or could not stop before a part that begins there.
        """
        return {
            vehicle.name
            for vehicle in self.vehicles.values()
            if not vehicle.has_cell
            or from_m - 2.0 * stopping_m(self._scenario.lattice.speed_mps) < vehicle.state[0]
        }

    def _check_lanes(self, now_s: float) -> None:
        """Report bodies behind the end of their lane, or partly behind an exit."""
        tick_m = 1.5 * self._scenario.lattice.speed_mps * self._scenario.runtime.tick_s
        for name, vehicle in self.vehicles.items():
            s_m, _, _, y_m, _, _ = vehicle.state
            touched = self._scenario.lattice.lanes_touched(y_m, vehicle.size[1])
            for lane in {*touched}:
                exit_lane = self._lane_ends.exit_ahead(lane, s_m)
                if exit_lane is not None and s_m > exit_lane.end_m + tick_m:
                    text = f"in lanes {touched} at {s_m:.1f} m, exit at {exit_lane.end_m:g} m"
                    self._checker.beyond_end(now_s, name, text)
            end = self._lane_ends.ahead(vehicle.body_lane, s_m)
            if end is not None and not end.sudden and s_m > end.end_m:
                text = f"at {s_m:.1f} m, its lane ends at {end.end_m:g} m"
                self._checker.beyond_end(now_s, name, text)


def _is_beside(vehicle: LightVehicle, from_m: float, to_m: float) -> bool:
    """Return whether a body is between two positions, or partly."""
    s_m = vehicle.state[0]
    return s_m > from_m and s_m - vehicle.size[0] < to_m
