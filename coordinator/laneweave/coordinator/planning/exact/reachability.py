"""Joint search for small state spaces: find any path set, or prove that there is none.

Branch and bound and conflict trees may not terminate if no path set exists. A joint search over the
cells of all vehicles does: vehicles with the same eligible targets that can drive the same moves
form a team and are interchangeable, so a state is the set of cells of each team. States whose
vehicles are close to their targets come first, so a path set is found soon if one exists. After a
given number of joint moves the search ends without a result.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from itertools import count, product

import attrs

from laneweave.coordinator.planning.budget import Budget
from laneweave.coordinator.planning.conflict_kinds import ConflictModel, conflict_offsets
from laneweave.coordinator.planning.problem import MoveTable, Problem, Solution, bits
from laneweave.protocol.lattice import Mode, displacements

State = tuple[int, ...]
"""The cells of all vehicles, team by team, sorted within each team."""

_LOOKS_PER_TIME_CHECK = 256


@attrs.frozen
class Reachability:
    """The result of the search.

    solution: a path set, if one was found; not necessarily optimal.
    infeasible: whether no state with all vehicles at their targets can be reached.
    """

    solution: Solution | None = None
    infeasible: bool = False


@attrs.frozen
class _Step:
    """The joint move from `state` that first reached a new state; `order` re-sorts the vehicles."""

    state: State
    moves: tuple[int, ...]
    order: tuple[int, ...]


def explore(
    problem: Problem, choices: Sequence[frozenset[int]], budget: Budget, max_moves: int
) -> Reachability:
    """Search the reachable joint states, up to `max_moves` joint moves."""
    members = [(sorted(choice), problem.undrivable[v]) for v, choice in enumerate(choices)]
    vehicles = sorted(range(len(choices)), key=lambda v: (*members[v], v))
    teams = [members[v] for v in vehicles]
    team = [teams.index(t) for t in teams]
    goals = [frozenset(problem.targets[j] for j in choice) for choice, _ in teams]
    undrivable = [moves for _, moves in teams]
    one_at_a_time = can_be_made_one_after_another(problem.table.mode, problem.table.model)

    start, order = _sorted_by_team([problem.starts[v] for v in vehicles], team)
    vehicles = [vehicles[i] for i in order]
    distances = [problem.table.distances(sum(1 << cell for cell in goal)) for goal in goals]
    found: dict[State, _Step | None] = {start: None}
    frontier = [(0, 0, start)]
    move_count, looks = 0, count(1)

    def look_at_clock() -> None:
        if next(looks) % _LOOKS_PER_TIME_CHECK == 0:
            budget.check_time()

    while frontier:
        _, _, state = heapq.heappop(frontier)
        arrived = all(cell in goal for cell, goal in zip(state, goals, strict=True))
        if arrived and len(set(state)) == len(state):
            return Reachability(solution=_solution(problem, found, state, vehicles))
        successors = _single_moves if one_at_a_time else _joint_moves
        for moves in successors(problem.table, state, undrivable, look_at_clock):
            move_count += 1
            if move_count > max_moves:
                return Reachability()
            successor, order = _sorted_by_team([problem.table.landing(m) for m in moves], team)
            if successor not in found:
                found[successor] = _Step(state, moves, order)
                remaining = sum(
                    steps.get(cell, 0) for steps, cell in zip(distances, successor, strict=True)
                )
                heapq.heappush(frontier, (remaining, len(found), successor))
    return Reachability(infeasible=True)


@lru_cache(maxsize=64)
def can_be_made_one_after_another(mode: Mode, model: ConflictModel) -> bool:
    """Return whether the moves of any step can also be made one after another, in any order.

    True if, for any two moves that do not conflict, each is also possible while the other vehicle
    waits in its from-cell or in its to-cell.
    """
    if model.vehicles_share_cells:
        return False
    conflicts = [frozenset(offsets) for offsets in conflict_offsets(mode, model)]
    columns, lanes = (range(-reach, reach + 1) for reach in model.reach)
    for blocked in conflicts:
        for column, lane, (e, (x, y)) in product(columns, lanes, enumerate(displacements(mode))):
            if (column, lane) == (0, 0) or (column, lane, e) in blocked:
                continue
            if (column, lane, 0) in blocked or (column + x, lane + y, 0) in blocked:
                return False
    return True


def _single_moves(
    table: MoveTable, state: State, undrivable: Sequence[int], look: Callable[[], None]
) -> Iterator[tuple[int, ...]]:
    """Yield the joint moves in which one vehicle moves; call `look` for each vehicle."""
    for i, cell in enumerate(state):
        look()
        options = table.starting_in(1 << cell) & ~(1 << cell | undrivable[i])
        for j, other in enumerate(state):
            if j != i:
                options &= ~table.conflicts[other]
        for move in bits(options):
            yield (*state[:i], move, *state[i + 1 :])


def _joint_moves(
    table: MoveTable,
    state: State,
    undrivable: Sequence[int],
    look: Callable[[], None],
    chosen: tuple[int, ...] = (),
    forbidden: int = 0,
) -> Iterator[tuple[int, ...]]:
    """Yield all conflict-free joint moves; call `look` for each partial joint move."""
    look()
    if len(chosen) == len(state):
        yield chosen
        return
    number = len(chosen)
    for move in bits(table.starting_in(1 << state[number]) & ~(forbidden | undrivable[number])):
        conflicting = forbidden | table.conflicts[move]
        yield from _joint_moves(table, state, undrivable, look, (*chosen, move), conflicting)


def _sorted_by_team(cells: Sequence[int], team: Sequence[int]) -> tuple[State, tuple[int, ...]]:
    order = tuple(sorted(range(len(cells)), key=lambda i: (team[i], cells[i], i)))
    return tuple(cells[i] for i in order), order


def _solution(
    problem: Problem, found: dict[State, _Step | None], goal: State, vehicles: Sequence[int]
) -> Solution:
    """Reconstruct the paths of the vehicles from the start to a goal state."""
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
