"""One formation under a leader: prepare, promise, plan (rules L2 to L8).

The leader asks every vehicle of the roster for a promise, plans from the cells in which all of
them will hold, and issues one plan under that ballot. Nothing here is needed for safety, except
that a ballot is never used twice and that a plan is made only from the promises of the *whole*
roster; vehicles check the rest. `LEADER_RULES` is the table; docs/PROTOCOL.md shows it.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable

from attrs import define, field

from laneweave.coordinator.formations.leader_rules import (
    ALL,
    FAILED,
    LEADER_RULES,
    MEMBERS,
    PLANNED,
    STATE,
    TIME,
    TOO_LATE,
    Phase,
)
from laneweave.coordinator.formations.roster import Formation
from laneweave.protocol.lattice import Cell
from laneweave.protocol.state_machine import RuleBook
from laneweave.protocol.wire.messages import Ballot, Name, Plan, Prepare, VehicleState


@define
class FormationControl:
    """The leader's state for one formation, or for several that are joined."""

    formation: Formation
    new_ballot: Callable[[Ballot | None], Ballot]
    """Returns a ballot never used before and above the given one, if one is given."""
    rng: random.Random
    resend_s: float
    rules: RuleBook = LEADER_RULES
    phase: Phase = Phase.OBSERVING
    ballot: Ballot | None = None
    plan: Plan | None = None
    failures: int = 0
    """Plannings that failed under this ballot."""
    back_offs: int = 0
    """Pauses in a row without a plan in force between them."""
    out_of_reach: frozenset[Name] = frozenset()
    """Members that the plan in force does not bring to their lanes, because it cannot."""
    states: dict[Name, VehicleState] = field(factory=dict)
    """The newest state of each member."""
    promises: dict[Name, VehicleState] = field(factory=dict)
    accepted: set[Name] = field(factory=set)
    highest: Ballot | None = None
    """Highest ballot that a member has shown; a new one must be above it to be promised."""
    now_s: float = 0.0
    """Time of the event at hand (node clock)."""
    due_s: float = 0.0
    """When the phase's timer fires, or something is to be sent again (node clock)."""
    until_s: float = 0.0
    """When patience with the phase ends (node clock)."""

    def begin(self, now_s: float, *, observe: bool = True) -> None:
        """Take the formation over (L2), or prepare at once where there can be no plan yet (L3)."""
        self.now_s = now_s
        self.rules.functions["observe"](self, None)
        self.phase = Phase.OBSERVING
        if not observe:
            self.until_s = now_s
            self.on_time(now_s)

    # --- inputs -------------------------------------------------------------------------------

    def on_members(self, formation: Formation, now_s: float) -> None:
        """The census changed: who left can neither promise nor accept; targets may be new (L8)."""
        if formation == self.formation:
            return
        self.now_s = now_s
        for vehicle in set(self.formation.roster) - set(formation.roster):
            self.states.pop(vehicle, None)
        self.rules.take(self, MEMBERS, formation)
        self.formation = formation

    def on_state(self, state: VehicleState, now_s: float) -> None:
        """A member showed its state (L2, L4, L6, L7, L8)."""
        self.now_s = now_s
        if self.rules.functions["is_news"](self, state):
            self.states[state.vehicle] = state
            if state.promised is not None:
                self.highest = max(self.highest or state.promised, state.promised)
            self.rules.take(self, STATE, state)

    def on_time(self, now_s: float) -> None:
        """A timer may have run out."""
        self.now_s = now_s
        self.rules.take(self, TIME, None)

    def on_plan(self, plan: Plan, now_s: float, out_of_reach: Iterable[Name] = ()) -> None:
        """Planning succeeded: issue the plan under the ballot that was promised (L5)."""
        self.now_s = now_s
        self.out_of_reach = frozenset(out_of_reach)
        self.rules.take(self, PLANNED, plan)

    def on_planning_failed(self, now_s: float) -> None:
        """Planning failed: keep the ballot and try again later (L5)."""
        self.now_s = now_s
        self.rules.take(self, FAILED, None)

    def settle(self, now_s: float) -> None:
        """No step fits in any more."""
        self.now_s = now_s
        self.rules.take(self, TOO_LATE, None)

    # --- outputs ------------------------------------------------------------------------------

    def outgoing(self, now_s: float) -> Iterable[tuple[Name, Prepare | Plan]]:
        """Return what has to be sent (again) now, and to whom."""
        if now_s < self.due_s or self.ballot is None:
            return []
        if self.phase is Phase.PREPARING:
            formation = self.formation
            missing = [name for name in formation.roster if name not in self.promises]
            message = Prepare(self.ballot, formation.numbers, formation.roster)
            if missing:
                self.due_s = now_s + self.resend_s
            return [(name, message) for name in missing]
        if self.phase is Phase.ISSUING and self.plan is not None:
            plan = self.plan
            self.due_s = now_s + self.resend_s
            return [(name, plan) for name in plan.roster if name not in self.accepted]
        return []

    def take_planning_order(self, now_s: float) -> bool:
        """Tell, once, that the whole roster has promised and planning should begin (L5)."""
        self.now_s = now_s
        return self.rules.take(self, ALL, None) is not None

    @property
    def hold_cells(self) -> dict[Name, Cell]:
        """Where each member will hold, from its promise."""
        return {name: self.promises[name].hold_cell for name in self.plan_roster}

    @property
    def incarnations(self) -> dict[Name, int]:
        """Which process of each member promised."""
        return {name: self.promises[name].incarnation for name in self.plan_roster}

    @property
    def unattended(self) -> frozenset[Name]:
        """Members that no agent drives: they promised to hold."""
        return frozenset(name for name in self.plan_roster if not self.promises[name].attended)

    @property
    def plan_roster(self) -> tuple[Name, ...]:
        """Who takes part in the plan: everybody."""
        return tuple(self.rules.functions["roster"](self))

    @property
    def wakeup_s(self) -> float | None:
        """When `on_time` or `outgoing` has something to do."""
        if self.phase in (Phase.WATCHING, Phase.SETTLED, Phase.PLANNING):
            return None
        return self.due_s
