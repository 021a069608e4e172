"""Conflict rows: sets of moves of which one step admits at most one.

Pairs of conflicting moves say what is forbidden; a linear relaxation that knows only pairs is weak.
A *row* is a clique of the conflict relation: whatever the other vehicles do, at most one of its
moves is made in a step. The rows here are maximal cliques that cover every conflicting pair. With
footprints (mode 1 with node, edge and special-1; geometric) one pattern is enough: all moves
whose footprint contains a cell. Tables computed from a geometry, and `closing`, take more
patterns.

Conflicts do not depend on where on the lattice they happen, so a row is a pattern that is laid on
every cell, its anchor.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from itertools import product

from laneweave.coordinator.planning.conflicts import ConflictModel
from laneweave.coordinator.planning.grid import Mode, Move, displacements
from laneweave.coordinator.planning.moves import conflict_offsets

Member = tuple[int, int, int]
"""Columns and lanes from the anchor to the from-cell of a move, and its displacement."""


Row = tuple[Member, ...]
"""Moves of which one step admits at most one, around an anchor."""


def vehicles_share_cells(model: ConflictModel) -> bool:
    """Tell whether two vehicles may be in one cell; then moves from one cell need not exclude.

    Bodies that start in one cell or end in one are too close in every geometry.
    """
    return not {"node", "geometric"} & set(model.kinds)


@lru_cache(maxsize=64)
def row_patterns(mode: Mode, model: ConflictModel) -> tuple[Row, ...]:
    """Return rows that cover all pairs of moves that conflict under a model.

    Raises:
        ValueError: under this model vehicles may share a cell.
    """
    if vehicles_share_cells(model):
        raise ValueError(f"conflicts {model.kinds}: rows need vehicles that never share a cell")
    relation = _Relation(mode, model)
    uncovered = relation.pairs()
    rows = []
    cliques = sorted(relation.maximal_cliques(), key=lambda clique: (-len(clique), clique))
    for clique in cliques:
        pairs = {_normal_pair(a, b) for a in clique for b in clique if a < b}
        if pairs & uncovered:
            uncovered -= pairs
            rows.append(clique)
    return tuple(rows)


class _Relation:
    """Which moves around the origin conflict; a move is a `Member` of the anchor (0, 0)."""

    def __init__(self, mode: Mode, model: ConflictModel) -> None:
        self.steps = displacements(mode)
        self._mode = mode
        self._model = model
        columns, lanes = (range(-reach, reach + 1) for reach in model.reach)
        self._moves = list(product(columns, lanes, range(len(self.steps))))

    def move(self, member: Member) -> Move:
        column, lane, d = member
        step = self.steps[d]
        return (column, lane), (column + step[0], lane + step[1])

    def conflict(self, a: Member, b: Member) -> bool:
        return self._model.kind(self.move(a), self.move(b)) is not None

    def pairs(self) -> set[tuple[Member, Member]]:
        """Return all conflicting pairs, each once wherever it may lie."""
        return {
            _normal_pair((0, 0, d), other)
            for d, offsets in enumerate(conflict_offsets(self._mode, self._model))
            for other in offsets
            if other[:2] != (0, 0)
        }

    def maximal_cliques(self) -> set[Row]:
        """Return the maximal cliques that contain a move from the origin, each once."""
        found: set[Row] = set()
        for d in range(len(self.steps)):
            origin = (0, 0, d)
            near = [b for b in self._moves if b != origin and self._exclude(origin, b)]
            near_of = {a: {b for b in near if b != a and self._exclude(a, b)} for a in near}
            for clique in _cliques(set(), set(near), set(), near_of):
                found.add(_normal((origin, *clique)))
        return found

    def _exclude(self, a: Member, b: Member) -> bool:
        """Tell whether no two vehicles make both moves; none share a cell."""
        return a[:2] == b[:2] or self.conflict(a, b)


def _cliques(
    chosen: set[Member], open_: set[Member], closed: set[Member], near: dict[Member, set[Member]]
) -> Iterator[Row]:
    """Yield maximal cliques (Bron and Kerbosch, Communications of the ACM 16, 1973)."""
    if not open_ and not closed:
        yield tuple(chosen)
        return
    pivot = max(sorted(open_ | closed), key=lambda member: len(near[member] & open_))
    for member in sorted(open_ - near[pivot]):
        yield from _cliques(chosen | {member}, open_ & near[member], closed & near[member], near)
        open_ = open_ - {member}
        closed = closed | {member}


def _normal(members: Row) -> Row:
    """Return members with the anchor on the least of their from-cells."""
    column, lane = min((member[0], member[1]) for member in members)
    return tuple(sorted((c - column, left - lane, d) for c, left, d in members))


def _normal_pair(a: Member, b: Member) -> tuple[Member, Member]:
    first, second = _normal((a, b))
    return first, second
