"""Good path sets early: prioritized planning, improved by large-neighbourhood search.

The conflict trees prove how cheap a plan can be, but may take long to reach their first solution.
Here vehicles are planned one after the other, each avoiding the paths of those before it; then a
few vehicles at a time are taken out, perhaps exchange targets, and are planned again. That gives
an answer when the deadline comes early, and a bound C'* that lets the trees stop early.

All choices are drawn from a fixed seed, so equal problems give equal path sets.
"""

from __future__ import annotations

import random
from collections.abc import Iterable, Sequence

import attrs

from laneweave.coordinator.planning.budget import Budget, BudgetSpentError
from laneweave.coordinator.planning.diagram import Bans, Diagram, shortest_paths
from laneweave.coordinator.planning.problem import Problem
from laneweave.coordinator.planning.sppa import Path, choose_path

_NODES_PER_BUILD = 12
_NODES_PER_IMPROVEMENT = 24
"""Divided by the number of vehicles: with 6 vehicles one step per two nodes until there is a path
set, then one per four nodes; more steps with more vehicles, for which a proof is out of reach."""

_CREDIT_PER_VEHICLE = 4
"""Nodes' worth of steps that are granted each time a better path set is found."""

_TAKE_OUT_AT_MOST = 6
_BUILDS_PER_ROUND = 16
_IDLE_STEPS_PER_ROUND = 600
"""After so many vain attempts to improve a path set the search starts again from new ones."""


@attrs.frozen
class Solution:
    """A conflict-free path set for an assignment."""

    assignment: tuple[int, ...]
    paths: tuple[Path, ...]

    @property
    def cost(self) -> int:
        """Return the cost of the path set."""
        return sum(len(path) for path in self.paths)


class Incumbent:
    """The best path set found without a proof."""

    def __init__(self, problem: Problem, choices: Sequence[frozenset[int]], budget: Budget) -> None:
        """Start without a path set; `choices` are the eligible targets of each vehicle."""
        self.best: Solution | None = None
        self._problem = problem
        self._choices = choices
        self._budget = budget
        self._random = random.Random(0)  # noqa: S311
        self._order = list(range(len(choices)))
        self._effort = 0.0
        self._credit = 0
        self._steps = 0
        self._round: Solution | None = None
        self._builds = 0
        self._idle = 0

    def work(self, nodes: int, assignments: Sequence[Sequence[int]]) -> None:
        """Do as many small steps as the number of expanded nodes allows, more while it pays."""
        vehicles = len(self._choices)
        while self._effort < nodes + self._credit:
            before = self.best
            self._steps += 1
            share = _NODES_PER_BUILD if before is None else _NODES_PER_IMPROVEMENT
            self._effort += share / vehicles
            self._step(assignments[self._steps % len(assignments)])
            if self.best is not before:
                self._credit += _CREDIT_PER_VEHICLE * vehicles

    def _step(self, assignment: Sequence[int]) -> None:
        """Do one small piece of work; new rounds plan for `assignment`."""
        if self._round is None or self._builds < _BUILDS_PER_ROUND:
            self._build(assignment)
        elif len(assignment) > 1:
            self._improve(self._round)
        if self._idle > _IDLE_STEPS_PER_ROUND:
            self._round, self._builds, self._idle = None, 0, 0

    def offer(self, solution: Solution) -> None:
        """Keep a path set if it is the best so far."""
        if self.best is None or solution.cost < self.best.cost:
            self.best = solution

    def begin_with(self, solution: Solution) -> None:
        """Improve a path set that was found elsewhere from now on."""
        self.offer(solution)
        self._round, self._builds, self._idle = solution, _BUILDS_PER_ROUND, 0

    def _build(self, assignment: Sequence[int]) -> None:
        """Plan all vehicles one after the other; one that is stuck goes first next time."""
        self._builds += 1
        stuck, paths = self._plan(self._order, assignment, {})
        if stuck is None:
            self._keep(assignment, paths)
            self._random.shuffle(self._order)
        else:
            self._order.remove(stuck)
            self._order.insert(0, stuck)

    def _improve(self, best: Solution) -> None:
        """Take some vehicles out of the round's path set and plan them again."""
        removed = self._neighbourhood(best)
        assignment = list(best.assignment)
        if self._random.random() < 0.5:
            self._exchange(assignment, removed)
        kept = {v: path for v, path in enumerate(best.paths) if v not in removed}
        self._idle += 1
        stuck, paths = self._plan(removed, assignment, kept)
        if stuck is None:
            self._keep(assignment, paths)

    def _keep(self, assignment: Sequence[int], paths: dict[int, Path]) -> None:
        found = Solution(tuple(assignment), tuple(paths[v] for v in range(len(paths))))
        if self._round is None or found.cost < self._round.cost:
            self._idle = 0
        if self._round is None or found.cost <= self._round.cost:
            self._round = found
        self.offer(found)

    def _neighbourhood(self, best: Solution) -> list[int]:
        """Choose a vehicle that is late, and some of those that are in its way."""
        problem, count = self._problem, len(best.paths)
        size = self._random.randint(2, min(count, _TAKE_OUT_AT_MOST))
        free = [problem.free_paths(v, best.assignment[v]) for v in range(count)]
        late = [len(best.paths[v]) - (d.cost if d else 0) for v, d in enumerate(free)]
        if not any(late):
            return self._random.sample(range(count), size)
        (seed,) = self._random.choices(range(count), late)
        wish = free[seed]
        blockers = [
            v
            for v in range(count)
            if v != seed and wish is not None and self._is_in_the_way(best, v, wish)
        ]
        self._random.shuffle(blockers)
        others = [v for v in range(count) if v != seed and v not in blockers]
        self._random.shuffle(others)
        removed = [seed, *(blockers + others)[: size - 1]]
        self._random.shuffle(removed)
        return removed

    def _is_in_the_way(self, best: Solution, vehicle: int, wish: Diagram) -> bool:
        """Tell whether a vehicle's path conflicts with some shortest path of another one."""
        conflicts = self._problem.table.conflicts
        path, target = best.paths[vehicle], self._problem.targets[best.assignment[vehicle]]
        return any(
            layer & conflicts[path[step] if step < len(path) else target]
            for step, layer in enumerate(wish.layers)
        )

    def _exchange(self, assignment: list[int], removed: Sequence[int]) -> None:
        """Exchange the targets of the removed vehicles, if all remain eligible."""
        targets = [assignment[v] for v in removed]
        self._random.shuffle(targets)
        if all(t in self._choices[v] for v, t in zip(removed, targets, strict=True)):
            for vehicle, target in zip(removed, targets, strict=True):
                assignment[vehicle] = target

    def _plan(
        self, order: Iterable[int], assignment: Sequence[int], kept: dict[int, Path]
    ) -> tuple[int | None, dict[int, Path]]:
        """Plan the vehicles in this order around the kept paths; return who is stuck, if any."""
        problem = self._problem
        table, targets = problem.table, problem.targets
        paths = dict(kept)
        for vehicle in order:
            self._budget.check_time()
            bans = Bans()
            for other, path in paths.items():
                avoid(problem, bans, path, targets[assignment[other]])
            start, target = problem.starts[vehicle], targets[assignment[vehicle]]
            diagram = shortest_paths(table, start, target, bans)
            if diagram is None:
                return vehicle, paths
            paths[vehicle] = choose_path(table, diagram, [0] * diagram.cost)
        return None, paths


def avoid(problem: Problem, bans: Bans, path: Path, target: int) -> None:
    """Add all moves that conflict with a path, and with waiting at its target ever after."""
    conflicts = problem.table.conflicts
    for step, move in enumerate(path):
        bans.at[step] = bans.at.get(step, 0) | conflicts[move]
    bans.since[len(path)] = bans.since.get(len(path), 0) | conflicts[target]


def tidied(problem: Problem, solution: Solution, budget: Budget) -> Solution:
    """Return the path set without needless moves.

    Each vehicle in turn takes, among its cheapest paths around all others, the one with the
    fewest moves. Stops when nothing changes any more, or when time is up.
    """
    while True:
        before = solution
        for vehicle in range(len(solution.paths)):
            try:
                budget.check_time()
            except BudgetSpentError:
                return solution
            solution = _tidied_for(problem, solution, vehicle)
        if solution == before:
            return solution


def _tidied_for(problem: Problem, solution: Solution, vehicle: int) -> Solution:
    bans = Bans()
    for other, path in enumerate(solution.paths):
        if other != vehicle:
            avoid(problem, bans, path, problem.targets[solution.assignment[other]])
    target = problem.targets[solution.assignment[vehicle]]
    diagram = shortest_paths(problem.table, problem.starts[vehicle], target, bans)
    if diagram is None:
        return solution
    path = choose_path(problem.table, diagram, [0] * diagram.cost)
    paths = (*solution.paths[:vehicle], path, *solution.paths[vehicle + 1 :])
    return Solution(solution.assignment, paths)
