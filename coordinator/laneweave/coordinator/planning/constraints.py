"""From a conflict to the constraints of two children.

The paper bans, for one of the two vehicles, the node (every edge into it) or the edge. Two
improvements keep every solution in the tree:

- Bicliques. Any sets S_A and S_B of moves in the same step will do as long as every move of S_A
  conflicts with every move of S_B: no solution uses both. Large sets make strong bans.
- Disjoint children. Either A makes no move of S_A, or it makes one; in the second case no other
  vehicle makes a move that conflicts with all of S_A, which includes S_B. No solution is in both
  children, so none is looked for twice. Likewise, a vehicle has arrived for good before a step,
  and then nobody passes its target any more, or it has not.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import attrs

from laneweave.coordinator.planning.diagram import Bans, Diagram
from laneweave.coordinator.planning.moves import MoveTable, bits


class Constraint(NamedTuple):
    """What one child of a split adds.

    arrived is None: in this step `vehicle` must not make a move of `own`, and no other vehicle one
        of `others`.
    arrived is True: before this step, `vehicle` has reached its target for good, and from this
        step on, no other vehicle makes a move of `others`.
    arrived is False: before this step, `vehicle` has not reached its target for good. It may wait
        there in this step and leave it later.
    """

    vehicle: int
    step: int
    own: int = 0
    others: int = 0
    arrived: bool | None = None

    def spares(self, vehicle: int, diagram: Diagram) -> bool:
        """Tell whether all paths of a vehicle's diagram satisfy this constraint."""
        if vehicle == self.vehicle:
            if self.arrived is not None:
                return (diagram.cost <= self.step) == self.arrived
            return not diagram.layer(self.step) & self.own
        if not self.arrived:
            return not diagram.layer(self.step) & self.others
        later = range(self.step, max(diagram.cost, self.step) + 1)
        return not any(diagram.layer(step) & self.others for step in later)


def bans_for(vehicle: int, constraints: Iterable[Constraint]) -> Bans:
    """Return all that is forbidden to one vehicle."""
    at: dict[int, int] = {}
    since: dict[int, int] = {}
    earliest = 0
    latest: int | None = None
    for constraint in constraints:
        step = constraint.step
        if vehicle != constraint.vehicle:
            if constraint.others:
                bans = since if constraint.arrived else at
                bans[step] = bans.get(step, 0) | constraint.others
        elif constraint.arrived:
            latest = step if latest is None else min(latest, step)
        elif constraint.arrived is not None:
            earliest = max(earliest, step + 1)
        else:
            at[step] = at.get(step, 0) | constraint.own
    return Bans(at, since, earliest, latest)


class Conflict(NamedTuple):
    """Two vehicles whose moves in this step conflict; `first` < `second`."""

    step: int
    first: int
    second: int


@attrs.frozen
class Split:
    """The constraints of two children such that every solution survives in exactly one of them.

    without, using: the vehicle that the split is about avoids the set S_A, or uses it.
    """

    without: tuple[Constraint, ...]
    using: tuple[Constraint, ...]


def rises(
    table: MoveTable, conflict: Conflict, moves: tuple[int, int], diagrams: Sequence[Diagram]
) -> int:
    """Return how many of the children of a split must cost more than their parent.

    2: cardinal, all shortest paths of both conflict in this step. 1: semi-cardinal, all shortest
    paths of one conflict with the move of the other.
    """
    first = diagrams[conflict.first].layer(conflict.step)
    second = diagrams[conflict.second].layer(conflict.step)
    against_first = table.common_conflicts(first)
    if against_first >> moves[1] & 1:
        return 1 if second & ~against_first else 2
    return table.common_conflicts(second) >> moves[0] & 1


def split_by_moves(
    table: MoveTable, conflict: Conflict, moves: tuple[int, int], diagrams: Sequence[Diagram]
) -> Split:
    """Return the split that a conflict between two moves leads to."""
    step = conflict.step
    pair = conflict.first, conflict.second
    for vehicle in pair:
        if step >= diagrams[vehicle].cost:
            return _split_by_arrival(table, vehicle, step, diagrams, ())
    layers = diagrams[pair[0]].layer(step), diagrams[pair[1]].layer(step)
    sets = _exclusive_sets(table, moves, layers)
    side = _side_to_decide(sets, layers)
    vehicle, chosen = pair[side], sets[side]
    others = table.common_conflicts(chosen)
    return Split(
        without=(Constraint(vehicle, step, chosen),),
        using=(Constraint(vehicle, step, table.valid & ~chosen, others),),
    )


def _side_to_decide(sets: tuple[int, int], layers: tuple[int, int]) -> int:
    """Return whose set covers the larger share of its shortest paths; 1 means it must pay."""
    first, second = (
        (chosen & layer).bit_count() / layer.bit_count()
        for chosen, layer in zip(sets, layers, strict=True)
    )
    return 0 if first >= second else 1


def split_by_cost(table: MoveTable, conflict: Conflict, diagrams: Sequence[Diagram]) -> Split:
    """Return the split that follows when no two shortest paths of the vehicles are compatible.

    Then one of the two must arrive later.
    """
    a, b = diagrams[conflict.first], diagrams[conflict.second]
    later = Constraint(conflict.second, b.cost, arrived=False)
    return _split_by_arrival(table, conflict.first, a.cost, diagrams, (later,))


def _split_by_arrival(
    table: MoveTable,
    vehicle: int,
    step: int,
    diagrams: Sequence[Diagram],
    more: tuple[Constraint, ...],
) -> Split:
    """Split by whether a vehicle has arrived for good before a step."""
    passing = table.conflicts[diagrams[vehicle].target]
    return Split(
        without=(Constraint(vehicle, step, arrived=False),),
        using=(Constraint(vehicle, step, others=passing, arrived=True), *more),
    )


def _exclusive_sets(
    table: MoveTable, moves: tuple[int, int], layers: tuple[int, int]
) -> tuple[int, int]:
    """Return S_A and S_B around two conflicting moves, the larger the better."""
    a, b = 1 << moves[0], 1 << moves[1]
    against_first = table.common_conflicts(layers[0])
    if against_first & b:
        return table.common_conflicts(against_first), against_first
    against_second = table.common_conflicts(layers[1])
    if against_second & a:
        return against_second, table.common_conflicts(against_second)
    return _grown(table, moves, layers)


def _grown(table: MoveTable, moves: tuple[int, int], layers: tuple[int, int]) -> tuple[int, int]:
    """Grow both sets greedily among moves on shortest paths, then among all moves."""
    conflicts = table.conflicts
    a, b = moves
    first, second = 1 << a, 1 << b
    for_first, for_second = conflicts[b], conflicts[a]
    while True:
        best = (0, 0, 0)
        for bit in bits(for_first & layers[0] & ~first):
            kept = (for_second & conflicts[bit] & layers[1]).bit_count()
            best = max(best, (kept, 0, -bit))
        for bit in bits(for_second & layers[1] & ~second):
            kept = (for_first & conflicts[bit] & layers[0]).bit_count()
            best = max(best, (kept, 1, -bit))
        kept, side, bit = best
        if not kept:
            break
        if side == 0:
            first |= 1 << -bit
            for_second &= conflicts[-bit]
        else:
            second |= 1 << -bit
            for_first &= conflicts[-bit]
    return for_first, table.common_conflicts(for_first)
