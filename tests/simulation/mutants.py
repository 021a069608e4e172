"""Planted bugs: each takes one rule of the protocol away, to show that the tests can fail."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from attrs import evolve

from laneweave.agents import execution
from laneweave.agents.execution import PlanExecution
from laneweave.protocol.lattice import Move
from laneweave.protocol.messages import Name, Plan, VehicleState
from laneweave.protocol.plans import Needs, dependencies

Mutant = Callable[[pytest.MonkeyPatch], None]


def no_gate(patch: pytest.MonkeyPatch) -> None:
    """A vehicle moves as soon as it has the plan, whoever else has it (V5)."""
    next_move = PlanExecution.next_move

    def mutant(self: PlanExecution, t_s: float) -> Move | None:
        self.go = self.go or self.plan is not None
        return next_move(self, t_s)

    patch.setattr(PlanExecution, "next_move", mutant)


def no_promise_check(patch: pytest.MonkeyPatch) -> None:
    """A vehicle takes every plan that names it, whatever it has promised or accepted (V3)."""

    def mutant(self: PlanExecution, plan: Plan) -> bool:
        known = self.plan is not None and plan.ballot == self.plan.ballot
        if known or plan.incarnations.get(self.vehicle) != self.incarnation:
            return False
        self._forget_plan()
        self.promised, self.plan = plan.ballot, plan
        self._needs = dependencies(plan, self.vehicle)
        return True

    patch.setattr(PlanExecution, "on_plan", mutant)


def timetable_only(patch: pytest.MonkeyPatch) -> None:
    """The clock alone releases moves (V6)."""

    def mutant(plan: Plan, vehicle: Name) -> tuple[Needs, ...]:
        return tuple({} for _ in plan.moves[vehicle])

    patch.setattr(execution, "dependencies", mutant)


def needs_one_less(patch: pytest.MonkeyPatch) -> None:
    """A move waits until the one before the interfering move is completed: off by one (V6)."""

    def mutant(plan: Plan, vehicle: Name) -> tuple[Needs, ...]:
        return tuple(
            {other: count - 1 for other, count in needs.items()}
            for needs in dependencies(plan, vehicle)
        )

    patch.setattr(execution, "dependencies", mutant)


def ready_while_moving(patch: pytest.MonkeyPatch) -> None:
    """An acceptance counts though the footprint of an older plan's move is still occupied (V4)."""
    patch.setattr(PlanExecution, "ready", property(lambda self: self.plan is not None))


def foreign_motion_counts(patch: pytest.MonkeyPatch) -> None:
    """A move of an older plan counts as a completed move of the new one (V7)."""
    forget = PlanExecution._forget_plan

    def mutant(self: PlanExecution) -> None:
        in_plan = self._moving_in_plan
        forget(self)
        self._moving_in_plan = in_plan

    patch.setattr(PlanExecution, "_forget_plan", mutant)


def any_ballot_releases(patch: pytest.MonkeyPatch) -> None:
    """What a vehicle has completed of any plan counts for this one (V4)."""
    on_state = PlanExecution.on_state

    def mutant(self: PlanExecution, state: VehicleState) -> None:
        if self.plan is not None and state.accepted:
            state = evolve(state, promised=self.plan.ballot)
        on_state(self, state)

    patch.setattr(PlanExecution, "on_state", mutant)
