"""The bridge's core: lockstep ticks between the simulated world and the vehicles' agents.

A tick: the census admits vehicles, every vehicle on the road is told what its sensors see, its
agent answers with a trajectory, all bodies move on by one tick, the world shows them, and what it
shows is measured. A tick is sent again to those who have not answered; after the deadline their
motion controllers go on with the trajectory that they have.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from enum import Enum
from typing import Protocol

import structlog

from laneweave.protocol.errors import BadInputError
from laneweave.protocol.messages import (
    Command,
    Heartbeat,
    LogEvent,
    Name,
    Neighbour,
    Report,
    Sense,
)
from laneweave.protocol.motion import State
from laneweave.protocol.node import (
    Announce,
    Arrived,
    Effect,
    End,
    Event,
    Listen,
    PeerDown,
    PeerUp,
    Send,
    Started,
    Stopping,
    Wakeup,
    Watch,
)
from laneweave.protocol.scenario import Scenario
from laneweave.protocol.topics import (
    BRIDGE_ALIVE,
    CENSUS,
    CLOCK,
    COMMAND,
    EVENT,
    HEARTBEAT,
    REPORT,
    SENSE,
    VEHICLE_ALIVE,
)
from laneweave.protocol.transport import LinkDown, LinkUp
from laneweave.sim_bridge.overlap import Pose, least_gaps, neighbours, overlapping_pairs
from laneweave.sim_bridge.roadside import Roadside
from laneweave.sim_bridge.run_record import Ending, RunRecord
from laneweave.sim_bridge.traffic import RoadVehicle

log = structlog.get_logger(__name__)

CENSUS_EVERY_TICKS = 10
LEFT_REPEATS = 20
"""Ticks for which the agent of a vehicle that left is told so."""
BRIDGE = Name("bridge")
WIND_UP_S = 2.0
"""How long the bridge waits for last reports at the end of a run."""


class World(Protocol):
    """Where the bodies are shown; `SumoWorld` in every real run."""

    def add(self, vehicle: str, state: State) -> None:
        """Put a vehicle on the road."""

    def place(self, vehicle: str, state: State) -> None:
        """Say where a vehicle is at the end of the next step."""

    def step(self) -> None:
        """Advance by one tick."""

    def positions(self) -> dict[str, Pose]:
        """Return where each vehicle is shown."""

    def collisions(self) -> list[tuple[str, str]]:
        """Return the pairs that the world itself takes for colliding."""

    def remove(self, vehicle: str) -> None:
        """Take a vehicle off the road."""


class Phase(Enum):
    """What the bridge waits for."""

    STARTING = "starting"
    AGENTS = "agents"
    """Vehicles are at the entrance whose agents are not up yet."""
    ANSWERS = "answers"
    PACE = "pace"
    """The next tick is not due yet."""
    WIND_UP = "wind-up"
    ENDED = "ended"


class BridgeCore:
    """State machine of the bridge; see `Core` for how it is driven."""

    def __init__(
        self,
        scenario: Scenario,
        world: World,
        record: RunRecord,
        *,
        pace: float | None = None,
        incarnation: int = 0,
        stopwatch: Callable[[], float] = time.perf_counter,
    ) -> None:
        """Set the world up before the first tick.

        Args:
            scenario: road, demand, vehicles.
            world: an empty world.
            record: where measurements go.
            pace: most road seconds per second of the node's clock; None: the scenario's maximum.
            incarnation: tells this run of the road from earlier ones of the same deployment.
            stopwatch: measures the duration of ticks, in s; decides nothing.
        """
        self.scenario = scenario
        self.tick = 0
        self.phase = Phase.STARTING
        self.vehicles: dict[Name, RoadVehicle] = {}
        self._world = world
        self._record = record
        self._roadside = Roadside(scenario)
        self._tick_lasts_s = scenario.runtime.tick_s / (pace or scenario.runtime.max_pace)
        self._incarnation = incarnation
        self._stopwatch = stopwatch
        self._agents_up: set[str] = set()
        self._silent: set[str] = set()
        self._awaited: set[Name] = set()
        self._at_entrance: list[RoadVehicle] = []
        self._leaving: dict[Name, tuple[RoadVehicle, int]] = {}
        """Vehicles that left, and how often their agents are still told so."""
        self._unreported: set[str] = {BRIDGE}
        """Whose last report is still to come."""
        self._patience_s = scenario.runtime.agent_start_s
        """How long to wait for the next agent that is not up."""
        self._ending = Ending.COMPLETE
        self._link_up = True
        self._census_sent_tick = -CENSUS_EVERY_TICKS
        self._census_changed = True
        self._tick_began = 0.0
        self._opened_s = 0.0
        self._due_s = 0.0
        self._resend_s = 0.0
        self._deadline_s = 0.0

    # --- as a core ----------------------------------------------------------------------------

    @property
    def t_s(self) -> float:
        """Road time."""
        return self.tick * self.scenario.runtime.tick_s

    @property
    def wakeup_s(self) -> float | None:
        """Next resend, deadline, or tick."""
        match self.phase:
            case Phase.ANSWERS:
                return min(self._resend_s, self._deadline_s)
            case Phase.AGENTS | Phase.WIND_UP:
                return self._deadline_s
            case Phase.PACE:
                return self._due_s
            case _:
                return None

    def handle(self, event: Event, now_s: float) -> list[Effect]:
        """Take an event; see `Core`."""
        effects = list(self._on_event(event, now_s))
        effects += self._proceed(now_s)
        return effects

    def _on_event(self, event: Event, now_s: float) -> Iterator[Effect]:
        match event:
            case Started():
                yield from self._start(now_s)
            case Arrived(_, _, message):
                self._on_message(message, now_s)
            case PeerUp(topic, parameters) if topic is VEHICLE_ALIVE:
                self._agents_up.add(parameters["vehicle"])
                self._silent.discard(parameters["vehicle"])
                self._patience_s = self.scenario.runtime.agent_start_s
                if parameters["vehicle"] in self.vehicles:
                    self._unreported.add(parameters["vehicle"])
            case PeerDown(topic, parameters) if topic is VEHICLE_ALIVE:
                self._on_agent_down(parameters["vehicle"])
            case LinkUp():
                self._link_up = True
            case LinkDown():
                self._link_up = False
            case Wakeup() if self.phase is Phase.ANSWERS:
                yield from self._send_again(now_s)
            case Stopping():
                # Who is asked to end while the last reports come in has ended already.
                winding_up = self.phase is Phase.WIND_UP
                self._finish(self._ending if winding_up else Ending.INTERRUPTED)
            case _:
                pass

    def _start(self, now_s: float) -> Iterator[Effect]:
        yield Listen(COMMAND)
        yield Listen(EVENT)
        yield Listen(REPORT)
        yield Listen(HEARTBEAT)
        yield Watch(VEHICLE_ALIVE)
        yield Announce(BRIDGE_ALIVE, {"incarnation": self._incarnation})
        self._open_tick(now_s)

    def _on_message(self, message: object, now_s: float) -> None:
        match message:
            case Command():
                self._on_command(message)
            case Report():
                self._on_report(message)
            case LogEvent():
                self._record.on_event(message)
            case Heartbeat():
                self._record.on_heartbeat(message, self.t_s, now_s)
            case _:
                pass

    def _on_command(self, command: Command) -> None:
        vehicle = self.vehicles.get(command.vehicle)
        if vehicle is None:
            return
        # Whoever answers late is there: the next tick waits for it, and it catches up.
        self._silent.discard(command.vehicle)
        if command.tick != self.tick or self.phase is not Phase.ANSWERS:
            # A late answer was made for a state that is past: played now, from its middle, it
            # would end somewhere else.
            return
        try:
            vehicle.controller.take(command)
        except BadInputError as error:
            log.warning("command ignored", vehicle=command.vehicle, reason=str(error))
            return
        self._awaited.discard(command.vehicle)

    def _on_report(self, report: Report) -> None:
        if report.role in ("agent", "bridge"):
            if report.name not in self._unreported:
                return  # about a vehicle of an earlier run, or a duplicate
            self._unreported.discard(report.name)
        self._record.on_report(report)

    def _on_agent_down(self, vehicle: str) -> None:
        if self._link_up:
            self._agents_up.discard(vehicle)
            self._awaited.discard(Name(vehicle))
            self._leaving.pop(Name(vehicle), None)

    # --- the tick -----------------------------------------------------------------------------

    def _proceed(self, now_s: float) -> Iterator[Effect]:
        """Go on from phase to phase as far as nothing has to be waited for, one tick at most."""
        if self.phase is Phase.PACE and now_s >= self._due_s:
            self._open_tick(now_s)
        if self.phase is Phase.AGENTS and self._entrance_clear(now_s):
            yield from self._begin_tick(now_s)
        if self.phase is Phase.ANSWERS and (not self._awaited or now_s >= self._deadline_s):
            yield from self._end_tick(now_s)
        if self.phase is Phase.WIND_UP and (now_s >= self._deadline_s or not self._unreported):
            self._finish(self._ending)
            yield End()

    def _open_tick(self, now_s: float) -> None:
        """Admit vehicles at the entrance; wait for their agents."""
        self._opened_s = now_s
        self._tick_began = self._stopwatch()
        for arrival in self._roadside.newly_demanded(self.t_s):
            self._record.on_demanded(arrival)
        for admission in self._roadside.admit(self.t_s):
            vehicle = RoadVehicle.entering(admission, self.t_s, self.scenario)
            self._at_entrance.append(vehicle)
            self._census_changed = True
        self.phase = Phase.AGENTS
        self._deadline_s = now_s + self._patience_s

    def _entrance_clear(self, now_s: float) -> bool:
        return now_s >= self._deadline_s or all(
            vehicle.name in self._agents_up for vehicle in self._at_entrance
        )

    def _begin_tick(self, now_s: float) -> Iterator[Effect]:
        for vehicle in self._at_entrance:
            self.vehicles[vehicle.name] = vehicle
            self._world.add(vehicle.name, vehicle.state)
            self._record.on_entered(vehicle)
            if vehicle.name in self._agents_up:
                self._unreported.add(vehicle.name)
            else:
                self._record.note(self.t_s, "agent-missing", vehicle=vehicle.name)
                # Where one did not come, the next are not worth a long wait, until one does.
                self._patience_s = self.scenario.network.resend_s
        self._at_entrance.clear()
        yield from self._tell_road_users()
        for vehicle in self.vehicles.values():
            yield Send(SENSE, self._sense(vehicle), {"vehicle": vehicle.name})
        yield from self._tell_leaving()
        self._awaited = {
            name for name in self.vehicles if name in self._agents_up and name not in self._silent
        }
        runtime, network = self.scenario.runtime, self.scenario.network
        self._resend_s = now_s + network.resend_s
        self._deadline_s = now_s + runtime.tick_deadline_s
        self.phase = Phase.ANSWERS

    def _tell_road_users(self) -> Iterator[Effect]:
        counts = self._roadside.counts(on_road=len(self.vehicles))
        yield Send(CLOCK, counts.clock(self.tick, self.t_s, ended=False))
        due = self.tick >= self._census_sent_tick + CENSUS_EVERY_TICKS
        announced = self._roadside.announcements_changed(self.t_s)
        if announced or due or self._census_changed:
            self._census_changed = False
            self._census_sent_tick = self.tick
            yield Send(CENSUS, self._roadside.census(self.t_s, self.vehicles.values()))

    def _sense(self, vehicle: RoadVehicle, *, left: bool = False) -> Sense:
        controller = vehicle.controller
        return Sense(
            vehicle=vehicle.name,
            tick=self.tick,
            t_s=self.t_s,
            state=vehicle.state,
            hold_cell=controller.hold_cell,
            motion_end_tick=controller.motion_end_tick,
            motion_origin=controller.motion_origin,
            preferred_lane=vehicle.admission.arrival.preferred_lane,
            ahead=vehicle.ahead,
            left=left,
        )

    def _tell_leaving(self) -> Iterator[Effect]:
        for name, (vehicle, repeats) in list(self._leaving.items()):
            if name not in self._agents_up or repeats == 0:
                del self._leaving[name]
                continue
            self._leaving[name] = (vehicle, repeats - 1)
            yield Send(SENSE, self._sense(vehicle, left=True), {"vehicle": name})

    def _send_again(self, now_s: float) -> Iterator[Effect]:
        if now_s >= self._resend_s:
            self._resend_s = now_s + self.scenario.network.resend_s
            for name in sorted(self._awaited):
                yield Send(SENSE, self._sense(self.vehicles[name]), {"vehicle": name})

    def _end_tick(self, now_s: float) -> Iterator[Effect]:
        for name in sorted(self._awaited):
            self._silent.add(name)
            self._record.note(self.t_s, "agent-silent", vehicle=name)
        self._awaited.clear()
        for vehicle in self.vehicles.values():
            vehicle.controller.step(self.tick)
        self.tick += 1
        self._show()
        self._let_leave()
        duration_s = self._stopwatch() - self._tick_began
        self._record.on_tick(self.t_s, len(self.vehicles), duration_s)
        if self._over():
            yield from self._wind_up(now_s)
            return
        self._due_s = max(now_s, self._opened_s + self._tick_lasts_s)
        if not self._link_up:
            # Nobody can answer: do not race ahead of the vehicles while the network is away.
            self._due_s = max(self._due_s, now_s + self.scenario.runtime.tick_s)
        self.phase = Phase.PACE

    def _show(self) -> None:
        """Let the world show the bodies, and measure what it shows."""
        world, vehicle_size = self._world, self.scenario.vehicle
        for vehicle in self.vehicles.values():
            world.place(vehicle.name, vehicle.state)
        world.step()
        poses = world.positions()
        size = (vehicle_size.length_m, vehicle_size.width_m)
        seen = neighbours(
            poses,
            {},
            lanes=self.scenario.road.lanes,
            lane_width_m=self.scenario.road.lane_width_m,
            length_m=size[0],
            width_m=size[1],
        )
        for name, vehicle in self.vehicles.items():
            vehicle.ahead = tuple(
                Neighbour(lane, gap_m, speed_mps) for lane, gap_m, speed_mps, _ in seen[name].ahead
            )
        self._record.on_shown(
            self.t_s,
            self.vehicles.values(),
            overlaps=overlapping_pairs(poses, *size),
            collisions=world.collisions(),
            gaps=least_gaps(poses, *size),
        )

    def _let_leave(self) -> None:
        length_m = self.scenario.road.length_m
        for name, vehicle in list(self.vehicles.items()):
            if vehicle.state[0] >= length_m:
                del self.vehicles[name]
                self._world.remove(name)
                self._roadside.count_left()
                self._record.on_left(vehicle, self.t_s)
                self._leaving[name] = (vehicle, LEFT_REPEATS)
                self._silent.discard(name)
                self._census_changed = True

    def _over(self) -> bool:
        if not self.vehicles and self._roadside.exhausted(self.t_s):
            return True
        if self.t_s >= self.scenario.runtime.max_road_s:
            self._ending = Ending.LIMIT
            return True
        return False

    # --- the end ------------------------------------------------------------------------------

    def _wind_up(self, now_s: float) -> Iterator[Effect]:
        counts = self._roadside.counts(on_road=len(self.vehicles))
        yield Send(CLOCK, counts.clock(self.tick, self.t_s, ended=True))
        yield Send(CENSUS, self._roadside.census(self.t_s, self.vehicles.values()))
        yield from self._tell_leaving()
        for vehicle in self.vehicles.values():
            yield Send(SENSE, self._sense(vehicle, left=True), {"vehicle": vehicle.name})
        # Last, so that it counts all, and through the network, like everybody's: the node fills in
        # what it has counted.
        yield Send(
            REPORT,
            Report(role=Name("bridge"), name=BRIDGE),
            {"role": "bridge", "name": BRIDGE},
        )
        self.phase = Phase.WIND_UP
        self._deadline_s = now_s + WIND_UP_S

    def _finish(self, ending: Ending) -> None:
        if self.phase is not Phase.ENDED:
            self.phase = Phase.ENDED
            for vehicle in self.vehicles.values():
                self._record.on_still_on_road(vehicle)
            self._record.close(self.t_s, ending)
