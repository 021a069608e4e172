"""An exact answer for small joint state spaces: can the vehicles reach their targets at all?

Conflict trees never end when no path set exists. A search over the cells of all vehicles together
does: vehicles with the same eligible targets form a team and are interchangeable, so a state is
which cells each team occupies. States whose vehicles are close to targets of theirs come first, so
a path set is found soon where there is one, even if the trees take for ever to find it. The search
is cut off after a given number of joint moves; then it has shown nothing.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Sequence

import attrs

from laneweave.coordinator.planning.budget import Budget
from laneweave.coordinator.planning.moves import MoveTable, bits
from laneweave.coordinator.planning.problem import Problem
from laneweave.coordinator.planning.solution import Solution

State = tuple[int, ...]
"""The cells of all vehicles, team by team, sorted within a team."""

_MOVES_PER_TIME_CHECK = 256


@attrs.frozen
class Verdict:
    """What the search showed.

    solution: a path set, if one was found; not an optimal one.
    impossible: all states were visited, and in none are all vehicles at their targets.
    """

    solution: Solution | None = None
    impossible: bool = False


@attrs.frozen
class _Step:
    """How a state was first reached; `order` tells which mover came to which place in it."""

    state: State
    moves: tuple[int, ...]
    order: tuple[int, ...]


def explore(
    problem: Problem, choices: Sequence[frozenset[int]], budget: Budget, max_moves: int
) -> Verdict:
    """Search all joint states that can be reached, up to `max_moves` joint moves."""
    vehicles = sorted(range(len(choices)), key=lambda v: (sorted(choices[v]), v))
    teams = [sorted(choices[v]) for v in vehicles]
    team = [teams.index(t) for t in teams]
    goals = [frozenset(problem.targets[j] for j in t) for t in teams]
    one_at_a_time = _can_be_made_one_after_another(problem.table)

    start, order = _sorted_by_team([problem.starts[v] for v in vehicles], team)
    vehicles = [vehicles[i] for i in order]
    away = [_steps_away(problem.table, goal) for goal in goals]
    found: dict[State, _Step | None] = {start: None}
    frontier = [(0, 0, start)]
    made = 0
    while frontier:
        _, _, state = heapq.heappop(frontier)
        arrived = all(cell in goal for cell, goal in zip(state, goals, strict=True))
        if arrived and len(set(state)) == len(state):
            return Verdict(solution=_solution(problem, found, state, vehicles))
        successors = _single_moves if one_at_a_time else _joint_moves
        for moves in successors(problem.table, state):
            made += 1
            if made % _MOVES_PER_TIME_CHECK == 0:
                budget.check_time()
            if made > max_moves:
                return Verdict()
            following, order = _sorted_by_team([problem.table.landing(m) for m in moves], team)
            if following not in found:
                found[following] = _Step(state, moves, order)
                left = sum(steps.get(cell, 0) for steps, cell in zip(away, following, strict=True))
                heapq.heappush(frontier, (left, len(found), following))
    return Verdict(impossible=True)


def _steps_away(table: MoveTable, goals: frozenset[int]) -> dict[int, int]:
    """Return the least number of steps from each cell to one of some others."""
    steps: dict[int, int] = {}
    reached = cells = sum(1 << goal for goal in goals)
    count = 0
    while cells:
        steps.update(dict.fromkeys(bits(cells), count))
        count += 1
        cells = table.starts(table.leading_to(cells)) & ~reached
        reached |= cells
    return steps


def _can_be_made_one_after_another(table: MoveTable) -> bool:
    """Tell whether the moves of any one step could also be made in single file.

    True if no vehicle moves into a cell that another one is leaving, and if passing a waiting
    vehicle is not forbidden unless every overlap of footprints is. A computed table is of this kind
    if it holds for any lateness: that one vehicle waits until the other has arrived is part of it.
    If vehicles are not very late it allows some to follow each other that cannot go one by one.
    `closing` takes two vehicles that both move, so it never stands in the way of a single one.
    """
    kinds, geometry = table.model.kinds, table.model.geometry
    if "geometric" in kinds:
        passing = table.mode == 1 or "special-4" not in kinds
        return geometry is None or (geometry.lateness_s is None and passing)
    no_following = "node" in kinds and "special-1" in kinds
    return no_following and (table.mode == 1 or "special-4" not in kinds)


def _single_moves(table: MoveTable, state: State) -> Iterator[tuple[int, ...]]:
    """Yield the joint moves in which one vehicle moves."""
    for i, cell in enumerate(state):
        options = table.starting_in(1 << cell) & ~(1 << cell)
        for j, other in enumerate(state):
            if j != i:
                options &= ~table.conflicts[other]
        for move in bits(options):
            yield (*state[:i], move, *state[i + 1 :])


def _joint_moves(
    table: MoveTable, state: State, chosen: tuple[int, ...] = (), forbidden: int = 0
) -> Iterator[tuple[int, ...]]:
    """Yield all joint moves without conflicts."""
    if len(chosen) == len(state):
        yield chosen
        return
    for move in bits(table.starting_in(1 << state[len(chosen)]) & ~forbidden):
        yield from _joint_moves(table, state, (*chosen, move), forbidden | table.conflicts[move])


def _sorted_by_team(cells: Sequence[int], team: Sequence[int]) -> tuple[State, tuple[int, ...]]:
    order = tuple(sorted(range(len(cells)), key=lambda i: (team[i], cells[i], i)))
    return tuple(cells[i] for i in order), order


def _solution(
    problem: Problem,
    found: dict[State, _Step | None],
    goal: State,
    vehicles: Sequence[int],
) -> Solution:
    """Follow the search back to the start, then walk each vehicle through it."""
    steps: list[_Step] = []
    step = found[goal]
    while step is not None:
        steps.append(step)
        step = found[step.state]
    places = list(vehicles)
    paths: list[list[int]] = [[] for _ in vehicles]
    for step in reversed(steps):
        for vehicle, move in zip(places, step.moves, strict=True):
            paths[vehicle].append(move)
        places = [places[i] for i in step.order]
    assignment = [0] * len(places)
    for vehicle, cell in zip(places, goal, strict=True):
        assignment[vehicle] = problem.targets.index(cell)
        while paths[vehicle] and paths[vehicle][-1] == cell:
            paths[vehicle].pop()
    return Solution(tuple(assignment), tuple(tuple(path) for path in paths))
