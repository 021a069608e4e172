"""TAPPA, the target assignment and path planning algorithm (paper, Algorithm 1).

The paper applies CBSA to one assignment after the other and stops when the next assignment costs
no less than the best path set. Here the conflict trees of all assignments stay open side by side,
so that an assignment without a solution cannot hold up the others, and a tree is left alone once
its lower bound exceeds that of another tree or the cost of the next assignment. "Optimal" is
claimed when no open tree and no later assignment can be cheaper.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from laneweave.coordinator.planning.assignments import Assignment
from laneweave.coordinator.planning.budget import Budget, BudgetSpentError
from laneweave.coordinator.planning.cbs import ConflictTree
from laneweave.coordinator.planning.incumbent import Incumbent, Solution
from laneweave.coordinator.planning.problem import Problem
from laneweave.coordinator.planning.reachability import explore

_SLICE = 4
"""Nodes expanded in one tree before the order of trees is looked at again."""

_EXPLORE_AFTER = 128
_EXPLORE_MOVES = 20_000
_EXPLORE_GROWTH = 8
_EXPLORE_TIMES = 3
"""After so many nodes without a path set, so many joint moves are tried; then more of both."""


class Tappa:
    """The state of Algorithm 1.

    best: the best path set P* so far; its cost is C'*.
    lower_bound: no path set costs less.
    finished: the search is complete; `best` is optimal, or nothing exists.
    gave_up, has_fewest_moves: never.
    tried: the assignments A_1 ... A_k whose trees were opened.
    """

    def __init__(
        self,
        problem: Problem,
        candidates: Iterator[Assignment],
        choices: Sequence[frozenset[int]],
        budget: Budget,
    ) -> None:
        """Prepare the search; `candidates` are the assignments in order of cost."""
        self.lower_bound: float = 0
        self.finished = False
        self.gave_up = self.has_fewest_moves = False
        self.tried = 0
        self._problem = problem
        self._candidates = candidates
        self._budget = budget
        self._trees: list[ConflictTree] = []
        self._incumbent = Incumbent(problem, choices, budget)
        self._choices = choices
        self._explored = 0

    @property
    def best(self) -> Solution | None:
        """Return the best path set so far."""
        return self._incumbent.best

    @property
    def best_cost(self) -> float:
        """Return C'*, which is infinite until a path set is found."""
        return math.inf if self.best is None else self.best.cost

    def run(self) -> None:
        """Search until the optimum is proven or the budget is spent."""
        try:
            self._search()
        except BudgetSpentError:
            self.lower_bound = min(self.lower_bound, self.best_cost)

    def _search(self) -> None:
        upcoming = next(self._candidates, None)
        while True:
            tree = self._most_promising_tree()
            tree_bound = math.inf if tree is None else tree.lower_bound
            next_cost = math.inf if upcoming is None else upcoming.cost
            self.lower_bound = min(next_cost, tree_bound, self.best_cost)
            if self.best_cost <= self.lower_bound:
                self.finished = True
                return
            if upcoming is not None and self._is_turn_of_assignment(next_cost, tree):
                self.tried += 1
                self._trees.append(ConflictTree(self._problem, upcoming.targets, self._budget))
                upcoming = next(self._candidates, None)
            elif tree is not None:
                self._apply_cbsa(tree)
            if self.best is None and self._is_impossible():
                self.lower_bound = math.inf
                self.finished = True
                return

    def _most_promising_tree(self) -> ConflictTree | None:
        """Close the trees that cannot improve C'*; return the one with the least lower bound."""
        self._trees = [tree for tree in self._trees if tree.lower_bound < self.best_cost]
        return min(self._trees, key=lambda tree: (tree.lower_bound, tree.expanded), default=None)

    def _is_turn_of_assignment(self, next_cost: float, tree: ConflictTree | None) -> bool:
        """Tell whether to open the tree of A_{k+1} before going on with an open tree.

        At equal cost, the more trees are open the more nodes each of them gets first.
        """
        if tree is None:
            return True
        return (next_cost, _SLICE * len(self._trees)) <= (tree.lower_bound, tree.expanded)

    def _apply_cbsa(self, tree: ConflictTree) -> None:
        """Continue one tree for a while; then look for path sets elsewhere, too."""
        node = tree.search(below=self.best_cost, nodes=_SLICE)
        if node is not None:
            self._incumbent.offer(Solution(tree.assignment, node.paths))
        self._incumbent.work(self._budget.nodes, [tree.assignment for tree in self._trees])

    def _is_impossible(self) -> bool:
        """Now and then, look whether the vehicles can reach their targets at all."""
        growth = _EXPLORE_GROWTH**self._explored
        if self._explored == _EXPLORE_TIMES or self._budget.nodes < _EXPLORE_AFTER * growth:
            return False
        self._explored += 1
        verdict = explore(self._problem, self._choices, self._budget, _EXPLORE_MOVES * growth)
        if verdict.solution is not None:
            self._incumbent.begin_with(verdict.solution)
        return verdict.impossible
