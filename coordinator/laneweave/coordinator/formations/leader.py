"""One formation under a leader: its ballots, one after the other (rules L2 to L8).

A leader observes the formation first and adopts the plan that is in force (L2). Otherwise, and
whenever that plan stalls or no longer fits, it prepares a new ballot. `LEADER_RULES` is the table;
docs/PROTOCOL.md shows it. L1 is `election.Election`.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable

from attrs import define, field

from laneweave.coordinator.ballots.ballot_round import (
    FAILED,
    MEMBERS,
    PLAN_RULES,
    PLANNED,
    STATE,
    TIME,
    TOO_LATE,
    UNFINISHED,
    BallotPhase,
    BallotRound,
    count_promise,
    had_promised,
    has_higher_promise,
    is_older,
    is_promise,
    restarted,
)
from laneweave.coordinator.formations.roster import Formation
from laneweave.protocol.state_machine import RuleBook, Transition
from laneweave.protocol.wire.messages import Ballot, Name, Plan, VehicleState

OBSERVE_S = 1.0
"""How long a new leader waits for the states of a roster before it prepares (L2)."""
BACK_OFF_S = (0.05, 0.3)
"""Random pause before a leader outbids another one (L7); twice as long each time in a row, so that
one of two leaders gets the time to plan."""
MAX_BACK_OFFS = 6
"""The pause grows this often at most."""
RETRY_S = 1.0
"""First pause after failed planning; doubles with each failure (L5)."""
LONGEST_RETRY_S = 8.0


@define
class FormationLeader(BallotRound):
    """The leader's state for one formation, or for several that are joined."""

    formation: Formation
    new_ballot: Callable[[Ballot | None], Ballot]
    """Returns a ballot never used before and above the given one, if one is given."""
    rng: random.Random
    rules: RuleBook = field(factory=lambda: LEADER_RULES, kw_only=True)
    phase: BallotPhase = field(default=BallotPhase.OBSERVING, kw_only=True)
    out_of_reach: frozenset[Name] = frozenset()
    """Members that the plan in force does not bring to their lanes, because it cannot."""
    states: dict[Name, VehicleState] = field(factory=dict)
    """The newest state of each member."""
    highest: Ballot | None = None
    """Highest ballot that a member has shown; a new one must be above it to be promised."""

    @property
    def roster(self) -> tuple[Name, ...]:
        """All members on the road."""
        return self.formation.roster

    @property
    def blocks(self) -> tuple[int, ...]:
        """Blocks of the formation."""
        return self.formation.numbers

    @property
    def unattended(self) -> frozenset[Name]:
        """Members that no agent drives: they promised to hold."""
        return frozenset(name for name in self.roster if not self.promises[name].attended)

    def begin(self, now_s: float, *, observe: bool = True) -> None:
        """Take the formation over (L2), or prepare at once where there can be no plan yet (L3)."""
        self.now_s = now_s
        observe_members(self, None)
        self.phase = BallotPhase.OBSERVING
        if not observe:
            self.until_s = now_s
            self.take(TIME, now_s)

    def on_members(self, formation: Formation, now_s: float) -> None:
        """Take the formation as a newer census shows it (L8).

        Vehicles that have left can neither promise nor accept; targets may be new.
        """
        if formation == self.formation:
            return
        for vehicle in set(self.formation.roster) - set(formation.roster):
            self.states.pop(vehicle, None)
        self.take(MEMBERS, now_s, formation)
        self.formation = formation

    def on_state(self, state: VehicleState, now_s: float) -> None:
        """Take the state of a member (L2, L4, L6, L7, L8)."""
        if self._is_news(state):
            self.states[state.vehicle] = state
            if state.promised is not None:
                self.highest = max(self.highest or state.promised, state.promised)
            self.take(STATE, now_s, state)

    def on_plan(self, plan: Plan, now_s: float, out_of_reach: Iterable[Name] = ()) -> None:
        """Issue the plan under the ballot that was promised (L5)."""
        self.out_of_reach = frozenset(out_of_reach)
        self.take(PLANNED, now_s, plan)

    def _is_news(self, state: VehicleState) -> bool:
        """Return whether a state is from a member and not older than its newest one."""
        known = self.states.get(state.vehicle)
        return state.vehicle in self.formation.roster and (
            known is None or not is_older(state, known)
        )


# --- guards and actions -----------------------------------------------------------------------


def observe_members(leader: FormationLeader, _: object) -> None:
    """Listen to all members."""
    leader.states.clear()
    leader.promises = {}
    leader.until_s = leader.due_s = leader.now_s + OBSERVE_S


def all_have_reported(leader: FormationLeader, _: object) -> bool:
    """All members have shown their states."""
    return all(name in leader.states for name in leader.roster)


def one_plan_is_in_force(leader: FormationLeader, _: object) -> bool:
    """All show the same ballot as accepted, no member is overdue."""
    states = [leader.states[name] for name in leader.roster]
    return len({state.promised for state in states}) == 1 and all(
        state.accepted and not state.overdue for state in states
    )


def adopt(leader: FormationLeader, _: object) -> None:
    """Adopt: send nothing, watch."""
    leader.ballot = next(iter(leader.states.values())).promised
    # The promises were given to another leader; a vehicle that has accepted has promised.
    leader.promises = dict(leader.states)
    leader.back_offs = 0
    # This plan may bring members to their lanes that an earlier one could not.
    leader.out_of_reach = frozenset()


def time_is_up(leader: FormationLeader, _: object) -> bool:
    """The phase has lasted for long enough."""
    return leader.now_s >= leader.until_s


def prepare(leader: FormationLeader, _: object) -> None:
    """PREPARE a new ballot, above all that members have shown."""
    leader.ballot = leader.new_ballot(leader.highest)
    leader.plan = None
    leader.promises = {}
    leader.accepted = set()
    leader.failures = 0
    leader.due_s = leader.now_s


def back_off(leader: FormationLeader, _: object) -> None:
    """Pause for 0.05 to 0.3 s, twice as long each time in a row."""
    pause_s = leader.rng.uniform(*BACK_OFF_S) * 2.0 ** min(leader.back_offs, MAX_BACK_OFFS)
    leader.back_offs += 1
    leader.until_s = leader.due_s = leader.now_s + pause_s


def has_joined(leader: FormationLeader, state: VehicleState) -> bool:
    """It has joined the formations of b and no others."""
    return state.joined == leader.formation.numbers


def void_promise(leader: FormationLeader, state: VehicleState) -> None:
    """Void the promise: it has lost its memory since."""
    del leader.promises[state.vehicle]


def keep_ballot(leader: FormationLeader, _: object) -> None:
    """Keep the ballot, try again after 1, 2, 4, 8, 8, ... s."""
    leader.due_s = leader.now_s + min(RETRY_S * 2.0**leader.failures, LONGEST_RETRY_S)
    leader.failures += 1


def stalls(_: FormationLeader, state: VehicleState) -> bool:
    """Its next move is overdue."""
    return state.overdue


def is_off_lane(leader: FormationLeader, state: VehicleState) -> bool:
    """It is done on a lane that it does not prefer, though it could reach its own.

    An adopted plan may have been made for targets that this leader never saw.
    """
    return (
        leader.formation.sorts
        and state.done
        and state.attended
        and state.vehicle not in leader.out_of_reach
        and any(
            member.vehicle == state.vehicle and member.preferred_lane != state.hold_cell[1]
            for member in leader.formation.members
        )
    )


def has_new_targets(leader: FormationLeader, formation: Formation) -> bool:
    """There are new targets, new members, or another structure to take on."""
    return formation.stage != leader.formation.stage or not (
        set(formation.members) <= set(leader.formation.members)
    )


_OBSERVING, _PREPARING, _PLANNING, _ISSUING, _IN_FORCE, _BACKING_OFF, _ = (
    (phase,) for phase in BallotPhase
)
_ADOPT = (adopt,), BallotPhase.IN_FORCE
_BACK_OFF = (back_off,), BallotPhase.BACKING_OFF
_PREPARE = (prepare,), BallotPhase.PREPARING

LEADER_RULES: RuleBook = RuleBook(
    (
        Transition("L2", STATE, _OBSERVING, (all_have_reported, one_plan_is_in_force), *_ADOPT),
        Transition("L3", STATE, _OBSERVING, (all_have_reported,), *_PREPARE),
        Transition("L3", TIME, _OBSERVING, (time_is_up,), *_PREPARE),
        Transition("L7", STATE, (*UNFINISHED, *_IN_FORCE), (has_higher_promise,), *_BACK_OFF),
        Transition("L8", STATE, (*_PLANNING, *_ISSUING, *_IN_FORCE), (restarted,), *_PREPARE),
        Transition("L4", STATE, _PREPARING, (is_promise, has_joined), (count_promise,)),
        *PLAN_RULES,
        Transition("L5", FAILED, _PLANNING, (), (keep_ballot,), BallotPhase.PREPARING),
        Transition(
            "L7", TIME, _BACKING_OFF, (time_is_up,), (observe_members,), BallotPhase.OBSERVING
        ),
        Transition("L4", STATE, _PREPARING, (had_promised,), (void_promise,)),
        Transition("L5", TOO_LATE, _PLANNING, (), (), BallotPhase.ABORTED),
        Transition("L8", TIME, _ISSUING, (time_is_up,), *_PREPARE),
        Transition("L8", STATE, _IN_FORCE, (stalls,), *_PREPARE),
        Transition("L8", STATE, _IN_FORCE, (is_off_lane,), *_PREPARE),
        Transition("L8", MEMBERS, UNFINISHED, (), *_PREPARE),
        Transition("L8", MEMBERS, _IN_FORCE, (has_new_targets,), *_PREPARE),
    )
)
"""Rules L2 to L8 of formations."""
