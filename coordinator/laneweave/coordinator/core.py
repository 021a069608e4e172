"""The coordinator's core: one candidate that, when elected, leads all formations on the road."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from functools import partial

import structlog

from laneweave.coordinator.election import Election
from laneweave.coordinator.formation import (
    Formation,
    closed_formations,
    plan_request,
    start_time_s,
    steps_left,
)
from laneweave.coordinator.leader import FormationControl, Phase
from laneweave.coordinator.planning import PlanRequest, PlanResponse, Weights, checked_plan
from laneweave.coordinator.service import PlanningService
from laneweave.protocol.lattice import Move, territory
from laneweave.protocol.messages import (
    Ballot,
    Census,
    Heartbeat,
    LogEvent,
    Name,
    Plan,
    Report,
    RoadClock,
    VehicleState,
)
from laneweave.protocol.node import (
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
from laneweave.protocol.plans import plan_problems
from laneweave.protocol.scenario import Scenario
from laneweave.protocol.topics import (
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
from laneweave.protocol.transport import LinkDown, LinkUp

log = structlog.get_logger(__name__)

REPORT_S = 2.0
START_MARGIN_S = 0.5
"""A plan made late starts this much road time after it is ready."""


class CoordinatorCore:
    """State machine of a coordinator; see `Core` for how it is driven."""

    def __init__(self, name: Name, incarnation: int, scenario: Scenario) -> None:
        """Make a candidate that has seen nothing yet."""
        self.name = name
        self.scenario = scenario
        self.election = Election(name, incarnation, scenario.network.election_s, 0.0)
        self.controls: dict[int, FormationControl] = {}
        self.census: Census | None = None
        self.t_s = 0.0
        self._incarnation = incarnation
        self._seq = 0
        self._rng = random.Random(f"{scenario.seed}/{name}/{incarnation}")  # noqa: S311
        self._service = PlanningService()
        formation = scenario.formation
        oblique = formation.weight_oblique
        self._weights = Weights(
            formation.weight_straight, formation.oblique_steps if oblique is None else oblique
        )
        self._planning: dict[int, tuple[int, Ballot]] = {}
        self._next_job = 0
        self._bridge = -1
        """Incarnation of the newest bridge."""
        self._road_changed = True
        self._heartbeat_s = 0.0
        self._report_s = 0.0
        self._wakeup_s: float | None = None

    @property
    def wakeup_s(self) -> float | None:
        """Next heartbeat, election, or formation timer."""
        return self._wakeup_s

    def handle(self, event: Event, now_s: float) -> list[Effect]:
        """Take an event; see `Core`."""
        effects = list(self._on_event(event, now_s))
        if not isinstance(event, Stopping):
            effects += self._on_election(now_s)
            effects += self._lead(now_s)
            effects += self._heartbeat(now_s)
            self._plan_wakeup(now_s)
        return effects

    # --- inputs -------------------------------------------------------------------------------

    def _on_event(self, event: Event, now_s: float) -> Iterator[Effect]:
        match event:
            case Started():
                yield from self._start(now_s)
            case Arrived(_, _, message):
                self._on_message(message, now_s)
            case PeerUp(topic, parameters) if topic is COORDINATOR_ALIVE:
                self._meet_candidate(*_identity(parameters), now_s)
            case PeerDown(topic, parameters) if topic is COORDINATOR_ALIVE:
                self.election.on_token_down(*_identity(parameters))
            case PeerUp(topic, parameters) if topic is BRIDGE_ALIVE:
                self._meet_bridge(incarnation_of(parameters))
            case LinkUp():
                self.election.on_link(up=True, now_s=now_s)
            case LinkDown():
                self.election.on_link(up=False, now_s=now_s)
            case Asked(token, payload):
                yield from self._service.take(token, payload, self._job())
            case Computed(job, result, error):
                yield from self._on_computed(job, result, error, now_s)
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
            self.t_s = 0.0
            self.controls = {}
            self._planning = {}

    def _on_message(self, message: object, now_s: float) -> None:
        match message:
            case Heartbeat():
                self.election.on_heartbeat(message, now_s)
            case RoadClock():
                self.t_s = max(self.t_s, message.t_s)
                self._road_changed = True
            case Census():
                if self.census is None or message.t_s >= self.census.t_s:
                    self.census = message
                    self.t_s = max(self.t_s, message.t_s)
                    self._road_changed = True
            case VehicleState() if self.election.leading:
                control = self.controls.get(message.formation)
                if control is not None:
                    control.on_state(message, now_s)
            case _:
                pass

    # --- election -----------------------------------------------------------------------------

    def _on_election(self, now_s: float) -> Iterator[Effect]:
        if not self.election.update(now_s):
            return
        self.controls = {}
        self._planning = {}
        self._road_changed = True
        if self.election.leading:
            yield Listen(STATE)
        else:
            yield Unlisten(STATE)
        self._heartbeat_s = now_s
        kind = "leader-elected" if self.election.leading else "leader-stepped-down"
        log.info(kind, coordinator=self.name, term=self.election.term)
        yield self._log(kind, term=self.election.term)

    def _heartbeat(self, now_s: float) -> Iterator[Effect]:
        if now_s >= self._heartbeat_s:
            self._heartbeat_s = now_s + self.scenario.network.heartbeat_s
            in_force = sum(control.phase is Phase.WATCHING for control in self.controls.values())
            election = self.election
            yield Send(
                HEARTBEAT,
                Heartbeat(self.name, self._incarnation, election.term, election.leading, in_force),
                {"coordinator": self.name},
            )
        if now_s >= self._report_s:
            self._report_s = now_s + REPORT_S
            yield self._report()

    # --- leading ------------------------------------------------------------------------------

    def _lead(self, now_s: float) -> Iterator[Effect]:
        if not self.election.leading or self.census is None:
            return
        if self._road_changed:
            self._road_changed = False
            self._update_members(self.census, now_s)
        for number, control in self.controls.items():
            if control.wakeup_s is None or control.wakeup_s > now_s:
                continue
            control.on_time(now_s)
            if control.take_planning_order(now_s):
                yield from self._order_plan(number, control)
            for vehicle, message in control.outgoing(now_s):
                topic = PLAN if isinstance(message, Plan) else PREPARE
                yield Send(topic, message, {"vehicle": vehicle})

    def _update_members(self, census: Census, now_s: float) -> None:
        formations = closed_formations(census, self.t_s, self.scenario)
        for number, formation in formations.items():
            control = self.controls.get(number)
            if control is None:
                self.controls[number] = self._take_over(formation, now_s)
            else:
                control.on_members(formation, now_s)
        for number in set(self.controls) - set(formations):
            del self.controls[number]

    def _take_over(self, formation: Formation, now_s: float) -> FormationControl:
        control = FormationControl(
            formation, self._new_ballot, self._rng, self.scenario.network.resend_s
        )
        control.begin(now_s)
        return control

    def _new_ballot(self, above: Ballot | None) -> Ballot:
        self._seq += 1
        ballot = Ballot(self.election.term, self.name, self._incarnation, self._seq)
        if above is not None and ballot < above:
            # Equal terms happen, too: two candidates that did not hear each other take the same.
            self.election.raise_term(above.term)
            ballot = ballot._replace(term=self.election.term)
        return ballot

    def _order_plan(self, number: int, control: FormationControl) -> Iterator[Effect]:
        if steps_left(number, self._start_s(number), self.scenario) == 0 or control.ballot is None:
            control.settle()
            yield self._log("formation-too-late", formation=number)
            return
        # In the job: promises that cannot be planned from fail there, as any failed planning does.
        make_request = partial(
            plan_request,
            number,
            control.hold_cells,
            {member.vehicle: member.preferred_lane for member in control.formation.members},
            self.scenario,
        )
        job = self._job()
        self._planning[job] = (number, control.ballot)
        nodes = self.scenario.formation.max_nodes * 2**control.failures
        yield Compute(job, partial(_plan, make_request, nodes, self._weights))

    def _on_computed(self, job: int, result: object, error: str, now_s: float) -> Iterator[Effect]:
        if self._service.owns(job):
            yield from self._service.finish(job, result, error)
            return
        if job not in self._planning:
            return
        number, ballot = self._planning.pop(job)
        control = self.controls.get(number)
        if control is None or control.ballot != ballot or control.phase is not Phase.PLANNING:
            return
        if isinstance(result, PlanResponse) and result.paths:
            issued = self._plan_message(number, control, result)
            problems = plan_problems(issued)
            if not problems:
                control.on_plan(issued, now_s)
                yield self._log_plan(number, result)
                return
            error = "; ".join(problems)
        status = result.status if isinstance(result, PlanResponse) else "error"
        control.on_planning_failed(now_s)
        yield self._log("planning-failed", formation=number, status=status, error=error)

    def _plan_message(self, number: int, control: FormationControl, response: PlanResponse) -> Plan:
        first = self.scenario.lattice.block_range(number)[0]
        hold_cells = control.hold_cells
        moves: dict[Name, tuple[Move, ...]] = {}
        for vehicle, path in zip(hold_cells, response.paths, strict=True):
            cells = [(column + first, lane) for column, lane in path]
            moves[vehicle] = tuple(
                (step, cells[step], cells[step + 1])
                for step in range(len(cells) - 1)
                if cells[step] != cells[step + 1]
            )
        assert control.ballot is not None  # noqa: S101 (set before planning begins)
        all_moves = [move for each in moves.values() for move in each]
        return Plan(
            ballot=control.ballot,
            formation=number,
            roster=tuple(hold_cells),
            incarnations=control.incarnations,
            start_cells=hold_cells,
            moves=moves,
            t0_s=self._start_s(number),
            slot_s=self.scenario.formation.cycle_s,
            territory=tuple(sorted(territory(hold_cells.values(), all_moves))),
        )

    def _start_s(self, number: int) -> float:
        return start_time_s(number, self.t_s + START_MARGIN_S, self.scenario)

    # --- small things -------------------------------------------------------------------------

    def _job(self) -> int:
        self._next_job += 1
        return self._next_job

    def _log(self, kind: str, **data: object) -> Effect:
        message = LogEvent(Name("coordinator"), self.name, self.t_s, Name(kind), dict(data))
        return Send(EVENT, message, {"role": "coordinator", "name": self.name})

    def _log_plan(self, number: int, response: PlanResponse) -> Effect:
        return self._log(
            "plan-made",
            formation=number,
            vehicles=len(response.paths),
            status=response.status,
            cost=response.cost,
            lower_bound=response.lower_bound,
            steps=response.steps,
            solve_ms=response.solve_ms,
            assignments_tried=response.assignments_tried,
            nodes_expanded=response.nodes_expanded,
        )

    def _report(self) -> Effect:
        message = Report(Name("coordinator"), self.name)
        return Send(REPORT, message, {"role": "coordinator", "name": self.name})

    def _plan_wakeup(self, now_s: float) -> None:
        times = [self._heartbeat_s, self._report_s, self.election.next_change_s()]
        if not self.election.leading:
            times.append(self.election.started_s + self.election.election_s)
        else:
            times += [
                control.wakeup_s
                for control in self.controls.values()
                if control.wakeup_s is not None
            ]
        # Never ask for a moment that has passed: the same timer would fire for ever.
        self._wakeup_s = max(min(time for time in times if time > now_s), now_s + 1e-3)


def _plan(make_request: Callable[[], PlanRequest], nodes: int, weights: Weights) -> PlanResponse:
    return checked_plan(make_request(), max_nodes=nodes, weights=weights)


def _identity(parameters: dict[str, str]) -> tuple[str, int]:
    return parameters["coordinator"], incarnation_of(parameters)
