"""Timing of a plan: start, slot length, pauses for neighbouring formations.

When sorting, vehicles change lanes in S3 only (paper, Section 5.2.1), or in a later stage of the
road (`stages`). If the scenario does not fix T_F, a plan gets the longest slots with which each of
its moves ends in time, and begins as early as possible without any lane change before the stage.
Before the rear of the formation is in the stage, vehicles may already move along the road, and
those in it may change lanes; when its front leaves the stage, those behind may still move.

Plans stay in the blocks of their formations, so their footprints never intersect. But two moves
towards each other across the border between formations (conflict kind `closing`) would reduce the
time to collision to 0.4 T_F, and may trigger the emergency brake. Formations are planned one after
another. To avoid such moves, the later plan pauses for a slot; if there is no time for that, its
slots are shortened.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from functools import partial

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
"""Spare time if `RESERVE_S` would leave too little for comfortable moves."""
MIN_SHORTENING = 0.65
"""Minimum ratio between the slots with which a plan has time to pause and those with which it has
not; even shorter ones would bring vehicles closer to a collision than the conflicts."""

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
    """Return a plan with the longest slots with which its moves end in time, else the shortest.

    The plan pauses where its moves would have `closing` conflicts with those of its neighbours. If
    there is no time for that, its slots are shortened, by `MIN_SHORTENING` at most. If that is not
    enough, conflicts remain, and are left to the emergency brake: a late vehicle is better than
    one in a wrong lane.

    Args:
        plan: plan with the latest start: when all of its vehicles are in the stage, and those from
            ramps have settled.
        others: plans of neighbouring formations; not changed.
        not_before_s: earliest start (road time).
        end_s: returns the road time by which a move between some cells should be complete.
        scenario: road, lattice, T_F.
        from_m: position from which vehicles may change lanes; None: the start of S3.
    """
    slots_s = scenario.timing.slots_s[::-1]
    comfortable = [slot_s for slot_s in slots_s if slot_s >= scenario.timing.comfortable_cycle_s]
    neighbours = Neighbours(others, scenario.formation.slack_s)
    conflicting: Plan | None = None

    def in_time(one: Plan, reserve_s: float) -> bool:
        return all(
            one.t0_s + (1 + step) * one.slot_s <= end_s(cells) - reserve_s + TIME_TOLERANCE_S
            for moves in one.moves.values()
            for step, *cells in moves
        )

    # Prefer a smaller reserve to shorter slots.
    for slot_s, reserve_s in (
        *((slot_s, RESERVE_S) for slot_s in comfortable),
        *((slot_s, MIN_RESERVE_S) for slot_s in slots_s),
        (slots_s[-1], 0.0),
    ):
        t0_s = plan.t0_s
        if len(slots_s) > 1:
            t0_s = _start_s(plan, slot_s, not_before_s, scenario, from_m)
        last = replace(plan, t0_s=t0_s, slot_s=slot_s)
        too_short = conflicting is not None and slot_s < MIN_SHORTENING * conflicting.slot_s
        if not too_short and in_time(last, reserve_s):
            paused = neighbours.with_pauses(last, partial(in_time, reserve_s=reserve_s))
            if not neighbours.closing_steps(paused):
                return paused
            conflicting = conflicting or paused
    return conflicting or last


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
        """Collect the moves by a column, by their first column.

        Args:
            plans: plans of the neighbouring formations; not changed.
            slack_s: difference between the length of a slot and the duration of a move [s].
        """
        self._slack_s = slack_s
        self._moves: dict[int, list[tuple[float, float, Move]]] = {}
        """Begin and end (road time) of moves, and their cells."""
        for plan in plans:
            for step, move in _moves_by_column(plan):
                begin_s = plan.t0_s + step * plan.slot_s
                timed = (begin_s, begin_s + plan.slot_s - slack_s, move)
                self._moves.setdefault(move[0][0], []).append(timed)

    def closing_steps(self, plan: Plan) -> set[int]:
        """Return the steps of a plan whose moves have `closing` conflicts with the neighbours."""
        if not self._moves:
            return set()
        return {step for step, move in _moves_by_column(plan) if self._closes_up(plan, step, move)}

    def with_pauses(self, plan: Plan, in_time: Callable[[Plan], bool]) -> Plan:
        """Return a plan with pauses, so that no move has a `closing` conflict.

        All vehicles pause together, so the order of moves does not change. Conflicts remain if a
        plan with a further pause would not end in time.

        Args:
            plan: the new plan.
            in_time: returns whether a plan ends in time.
        """
        while closing := self.closing_steps(plan):
            paused = _paused(plan, min(closing))
            if not in_time(paused):
                break
            plan = paused
        return plan

    def _closes_up(self, plan: Plan, step: int, move: Move) -> bool:
        begin_s = plan.t0_s + step * plan.slot_s
        end_s = begin_s + plan.slot_s - self._slack_s
        return any(
            begin_s < their_end_s - TIME_TOLERANCE_S
            and their_begin_s < end_s - TIME_TOLERANCE_S
            and _MODEL.kind(move, theirs) is not None
            for offset in (-CLOSING_COLUMNS, CLOSING_COLUMNS)
            for their_begin_s, their_end_s, theirs in self._moves.get(move[0][0] + offset, ())
        )


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
