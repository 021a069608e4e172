"""Planted bugs with which neither the scenarios nor the fault search were developed.

They show how well the fault search finds errors that nobody had in mind. Each violates a promise of
docs/SAFETY.md under some schedule of faults that the assumptions allow; some of these schedules are
rare. No scenario is written for them.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Generator, Iterable, Iterator, Mapping, Sequence
from itertools import count

import pytest
from attrs import evolve
from msgspec.structs import replace

from laneweave.agents.core import AgentCore
from laneweave.agents.host import AgentHost
from laneweave.coordinator.ballots import ballot_round as ballots
from laneweave.coordinator.ballots.ballot_round import BallotRound
from laneweave.coordinator.core import CoordinatorCore
from laneweave.coordinator.formations import operation as formations
from laneweave.coordinator.formations.formation_planner import FormationPlanner
from laneweave.coordinator.formations.leader import FormationLeader
from laneweave.coordinator.formations.roster import Formation, Groups, Numbers
from laneweave.coordinator.formations.stages import Stage
from laneweave.coordinator.operation import LogEntry
from laneweave.coordinator.planning.rolling.problem import StreamPlan
from laneweave.coordinator.rolling import operation as rolling
from laneweave.coordinator.rolling import ownership
from laneweave.coordinator.rolling.operation import RollingOperation
from laneweave.coordinator.rolling.ownership import ReplacedBallots, States
from laneweave.coordinator.rolling.transfer import CellTransfer
from laneweave.protocol.lattice import Cell, footprint
from laneweave.protocol.runtime.node import Compute, Computed, Effect, Listen
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.state_machine import Transition
from laneweave.protocol.vehicle import execution_rules as execution
from laneweave.protocol.vehicle.plan_execution import GATE, PlanExecution
from laneweave.protocol.vehicle.plans import Needs
from laneweave.protocol.wire.messages import (
    Ballot,
    Census,
    Command,
    Name,
    PendingTransfer,
    Plan,
    Prepare,
    Sense,
    VehicleState,
)
from laneweave.protocol.wire.topics import PLAN, PREPARE
from laneweave.sim_bridge.bodies import record_store
from laneweave.sim_bridge.bodies.record_store import RecordStore
from laneweave.sim_bridge.road.allocation import CellAllocation
from laneweave.sim_bridge.road.caretakers import Caretaker, Caretakers
from laneweave.sim_bridge.road.census import CensusPublisher
from laneweave.sim_bridge.road.formation_building import GrowingFormations
from laneweave.sim_bridge.road.vehicle import RoadVehicle
from support.broken_rules import dependencies_where
from support.bugs import Bug, breaks
from support.states import set_record

Call = Callable[..., None]
"""A method that is replaced."""

# --- plan execution, agents -------------------------------------------------------------------


@breaks("V1", AgentCore, "_take_over")
def move_of_an_earlier_charge(take_over: Call, self: AgentCore, sense: Sense) -> None:
    """An agent that takes charge again resumes the last move of its earlier time in charge."""
    begun = self._begun
    take_over(self, sense)
    self._begun = begun


def _gate_while_moving(row: Transition) -> Transition:
    if row.event != GATE:
        return row
    return evolve(row, guards=tuple(one for one in row.guards if one is not execution.is_holding))


gate_opens_while_moving = Bug(
    "gate-opens-while-moving",
    "V5",
    "A vehicle whose motion of an older plan is in progress opens its start gate.",
    vehicle_row=_gate_while_moving,
)


@breaks("V2", execution.drop_plan)
def motion_stays_in_plan(me: PlanExecution, _: object) -> None:
    """A promise leaves the motion in progress marked as a move of the plan."""
    me.plan, me.completed, me.needs = None, 0, ()


@breaks("V6", execution, "dependencies")
def dependency_on_last_step_only(_: object, plan: Plan, vehicle: Name) -> tuple[Needs, ...]:
    """A move waits only for interfering moves of the step before it."""
    return dependencies_where(plan, vehicle, footprint, lambda other, own: other == own - 1)


@breaks("V3", execution.is_stored)
def any_stored_acceptance_confirms(me: PlanExecution, ballot: Ballot | None) -> bool:
    """A stored acceptance of an earlier plan confirms the newest one."""
    return me.plan is not None and ballot is not None


@breaks("V2", execution.is_above_promise)
def repeated_prepare_drops_plan(me: PlanExecution, prepare: Prepare) -> bool:
    """A repeated PREPARE of the promised ballot drops its plan."""
    return me.promised is None or prepare.ballot >= me.promised


@breaks("V1", AgentCore, "_take_over")
def restarted_agent_counts_as_holding(take_over: Call, self: AgentCore, sense: Sense) -> None:
    """An agent that takes charge of a moving vehicle assumes that it holds."""
    take_over(self, sense)
    if self.execution is not None:
        self.execution.moving = False


@breaks("C9", AgentHost, "_leave_road", collides=False)
def seen_vehicles_of_the_old_road(
    leave_road: Callable[..., list[Effect]], self: AgentHost
) -> list[Effect]:
    """After a restart of the bridge, a shard makes no agents for names that it saw before."""
    seen = set(self._seen)
    effects = leave_road(self)
    self._seen = seen
    return effects


# --- ballots, election, formations ------------------------------------------------------------


@breaks("L3", CoordinatorCore, "_new_ballot", collides=False)
def ballot_not_above_promises(
    new_ballot: Callable[..., Ballot], self: CoordinatorCore, _: Ballot | None
) -> Ballot:
    """A new ballot is not raised above what the vehicles have promised."""
    return new_ballot(self, None)


@breaks("L7", ballots.has_higher_promise, collides=False)
def outbid_by_term_only(round_: BallotRound, state: VehicleState) -> bool:
    """A higher promise of the same term does not count as outbidding."""
    ballot, promised = round_.ballot, state.record.promised
    return ballot is not None and promised is not None and promised.term > ballot.term


@breaks("joining", Groups, "join", collides=False)
def groups_not_merged(_: object, self: Groups, numbers: Iterable[int]) -> bool:
    """A newly reported group of blocks replaces the known groups instead of being merged."""
    union = tuple(sorted(set(numbers)))
    if not union or self.of(union[0]) == union:
        return False
    self._group |= dict.fromkeys(union, union)
    self.changed = True
    return True


@breaks("census", formations, "closed_formations")
def joined_with_an_open_formation(
    closed_formations: Callable[..., dict[int, Formation]],
    census: Census,
    t_s: float,
    scenario: Scenario,
    groups: Groups,
    stages_of: Callable[[Numbers], Sequence[Stage]] | None = None,
) -> dict[int, Formation]:
    """A joint formation counts as closed once its foremost block is closed."""
    for closed in census.formations:
        groups.join(closed.blocks)
    blocks = {scenario.lattice.block_of(entry.cell[0]) for entry in census.on_road}
    begun = [groups.of(block) for block in blocks if groups.of(block)[0] <= census.closed_to]
    last = max((numbers[-1] for numbers in begun), default=census.closed_to)
    closed_to = max(census.closed_to, last)
    return closed_formations(replace(census, closed_to=closed_to), t_s, scenario, groups, stages_of)


@breaks("L3", formations.FormationsOperation, "_lead_formation", collides=False)
def ballots_numbered_by_formation(
    lead_formation: Callable[..., FormationLeader],
    self: formations.FormationsOperation,
    formation: Formation,
    *times_s: float,
) -> FormationLeader:
    """Each formation of a leader numbers its ballots from 1, also after being joined."""
    shared, numbers = self._new_ballot, count(1)

    def numbered(above: Ballot | None) -> Ballot:
        ballot = shared(None)._replace(seq=next(numbers))
        if above is not None and ballot < above:
            ballot = ballot._replace(term=above.term + 1)
        return ballot

    self._new_ballot = numbered
    try:
        return lead_formation(self, formation, *times_s)
    finally:
        self._new_ballot = shared


@breaks("L5", FormationPlanner, "finish", collides=False)
def dropped_result_blocks_planning(
    finish: Callable[..., Iterator[Compute | LogEntry]],
    self: FormationPlanner,
    computed: Computed,
    *times_s: float,
) -> Iterator[Compute | LogEntry]:
    """A result that is no longer needed leaves its computation marked as running."""
    under_way = self._under_way
    if under_way is None or self._wanted(*under_way[1:]):
        yield from finish(self, computed, *times_s)


# --- the rolling operation --------------------------------------------------------------------


@breaks("transfer", ownership, "_sign")
def acceptance_closes_transfer(
    sign: Callable[..., ownership._Sign], state: VehicleState | None, pending: PendingTransfer
) -> ownership._Sign:
    """Leaders count a vehicle that has accepted a ballot as one that has left it closed."""
    found = sign(state, pending)
    if found is not ownership._Sign.NONE or state is None:
        return found
    record = state.record
    if record.promised != pending.ballot or not record.owned:
        return found
    known = record.transfer is not None and record.transfer.ballot == pending.ballot
    return ownership._Sign.CLOSED if known else ownership._Sign.NEVER_READY


@breaks("transfer")
def newer_transfer_cancels_older(patch: pytest.MonkeyPatch) -> None:
    """Leaders conclude from a member's newer transfer that the older one never opened."""
    owned_cells = ownership.owned_cells

    def mutant(
        state: VehicleState, states: States, gone: Collection[Name] = ()
    ) -> frozenset[Cell] | None:
        pending = state.record.transfer
        if pending is not None and not pending.open:
            signs = ownership._signs(state, pending, states, gone)
            if ownership._Sign.NEWER in signs and ownership._Sign.OPEN not in signs:
                return frozenset(pending.before)
        return owned_cells(state, states, gone)

    patch.setattr(ownership, "owned_cells", mutant)


@breaks("transfer", ownership, "_signs")
def departed_member_ignored(
    signs: Callable[..., set[ownership._Sign]], *given: object
) -> set[ownership._Sign]:
    """Leaders treat a transfer as closed although a departed member may have opened it."""
    return signs(*given) - {ownership._Sign.GONE}


@breaks("transfer", RollingOperation, "_with_partners", collides=False)
def partners_not_asked(_: object, __: RollingOperation, names: Iterable[Name]) -> set[Name]:
    """The roster lacks the vehicles whose promises determine what a member owns."""
    return set(names)


@breaks("transfer", CellTransfer, "_awaits_replaced", collides=False)
def replaced_ballots_not_awaited(*_: object) -> bool:
    """A new plan for a slot is made before it is known who owns the cells of a replaced one."""
    return False


@breaks("transfer", ReplacedBallots, "on_state", collides=False)
def evidence_is_not_kept(*_: object) -> None:
    """Leaders forget what a vehicle has shown about a replaced ballot when it has a newer one."""


@breaks("transfer", ownership, "owned_cells")
def unknown_cells_guessed(
    owned_cells: Callable[..., frozenset[Cell] | None], state: VehicleState, *more: object
) -> frozenset[Cell]:
    """A vehicle whose cells are not known is planned with those that its controller stores."""
    return owned_cells(state, *more) or frozenset(state.record.owned)


@breaks("L5", RollingOperation, "finish", collides=False)
def late_plan_blocks_planning(
    finish: Callable[..., Iterator[LogEntry]],
    self: RollingOperation,
    computed: Computed,
    t_s: float,
    now_s: float,
) -> Iterator[LogEntry]:
    """A late or failed plan leaves its computation marked as running."""
    ordered = self._ordered
    yield from finish(self, computed, t_s, now_s)
    if ordered is None or computed.job != ordered[0]:
        return
    late = t_s > ordered[1] * self._slot_s + rolling.MAX_DELAY_S
    if late or not isinstance(computed.result, StreamPlan):
        self._ordered = ordered


@breaks("ownership", RecordStore, "begin_transfer")
def assigned_cells_kept(_: object, self: RecordStore, pending: PendingTransfer) -> None:
    """A vehicle that gives away a cell assigned by the roadside keeps it."""
    stored, promised = self.record.transfer, self.record.promised
    newer = stored is None or pending.ballot > stored.ballot
    if newer and promised is not None and pending.ballot >= promised:
        _store(self, pending, pending.after)


def _store(store: RecordStore, pending: PendingTransfer, cells: tuple[Cell, ...]) -> None:
    """Store a transfer; some cells no longer count as assigned by the roadside."""
    store._granted -= set(cells)
    begun = record_store._with_cells(pending, store._granted)
    set_record(store, transfer=begun, owned=begun.before)


# --- the motion controller, caretakers --------------------------------------------------------


@breaks("ownership", RecordStore, "complete_transfer")
def any_transfer_opened(complete_transfer: Call, self: RecordStore, ballot: Ballot) -> None:
    """An open gate of an older ballot opens the newest transfer."""
    stored = self.record.transfer
    complete_transfer(self, ballot if stored is None else stored.ballot)


@breaks("ownership", RecordStore, "begin_transfer")
def late_command_closes_transfer(_: object, self: RecordStore, pending: PendingTransfer) -> None:
    """A late COMMAND closes a transfer of the same ballot that is open."""
    stored, promised = self.record.transfer, self.record.promised
    newer = stored is None or pending.ballot >= stored.ballot
    if newer and promised is not None and pending.ballot >= promised:
        _store(self, pending, pending.before)


@breaks("joining", RecordStore, "join")
def joined_blocks_replaced(_: object, self: RecordStore, blocks: Iterable[int]) -> None:
    """A late COMMAND with fewer joined blocks removes the others."""
    set_record(self, joined=tuple(sorted(set(blocks))))


@breaks("caretaker", Caretakers, "take_charge", collides=False)
def caretaker_below_agent(
    _: object, self: Caretakers, vehicle: RoadVehicle, tick: int
) -> Iterator[Effect]:
    """A caretaker's incarnation is taken from the clock, even if the agent's is higher."""
    self._caretakers[vehicle.name] = Caretaker(vehicle, self._new_incarnation(), tick)
    yield Listen(PREPARE, {"vehicle": vehicle.name})
    yield Listen(PLAN, {"vehicle": vehicle.name})


@breaks("charge", Caretakers, "accept_command", collides=False)
def claim_is_no_presence(
    _: object, self: Caretakers, vehicle: RoadVehicle, command: Command
) -> Generator[Effect, None, bool]:
    """An agent that claims its vehicle counts as absent until its token appears."""
    controller = vehicle.controller
    in_charge = controller.record.incarnation
    if not controller.accept_command(command):
        return False
    self.answers.in_time(vehicle.name)
    if controller.record.incarnation != in_charge:
        yield from self._end_caretaker(vehicle.name)
    return True


# --- the road ---------------------------------------------------------------------------------


@breaks("ownership", CellAllocation, "assign_empty_cells")
def waiting_cell_assigned_again(
    assign: Call, self: CellAllocation, vehicles: Mapping[Name, RoadVehicle], closed: Sequence[int]
) -> None:
    """An empty cell that waited for a vehicle is assigned again at each tick."""
    waiting = dict(self._unassigned)
    assign(self, vehicles, closed)
    self._unassigned = waiting | self._unassigned


@breaks("census", CensusPublisher, "census", collides=False)
def formation_listed_by_block(
    make: Callable[..., Census], self: CensusPublisher, t_s: float, on_road: Iterable[RoadVehicle]
) -> Census:
    """The census lists a formation only while a vehicle of its foremost block is on the road."""
    vehicles = tuple(on_road)
    present = {vehicle.block for vehicle in vehicles}
    self._closed = [closed for closed in self._closed if closed.first_block in present]
    return make(self, t_s, vehicles)


@breaks("census", GrowingFormations, "_complete_open")
def formations_overlap(
    complete: Call, self: GrowingFormations, last_column: int, t_s: float
) -> None:
    """A formation begins behind the last vehicle, not the last column, of the one before it."""
    rear = None if self._open is None else self._open.rear
    complete(self, last_column, t_s)
    if rear is not None:
        self.first_open_column = rear - 1


@breaks("C9", CoordinatorCore, "_forget_road", collides=False)
def census_of_the_old_road(forget_road: Call, self: CoordinatorCore) -> None:
    """After a restart of the bridge, a coordinator keeps the last census of the old road."""
    census = self.census
    forget_road(self)
    self.census = census


UNSEEN: tuple[Bug, ...] = tuple(one for one in [*vars().values()] if isinstance(one, Bug))
