"""Timing of a plan: start, slot length, pauses for neighbouring formations.

When sorting, vehicles change lanes in S3 only (paper, Section 5.2.1), or in a later stage of the
road (`stages`). If the scenario does not fix T_F, a plan gets the longest slots with which each of
its moves ends in time, and begins as early as possible without any lane change before the stage.
Before the rear of the formation is in the stage, vehicles may already move along the road, and
those in it may change lanes; when its front leaves the stage, those behind may still move.

Plans stay in the blocks of their formations, so their footprints never intersect. But two moves
towards each other across the border between formations (conflict kind `closing`) would reduce the
time to collision to 0.4 T_F, and may trigger the emergency brake. Formations are planned one after
another. To avoid such moves, the later plan pauses for a slot; if there is no time for that, it
begins later by less than a slot, or its slots are shortened.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from functools import partial
from operator import itemgetter

from msgspec.structs import replace

from laneweave.coordinator.formations.roster import on_tick, start_time_s
from laneweave.coordinator.planning.conflict_kinds import CLOSING_COLUMNS, ConflictModel, Move
from laneweave.protocol.lattice import Cell
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.vehicle.plan_execution import TIME_TOLERANCE_S
from laneweave.protocol.wire.messages import Plan

RESERVE_S = 3.0
"""Spare road time after the last slot, for lost messages."""
MIN_RESERVE_S = 1.0
"""Spare time if `RESERVE_S` would leave too little for comfortable moves; none if this would leave
too little for gentle ones (decision 76)."""
DELAY_S = 0.5
"""Step between the later starts of a plan that are tried if conflicts remain in spite of pauses."""

SHORT_CONFLICT_S = 2.5
"""Maximum duration of a conflict in which vehicles keep 3 s to collision, if the slots are not
shorter than `Timing.brisk_cycle_s`."""

_MODEL = ConflictModel(("closing",))


def steps_of(plan: Plan) -> int:
    """Return the number of slots of a plan."""
    return max((1 + step for moves in plan.moves.values() for step, _, _ in moves), default=0)


def comfortable_steps(start_s: float, end_s: float, scenario: Scenario) -> int:
    """Return how many steps of comfortable length, or of a given T_F, fit between two times."""
    shortest_s, longest_s = scenario.timing.cycles_s
    if shortest_s == longest_s:
        return int((end_s - start_s) / longest_s + 1e-6)
    free_s = end_s - start_s - RESERVE_S
    return max(1, int(free_s / scenario.timing.comfortable_cycle_s + 1e-6))


def paced(
    plan: Plan,
    others: Sequence[Plan],
    not_before_s: float,
    end_s: Callable[[Collection[Cell]], float],
    scenario: Scenario,
    from_m: float | None = None,
) -> Plan:
    """Return a plan with the longest slots with which it ends in time; if none, with the shortest.

    The plan pauses where its moves would have `closing` conflicts with those of its neighbours. If
    there is no time for that, it begins later by less than a slot, or its slots are shortened: to
    `Timing.brisk_cycle_s` if a short conflict would remain otherwise, to `Timing.gentle_cycle_s` if
    a long one would. Even shorter slots bring vehicles as close to a collision as conflicts do
    (decision 76). If that is not enough, the shortest conflict remains, and is left to the
    emergency brake: a late vehicle is better than one in a wrong lane.

    Args:
        plan: plan with the latest start: when all of its vehicles are in the stage, and those from
            ramps have settled.
        others: plans of neighbouring formations; not changed.
        not_before_s: earliest start (road time).
        end_s: returns the road time by which a move between some cells should be complete.
        scenario: road, lattice, T_F.
        from_m: position from which vehicles may change lanes; None: the start of S3.
    """
    timing = scenario.timing
    slots_s = timing.slots_s[::-1]
    comfortable = [slot_s for slot_s in slots_s if slot_s >= timing.comfortable_cycle_s]
    neighbours = Neighbours(others, scenario.formation.slack_s)
    conflicting: list[tuple[float, Plan]] = []
    """Plans that end in time, and how long their conflicts last."""

    def min_slot_s() -> float:
        """Return the shortest slots that may be tried, which depend on the conflicts so far."""
        if not conflicting:
            return 0.0
        is_short = min(conflict_s for conflict_s, _ in conflicting) <= SHORT_CONFLICT_S
        limits_s = (timing.brisk_cycle_s if is_short else 0.0, timing.gentle_cycle_s)
        return max((one for one in limits_s if one <= conflicting[0][1].slot_s), default=0.0)

    def in_time(one: Plan, reserve_s: float) -> bool:
        return all(
            one.t0_s + (1 + step) * one.slot_s <= end_s(cells) - reserve_s + TIME_TOLERANCE_S
            for moves in one.moves.values()
            for step, *cells in moves
        )

    gentle = [slot_s for slot_s in slots_s if slot_s >= timing.gentle_cycle_s]
    # The shortest ones first, which leave most of the reserve.
    without_reserve = [(slot_s, 0.0) for slot_s in gentle[::-1] if slot_s != slots_s[-1]]
    # Prefer a smaller reserve to shorter slots, and none at all to slots without gentle moves.
    for slot_s, reserve_s in (
        *((slot_s, RESERVE_S) for slot_s in comfortable),
        *((slot_s, MIN_RESERVE_S) for slot_s in gentle),
        *without_reserve,
        *((slot_s, MIN_RESERVE_S) for slot_s in slots_s[len(gentle) :]),
        (slots_s[-1], 0.0),
    ):
        t0_s = plan.t0_s
        if len(slots_s) > 1:
            t0_s = _start_s(plan, slot_s, not_before_s, scenario, from_m)
        last = replace(plan, t0_s=t0_s, slot_s=slot_s)
        if slot_s < min_slot_s() or not in_time(last, reserve_s):
            continue
        if conflicting and (slot_s, reserve_s) in without_reserve:
            continue  # keep the reserve, and the shortest conflict
        paused = neighbours.with_pauses(last, partial(in_time, reserve_s=reserve_s))
        for one in (paused, *_later(last, scenario)):
            if not in_time(one, reserve_s):
                break
            conflict_s = max(neighbours.conflicts_s(one).values(), default=0.0)
            if not conflict_s:
                return one
            if (slot_s, reserve_s) not in without_reserve:
                conflicting.append((conflict_s, one))
    return min(conflicting, key=itemgetter(0))[1] if conflicting else last


def _later(plan: Plan, scenario: Scenario) -> Iterator[Plan]:
    """Yield the plan with starts that are later by less than a slot."""
    for number in range(1, math.ceil(plan.slot_s / DELAY_S)):
        yield replace(plan, t0_s=on_tick(plan.t0_s + number * DELAY_S, scenario))


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


class Neighbours:
    """Moves of neighbouring formations with which those of a new plan may have conflicts."""

    def __init__(self, plans: Iterable[Plan], slack_s: float) -> None:
        """Collect the moves that change the column.

        Args:
            plans: plans of the neighbouring formations; not changed.
            slack_s: difference between the length of a slot and the duration of a move [s].
        """
        self._slack_s = slack_s
        self._moves: dict[int, list[tuple[float, float, Move]]] = {}
        """By first column: begin and end of each move (road time), and its cells."""
        for plan in plans:
            for step, move in _moves_by_column(plan):
                begin_s = plan.t0_s + step * plan.slot_s
                timed = (begin_s, begin_s + plan.slot_s - slack_s, move)
                self._moves.setdefault(move[0][0], []).append(timed)

    def conflicts_s(self, plan: Plan) -> dict[int, float]:
        """Return the steps of a plan whose moves have `closing` conflicts, and how long these last.

        A conflict lasts as long as both moves are under way.
        """
        found: dict[int, float] = {}
        for step, move in _moves_by_column(plan) if self._moves else ():
            begin_s = plan.t0_s + step * plan.slot_s
            end_s = begin_s + plan.slot_s - self._slack_s
            for offset in (-CLOSING_COLUMNS, CLOSING_COLUMNS):
                for their_begin_s, their_end_s, theirs in self._moves.get(move[0][0] + offset, ()):
                    both_s = min(end_s, their_end_s) - max(begin_s, their_begin_s)
                    if both_s > TIME_TOLERANCE_S and _MODEL.kind(move, theirs) is not None:
                        found[step] = max(both_s, found.get(step, 0.0))
        return found

    def with_pauses(self, plan: Plan, in_time: Callable[[Plan], bool]) -> Plan:
        """Insert pauses into a plan until no move has a `closing` conflict.

        All vehicles pause together, so the order of moves does not change. Conflicts remain if a
        plan with a further pause would not end in time.

        Args:
            plan: the new plan.
            in_time: returns whether a plan ends in time.
        """
        while conflicts_s := self.conflicts_s(plan):
            paused = _paused(plan, min(conflicts_s))
            if not in_time(paused):
                break
            plan = paused
        return plan


def _moves_by_column(plan: Plan) -> Iterator[tuple[int, Move]]:
    """Yield the moves of a plan that change the column, with their steps."""
    for moves in plan.moves.values():
        for step, origin, target in moves:
            if origin[0] != target[0]:
                yield step, (origin, target)


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
