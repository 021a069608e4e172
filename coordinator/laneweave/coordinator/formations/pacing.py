"""When the steps of a plan are driven: its first slot, and the length of all of its slots.

Lanes are changed in S3 only (paper, Section 5.2.1). Where the scenario leaves T_F open, the slots
of a plan are as long as its road allows, and a plan begins as soon as none of its lane changes
comes before S3. Moves along the road may come earlier, and so may lane changes of vehicles that
are in S3 while the rear of the formation is not.
"""

from __future__ import annotations

from collections.abc import Sequence

from attrs import evolve

from laneweave.coordinator.formations.borders import kept_apart, steps_of
from laneweave.coordinator.formations.roster import on_tick, start_time_s
from laneweave.protocol.scenario.tables import Scenario
from laneweave.protocol.wire.messages import Plan

RESERVE_S = 3.0
"""Road time behind the last slot that is left for lost messages."""
LEAST_RESERVE_S = 1.0
"""The same where moves would not be comfortable otherwise."""


def comfortable_steps(start_s: float, end_s: float, scenario: Scenario) -> int:
    """Return how many steps fit in between two road times without haste.

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
        *((slot_s, LEAST_RESERVE_S) for slot_s in slots_s),
    ):
        t0_s = plan.t0_s
        if len(slots_s) > 1:
            t0_s = _start_s(plan, slot_s, not_before_s, scenario)
        most_steps = max(0, int((end_s - t0_s) / slot_s))
        best = kept_apart(evolve(plan, t0_s=t0_s, slot_s=slot_s), others, slack_s, most_steps)
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
