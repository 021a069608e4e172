"""The conflict model, one picture of the paper at a time."""

import itertools

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from laneweave.coordinator.planning.conflicts import KINDS, ConflictModel, footprint
from laneweave.coordinator.planning.grid import Cell, Move, displacements

CELLS = st.tuples(st.integers(0, 3), st.integers(0, 3))


@st.composite
def moves(draw: st.DrawFn) -> Move:
    cell: Cell = draw(CELLS)
    step = draw(st.sampled_from(displacements(2)))
    return cell, (cell[0] + step[0], cell[1] + step[1])


CASES: list[tuple[Move, Move, set[str]]] = [
    # Onto a waiting vehicle; two vehicles to one cell.
    (((0, 0), (1, 0)), ((1, 0), (1, 0)), {"node"}),
    (((0, 0), (1, 0)), ((2, 0), (1, 0)), {"node"}),
    (((0, 0), (1, 0)), ((1, 1), (1, 0)), {"node"}),
    # A swap is an edge conflict, and each also moves to where the other was.
    (((0, 0), (1, 0)), ((1, 0), (0, 0)), {"edge", "special-1"}),
    (((0, 0), (1, 1)), ((1, 1), (0, 0)), {"edge", "special-1"}),
    # Crossing diagonals.
    (((0, 0), (1, 1)), ((0, 1), (1, 0)), {"edge"}),
    (((0, 0), (1, 1)), ((1, 0), (0, 1)), {"edge"}),
    # Following, straight and around a corner.
    (((0, 0), (1, 0)), ((1, 0), (2, 0)), {"special-1"}),
    (((0, 0), (1, 0)), ((1, 0), (1, 1)), {"special-1"}),
    (((0, 0), (1, 1)), ((1, 1), (2, 2)), {"special-1"}),
    # An oblique move and a longitudinal one in the same square: from either diagonal corner.
    (((0, 0), (1, 1)), ((0, 1), (1, 1)), {"node", "special-2"}),
    (((0, 0), (1, 1)), ((0, 0), (1, 0)), {"special-2"}),
    (((0, 0), (1, 1)), ((1, 0), (0, 0)), {"special-1", "special-2"}),
    (((0, 0), (1, 1)), ((1, 1), (0, 1)), {"special-1", "special-2"}),
    # ... and a lateral one.
    (((0, 0), (1, 1)), ((0, 0), (0, 1)), {"special-3"}),
    (((0, 0), (1, 1)), ((1, 0), (1, 1)), {"node", "special-3"}),
    (((0, 0), (1, 1)), ((0, 1), (0, 0)), {"special-1", "special-3"}),
    (((0, 0), (1, 1)), ((1, 1), (1, 0)), {"special-1", "special-3"}),
    # ... and a vehicle that waits in a corner.
    (((0, 0), (1, 1)), ((0, 1), (0, 1)), {"special-4"}),
    (((0, 0), (1, 1)), ((1, 0), (1, 0)), {"special-4"}),
    # Leaving the square through its corner is none of these, but the footprints meet.
    (((0, 0), (1, 1)), ((1, 0), (2, 0)), set()),
    (((0, 0), (1, 1)), ((1, 0), (2, -1)), set()),
]


@pytest.mark.parametrize(("a", "b", "kinds"), CASES)
def test_kinds(a: Move, b: Move, kinds: set[str]) -> None:
    found = {kind for kind in KINDS if ConflictModel([kind]).kind(a, b) is not None}
    assert found == kinds | {"geometric"}


def test_side_by_side_and_apart_is_no_conflict() -> None:
    everything = ConflictModel(KINDS)
    assert everything.kind(((0, 0), (1, 0)), ((0, 1), (1, 1))) is None
    assert everything.kind(((0, 0), (1, 1)), ((1, 2), (2, 2))) is None
    assert everything.kind(((0, 0), (0, 0)), ((0, 1), (0, 1))) is None


@settings(deadline=None)
@given(moves(), moves(), st.sampled_from(KINDS))
def test_every_kind_is_symmetric(a: Move, b: Move, kind: str) -> None:
    model = ConflictModel([kind])
    assert model.kind(a, b) == model.kind(b, a)


@settings(deadline=None)
@given(moves(), moves())
def test_geometric_contains_all_other_kinds(a: Move, b: Move) -> None:
    if ConflictModel(KINDS[:-1]).kind(a, b) is not None:
        assert ConflictModel(["geometric"]).kind(a, b) == "geometric"


@settings(deadline=None)
@given(moves(), moves(), st.tuples(st.integers(-5, 5), st.integers(-5, 5)))
def test_conflicts_do_not_depend_on_the_place(a: Move, b: Move, shift: Cell) -> None:
    def moved(move: Move) -> Move:
        start, end = ((c + shift[0], lane + shift[1]) for c, lane in move)
        return start, end

    model = ConflictModel(KINDS)
    assert model.kind(a, b) == model.kind(moved(a), moved(b))


def test_footprints() -> None:
    square = set(itertools.product((0, 1), repeat=2))
    assert footprint(((0, 0), (1, 1))) == square
    assert footprint(((0, 0), (0, 1))) == {(0, 0), (0, 1)}
    assert footprint(((0, 0), (0, 0))) == {(0, 0)}


def test_kinds_are_kept_in_one_order_and_unknown_ones_rejected() -> None:
    assert ConflictModel(["edge", "node"]).kinds == ("node", "edge")
    with pytest.raises(ValueError, match="special-5"):
        ConflictModel(["special-5"])
