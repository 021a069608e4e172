"""The bridge's core: lockstep ticks between the simulated world and the vehicles' agents.

In each tick (`simulated_road`) vehicles enter, every vehicle on the road receives a SENSE, its
agent answers with a trajectory, all bodies move by one tick, the world displays them, and gaps and
overlaps are measured. SENSE is repeated to agents that have not answered (`tick_answers`); after
the deadline their motion controllers continue their trajectories. A vehicle whose agent is absent,
silent or always late gets a caretaker (`caretakers`).
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from enum import Enum
from itertools import groupby
from typing import ClassVar

from attrs import frozen

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.runtime.metrics import MetricsSnapshot, metric
from laneweave.protocol.runtime.node import (
    Arrived,
    Effect,
    End,
    Event,
    Listen,
    PeerUp,
    QueryArrived,
    Refuse,
    Send,
    Serve,
    Started,
    Stopping,
    Wakeup,
)
from laneweave.protocol.scenario.deployment_fields import Runtime
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.summary import Ending
from laneweave.protocol.wire.events import AGENT_MISSING
from laneweave.protocol.wire.messages import Command, Heartbeat, Name, Plan, Prepare
from laneweave.protocol.wire.process_messages import LogEvent, Report, RoadStatus
from laneweave.protocol.wire.topics import (
    CENSUS,
    EVENT,
    HEARTBEAT,
    REPORT,
    ROAD_REQUEST,
    VEHICLE_ALIVE,
)
from laneweave.sim_bridge.agent_log import AgentLog
from laneweave.sim_bridge.deployment import Deployment
from laneweave.sim_bridge.recording.record_interface import Record
from laneweave.sim_bridge.road.demand import Arrival
from laneweave.sim_bridge.road.demand_queue import NO_OUTSIDE_TRAFFIC, OutsideTraffic
from laneweave.sim_bridge.road.obstacles import Breakdown
from laneweave.sim_bridge.road.passing_vehicles import PassingVehicles
from laneweave.sim_bridge.road.road_desk import RoadDesk
from laneweave.sim_bridge.road.roadside import Roadside
from laneweave.sim_bridge.road.vehicle import RoadVehicle
from laneweave.sim_bridge.simulated_road import SimulatedRoad
from laneweave.sim_bridge.world_interface import World, show_bodies

BRIDGE = Name("bridge")
CATCH_UP_S = 1.0
"""Maximum delay of the road that later, shorter ticks make up for [s, on the node's clock]."""
SHUT_DOWN_S = 2.0
"""Maximum wait for final reports after a run has ended."""
CENSUS_S = 1.0
"""Period of the census while a tick waits for agents at the entrance [s, on the node's clock]."""
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
    SHUTTING_DOWN = "shutting down"
    ENDED = "ended"


class TickPace:
    """When ticks open, if answers arrive in time.

    The road keeps a pace on average: after long ticks it is faster, up to the scenario's
    `max_pace`. On a link that loses packets, few ticks are long.
    """

    def __init__(self, runtime: Runtime, pace: float | None) -> None:
        """Begin at any time; `pace` as in `BridgeCore`."""
        self._tick_s = runtime.tick_s
        self._duration_s = runtime.tick_s / (pace or runtime.max_pace)
        self._min_duration_s = min(self._duration_s, runtime.tick_s / runtime.max_pace)
        self._opened_s = 0.0
        self._due_s = 0.0
        """Time at which the current tick was due."""

    def start(self, now_s: float) -> None:
        """Make the first tick due now."""
        self._due_s = now_s

    def open_tick(self, now_s: float) -> None:
        """Register that a tick opens."""
        self._opened_s = now_s

    def next_s(self, now_s: float, *, answering: bool) -> float:
        """Return when the next tick opens; `answering`: whether any agent can answer."""
        if answering:
            self._due_s = max(self._due_s + self._duration_s, now_s - CATCH_UP_S)
        else:
            # Run no faster than real time during a network failure.
            self._due_s = self._opened_s + max(self._duration_s, self._tick_s)
        return max(now_s, self._due_s, self._opened_s + self._min_duration_s)


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
        breakdowns: Iterable[Breakdown] = (),
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
            breakdowns: vehicles that break down.
        """
        self.phase = TickPhase.STARTING
        self._scenario = scenario
        self._world = world
        self._record = record
        self._new_incarnation = new_incarnation
        self._roadside = Roadside(
            scenario, stream, incarnation, outside_traffic, breakdowns=breakdowns
        )
        self.road = SimulatedRoad(
            scenario, self._roadside, record, new_incarnation, RoadVehicle.entering, incarnation
        )
        self._desk = RoadDesk(scenario, self._roadside.obstacles)
        self._answers = self.road.answers
        self._pace = TickPace(scenario.runtime, pace)
        self._unreported: set[str] = {BRIDGE}
        """Processes whose final report is awaited."""
        self._departures: deque[tuple[int, Name]] = deque()
        """Tick and name of each vehicle that has left in the last `REPORT_TICKS`."""
        self._stopwatch = stopwatch
        self._tick_began = 0.0
        self._deployment = Deployment(scenario, incarnation, record)
        self._agent_log = AgentLog(self._deployment.fleet_of)
        self._leader: tuple[Name, int, int] | None = None
        """Name, incarnation and term of the coordinator that leads."""
        self._passing: set[str] = set()
        """Vehicles of other systems in the world."""
        self._opened_s = self._census_s = 0.0
        """When the current tick was opened; when the census is published next if it waits."""
        self._ending = Ending.COMPLETE
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
                vehicles_unattended=len(self.road.caretakers.vehicles),
            ),
        )

    @property
    def vehicles(self) -> Mapping[Name, RoadVehicle]:
        """The vehicles on the road, by name, in the order in which they entered."""
        return self.road.vehicles

    @property
    def tick(self) -> int:
        """Number of completed ticks."""
        return self.road.tick

    @property
    def t_s(self) -> float:
        """Road time."""
        return self.road.t_s

    @property
    def wakeup_s(self) -> float | None:
        """Time of the next resend, deadline or tick."""
        match self.phase:
            case TickPhase.ANSWERS:
                wakeup_s = min(self._answers.resend_s, self._answers.deadline_s)
            case TickPhase.AGENTS:
                wakeup_s = min(self._until_s, self._census_s)
            case TickPhase.PACE | TickPhase.SHUTTING_DOWN:
                wakeup_s = self._until_s
            case _:
                return None
        return min(wakeup_s, self._deployment.wakeup_s)

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
        if now_s >= self._deployment.wakeup_s and self.phase is not TickPhase.ENDED:
            effects += self._deployment.publish(now_s, self._status(now_s))
        return effects

    def _status(self, now_s: float) -> RoadStatus:
        """Return what observers learn about the road."""
        waits = self.phase is TickPhase.AGENTS
        up = self._answers.up
        return RoadStatus(
            bridge=self.road.incarnation,
            clock_s=self._new_incarnation() / 1e9,
            standing_s=now_s - self._opened_s if waits else 0.0,
            awaited=tuple(
                one.name for one in self.road.at_entrance if waits and one.name not in up
            ),
            unattended=self._deployment.unattended(self.road.caretakers.vehicles, now_s),
            overlaps=self._record.overlap_count,
            recording=self._record.recording,
        )

    def _on_event(self, event: Event, now_s: float) -> Iterator[Effect]:
        self.road.on_network(event, now_s)
        self._deployment.on_event(event, self.t_s, now_s)
        match event:
            case Started():
                for subscribed in (EVENT, REPORT, HEARTBEAT):
                    yield Listen(subscribed)
                # First: processes compare settings before they act.
                yield from self._deployment.start(now_s)
                yield from self.road.connect()
                yield Serve(ROAD_REQUEST)
                self._pace.start(now_s)
                self._open_tick(now_s)
            case QueryArrived():
                yield from self._desk.take(event, self.t_s)
            case Arrived(_, parameters, message):
                yield from self._on_message(message, parameters, now_s)
            case PeerUp(topic, parameters) if topic is VEHICLE_ALIVE:
                if parameters["vehicle"] in self.vehicles:
                    self._unreported.add(parameters["vehicle"])
            case Wakeup() if self.phase is TickPhase.ANSWERS:
                for name, copies in groupby(self._answers.due_resends(now_s)):
                    senses = self.road.sense_of(self.vehicles[name])  # encoded once
                    for _ in copies:
                        yield from senses
            case Stopping():
                yield from self._desk.close()
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
                yield from self.road.on_ballot(Name(parameters["vehicle"]), message)
            case Report():
                self._on_report(message, now_s)
            case LogEvent():
                self._record.on_event(message)
            case Heartbeat():
                self.road.bounds.check(message, self.t_s, now_s)
                self._record.on_heartbeat(message, self.t_s, now_s)
                yield from self._on_leader(message)
            case _:
                pass

    def _on_leader(self, heartbeat: Heartbeat) -> Iterator[Effect]:
        """Send SENSE to vehicles at rest if another coordinator leads: it needs their states."""
        leader = heartbeat.coordinator, heartbeat.incarnation, heartbeat.term
        if heartbeat.leading and leader != self._leader:
            self._leader = leader
            yield from self.road.disturb()

    def _on_command(self, command: Command, now_s: float) -> list[Effect]:
        # A late answer was computed for a past state and would lead to a wrong position.
        in_time = command.tick == self.tick and self.phase is TickPhase.ANSWERS
        return self.road.on_command(command, now_s, in_time=in_time)

    def _on_report(self, report: Report, now_s: float) -> None:
        final = report.role in ("agent", "bridge")
        if final and report.name not in self._unreported:
            return  # from an earlier run, or a duplicate
        self.road.bounds.check(report, self.t_s, now_s)
        if final:
            self._unreported.discard(report.name)
        self._record.on_report(report)

    # --- the tick -----------------------------------------------------------------------------

    def _proceed(self, now_s: float) -> Iterator[Effect]:
        """Advance through the phases, by at most one tick, until a phase has to wait."""
        if self.phase is TickPhase.PACE and now_s >= self._until_s:
            self._open_tick(now_s)
        if self.phase is TickPhase.AGENTS:
            self._until_s = max(self._waits_until_s(now_s), default=now_s)
            if now_s >= self._until_s:
                self._enter()
                yield from self.road.begin_tick(now_s)
                yield from self._desk.update(self.vehicles, self.t_s)
                self._agent_log.update(self.road.caretakers.vehicles, self.vehicles, self.t_s)
                self.phase = TickPhase.ANSWERS
            elif now_s >= self._census_s:
                # A fleet that was restarted learns of its vehicles.
                self._census_s = now_s + CENSUS_S
                publisher, at_entrance = self._roadside.publisher, self.road.at_entrance
                yield Send(CENSUS, publisher.census(self.t_s, self.vehicles.values(), at_entrance))
        if self.phase is TickPhase.ANSWERS and self._answers.complete(now_s):
            yield from self._end_tick(now_s)
        if self.phase is TickPhase.SHUTTING_DOWN and (
            now_s >= self._until_s or not self._unreported
        ):
            self._finish(self._ending)
            yield End()

    def _waits_until_s(self, now_s: float) -> Iterator[float]:
        """Yield until when the tick waits for each agent that is missing at the entrance."""
        for vehicle in self.road.at_entrance:
            if vehicle.name not in self._answers.up:
                yield self._opened_s + self._deployment.wait_s(vehicle.name, now_s)

    def _open_tick(self, now_s: float) -> None:
        """Admit vehicles at the entrance and start waiting for their agents."""
        self._pace.open_tick(now_s)
        self._tick_began = self._stopwatch()
        self.road.admit()
        self.phase = TickPhase.AGENTS
        self._opened_s, self._census_s = now_s, now_s + CENSUS_S

    def _enter(self) -> None:
        for vehicle in self.road.enter():
            self._world.add(vehicle.name, vehicle.state, vehicle.arrival.vehicle_type)
            if vehicle.name in self._answers.up:
                self._unreported.add(vehicle.name)
            else:
                self._record.event(self.t_s, AGENT_MISSING, vehicle=vehicle.name)
                self._deployment.on_missing(vehicle.name)

    def _end_tick(self, now_s: float) -> Iterator[Effect]:
        road = self.road
        self._record.on_missed(self._answers.close())
        road.step()
        obstacles = self._roadside.obstacles
        closed, passing = obstacles.without_vehicles(road.t_s), obstacles.passing
        self._show_passing(passing)
        show_bodies(
            self._world, road.vehicles, self._scenario, self._record, road.t_s, closed, passing
        )
        for vehicle in road.departed():
            self._world.remove(vehicle.name)
            self._departures.append((road.tick, vehicle.name))
            yield from road.remove(vehicle)
        while self._departures and self._departures[0][0] < road.tick - REPORT_TICKS:
            # The agent was killed, or its report was lost.
            self._unreported.discard(self._departures.popleft()[1])
        duration_s = self._stopwatch() - self._tick_began
        self._record.on_tick(road.t_s, len(road.vehicles), duration_s)
        if self._is_over():
            yield from self._shut_down(now_s)
            return
        answering = not self._answers.all_silent and road.caretakers.link_up
        self._until_s = self._pace.next_s(now_s, answering=answering)
        self.phase = TickPhase.PACE

    def _show_passing(self, passing: PassingVehicles) -> None:
        """Add vehicles of other systems to the world, and remove those that have left."""
        states = passing.states
        for name in self._passing - states.keys():
            self._world.remove(name)
        for name in states.keys() - self._passing:
            self._world.add(name, states[name])
            self._world.resize(name, passing.sizes[name])
        self._passing = {*states}

    def _is_over(self) -> bool:
        if self._roadside.is_over(self.t_s, self.vehicles):
            return True
        if self.t_s >= self._scenario.runtime.max_road_s:
            self._ending = Ending.LIMIT
            return True
        return False

    # --- the end ------------------------------------------------------------------------------

    def _shut_down(self, now_s: float) -> Iterator[Effect]:
        on_road = self.vehicles.values()
        yield from self._desk.close()
        yield from self._roadside.publish(self.tick, self.t_s, on_road, ended=True)
        yield from self.road.caretakers.notify_departed(self.tick)
        for vehicle in on_road:
            yield from vehicle.send_sense(self.tick, left=True)
        # Sent last, through the network like the other reports: the node adds its counters.
        yield Send(REPORT, Report(role=BRIDGE, name=BRIDGE), {"role": BRIDGE, "name": BRIDGE})
        self.phase = TickPhase.SHUTTING_DOWN
        self._until_s = now_s + SHUT_DOWN_S

    def _finish(self, ending: Ending) -> None:
        if self.phase is not TickPhase.ENDED:
            self.phase = TickPhase.ENDED
            self._agent_log.close(self.t_s)
            for arrival in self._roadside.outside.never_came if ending is Ending.COMPLETE else ():
                self._record.on_demanded(arrival)
            for vehicle in self.vehicles.values():
                self._record.on_still_on_road(vehicle)
            self._record.close(self.t_s, ending)
