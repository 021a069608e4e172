"""One formation under a leader: prepare, promise, plan (rules L2 to L8).

The leader asks every vehicle of the roster for a promise, plans from the cells in which all of
them will hold, and issues one plan under that ballot. Nothing here is needed for safety, except
that a ballot is never used twice and that a plan is made only from the promises of the *whole*
roster; vehicles check the rest. docs/PROTOCOL.md has the table.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable
from enum import Enum

import structlog
from attrs import define, field

from laneweave.coordinator.formation import Formation
from laneweave.protocol.lattice import Cell
from laneweave.protocol.messages import Ballot, Name, Plan, Prepare, VehicleState

log = structlog.get_logger(__name__)

OBSERVE_S = 0.5
"""How long a new leader waits for the states of a roster before it prepares (L2)."""
BACK_OFF_S = (0.05, 0.3)
"""Random pause before a leader outbids another one (L7)."""
RETRY_S = 1.0
"""First pause after failed planning; doubles with each failure (L5)."""


class Phase(Enum):
    """Where a formation stands under this leader."""

    OBSERVING = "observing"
    """L2: is a plan in force that can be adopted?"""
    PREPARING = "preparing"
    """L3, L4: collecting promises."""
    PLANNING = "planning"
    """L5: the whole roster has promised."""
    ISSUING = "issuing"
    """L6: the plan is being sent until all have accepted."""
    WATCHING = "watching"
    """A plan is in force; L8 ends it when it stalls."""
    BACKING_OFF = "backing off"
    """L7: somebody promised a higher ballot."""
    SETTLED = "settled"
    """No step fits in any more; the members hold until they leave."""


@define
class FormationControl:
    """The leader's state for one formation."""

    formation: Formation
    new_ballot: Callable[[Ballot | None], Ballot]
    """Returns a ballot never used before and above the given one, if one is given."""
    rng: random.Random
    resend_s: float
    phase: Phase = Phase.OBSERVING
    ballot: Ballot | None = None
    plan: Plan | None = None
    failures: int = 0
    _states: dict[Name, VehicleState] = field(factory=dict)
    _promises: dict[Name, VehicleState] = field(factory=dict)
    _accepted: set[Name] = field(factory=set)
    _due_s: float = 0.0
    """When the phase's timer fires (node clock)."""
    _observe_until_s: float = 0.0
    _highest: Ballot | None = None
    """Highest ballot that a member has shown; a new one must be above it to be promised."""

    def begin(self, now_s: float) -> None:
        """Take the formation over (L2)."""
        self.phase = Phase.OBSERVING
        self._states.clear()
        self._promises = {}
        self._observe_until_s = self._due_s = now_s + OBSERVE_S

    # --- inputs -------------------------------------------------------------------------------

    def on_members(self, formation: Formation, now_s: float) -> None:
        """The census changed: who left can neither promise nor accept; targets may be new (L8)."""
        if formation == self.formation:
            return
        left = set(self.formation.roster) - set(formation.roster)
        new_targets = not set(formation.members) <= set(self.formation.members)
        self.formation = formation
        for vehicle in left:
            self._states.pop(vehicle, None)
        unfinished = self.phase in (Phase.PREPARING, Phase.PLANNING, Phase.ISSUING)
        if unfinished or (self.phase is Phase.WATCHING and new_targets):
            self._prepare(now_s)

    def on_state(self, state: VehicleState, now_s: float) -> None:
        """A member showed its state (L4, L6, L7, L8)."""
        if state.vehicle not in self.formation.roster or not self._take(state):
            return
        if state.promised is not None:
            self._highest = max(self._highest or state.promised, state.promised)
        if self.phase is Phase.OBSERVING:
            self._observe(now_s)
        elif self.phase in (Phase.PREPARING, Phase.PLANNING, Phase.ISSUING, Phase.WATCHING):
            self._follow(state, now_s)

    def on_time(self, now_s: float) -> None:
        """A timer may have run out."""
        if now_s < self._due_s:
            return
        if self.phase is Phase.OBSERVING and now_s >= self._observe_until_s:
            self._prepare(now_s)
        elif self.phase is Phase.BACKING_OFF:
            self.begin(now_s)

    def on_plan(self, plan: Plan, now_s: float) -> None:
        """Planning succeeded: issue the plan under the ballot that was promised (L5)."""
        self.plan = plan
        self.failures = 0
        self._accepted = set()
        self.phase = Phase.ISSUING
        self._due_s = now_s

    def on_planning_failed(self, now_s: float) -> None:
        """Planning failed: keep the ballot and try again later (L5)."""
        self.phase = Phase.PREPARING
        self._due_s = now_s + RETRY_S * 2.0**self.failures
        self.failures += 1

    def settle(self) -> None:
        """No step fits in any more."""
        self.phase = Phase.SETTLED

    # --- outputs ------------------------------------------------------------------------------

    def outgoing(self, now_s: float) -> Iterable[tuple[Name, Prepare | Plan]]:
        """Return what has to be sent (again) now, and to whom."""
        if now_s < self._due_s:
            return []
        if self.phase is Phase.PREPARING and self.ballot is not None:
            missing = [name for name in self.formation.roster if name not in self._promises]
            message = Prepare(self.ballot, self.formation.number, self.formation.roster)
            if missing:
                self._due_s = now_s + self.resend_s
            return [(name, message) for name in missing]
        if self.phase is Phase.ISSUING and self.plan is not None:
            plan = self.plan
            self._due_s = now_s + self.resend_s
            return [(name, plan) for name in plan.roster if name not in self._accepted]
        return []

    def take_planning_order(self, now_s: float) -> bool:
        """Tell, once, that the whole roster has promised and planning should begin (L5)."""
        if (
            self.phase is not Phase.PREPARING
            or not self._all_promised
            or (self.failures and now_s < self._due_s)
        ):
            return False
        self.phase = Phase.PLANNING
        return True

    @property
    def _all_promised(self) -> bool:
        return set(self._promises) == set(self.formation.roster)

    @property
    def hold_cells(self) -> dict[Name, Cell]:
        """Where each member will hold, from its promise."""
        return {name: self._promises[name].hold_cell for name in self.formation.roster}

    @property
    def incarnations(self) -> dict[Name, int]:
        """Which process of each member promised."""
        return {name: self._promises[name].incarnation for name in self.formation.roster}

    @property
    def wakeup_s(self) -> float | None:
        """When `on_time` or `outgoing` has something to do."""
        if self.phase in (Phase.WATCHING, Phase.SETTLED, Phase.PLANNING):
            return None
        return self._due_s

    # --- inside -------------------------------------------------------------------------------

    def _take(self, state: VehicleState) -> bool:
        known = self._states.get(state.vehicle)
        if known is not None and _age(state) < _age(known):
            return False
        self._states[state.vehicle] = state
        return True

    def _observe(self, now_s: float) -> None:
        states = [self._states.get(name) for name in self.formation.roster]
        if any(state is None for state in states):
            return
        shown = {state.promised for state in states if state is not None and state.accepted}
        in_force = all(
            state is not None and state.accepted and not state.overdue for state in states
        )
        if in_force and len(shown) == 1:
            # Adoption: send nothing, watch. The plan is executed without any leader.
            self.ballot = shown.pop()
            # The promises were given to another leader; whoever has accepted has promised.
            self._promises = dict(self._states)
            self.phase = Phase.WATCHING
        else:
            self._prepare(now_s)

    def _prepare(self, now_s: float) -> None:
        self.ballot = self.new_ballot(self._highest)
        self.plan = None
        self._promises = {}
        self._accepted = set()
        self.phase = Phase.PREPARING
        self.failures = 0
        self._due_s = now_s

    def _follow(self, state: VehicleState, now_s: float) -> None:
        ballot = self.ballot
        if ballot is None:
            return
        if state.promised is not None and state.promised > ballot:
            self.phase = Phase.BACKING_OFF
            self._due_s = now_s + self.rng.uniform(*BACK_OFF_S)
        elif self.phase is Phase.PREPARING:
            self._count_promise(state, ballot)
            if self._all_promised and not self.failures:
                self._due_s = now_s
        elif self._restarted(state):
            self._prepare(now_s)
        elif self.phase is Phase.ISSUING:
            self._count_acceptance(state, ballot)
        elif self.phase is Phase.WATCHING and (state.overdue or self._astray(state)):
            self._prepare(now_s)

    def _count_promise(self, state: VehicleState, ballot: Ballot) -> None:
        if state.promised == ballot and not state.accepted:
            self._promises[state.vehicle] = state
        elif state.vehicle in self._promises:
            # It promised and lost its memory since: the promise is void.
            del self._promises[state.vehicle]

    def _count_acceptance(self, state: VehicleState, ballot: Ballot) -> None:
        if state.promised == ballot and state.accepted:
            self._accepted.add(state.vehicle)
            if self._accepted >= set(self.formation.roster):
                self.phase = Phase.WATCHING

    def _restarted(self, state: VehicleState) -> bool:
        """Tell whether a vehicle's agent is another process than the one that promised (L8)."""
        promise = self._promises.get(state.vehicle)
        return promise is None or promise.incarnation != state.incarnation

    def _astray(self, state: VehicleState) -> bool:
        """Tell whether the plan has ended for a vehicle that now prefers another lane (L8).

        An adopted plan may have been made for targets that this leader never saw.
        """
        return state.done and any(
            member.vehicle == state.vehicle and member.preferred_lane != state.hold_cell[1]
            for member in self.formation.members
        )


def _age(state: VehicleState) -> tuple[object, ...]:
    """Return what orders the states of one vehicle, older ones first.

    Between two ticks it shows states with equal times; it never promises less or takes back an
    acceptance, so a late state cannot pass for a newer one.
    """
    return (state.incarnation, state.t_s, state.promised or (), state.accepted)
