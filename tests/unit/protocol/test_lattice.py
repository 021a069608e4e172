"""The lattice: blocks partition the columns, positions and times are inverse, footprints."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from laneweave.protocol.lattice import Cell, Lattice, PlannedMove, footprint, territory

LATTICES = st.builds(
    Lattice,
    pitch_m=st.floats(1, 200),
    speed_mps=st.floats(1, 60),
    lane_width_m=st.floats(2, 10),
    lanes=st.integers(1, 8),
    block_columns=st.integers(1, 24),
)
COLUMNS = st.integers(-10_000, 10_000)
CELLS = st.tuples(st.integers(-50, 50), st.integers(0, 7))
STEPS = st.tuples(st.integers(-1, 1), st.integers(-1, 1))
MOVES = st.builds(
    lambda step, cell, by: (step, cell, (cell[0] + by[0], cell[1] + by[1])),
    st.integers(0, 20),
    CELLS,
    STEPS,
)


@given(LATTICES, st.integers(-500, 500))
def test_blocks_partition_the_columns(lattice: Lattice, block: int) -> None:
    columns = lattice.block_range(block)
    assert len(columns) == lattice.block_columns
    assert columns.step == 1
    assert {lattice.block_of(column) for column in columns} == {block}
    # Higher numbers lie behind, without a column between.
    assert lattice.block_range(block + 1)[-1] == columns[0] - 1


@given(LATTICES, st.integers(-100, 100))
def test_the_cells_of_a_block_are_its_columns_on_all_lanes(lattice: Lattice, block: int) -> None:
    cells = lattice.block_cells(block)
    assert len(cells) == lattice.block_columns * lattice.lanes
    assert {column for column, _ in cells} == set(lattice.block_range(block))
    assert {lane for _, lane in cells} == set(range(lattice.lanes))
    assert not cells & lattice.block_cells(block + 1)


def test_block_zero_is_where_the_docstring_says() -> None:
    lattice = Lattice(15.0, 15.0, 3.5, 3, 4)
    assert list(lattice.block_range(0)) == [-3, -2, -1, 0]
    assert list(lattice.block_range(1)) == [-7, -6, -5, -4]
    assert [lattice.block_of(column) for column in (1, 0, -3, -4, -7, -8)] == [-1, 0, 0, 1, 1, 2]


@given(LATTICES, COLUMNS, st.floats(-20_000, 20_000))
def test_a_column_is_where_it_passes(lattice: Lattice, column: int, s_m: float) -> None:
    t_s = lattice.passing_time_s(column, s_m)
    assert lattice.cell_s_m(column, t_s) == pytest.approx(s_m, abs=1e-6)


@given(LATTICES, COLUMNS, st.floats(0, 1e5))
def test_the_lattice_moves_forward_and_columns_are_a_pitch_apart(
    lattice: Lattice, column: int, t_s: float
) -> None:
    ahead_m = lattice.cell_s_m(column + 1, t_s) - lattice.cell_s_m(column, t_s)
    assert ahead_m == pytest.approx(lattice.pitch_m, abs=1e-6)
    assert lattice.cell_s_m(column, t_s + 1) > lattice.cell_s_m(column, t_s)
    assert lattice.passing_time_s(column) > lattice.passing_time_s(column + 1)


@given(LATTICES, st.integers(0, 7))
def test_lanes_lie_side_by_side(lattice: Lattice, lane: int) -> None:
    assert lattice.cell_y_m(0) == lattice.lane_width_m / 2
    assert lattice.cell_y_m(lane + 1) - lattice.cell_y_m(lane) == pytest.approx(
        lattice.lane_width_m
    )


@given(CELLS, STEPS)
def test_a_footprint_is_the_same_both_ways(cell: Cell, by: tuple[int, int]) -> None:
    target = (cell[0] + by[0], cell[1] + by[1])
    cells = footprint(cell, target)
    assert cells == footprint(target, cell)
    assert {cell, target} <= cells
    assert len(cells) == {0: 1, 1: 2, 2: 4}[abs(by[0]) + abs(by[1])]


@given(st.lists(CELLS, max_size=8), st.lists(MOVES, max_size=8))
def test_the_territory_contains_starts_and_footprints(
    cells: list[Cell], moves: list[PlannedMove]
) -> None:
    expected = set(cells).union(*(footprint(origin, target) for _, origin, target in moves))
    assert territory(cells, moves) == expected


@given(CELLS)
def test_every_second_cell_is_interlaced(cell: Cell) -> None:
    column, lane = cell
    for neighbour in ((column + 1, lane), (column, lane + 1), (column - 1, lane)):
        assert Lattice.interlaced(neighbour) is not Lattice.interlaced(cell)
