"""Prioritized planning: vehicles plan one after another, each around the paths of those before.

Fast and simple, but neither optimal nor complete: an early vehicle may be in the way of a later
one. Then the later one plans first, in a new attempt; if none succeeds, laneweave plans with its
own solvers. Without random numbers, results are repeatable.
"""

from __future__ import annotations

import time
from collections import deque

from laneweave.planners import Cell, Paths, PlanLimits, PlanRequest, displacements

ATTEMPTS = 20
"""Maximum number of orders of the vehicles."""


def plan(request: PlanRequest, limits: PlanLimits) -> Paths | None:
    """Return a path for each vehicle, or None if no order works; see `laneweave.planners`."""
    ends_s = time.monotonic() + limits.deadline_s
    horizon = request.grid.columns + request.grid.lanes  # steps: enough for the longest paths
    order = list(range(len(request.vehicles)))
    for _ in range(ATTEMPTS):
        paths: dict[int, list[Cell]] = {}
        for number in order:
            path = find_path(request, number, paths, horizon)
            if path is None or time.monotonic() > ends_s:
                break
            paths[number] = path
        else:
            return [paths[number] for number in range(len(order))]
        order.remove(number)
        order.insert(0, number)
    return None


def find_path(
    request: PlanRequest, number: int, others: dict[int, list[Cell]], horizon: int
) -> list[Cell] | None:
    """Return a vehicle's shortest path of `horizon` steps that avoids conflicts with others.

    Breadth-first search over (cell, step). At the horizon all vehicles are at their targets.
    """
    vehicle, conflict = request.vehicles[number], request.conflict_model.kind
    moves = [move for move in displacements(request.mode) if can_drive(vehicle.moves, move)]
    taken = {path[-1] for path in others.values()}
    targets = {request.targets[j] for j in vehicle.choice(request.targets)} - taken
    came_from: dict[tuple[Cell, int], Cell] = {}
    queue = deque([(vehicle.cell, 0)])
    while queue:
        cell, step = queue.popleft()
        if cell in targets and may_wait(request, cell, step, others, horizon):
            path = [cell] * (horizon - step + 1)
            while step:
                cell = came_from[cell, step]
                step -= 1
                path.insert(0, cell)
            return path
        if step == horizon:
            continue
        for columns, lanes in moves:
            move = cell, (cell[0] + columns, cell[1] + lanes)
            new = move[1], step + 1
            if new in came_from or not request.grid.is_free(move[1]):
                continue
            if not any(conflict(move, (path[step], path[step + 1])) for path in others.values()):
                came_from[new] = cell
                queue.append(new)
    return None


def may_wait(
    request: PlanRequest, cell: Cell, step: int, others: dict[int, list[Cell]], horizon: int
) -> bool:
    """Return whether a vehicle can stay in a cell from a step on."""
    kind = request.conflict_model.kind
    return not any(
        kind((cell, cell), (path[later], path[later + 1]))
        for path in others.values()
        for later in range(step, horizon)
    )


def can_drive(moves: tuple[Cell, ...] | None, move: Cell) -> bool:
    """Return whether a vehicle with these moves (None: all) can drive a move, or waits."""
    return moves is None or move == (0, 0) or move in moves
