"""The coordinator's core: election, planning service, and one operation."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, ClassVar

import structlog
from attrs import frozen

from laneweave.coordinator.election import Election
from laneweave.coordinator.entry_cells import EntryCells
from laneweave.coordinator.formations.leader import LEADER_RULES
from laneweave.coordinator.formations.operation import FormationsOperation
from laneweave.coordinator.operation import LogEntry, Operation, Outcome, ToVehicle
from laneweave.coordinator.planning.response import PlanFunction
from laneweave.coordinator.planning.solve import plan
from laneweave.coordinator.rolling.checked_planner import Planner, stream_planner
from laneweave.coordinator.rolling.operation import RollingOperation
from laneweave.coordinator.rolling.transfer import TRANSFER_RULES
from laneweave.coordinator.service.pending import ClientSession
from laneweave.coordinator.service.server import PlanningService
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.runtime.metrics import MetricsSnapshot, metric
from laneweave.protocol.runtime.node import (
    Announce,
    Arrived,
    Computed,
    Effect,
    End,
    Event,
    Listen,
    MessagesDropped,
    PeerDown,
    PeerUp,
    QueryArrived,
    Refuse,
    Send,
    Serve,
    Started,
    Stopping,
    Unlisten,
    Watch,
    Withdraw,
)
from laneweave.protocol.runtime.transport import LinkDown, LinkUp
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.state_machine import RuleBook
from laneweave.protocol.wire.bounds import max_election_term
from laneweave.protocol.wire.events import LEADER_ELECTED, LEADER_STEPPED_DOWN
from laneweave.protocol.wire.messages import (
    Ballot,
    Census,
    Heartbeat,
    Name,
    Plan,
    RoadClock,
    VehicleState,
    addresses_of,
)
from laneweave.protocol.wire.newest import NewestRoad
from laneweave.protocol.wire.obstacle_messages import Obstacles
from laneweave.protocol.wire.process_messages import LogEvent, Report
from laneweave.protocol.wire.topics import (
    BRIDGE_ALIVE,
    CENSUS,
    CLIENT_ALIVE,
    CLOCK,
    COORDINATOR_ALIVE,
    EVENT,
    HEARTBEAT,
    OBSTACLES,
    PLAN,
    PREPARE,
    REPORT,
    SERVICE,
    SERVICE_CANCEL,
    STATE,
    incarnation_of,
)

log = structlog.get_logger(__name__)

REPORT_S = 2.0
"""Interval between reports."""


@frozen
class CoordinatorMetrics:
    """Election and plans as seen by one candidate."""

    ABOUT: ClassVar[str] = "coordinator"

    leading: bool = metric("1 while this candidate leads, else 0")
    term: int = metric("Highest term seen; the candidate's own term while it leads")
    candidates: int = metric("Candidates with recent heartbeats, including this one")
    elections_total: int = metric("Number of times that this process has become leader")
    plans_in_force: int = metric("Plans in force while leading, for formations or for this slot")
    road_seconds: float = metric("Newest road time received")


class CoordinatorCore:
    """State machine of a coordinator; see `Core`."""

    def __init__(
        self,
        name: Name,
        incarnation: int,
        scenario: Scenario,
        rules: RuleBook = LEADER_RULES,
        make_planner: Callable[[Scenario], Planner] = stream_planner,
        workers: int = 1,
        transfer_rules: RuleBook = TRANSFER_RULES,
        plan: PlanFunction = plan,
    ) -> None:
        """Create a candidate that has received no messages yet.

        Args:
            name: name of the candidate; candidates are ranked by name.
            incarnation: a number that no process of this name has used before.
            scenario: road, formations, timing.
            rules: rules for formation leaders; tests replace some.
            make_planner: returns the planner of the rolling operation.
            workers: number of client requests to answer concurrently.
            transfer_rules: rules for cell transfers; tests replace some.
            plan: answers requests, in other processes or threads.
        """
        self.name = name
        self.scenario = scenario
        self.election = Election(name, incarnation, scenario.network.election_s, 0.0)
        self.service = PlanningService(
            name, scenario.service, workers, plan, scenario.formation.solver
        )
        runtime = scenario.runtime
        self._bounds = runtime.bounds(incarnation)
        self._road = NewestRoad(runtime.max_pace)
        self._road_number = 0
        """Number of the road that the census and the operation are about."""
        self.census: Census | None = None
        self._entry_cells = EntryCells(scenario)
        self._processes_of: dict[Name, tuple[Name, ...]] = {}
        """Processes with an agent for each vehicle in the census."""
        self._handled_s = self._awake_since_s = 0.0
        """Time of the last event; start of the current gap-free series of events (node clock)."""
        self._incarnation = incarnation
        self._seq = 0
        self._last_job = 0
        self._of_this_road = True
        """Whether the newest clock or census is of the newest road."""
        self._obstacles_s = -math.inf
        """Road time of the newest closed parts of lanes."""
        self._road_changed = True
        self._next_heartbeat_s = 0.0
        self._next_report_s = 0.0
        self._wakeup_s: float | None = None
        self._ends_s: float | None = None
        """End of the grace after a stop signal; None: there was none."""
        self.operation = self._make_operation(rules, transfer_rules, make_planner, plan)

    def _make_operation(
        self,
        rules: RuleBook,
        transfer_rules: RuleBook,
        make_planner: Callable[[Scenario], Planner],
        plan: PlanFunction,
    ) -> Operation:
        scenario = self.scenario
        if scenario.formation.traits.has_formations:
            rng = random.Random(f"{scenario.seed}/{self.name}/{self._incarnation}")  # noqa: S311
            return FormationsOperation(
                scenario, self._new_ballot, self._new_job, self._has_watched, rng, plan, rules
            )
        planner = make_planner(scenario)
        return RollingOperation(scenario, self._new_ballot, self._new_job, planner, transfer_rules)

    @property
    def metrics(self) -> tuple[MetricsSnapshot, ...]:
        """Metrics of this candidate and of its planning service."""
        election = self.election
        return (
            CoordinatorMetrics(
                leading=election.leading,
                term=election.term,
                candidates=1 + len(list(election.living(self._handled_s))),
                elections_total=election.won,
                plans_in_force=self.operation.in_force,
                road_seconds=self.t_s,
            ),
            self.service.metrics,
        )

    @property
    def t_s(self) -> float:
        """Road time."""
        return self._road.t_s

    @property
    def wakeup_s(self) -> float | None:
        """Time of the next heartbeat, report, election timeout or other timer."""
        return self._wakeup_s

    def handle(self, event: Event, now_s: float) -> list[Effect]:
        """Handle an event; see `Core`."""
        if now_s > self._handled_s + self.election.election_s / 2:
            # After a pause, a leader knows no more than a newly elected one.
            self._awake_since_s = now_s
        self._handled_s = now_s
        try:
            self._check(event, now_s)
        except BadInputError as error:
            return [Refuse(error)]
        if isinstance(event, Arrived) and isinstance(event.message, VehicleState):
            outcomes = self._on_state(event.message, now_s)
            if outcomes is None and self._wakeup_s is not None and now_s < self._wakeup_s:
                return []  # most states: nothing depends on them, and nothing is due
            effects = list(self._effects(outcomes or ()))
        else:
            effects = list(self._on_event(event, now_s))
        if not isinstance(event, Stopping) or event.grace_s:
            effects += self._on_election(now_s)
            effects += self._lead(now_s)
            effects += self._periodic_messages(now_s)
            effects += self.service.wake(now_s)
            effects += self._end(now_s)
            self._set_wakeup(now_s)
        return effects

    # --- inputs -------------------------------------------------------------------------------

    def _check(self, event: Event, now_s: float) -> None:
        """Check the numbers of an event, and register the road that it shows.

        Raises:
            BadInputError: a number is out of bounds.
        """
        road = self._road
        match event:
            case Arrived(_, _, message):
                self._bounds.check(message, road.latest_s(now_s), now_s)
                if isinstance(message, VehicleState):
                    self._entry_cells.check(message)
                if isinstance(message, (RoadClock, Census, Obstacles)):
                    self._of_this_road = road.on_message(message.bridge, message.t_s, now_s)
            case PeerUp(_, {"incarnation": _} as parameters):
                incarnation = incarnation_of(parameters)
                self._bounds.check_incarnation(incarnation, now_s)
                if event.topic is BRIDGE_ALIVE:
                    road.on_token_up(incarnation, now_s)
            case LinkDown():
                road.on_link_down()
            case PeerDown(topic, parameters) if topic is BRIDGE_ALIVE and self.election.link_up:
                road.on_token_down(incarnation_of(parameters), now_s)
            case _:
                pass
        if road.number != self._road_number:
            self._forget_road()

    def _forget_road(self) -> None:
        """Discard everything about another road, or about a road time that was wrong."""
        self._road_number = self._road.number
        self.census = None
        self._obstacles_s = -math.inf
        self._entry_cells.update(())
        self._processes_of = {}
        self.operation.forget()

    def _on_event(self, event: Event, now_s: float) -> Iterator[Effect]:
        match event:
            case Started():
                yield from self._start(now_s)
            case Arrived(_, _, message):
                self._on_message(message, now_s)
            case PeerUp(topic, parameters) if topic is COORDINATOR_ALIVE:
                self._on_candidate(*_identity(parameters), now_s)
            case PeerDown(topic, parameters) if topic is COORDINATOR_ALIVE:
                self.election.on_token_down(*_identity(parameters))
            case MessagesDropped():
                self.election.on_messages_dropped(now_s)
            case LinkUp() | LinkDown():
                self.election.on_link(up=isinstance(event, LinkUp), now_s=now_s)
            case PeerUp(topic, parameters) if topic is CLIENT_ALIVE:
                self.service.open_session(ClientSession.of(parameters))
            case PeerDown(topic, parameters) if topic is CLIENT_ALIVE:
                yield from self.service.close_session(ClientSession.of(parameters))
            case QueryArrived():
                yield from self._on_query(event, now_s)
            case Computed():
                yield from self._on_computed(event, now_s)
            case Stopping(grace_s):
                yield from self._retire(now_s + grace_s) if grace_s else (self._report(),)
            case _:
                pass

    def _on_query(self, query: QueryArrived, now_s: float) -> Iterator[Effect]:
        session = ClientSession.of(query.sender)
        if query.topic is SERVICE_CANCEL:
            yield from self.service.cancel(query.token, query.payload, query.encoding, session)
            return
        others = self.election.living(now_s)
        yield from self.service.take(
            query.token, query.payload, query.encoding, session, self._new_job(), others, now_s
        )

    def _start(self, now_s: float) -> Iterator[Effect]:
        self.election.started_s = self._next_heartbeat_s = self._next_report_s = now_s
        yield Listen(HEARTBEAT)
        yield Listen(CLOCK)
        yield Listen(CENSUS)
        yield Listen(OBSTACLES)
        yield Watch(COORDINATOR_ALIVE)
        yield Watch(BRIDGE_ALIVE)
        yield Watch(CLIENT_ALIVE)
        yield Announce(COORDINATOR_ALIVE, self._own)
        yield Serve(SERVICE)
        yield Serve(SERVICE_CANCEL)

    @property
    def _own(self) -> Mapping[str, Any]:
        """Parameters of this candidate's token."""
        return {"coordinator": self.name, "incarnation": self._incarnation}

    def _on_candidate(self, name: str, incarnation: int, now_s: float) -> None:
        if name == self.name and incarnation != self._incarnation:
            # Safe, but both would lead: neither outranks the other.
            log.warning("another coordinator has the same name", coordinator=name)
        self.election.on_token_up(name, incarnation, now_s)

    def _on_message(self, message: object, now_s: float) -> None:
        match message:
            case Heartbeat():
                self.election.on_heartbeat(message, now_s)
            case RoadClock() | Census() | Obstacles() if not self._of_this_road:
                pass
            case RoadClock():
                self.election.limit_term(max_election_term(self.t_s))
                self.operation.on_clock(self.t_s, now_s)
                self._road_changed = True
            case Obstacles():
                if message.t_s >= self._obstacles_s:
                    self._obstacles_s = message.t_s
                    self.operation.on_obstacles(message.temporary)
            case Census():
                if self.census is None or message.t_s >= self.census.t_s:
                    self.census = message
                    self._entry_cells.update(message.on_lattice)
                    self._processes_of = {
                        entry.vehicle: entry.processes for entry in message.on_road
                    }
                    self._road_changed = True
            case _:
                pass

    def _on_state(self, state: VehicleState, now_s: float) -> list[LogEntry] | None:
        """Handle the state of a vehicle; return None if nothing depends on it.

        A leader ignores vehicles that its census does not list, for example departed ones.
        """
        if self.election.leading and self._entry_cells.has_entry_of(state):
            return self.operation.on_state(state, now_s)
        return None

    def _on_computed(self, computed: Computed, now_s: float) -> Iterator[Effect]:
        if self.service.owns(computed.job):
            yield from self.service.finish(computed.job, computed.result, computed.error, now_s)
        else:
            yield from self._effects(self.operation.finish(computed, self.t_s, now_s))

    # --- election -----------------------------------------------------------------------------

    def _on_election(self, now_s: float) -> Iterator[Effect]:
        if not self.election.update(now_s):
            return
        self.operation.take_over()
        self._road_changed = True
        self._awake_since_s = now_s
        if self.election.leading:
            yield Listen(STATE)
        else:
            yield Unlisten(STATE)
        self._next_heartbeat_s = now_s
        kind = LEADER_ELECTED if self.election.leading else LEADER_STEPPED_DOWN
        log.info(kind, coordinator=self.name, term=self.election.term)
        yield self._log(kind, term=self.election.term)

    def _periodic_messages(self, now_s: float) -> Iterator[Effect]:
        if now_s >= self._next_heartbeat_s:
            self._next_heartbeat_s = now_s + self.scenario.network.heartbeat_s
            if not self.election.retired:
                yield self._heartbeat()
        if now_s >= self._next_report_s:
            self._next_report_s = now_s + REPORT_S
            yield self._report()

    def _heartbeat(self) -> Effect:
        term, leading = self.election.term, self.election.leading
        message = Heartbeat(self.name, self._incarnation, term, leading, self.operation.in_force)
        return Send(HEARTBEAT, message, {"coordinator": self.name})

    # --- the end ------------------------------------------------------------------------------

    def _retire(self, ends_s: float) -> Iterator[Effect]:
        """Leave leadership and new requests to others; finish the pending requests.

        Without heartbeats and token, the other candidates do not count this one any more.
        """
        self._ends_s = ends_s
        self.election.retired = True
        yield Withdraw(COORDINATOR_ALIVE, self._own)
        yield from self.service.retire()

    def _end(self, now_s: float) -> Iterator[Effect]:
        """End if there is nothing left to finish, or no time for it."""
        if self._ends_s is not None and (self.service.idle or now_s >= self._ends_s):
            yield from self.service.give_up()
            yield self._report()
            yield End()

    # --- leading ------------------------------------------------------------------------------

    def _lead(self, now_s: float) -> Iterator[Effect]:
        if self.election.leading and self.census is not None:
            changed, self._road_changed = self._road_changed, False
            yield from self._effects(
                self.operation.lead(self.census, self.t_s, now_s, changed=changed)
            )

    def _has_watched(self, now_s: float) -> bool:
        """Return whether this leader has handled events without gaps for an election timeout."""
        return now_s >= self._awake_since_s + self.election.election_s

    def _new_ballot(self, above: Ballot | None) -> Ballot:
        self._seq += 1
        ballot = Ballot(self.election.term, self.name, self._incarnation, self._seq)
        if above is not None and ballot < above:
            # Terms can be equal if two candidates did not receive each other's heartbeats. The term
            # of the election stays, since a vehicle may report any term.
            ballot = ballot._replace(term=above.term + 1)
        return ballot

    def _effects(self, outcomes: Iterable[Outcome]) -> Iterator[Effect]:
        """Yield outcomes as effects."""
        for outcome in outcomes:
            match outcome:
                case LogEntry(kind, data):
                    yield self._log(kind, **data)
                case ToVehicle(vehicle, message):
                    topic = PLAN if isinstance(message, Plan) else PREPARE
                    for process in addresses_of(vehicle, self._processes_of.get(vehicle, ())):
                        yield Send(topic, message, {"process": process, "vehicle": vehicle})
                case _:
                    yield outcome

    def _new_job(self) -> int:
        self._last_job += 1
        return self._last_job

    def _log(self, kind: str, **data: object) -> Effect:
        message = LogEvent(Name("coordinator"), self.name, self.t_s, Name(kind), dict(data))
        return Send(EVENT, message, {"role": "coordinator", "name": self.name})

    def _report(self) -> Effect:
        message = Report(Name("coordinator"), self.name)
        return Send(REPORT, message, {"role": "coordinator", "name": self.name})

    def _set_wakeup(self, now_s: float) -> None:
        election = self.election
        times = [self._next_heartbeat_s, self._next_report_s, election.next_change_s(now_s)]
        times += [time_s for time_s in (self.service.wakeup_s, self._ends_s) if time_s is not None]
        if election.leading:
            times += self.operation.wakeups
        else:
            times.append(election.started_s + election.election_s)
        # A time in the past would make the same timer fire forever.
        self._wakeup_s = max(min(time for time in times if time > now_s), now_s + 1e-3)


def _identity(parameters: Mapping[str, str]) -> tuple[str, int]:
    return parameters["coordinator"], incarnation_of(parameters)
