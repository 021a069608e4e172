"""One formation under a leader: its ballots, one after another (rules L2 to L8).

A leader first observes the formation and adopts a plan that is in force (L2). If there is no such
plan, or the plan stalls or no longer fits, the leader prepares a new ballot. `LEADER_RULES` is the
table, shown in docs/PROTOCOL.md. L1 is `election.Election`.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable, Mapping

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
    age,
    count_promise,
    had_promised,
    has_higher_promise,
    is_promise,
    restarted,
)
from laneweave.coordinator.formations.roster import Formation
from laneweave.protocol.state_machine import RuleBook, Transition
from laneweave.protocol.wire.messages import Ballot, Name, Plan, VehicleState
from laneweave.protocol.wire.newest import Newest

OBSERVE_S = 1.0
"""Longest time for which a new leader waits for the states of all members (L2)."""
BACK_OFF_S = (0.05, 0.3)
"""Range of the random back-off before a leader outbids another one (L7). It is doubled for each
consecutive back-off, so that one of two leaders has time to plan."""
MAX_BACK_OFFS = 2
"""Maximum number of doublings of the back-off, so that planning goes on within 2 s of the last
promise that outbids the leader."""
RETRY_S = 1.0
"""First pause after failed planning; it doubles with each failure (L5)."""
LONGEST_RETRY_S = 8.0
AWAITED_S = 3.0
"""Time after which a leader logs the vehicles whose promises or acceptances a ballot lacks."""


@define
class FormationLeader(BallotRound):
    """A leader's state for one formation, or for joined formations."""

    formation: Formation
    new_ballot: Callable[[Ballot | None], Ballot]
    """Returns a new ballot, above the given one, if any."""
    rng: random.Random
    has_formed: Callable[[Formation, Mapping[Name, VehicleState]], bool]
    """Returns whether members with these states form the structure of the stage, if any."""
    rules: RuleBook = field(factory=lambda: LEADER_RULES, kw_only=True)
    phase: BallotPhase = field(default=BallotPhase.OBSERVING, kw_only=True)
    out_of_reach: frozenset[Name] = frozenset()
    """Members that cannot reach their lanes with the plan in force."""
    states: dict[Name, VehicleState] = field(factory=dict)
    """Newest state of each member."""
    ages: dict[Name, Newest] = field(factory=dict)
    """`age` of each of these states."""
    highest: Ballot | None = None
    """Highest ballot that a member has reported; members promise only higher ones."""
    awaited_log_s: float | None = None
    """Time at which to log the vehicles that the ballot awaits (node clock); None: not again."""

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
        """Members without an agent, according to their promises; they only hold."""
        return frozenset(name for name in self.roster if not self.promises[name].attended)

    def begin(self, now_s: float, *, observe: bool = True) -> None:
        """Observe the formation (L2), or prepare at once if there can be no plan yet (L3)."""
        self.now_s = now_s
        observe_members(self, None)
        self.phase = BallotPhase.OBSERVING
        if not observe:
            self.until_s = now_s
            self.take(TIME, now_s)

    def on_members(self, formation: Formation, now_s: float) -> None:
        """Update the formation from a newer census (L8)."""
        if formation == self.formation:
            return
        self.take(MEMBERS, now_s, formation)
        for vehicle in set(self.formation.roster) - set(formation.roster):
            self.states.pop(vehicle, None)
            self.ages.pop(vehicle, None)
            self.reconsider()
        self.formation = formation

    def reconsider(self) -> None:
        """Consider all lanes within reach again, so that members off their lanes are planned again.

        There is more room: a member has left, or there is another formation to join.
        """
        self.out_of_reach = frozenset()

    def on_state(self, state: VehicleState, now_s: float) -> None:
        """Handle the state of a member (L2, L4, L6, L7, L8)."""
        if self._is_news(state, now_s):
            self.states[state.vehicle] = state
            if state.record.promised is not None:
                self.highest = max(self.highest or state.record.promised, state.record.promised)
            self.take(STATE, now_s, state)

    def on_plan(self, plan: Plan, now_s: float, out_of_reach: Iterable[Name] = ()) -> None:
        """Issue the plan under the promised ballot (L5)."""
        self.out_of_reach = frozenset(out_of_reach)
        self.awaited_log_s = now_s + AWAITED_S  # planning may have taken longer
        self.take(PLANNED, now_s, plan)

    def pop_awaited(self, now_s: float) -> tuple[Name, ...]:
        """Return the vehicles that have not answered for `AWAITED_S`, once in each phase."""
        if self.awaited_log_s is None or now_s < self.awaited_log_s:
            return ()
        match self.phase:
            case BallotPhase.PREPARING:
                answered = set(self.promises)
            case BallotPhase.ISSUING:
                answered = self.accepted
            case _:
                return ()
        awaited = tuple(name for name in self.roster if name not in answered)
        if awaited:
            self.awaited_log_s = None
        return awaited

    def _is_news(self, state: VehicleState, now_s: float) -> bool:
        """Return whether a state is from a member and not older than the member's newest one."""
        name = state.vehicle
        return name in self.formation.roster and (
            self.ages.setdefault(name, Newest()).take(age(state), now_s)
        )


# --- guards and actions -----------------------------------------------------------------------


def observe_members(leader: FormationLeader, _: object) -> None:
    """Observe all members."""
    leader.states.clear()
    leader.ages.clear()
    leader.promises = {}
    leader.until_s = leader.due_s = leader.now_s + OBSERVE_S


def all_have_reported(leader: FormationLeader, _: object) -> bool:
    """All members have reported their states."""
    return all(name in leader.states for name in leader.roster)


def one_plan_is_in_force(leader: FormationLeader, _: object) -> bool:
    """All members have accepted the same ballot, and none is overdue."""
    states = [leader.states[name] for name in leader.roster]
    return len({state.record.promised for state in states}) == 1 and all(
        state.accepted and not state.overdue for state in states
    )


def adopt(leader: FormationLeader, _: object) -> None:
    """Adopt the plan: send nothing, monitor states."""
    leader.ballot = next(iter(leader.states.values())).record.promised
    leader.plan = None
    # The promises were given to another leader; acceptance implies a promise.
    leader.promises = dict(leader.states)
    leader.back_offs = 0
    # The adopted plan may reach lanes that an earlier plan could not.
    leader.out_of_reach = frozenset()


def time_is_up(leader: FormationLeader, _: object) -> bool:
    """The phase has timed out."""
    return leader.now_s >= leader.until_s


def prepare(leader: FormationLeader, _: object) -> None:
    """Send PREPARE for a new ballot, above all that members have reported."""
    leader.ballot = leader.new_ballot(leader.highest)
    leader.plan = None
    leader.promises = {}
    leader.accepted = set()
    leader.failures = 0
    leader.due_s = leader.now_s
    leader.awaited_log_s = leader.now_s + AWAITED_S


def back_off(leader: FormationLeader, _: object) -> None:
    """Pause for 0.05 to 0.3 s, doubled with each consecutive back-off."""
    pause_s = leader.rng.uniform(*BACK_OFF_S) * 2.0 ** min(leader.back_offs, MAX_BACK_OFFS)
    leader.back_offs += 1
    leader.until_s = leader.due_s = leader.now_s + pause_s


def has_joined(leader: FormationLeader, state: VehicleState) -> bool:
    """The vehicle has joined exactly the blocks of b."""
    return state.record.joined == leader.formation.numbers


def void_promise(leader: FormationLeader, state: VehicleState) -> None:
    """Discard the promise: the newest state no longer confirms it."""
    del leader.promises[state.vehicle]


def keep_ballot(leader: FormationLeader, _: object) -> None:
    """Keep the ballot; plan again after 1, 2, 4, 8, 8, ... s."""
    leader.due_s = leader.now_s + min(RETRY_S * 2.0**leader.failures, LONGEST_RETRY_S)
    leader.failures += 1


def stalls(_: FormationLeader, state: VehicleState) -> bool:
    """The vehicle's next move is overdue."""
    return state.overdue


def is_off_lane(leader: FormationLeader, state: VehicleState) -> bool:
    """The vehicle has completed the plan outside its goal lanes, which are within reach.

    An adopted plan may have been made for other targets.
    """
    return (
        leader.formation.sorts
        and state.done
        and state.attended
        and state.vehicle not in leader.out_of_reach
        and state.hold_cell[1] not in leader.formation.goal_lanes[state.vehicle]
    )


def lacks_structure(leader: FormationLeader, _: object) -> bool:
    """An adopted plan is complete, and the members do not form the structure of the stage.

    The plan may have been made for an earlier stage.
    """
    return (
        leader.plan is None
        and all(leader.states[name].done for name in leader.roster)
        and not leader.has_formed(leader.formation, leader.states)
    )


def has_new_targets(leader: FormationLeader, formation: Formation) -> bool:
    """There are new members or targets, or the structure to form has changed."""
    return formation.stage != leader.formation.stage or not (
        set(formation.members) <= set(leader.formation.members)
    )


def has_lost_member(leader: FormationLeader, formation: Formation) -> bool:
    """A member has left before completing the plan, which no other member is executing.

    The member has stopped before a closed part, so the start gates of the others stay closed. With
    an open gate, a member may no longer depend on it.
    """
    left = set(leader.formation.roster) - set(formation.roster)
    unfinished = [(name, state) for name, state in leader.states.items() if not state.done]
    under_way = any(state.go for name, state in unfinished if name not in left)
    return not under_way and any(name in left for name, _ in unfinished)


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
        Transition("L8", STATE, _IN_FORCE, (lacks_structure,), *_PREPARE),
        Transition("L8", MEMBERS, UNFINISHED, (), *_PREPARE),
        Transition("L8", MEMBERS, _IN_FORCE, (has_new_targets,), *_PREPARE),
        Transition("L8", MEMBERS, _IN_FORCE, (has_lost_member,), *_PREPARE),
    )
)
"""Rules L2 to L8 of formations."""
