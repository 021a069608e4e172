"""Broken guards, actions and methods for the bugs in `planted_bugs`."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any

import pytest
from attrs import evolve
from msgspec.structs import replace

from laneweave.agents.core import AgentCore
from laneweave.coordinator.ballots.ballot_round import BallotPhase
from laneweave.coordinator.core import CoordinatorCore
from laneweave.coordinator.election import Election
from laneweave.coordinator.formations import operation, roster
from laneweave.coordinator.formations.leader import FormationLeader
from laneweave.coordinator.formations.roster import Formation, Groups
from laneweave.launch.fault_search.road.drawn_entrance import DrawnEntrance
from laneweave.protocol.lattice import Cell
from laneweave.protocol.runtime.node import Effect
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.state_machine import Transition
from laneweave.protocol.vehicle import execution_rules as execution
from laneweave.protocol.vehicle.plan_execution import PLAN, ExecutionPhase, PlanExecution
from laneweave.protocol.vehicle.plans import Needs, dependencies
from laneweave.protocol.wire.messages import (
    Ballot,
    Census,
    ClosedFormation,
    Command,
    Heartbeat,
    Name,
    Plan,
    Prepare,
    VehicleState,
)
from laneweave.sim_bridge.bodies.motion_controller import MotionController
from laneweave.sim_bridge.road.attendance import Caretaker
from laneweave.sim_bridge.road.formation_building import ColumnBlocks
from support.states import changed

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


def ready_with_plan(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(PlanExecution, "ready", property(lambda me: me.plan is not None))


def all_but_one_are_ready(me: PlanExecution, _: object) -> bool:
    roster = me.plan.roster if me.plan is not None else ()
    ready = sum(me.progress.get(other, -1) >= 0 for other in roster if other != me.vehicle)
    return ready >= len(roster) - 2


def is_released_after_a_while(me: PlanExecution, _: object) -> bool:
    needs = me.needs[me.completed]
    heard = all(me.progress.get(other, -1) >= count for other, count in needs.items())
    return heard or me.is_due(me.t_s - LEASE_S)


def one_less(plan: Plan, vehicle: Name) -> tuple[Needs, ...]:
    return tuple(
        {other: count - 1 for other, count in needs.items()}
        for needs in dependencies(plan, vehicle)
    )


def need_one_less(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(execution, "dependencies", one_less)


def forget_corners(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(execution, "dependencies", without_corners)


def without_corners(plan: Plan, vehicle: Name) -> tuple[Needs, ...]:
    def needs_of(step: int, cells: set[Cell]) -> Needs:
        return {
            other: index + 1
            for other, moves in plan.moves.items()
            for index, (other_step, origin, target) in enumerate(moves)
            if other != vehicle and other_step < step and cells & {origin, target}
        }

    return tuple(needs_of(step, {origin, target}) for step, origin, target in plan.moves[vehicle])


def start_and_count(me: PlanExecution, _: object) -> None:
    move = me.next_move
    if move is not None:
        me.hold_cell, me.moving, me.moving_in_plan = move[2], True, True
        me.completed += 1


# --- a leader ---------------------------------------------------------------------------------


def replace_roster(
    patch: pytest.MonkeyPatch, roster: Callable[[FormationLeader], Iterable[Name]]
) -> None:
    patch.setattr(FormationLeader, "roster", property(lambda me: tuple(roster(me))))


def roster_of_heard(patch: pytest.MonkeyPatch) -> None:
    replace_roster(patch, lambda me: (name for name in me.formation.roster if name in me.states))


def roster_of_majority(patch: pytest.MonkeyPatch) -> None:
    def mutant(me: FormationLeader) -> Iterable[Name]:
        members = me.formation.roster
        promised = [name for name in members if name in me.promises]
        return promised if 2 * len(promised) > len(members) else members

    replace_roster(patch, mutant)


def roster_of_promised(patch: pytest.MonkeyPatch) -> None:
    replace_roster(patch, lambda me: me.promises or me.formation.roster)


def any_has_promised(me: FormationLeader, _: object) -> bool:
    return bool(me.promises)


def take_old_states(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(
        FormationLeader, "_is_news", lambda me, state, _: state.vehicle in me.formation.roster
    )


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


def revive(patch: pytest.MonkeyPatch) -> None:
    hear = Election.on_heartbeat

    def mutant(self: Election, heartbeat: Heartbeat, now_s: float) -> None:
        self._dead.clear()
        hear(self, heartbeat, now_s)

    patch.setattr(Election, "on_heartbeat", mutant)


def ignore_link_loss(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(Election, "on_link", skip)


def forget_incarnation(patch: pytest.MonkeyPatch) -> None:
    new_ballot = CoordinatorCore._new_ballot

    def mutant(self: CoordinatorCore, above: Ballot | None) -> Ballot:
        return new_ballot(self, above)._replace(incarnation=1)

    patch.setattr(CoordinatorCore, "_new_ballot", mutant)


def close_at_once(patch: pytest.MonkeyPatch) -> None:
    closed_formations = roster.closed_formations

    def mutant(
        census: Census, t_s: float, scenario: Scenario, groups: Groups
    ) -> dict[int, Formation]:
        blocks = sorted({scenario.lattice.block_of(entry.cell[0]) for entry in census.on_road})
        closed = tuple(ClosedFormation(block, block, 0.0) for block in blocks)
        early = replace(census, formations=closed, closed_to=FAR_BEHIND)
        return closed_formations(early, t_s, scenario, groups)

    patch.setattr(operation, "closed_formations", mutant)


def close_early(patch: pytest.MonkeyPatch) -> None:
    closing_s, close_formations = ColumnBlocks._closing_s, DrawnEntrance.close_formations

    def block_mutant(self: ColumnBlocks, block: int) -> float:
        return closing_s(self, block) - EARLY_S

    def drawn_mutant(self: DrawnEntrance, t_s: float) -> list[ClosedFormation]:
        return close_formations(self, t_s + EARLY_S)

    patch.setattr(ColumnBlocks, "_closing_s", block_mutant)
    patch.setattr(DrawnEntrance, "close_formations", drawn_mutant)


def join_nothing(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(Groups, "join", never)


def play_any_command(patch: pytest.MonkeyPatch) -> None:
    accept_command = MotionController.accept_command

    def mutant(self: MotionController, command: Command) -> bool:
        return accept_command(
            self,
            changed(command, incarnation=max(command.record.incarnation, self.record.incarnation)),
        )

    patch.setattr(MotionController, "accept_command", mutant)


def always_in_charge(patch: pytest.MonkeyPatch) -> None:
    def mutant(self: AgentCore) -> bool:
        return self.execution is not None and not self.ended

    patch.setattr(AgentCore, "in_charge", property(mutant))


def note_by_itself(patch: pytest.MonkeyPatch) -> None:
    ask = AgentCore._request_storage

    def mutant(self: AgentCore, execution: PlanExecution) -> Iterator[Effect]:
        yield from ask(self, execution)
        if execution.plan is not None:
            noted = replace(execution.stored, accepted=execution.plan.ballot)
            if execution.on_record(noted):
                yield self._state()

    patch.setattr(AgentCore, "_request_storage", mutant)


def keep_incarnation(patch: pytest.MonkeyPatch) -> None:
    sense = AgentCore._on_sense

    def mutant(self: AgentCore, message: Any, now_s: float) -> Any:  # noqa: ANN401
        # As if there had been no caretaker: earlier promises still count.
        as_before = changed(message, incarnation=self._incarnation, caretaker=False)
        return sense(self, as_before, now_s)

    patch.setattr(AgentCore, "_on_sense", mutant)


def accept_moves(patch: pytest.MonkeyPatch) -> None:
    on_message = Caretaker.on_message

    def mutant(self: Caretaker, message: Prepare | Plan, tick: int) -> VehicleState | None:
        if isinstance(message, Plan):
            return self.state(tick) if self._execution.on_plan(message) else None
        return on_message(self, message, tick)

    patch.setattr(Caretaker, "on_message", mutant)


def never_moving(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(MotionController, "moving", never)
    patch.setattr(MotionController, "displaced", never)
