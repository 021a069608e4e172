"""SPPA, the single-vehicle path planning algorithm of the paper.

The paper uses A* in space and time. Here all shortest paths of a vehicle under its constraints are
computed at once, as sets of moves per step (`Diagram`): a forward pass collects the moves up to the
earliest final arrival, a backward pass removes those that do not lead to it. `choose_path` selects
the path with the fewest conflicts with other vehicles, then the fewest moves, then the lowest bit.
"""

from __future__ import annotations

from collections.abc import Sequence

import attrs

from laneweave.coordinator.planning.budget import Budget, BudgetSpentError
from laneweave.coordinator.planning.problem import (
    Bans,
    Diagram,
    MoveTable,
    Path,
    Problem,
    Solution,
    bits,
)


def shortest_paths(table: MoveTable, start: int, target: int, bans: Bans) -> Diagram | None:
    """Return all paths of minimum cost that respect the bans, or None if there is no path."""
    last_ban = max(*bans.at, *bans.since, bans.earliest, -1)
    limit = last_ban + table.cell_count + 2
    if bans.latest is not None:
        limit = min(limit, bans.latest)
    arrival = bans.earliest
    for step, banned in bans.at.items():
        if banned >> target & 1:
            arrival = max(arrival, step + 1)
    for banned in bans.since.values():
        if banned >> target & 1:
            return None
    cells = arriving = 1 << start
    layers: list[int] = []
    banned_since = 0
    while len(layers) < arrival or not arriving >> target & 1:
        step = len(layers)
        if not cells or step >= limit:
            return None
        banned_since |= bans.since.get(step, 0)
        moves = table.starting_in(cells) & ~(bans.at.get(step, 0) | banned_since)
        layers.append(moves)
        cells = table.ends(moves)
        # A vehicle that waits at the target arrived earlier, unless a later wait is banned.
        arriving = cells if not moves >> target & 1 else table.ends(moves & ~(1 << target))
    if layers:
        layers[-1] &= ~(1 << target)
    cells = 1 << target
    for step in range(len(layers) - 1, -1, -1):
        layers[step] &= table.leading_to(cells)
        cells = table.starts(layers[step])
    return Diagram(tuple(layers), target)


def paths_of(problem: Problem, vehicle: int, target: int, bans: Bans) -> Diagram | None:
    """Return a vehicle's shortest paths to a target cell with the moves that it can drive.

    A path has at most the number of steps that the problem permits.
    """
    if problem.max_steps is not None:
        latest = problem.max_steps if bans.latest is None else min(bans.latest, problem.max_steps)
        bans = attrs.evolve(bans, latest=latest)
    if undrivable := problem.undrivable[vehicle]:
        since = {**bans.since, 0: bans.since.get(0, 0) | undrivable}
        bans = attrs.evolve(bans, since=since)
    return shortest_paths(problem.table, problem.starts[vehicle], target, bans)


def free_paths(problem: Problem, vehicle: int, target: int) -> Diagram | None:
    """Return a vehicle's unconstrained shortest paths to a target (an index)."""
    key = vehicle, target
    if key not in problem.free_paths:
        problem.free_paths[key] = paths_of(problem, vehicle, problem.targets[target], Bans())
    return problem.free_paths[key]


def conflicting_moves(
    table: MoveTable, others: Sequence[tuple[Path, int]], steps: int
) -> list[int]:
    """Return, per step, the moves that conflict with a move of another vehicle.

    Each other vehicle is given as its path and its target, where it waits after arrival.
    """
    conflicts = table.conflicts
    conflicting = [0] * steps
    for path, target in others:
        arrived = len(path)
        for step in range(steps):
            conflicting[step] |= conflicts[path[step] if step < arrived else target]
    return conflicting


def choose_path(
    table: MoveTable, diagram: Diagram, conflicting: Sequence[int], budget: Budget | None = None
) -> Path:
    """Return the best path of a diagram, given the moves that conflict with other vehicles.

    Raises:
        BudgetSpentError: the deadline has passed.
    """
    fan, shifts = table.fan, table.shifts
    conflict_weight = diagram.cost + 1
    cost_to_go = {diagram.target: 0}
    choices: list[dict[int, int]] = []
    for step in range(diagram.cost - 1, -1, -1):
        if budget is not None:
            budget.check_time()
        layer = diagram.layers[step]
        bad = {*bits(layer & conflicting[step])}
        cost_before: dict[int, int] = {}
        choice: dict[int, int] = {}
        for bit in bits(layer):
            d = bit % fan
            cell = bit - d
            value = cost_to_go[cell + shifts[d]]
            if d:
                value += 1
            if bit in bad:
                value += conflict_weight
            if cell not in cost_before or value < cost_before[cell]:
                cost_before[cell] = value
                choice[cell] = bit
        cost_to_go = cost_before
        choices.append(choice)
    path: list[int] = []
    if choices:
        (cell,) = cost_to_go
        for choice in reversed(choices):
            path.append(choice[cell])
            cell = table.landing(choice[cell])
    return tuple(path)


def without_needless_moves(problem: Problem, solution: Solution, budget: Budget) -> Solution:
    """Return the path set without needless moves.

    Each vehicle in turn takes, among its cheapest paths around all others, the one with the
    fewest moves. Stops when nothing changes, or when the budget is spent.
    """
    while True:
        before = solution
        for vehicle in range(len(solution.paths)):
            try:
                budget.check_time()
                solution = _reroute(problem, solution, vehicle, budget)
            except BudgetSpentError:
                return solution
        if solution == before:
            return solution


def _reroute(problem: Problem, solution: Solution, vehicle: int, budget: Budget) -> Solution:
    bans = Bans()
    for other, path in enumerate(solution.paths):
        if other != vehicle:
            ban_conflicts(problem, bans, path, problem.targets[solution.assignment[other]])
    target = problem.targets[solution.assignment[vehicle]]
    diagram = paths_of(problem, vehicle, target, bans)
    if diagram is None:
        return solution
    path = choose_path(problem.table, diagram, [0] * diagram.cost, budget)
    paths = (*solution.paths[:vehicle], path, *solution.paths[vehicle + 1 :])
    return Solution(solution.assignment, paths)


def ban_conflicts(problem: Problem, bans: Bans, path: Path, target: int) -> None:
    """Ban all moves that conflict with a path or with waiting at its target afterwards."""
    conflicts = problem.table.conflicts
    for step, move in enumerate(path):
        bans.at[step] = bans.at.get(step, 0) | conflicts[move]
    bans.since[len(path)] = bans.since.get(len(path), 0) | conflicts[target]
