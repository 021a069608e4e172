"""Conflict cliques cover every conflict."""

from itertools import combinations

import numpy as np
import pytest

from laneweave.coordinator.planning.conflict_kinds import ConflictModel, Move
from laneweave.coordinator.planning.exact.arrays import move_arrays
from laneweave.coordinator.planning.exact.cliques import Clique, clique_patterns
from laneweave.coordinator.planning.grid import Grid
from laneweave.protocol.lattice import Mode, displacements
from laneweave.protocol.scenario.formation_table import CONFLICT_KINDS
from oracles.instances import EVERY_VARIANT
from support.tables import for_each

MODELS: list[tuple[Mode, tuple[str, ...]]] = [
    (1 if mode == 1 else 2, tuple(kinds)) for mode, kinds in EVERY_VARIANT if kinds is not None
]
FAR = range(-3, 4)
NEAR = range(-2, 3)


def moves_of(pattern: Clique, mode: Mode, column: int, lane: int) -> set[Move]:
    """Return the moves of a clique with its anchor in a cell."""
    steps = displacements(mode)
    moves = set()
    for c, left, d in pattern:
        cell = column + c, lane + left
        moves.add((cell, (cell[0] + steps[d][0], cell[1] + steps[d][1])))
    return moves


@for_each(("mode", "kinds"), MODELS)
def test_every_conflict_is_in_a_clique_and_every_clique_excludes(
    mode: Mode, kinds: tuple[str, ...]
) -> None:
    model = ConflictModel(kinds)
    patterns = clique_patterns(mode, model)
    cliques = [
        moves_of(pattern, mode, column, lane)
        for pattern in patterns
        for column in range(-6, 7)
        for lane in range(-4, 5)
    ]
    for pattern in patterns:
        for a, b in combinations(sorted(moves_of(pattern, mode, 0, 0)), 2):
            assert a[0] == b[0] or model.kind(a, b) is not None
    steps = displacements(mode)
    origin = [((0, 0), step) for step in steps]
    others = [
        ((column, lane), (column + along, lane + across))
        for column in FAR
        for lane in NEAR
        for along, across in steps
        if (column, lane) != (0, 0)
    ]
    for a in origin:
        for b in others:
            if model.kind(a, b) is not None:
                assert any(a in clique and b in clique for clique in cliques), (a, b)


@for_each(("mode", "kinds"), MODELS)
def test_from_cells_of_a_clique_have_different_residues(mode: Mode, kinds: tuple[str, ...]) -> None:
    """See `MoveArrays.residue`."""
    grid, model = Grid(9, 5), ConflictModel(kinds)
    arrays = move_arrays(grid, mode, model)
    assert arrays.residue_count == (12 if "closing" in kinds else 9)
    assert set(arrays.residue.tolist()) == set(range(arrays.residue_count))
    cells: dict[int, set[int]] = {}
    for d, cell, m in np.argwhere(arrays.clique >= 0).tolist():
        cells.setdefault(int(arrays.clique[d, cell, m]), set()).add(cell)
    assert len(cells) == arrays.clique_count
    for of_clique in cells.values():
        assert len({int(arrays.residue[cell]) for cell in of_clique}) == len(of_clique)


@pytest.mark.parametrize(
    ("mode", "kinds", "sizes"),
    [
        (1, ("node", "edge", "special-1"), [9, 4]),
        (1, ("geometric",), [9, 4]),
        (2, ("geometric",), [25, 20]),
    ],
)
def test_footprints_have_one_clique_for_each_cell_and_closing_adds_one(
    mode: Mode, kinds: tuple[str, ...], sizes: list[int]
) -> None:
    footprints = clique_patterns(mode, ConflictModel(kinds))
    both = clique_patterns(mode, ConflictModel((*kinds, "closing")))
    assert [len(pattern) for pattern in both] == sizes
    assert footprints == both[:1]


@pytest.mark.parametrize("kind", sorted(set(CONFLICT_KINDS) - {"node", "geometric"}))
def test_cliques_are_refused_where_vehicles_may_share_a_cell(kind: str) -> None:
    with pytest.raises(ValueError, match="share a cell"):
        clique_patterns(2, ConflictModel((kind,)))
