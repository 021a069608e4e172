"""Improvement of CBSA: two children of a node, for the conflict that raises their costs most.

The paper's children for all conflicts of a node overlap: a solution may be found below several of
them. One conflict is enough, since a solution contains at most one of its two moves.

- Cardinal conflicts first (Boyarski et al., IJCAI 2015): where all shortest paths of both vehicles
  conflict, both children cost more than their parent.
- Bicliques (Li et al., ICAPS 2019, call them mutex propagation and positive constraints): any sets
  S_A and S_B of moves in the same step will do as long as every move of S_A conflicts with every
  move of S_B. Either A makes no move of S_A, or it makes one; then no other vehicle makes a move
  that conflicts with all of S_A, which includes S_B. No solution satisfies both.
- Likewise, a vehicle has arrived for good before a step, and then nobody passes its target any
  more, or it has not.
"""

from __future__ import annotations

from collections.abc import Sequence

from laneweave.coordinator.planning.moves import MoveTable, bits
from laneweave.coordinator.planning.paper.constraints import Conflict, Constraint
from laneweave.coordinator.planning.paper.path_diagram import Diagram

CARDINAL = 2
"""Both children cost more than their parent."""


def rises(
    table: MoveTable, conflict: Conflict, moves: tuple[int, int], diagrams: Sequence[Diagram]
) -> int:
    """Return how many of the children of a conflict must cost more than their parent.

    2: cardinal, all shortest paths of both conflict in this step. 1: semi-cardinal, all shortest
    paths of one conflict with the move of the other.
    """
    first = diagrams[conflict.first].layer(conflict.step)
    second = diagrams[conflict.second].layer(conflict.step)
    against_first = table.common_conflicts(first)
    if against_first >> moves[1] & 1:
        return 1 if second & ~against_first else CARDINAL
    return table.common_conflicts(second) >> moves[0] & 1


def disjoint_constraints(
    table: MoveTable, conflict: Conflict, moves: tuple[int, int], diagrams: Sequence[Diagram]
) -> tuple[Constraint, Constraint]:
    """Return two constraints of which every solution satisfies exactly one."""
    step = conflict.step
    pair = conflict.first, conflict.second
    for vehicle in pair:
        if step >= diagrams[vehicle].cost:
            passing = table.conflicts[diagrams[vehicle].target]
            return (
                Constraint(vehicle, step, arrived=False),
                Constraint(vehicle, step, others=passing, arrived=True),
            )
    layers = diagrams[pair[0]].layer(step), diagrams[pair[1]].layer(step)
    sets = _exclusive_sets(table, moves, layers)
    side = _side_to_decide(sets, layers)
    vehicle, chosen = pair[side], sets[side]
    others = table.common_conflicts(chosen)
    return (
        Constraint(vehicle, step, chosen),
        Constraint(vehicle, step, table.valid & ~chosen, others),
    )


def _side_to_decide(sets: tuple[int, int], layers: tuple[int, int]) -> int:
    """Return whose set covers the larger share of its shortest paths; 1 means it must pay."""
    first, second = (
        (chosen & layer).bit_count() / layer.bit_count()
        for chosen, layer in zip(sets, layers, strict=True)
    )
    return 0 if first >= second else 1


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
