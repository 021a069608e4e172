"""Broken guards, actions and methods for the bugs in `planted_bugs`."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence

import pytest
from attrs import evolve
from msgspec.structs import replace

from laneweave.agents.core import AgentCore
from laneweave.coordinator.ballots.ballot_round import BallotPhase
from laneweave.coordinator.core import CoordinatorCore
from laneweave.coordinator.election import Election
from laneweave.coordinator.formations import operation
from laneweave.coordinator.formations.leader import FormationLeader
from laneweave.coordinator.formations.roster import Formation, Groups, Numbers
from laneweave.coordinator.formations.stages import Stage
from laneweave.coordinator.rolling import ownership, transfer
from laneweave.coordinator.rolling.ownership import States
from laneweave.coordinator.rolling.transfer import CellTransfer
from laneweave.launch.fault_search.road.drawn_entrance import DrawnBlocks
from laneweave.protocol.lattice import Cell
from laneweave.protocol.runtime.node import Effect
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.state_machine import Transition
from laneweave.protocol.vehicle import execution_rules as execution
from laneweave.protocol.vehicle import territory
from laneweave.protocol.vehicle.plan_execution import PLAN, ExecutionPhase, PlanExecution
from laneweave.protocol.vehicle.plans import Needs, dependencies
from laneweave.protocol.wire.messages import (
    Ballot,
    Census,
    ClosedFormation,
    Command,
    Heartbeat,
    Name,
    PendingTransfer,
    Plan,
    Prepare,
    Sense,
    VehicleState,
)
from laneweave.sim_bridge.bodies.motion_controller import MotionController
from laneweave.sim_bridge.bodies.record_store import RecordStore
from laneweave.sim_bridge.road.caretakers import Caretaker, Caretakers
from laneweave.sim_bridge.road.formation_building import ColumnBlocks
from laneweave.sim_bridge.road.vehicle import RoadVehicle
from support.bugs import Plant, instead_of
from support.states import changed, set_record

Patch = pytest.MonkeyPatch
Call = Callable[..., None]
"""A method that is replaced."""
Dependencies = Callable[..., tuple[Needs, ...]]
OwnedCells = Callable[..., frozenset[Cell] | None]

LEASE_S = 2.0
FAR_BEHIND = 2**31
"""A block beyond those of any run."""
EARLY_S = 4.0
"""About as long as a block of columns takes to enter."""


def always(*_: object) -> bool:
    """Do not check."""
    return True


def never(*_: object) -> bool:
    """Check and refuse."""
    return False


def skip(*_: object, **__: object) -> None:
    """Do not act."""


# --- a vehicle --------------------------------------------------------------------------------


def plan_in_any_phase(row: Transition) -> Transition:
    return evolve(row, sources=tuple(ExecutionPhase)) if row.event == PLAN else row


def accept_anew(me: PlanExecution, plan: Plan) -> None:
    me.promised, me.plan, me.completed = plan.ballot, plan, 0
    me.needs = dependencies(plan, me.vehicle)


def keep_count(me: PlanExecution, _: object) -> None:
    me.plan, me.needs, me.moving_in_plan = None, (), False


def plans_for_some_of_its_blocks(me: PlanExecution, plan: Plan) -> bool:
    return set(plan.blocks) <= set(me.stored.joined)


def promise_without_joining(me: PlanExecution, prepare: Prepare) -> None:
    me.promised = prepare.ballot


def is_member(me: PlanExecution, state: VehicleState) -> bool:
    return me.plan is not None and state.vehicle in me.plan.moves and state.vehicle != me.vehicle


def promised_my_ballot(me: PlanExecution, state: VehicleState) -> bool:
    return is_member(me, state) and me.plan is not None and state.record.promised == me.plan.ballot


def accepted_anything(me: PlanExecution, state: VehicleState) -> bool:
    return is_member(me, state) and state.accepted


def accepted_mine_or_goes(me: PlanExecution, state: VehicleState) -> bool:
    return accepted_anything(me, state) and (promised_my_ballot(me, state) or state.go)


def accepted_mine_or_newer(me: PlanExecution, state: VehicleState) -> bool:
    plan = me.plan
    return (
        plan is not None
        and accepted_anything(me, state)
        and state.record.promised is not None
        and state.record.promised >= plan.ballot
    )


def hear_any_state(me: PlanExecution, state: VehicleState) -> None:
    me.progress[state.vehicle] = max(me.progress.get(state.vehicle, -1), state.completed)


def hear_moves_under_way(me: PlanExecution, state: VehicleState) -> None:
    if state.ready:
        shown = state.completed + state.moving
        me.progress[state.vehicle] = max(me.progress.get(state.vehicle, -1), shown)


def ready_with_plan(patch: Patch) -> None:
    patch.setattr(PlanExecution, "ready", property(lambda me: me.plan is not None))


def all_but_one_are_ready(me: PlanExecution, _: object) -> bool:
    roster = me.plan.roster if me.plan is not None else ()
    ready = sum(me.progress.get(other, -1) >= 0 for other in roster if other != me.vehicle)
    return ready >= len(roster) - 2


def is_released_after_a_while(me: PlanExecution, _: object) -> bool:
    needs = me.needs[me.completed]
    heard = all(me.progress.get(other, -1) >= count for other, count in needs.items())
    return heard or me.is_due(me.t_s - LEASE_S)


@instead_of(execution, "dependencies")
def need_one_less(needs_of: Dependencies, plan: Plan, vehicle: Name) -> tuple[Needs, ...]:
    return tuple(
        {other: count - 1 for other, count in needs.items()} for needs in needs_of(plan, vehicle)
    )


@instead_of(execution, "dependencies")
def forget_corners(_: object, plan: Plan, vehicle: Name) -> tuple[Needs, ...]:
    return dependencies_where(
        plan, vehicle, lambda *ends: frozenset(ends), lambda other, own: other < own
    )


def dependencies_where(
    plan: Plan,
    vehicle: Name,
    cells_of: Callable[[Cell, Cell], frozenset[Cell]],
    counts: Callable[[int, int], bool],
) -> tuple[Needs, ...]:
    """Return dependencies of a vehicle's moves that are not those of the protocol.

    Args:
        plan: its plan.
        vehicle: the vehicle.
        cells_of: the cells that a move from one cell to another uses.
        counts: whether a move of another vehicle counts, by its step and that of the own move.
    """
    return tuple(
        {
            other: index + 1
            for other, moves in plan.moves.items()
            for index, (other_step, *ends) in enumerate(moves)
            if other != vehicle
            and counts(other_step, step)
            and cells_of(*ends) & cells_of(origin, target)
        }
        for step, origin, target in plan.moves[vehicle]
    )


def start_and_count(me: PlanExecution, _: object) -> None:
    move = me.next_move
    if move is not None:
        me.hold_cell, me.moving, me.moving_in_plan = move[2], True, True
        me.completed += 1


# --- a leader ---------------------------------------------------------------------------------


def as_roster(roster: Callable[[FormationLeader], Iterable[Name]]) -> Plant:
    def plant(patch: Patch) -> None:
        patch.setattr(FormationLeader, "roster", property(lambda me: tuple(roster(me))))

    return plant


@as_roster
def roster_of_heard(me: FormationLeader) -> Iterable[Name]:
    return (name for name in me.formation.roster if name in me.states)


@as_roster
def roster_of_majority(me: FormationLeader) -> Iterable[Name]:
    members = me.formation.roster
    promised = [name for name in members if name in me.promises]
    return promised if 2 * len(promised) > len(members) else members


@as_roster
def roster_of_promised(me: FormationLeader) -> Iterable[Name]:
    return me.promises or me.formation.roster


def any_has_promised(me: FormationLeader, _: object) -> bool:
    return bool(me.promises)


@instead_of(FormationLeader, "_is_news")
def take_old_states(_: object, me: FormationLeader, state: VehicleState, *__: object) -> bool:
    return state.vehicle in me.formation.roster


def heard_have_accepted(me: FormationLeader, _: object) -> bool:
    return all(state.accepted for state in me.states.values())


def all_have_accepted(me: FormationLeader, _: object) -> bool:
    return all(me.states[name].accepted for name in me.formation.roster)


def one_ballot(me: FormationLeader, _: object) -> bool:
    ballots = {me.states[name].record.promised for name in me.formation.roster}
    return len(ballots) == 1 and all_have_accepted(me, None)


def adopt_the_ballot_only(me: FormationLeader, _: object) -> None:
    me.ballot = next(iter(me.states.values())).record.promised


def prepare_the_same(me: FormationLeader, _: object) -> None:
    if me.ballot is None:
        me.ballot = me.new_ballot(me.highest)
    else:
        # Vehicles that restarted are asked again; the others have promised this ballot.
        known = {name: each.record.incarnation for name, each in me.promises.items()}
        me.promises = {
            name: promise
            for name, promise in me.promises.items()
            if name in me.states and me.states[name].record.incarnation == known[name]
        }
    me.plan, me.accepted, me.failures, me.due_s = None, set(), 0, me.now_s


def prepare_anew(me: FormationLeader, _: object) -> None:
    me.ballot = me.new_ballot(me.highest)
    me.promises, me.due_s = {}, me.now_s


def promised_something(_: FormationLeader, state: VehicleState) -> bool:
    return state.record.promised is not None and not state.accepted


def count_entry_cell(me: FormationLeader, state: VehicleState) -> None:
    cells = {member.vehicle: member.cell for member in me.formation.members}
    me.promises[state.vehicle] = replace(state, hold_cell=cells[state.vehicle])


def time_is_up_unless_issuing(me: FormationLeader, _: object) -> bool:
    return me.now_s >= me.until_s and me.phase is not BallotPhase.ISSUING


def shows_another_ballot(me: FormationLeader, state: VehicleState) -> bool:
    return state.record.promised != me.ballot


def promised_b(me: FormationLeader, state: VehicleState) -> bool:
    return state.record.promised == me.ballot


# --- outside the rule books -------------------------------------------------------------------


@instead_of(Election, "on_heartbeat")
def revive(hear: Call, self: Election, heartbeat: Heartbeat, now_s: float) -> None:
    self._dead.clear()
    hear(self, heartbeat, now_s)


ignore_link_loss = instead_of(Election, "on_link")(skip)


@instead_of(CoordinatorCore, "_new_ballot")
def forget_incarnation(new_ballot: Callable[..., Ballot], *given: object) -> Ballot:
    return new_ballot(*given)._replace(incarnation=1)


@instead_of(operation, "closed_formations")
def close_at_once(
    closed_formations: Callable[..., dict[int, Formation]],
    census: Census,
    t_s: float,
    scenario: Scenario,
    groups: Groups,
    stages_of: Callable[[Numbers], Sequence[Stage]] | None = None,
) -> dict[int, Formation]:
    blocks = sorted({scenario.lattice.block_of(entry.cell[0]) for entry in census.on_road})
    closed = tuple(ClosedFormation(block, block, 0.0) for block in blocks)
    early = replace(census, formations=closed, closed_to=FAR_BEHIND)
    return closed_formations(early, t_s, scenario, groups, stages_of)


def close_early(patch: Patch) -> None:
    closing_s, close_formations = ColumnBlocks._closing_s, DrawnBlocks.close_formations

    def block_mutant(self: ColumnBlocks, block: int) -> float:
        return closing_s(self, block) - EARLY_S

    def drawn_mutant(self: DrawnBlocks, t_s: float, gaps: Sequence[range]) -> list[ClosedFormation]:
        return close_formations(self, t_s + EARLY_S, gaps)

    patch.setattr(ColumnBlocks, "_closing_s", block_mutant)
    patch.setattr(DrawnBlocks, "close_formations", drawn_mutant)


join_nothing = instead_of(Groups, "join")(never)
never_moving = instead_of(MotionController, "moving", "displaced")(never)


@instead_of(MotionController, "accept_command")
def play_any_command(accept: Callable[..., bool], self: MotionController, command: Command) -> bool:
    incarnation = max(command.record.incarnation, self.record.incarnation)
    return accept(self, changed(command, incarnation=incarnation))


def always_in_charge(patch: Patch) -> None:
    def mutant(self: AgentCore) -> bool:
        return self.execution is not None and not self.ended

    patch.setattr(AgentCore, "in_charge", property(mutant))


@instead_of(AgentCore, "_request_storage")
def note_by_itself(
    ask: Callable[..., Iterator[Effect]], self: AgentCore, execution: PlanExecution
) -> Iterator[Effect]:
    yield from ask(self, execution)
    if execution.plan is not None:
        noted = replace(execution.stored, accepted=execution.plan.ballot)
        if execution.on_record(noted):
            yield self._state()


@instead_of(AgentCore, "_on_sense")
def keep_incarnation(
    on_sense: Callable[..., object], self: AgentCore, message: Sense, now_s: float
) -> object:
    # As if there had been no caretaker: earlier promises still count.
    return on_sense(
        self, changed(message, incarnation=self._claim.incarnation, caretaker=False), now_s
    )


@instead_of(Caretaker, "on_message")
def accept_moves(
    on_message: Callable[..., VehicleState | None],
    self: Caretaker,
    message: Prepare | Plan,
    tick: int,
) -> VehicleState | None:
    if isinstance(message, Plan):
        return self.state(tick) if self._execution.on_plan(message) else None
    return on_message(self, message, tick)


# --- the rolling operation --------------------------------------------------------------------


@instead_of(MotionController, "accept_command")
def obey(accept_command: Callable[..., bool], self: MotionController, command: Command) -> bool:
    owned = self.record.owned
    set_record(self.store, owned=tuple(sorted({*owned, command.hold_cell})))
    taken = accept_command(self, command)
    set_record(self.store, owned=owned)
    return taken


@instead_of(RecordStore, "begin_transfer")
def own_at_once(begin_transfer: Call, self: RecordStore, transfer: PendingTransfer) -> None:
    begin_transfer(self, transfer)
    self.complete_transfer(transfer.ballot)


@instead_of(RecordStore, "begin_transfer")
def note_any_transfer(_: object, self: RecordStore, transfer: PendingTransfer) -> None:
    if transfer != self.record.transfer:
        set_record(self, transfer=transfer, owned=transfer.before)


@instead_of(RecordStore, "put_in_charge")
def forget_promise(put_in_charge: Call, self: RecordStore, incarnation: int) -> None:
    put_in_charge(self, incarnation)
    set_record(self, promised=None)


def forget_owned_cells(patch: Patch) -> None:
    accept_command, take_charge = MotionController.accept_command, Caretakers._put_caretaker

    def forget(controller: MotionController, before: int) -> None:
        if before not in (0, controller.record.incarnation):
            set_record(controller.store, owned=(controller.hold_cell,))

    def claimed(self: MotionController, command: Command) -> bool:
        before = self.record.incarnation
        taken = accept_command(self, command)
        forget(self, before)
        return taken

    def cared_for(self: Caretakers, vehicle: RoadVehicle, tick: int) -> None:
        before = vehicle.controller.record.incarnation
        take_charge(self, vehicle, tick)
        forget(vehicle.controller, before)

    patch.setattr(MotionController, "accept_command", claimed)
    patch.setattr(Caretakers, "_put_caretaker", cared_for)


@instead_of(PlanExecution, "state")
def show_owned_cells_at_once(
    state: Callable[..., VehicleState], self: PlanExecution, sense: Sense, **more: bool
) -> VehicleState:
    return state(self, changed(sense, promised=self.promised), **more)


@instead_of(ownership, "owned_cells")
def cancel_closed_transfers(_: object, state: VehicleState, *__: object) -> frozenset[Cell]:
    return frozenset(state.record.owned)


@instead_of(ownership, "owned_cells")
def cancel_on_common_promise(
    owned_cells: OwnedCells, state: VehicleState, states: States, gone: Collection[Name]
) -> frozenset[Cell] | None:
    pending, promised = state.record.transfer, state.record.promised
    if pending is not None and not pending.open:
        common = {states[name].record.promised for name in pending.roster if name in states}
        if common == {promised} and promised != pending.ballot:
            return frozenset(pending.before)
    return owned_cells(state, states, gone)


@instead_of(ownership, "owned_cells")
def forget_motion(
    owned_cells: OwnedCells, state: VehicleState, *more: object
) -> frozenset[Cell] | None:
    return owned_cells(replace(state, moving=False), *more)


def skip_ownership_checks(patch: Patch) -> None:
    for module in (transfer, territory):
        patch.setattr(module, "ownership_problems", lambda plan: [])  # noqa: ARG005


def keep_what_is_given(patch: Patch) -> None:
    make = CellTransfer._plan

    def mutant(self: CellTransfer, before: Mapping[Name, frozenset[Cell]]) -> Plan:
        plan = make(self, before)
        after = {
            name: tuple(sorted({*cells, *plan.before[name]})) for name, cells in plan.after.items()
        }
        return replace(plan, after=after)

    patch.setattr(CellTransfer, "_plan", mutant)
    skip_ownership_checks(patch)
