"""The bridge's core: lockstep ticks between the simulated world and the vehicles' agents.

In each tick the roadside admits vehicles, every vehicle on the road receives a SENSE, its agent
answers with a trajectory, all bodies move by one tick, the world displays them, and gaps and
overlaps are measured. SENSE is repeated to agents that have not answered (`tick_answers`); after
the deadline their motion controllers continue their trajectories. A vehicle whose agent is absent,
silent or always late gets a caretaker (`attendance`).
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from enum import Enum
from itertools import groupby
from typing import ClassVar

import structlog
from attrs import frozen

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.road_layout import Exits
from laneweave.protocol.runtime.metrics import MetricsSnapshot, metric
from laneweave.protocol.runtime.node import (
    Announce,
    Arrived,
    Effect,
    End,
    Event,
    Listen,
    PeerUp,
    Refuse,
    Send,
    Started,
    Stopping,
    Wakeup,
    Watch,
)
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.wire.bounds import check_ballot
from laneweave.protocol.wire.events import AGENT_MISSING, AGENT_SILENT
from laneweave.protocol.wire.messages import (
    Command,
    Heartbeat,
    LogEvent,
    Name,
    Plan,
    Prepare,
    Report,
)
from laneweave.protocol.wire.topics import (
    BRIDGE_ALIVE,
    COMMAND,
    EVENT,
    HEARTBEAT,
    REPORT,
    SENSE,
    VEHICLE_ALIVE,
)
from laneweave.sim_bridge.recording.record_interface import Record
from laneweave.sim_bridge.recording.run_record import Ending
from laneweave.sim_bridge.road.attendance import Attendance, notify_left
from laneweave.sim_bridge.road.demand import Arrival
from laneweave.sim_bridge.road.demand_queue import NO_OUTSIDE_TRAFFIC, OutsideTraffic
from laneweave.sim_bridge.road.roadside import Roadside
from laneweave.sim_bridge.road.vehicle import RoadVehicle
from laneweave.sim_bridge.world_interface import World, show_bodies

log = structlog.get_logger(__name__)

BRIDGE = Name("bridge")
CATCH_UP_S = 1.0
"""Maximum delay of the road that later, shorter ticks make up for [s, on the node's clock]."""
SHUT_DOWN_S = 2.0
"""Maximum wait for final reports after a run has ended."""
REPORT_TICKS = 600
"""Number of ticks after a vehicle has left for which the final report of its agent is awaited."""


@frozen
class BridgeMetrics:
    """Counters of the road."""

    ABOUT: ClassVar[str] = "bridge"

    road_seconds: float = metric("Road time")
    ticks_total: int = metric("Completed ticks of the road")
    missed_answers_total: int = metric(
        "Answers from agents that were missing at the tick's deadline"
    )
    vehicles_demanded_total: int = metric("Vehicles that have arrived at the entrance")
    vehicles_entered_total: int = metric("Vehicles that have entered the road")
    vehicles_left_total: int = metric("Vehicles that have left the road at its end")
    vehicles_on_road: int = metric("Vehicles on the road")
    vehicles_unattended: int = metric("Vehicles on the road with a caretaker in charge")


class TickPhase(Enum):
    """State of the current tick: what the bridge is waiting for."""

    STARTING = "starting"
    AGENTS = "agents"
    """Agents of vehicles at the entrance."""
    ANSWERS = "answers"
    PACE = "pace"
    """Start time of the next tick."""
    SHUTTING_DOWN = "wind-up"
    ENDED = "ended"


class BridgeCore:
    """State machine of the bridge; a `Core`."""

    def __init__(
        self,
        scenario: Scenario,
        world: World,
        record: Record,
        stream: Sequence[Arrival],
        *,
        new_incarnation: Callable[[], int],
        pace: float | None,
        incarnation: int = 0,
        stopwatch: Callable[[], float] = time.perf_counter,
        outside_traffic: OutsideTraffic = NO_OUTSIDE_TRAFFIC,
    ) -> None:
        """Create the bridge before the first tick.

        Args:
            scenario: road, demand, vehicles.
            world: an empty world.
            record: receives the measurements.
            stream: the arrivals, by time.
            new_incarnation: returns an unused incarnation, for caretakers.
            pace: road seconds per second of the node's clock, if answers arrive in time; None: the
                scenario's `max_pace`.
            incarnation: distinguishes this road from earlier roads of the same deployment.
            stopwatch: clock [s] that measures how long ticks take.
            outside_traffic: further vehicles, which a simulator drives to entrances.
        """
        self.scenario = scenario
        self.tick = 0
        self.phase = TickPhase.STARTING
        self.vehicles: dict[Name, RoadVehicle] = {}
        self._world = world
        self._record = record
        self._roadside = Roadside(scenario, stream, incarnation, outside_traffic)
        self._exits = Exits(scenario.geometry.sections, scenario.road.length_m)
        runtime = scenario.runtime
        self._tick_duration_s = runtime.tick_s / (pace or runtime.max_pace)
        self._min_tick_duration_s = min(self._tick_duration_s, runtime.tick_s / runtime.max_pace)
        self._incarnation = incarnation
        self._stopwatch = stopwatch
        self._bounds = runtime.bounds(incarnation)
        self._attendance = Attendance(scenario, new_incarnation)
        self._answers = self._attendance.answers
        self._at_entrance: list[RoadVehicle] = []
        self._unreported: set[str] = {BRIDGE}
        """Processes whose final report is awaited."""
        self._departures: deque[tuple[int, Name]] = deque()
        """Tick and name of each vehicle that has left in the last `REPORT_TICKS`."""
        self._agent_wait_s = scenario.runtime.agent_start_s
        """Maximum wait for agents at the entrance."""
        self._ending = Ending.COMPLETE
        self._tick_began = 0.0
        self._opened_s = 0.0
        self._due_s = 0.0
        """Time at which the current tick was due."""
        self._until_s = 0.0
        """Deadline for all phases except ANSWERS."""

    # --- core interface -----------------------------------------------------------------------

    @property
    def metrics(self) -> tuple[MetricsSnapshot, ...]:
        """Counters of the bridge."""
        clock = self._roadside.publisher.clock(self.tick, self.t_s, len(self.vehicles))
        return (
            BridgeMetrics(
                road_seconds=self.t_s,
                ticks_total=self.tick,
                missed_answers_total=self._record.missed_ticks,
                vehicles_demanded_total=clock.demanded,
                vehicles_entered_total=clock.entered,
                vehicles_left_total=clock.left,
                vehicles_on_road=clock.on_road,
                vehicles_unattended=self._attendance.caretaker_count,
            ),
        )

    @property
    def t_s(self) -> float:
        """Road time."""
        return self.tick * self.scenario.runtime.tick_s

    @property
    def wakeup_s(self) -> float | None:
        """Time of the next resend, deadline or tick."""
        match self.phase:
            case TickPhase.ANSWERS:
                return min(self._answers.resend_s, self._answers.deadline_s)
            case TickPhase.AGENTS | TickPhase.PACE | TickPhase.SHUTTING_DOWN:
                return self._until_s
            case _:
                return None

    def handle(self, event: Event, now_s: float) -> list[Effect]:
        """Handle an event; see `Core`."""
        try:
            if isinstance(event, Arrived) and isinstance(event.message, Command):
                effects = self._on_command(event.message, now_s)  # most events
            else:
                effects = list(self._on_event(event, now_s))
        except BadInputError as error:
            effects = [Refuse(error)]
        if self.phase is not TickPhase.ANSWERS or self._answers.complete(now_s):
            effects += self._proceed(now_s)
        return effects

    def _on_event(self, event: Event, now_s: float) -> Iterator[Effect]:
        self._attendance.on_network(event, now_s)
        match event:
            case Started():
                for subscribed in (COMMAND, EVENT, REPORT, HEARTBEAT):
                    yield Listen(subscribed)
                yield Watch(VEHICLE_ALIVE)
                yield Announce(BRIDGE_ALIVE, {"incarnation": self._incarnation})
                self._due_s = now_s
                self._open_tick(now_s)
            case Arrived(_, parameters, message):
                yield from self._on_message(message, parameters, now_s)
            case PeerUp(topic, parameters) if topic is VEHICLE_ALIVE:
                self._agent_wait_s = self.scenario.runtime.agent_start_s
                if parameters["vehicle"] in self.vehicles:
                    self._unreported.add(parameters["vehicle"])
            case Wakeup() if self.phase is TickPhase.ANSWERS:
                for name, copies in groupby(self._answers.due_resends(now_s)):
                    sense = self._sense_of(self.vehicles[name])  # encoded once
                    yield from (sense for _ in copies)
            case Stopping():
                # While the bridge waits for final reports, the run itself has ended.
                shutting_down = self.phase is TickPhase.SHUTTING_DOWN
                self._finish(self._ending if shutting_down else Ending.INTERRUPTED)
            case _:
                pass

    def _on_message(
        self, message: object, parameters: Mapping[str, str], now_s: float
    ) -> Iterator[Effect]:
        match message:
            case Prepare() | Plan():
                vehicle = Name(parameters["vehicle"])
                check_ballot(message.ballot, self.t_s)
                yield from self._attendance.on_message(vehicle, message, self.tick)
            case Report():
                self._on_report(message)
            case LogEvent():
                self._record.on_event(message)
            case Heartbeat():
                self._bounds.check(message, self.t_s, now_s)
                self._record.on_heartbeat(message, self.t_s, now_s)
            case _:
                pass

    def _on_command(self, command: Command, now_s: float) -> list[Effect]:
        effects: list[Effect] = []
        name = command.vehicle
        vehicle = self.vehicles.get(name)
        if vehicle is None:
            return effects
        in_charge, incarnation = vehicle.controller.record.incarnation, command.record.incarnation
        self._bounds.check(command, self.t_s, now_s)
        self._bounds.check_claim(incarnation, in_charge, now_s)
        current = command.tick == self.tick and self.phase is TickPhase.ANSWERS
        if incarnation >= in_charge:
            self._answers.received(name, now_s, current=current)
        had_caretaker = name in self._attendance
        if self._attendance.register_command(vehicle, command):
            effects.append(self._sense_of(vehicle))
        if not current:
            # A late answer was computed for a past state and would lead to a wrong position.
            if command.tick < self.tick and incarnation == in_charge:
                self._answers.late(name)
            return effects
        try:
            effects += self._attendance.accept_command(vehicle, command)
        except BadInputError as error:
            log.warning("command ignored", vehicle=name, reason=str(error))
            return effects
        # Only an accepted command can change the process in charge.
        if in_charge not in (0, vehicle.controller.record.incarnation):
            previous = "caretaker" if had_caretaker else "agent"
            self._record.on_agent_took_over(self.t_s, name, previous)
        return effects

    def _on_report(self, report: Report) -> None:
        if report.role in ("agent", "bridge"):
            if report.name not in self._unreported:
                return  # from an earlier run, or a duplicate
            self._unreported.discard(report.name)
        self._record.on_report(report)

    # --- the tick -----------------------------------------------------------------------------

    def _proceed(self, now_s: float) -> Iterator[Effect]:
        """Advance through the phases, by at most one tick, until a phase has to wait."""
        if self.phase is TickPhase.PACE and now_s >= self._until_s:
            self._open_tick(now_s)
        if self.phase is TickPhase.AGENTS:
            missing = any(each.name not in self._answers.up for each in self._at_entrance)
            if not missing or now_s >= self._until_s:
                yield from self._begin_tick(now_s)
        if self.phase is TickPhase.ANSWERS and self._answers.complete(now_s):
            yield from self._end_tick(now_s)
        if self.phase is TickPhase.SHUTTING_DOWN and (
            now_s >= self._until_s or not self._unreported
        ):
            self._finish(self._ending)
            yield End()

    def _open_tick(self, now_s: float) -> None:
        """Admit vehicles at the entrance and start waiting for their agents."""
        self._opened_s = now_s
        self._tick_began = self._stopwatch()
        for arrival in self._roadside.demand.newly_demanded(self.t_s):
            self._record.on_demanded(arrival)
        for admission in self._roadside.admit(self.t_s, self.vehicles):
            self._at_entrance.append(
                RoadVehicle.entering(admission, self.t_s, self.scenario, self._incarnation)
            )
        self.phase = TickPhase.AGENTS
        self._until_s = now_s + self._agent_wait_s

    def _begin_tick(self, now_s: float) -> Iterator[Effect]:
        self._enter()
        for change in self._roadside.control_lane_ends(self.vehicles, self.t_s):
            self._attendance.begin_anew(self.vehicles[change.vehicle], self.tick)
            self._record.on_lane_end(self.t_s, change.vehicle, change.lane, change.kind)
        self._close_formations()
        self._roadside.assign_empty_cells(self.vehicles)
        yield from self._roadside.publish(self.tick, self.t_s, self.vehicles.values())
        yield from self._start_caretakers(now_s)
        for vehicle in self.vehicles.values():
            yield self._sense_of(vehicle)
        yield from self._attendance.states(self.tick)
        yield from self._attendance.notify_departed(self.tick)
        self._attendance.start_tick(self.vehicles, now_s)
        self.phase = TickPhase.ANSWERS

    def _enter(self) -> None:
        for vehicle in self._at_entrance:
            self.vehicles[vehicle.name] = vehicle
            self._world.add(vehicle.name, vehicle.state, vehicle.arrival.vehicle_type)
            self._record.on_entered(vehicle)
            if vehicle.name in self._answers.up:
                self._unreported.add(vehicle.name)
            else:
                self._record.event(self.t_s, AGENT_MISSING, vehicle=vehicle.name)
                # After a missing agent, wait only briefly for others until one appears.
                self._agent_wait_s = self.scenario.network.resend_s
        self._at_entrance.clear()

    def _close_formations(self) -> None:
        for closed in self._roadside.close_formations(self.t_s):
            blocks = closed.blocks
            members = [vehicle for vehicle in self.vehicles.values() if vehicle.block in blocks]
            for vehicle in members:
                vehicle.join(closed)
            self._record.on_closed(closed, [vehicle.name for vehicle in members])

    def _start_caretakers(self, now_s: float) -> Iterator[Effect]:
        """Put caretakers in charge of vehicles whose agents are absent, silent or always late."""
        for name in self._answers.update_durations(now_s):
            self._record.event(self.t_s, AGENT_SILENT, vehicle=name)
        for vehicle, absence in self._attendance.unattended(self.vehicles, now_s):
            self._record.on_caretaker_took_over(self.t_s, vehicle.name, absence)
            yield from self._attendance.take_charge(vehicle, self.tick)

    def _sense_of(self, vehicle: RoadVehicle) -> Effect:
        caretaker = vehicle.name in self._attendance
        sense = vehicle.sense(self.tick, caretaker=caretaker)
        return Send(SENSE, sense, {"vehicle": vehicle.name})

    def _end_tick(self, now_s: float) -> Iterator[Effect]:
        self._record.on_missed(self._answers.close())
        tick = self.tick
        for vehicle in self.vehicles.values():
            vehicle.step(tick)
        self.tick += 1
        show_bodies(self._world, self.vehicles, self.scenario, self._record, self.t_s)
        yield from self._remove_departed()
        duration_s = self._stopwatch() - self._tick_began
        self._record.on_tick(self.t_s, len(self.vehicles), duration_s)
        if self._is_over():
            yield from self._shut_down(now_s)
            return
        self._until_s = self._schedule_tick(now_s)
        self.phase = TickPhase.PACE

    def _schedule_tick(self, now_s: float) -> float:
        """Schedule the next tick, and return when it opens.

        The road keeps `pace` on average: after long ticks it is faster, up to the scenario's
        `max_pace`. On a link that loses packets, few ticks are long.
        """
        if self._answers.all_silent or not self._attendance.link_up:
            # No agent can answer: run no faster than real time during a network failure.
            self._due_s = self._opened_s + max(self._tick_duration_s, self.scenario.runtime.tick_s)
        else:
            self._due_s = max(self._due_s + self._tick_duration_s, now_s - CATCH_UP_S)
        return max(now_s, self._due_s, self._opened_s + self._min_tick_duration_s)

    def _remove_departed(self) -> Iterator[Effect]:
        for name, vehicle in list(self.vehicles.items()):
            if self._exits.left_by(vehicle.body_lane, vehicle.state[0]) is not None:
                del self.vehicles[name]
                self._world.remove(name)
                self._roadside.on_left(vehicle, self.vehicles, self.t_s)
                self._departures.append((self.tick, name))
                self._record.on_left(vehicle, self.t_s, attended=name not in self._attendance)
                yield from self._attendance.leave(vehicle)
        while self._departures and self._departures[0][0] < self.tick - REPORT_TICKS:
            # The agent was killed, or its report was lost.
            self._unreported.discard(self._departures.popleft()[1])

    def _is_over(self) -> bool:
        if self._roadside.is_over(self.t_s, self.vehicles):
            return True
        if self.t_s >= self.scenario.runtime.max_road_s:
            self._ending = Ending.LIMIT
            return True
        return False

    # --- the end ------------------------------------------------------------------------------

    def _shut_down(self, now_s: float) -> Iterator[Effect]:
        on_road = self.vehicles.values()
        yield from self._roadside.publish(self.tick, self.t_s, on_road, ended=True)
        yield from self._attendance.notify_departed(self.tick)
        for vehicle in self.vehicles.values():
            yield notify_left(vehicle, self.tick)
        # Sent last, through the network like the other reports: the node adds its counters.
        yield Send(REPORT, Report(role=BRIDGE, name=BRIDGE), {"role": BRIDGE, "name": BRIDGE})
        self.phase = TickPhase.SHUTTING_DOWN
        self._until_s = now_s + SHUT_DOWN_S

    def _finish(self, ending: Ending) -> None:
        if self.phase is not TickPhase.ENDED:
            self.phase = TickPhase.ENDED
            for arrival in self._roadside.outside.never_came if ending is Ending.COMPLETE else ():
                self._record.on_demanded(arrival)
            for vehicle in self.vehicles.values():
                self._record.on_still_on_road(vehicle)
            self._record.close(self.t_s, ending)
