"""The conflict model, one picture of the paper at a time."""

import itertools

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from laneweave.coordinator.planning.conflicts import PAPER_KINDS, ConflictModel, Move
from laneweave.protocol.lattice import Cell, displacements, footprint
from laneweave.protocol.scenario.tables import CONFLICT_KINDS
from oracles.path_rules import conflict_kinds

CELLS = st.tuples(st.integers(0, 4), st.integers(0, 3))


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
    # ... and one that leaves the square from a corner, or enters it there.
    (((0, 0), (1, 1)), ((1, 0), (2, 0)), {"special-2"}),
    (((0, 0), (1, 1)), ((2, 0), (1, 0)), {"special-2"}),
    (((0, 0), (1, 1)), ((-1, 1), (0, 1)), {"special-2"}),
    (((0, 0), (1, 1)), ((1, 0), (1, -1)), {"special-3"}),
    (((0, 0), (1, 1)), ((0, 2), (0, 1)), {"special-3"}),
    # Two oblique moves that share a corner are none of these, but the footprints meet.
    (((0, 0), (1, 1)), ((1, 0), (2, -1)), set()),
    (((0, 0), (1, 1)), ((2, 0), (1, -1)), set()),
]


@pytest.mark.parametrize(("a", "b", "kinds"), CASES)
def test_kinds(a: Move, b: Move, kinds: set[str]) -> None:
    found = {kind for kind in CONFLICT_KINDS if ConflictModel([kind]).kind(a, b) is not None}
    assert found == kinds | {"geometric"}


def test_side_by_side_and_apart_is_no_conflict() -> None:
    everything = ConflictModel(CONFLICT_KINDS)
    assert everything.kind(((0, 0), (1, 0)), ((0, 1), (1, 1))) is None
    assert everything.kind(((0, 0), (1, 1)), ((1, 2), (2, 2))) is None
    assert everything.kind(((0, 0), (0, 0)), ((0, 1), (0, 1))) is None


@settings(deadline=None)
@given(moves(), moves(), st.sampled_from(CONFLICT_KINDS))
def test_every_kind_is_symmetric(a: Move, b: Move, kind: str) -> None:
    model = ConflictModel([kind])
    assert model.kind(a, b) == model.kind(b, a)


@settings(deadline=None)
@given(moves(), moves())
def test_geometric_contains_all_kinds_of_the_paper(a: Move, b: Move) -> None:
    if ConflictModel(PAPER_KINDS).kind(a, b) is not None:
        assert ConflictModel(["geometric"]).kind(a, b) == "geometric"


@settings(deadline=None)
@given(moves(), moves(), st.tuples(st.integers(-5, 5), st.integers(-5, 5)))
def test_conflicts_do_not_depend_on_the_place(a: Move, b: Move, shift: Cell) -> None:
    def moved(move: Move) -> Move:
        start, end = ((c + shift[0], lane + shift[1]) for c, lane in move)
        return start, end

    model = ConflictModel(CONFLICT_KINDS)
    assert model.kind(a, b) == model.kind(moved(a), moved(b))


CLOSING: list[tuple[Move, Move]] = [
    # Head-on on one lane.
    (((0, 0), (1, 0)), ((3, 0), (2, 0))),
    # One goes to the other's lane, or leaves it.
    (((0, 0), (1, 1)), ((3, 1), (2, 1))),
    (((0, 1), (1, 0)), ((3, 1), (2, 1))),
    (((0, 0), (1, 0)), ((3, 1), (2, 0))),
    (((0, 0), (1, 0)), ((3, 0), (2, 1))),
    # Both change lanes: to one lane, past each other, from one lane, from and to that between them.
    (((0, 0), (1, 1)), ((3, 2), (2, 1))),
    (((0, 0), (1, 1)), ((3, 1), (2, 0))),
    (((0, 0), (1, 1)), ((3, 0), (2, -1))),
    (((0, 0), (1, 1)), ((3, 1), (2, 2))),
]


@pytest.mark.parametrize(("a", "b"), CLOSING)
def test_no_other_kind_contains_closing(a: Move, b: Move) -> None:
    for first, second in ((a, b), (b, a)):
        found = [
            kind for kind in CONFLICT_KINDS if ConflictModel([kind]).kind(first, second) is not None
        ]
        assert found == ["closing"]
        assert ConflictModel(CONFLICT_KINDS).kind(first, second) == "closing"


@pytest.mark.parametrize(
    ("a", "b"),
    [
        # One free cell more, and one less.
        (((0, 0), (1, 0)), ((4, 0), (3, 0))),
        (((0, 0), (1, 0)), ((2, 0), (1, 0))),
        # Only one moves, or only sideways; one follows the other; they draw apart.
        (((0, 0), (1, 0)), ((3, 0), (3, 0))),
        (((0, 0), (0, 0)), ((3, 0), (2, 0))),
        (((0, 0), (1, 0)), ((3, 0), (3, 1))),
        (((0, 0), (0, 1)), ((3, 1), (2, 1))),
        (((0, 0), (1, 0)), ((3, 0), (4, 0))),
        (((0, 0), (-1, 0)), ((3, 0), (2, 0))),
        (((0, 0), (-1, 0)), ((3, 0), (4, 0))),
        # No lane in common.
        (((0, 0), (1, 0)), ((3, 1), (2, 1))),
        (((0, 0), (1, 0)), ((3, 1), (2, 2))),
        (((0, 0), (1, -1)), ((3, 1), (2, 2))),
    ],
)
def test_not_closing(a: Move, b: Move) -> None:
    model = ConflictModel(["closing"])
    assert model.kind(a, b) is None
    assert model.kind(b, a) is None


@settings(deadline=None)
@given(moves(), moves())
def test_closing_is_the_same_from_either_end_of_the_road_and_from_either_side(
    a: Move, b: Move
) -> None:
    def turned(move: Move, along: int, across: int) -> Move:
        start, end = ((along * c, across * lane) for c, lane in move)
        return start, end

    model = ConflictModel(["closing"])
    for signs in ((-1, 1), (1, -1)):
        assert model.kind(a, b) == model.kind(turned(a, *signs), turned(b, *signs))


def test_all_kinds_agree_with_independent_rules() -> None:
    steps = displacements(2)
    for column, lane in itertools.product(range(-4, 5), range(-3, 4)):
        for step, other in itertools.product(steps, steps):
            a, b = ((0, 0), step), ((column, lane), (column + other[0], lane + other[1]))
            found = [
                kind for kind in CONFLICT_KINDS if ConflictModel([kind]).kind(a, b) is not None
            ]
            assert found == conflict_kinds(a, b)


def test_the_reach_of_a_model_holds_all_its_conflicts() -> None:
    near = list(itertools.product(range(-5, 6), repeat=2))
    steps = displacements(2)
    for kind in CONFLICT_KINDS:
        model = ConflictModel([kind])
        found = {
            (column, lane)
            for column, lane in near
            for a, b in itertools.product(steps, steps)
            if model.kind(((0, 0), a), ((column, lane), (column + b[0], lane + b[1]))) is not None
        }
        assert max(abs(c) for c, _ in found) <= model.reach[0]
        assert max(abs(lane) for _, lane in found) <= model.reach[1]
    assert ConflictModel(CONFLICT_KINDS).reach == (3, 2)
    assert ConflictModel([kind for kind in CONFLICT_KINDS if kind != "closing"]).reach == (2, 2)


def test_footprints() -> None:
    square = set(itertools.product((0, 1), repeat=2))
    assert footprint((0, 0), (1, 1)) == square
    assert footprint((0, 0), (0, 1)) == {(0, 0), (0, 1)}
    assert footprint((0, 0), (0, 0)) == {(0, 0)}


def test_kinds_are_kept_in_one_order_and_unknown_ones_rejected() -> None:
    assert ConflictModel(["edge", "node"]).kinds == ("node", "edge")
    with pytest.raises(ValueError, match="special-5"):
        ConflictModel(["special-5"])
