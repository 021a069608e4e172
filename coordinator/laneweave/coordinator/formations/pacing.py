"""Timing of a plan: start, slot length, pauses for neighbouring formations.

When sorting, vehicles change lanes in S3 only (paper, Section 5.2.1), or in a later stage of the
road (`stages`). If the scenario does not fix T_F, a plan gets the longest slots with which each of
its moves ends in time, and begins as early as possible without any lane change before the stage.
Before the rear of the formation is in the stage, vehicles may already move along the road, and
those in it may change lanes; when its front leaves the stage, those behind may still move.

Plans stay in the blocks of their formations, so their footprints never intersect. But two moves
towards each other across the border between formations (conflict kind `closing`) would bring the
vehicles within 2.5 s of a collision, and may trigger the emergency brake. Formations are planned
one after another, and the later plan pauses for a slot, or has shorter slots, to avoid such moves.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence

from msgspec.structs import replace

from laneweave.coordinator.formations.roster import on_tick, start_time_s
from laneweave.coordinator.planning.conflict_kinds import ConflictModel, Move
from laneweave.protocol.lattice import Cell
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.vehicle.plan_execution import TIME_TOLERANCE_S
from laneweave.protocol.wire.messages import Plan

RESERVE_S = 3.0
"""Spare road time after the last slot, for lost messages."""
MIN_RESERVE_S = 1.0
"""Spare time if `RESERVE_S` would leave too little for comfortable moves."""

_MODEL = ConflictModel(("closing",))


def steps_of(plan: Plan) -> int:
    """Return the number of slots of a plan."""
    return max((1 + step for moves in plan.moves.values() for step, _, _ in moves), default=0)


def comfortable_steps(start_s: float, end_s: float, scenario: Scenario) -> int:
    """Return how many steps of comfortable length, or of a given T_F, fit between two times."""
    shortest_s, longest_s = scenario.timing.cycles_s
    if shortest_s == longest_s:
        return int((end_s - start_s) / longest_s)
    return max(1, int((end_s - start_s - RESERVE_S) / scenario.timing.comfortable_cycle_s))


def paced(
    plan: Plan,
    others: Sequence[Plan],
    not_before_s: float,
    end_s: Callable[[Collection[Cell]], float],
    scenario: Scenario,
    from_m: float | None = None,
) -> Plan:
    """Return a plan with the longest slots with which it ends in time, otherwise the shortest.

    The plan pauses where its moves would have `closing` conflicts with those of its neighbours. If
    there is no time for pauses, its slots are shorter. Only if even the shortest slots leave
    conflicts does it get the longest ones with which it ends in time in spite of them.

    Args:
        plan: plan with the latest start: when all of its vehicles are in the stage, and those from
            ramps have settled.
        others: plans of neighbouring formations; not changed.
        not_before_s: earliest start (road time).
        end_s: returns the road time by which a move between some cells should be complete.
        scenario: road, lattice, T_F.
        from_m: position from which vehicles may change lanes; None: the start of S3.
    """
    slots_s, slack_s = scenario.timing.slots_s[::-1], scenario.formation.slack_s
    comfortable = [slot_s for slot_s in slots_s if slot_s >= scenario.timing.comfortable_cycle_s]
    closing: Plan | None = None

    def in_time(one: Plan, reserve_s: float = 0.0) -> bool:
        return all(
            one.t0_s + (1 + step) * one.slot_s <= end_s(cells) - reserve_s + TIME_TOLERANCE_S
            for moves in one.moves.values()
            for step, *cells in moves
        )

    # Prefer a smaller reserve to shorter slots.
    for slot_s, reserve_s in (
        *((slot_s, RESERVE_S) for slot_s in comfortable),
        *((slot_s, MIN_RESERVE_S) for slot_s in slots_s),
    ):
        t0_s = plan.t0_s
        if len(slots_s) > 1:
            t0_s = _start_s(plan, slot_s, not_before_s, scenario, from_m)
        last = with_pauses(replace(plan, t0_s=t0_s, slot_s=slot_s), others, slack_s, in_time)
        if in_time(last, reserve_s):
            if not closing_steps(last, others, slack_s):
                return last
            closing = closing or last
    return closing or last


def _start_s(
    plan: Plan, slot_s: float, not_before_s: float, scenario: Scenario, from_m: float | None
) -> float:
    """Return the earliest start of a plan that allows no lane change before `from_m`."""
    in_time = [
        start_time_s([origin], 0.0, scenario, from_m) - step * slot_s
        for moves in plan.moves.values()
        for step, origin, target in moves
        if origin[1] != target[1]
    ]
    return min(plan.t0_s, on_tick(max([not_before_s, *in_time]), scenario))


def with_pauses(
    plan: Plan, others: Sequence[Plan], slack_s: float, in_time: Callable[[Plan], bool]
) -> Plan:
    """Return a plan with pauses, so that no move has a `closing` conflict with another plan.

    All vehicles pause together, so the order of moves does not change.

    Args:
        plan: the new plan.
        others: plans of neighbouring formations; not changed.
        slack_s: difference between the length of a slot and the duration of a move [s].
        in_time: returns whether a plan ends in time. Conflicts that remain are left to the
            emergency brake, because a late vehicle is better than one in a wrong lane.
    """
    while closing := closing_steps(plan, others, slack_s):
        paused = _paused(plan, min(closing))
        if not in_time(paused):
            break
        plan = paused
    return plan


def closing_steps(plan: Plan, others: Iterable[Plan], slack_s: float) -> set[int]:
    """Return the steps in which moves of a plan have `closing` conflicts with other plans.

    Args:
        plan: the plan.
        others: plans of neighbouring formations.
        slack_s: as in `with_pauses`.
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

    return {
        step
        for moves in plan.moves.values()
        for step, origin, target in moves
        if closes_up(step, (origin, target))
    }


def _paused(plan: Plan, pause: int) -> Plan:
    """Return a plan whose moves from step `pause` on begin one slot later."""
    return replace(
        plan,
        moves={
            vehicle: tuple(
                (step + (step >= pause), origin, target) for step, origin, target in moves
            )
            for vehicle, moves in plan.moves.items()
        },
    )
