"""Exact uniform-cost search over joint configurations: short, slow, for two or three vehicles."""

import heapq
from collections.abc import Iterator
from itertools import count
from typing import Any

from oracles.path_rules import Cell, Move, Path, Problem

Stays = tuple[tuple[Cell, bool], ...]
"""For each vehicle its cell, and whether it stays there for ever; such a vehicle costs nothing."""
State = tuple[Stays, int]
"""The same, and the number of steps so far if it is limited, otherwise 0."""


def optimal_cost(request: dict[str, Any]) -> int | None:
    """The least cost over any number of steps; None: there is no solution."""
    response = optimal_response(request)
    return None if response is None else int(response["cost"])


def optimal_response(request: dict[str, Any]) -> dict[str, Any] | None:
    problem = Problem.of(request)
    start: State = tuple((cell, False) for cell in problem.starts), 0
    came_from: dict[State, State | None] = {}
    order = count()
    queue: list[tuple[int, int, State, State | None]] = [(0, next(order), start, None)]
    while queue:
        cost, _, state, before = heapq.heappop(queue)
        if state in came_from:
            continue
        came_from[state] = before
        if all(stays for _, stays in state[0]):
            return _response(problem, cost, state, came_from)
        for step_cost, following in _successors(problem, state):
            if following not in came_from:
                heapq.heappush(queue, (cost + step_cost, next(order), following, state))
    return None


def _successors(problem: Problem, state: State) -> Iterator[tuple[int, State]]:
    cells, steps = state
    for i, (cell, stays) in enumerate(cells):
        if not stays and _may_stay(problem, cells, i):
            yield 0, ((*cells[:i], (cell, True), *cells[i + 1 :]), steps)
    moving = sum(not stays for _, stays in cells)
    if problem.max_steps is not None:
        steps += 1
        if steps > problem.max_steps:
            return
    for moves in _joint_moves(problem, cells, ()):
        pairs = zip(moves, cells, strict=True)
        yield moving, (tuple((move[1], stays) for move, (_, stays) in pairs), steps)


def _may_stay(problem: Problem, state: Stays, i: int) -> bool:
    cell = state[i][0]
    return cell in {problem.targets[j] for j in problem.eligible[i]} and (cell, True) not in state


def _joint_moves(
    problem: Problem, state: Stays, chosen: tuple[Move, ...]
) -> Iterator[tuple[Move, ...]]:
    if len(chosen) == len(state):
        yield chosen
        return
    vehicle = len(chosen)
    cell, stays = state[vehicle]
    for move in [(cell, cell)] if stays else problem.moves_from(cell):
        if problem.can_drive(vehicle, move) and not any(
            problem.conflict(move, other) for other in chosen
        ):
            yield from _joint_moves(problem, state, (*chosen, move))


def _response(
    problem: Problem, cost: int, goal: State, came_from: dict[State, State | None]
) -> dict[str, Any]:
    states: list[Stays] = []
    state: State | None = goal
    while state is not None:
        previous = came_from[state]
        # Steps keep the flags; a transition that sets one takes no time.
        if previous is None or _flags(previous) == _flags(state):
            states.append(state[0])
        state = previous
    states.reverse()
    paths: list[Path] = [[s[i][0] for s in states] for i in range(len(goal[0]))]
    return {
        "cost": cost,
        "lower_bound": cost,
        "steps": len(states) - 1,
        "assignment": [problem.targets.index(path[-1]) for path in paths],
        "paths": paths,
    }


def _flags(state: State) -> list[bool]:
    return [stays for _, stays in state[0]]
