"""Moves as bits must agree with moves as cells."""

from itertools import product

import pytest
from hypothesis import given
from hypothesis import strategies as st

from laneweave.coordinator.planning.conflict_kinds import ConflictModel, Move
from laneweave.coordinator.planning.grid import Grid
from laneweave.coordinator.planning.problem import MoveTable, bits
from laneweave.protocol.lattice import Cell, Mode, displacements
from laneweave.protocol.scenario.formation_table import CONFLICT_KINDS
from support.examples import examples
from support.tables import for_each

GRIDS = [
    Grid(4, 3, []),
    Grid(3, 4, [(1, 1), (2, 3)]),
    Grid(5, 1, []),
    Grid(1, 2, []),
    Grid(7, 2, []),
]
MODELS = [
    *(ConflictModel([kind]) for kind in CONFLICT_KINDS),
    ConflictModel(["geometric", "closing"]),
    ConflictModel(CONFLICT_KINDS),
]


def _moves(table: MoveTable) -> set[Move]:
    return {
        (cell, to)
        for cell in product(range(table.grid.columns), range(table.grid.lanes))
        if table.grid.is_free(cell)
        for step in displacements(table.mode)
        if table.grid.is_free(to := (cell[0] + step[0], cell[1] + step[1]))
    }


@pytest.mark.parametrize("grid", GRIDS)
@pytest.mark.parametrize("mode", [1, 2])
def test_there_is_one_bit_per_possible_move(grid: Grid, mode: Mode) -> None:
    table = MoveTable(grid, mode, MODELS[0])
    assert {table.move(bit) for bit in bits(table.valid)} == _moves(table)
    assert table.valid.bit_count() == len(_moves(table))
    for move in _moves(table):
        number = table.number(move)
        assert table.move(number) == move
        assert table.cell(table.landing(number)) == move[1]


@for_each("grid", GRIDS)
@for_each("mode", [1, 2])
@for_each("model", MODELS)
def test_conflict_sets_hold_exactly_the_conflicting_moves(
    grid: Grid, mode: Mode, model: ConflictModel
) -> None:
    table = MoveTable(grid, mode, model)
    moves = _moves(table)
    for a in moves:
        found = {table.move(bit) for bit in bits(table.conflicts[table.number(a)])}
        assert found == {b for b in moves if model.kind(a, b) is not None}


@examples(60)
@given(st.sampled_from(GRIDS), st.sampled_from([1, 2]), st.integers(0, 2**200))
def test_sets_of_cells_and_moves(grid: Grid, mode: Mode, pattern: int) -> None:
    table = MoveTable(grid, mode, MODELS[0])
    cells, moves = pattern & table.cells, pattern & table.valid
    inside = {table.cell(bit) for bit in bits(cells)}
    chosen = {table.move(bit) for bit in bits(moves)}

    def as_moves(mask: int) -> set[Move]:
        return {table.move(bit) for bit in bits(mask)}

    assert as_moves(table.starting_in(cells)) == {m for m in _moves(table) if m[0] in inside}
    assert as_moves(table.leading_to(cells)) == {m for m in _moves(table) if m[1] in inside}
    assert {table.cell(bit) for bit in bits(table.starts(moves))} == {m[0] for m in chosen}
    assert {table.cell(bit) for bit in bits(table.ends(moves))} == {m[1] for m in chosen}


def test_moves_that_conflict_with_all() -> None:
    table = MoveTable(Grid(3, 1), 1, ConflictModel(["node"]))
    both = 1 << table.number(((0, 0), (1, 0))) | 1 << table.number(((1, 0), (1, 0)))
    into_the_middle = {((0, 0), (1, 0)), ((1, 0), (1, 0)), ((2, 0), (1, 0))}
    assert {table.move(bit) for bit in bits(table.common_conflicts(both))} == into_the_middle
    assert table.common_conflicts(0) == table.valid


@pytest.mark.parametrize("mode", [1, 2])
def test_distances_lead_around_blocked_cells(mode: Mode) -> None:
    table = MoveTable(Grid(4, 3, [(1, 1), (2, 0), (3, 1), (2, 2)]), mode, MODELS[0])

    def distance(start: Cell, end: Cell) -> int | None:
        return table.distances(1 << table.bit(start)).get(table.bit(end))

    assert distance((0, 0), (2, 1)) == (None if mode == 1 else 2)
    assert distance((0, 0), (1, 2)) == 3 - (mode - 1)
    assert distance((0, 0), (0, 0)) == 0
    both = table.distances(1 << table.bit((0, 0)) | 1 << table.bit((0, 2)))
    assert {table.cell(bit): steps for bit, steps in both.items()}[1, 2] == 1
