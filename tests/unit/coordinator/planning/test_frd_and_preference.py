"""The formation relative distance, its weights, and the preference matrix."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from laneweave.coordinator.planning.conflict_kinds import ConflictModel
from laneweave.coordinator.planning.grid import Grid
from laneweave.coordinator.planning.paper.assignments import (
    Weights,
    cost_matrix,
    frd,
    preference_matrix,
)
from laneweave.coordinator.planning.problem import MoveTable
from laneweave.coordinator.planning.request import VehicleRequest
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.lattice import Cell, Mode

CELLS = st.tuples(st.integers(0, 4), st.integers(0, 2))


def test_the_equation_of_the_paper() -> None:
    # Five columns and two lanes apart: two oblique edges and three straight ones.
    assert frd((0, 0), (5, 2), Weights(straight=1, oblique=1)) == 5
    assert frd((0, 0), (5, 2), Weights(straight=1, oblique=2)) == 7
    assert frd((0, 0), (5, 2), Weights(straight=0, oblique=1)) == 2


@given(CELLS, CELLS, st.sampled_from([1, 2]))
def test_default_weights_give_the_number_of_steps_on_a_free_grid(
    a: Cell, b: Cell, mode: Mode
) -> None:
    table = MoveTable(Grid(5, 3), mode, ConflictModel(["node"]))
    steps = table.distances(1 << table.bit(a))
    assert frd(a, b, Weights.for_mode(mode)) == steps[table.bit(b)]


@pytest.mark.parametrize(
    ("mode", "weights", "field"),
    [
        (1, Weights(2, 2), "l_s"),
        (1, Weights(1, 3), "l_o"),
        (2, Weights(1, 2), "l_o"),
        (2, Weights(-1, 1), "l_s"),
    ],
)
def test_weights_that_are_no_lower_bound_are_rejected(
    mode: Mode, weights: Weights, field: str
) -> None:
    with pytest.raises(BadInputError) as caught:
        weights.checked(mode)
    assert caught.value.field == field


def test_cost_matrix() -> None:
    costs = cost_matrix([(0, 0), (2, 1)], [(0, 0), (1, 1), (2, 2)], Weights(1, 1))
    assert costs.tolist() == [[0, 1, 2], [2, 1, 1]]


def test_preferences() -> None:
    targets = [(0, 0), (1, 1), (2, 1)]
    assert VehicleRequest("a", (0, 0), lane=1).choice(targets) == {1, 2}
    assert VehicleRequest("a", (0, 0), lane=2).choice(targets) == frozenset()
    assert VehicleRequest("a", (0, 0), eligible=(0, 2)).choice(targets) == {0, 2}
    assert VehicleRequest("a", (0, 0)).choice(targets) == {0, 1, 2}
    matrix = preference_matrix([frozenset({1}), frozenset()], 3)
    assert matrix.tolist() == [[False, True, False], [False, False, False]]
