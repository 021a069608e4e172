"""Seeded families of instances for tests and `laneweave bench planner`."""

from __future__ import annotations

import random

import attrs

from laneweave.coordinator.planning.grid import Cell, Grid


@attrs.frozen
class Instance:
    """One formation: start cells, preferred lanes and targets on a grid."""

    grid: Grid
    cells: tuple[Cell, ...]
    lanes: tuple[int, ...]
    targets: tuple[Cell, ...]


def block_instance(seed: int, *, vehicles: int = 6, columns: int = 4, lanes: int = 3) -> Instance:
    """Return vehicles on a checkerboard in a block without spare columns.

    The block holds the formation and nothing else, so there is hardly any room to manoeuvre.
    """
    rng = random.Random(seed)  # noqa: S311
    board = [(c, lane) for c in range(columns) for lane in range(lanes) if (c + lane) % 2 == 0]
    cells = tuple(board[:vehicles])
    wishes = _wishes(rng, vehicles, lanes, most=columns)
    return Instance(Grid(columns, lanes), cells, wishes, _parallel(wishes, columns, lanes))


def _wishes(rng: random.Random, vehicles: int, lanes: int, most: int) -> tuple[int, ...]:
    while True:
        wishes = tuple(rng.randrange(lanes) for _ in range(vehicles))
        if all(wishes.count(lane) <= most for lane in range(lanes)):
            return wishes


def _parallel(wishes: tuple[int, ...], columns: int, lanes: int) -> tuple[Cell, ...]:
    """Return as many targets per lane as vehicles prefer it, in the middle columns."""
    targets = []
    for lane in range(lanes):
        count = wishes.count(lane)
        first = (columns - count) // 2
        targets += [(first + k, lane) for k in range(count)]
    return tuple(targets)
