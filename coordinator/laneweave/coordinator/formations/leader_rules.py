"""The rules of a leader for one formation (L2 to L8): one table, and the names it is made of.

`FormationControl` runs by it; the first line of each function here is its meaning in
docs/PROTOCOL.md.
"""

from __future__ import annotations

from enum import Enum
from typing import TYPE_CHECKING

from laneweave.coordinator.formations.roster import Formation
from laneweave.protocol.state_machine import RuleBook, Transition, named
from laneweave.protocol.wire.messages import Name, Plan, VehicleState

if TYPE_CHECKING:
    from laneweave.coordinator.formations.control import FormationControl

OBSERVE_S = 1.0
"""How long a new leader waits for the states of a roster before it prepares (L2)."""
BACK_OFF_S = (0.05, 0.3)
"""Random pause before a leader outbids another one (L7); twice as long each time in a row, so that
one of two leaders gets the time to plan."""
MOST_BACK_OFFS = 6
"""The pause grows this often at most."""
RETRY_S = 1.0
"""First pause after failed planning; doubles with each failure (L5)."""
LONGEST_RETRY_S = 8.0
ISSUE_S = 30.0
"""A plan that is not accepted by all in this time is given up: somebody refuses it (L8)."""


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


STATE, TIME, MEMBERS = "STATE", "time", "census"
ALL, PLANNED, FAILED, TOO_LATE = "promised", "planned", "planning failed", "too late"


# --- guards and actions -----------------------------------------------------------------------


def _roster(me: FormationControl) -> tuple[Name, ...]:
    """All members on the road."""
    return me.formation.roster


def _is_news(me: FormationControl, state: VehicleState) -> bool:
    """It is from a member and not older than the newest of it."""
    known = me.states.get(state.vehicle)
    return state.vehicle in me.formation.roster and (known is None or _age(state) >= _age(known))


def _age(state: VehicleState) -> tuple[object, ...]:
    """Return what orders the states of one vehicle, older ones first.

    Between two ticks it shows states with equal times; it never promises less or takes back an
    acceptance, so a late state cannot pass for a newer one.
    """
    return (state.incarnation, state.t_s, state.promised or (), state.accepted)


def _observe(me: FormationControl, _: object) -> None:
    """Listen to all members."""
    me.states.clear()
    me.promises = {}
    me.until_s = me.due_s = me.now_s + OBSERVE_S


def _all_are_heard(me: FormationControl, _: object) -> bool:
    """All members have shown their states."""
    return all(name in me.states for name in me.plan_roster)


def _one_plan_is_in_force(me: FormationControl, _: object) -> bool:
    """All show the same ballot as accepted, nobody is overdue."""
    states = [me.states[name] for name in me.plan_roster]
    return len({state.promised for state in states}) == 1 and all(
        state.accepted and not state.overdue for state in states
    )


def _adopt(me: FormationControl, _: object) -> None:
    """Adopt: send nothing, watch."""
    me.ballot = next(iter(me.states.values())).promised
    # The promises were given to another leader; whoever has accepted has promised.
    me.promises = dict(me.states)
    me.back_offs = 0
    # Whom an earlier plan could not bring to its lane, this one may.
    me.out_of_reach = frozenset()


def _time_is_up(me: FormationControl, _: object) -> bool:
    """The phase has lasted for long enough."""
    return me.now_s >= me.until_s


def _prepare(me: FormationControl, _: object) -> None:
    """PREPARE a new ballot, above all that members have shown."""
    me.ballot = me.new_ballot(me.highest)
    me.plan = None
    me.promises = {}
    me.accepted = set()
    me.failures = 0
    me.due_s = me.now_s


def _shows_higher_promise(me: FormationControl, state: VehicleState) -> bool:
    """It promised more than b."""
    return me.ballot is not None and state.promised is not None and state.promised > me.ballot


def _back_off(me: FormationControl, _: object) -> None:
    """Pause for 0.05 to 0.3 s, twice as long each time in a row."""
    pause_s = me.rng.uniform(*BACK_OFF_S) * 2.0 ** min(me.back_offs, MOST_BACK_OFFS)
    me.back_offs += 1
    me.until_s = me.due_s = me.now_s + pause_s


def _is_promise(me: FormationControl, state: VehicleState) -> bool:
    """It promised b and has not accepted."""
    return state.promised == me.ballot and not state.accepted


def _has_joined(me: FormationControl, state: VehicleState) -> bool:
    """It has joined the formations of b and no others."""
    return state.joined == me.formation.numbers


def _count_promise(me: FormationControl, state: VehicleState) -> None:
    """Count the promise, with hold cell and incarnation."""
    me.promises[state.vehicle] = state
    if len(me.promises) == len(me.plan_roster) and not me.failures:
        me.due_s = me.now_s


def _had_promised(me: FormationControl, state: VehicleState) -> bool:
    """Its promise was counted."""
    return state.vehicle in me.promises


def _void_promise(me: FormationControl, state: VehicleState) -> None:
    """Void the promise: it has lost its memory since."""
    del me.promises[state.vehicle]


def _all_have_promised(me: FormationControl, _: object) -> bool:
    """The whole roster has promised."""
    return set(me.promises) == set(me.plan_roster)


def _may_try(me: FormationControl, _: object) -> bool:
    """The pause after failed planning is over."""
    return not me.failures or me.now_s >= me.due_s


def _order_plan(me: FormationControl, _: object) -> None:
    """Plan from the hold cells."""


def _issue(me: FormationControl, plan: Plan) -> None:
    """PLAN, the one and only of b."""
    me.plan = plan
    me.failures = 0
    me.accepted = set()
    me.due_s = me.now_s
    me.until_s = me.now_s + ISSUE_S


def _keep_ballot(me: FormationControl, _: object) -> None:
    """Keep the ballot, try again after 1, 2, 4, 8, 8, ... s."""
    me.due_s = me.now_s + min(RETRY_S * 2.0**me.failures, LONGEST_RETRY_S)
    me.failures += 1


def _restarted(me: FormationControl, state: VehicleState) -> bool:
    """Its incarnation is not the one that promised."""
    promise = me.promises.get(state.vehicle)
    return promise is None or promise.incarnation != state.incarnation


def _is_acceptance(me: FormationControl, state: VehicleState) -> bool:
    """It accepted b."""
    return state.promised == me.ballot and state.accepted


def _is_the_last(me: FormationControl, state: VehicleState) -> bool:
    """All others have accepted."""
    return me.accepted | {state.vehicle} >= set(me.plan_roster)


def _count_acceptance(me: FormationControl, state: VehicleState) -> None:
    """Count the acceptance."""
    me.accepted.add(state.vehicle)
    me.back_offs = 0


def _stalls(_: FormationControl, state: VehicleState) -> bool:
    """Its next move is overdue."""
    return state.overdue


def _is_astray(me: FormationControl, state: VehicleState) -> bool:
    """It is done on a lane that it does not prefer, though it could reach its own.

    An adopted plan may have been made for targets that this leader never saw.
    """
    return (
        me.formation.sorts
        and state.done
        and state.attended
        and state.vehicle not in me.out_of_reach
        and any(
            member.vehicle == state.vehicle and member.preferred_lane != state.hold_cell[1]
            for member in me.formation.members
        )
    )


def _has_new_targets(me: FormationControl, formation: Formation) -> bool:
    """There are new targets, new members, or another structure to take on."""
    return formation.stage != me.formation.stage or not (
        set(formation.members) <= set(me.formation.members)
    )


_UNFINISHED = (Phase.PREPARING, Phase.PLANNING, Phase.ISSUING)
_ACTIVE = (*_UNFINISHED, Phase.WATCHING)

LEADER_RULES: RuleBook = RuleBook(
    (
        Transition(
            "L2",
            STATE,
            (Phase.OBSERVING,),
            ("all_are_heard", "one_plan_is_in_force"),
            ("adopt",),
            Phase.WATCHING,
        ),
        Transition(
            "L3", STATE, (Phase.OBSERVING,), ("all_are_heard",), ("prepare",), Phase.PREPARING
        ),
        Transition("L3", TIME, (Phase.OBSERVING,), ("time_is_up",), ("prepare",), Phase.PREPARING),
        Transition(
            "L7", STATE, _ACTIVE, ("shows_higher_promise",), ("back_off",), Phase.BACKING_OFF
        ),
        Transition(
            "L7", TIME, (Phase.BACKING_OFF,), ("time_is_up",), ("observe",), Phase.OBSERVING
        ),
        Transition(
            "L4", STATE, (Phase.PREPARING,), ("is_promise", "has_joined"), ("count_promise",)
        ),
        Transition("L4", STATE, (Phase.PREPARING,), ("had_promised",), ("void_promise",)),
        Transition(
            "L5",
            ALL,
            (Phase.PREPARING,),
            ("all_have_promised", "may_try"),
            ("order_plan",),
            Phase.PLANNING,
        ),
        Transition("L5", PLANNED, (Phase.PLANNING,), (), ("issue",), Phase.ISSUING),
        Transition("L5", FAILED, (Phase.PLANNING,), (), ("keep_ballot",), Phase.PREPARING),
        Transition("L5", TOO_LATE, (Phase.PLANNING,), (), (), Phase.SETTLED),
        Transition(
            "L8",
            STATE,
            (Phase.PLANNING, Phase.ISSUING, Phase.WATCHING),
            ("restarted",),
            ("prepare",),
            Phase.PREPARING,
        ),
        Transition(
            "L6",
            STATE,
            (Phase.ISSUING,),
            ("is_acceptance", "is_the_last"),
            ("count_acceptance",),
            Phase.WATCHING,
        ),
        Transition("L6", STATE, (Phase.ISSUING,), ("is_acceptance",), ("count_acceptance",)),
        Transition("L8", TIME, (Phase.ISSUING,), ("time_is_up",), ("prepare",), Phase.PREPARING),
        Transition("L8", STATE, (Phase.WATCHING,), ("stalls",), ("prepare",), Phase.PREPARING),
        Transition("L8", STATE, (Phase.WATCHING,), ("is_astray",), ("prepare",), Phase.PREPARING),
        Transition("L8", MEMBERS, _UNFINISHED, (), ("prepare",), Phase.PREPARING),
        Transition(
            "L8",
            MEMBERS,
            (Phase.WATCHING,),
            ("has_new_targets",),
            ("prepare",),
            Phase.PREPARING,
        ),
    ),
    named(
        _roster,
        _is_news,
        _observe,
        _all_are_heard,
        _one_plan_is_in_force,
        _adopt,
        _time_is_up,
        _prepare,
        _shows_higher_promise,
        _back_off,
        _is_promise,
        _has_joined,
        _count_promise,
        _had_promised,
        _void_promise,
        _all_have_promised,
        _may_try,
        _order_plan,
        _issue,
        _keep_ballot,
        _restarted,
        _is_acceptance,
        _is_the_last,
        _count_acceptance,
        _stalls,
        _is_astray,
        _has_new_targets,
    ),
)
"""Rules L2 to L8; L1 is `election.Election`, joining formations is `groups.Groups`."""
