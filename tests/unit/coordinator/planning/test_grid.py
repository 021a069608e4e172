"""Cells and moves."""

import pytest

from laneweave.coordinator.planning.problem import Grid
from laneweave.protocol.lattice import displacements

GRID = Grid(4, 3, [(1, 1)])


def test_modes_allow_four_or_eight_neighbours_and_waiting() -> None:
    assert len(displacements(1)) == 5
    assert len(displacements(2)) == 9
    assert displacements(1)[0] == displacements(2)[0] == (0, 0)


@pytest.mark.parametrize("cell", [(-1, 0), (4, 0), (0, 3), (0, -1), (1, 1)])
def test_cells_that_are_not_free(cell: tuple[int, int]) -> None:
    assert not GRID.is_free(cell)
