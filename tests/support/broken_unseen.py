"""Broken guards, actions and methods for the bugs in `unseen_bugs`."""

from __future__ import annotations

from collections.abc import Callable, Collection, Generator, Iterable, Iterator, Mapping, Sequence
from itertools import count

import pytest
from attrs import evolve
from msgspec.structs import replace

from laneweave.agents.core import AgentCore
from laneweave.agents.host import AgentHost
from laneweave.coordinator.ballots.ballot_round import BallotRound
from laneweave.coordinator.core import CoordinatorCore
from laneweave.coordinator.formations import operation as formations
from laneweave.coordinator.formations.leader import FormationLeader
from laneweave.coordinator.formations.planning_orders import FormationPlanner
from laneweave.coordinator.formations.roster import Formation, Groups, closed_formations
from laneweave.coordinator.operation import LogEntry
from laneweave.coordinator.planning.rolling.problem import StreamPlan
from laneweave.coordinator.rolling import operation as rolling
from laneweave.coordinator.rolling import ownership, transfer
from laneweave.coordinator.rolling.operation import RollingOperation
from laneweave.coordinator.rolling.ownership import States
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
from laneweave.sim_bridge.road.attendance import Attendance, Caretaker
from laneweave.sim_bridge.road.census import CensusPublisher
from laneweave.sim_bridge.road.formation_building import GrowingFormations
from laneweave.sim_bridge.road.vehicle import RoadVehicle
from support.states import set_record

Patch = pytest.MonkeyPatch


# --- plan execution ---------------------------------------------------------------------------


def gate_while_moving(row: Transition) -> Transition:
    if row.event != GATE:
        return row
    return evolve(row, guards=tuple(one for one in row.guards if one is not execution.is_holding))


def drop_plan_only(me: PlanExecution, _: object) -> None:
    me.plan, me.completed, me.needs = None, 0, ()


def is_at_least_promise(me: PlanExecution, prepare: Prepare) -> bool:
    return me.promised is None or prepare.ballot >= me.promised


def any_acceptance_is_stored(me: PlanExecution, ballot: Ballot | None) -> bool:
    return me.plan is not None and ballot is not None


def wait_for_previous_step(patch: Patch) -> None:
    patch.setattr(execution, "dependencies", on_previous_step)


def on_previous_step(plan: Plan, vehicle: Name) -> tuple[Needs, ...]:
    def needs(step: int, cells: frozenset[Cell]) -> Needs:
        return {
            other: index + 1
            for other, moves in plan.moves.items()
            for index, (other_step, origin, target) in enumerate(moves)
            if other != vehicle and other_step == step - 1 and cells & footprint(origin, target)
        }

    return tuple(
        needs(step, footprint(origin, target)) for step, origin, target in plan.moves[vehicle]
    )


# --- agents -----------------------------------------------------------------------------------


def keep_move(patch: Patch) -> None:
    take_over = AgentCore._take_over

    def mutant(self: AgentCore, sense: Sense) -> None:
        move = self._move
        take_over(self, sense)
        self._move = move

    patch.setattr(AgentCore, "_take_over", mutant)


def take_over_at_rest(patch: Patch) -> None:
    take_over = AgentCore._take_over

    def mutant(self: AgentCore, sense: Sense) -> None:
        take_over(self, sense)
        if self.execution is not None:
            self.execution.moving = False

    patch.setattr(AgentCore, "_take_over", mutant)


def remember_seen_vehicles(patch: Patch) -> None:
    leave_road = AgentHost._leave_road

    def mutant(self: AgentHost) -> list[Effect]:
        seen = set(self._seen)
        effects = leave_road(self)
        self._seen = seen
        return effects

    patch.setattr(AgentHost, "_leave_road", mutant)


# --- ballots, election, formations ------------------------------------------------------------


def ignore_promises(patch: Patch) -> None:
    new_ballot = CoordinatorCore._new_ballot

    def mutant(self: CoordinatorCore, above: Ballot | None) -> Ballot:
        del above
        return new_ballot(self, None)

    patch.setattr(CoordinatorCore, "_new_ballot", mutant)


def has_higher_term(round_: BallotRound, state: VehicleState) -> bool:
    ballot = round_.ballot
    return (
        ballot is not None
        and state.record.promised is not None
        and state.record.promised.term > ballot.term
    )


def join_directly(patch: Patch) -> None:
    def mutant(self: Groups, numbers: Iterable[int]) -> bool:
        union = tuple(sorted(set(numbers)))
        if not union or self.of(union[0]) == union:
            return False
        self._group |= dict.fromkeys(union, union)
        self.changed = True
        return True

    patch.setattr(Groups, "join", mutant)


def compare_foremost_block(patch: Patch) -> None:
    def mutant(
        census: Census, t_s: float, scenario: Scenario, groups: Groups
    ) -> dict[int, Formation]:
        for closed in census.formations:
            groups.join(closed.blocks)
        blocks = {scenario.lattice.block_of(entry.cell[0]) for entry in census.on_road}
        begun = [groups.of(block) for block in blocks if groups.of(block)[0] <= census.closed_to]
        last = max((numbers[-1] for numbers in begun), default=census.closed_to)
        closed_to = max(census.closed_to, last)
        return closed_formations(replace(census, closed_to=closed_to), t_s, scenario, groups)

    patch.setattr(formations, "closed_formations", mutant)


def number_ballots_by_formation(patch: Patch) -> None:
    lead_formation = formations.FormationsOperation._lead_formation

    def mutant(
        self: formations.FormationsOperation, formation: Formation, t_s: float, now_s: float
    ) -> FormationLeader:
        shared = self._new_ballot
        self._new_ballot = _numbered(shared)
        try:
            return lead_formation(self, formation, t_s, now_s)
        finally:
            self._new_ballot = shared

    patch.setattr(formations.FormationsOperation, "_lead_formation", mutant)


def _numbered(new_ballot: Callable[[Ballot | None], Ballot]) -> Callable[[Ballot | None], Ballot]:
    numbers = count(1)

    def numbered(above: Ballot | None) -> Ballot:
        ballot = new_ballot(None)._replace(seq=next(numbers))
        if above is not None and ballot < above:
            ballot = ballot._replace(term=above.term + 1)
        return ballot

    return numbered


def keep_dropped_computation(patch: Patch) -> None:
    finish = FormationPlanner.finish

    def mutant(
        self: FormationPlanner, computed: Computed, t_s: float, now_s: float
    ) -> Iterator[Compute | LogEntry]:
        under_way = self._under_way
        if under_way is not None and not self._wanted(*under_way[1:]):
            return
        yield from finish(self, computed, t_s, now_s)

    patch.setattr(FormationPlanner, "finish", mutant)


def keep_census(patch: Patch) -> None:
    forget_road = CoordinatorCore._forget_road

    def mutant(self: CoordinatorCore) -> None:
        census = self.census
        forget_road(self)
        self.census = census

    patch.setattr(CoordinatorCore, "_forget_road", mutant)


# --- the rolling operation --------------------------------------------------------------------


def close_on_equal_promise(patch: Patch) -> None:
    sign = ownership._sign

    def mutant(state: VehicleState | None, pending: PendingTransfer) -> ownership._Sign:
        found = sign(state, pending)
        accepted = (
            state is not None and state.record.promised == pending.ballot and state.record.owned
        )
        if found is ownership._Sign.NONE and state is not None and accepted:
            known = (
                state.record.transfer is not None and state.record.transfer.ballot == pending.ballot
            )
            return ownership._Sign.CLOSED if known else ownership._Sign.NEVER_READY
        return found

    patch.setattr(ownership, "_sign", mutant)


def cancel_on_newer_transfer(patch: Patch) -> None:
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

    for module in (ownership, transfer):
        patch.setattr(module, "owned_cells", mutant)


def forget_departed_members(patch: Patch) -> None:
    signs = ownership._signs

    def mutant(
        state: VehicleState, pending: PendingTransfer, states: States, gone: Collection[Name]
    ) -> set[ownership._Sign]:
        return signs(state, pending, states, gone) - {ownership._Sign.GONE}

    patch.setattr(ownership, "_signs", mutant)


def leave_partners_out(patch: Patch) -> None:
    patch.setattr(rolling.RollingOperation, "_with_partners", lambda _, names: set(names))


def guess_unknown_cells(patch: Patch) -> None:
    owned_cells = ownership.owned_cells

    def mutant(
        state: VehicleState, states: States, gone: Collection[Name] = ()
    ) -> frozenset[Cell] | None:
        return owned_cells(state, states, gone) or frozenset(state.record.owned)

    patch.setattr(transfer, "owned_cells", mutant)


def keep_late_order(patch: Patch) -> None:
    finish = RollingOperation.finish

    def mutant(
        self: RollingOperation, computed: Computed, t_s: float, now_s: float
    ) -> Iterator[LogEntry]:
        ordered = self._ordered
        yield from finish(self, computed, t_s, now_s)
        if ordered is None or computed.job != ordered[0]:
            return
        late = t_s > ordered[1] * self._slot_s + rolling.MAX_DELAY_S
        if late or not isinstance(computed.result, StreamPlan):
            self._ordered = ordered

    patch.setattr(RollingOperation, "finish", mutant)


# --- the motion controller --------------------------------------------------------------------


def keep_assigned_cells(patch: Patch) -> None:
    def mutant(self: RecordStore, pending: PendingTransfer) -> None:
        stored, promised = self.record.transfer, self.record.promised
        newer = stored is None or pending.ballot > stored.ballot
        if newer and promised is not None and pending.ballot >= promised:
            self._granted -= set(pending.after)
            begun = record_store._with_cells(pending, self._granted)
            set_record(self, transfer=begun, owned=begun.before)

    patch.setattr(RecordStore, "begin_transfer", mutant)


def store_same_transfer_again(patch: Patch) -> None:
    def mutant(self: RecordStore, pending: PendingTransfer) -> None:
        stored, promised = self.record.transfer, self.record.promised
        newer = stored is None or pending.ballot >= stored.ballot
        if newer and promised is not None and pending.ballot >= promised:
            self._granted -= set(pending.before)
            begun = record_store._with_cells(pending, self._granted)
            set_record(self, transfer=begun, owned=begun.before)

    patch.setattr(RecordStore, "begin_transfer", mutant)


def open_any_transfer(patch: Patch) -> None:
    complete_transfer = RecordStore.complete_transfer

    def mutant(self: RecordStore, ballot: Ballot) -> None:
        stored = self.record.transfer
        complete_transfer(self, ballot if stored is None else stored.ballot)

    patch.setattr(RecordStore, "complete_transfer", mutant)


def replace_joined_blocks(patch: Patch) -> None:
    def mutant(self: RecordStore, blocks: Iterable[int]) -> None:
        set_record(self, joined=tuple(sorted(set(blocks))))

    patch.setattr(RecordStore, "join", mutant)


# --- attendance -------------------------------------------------------------------------------


def take_charge_by_the_clock(patch: Patch) -> None:
    def mutant(self: Attendance, vehicle: RoadVehicle, tick: int) -> Iterator[Effect]:
        self._caretakers[vehicle.name] = Caretaker(vehicle, self._new_incarnation(), tick)
        yield Listen(PREPARE, {"vehicle": vehicle.name})
        yield Listen(PLAN, {"vehicle": vehicle.name})

    patch.setattr(Attendance, "take_charge", mutant)


def await_token(patch: Patch) -> None:
    def mutant(
        self: Attendance, vehicle: RoadVehicle, command: Command
    ) -> Generator[Effect, None, bool]:
        controller = vehicle.controller
        attendant = controller.record.incarnation
        if not controller.accept_command(command):
            return False
        self.answers.in_time(vehicle.name)
        if controller.record.incarnation != attendant:
            yield from self._end_caretaker(vehicle.name)
        return True

    patch.setattr(Attendance, "accept_command", mutant)


# --- the road ---------------------------------------------------------------------------------


def keep_waiting_cells(patch: Patch) -> None:
    assign_empty_cells = CellAllocation.assign_empty_cells

    def mutant(
        self: CellAllocation, vehicles: Mapping[Name, RoadVehicle], closed: Sequence[int]
    ) -> None:
        waiting = list(self._unassigned)
        assign_empty_cells(self, vehicles, closed)
        self._unassigned = [*waiting, *(one for one in self._unassigned if one not in waiting)]

    patch.setattr(CellAllocation, "assign_empty_cells", mutant)


def list_by_block(patch: Patch) -> None:
    make = CensusPublisher.census

    def mutant(self: CensusPublisher, t_s: float, on_road: Iterable[RoadVehicle]) -> Census:
        vehicles = tuple(on_road)
        present = {vehicle.block for vehicle in vehicles}
        self._closed = [closed for closed in self._closed if closed.first_block in present]
        return make(self, t_s, vehicles)

    patch.setattr(CensusPublisher, "census", mutant)


def begin_behind_last_vehicle(patch: Patch) -> None:
    complete = GrowingFormations._complete_open

    def mutant(self: GrowingFormations, last_column: int, t_s: float) -> None:
        rear = None if self._open is None else self._open.rear
        complete(self, last_column, t_s)
        if rear is not None:
            self.first_open_column = rear - 1

    patch.setattr(GrowingFormations, "_complete_open", mutant)
