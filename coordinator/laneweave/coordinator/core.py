"""The coordinator's core: one candidate that, when elected, leads all formations on the road."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable, Iterator, Mapping

import structlog

from laneweave.coordinator.election import Election
from laneweave.coordinator.formations.control import FormationControl
from laneweave.coordinator.formations.groups import Groups
from laneweave.coordinator.formations.leader_rules import LEADER_RULES, Phase
from laneweave.coordinator.formations.planner import FormationPlanner, Note
from laneweave.coordinator.formations.roster import Formation, closed_formations, with_room
from laneweave.coordinator.metrics import CoordinatorMetrics
from laneweave.coordinator.rolling.control import Note as StreamNote
from laneweave.coordinator.rolling.control import StreamControl
from laneweave.coordinator.rolling.planner import Planner, stream_planner
from laneweave.coordinator.service.server import PlanningService
from laneweave.protocol.runtime.metrics import MetricsSnapshot
from laneweave.protocol.runtime.node import (
    Announce,
    Arrived,
    Asked,
    Compute,
    Computed,
    Effect,
    Event,
    Listen,
    PeerDown,
    PeerUp,
    Send,
    Serve,
    Started,
    Stopping,
    Unlisten,
    Watch,
)
from laneweave.protocol.runtime.transport import LinkDown, LinkUp
from laneweave.protocol.scenario.tables import Scenario
from laneweave.protocol.state_machine import RuleBook
from laneweave.protocol.wire.events import (
    FORMATIONS_JOINED,
    LEADER_ELECTED,
    LEADER_STEPPED_DOWN,
    PLAN_IN_FORCE,
)
from laneweave.protocol.wire.messages import (
    Ballot,
    Census,
    Heartbeat,
    LogEvent,
    Name,
    Plan,
    Prepare,
    Report,
    RoadClock,
    VehicleState,
)
from laneweave.protocol.wire.topics import (
    BRIDGE_ALIVE,
    CENSUS,
    CLOCK,
    COORDINATOR_ALIVE,
    EVENT,
    HEARTBEAT,
    PLAN,
    PREPARE,
    REPORT,
    SERVICE,
    STATE,
    incarnation_of,
)

log = structlog.get_logger(__name__)

REPORT_S = 2.0
JUST_CLOSED_S = 1.0
"""A formation is new to everybody for this much road time."""


class CoordinatorCore:
    """State machine of a coordinator; see `Core` for how it is driven."""

    def __init__(
        self,
        name: Name,
        incarnation: int,
        scenario: Scenario,
        rules: RuleBook = LEADER_RULES,
        make_planner: Callable[[Scenario], Planner] = stream_planner,
        workers: int = 1,
    ) -> None:
        """Make a candidate that has seen nothing yet.

        Args:
            name: by which candidates are ranked.
            incarnation: a number that no process of this name has used before.
            scenario: road, formations, timing.
            rules: of a leader; others than `LEADER_RULES` only in tests.
            make_planner: makes what plans the stream in the rolling operation.
            workers: how many requests of others are planned at a time.
        """
        self.name = name
        self.scenario = scenario
        self.election = Election(name, incarnation, scenario.network.election_s, 0.0)
        self.controls: dict[int, FormationControl] = {}
        """Each under the least number of its formations."""
        self.census: Census | None = None
        self.t_s = 0.0
        self._formation_of: dict[Name, int] = {}
        """In whose block each vehicle of the census entered."""
        self._rules = rules
        self._groups = Groups()
        self._planner = FormationPlanner(scenario, self._groups)
        self._stream = (
            StreamControl(scenario, self._new_ballot, make_planner(scenario))
            if scenario.formation.rolling
            else None
        )
        """The rolling operation; None: formations."""
        self._handled_s = self._awake_since_s = 0.0
        """When the last event was, and since when this leader has missed nothing (node clock)."""
        self._incarnation = incarnation
        self._seq = 0
        self._rng = random.Random(f"{scenario.seed}/{name}/{incarnation}")  # noqa: S311
        self.service = PlanningService(name, scenario.service, workers, scenario.formation.solver)
        self._next_job = 0
        self._bridge = -1
        """Incarnation of the newest bridge."""
        self._road_changed = True
        self._heartbeat_s = 0.0
        self._report_s = 0.0
        self._wakeup_s: float | None = None

    @property
    def metrics(self) -> tuple[MetricsSnapshot, ...]:
        """What this candidate has counted."""
        election = self.election
        return (
            CoordinatorMetrics(
                leading=election.leading,
                term=election.term,
                candidates=1 + len(list(election.living(self._handled_s))),
                elections_total=election.won,
                plans_in_force=self._in_force,
                road_seconds=self.t_s,
            ),
            self.service.metrics,
        )

    @property
    def _in_force(self) -> int:
        """Plans in force: of formations, or of the slot."""
        if self._stream is not None:
            return self._stream.in_force
        return sum(control.phase is Phase.WATCHING for control in self.controls.values())

    @property
    def wakeup_s(self) -> float | None:
        """Next heartbeat, election, or formation timer."""
        return self._wakeup_s

    def handle(self, event: Event, now_s: float) -> list[Effect]:
        """Take an event; see `Core`."""
        if now_s > self._handled_s + self.election.election_s / 2:
            # Whoever wakes up from a pause leads no better than one who has just begun.
            self._awake_since_s = now_s
        self._handled_s = now_s
        stream = self._stream
        if (
            stream is not None
            and isinstance(event, Arrived)
            and isinstance(event.message, VehicleState)
        ):
            awaited = self._is_on_road(event.message) and stream.on_state(event.message)
            if not awaited and self._wakeup_s is not None and now_s < self._wakeup_s:
                return []  # as most: nobody waits for it, and nothing is due
            effects = list(self._carry_out(stream.on_awaited(event.message))) if awaited else []
        else:
            effects = list(self._on_event(event, now_s))
        if not isinstance(event, Stopping):
            effects += self._on_election(now_s)
            effects += self._lead(now_s)
            effects += self._heartbeat(now_s)
            effects += self.service.drop_late(now_s)
            self._plan_wakeup(now_s)
        return effects

    # --- inputs -------------------------------------------------------------------------------

    def _on_event(self, event: Event, now_s: float) -> Iterator[Effect]:
        match event:
            case Started():
                yield from self._start(now_s)
            case Arrived(_, _, VehicleState() as state):
                yield from self._on_state(state, now_s)
            case Arrived(_, _, message):
                self._on_message(message, now_s)
            case PeerUp(topic, parameters) if topic is COORDINATOR_ALIVE:
                self._meet_candidate(*_identity(parameters), now_s)
            case PeerDown(topic, parameters) if topic is COORDINATOR_ALIVE:
                self.election.on_token_down(*_identity(parameters))
            case PeerUp(topic, parameters) if topic is BRIDGE_ALIVE:
                self._meet_bridge(incarnation_of(parameters))
            case LinkUp() | LinkDown():
                self.election.on_link(up=isinstance(event, LinkUp), now_s=now_s)
            case Asked(token, payload, encoding):
                others = self.election.living(now_s)
                yield from self.service.take(token, payload, encoding, self._job(), others, now_s)
            case Computed():
                yield from self._on_computed(event, now_s)
            case Stopping():
                yield self._report()
            case _:
                pass

    def _start(self, now_s: float) -> Iterator[Effect]:
        self.election.started_s = self._heartbeat_s = self._report_s = now_s
        yield Listen(HEARTBEAT)
        yield Listen(CLOCK)
        yield Listen(CENSUS)
        yield Watch(COORDINATOR_ALIVE)
        yield Watch(BRIDGE_ALIVE)
        yield Announce(
            COORDINATOR_ALIVE, {"coordinator": self.name, "incarnation": self._incarnation}
        )
        yield Serve(SERVICE)

    def _meet_candidate(self, name: str, incarnation: int, now_s: float) -> None:
        if name == self.name and incarnation != self._incarnation:
            # Harmless for safety, but both would lead: nobody outranks the other.
            log.warning("another coordinator has the same name", coordinator=name)
        self.election.on_token_up(name, incarnation, now_s)

    def _meet_bridge(self, incarnation: int) -> None:
        """Forget the road of an earlier bridge: the clock of a new one begins at 0."""
        if incarnation > self._bridge:
            self._bridge = incarnation
            self.census = None
            self._formation_of = {}
            self.t_s = 0.0
            self._groups.forget()
            self._forget_formations()

    def _is_of_this_road(self, message: RoadClock | Census) -> bool:
        """Tell whether news is of the newest bridge; a newer one is met with it."""
        if message.bridge:
            self._meet_bridge(message.bridge)
        return message.bridge in (0, self._bridge)

    def _forget_formations(self) -> None:
        self.controls = {}
        self._planner.forget()
        if self._stream is not None:
            self._stream.forget()

    def _on_message(self, message: object, now_s: float) -> None:
        match message:
            case Heartbeat():
                self.election.on_heartbeat(message, now_s)
            case RoadClock() | Census() if not self._is_of_this_road(message):
                pass
            case RoadClock():
                self.t_s = max(self.t_s, message.t_s)
                self._planner.on_clock(self.t_s, now_s)
                self._road_changed = True
            case Census():
                if self.census is None or message.t_s >= self.census.t_s:
                    self.census = message
                    block_of = self.scenario.lattice.block_of
                    self._formation_of = {
                        entry.vehicle: block_of(entry.cell[0]) for entry in message.on_road
                    }
                    self.t_s = max(self.t_s, message.t_s)
                    self._road_changed = True
            case _:
                pass

    def _is_on_road(self, state: VehicleState) -> bool:
        """Tell whether a leader knows the vehicle by its census, and it has not left."""
        return self.election.leading and self._formation_of.get(state.vehicle) == state.formation

    def _on_state(self, state: VehicleState, now_s: float) -> Iterator[Effect]:
        """Take a state in the paper's operation."""
        if not self._is_on_road(state):
            return
        # What a vehicle has joined stays joined, whoever had it joined.
        if self._groups.join((state.formation, *state.joined)):
            self._road_changed = True
        group = self._groups.of(state.formation)
        control = self.controls.get(group[0])
        if control is None or control.formation.numbers != group:
            return
        issuing = control.phase is Phase.ISSUING
        control.on_state(state, now_s)
        if issuing and control.phase is Phase.WATCHING:
            closed_s = control.formation.closed_s
            yield self._log(PLAN_IN_FORCE, formation=group[0], closed_s=closed_s)

    def _on_computed(self, computed: Computed, now_s: float) -> Iterator[Effect]:
        if self.service.owns(computed.job):
            yield from self.service.finish(computed.job, computed.result, computed.error, now_s)
        elif self._stream is not None:
            yield from self._carry_out(self._stream.finish(computed, self.t_s, now_s))
        else:
            notes = self._planner.finish(computed, self.controls, self.t_s, now_s)
            yield from self._carry_out(notes)

    # --- election -----------------------------------------------------------------------------

    def _on_election(self, now_s: float) -> Iterator[Effect]:
        if not self.election.update(now_s):
            return
        if self._stream is None:
            self._forget_formations()
        else:
            self._stream.take_over()
        self._road_changed = True
        self._awake_since_s = now_s
        if self.election.leading:
            yield Listen(STATE)
        else:
            yield Unlisten(STATE)
        self._heartbeat_s = now_s
        kind = LEADER_ELECTED if self.election.leading else LEADER_STEPPED_DOWN
        log.info(kind, coordinator=self.name, term=self.election.term)
        yield self._log(kind, term=self.election.term)

    def _heartbeat(self, now_s: float) -> Iterator[Effect]:
        if now_s >= self._heartbeat_s:
            self._heartbeat_s = now_s + self.scenario.network.heartbeat_s
            term, leading = self.election.term, self.election.leading
            yield Send(
                HEARTBEAT,
                Heartbeat(self.name, self._incarnation, term, leading, self._in_force),
                {"coordinator": self.name},
            )
        if now_s >= self._report_s:
            self._report_s = now_s + REPORT_S
            yield self._report()

    # --- leading ------------------------------------------------------------------------------

    def _lead(self, now_s: float) -> Iterator[Effect]:
        if not self.election.leading or self.census is None:
            return
        if self._stream is not None:
            yield from self._lead_stream(self._stream, self.census, now_s)
            return
        if self._road_changed:
            self._road_changed = False
            yield from self._update_members(self.census, now_s)
        for control in self.controls.values():
            if control.wakeup_s is None or control.wakeup_s > now_s:
                continue
            control.on_time(now_s)
            if control.take_planning_order(now_s):
                yield from self._carry_out(
                    self._planner.order(self._job(), control, self.t_s, now_s)
                )
            for vehicle, message in control.outgoing(now_s):
                yield self._to_vehicle(vehicle, message)

    def _lead_stream(self, stream: StreamControl, census: Census, now_s: float) -> Iterator[Effect]:
        if self._road_changed:
            self._road_changed = False
            stream.on_census(census)
            yield from self._carry_out(stream.order(self._job, self.t_s, now_s))
        for vehicle, message in stream.outgoing(now_s):
            yield self._to_vehicle(vehicle, message)

    @staticmethod
    def _to_vehicle(vehicle: Name, message: Prepare | Plan) -> Effect:
        topic = PLAN if isinstance(message, Plan) else PREPARE
        return Send(topic, message, {"vehicle": vehicle})

    def _update_members(self, census: Census, now_s: float) -> Iterator[Effect]:
        formations = closed_formations(census, self.t_s, self.scenario, self._groups)
        for numbers in with_room(formations, self.t_s, self.scenario):
            self._groups.join(numbers)
            yield self._log(FORMATIONS_JOINED, formations=list(numbers), why="room")
            formations = closed_formations(census, self.t_s, self.scenario, self._groups)
        for number in set(self.controls) - set(formations):
            del self.controls[number]
        for number, formation in formations.items():
            control = self.controls.get(number)
            if control is None or control.formation.numbers != formation.numbers:
                self.controls[number] = self._take_over(formation, now_s)
            else:
                control.on_members(formation, now_s)

    def _take_over(self, formation: Formation, now_s: float) -> FormationControl:
        control = FormationControl(
            formation,
            self._new_ballot,
            self._rng,
            self.scenario.network.resend_s,
            self._rules,
        )
        # A formation that has just closed before this leader's eyes has no plan to be adopted.
        age_s = self.t_s - formation.closed_s
        watched = now_s >= self._awake_since_s + self.election.election_s
        control.begin(now_s, observe=not watched or age_s > JUST_CLOSED_S)
        return control

    def _new_ballot(self, above: Ballot | None) -> Ballot:
        self._seq += 1
        ballot = Ballot(self.election.term, self.name, self._incarnation, self._seq)
        if above is not None and ballot < above:
            # Equal terms happen, too: two candidates that did not hear each other take the same.
            self.election.raise_term(above.term)
            ballot = ballot._replace(term=self.election.term)
        return ballot

    def _carry_out(self, outcomes: Iterable[Compute | Note | StreamNote]) -> Iterator[Effect]:
        """Pass computations on; write notes down; a new group changes who plans together."""
        for outcome in outcomes:
            if isinstance(outcome, Compute):
                yield outcome
                continue
            self._road_changed |= outcome.kind == FORMATIONS_JOINED
            yield self._log(outcome.kind, **outcome.data)

    # --- small things -------------------------------------------------------------------------

    def _job(self) -> int:
        self._next_job += 1
        return self._next_job

    def _log(self, kind: str, **data: object) -> Effect:
        message = LogEvent(Name("coordinator"), self.name, self.t_s, Name(kind), dict(data))
        return Send(EVENT, message, {"role": "coordinator", "name": self.name})

    def _report(self) -> Effect:
        message = Report(Name("coordinator"), self.name)
        return Send(REPORT, message, {"role": "coordinator", "name": self.name})

    def _plan_wakeup(self, now_s: float) -> None:
        times = [self._heartbeat_s, self._report_s, self.election.next_change_s(now_s)]
        if (service_s := self.service.wakeup_s) is not None:
            times.append(service_s)
        if not self.election.leading:
            times.append(self.election.started_s + self.election.election_s)
        elif self._stream is not None:
            times += self._stream.wakeups
        else:
            times += [
                control.wakeup_s
                for control in self.controls.values()
                if control.wakeup_s is not None
            ]
        # Never ask for a moment that has passed: the same timer would fire for ever.
        self._wakeup_s = max(min(time for time in times if time > now_s), now_s + 1e-3)


def _identity(parameters: Mapping[str, str]) -> tuple[str, int]:
    return parameters["coordinator"], incarnation_of(parameters)
