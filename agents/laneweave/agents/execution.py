"""Plan execution: the vehicle's side of the execution protocol, rules V1 to V7.

The vehicle holds its cell unless everything that its next move needs is *known*: it has promised
and accepted a plan, every member of the roster has shown that it accepted the same plan (start
gate), and every vehicle whose earlier move interferes has shown that it completed it. Time only
paces; silence always means hold. docs/PROTOCOL.md has the table, docs/SAFETY.md the argument.
"""

from __future__ import annotations

from attrs import define, field

from laneweave.protocol.lattice import Cell, Move
from laneweave.protocol.messages import Ballot, Name, Plan, Prepare, VehicleState
from laneweave.protocol.plans import Needs, dependencies, plan_problems

TIME_TOLERANCE_S = 1e-6


@define
class PlanExecution:
    """What one vehicle remembers of the protocol (V1: nothing promised, no plan).

    `hold_cell` and `moving` mirror the motion controller, which outlives this object.
    """

    vehicle: Name
    incarnation: int
    hold_cell: Cell
    overdue_s: float
    """A move due for longer than this is reported as overdue."""
    moving: bool = False
    promised: Ballot | None = None
    plan: Plan | None = None
    completed: int = 0
    go: bool = False
    heard: dict[Name, int] = field(factory=dict)
    _moving_in_plan: bool = False
    _needs: tuple[Needs, ...] = ()

    def on_prepare(self, prepare: Prepare) -> bool:
        """V2: promise a ballot; true when a state should be shown at once."""
        if self.vehicle not in prepare.roster:
            return False
        if self.promised is not None and prepare.ballot <= self.promised:
            return True
        self.promised = prepare.ballot
        self._forget_plan()
        return True

    def on_plan(self, plan: Plan) -> bool:
        """V3: accept the plan of the promised ballot, once; true when it was accepted now.

        A plan that cannot be executed safely is not accepted, whoever sent it.
        """
        if (
            plan.ballot != self.promised
            or self.plan is not None
            or plan.incarnations.get(self.vehicle) != self.incarnation
            or plan.start_cells.get(self.vehicle) != self.hold_cell
            or plan_problems(plan)
        ):
            return False
        self.plan = plan
        self._needs = dependencies(plan, self.vehicle)
        return True

    def on_state(self, state: VehicleState) -> None:
        """V4: remember what another member of the same plan has shown."""
        plan = self.plan
        if (
            plan is None
            or not state.accepted
            or state.promised != plan.ballot
            or state.vehicle not in plan.moves
            or state.vehicle == self.vehicle
        ):
            return
        shown = state.completed if state.ready else -1
        self.heard[state.vehicle] = max(self.heard.get(state.vehicle, -1), shown)
        if state.go:
            self.go = True

    def next_move(self, t_s: float) -> Move | None:
        """V5 and V6: open the gate when it may, and return the move that may start now."""
        plan = self.plan
        if plan is None or self.moving:
            return None
        if not self.go and all(
            self.heard.get(other, -1) >= 0 for other in plan.roster if other != self.vehicle
        ):
            self.go = True
        move = self._due_move(t_s)
        if move is None or not self.go:
            return None
        needs = self._needs[self.completed]
        if any(self.heard.get(other, -1) < count for other, count in needs.items()):
            return None
        return move

    def begin(self, move: Move) -> None:
        """V6: the controller moves; from now on the vehicle counts as being at the target."""
        self.hold_cell = move[2]
        self.moving = True
        self._moving_in_plan = True

    def end_motion(self) -> None:
        """V7: the controller holds again."""
        if not self.moving:
            return
        self.moving = False
        if self._moving_in_plan:
            self.completed += 1
            self._moving_in_plan = False

    @property
    def done(self) -> bool:
        """All moves of the accepted plan are completed."""
        return self.plan is not None and self.completed == len(self.plan.moves[self.vehicle])

    def needs_states(self, t_s: float) -> bool:
        """Tell whether what other vehicles show matters now.

        It does until the gate is open, and from shortly before the plan's start on as long as a
        move waits for somebody. What is missed in between is shown again: it stays true.
        """
        plan = self.plan
        if plan is None:
            return False
        if not self.go:
            return True
        return t_s >= plan.t0_s - plan.slot_s and any(
            self.heard.get(other, -1) < count
            for needs in self._needs[self.completed :]
            for other, count in needs.items()
        )

    @property
    def ready(self) -> bool:
        """Accepted, and not moving or moving in a move of this plan."""
        return self.plan is not None and (not self.moving or self._moving_in_plan)

    def overdue(self, t_s: float) -> bool:
        """Tell whether the next move has been due for too long."""
        return not self.moving and self._due_move(t_s - self.overdue_s) is not None

    def _due_move(self, t_s: float) -> Move | None:
        plan = self.plan
        if plan is None or self.completed >= len(plan.moves[self.vehicle]):
            return None
        move = plan.moves[self.vehicle][self.completed]
        if t_s + TIME_TOLERANCE_S < plan.t0_s + move[0] * plan.slot_s:
            return None
        return move

    def _forget_plan(self) -> None:
        self.plan = None
        self.completed = 0
        self.go = False
        self.heard = {}
        self._needs = ()
        # The move under way ends, but it belongs to no plan any more.
        self._moving_in_plan = False
