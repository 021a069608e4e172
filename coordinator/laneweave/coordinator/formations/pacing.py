"""When the steps of a plan are driven: start, length of all slots, pauses for neighbours.

Lanes are changed in S3 only (paper, Section 5.2.1). Where the scenario leaves T_F open, the slots
of a plan are as long as its road allows, and a plan begins as soon as none of its lane changes
comes before S3. Moves along the road may come earlier, and so may lane changes of vehicles that
are in S3 while the rear of the formation is not.

Plans stay in the blocks of their formations, so their footprints never meet. But a move may close
up head-on with one of a neighbouring formation across the border of their blocks (conflict kind
`closing`), and then the emergency brake acts. Formations are planned one after the other: the later
plan pauses for a slot where it would close up.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from attrs import evolve

from laneweave.coordinator.formations.roster import on_tick, start_time_s
from laneweave.coordinator.planning.conflict_model import ConflictModel, Move
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.vehicle.plan_execution import TIME_TOLERANCE_S
from laneweave.protocol.wire.messages import Plan

RESERVE_S = 3.0
"""Road time after the last slot that is left for lost messages."""
MIN_RESERVE_S = 1.0
"""The same where moves would not be comfortable otherwise."""

_MODEL = ConflictModel(("closing",))


def steps_of(plan: Plan) -> int:
    """Return how many slots a plan takes."""
    return max((1 + step for moves in plan.moves.values() for step, _, _ in moves), default=0)


def comfortable_steps(start_s: float, end_s: float, scenario: Scenario) -> int:
    """Return how many comfortable steps fit in between two road times.

    Where T_F is given, as many as fit in.
    """
    shortest_s, longest_s = scenario.cycles_s
    if shortest_s == longest_s:
        return int((end_s - start_s) / longest_s)
    return max(1, int((end_s - start_s - RESERVE_S) / scenario.comfortable_cycle_s))


def paced(
    plan: Plan, others: Sequence[Plan], not_before_s: float, end_s: float, scenario: Scenario
) -> Plan:
    """Return a plan in the longest slots in which it ends in time; if none are, in the shortest.

    It pauses for slots in which it would come too close to plans of its neighbours.

    Args:
        plan: as it was planned; it begins when all of its vehicles are where they may change lanes.
        others: plans of neighbouring formations; they stay as they are.
        not_before_s: road time before which it cannot begin.
        end_s: road time by which it should have ended.
        scenario: road, lattice, T_F.
    """
    slots_s, slack_s = scenario.slots_s[::-1], scenario.formation.slack_s
    comfortable = [slot_s for slot_s in slots_s if slot_s >= scenario.comfortable_cycle_s]
    best = plan
    # Prefer a smaller reserve to shorter slots.
    for slot_s, reserve_s in (
        *((slot_s, RESERVE_S) for slot_s in comfortable),
        *((slot_s, MIN_RESERVE_S) for slot_s in slots_s),
    ):
        t0_s = plan.t0_s
        if len(slots_s) > 1:
            t0_s = _start_s(plan, slot_s, not_before_s, scenario)
        max_steps = max(0, int((end_s - t0_s) / slot_s))
        best = with_pauses(evolve(plan, t0_s=t0_s, slot_s=slot_s), others, slack_s, max_steps)
        if t0_s + steps_of(best) * slot_s <= end_s - reserve_s:
            return best
    return best


def _start_s(plan: Plan, slot_s: float, not_before_s: float, scenario: Scenario) -> float:
    """Return the first road time at which no lane change comes before S3."""
    in_time = [
        start_time_s([origin], 0.0, scenario) - step * slot_s
        for moves in plan.moves.values()
        for step, origin, target in moves
        if origin[1] != target[1]
    ]
    return min(plan.t0_s, on_tick(max([not_before_s, *in_time]), scenario))


def with_pauses(plan: Plan, others: Iterable[Plan], slack_s: float, max_steps: int) -> Plan:
    """Return a plan with pauses, so that none of its moves closes up with one of other plans.

    All vehicles pause together, so the order of moves stays as it was planned.

    Args:
        plan: the new one.
        others: of neighbouring formations; they stay as they are.
        slack_s: how much shorter a move is than the slot of its plan [s].
        max_steps: how many slots there are. What still closes up when they are used up is left to
            the brake: better late than on a wrong lane.
    """
    theirs = [
        (other.t0_s + step * other.slot_s, other.slot_s - slack_s, (origin, target))
        for other in others
        for moves in other.moves.values()
        for step, origin, target in moves
    ]

    def closes_up(step: int, move: Move) -> bool:
        begin_s = plan.t0_s + step * plan.slot_s
        return any(
            begin_s < other_s + other_lasts_s - TIME_TOLERANCE_S
            and other_s < begin_s + plan.slot_s - slack_s - TIME_TOLERANCE_S
            and _MODEL.kind(move, other) is not None
            for other_s, other_lasts_s, other in theirs
        )

    while steps_of(plan) < max_steps:
        closing = [
            step
            for moves in plan.moves.values()
            for step, origin, target in moves
            if closes_up(step, (origin, target))
        ]
        if not closing:
            break
        plan = _paused(plan, min(closing))
    return plan


def _paused(plan: Plan, pause: int) -> Plan:
    """Return a plan whose moves of a step, and all after them, begin a slot later."""
    return evolve(
        plan,
        moves={
            vehicle: tuple(
                (step + (step >= pause), origin, target) for step, origin, target in moves
            )
            for vehicle, moves in plan.moves.items()
        },
    )
