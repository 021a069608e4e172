"""The paper's conflict model: which two moves must not be made in the same step.

Section "Conflict model" defines node conflicts, edge conflicts and four special types of edge
conflict. Which special types matter depends on the width of the lanes and on the column pitch, so
each can be chosen on its own. Every kind is symmetric in the two vehicles.

Two kinds go beyond the paper. `geometric` by itself means footprints: rectangles of cells, which
the execution protocol reserves. With a `Geometry` it is the table computed from that
(`clearances`). `closing` keeps the room that an emergency brake needs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Final

import attrs

from laneweave.coordinator.planning.geometry.conflict_table import FARTHEST, close_pairs
from laneweave.coordinator.planning.geometry.settings import Geometry
from laneweave.coordinator.planning.grid import Cell, Mode, Move

PAPER_KINDS: Final = ("node", "edge", "special-1", "special-2", "special-3", "special-4")

KINDS: Final = (*PAPER_KINDS, "geometric", "closing")

DEFAULT_KINDS: Final[dict[Mode, tuple[str, ...]]] = {
    1: ("node", "edge", "special-1"),
    2: ("geometric",),
}

CLOSING_COLUMNS: Final = 3
"""From-cells of two vehicles that close up from two free columns to none."""


def is_wait(move: Move) -> bool:
    """Tell whether the vehicle stays in its cell."""
    return move[0] == move[1]


def is_oblique(move: Move) -> bool:
    """Tell whether the move changes column and lane at once."""
    return move[0][0] != move[1][0] and move[0][1] != move[1][1]


def is_longitudinal(move: Move) -> bool:
    """Tell whether the move changes the column only."""
    return move[0][0] != move[1][0] and move[0][1] == move[1][1]


def is_lateral(move: Move) -> bool:
    """Tell whether the move changes the lane only."""
    return move[0][0] == move[1][0] and move[0][1] != move[1][1]


def corners(move: Move) -> frozenset[Cell]:
    """Return the two cells that an oblique move passes between."""
    return frozenset({(move[0][0], move[1][1]), (move[1][0], move[0][1])})


def footprint(move: Move) -> frozenset[Cell]:
    """Return the cells which the execution protocol reserves for a move."""
    cells = frozenset(move)
    return cells | corners(move) if is_oblique(move) else cells


def _node(a: Move, b: Move) -> bool:
    """Both arrive at the same cell, or one moves to where the other waits."""
    return a[1] == b[1]


def _edge(a: Move, b: Move) -> bool:
    """The paths overlap (swap) or cross (two diagonals): both move, with one common midpoint."""
    if is_wait(a) or is_wait(b):
        return False
    return a[0][0] + a[1][0] == b[0][0] + b[1][0] and a[0][1] + a[1][1] == b[0][1] + b[1][1]


def _special_1(a: Move, b: Move) -> bool:
    """A moves into the cell that B is leaving."""
    return a[1] == b[0] and not is_wait(a) and not is_wait(b)


def _triangle(a: Move, b: Move) -> bool:
    """A is oblique, and B starts or ends at a corner of the square between A's cells.

    The corner and A's cells are a right triangle. B's other cell may lie outside of the square: a
    vehicle that enters or leaves the corner is as much in A's way as one that stays (ADR 27).
    """
    return is_oblique(a) and not corners(a).isdisjoint(b)


def _special_2(a: Move, b: Move) -> bool:
    return is_longitudinal(b) and _triangle(a, b)


def _special_3(a: Move, b: Move) -> bool:
    return is_lateral(b) and _triangle(a, b)


def _special_4(a: Move, b: Move) -> bool:
    return is_wait(b) and _triangle(a, b)


def _geometric(a: Move, b: Move) -> bool:
    return not footprint(a).isdisjoint(footprint(b))


def _closing(a: Move, b: Move) -> bool:
    """A moves forwards, and B, three columns ahead, backwards; some lane is touched by both."""
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
    "special-2": _special_2,
    "special-3": _special_3,
    "special-4": _special_4,
    "geometric": _geometric,
    "closing": _closing,
}


def _relative(a: Move, b: Move) -> tuple[Cell, Cell, Cell]:
    """Return the offset from A's cell to B's, and what A and B do."""
    offset = b[0][0] - a[0][0], b[0][1] - a[0][1]
    return offset, _displacement(a), _displacement(b)


def _displacement(move: Move) -> Cell:
    return move[1][0] - move[0][0], move[1][1] - move[0][1]


def _as_kinds(kinds: Iterable[str]) -> tuple[str, ...]:
    chosen = frozenset(kinds)
    unknown = chosen.difference(KINDS)
    if unknown:
        raise ValueError(f"unknown conflict kinds {sorted(unknown)}; known: {', '.join(KINDS)}")
    return tuple(kind for kind in KINDS if kind in chosen)


@attrs.frozen
class ConflictModel:
    """The kinds of conflict that a plan must avoid, in the order of `KINDS`.

    node: both vehicles end in the same cell, moving onto a waiting vehicle included.
    edge: the two paths cross or overlap: a swap, or crossing diagonals.
    special-1: A moves into B's current cell while B moves to another one; this forbids trains of
        vehicles in the same direction, too.
    special-2, special-3, special-4: A moves obliquely, B moves longitudinally, moves laterally or
        stays, and three of their initial and target cells form a right triangle: B leaves, enters
        or stays at a corner of the square between A's cells.
    geometric: without a geometry, the footprints intersect. The footprint of a move is its two
        cells and, if it is oblique, both corner cells of its square; that of a wait is its cell.
        This is what the execution protocol reserves, whatever is late. It contains all kinds above
        and, closed to whole cells, the table of any geometry.
        With a geometry, exactly the pairs that bring two bodies too close.
    closing: A moves forwards, straight or obliquely, B moves backwards and starts three columns
        ahead of A, and some lane is the from-lane or to-lane of both. No other kind contains it.
    """

    kinds: tuple[str, ...] = attrs.field(converter=_as_kinds)
    geometry: Geometry | None = None

    def __attrs_post_init__(self) -> None:
        """Check that the geometry is of use.

        Raises:
            ValueError: there is a geometry, but `geometric` is not among the kinds.
        """
        if self.geometry is not None and "geometric" not in self.kinds:
            raise ValueError(f"a geometry, but conflict kinds {self.kinds} without geometric")

    @property
    def reach(self) -> Cell:
        """Columns and lanes between two from-cells beyond which no two moves conflict."""
        return (CLOSING_COLUMNS if "closing" in self.kinds else FARTHEST), FARTHEST

    def kind(self, a: Move, b: Move) -> str | None:
        """Return the first kind of conflict between two moves made in the same step, or None."""
        for kind in self.kinds:
            if kind == "geometric" and self.geometry is not None:
                if _relative(a, b) in close_pairs(self.geometry):
                    return kind
                continue
            predicate = _PREDICATES[kind]
            if predicate(a, b) or predicate(b, a):
                return kind
        return None
