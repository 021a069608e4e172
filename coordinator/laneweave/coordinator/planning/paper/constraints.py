"""Conflicts and constraints of the constraint tree (paper, section `cppm`).

A conflict C^f between two vehicles has an entry for each, written {N | (x, y), step, id} or {E |
(x1, y1), (x2, y2), step, id}; the constraint C^t derived from it is written in the same way and
forbids that vehicle to enter the node, or to travel along the edge, in that step.

The paper's children for all conflicts of a node overlap: a solution may be found below several of
them. One conflict is enough, since a solution contains at most one of its two moves. Improvements
to the paper's tree (`cbs.Improvements`) use this:

- Cardinal conflicts first (Boyarski et al., IJCAI 2015): where all shortest paths of both vehicles
  conflict, both children cost more than their parent (`cardinality`).
- Bicliques (Li et al., ICAPS 2019, call them mutex propagation and positive constraints): S_A and
  S_B may be any sets of moves in the same step such that every move of S_A conflicts with every
  move of S_B. Either A makes no move of S_A, or A makes one and no other vehicle makes a move that
  conflicts with all of S_A; this excludes all of S_B. No solution satisfies both
  (`disjoint_constraints`).
- Likewise, either a vehicle has arrived for good before a step and no other vehicle crosses its
  target from then on, or it has not.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from laneweave.coordinator.planning.problem import Bans, Diagram, MoveTable, bits
from laneweave.protocol.lattice import Cell

CARDINAL = 2
"""Both children cost more than their parent."""


class Conflict(NamedTuple):
    """Two vehicles whose moves in a step conflict; `first` < `second`, steps count from 0.

    on_edge: false for a node conflict. Node conflicts sort first in each step.
    """

    step: int
    on_edge: bool
    first: int
    second: int


class Constraint(NamedTuple):
    """The constraint that a child adds to its parent's constraints; steps count from 0.

    The paper's constraints forbid one vehicle a set of moves, `own`. `others` and `arrived`
    belong to the improvement `bicliques`.

    arrived is None: in this step, `vehicle` must not make a move in `own`, and no other vehicle
        may make a move in `others`.
    arrived is True: `vehicle` has arrived for good at its target before this step, and from this
        step on, no other vehicle makes a move in `others`.
    arrived is False: `vehicle` has not arrived for good before this step. It may wait at its
        target in this step and leave it later.
    """

    vehicle: int
    step: int
    own: int = 0
    others: int = 0
    arrived: bool | None = None

    def is_satisfied_by(self, vehicle: int, diagram: Diagram) -> bool:
        """Return whether all paths of a vehicle's diagram satisfy this constraint."""
        if vehicle == self.vehicle:
            if self.arrived is not None:
                return (diagram.cost <= self.step) == self.arrived
            return not diagram.layer(self.step) & self.own
        if not self.others:
            return True
        if not self.arrived:
            return not diagram.layer(self.step) & self.others
        later = range(self.step, max(diagram.cost, self.step) + 1)
        return not any(diagram.layer(step) & self.others for step in later)

    def notation(self, table: MoveTable, name: str) -> str:
        """Return the paper's notation, extended for the constraints of the improvements.

        The first move is in step 1, and cells count from 0 as in requests. {S | edges, step, id}:
        none of these edges; {U | edges, step, id}: one of these; {A | step, id}: arrived for good
        before this step; {B | step, id}: not arrived for good before it.
        """
        end = f"{self.step + 1}, {name}}}"
        if self.arrived is not None:
            return f"{{{'A' if self.arrived else 'B'} | {end}"
        if self.others:
            return f"{{U | {_edges(table, table.valid & ~self.own)}, {end}"
        landing = table.landing(self.own.bit_length() - 1)
        if self.own == table.leading_to(1 << landing):
            return entry(table, landing, name, self.step, at_node=True)
        if self.own & (self.own - 1):
            return f"{{S | {_edges(table, self.own)}, {end}"
        return entry(table, self.own.bit_length() - 1, name, self.step, at_node=False)


def entry(table: MoveTable, move: int, name: str, step: int, *, at_node: bool) -> str:
    """Return {N | (x, y), step, id} or {E | (x1, y1), (x2, y2), step, id} for a vehicle's move."""
    cells = table.move(move)[1:] if at_node else table.move(move)
    kind = "N" if at_node else "E"
    return f"{{{kind} | {', '.join(map(_cell, cells))}, {step + 1}, {name}}}"


def _edges(table: MoveTable, moves: int) -> str:
    return " ".join("-".join(map(_cell, table.move(move))) for move in bits(moves))


def _cell(cell: Cell) -> str:
    return f"({cell[0]},{cell[1]})"


def constraints_of(
    table: MoveTable, conflict: Conflict, moves: tuple[int, int]
) -> tuple[Constraint, Constraint]:
    """Return the constraints C^t of both vehicles of a conflict (paper, definition `constraint`).

    A node conflict forbids all moves to the node; any other conflict forbids only the move itself.
    """
    first, second = (
        1 << move if conflict.on_edge else table.leading_to(1 << table.landing(move))
        for move in moves
    )
    return (
        Constraint(conflict.first, conflict.step, first),
        Constraint(conflict.second, conflict.step, second),
    )


def is_at_node(table: MoveTable, a: int, b: int) -> bool:
    """Return whether two conflicting moves form a node conflict, the first of the kinds."""
    return "node" in table.model.kinds and table.landing(a) == table.landing(b)


def bans_for(vehicle: int, constraints: Iterable[Constraint]) -> Bans:
    """Return the bans that constraints impose on one vehicle."""
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


def cardinality(
    table: MoveTable, conflict: Conflict, moves: tuple[int, int], diagrams: Sequence[Diagram]
) -> int:
    """Return how many children of a conflict are certain to cost more than their parent.

    2: cardinal, all shortest paths of both vehicles conflict in this step. 1: semi-cardinal, all
    shortest paths of one vehicle conflict with the other's move.
    """
    first = diagrams[conflict.first].layer(conflict.step)
    second = diagrams[conflict.second].layer(conflict.step)
    excluded_by_first = table.common_conflicts(first)
    if excluded_by_first >> moves[1] & 1:
        return 1 if second & ~excluded_by_first else CARDINAL
    return table.common_conflicts(second) >> moves[0] & 1


def disjoint_constraints(
    table: MoveTable, conflict: Conflict, moves: tuple[int, int], diagrams: Sequence[Diagram]
) -> tuple[Constraint, Constraint]:
    """Return two constraints such that every solution satisfies exactly one of them."""
    step = conflict.step
    pair = conflict.first, conflict.second
    for vehicle in pair:
        if step >= diagrams[vehicle].cost:
            crossing = table.conflicts[diagrams[vehicle].target]
            return (
                Constraint(vehicle, step, arrived=False),
                Constraint(vehicle, step, others=crossing, arrived=True),
            )
    layers = diagrams[pair[0]].layer(step), diagrams[pair[1]].layer(step)
    sets = _exclusive_sets(table, moves, layers)
    side = _side_to_branch_on(sets, layers)
    vehicle, chosen = pair[side], sets[side]
    others = table.common_conflicts(chosen)
    return (
        Constraint(vehicle, step, chosen),
        Constraint(vehicle, step, table.valid & ~chosen, others),
    )


def _side_to_branch_on(sets: tuple[int, int], layers: tuple[int, int]) -> int:
    """Return the vehicle (0 or 1) whose set covers the larger share of its shortest paths.

    If the share is 1, forbidding the set raises the vehicle's cost.
    """
    first, second = (
        (chosen & layer).bit_count() / layer.bit_count()
        for chosen, layer in zip(sets, layers, strict=True)
    )
    return 0 if first >= second else 1


def _exclusive_sets(
    table: MoveTable, moves: tuple[int, int], layers: tuple[int, int]
) -> tuple[int, int]:
    """Return large sets S_A and S_B that contain one of two conflicting moves each."""
    a, b = 1 << moves[0], 1 << moves[1]
    excluded_by_first = table.common_conflicts(layers[0])
    if excluded_by_first & b:
        return table.common_conflicts(excluded_by_first), excluded_by_first
    excluded_by_second = table.common_conflicts(layers[1])
    if excluded_by_second & a:
        return excluded_by_second, table.common_conflicts(excluded_by_second)
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
