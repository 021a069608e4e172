"""The simulated road: its vehicles, and what happens to them in a tick.

When a tick begins, vehicles enter, lane ends and formations are handled, caretakers take charge of
vehicles without agents, and every vehicle gets a SENSE. COMMANDs arrive; then all bodies move by
one tick, and those that have passed an exit leave. When ticks begin and end, and which COMMANDs are
in time, is decided elsewhere: `core.BridgeCore` waits for the agents, the fault search
(`launch.fault_search`) for nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Generic, TypeVar

import structlog

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.road_layout import Exits
from laneweave.protocol.runtime.node import (
    Announce,
    Effect,
    Event,
    Listen,
    PeerDown,
    PeerUp,
    Watch,
)
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.wire.bounds import check_ballot
from laneweave.protocol.wire.events import AGENT_SILENT
from laneweave.protocol.wire.messages import Command, Name, Plan, Prepare
from laneweave.protocol.wire.topics import BRIDGE_ALIVE, COMMAND, VEHICLE_ALIVE
from laneweave.sim_bridge.recording.record_interface import RoadRecord
from laneweave.sim_bridge.road.caretakers import Caretakers
from laneweave.sim_bridge.road.entry import Admission
from laneweave.sim_bridge.road.occupied_cells import OccupiedCells
from laneweave.sim_bridge.road.roadside import Roadside
from laneweave.sim_bridge.road.sender_density import measure_density
from laneweave.sim_bridge.road.tick_answers import Answers
from laneweave.sim_bridge.road.vehicle import RoadVehicle

log = structlog.get_logger(__name__)

VehicleT = TypeVar("VehicleT", bound=RoadVehicle)


class SimulatedRoad(Generic[VehicleT]):
    """Vehicles on a road, with their agents and caretakers."""

    def __init__(
        self,
        scenario: Scenario,
        roadside: Roadside,
        record: RoadRecord,
        new_incarnation: Callable[[], int],
        new_vehicle: Callable[[Admission, float, Scenario, int], VehicleT],
        incarnation: int = 0,
        *,
        checks_occupancy: bool = True,
    ) -> None:
        """Begin with an empty road before the first tick.

        Args:
            scenario: road, vehicles, timing.
            roadside: lets vehicles enter.
            record: receives what happens.
            new_incarnation: returns an unused incarnation, for caretakers.
            new_vehicle: makes the vehicles; arguments as those of `RoadVehicle.entering`.
            incarnation: distinguishes this road from earlier roads of the same deployment.
            checks_occupancy: whether motion controllers refuse moves into cells of other vehicles.
                The fault search tests that plans never lead there.
        """
        self.scenario = scenario
        self.tick = 0
        self.vehicles: dict[Name, VehicleT] = {}
        self.at_entrance: list[VehicleT] = []
        """Vehicles that enter when the next tick begins."""
        self.incarnation = incarnation
        self.caretakers = Caretakers(scenario, new_incarnation)
        self.bounds = scenario.runtime.bounds(incarnation)
        """Bounds of received numbers."""
        self._occupied_cells = (
            OccupiedCells(self.vehicles, roadside.is_kept_free) if checks_occupancy else None
        )
        self._roadside = roadside
        self._record = record
        self._new_vehicle = new_vehicle
        self._exits = Exits(scenario.geometry.sections, scenario.road.length_m)

    @property
    def t_s(self) -> float:
        """Road time."""
        return self.tick * self.scenario.runtime.tick_s

    @property
    def answers(self) -> Answers:
        """Answers of the agents."""
        return self.caretakers.answers

    # --- messages -----------------------------------------------------------------------------

    def connect(self) -> Iterator[Effect]:
        """Listen to COMMANDs, watch the agents, and announce the road."""
        yield Listen(COMMAND)
        yield Watch(VEHICLE_ALIVE)
        yield Announce(BRIDGE_ALIVE, {"incarnation": self.incarnation})

    def on_network(self, event: Event, now_s: float) -> None:
        """Handle agents' tokens and the state of the bridge's connection; ignore other events."""
        self.caretakers.on_network(event, now_s)
        if isinstance(event, (PeerUp, PeerDown)) and event.topic is VEHICLE_ALIVE:
            vehicle = self.vehicles.get(Name(event.parameters["vehicle"]))
            if vehicle is not None:
                if self.caretakers.update_processes(vehicle):
                    self._roadside.publisher.on_changed()
                vehicle.sense_rate.disturb()

    def on_ballot(self, vehicle: Name, message: Prepare | Plan) -> Iterator[Effect]:
        """Pass a message of a leader to the vehicle's caretaker."""
        check_ballot(message.ballot, self.t_s)
        yield from self.caretakers.on_message(vehicle, message, self.tick)

    def on_command(self, command: Command, now_s: float, *, in_time: bool) -> list[Effect]:
        """Store what a COMMAND requests, and execute its motion if it has arrived in time.

        Raises:
            BadInputError: a number is out of bounds.
        """
        effects: list[Effect] = []
        name = command.vehicle
        vehicle = self.vehicles.get(name)
        if vehicle is None:
            return effects
        in_charge, incarnation = vehicle.controller.record.incarnation, command.record.incarnation
        self.bounds.check(command, self.t_s, now_s)
        self.bounds.check_claim(incarnation, in_charge, now_s)
        if incarnation >= in_charge:
            self.answers.received(name, now_s, current=in_time)
        had_caretaker = name in self.caretakers
        if self.caretakers.register_command(vehicle, command):
            effects += self.sense_of(vehicle)
        if not command.undisturbed_ticks:
            vehicle.sense_rate.disturb()
        if not in_time:
            if command.tick < self.tick and incarnation == in_charge:
                self.answers.late(name)
            return effects
        try:
            effects += self._accept(vehicle, command)
        except BadInputError as error:
            log.warning("command ignored", vehicle=name, reason=str(error))
            return effects
        finally:
            self._record_refusal(vehicle)
        # Only an accepted command can change the process in charge.
        if in_charge not in (0, vehicle.controller.record.incarnation):
            previous = "caretaker" if had_caretaker else "agent"
            self._record.on_agent_took_over(self.t_s, name, previous)
        return effects

    def _accept(self, vehicle: VehicleT, command: Command) -> Iterator[Effect]:
        in_charge = vehicle.controller.record.incarnation
        accepted = yield from self.caretakers.accept_command(vehicle, command)
        claimed = vehicle.controller.record.incarnation != in_charge
        if accepted and command.undisturbed_ticks and not claimed:
            vehicle.hold(command)

    def disturb(self) -> Iterator[Effect]:
        """Send SENSE to the vehicles that hold undisturbed, since a leader waits for states."""
        for vehicle in self.vehicles.values():
            if not vehicle.sense_rate.full:
                vehicle.sense_rate.disturb()
                yield from self.sense_of(vehicle)

    def sense_of(self, vehicle: RoadVehicle) -> list[Effect]:
        """Return the effects that send a vehicle's SENSE of the current tick to its processes."""
        return vehicle.send_sense(self.tick, caretaker=vehicle.name in self.caretakers)

    # --- the tick -----------------------------------------------------------------------------

    def admit(self) -> None:
        """Admit vehicles, which wait at the entrance until the tick begins."""
        for arrival in self._roadside.demand.newly_demanded(self.t_s):
            self._record.on_demanded(arrival)
        for admission in self._roadside.admit(self.t_s, self.vehicles):
            self.at_entrance.append(
                self._new_vehicle(admission, self.t_s, self.scenario, self.incarnation)
            )

    def enter(self) -> Sequence[VehicleT]:
        """Let the vehicles at the entrance enter, and return them."""
        entered, self.at_entrance = self.at_entrance, []
        for vehicle in entered:
            vehicle.controller.occupancy = self._occupied_cells
            self.caretakers.update_processes(vehicle)
            vehicle.close(self._roadside.lane_ends, self.t_s)
            self.vehicles[vehicle.name] = vehicle
            self._record.on_entered(vehicle)
        return entered

    def begin_tick(self, now_s: float) -> Iterator[Effect]:
        """Begin a tick, after vehicles have entered."""
        changes = self._roadside.control_lane_ends(self.vehicles, self.t_s)
        for kind, obstacle in self._roadside.pop_obstacle_changes():
            self._record.on_obstacle(self.t_s, kind, obstacle)
        for change in changes:
            self.caretakers.begin_anew(self.vehicles[change.vehicle], self.tick)
            s_m = self.vehicles[change.vehicle].state[0]
            self._record.on_lane_end(self.t_s, change.vehicle, change.lane, change.kind, s_m)
        self._close_formations()
        self._roadside.assign_empty_cells(self.vehicles)
        yield from self._roadside.publish(self.tick, self.t_s, self.vehicles.values())
        yield from self._start_caretakers(now_s)
        if self.scenario.radio.enabled:
            measure_density(self.vehicles.values(), self.scenario.road.length_m)
        sensed = list[Name]()
        for vehicle in self.vehicles.values():
            vehicle.controller.end_move(self.t_s)
            if vehicle.needs_sense(self.tick):
                sensed.append(vehicle.name)
                yield from self.sense_of(vehicle)
        yield from self.caretakers.states(self.tick)
        yield from self.caretakers.notify_departed(self.tick)
        all_sensed = len(sensed) == len(self.vehicles)
        link_up = self.caretakers.link_up
        self.answers.start_tick(sensed, now_s, link_up=link_up, all_sensed=all_sensed)

    def _close_formations(self) -> None:
        for closed in self._roadside.close_formations(self.t_s):
            blocks = closed.blocks
            members = [vehicle for vehicle in self.vehicles.values() if vehicle.block in blocks]
            for vehicle in members:
                vehicle.join(closed)
            self._record.on_closed(closed, [vehicle.name for vehicle in members])

    def _start_caretakers(self, now_s: float) -> Iterator[Effect]:
        """Put caretakers in charge of vehicles whose agents are absent, silent or always late."""
        for name in self.answers.update_durations(now_s):
            self._record.event(self.t_s, AGENT_SILENT, vehicle=name)
        for vehicle, absence in self.caretakers.unattended(self.vehicles, now_s):
            self._record.on_caretaker_took_over(self.t_s, vehicle.name, absence)
            yield from self.caretakers.take_charge(vehicle, self.tick)

    def step(self) -> None:
        """End the tick: move all bodies."""
        tick = self.tick
        for vehicle in self.vehicles.values():
            vehicle.step(tick)
            if vehicle.controller.refusal is not None:
                self._record_refusal(vehicle)
        self._roadside.obstacles.step(self.vehicles.values(), self.t_s)
        self.tick += 1

    def _record_refusal(self, vehicle: RoadVehicle) -> None:
        """Record what a motion controller has refused, if anything."""
        refusal, vehicle.controller.refusal = vehicle.controller.refusal, None
        if refusal is not None:
            self._record.on_refused(self.t_s, vehicle.name, refusal)

    def departed(self) -> list[VehicleT]:
        """Return the vehicles that have left and have not been removed yet.

        They have passed an exit, or a simulator has taken them back before it.
        """
        left, on_road = list[VehicleT](), list[VehicleT]()
        for vehicle in self.vehicles.values():
            (left if self._has_passed_exit(vehicle) else on_road).append(vehicle)
        return [*left, *self._roadside.outside.given_back(on_road)]

    def _has_passed_exit(self, vehicle: VehicleT) -> bool:
        return self._exits.left_by(vehicle.body_lane, vehicle.state[0]) is not None

    def remove(self, vehicle: VehicleT) -> Iterator[Effect]:
        """Remove a vehicle that has left the road."""
        attended = vehicle.name not in self.caretakers
        self._record.on_left(vehicle, self.t_s, attended=attended)
        del self.vehicles[vehicle.name]
        still_in = None if self._has_passed_exit(vehicle) else vehicle.body_lane
        self._roadside.on_left(vehicle, self.vehicles, self.t_s, still_in)
        yield from self.caretakers.leave(vehicle)
