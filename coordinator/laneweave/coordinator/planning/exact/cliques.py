"""Conflict cliques: sets of moves of which at most one can be made in a step.

A linear relaxation with only the pairs of conflicting moves is weak, so moves are grouped into
maximal cliques of the conflict relation that together cover every conflicting pair. With
footprints (mode 1 with node, edge and special-1; geometric) one pattern is enough: all moves whose
footprint contains a given cell. Tables computed from a geometry, and `closing`, need more.

Conflicts are the same everywhere on the lattice, so a clique is a pattern that is placed at every
cell, its anchor.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from itertools import product

from laneweave.coordinator.planning.conflict_kinds import ConflictModel, Offset, conflict_offsets
from laneweave.protocol.lattice import Mode

Clique = tuple[Offset, ...]
"""Columns and lanes from the anchor to each move's from-cell, and the displacement index."""


@lru_cache(maxsize=64)
def clique_patterns(mode: Mode, model: ConflictModel) -> tuple[Clique, ...]:
    """Return cliques that cover all pairs of moves that conflict under a model.

    Raises:
        ValueError: vehicles may share a cell under this model.
    """
    if model.vehicles_share_cells:
        raise ValueError(f"conflicts {model.kinds}: cliques need vehicles that never share a cell")
    relation = _Relation(mode, model)
    uncovered = relation.pairs()
    patterns = []
    cliques = sorted(relation.maximal_cliques(), key=lambda clique: (-len(clique), clique))
    for clique in cliques:
        pairs = {_normal_pair(a, b) for a in clique for b in clique if a < b}
        if pairs & uncovered:
            uncovered -= pairs
            patterns.append(clique)
    return tuple(patterns)


class _Relation:
    """The conflict relation around the origin; a move is an `Offset` from the anchor (0, 0)."""

    def __init__(self, mode: Mode, model: ConflictModel) -> None:
        self._conflicts = [frozenset(offsets) for offsets in conflict_offsets(mode, model)]
        columns, lanes = (range(-reach, reach + 1) for reach in model.reach)
        self._moves = list(product(columns, lanes, range(len(self._conflicts))))

    def pairs(self) -> set[tuple[Offset, Offset]]:
        """Return all conflicting pairs, unique up to translation."""
        return {
            _normal_pair((0, 0, d), other)
            for d, offsets in enumerate(self._conflicts)
            for other in offsets
            if other[:2] != (0, 0)
        }

    def maximal_cliques(self) -> set[Clique]:
        """Return all maximal cliques, unique up to translation."""
        found: set[Clique] = set()
        for d in range(len(self._conflicts)):
            origin = (0, 0, d)
            near = [b for b in self._moves if b != origin and self._exclude(origin, b)]
            near_of = {a: {b for b in near if b != a and self._exclude(a, b)} for a in near}
            for clique in _cliques(set(), set(near), set(), near_of):
                found.add(_normal((origin, *clique)))
        return found

    def _exclude(self, a: Offset, b: Offset) -> bool:
        """Return whether two moves exclude each other; vehicles never share a cell."""
        column, lane, d = b[0] - a[0], b[1] - a[1], b[2]
        return (column, lane) == (0, 0) or (column, lane, d) in self._conflicts[a[2]]


def _cliques(
    chosen: set[Offset], open_: set[Offset], closed: set[Offset], near: dict[Offset, set[Offset]]
) -> Iterator[Clique]:
    """Yield maximal cliques (Bron and Kerbosch, Communications of the ACM 16, 1973)."""
    if not open_ and not closed:
        yield tuple(chosen)
        return
    pivot = max(sorted(open_ | closed), key=lambda member: len(near[member] & open_))
    for member in sorted(open_ - near[pivot]):
        yield from _cliques(chosen | {member}, open_ & near[member], closed & near[member], near)
        open_ = open_ - {member}
        closed = closed | {member}


def _normal(members: Clique) -> Clique:
    """Return the members with their lowest from-cell as the anchor."""
    column, lane = min((member[0], member[1]) for member in members)
    return tuple(sorted((c - column, left - lane, d) for c, left, d in members))


def _normal_pair(a: Offset, b: Offset) -> tuple[Offset, Offset]:
    first, second = _normal((a, b))
    return first, second
