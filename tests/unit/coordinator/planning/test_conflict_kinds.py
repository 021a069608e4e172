"""The conflict model against independent rules."""

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from laneweave.coordinator.planning.conflict_kinds import ConflictModel, Move
from laneweave.protocol.lattice import Cell, displacements, footprint
from laneweave.protocol.scenario.formation_table import CONFLICT_KINDS
from oracles.path_rules import conflict_kinds

CELLS = st.tuples(st.integers(0, 4), st.integers(0, 3))


@st.composite
def moves(draw: st.DrawFn) -> Move:
    cell: Cell = draw(CELLS)
    step = draw(st.sampled_from(displacements(2)))
    return cell, (cell[0] + step[0], cell[1] + step[1])


@given(moves(), moves(), st.tuples(st.integers(-5, 5), st.integers(-5, 5)))
def test_conflicts_do_not_depend_on_the_place(a: Move, b: Move, shift: Cell) -> None:
    def moved(move: Move) -> Move:
        start, end = ((c + shift[0], lane + shift[1]) for c, lane in move)
        return start, end

    model = ConflictModel(CONFLICT_KINDS)
    assert model.kind(a, b) == model.kind(moved(a), moved(b))


def test_all_kinds_agree_with_independent_rules() -> None:
    """`oracles/test_oracles.py` checks these rules against manually derived cases."""
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
    assert ConflictModel(["node", "closing"]).reach == (3, 2)
    assert ConflictModel(["node", "geometric"]).reach == (2, 2)


def test_footprints() -> None:
    square = set(itertools.product((0, 1), repeat=2))
    assert footprint((0, 0), (1, 1)) == square
    assert footprint((0, 0), (0, 1)) == {(0, 0), (0, 1)}
    assert footprint((0, 0), (0, 0)) == {(0, 0)}


def test_kinds_are_kept_in_one_order_and_unknown_ones_rejected() -> None:
    assert ConflictModel(["edge", "node"]).kinds == ("node", "edge")
    with pytest.raises(ValueError, match="special-5"):
        ConflictModel(["special-5"])
