"""TAPPA, the target assignment and path planning algorithm (paper, Algorithm 1).

Assignments A_1, A_2, ... are taken in order of their cost C_k. CBSA finds the best path set P_k of
each, with cost C'_k (`cbs`). As soon as the next assignment costs at least C'*, the cost of the
best path set P* so far, P* is optimal.

Two improvements (`cbs.Improvements`) end CBSA and the sequence of assignments earlier: CBSA looks
only for path sets that cost less than C'*; and a search over the cells of all vehicles together
(`exact.joint_search`), which runs beside large constraint trees, gives a lower bound on every C'_k.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import attrs

from laneweave.coordinator.planning.budget import Budget, BudgetSpentError
from laneweave.coordinator.planning.kernels import BRANCHING
from laneweave.coordinator.planning.paper.assignments import (
    Assignment,
    Weights,
    assignments,
    matrices,
)
from laneweave.coordinator.planning.paper.cbs import ConstraintTree, Improvements
from laneweave.coordinator.planning.problem import Problem, Search, Solution
from laneweave.coordinator.planning.request import PlanRequest

if TYPE_CHECKING:
    from laneweave.coordinator.planning.exact.joint_search import JointSearch

_JOINT_AFTER = 32
"""Number of nodes after which the joint search begins."""
_JOINT_MOVES_PER_NODE = 50_000
"""Moves that the joint search tries at each node from then on, until it ends; this takes as long as
five nodes. In crowded blocks it finishes first; in other blocks the trees do."""


@attrs.frozen
class Attempt:
    """The record of one assignment.

    assignment: A_k with its cost C_k.
    tree: the constraint tree of CBSA.
    best_cost: C'_k; None: CBSA ended without a path set that costs less than C'*.
    """

    assignment: Assignment
    tree: ConstraintTree
    best_cost: int | None


class Tappa(Search):
    """The state of Algorithm 1.

    best: the best path set P* so far; its cost is C'*.
    tried: k, the number of assignments to which CBSA was applied.
    attempts: the record of each of these assignments, if recording is on.
    next_cost: C_{k+1}; None: there is no further assignment.
    """

    def __init__(
        self,
        request: PlanRequest,
        problem: Problem,
        weights: Weights,
        budget: Budget,
        improvements: Improvements | None = None,
        *,
        record: bool = False,
    ) -> None:
        """Prepare the search.

        Args:
            request: what to plan.
            problem: the same request in the form that the searches use.
            weights: weights of the formation relative distance.
            budget: deadline and limit on nodes.
            improvements: additions to the paper's algorithms; None: all.
            record: whether to keep all constraint trees.
        """
        super().__init__()
        self.attempts: list[Attempt] | None = [] if record else None
        self.next_cost: float | None = None
        self._problem = problem
        costs, allowed = matrices(request, problem, weights, budget)
        self._assignments = assignments(costs, allowed, budget)
        self._budget = budget
        self._improvements = improvements or Improvements()
        self._choices = request.choices()
        self._joint: JointSearch | None = None
        self._wants_joint = self._improvements.joint

    @property
    def best_cost(self) -> float:
        """Return C'*, which is infinite until a path set is found."""
        return math.inf if self.best is None else self.best.cost

    @property
    def joint_bound(self) -> float:
        """Return the lower bound on every C'_k that the joint search has proven."""
        return 0 if self._joint is None else self._joint.lower_bound

    def run(self) -> None:
        """Search until the optimum is proven or the budget is spent."""
        try:
            self._search()
        except BudgetSpentError:
            self.lower_bound = min(max(self.lower_bound, self.joint_bound), self.best_cost)
        else:
            self.lower_bound = self.best_cost
            self.finished = True

    def _search(self) -> None:
        """Apply Algorithm 1; k is `tried`."""
        assignment = next(self._assignments, None)  # lines 2 and 3
        while assignment is not None:  # line 4
            self.tried += 1  # line 14
            self.lower_bound = min(assignment.cost, self.best_cost)
            self._update_best(self._cbsa(assignment))  # lines 5 to 8, and 16 to 19 for the last one
            assignment = next(self._assignments, None)  # line 9
            self.next_cost = None if assignment is None else assignment.cost
            if self.next_cost is not None:
                min_cost = max(self.next_cost, self.joint_bound)  # of all further path sets
                if self.best_cost <= min_cost:
                    return  # lines 10 to 13

    def _update_best(self, solution: Solution | None) -> None:
        """Set P* and C'* if a path set is better (lines 6 to 8)."""
        if solution is not None and solution.cost < self.best_cost:
            self.best = solution

    def _cbsa(self, assignment: Assignment) -> Solution | None:
        """Apply CBSA to A_k; return P_k, or None if it cannot cost less than C'*."""
        record = self.attempts is not None
        tree = ConstraintTree(
            self._problem, assignment.targets, self._budget, self._improvements, record=record
        )
        node = tree.search(self._limit)
        if self.attempts is not None:
            self.attempts.append(Attempt(assignment, tree, None if node is None else node.cost))
        return None if node is None else Solution(assignment.targets, node.paths)

    def _limit(self) -> float:
        """Continue the joint search, then return the cost that a path set must be below."""
        if self._wants_joint and self._budget.nodes >= _JOINT_AFTER:
            self._joint, self._wants_joint = self._new_joint_search(), False
        if self._joint is not None and not self._joint.ended:
            self._joint.work(_JOINT_MOVES_PER_NODE, self.best_cost)
            self._update_best(self._joint.solution)
        if self.best_cost <= self.joint_bound:
            return -math.inf
        return self.best_cost if self._improvements.cutoff else math.inf

    def _new_joint_search(self) -> JointSearch | None:
        """Return the joint search, or None if it is not compiled and must not be."""
        with self._budget.stopwatch.paused():
            if not BRANCHING.available(compiled_only=self._budget.compiled_only):
                return None
            from laneweave.coordinator.planning.exact.joint_search import (  # noqa: PLC0415
                JointSearch,
            )
        return JointSearch(self._problem, self._choices, self._budget)


def new_search(request: PlanRequest, problem: Problem, weights: Weights, budget: Budget) -> Search:
    """Return the search of TAPPA for a request, with all improvements."""
    return Tappa(request, problem, weights, budget)
