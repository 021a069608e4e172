"""Seeded families of requests for tests and for `laneweave bench planner`.

In both, vehicles start interlaced (on a checkerboard), prefer a random lane, and the targets are
parallel: as many on each lane as vehicles prefer it, in the middle columns.
"""

from __future__ import annotations

import random
from collections.abc import Sequence

from laneweave.coordinator.planning.conflicts import DEFAULT_KINDS
from laneweave.coordinator.planning.grid import Cell, Grid, Mode
from laneweave.coordinator.planning.request import PlanRequest, VehicleRequest

_SPARE_COLUMNS = (2, 4)


def block_request(
    seed: int,
    *,
    vehicles: int = 6,
    columns: int = 4,
    lanes: int = 3,
    mode: Mode = 1,
    conflicts: Sequence[str] | None = None,
    deadline_s: float = 4.0,
) -> PlanRequest:
    """Return a formation in a block that has no spare columns, so with little room to manoeuvre."""
    rng = random.Random(seed)  # noqa: S311
    starts = _checkerboard(vehicles, columns, lanes, first_column=0)
    wishes = _wishes(rng, vehicles, lanes, most=columns)
    return _request(Grid(columns, lanes), starts, wishes, mode, conflicts, deadline_s)


def formation_request(
    seed: int,
    *,
    vehicles: int = 6,
    lanes: int = 3,
    mode: Mode = 1,
    conflicts: Sequence[str] | None = None,
    deadline_s: float = 4.0,
) -> PlanRequest:
    """Return a formation with 2 to 4 spare columns in front and behind."""
    rng = random.Random(seed)  # noqa: S311
    behind, ahead = rng.randint(*_SPARE_COLUMNS), rng.randint(*_SPARE_COLUMNS)
    occupied = -(-2 * vehicles // lanes)
    columns = behind + occupied + ahead
    starts = _checkerboard(vehicles, columns, lanes, first_column=behind)
    wishes = _wishes(rng, vehicles, lanes, most=columns)
    return _request(Grid(columns, lanes), starts, wishes, mode, conflicts, deadline_s)


def _checkerboard(vehicles: int, columns: int, lanes: int, first_column: int) -> list[Cell]:
    board = [
        (column, lane)
        for column in range(first_column, columns)
        for lane in range(lanes)
        if (column - first_column + lane) % 2 == 0
    ]
    if len(board) < vehicles:
        raise ValueError(f"{vehicles} vehicles do not fit into {columns} x {lanes} interlaced")
    return board[:vehicles]


def _wishes(rng: random.Random, vehicles: int, lanes: int, most: int) -> list[int]:
    """Draw preferred lanes until no lane is preferred by more vehicles than it has columns."""
    if vehicles > most * lanes:
        raise ValueError(f"{vehicles} vehicles do not fit on {lanes} lanes of {most} columns")
    while True:
        wishes = [rng.randrange(lanes) for _ in range(vehicles)]
        if all(wishes.count(lane) <= most for lane in range(lanes)):
            return wishes


def _request(
    grid: Grid,
    starts: Sequence[Cell],
    wishes: Sequence[int],
    mode: Mode,
    conflicts: Sequence[str] | None,
    deadline_s: float,
) -> PlanRequest:
    targets = []
    for lane in range(grid.lanes):
        count = wishes.count(lane)
        first = (grid.columns - count) // 2
        targets += [(first + k, lane) for k in range(count)]
    vehicles = [
        VehicleRequest(f"v{i + 1}", cell, lane=lane)
        for i, (cell, lane) in enumerate(zip(starts, wishes, strict=True))
    ]
    kinds = DEFAULT_KINDS[mode] if conflicts is None else tuple(conflicts)
    return PlanRequest(grid, mode, kinds, tuple(vehicles), tuple(targets), deadline_s)
