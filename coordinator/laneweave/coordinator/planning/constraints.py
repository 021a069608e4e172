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

from collections.abc import Sequence

import attrs

from laneweave.coordinator.planning.diagram import Bans, Diagram
from laneweave.coordinator.planning.moves import MoveTable, bits


@attrs.frozen
class Constraint:
    """A restriction of one vehicle.

    It must not make any of the `banned` moves in this step, nor later if `lasting`. If `arrived`
    is set, it must have reached its target for good before this step.
    """

    vehicle: int
    step: int
    banned: int
    lasting: bool = False
    arrived: bool = False

    def spares(self, diagram: Diagram) -> bool:
        """Tell whether all paths of a diagram satisfy this constraint."""
        if self.arrived:
            return diagram.cost <= self.step
        if not self.lasting:
            return not diagram.layer(self.step) & self.banned
        later = range(self.step, max(diagram.cost, self.step) + 1)
        return not any(diagram.layer(step) & self.banned for step in later)

    def added_to(self, bans: Bans) -> Bans:
        """Return the bans of the vehicle with this constraint."""
        at, since, latest = bans.at, bans.since, bans.latest
        if self.arrived:
            latest = self.step if latest is None else min(latest, self.step)
        elif self.lasting:
            since = {**since, self.step: since.get(self.step, 0) | self.banned}
        else:
            at = {**at, self.step: at.get(self.step, 0) | self.banned}
        return Bans(at, since, latest)


@attrs.frozen(order=True)
class Conflict:
    """Two vehicles whose moves in this step conflict; `first` < `second`."""

    step: int
    first: int
    second: int


@attrs.frozen
class Split:
    """The constraints of two children such that every solution survives in exactly one of them.

    without, using: the vehicle that the split is about avoids the set S_A, or uses it.
    rises: how many of the two children surely cost more than their parent (2: cardinal).
    """

    without: tuple[Constraint, ...]
    using: tuple[Constraint, ...]
    rises: int


def split_by_moves(
    table: MoveTable, conflict: Conflict, moves: tuple[int, int], diagrams: Sequence[Diagram]
) -> Split:
    """Return the split that a conflict between two moves leads to."""
    step = conflict.step
    pair = conflict.first, conflict.second
    layers = diagrams[pair[0]].layer(step), diagrams[pair[1]].layer(step)
    sets = _exclusive_sets(table, moves, layers)
    raises = not layers[0] & ~sets[0], not layers[1] & ~sets[1]
    if step >= diagrams[pair[0]].cost:
        return _split_by_arrival(table, pair[0], step, diagrams, (), sum(raises))
    if step >= diagrams[pair[1]].cost:
        return _split_by_arrival(table, pair[1], step, diagrams, (), sum(raises))
    side = _side_to_decide(raises, sets, layers)
    vehicle, chosen = pair[side], sets[side]
    others = table.common_conflicts(chosen)
    return Split(
        (Constraint(vehicle, step, chosen),),
        (
            Constraint(vehicle, step, table.valid & ~chosen),
            *(Constraint(i, step, others) for i in range(len(diagrams)) if i != vehicle),
        ),
        sum(raises),
    )


def _side_to_decide(
    raises: tuple[bool, bool], sets: tuple[int, int], layers: tuple[int, int]
) -> int:
    """Return which vehicle the split is about: one that must pay, else the more restricted one."""
    if raises[0] != raises[1]:
        return 0 if raises[0] else 1
    share = [
        (s & layer).bit_count() / layer.bit_count() for s, layer in zip(sets, layers, strict=True)
    ]
    return 0 if share[0] >= share[1] else 1


def split_by_cost(table: MoveTable, conflict: Conflict, diagrams: Sequence[Diagram]) -> Split:
    """Return the split that follows when no two shortest paths of the vehicles are compatible.

    Then one of the two must arrive later, that is, must not yet wait at its target.
    """
    a, b = diagrams[conflict.first], diagrams[conflict.second]
    later = Constraint(conflict.second, b.cost, 1 << b.target)
    return _split_by_arrival(table, conflict.first, a.cost, diagrams, (later,), 2)


def _split_by_arrival(
    table: MoveTable,
    vehicle: int,
    step: int,
    diagrams: Sequence[Diagram],
    more: tuple[Constraint, ...],
    rises: int,
) -> Split:
    """Split by whether a vehicle has arrived for good before a step."""
    target = diagrams[vehicle].target
    passing = table.conflicts[target]
    return Split(
        (Constraint(vehicle, step, 1 << target),),
        (
            Constraint(vehicle, step, 0, arrived=True),
            *(
                Constraint(i, step, passing, lasting=True)
                for i in range(len(diagrams))
                if i != vehicle
            ),
            *more,
        ),
        rises,
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
