"""Conflicts and constraints of the constraint tree (paper, section `cppm`).

A conflict C^f of two vehicles has an entry for each of them, written {N | (x, y), step, id} or
{E | (x1, y1), (x2, y2), step, id}; the constraint C^t made of it is written in the same way and
forbids that vehicle to arrive at the node, or to travel along the edge, in that step.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from laneweave.coordinator.planning.grid import Cell
from laneweave.coordinator.planning.moves import MoveTable, bits
from laneweave.coordinator.planning.paper.path_diagram import Bans, Diagram


class Conflict(NamedTuple):
    """Two vehicles whose moves in a step conflict; `first` < `second`, steps count from 0.

    on_edge: it is no node conflict. In a list, node conflicts come first in each step.
    """

    step: int
    on_edge: bool
    first: int
    second: int


class Constraint(NamedTuple):
    """What a child adds to the constraints of its parent; steps count from 0.

    The paper's constraints forbid a set of moves to one vehicle: `own`. The others belong to the
    improvement `splits`.

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
        if not self.others:
            return True
        if not self.arrived:
            return not diagram.layer(self.step) & self.others
        later = range(self.step, max(diagram.cost, self.step) + 1)
        return not any(diagram.layer(step) & self.others for step in later)

    def notation(self, table: MoveTable, name: str) -> str:
        """Return the paper's notation, extended for the constraints of `splits`.

        Steps count from 1, cells as in requests from 0. {S | edges, step, id}: none of these
        edges; {U | edges, step, id}: one of these; {A | step, id}: at the target for good before
        this step; {B | step, id}: not so.
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

    A node conflict forbids all moves to the node, any other one the move that is an edge.
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
    """Tell whether two conflicting moves are a node conflict, the first of the kinds."""
    return "node" in table.model.kinds and table.landing(a) == table.landing(b)


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
