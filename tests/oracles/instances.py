"""Seeded random plan requests for the comparison of solvers."""

from random import Random
from typing import Any

from oracles.path_rules import Cell, Problem

SPECIALS = ("special-1", "special-2", "special-3", "special-4")


def _subsets(kinds: tuple[str, ...]) -> list[list[str]]:
    return [[k for i, k in enumerate(kinds) if code >> i & 1] for code in range(1 << len(kinds))]


Variant = tuple[int, list[str] | None]
"""A mode, and conflicts; None: the default of the mode."""

CLOSING: tuple[tuple[int, list[str]], ...] = (
    (1, ["node", "edge", "special-1", "closing"]),
    (2, ["geometric", "closing"]),
    (2, ["node", "edge", "closing"]),
)

# Mode 1 knows no oblique moves, so that only special-1 makes a difference there.
VARIANTS: tuple[Variant, ...] = (
    *((2, ["node", "edge", *subset]) for subset in _subsets(SPECIALS)),
    (2, ["geometric"]),
    (2, None),
    (1, ["node", "edge"]),
    (1, ["node", "edge", "special-1"]),
    (1, ["node", "edge", *SPECIALS]),
    (1, ["node", "edge", "special-2", "special-3", "special-4"]),
    (1, ["geometric"]),
    (1, None),
)
"""Which of them a seed takes depends on their number."""

EVERY_VARIANT = (*VARIANTS, *CLOSING)


def variant(seed: int) -> Variant:
    return VARIANTS[seed % len(VARIANTS)]


def random_request(seed: int, chosen: Variant | None = None) -> dict[str, Any]:
    """Two to six vehicles on two to four lanes and three to seven columns.

    The variant is the chosen one, or that of the seed. Each vehicle has a target that it may take
    and can reach alone; nothing more is promised.
    """
    rng = Random(seed)
    mode, conflicts = chosen or variant(seed)
    count = rng.choice((2, 3, 3, 4, 4, 5, 5, 6))
    while True:
        columns, lanes = rng.randint(3, 7), rng.randint(2, 4)
        if columns * lanes < count + 3:
            continue
        request = _draw(rng, columns, lanes, count, mode, conflicts)
        problem = Problem.of(request)
        # More crowded than this they are sliding puzzles, which the oracle proves slowly.
        enough = 3 * count - (0 if lanes == 2 else 2)
        if _is_connected(problem) and len(problem.free_cells()) >= enough:
            return request


def large_request(seed: int) -> dict[str, Any]:
    """Seven to twelve vehicles on three to five lanes, with more room than in `random_request`."""
    rng = Random(seed)
    mode, conflicts = variant(seed)
    count = rng.randint(7, 12)
    while True:
        lanes = rng.randint(3, 5)
        columns = -(-5 * count // lanes) + rng.randint(0, 3)
        request = _draw(rng, columns, lanes, count, mode, conflicts)
        if _is_connected(Problem.of(request)):
            return request


def meeting_request(seed: int, chosen: Variant) -> dict[str, Any]:
    """Vehicles from both ends of one to three lanes whose targets lie nearer to the middle.

    The first two are to stand behind each other there, on the lane on which both are.
    """
    rng = Random(seed)
    mode, conflicts = chosen
    lanes, half = rng.randint(1, 3), rng.choice((2, 3, 3))
    columns = 2 * half
    count = rng.randint(2, 2 + lanes)
    grid = [(c, lane) for c in range(columns) for lane in range(lanes)]
    while True:
        away, lane = rng.randint(1, half - 1), rng.randrange(lanes)
        met = [(half - 1 - away, lane), (half + away, lane)]
        starts = met + rng.sample([cell for cell in grid if cell not in met], count - 2)
        targets = [(half - 1, lane), (half, lane)]
        for column, lane in starts[2:]:
            ahead = rng.randint(0, 2) * (1 if column < half else -1)
            aside = rng.choice((0, 0, 0, -1, 1))
            targets.append((column + ahead, min(max(lane + aside, 0), lanes - 1)))
        if len(set(targets)) == count and set(targets) <= set(grid):
            break
    style = rng.choice(("lane", "eligible"))
    return {
        "schema": "laneweave.plan.request/1",
        "grid": {"columns": columns, "lanes": lanes},
        "mode": mode,
        "conflicts": conflicts,
        "vehicles": [
            {"id": f"v{i}", "cell": list(cell)}
            | ({"lane": targets[i][1]} if style == "lane" else {"eligible": [i]})
            for i, cell in enumerate(starts)
        ],
        "targets": [list(cell) for cell in targets],
        "deadline_s": 60.0,
    }


def small_request(
    seed: int, *, columns: int, lanes: int, count: int, mode: int, conflicts: list[str] | None
) -> dict[str, Any]:
    """A request of the size asked for, with or without a solution."""
    return _draw(Random(seed), columns, lanes, count, mode, conflicts)


def _draw(
    rng: Random, columns: int, lanes: int, count: int, mode: int, conflicts: list[str] | None
) -> dict[str, Any]:
    grid = [(c, lane) for c in range(columns) for lane in range(lanes)]
    spare = len(grid) - count
    rng.shuffle(grid)
    blocked = grid[: rng.choice((0, 0, 1, 2, 3)) if spare > 5 else 0]
    free = sorted(set(grid) - set(blocked))
    surplus = rng.choice((0, 0, 0, 1, 2)) if spare > 3 else 0
    starts = _cells(rng, free, count, columns)
    targets = _cells(rng, free, count + surplus, columns)
    rng.shuffle(targets)
    vehicles: list[dict[str, Any]] = [
        {"id": f"v{i}", "cell": list(cell)} for i, cell in enumerate(starts)
    ]
    _prefer(rng, vehicles, targets)
    return {
        "schema": "laneweave.plan.request/1",
        "grid": {"columns": columns, "lanes": lanes, "blocked": [list(cell) for cell in blocked]},
        "mode": mode,
        **({} if conflicts is None else {"conflicts": conflicts}),
        "vehicles": vehicles,
        "targets": [list(cell) for cell in targets],
        "deadline_s": 60.0,
    }


def _cells(rng: Random, free: list[Cell], count: int, columns: int) -> list[Cell]:
    """Anywhere, or in neighbouring columns with few gaps, as vehicles in a formation stand."""
    if rng.random() < 0.5:
        return rng.sample(free, count)
    first = rng.randrange(columns)
    nearest = sorted(free, key=lambda cell: (abs(cell[0] - first), rng.random()))
    return rng.sample(nearest[: count + rng.randint(0, 2)], count)


def _prefer(rng: Random, vehicles: list[dict[str, Any]], targets: list[Cell]) -> None:
    """By lane, by list or not at all; some assignment satisfies all."""
    own = rng.sample(range(len(targets)), len(vehicles))
    style = rng.choice(("lane", "lane", "eligible", "single", "any", "mixed"))
    for i, vehicle in enumerate(vehicles):
        how = rng.choice(("lane", "eligible", "single", "any")) if style == "mixed" else style
        if how == "lane":
            vehicle["lane"] = targets[own[i]][1]
        elif how == "single":
            vehicle["eligible"] = [own[i]]
        elif how == "eligible":
            more = rng.sample(range(len(targets)), rng.randint(0, len(targets) // 2))
            vehicle["eligible"] = sorted({own[i], *more})


def _is_connected(problem: Problem) -> bool:
    """Whether each vehicle alone reaches every target."""
    cells = problem.free_cells()
    return len(problem.distances_from(cells[0])) == len(cells)
