"""Cells, moves and distances."""

from itertools import product

import pytest

from laneweave.coordinator.planning.grid import Grid
from laneweave.protocol.lattice import displacements

GRID = Grid(4, 3, [(1, 1)])


def test_modes_allow_four_or_eight_neighbours_and_waiting() -> None:
    assert len(displacements(1)) == 5
    assert len(displacements(2)) == 9
    assert displacements(1)[0] == displacements(2)[0] == (0, 0)


def test_neighbours_stay_in_the_grid_and_off_blocked_cells() -> None:
    assert set(GRID.neighbours((0, 1), 1)) == {(0, 1), (0, 0), (0, 2)}
    assert set(GRID.neighbours((0, 0), 2)) == {(0, 0), (1, 0), (0, 1)}


def test_distances_go_around_blocked_cells() -> None:
    everywhere = [
        cell for cell in product(range(GRID.columns), range(GRID.lanes)) if GRID.is_free(cell)
    ]
    assert GRID.distances((0, 1), 1, everywhere)[2, 1] == 4
    assert GRID.distances((0, 1), 2, everywhere)[2, 1] == 2
    assert (1, 1) not in GRID.distances((0, 1), 2, [*everywhere, (1, 1)])


def test_cells_cut_off_have_no_distance() -> None:
    grid = Grid(3, 1, [(1, 0)])
    assert grid.distances((0, 0), 2, [(0, 0), (2, 0)]) == {(0, 0): 0}


@pytest.mark.parametrize("cell", [(-1, 0), (4, 0), (0, 3), (0, -1), (1, 1)])
def test_cells_that_are_not_free(cell: tuple[int, int]) -> None:
    assert not GRID.is_free(cell)
