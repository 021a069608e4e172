"""The paper's conflict model: pairs of moves that must not be made in the same step.

Section "Conflict model" defines node conflicts, edge conflicts and four special types of edge
conflict. Which special types matter depends on the lane width and on the column pitch, so each can
be selected separately. Every kind is symmetric in the two vehicles.

Two kinds go beyond the paper. `geometric` compares footprints, the cells that the execution
protocol reserves, or uses a `ConflictTable` computed from sizes and motions (`geometry`).
`closing` leaves enough distance for emergency braking.

Conflicts depend only on the relative position of two vehicles, so one table of offsets serves all
grids (`conflict_offsets`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from functools import lru_cache
from itertools import product
from typing import Final

import attrs

from laneweave.protocol.lattice import Cell, Mode, displacements, footprint
from laneweave.protocol.scenario.formation_table import CONFLICT_KINDS

Move = tuple[Cell, Cell]
"""From-cell and to-cell of one step; the same cell if the vehicle waits."""
Pair = tuple[Cell, Cell, Cell]
"""Offset from A's cell to B's, displacement of A, displacement of B."""
Offset = tuple[int, int, int]
"""Columns and lanes from A's cell to B's, and the index of B's displacement."""
ConflictTable = frozenset[Pair]
"""The pairs of moves that bring two bodies too close; see `geometry.conflict_table`."""

PAPER_KINDS: Final = ("node", "edge", "special-1", "special-2", "special-3", "special-4")

MAX_OFFSET: Final = 2
"""Maximum column or lane distance between conflicting from-cells; but see `_COLUMNS_OF_KIND`."""
CLOSING_COLUMNS: Final = 3
"""Column distance of two vehicles with two free columns between them."""
_COLUMNS_OF_KIND: Final = {"closing": CLOSING_COLUMNS}

_WAIT, _LONGITUDINAL, _LATERAL, _OBLIQUE = product((False, True), repeat=2)


def _direction(move: Move) -> tuple[bool, bool]:
    """Return whether a move changes lanes and whether it changes columns."""
    return move[0][1] != move[1][1], move[0][0] != move[1][0]


def _node(a: Move, b: Move) -> bool:
    """Return whether both end in the same cell; one may be waiting there."""
    return a[1] == b[1]


def _edge(a: Move, b: Move) -> bool:
    """Return whether both move and share a midpoint: they swap cells or cross diagonally."""
    if a[0] == a[1] or b[0] == b[1]:
        return False
    return a[0][0] + a[1][0] == b[0][0] + b[1][0] and a[0][1] + a[1][1] == b[0][1] + b[1][1]


def _special_1(a: Move, b: Move) -> bool:
    """Return whether A moves into the cell that B is leaving."""
    return a[1] == b[0] and a[0] != a[1] and b[0] != b[1]


def _triangle(a: Move, b: Move) -> bool:
    """Return whether A is oblique and B starts or ends at a corner of the square of A's cells.

    The corner and A's cells form a right triangle. B's other cell may lie outside the square: a
    vehicle that enters or leaves the corner blocks A as much as one that stays (ADR 27).
    """
    corners = {(a[0][0], a[1][1]), (a[1][0], a[0][1])}
    return _direction(a) == _OBLIQUE and not corners.isdisjoint(b)


def _geometric(a: Move, b: Move) -> bool:
    return not footprint(*a).isdisjoint(footprint(*b))


def _closing(a: Move, b: Move) -> bool:
    """Return whether A moves forwards and B, three columns ahead in a common lane, backwards."""
    return (
        a[1][0] - a[0][0] == 1
        and b[1][0] - b[0][0] == -1
        and b[0][0] - a[0][0] == CLOSING_COLUMNS
        and not {a[0][1], a[1][1]}.isdisjoint((b[0][1], b[1][1]))
    )


_PREDICATES: Final[dict[str, Callable[[Move, Move], bool]]] = {
    "node": _node,
    "edge": _edge,
    "special-1": _special_1,
    "special-2": lambda a, b: _direction(b) == _LONGITUDINAL and _triangle(a, b),
    "special-3": lambda a, b: _direction(b) == _LATERAL and _triangle(a, b),
    "special-4": lambda a, b: _direction(b) == _WAIT and _triangle(a, b),
    "geometric": _geometric,
    "closing": _closing,
}


def _as_kinds(kinds: Iterable[str]) -> tuple[str, ...]:
    chosen = frozenset(kinds)
    unknown = chosen.difference(CONFLICT_KINDS)
    if unknown:
        known = ", ".join(CONFLICT_KINDS)
        raise ValueError(f"unknown conflict kinds {sorted(unknown)}; known: {known}")
    return tuple(kind for kind in CONFLICT_KINDS if kind in chosen)


@attrs.frozen
class ConflictModel:
    """The kinds of conflict that a plan must avoid, in the order of `CONFLICT_KINDS`.

    node: both vehicles end in the same cell, including a move into a waiting vehicle's cell.
    edge: the two paths cross or overlap: a swap, or crossing diagonals.
    special-1: A moves into B's current cell while B moves to another one; this also forbids trains
        of vehicles moving in the same direction.
    special-2, special-3, special-4: A moves obliquely; B moves longitudinally, moves laterally or
        stays, respectively. Three of their initial and target cells form a right triangle: B
        leaves, enters or stays at a corner of the square of A's cells.
    geometric: without a table, the footprints intersect (`lattice.footprint`), which the execution
        protocol reserves, so moves without this conflict are safe at any lateness. It contains
        all kinds above and any `ConflictTable`. With a table: exactly the pairs in the table.
    closing: A moves forwards, straight or obliquely, B moves backwards and starts three columns
        ahead of A, and some lane is the from-lane or to-lane of both. No other kind contains it.
    """

    kinds: tuple[str, ...] = attrs.field(converter=_as_kinds)
    table: ConflictTable | None = None

    def __attrs_post_init__(self) -> None:
        """Check that the table is used.

        Raises:
            ValueError: there is a table, but `geometric` is not among the kinds.
        """
        if self.table is not None and "geometric" not in self.kinds:
            raise ValueError(f"a conflict table for conflict kinds {self.kinds}, without geometric")

    @property
    def reach(self) -> Cell:
        """Maximum column and lane distance between the from-cells of conflicting moves."""
        columns = max(_COLUMNS_OF_KIND.get(kind, MAX_OFFSET) for kind in self.kinds or ("node",))
        return columns, MAX_OFFSET

    @property
    def vehicles_share_cells(self) -> bool:
        """Whether two vehicles may share a cell.

        Bodies that start or end in the same cell are too close in every geometry.
        """
        return not {"node", "geometric"} & set(self.kinds)

    def kind(self, a: Move, b: Move) -> str | None:
        """Return the first kind of conflict between two moves made in the same step, or None.

        The order of the moves does not matter.
        """
        for kind in self.kinds:
            if kind == "geometric" and self.table is not None:
                pair = _difference(a[0], b[0]), _difference(*a), _difference(*b)
                if pair in self.table:
                    return kind
                continue
            predicate = _PREDICATES[kind]
            if predicate(a, b) or predicate(b, a):
                return kind
        return None


def _difference(cell: Cell, other: Cell) -> Cell:
    return other[0] - cell[0], other[1] - cell[1]


@lru_cache(maxsize=64)
def conflict_offsets(mode: Mode, model: ConflictModel) -> tuple[tuple[Offset, ...], ...]:
    """Return, for each displacement of A, the offsets and displacements of B that conflict."""
    steps = displacements(mode)
    columns, lanes = (range(-reach, reach + 1) for reach in model.reach)

    def conflicting(step: Cell) -> Iterator[Offset]:
        for column, lane, (e, other) in product(columns, lanes, enumerate(steps)):
            b = (column, lane), (column + other[0], lane + other[1])
            if model.kind(((0, 0), step), b) is not None:
                yield column, lane, e

    return tuple(tuple(conflicting(step)) for step in steps)
