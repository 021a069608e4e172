"""A record of a run of Algorithms 1 and 2: assignments, constraint trees, stop reason.

The trees are exactly the paper's if these are small, otherwise those of the improved algorithms.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Final, Literal

import attrs

from laneweave.coordinator.planning.budget import Budget, Stopwatch
from laneweave.coordinator.planning.paper.assignments import Weights
from laneweave.coordinator.planning.paper.cbs import ConstraintTree, Improvements, Node
from laneweave.coordinator.planning.paper.constraints import entry
from laneweave.coordinator.planning.paper.tappa import Attempt, Tappa
from laneweave.coordinator.planning.path_map import RelativePathMap
from laneweave.coordinator.planning.problem import MoveTable, Problem, Solution
from laneweave.coordinator.planning.request import PlanRequest

MAX_LITERAL_NODES: Final = 150
"""Node limit for literal trees; beyond it, improved trees are recorded."""
MAX_NODES: Final = 50_000
"""Node limit for improved trees; the record ends there."""

NodeStatus = Literal["expanded", "solution", "open"]
"""open: still in T when the search ended."""


@attrs.frozen
class ExplainedNode:
    """A node N_i of a constraint tree.

    number, parent: i of this node and of its parent; the root's parent is 0.
    constraint: the constraint that it adds to its parent's; empty for the root.
    conflicts: its conflict list in the paper's notation.
    path_map: the relative path map of its path set M_i.
    cost: L_i.
    """

    number: int
    parent: int
    constraint: str
    conflicts: tuple[str, ...]
    path_map: RelativePathMap
    cost: int
    status: NodeStatus


@attrs.frozen
class ExplainedAssignment:
    """The record of an assignment A_k.

    targets: the assignment vector, targets counted from 0.
    cost: C_k.
    best_cost: C'_k; None: no path set that costs less than C'* was found.
    best_so_far: C'* after this assignment.
    nodes: the nodes of the constraint tree in order of creation.
    """

    targets: tuple[int, ...]
    cost: int
    best_cost: int | None
    best_so_far: float
    nodes: tuple[ExplainedNode, ...]


@attrs.frozen
class Explanation:
    """The record of a run of Algorithm 1.

    literal: whether the trees are those of the paper, with all improvements off.
    optimal: whether it is proven that C'* is optimal or that there is no path set.
    joint_bound: lower bound proven by the joint search; 0: none.
    joint_cost: C'* if the joint search found it, else None.
    next_cost: C_{k+1}; None: there is no further assignment, or it was not examined.
    """

    literal: bool
    assignments: tuple[ExplainedAssignment, ...]
    best_cost: float
    optimal: bool
    joint_bound: float
    joint_cost: int | None
    next_cost: float | None

    @property
    def stop_reason(self) -> str:
        """Return one line explaining why no further assignment was tried."""
        k = len(self.assignments)
        best = "infinite" if math.isinf(self.best_cost) else f"{self.best_cost:g}"
        if not self.optimal:
            return f"deadline or node limit, C'* = {best} is not proven"
        if self.joint_cost is not None:
            return f"joint search: no path set costs less than C'* = {best}"
        if self.next_cost is not None and self.best_cost <= self.next_cost:
            return f"C_{k + 1} = {self.next_cost:g} >= C'* = {best}"
        if self.best_cost <= self.joint_bound and not math.isinf(self.best_cost):
            return f"joint search: no path set costs less than C'* = {best}"
        if math.isinf(self.joint_bound):
            return f"joint search: there is no path set, C'* = {best}"
        return f"there is no further assignment, C'* = {best}"


def explain(request: PlanRequest) -> Explanation:
    """Run Algorithm 1 on a request and return the record of the run."""
    stopwatch, weights = Stopwatch(), Weights.for_mode(request.mode)
    problem = request.problem()

    def recorded(improvements: Improvements, max_nodes: int) -> Tappa:
        budget = Budget(
            deadline_s=request.deadline_s,
            max_nodes=max_nodes,
            compiled_only=True,
            stopwatch=stopwatch,
        )
        tappa = Tappa(request, problem, weights, budget, improvements, record=True)
        tappa.run()
        return tappa

    run = recorded(Improvements.none(), MAX_LITERAL_NODES)
    literal = run.finished
    if not literal:
        run = recorded(Improvements(), MAX_NODES)
    best = math.inf
    found = []
    for attempt in run.attempts or ():
        best = min(best, math.inf if attempt.best_cost is None else attempt.best_cost)
        found.append(_assignment(problem, request.ids, attempt, best))
    found_by_tree = best == run.best_cost
    return Explanation(
        literal=literal,
        assignments=tuple(found),
        best_cost=run.best_cost,
        optimal=run.finished,
        joint_bound=run.joint_bound,
        joint_cost=None if found_by_tree or run.best is None else run.best.cost,
        next_cost=run.next_cost,
    )


def entries(table: MoveTable, node: Node, names: Sequence[str]) -> Iterator[str]:
    """Yield a node's conflict list: an entry C^f for each vehicle of each conflict."""
    for conflict in node.conflicts:
        pair = conflict.first, conflict.second
        for vehicle, move in zip(pair, node.moves(conflict), strict=True):
            at_node = not conflict.on_edge
            yield entry(table, move, names[vehicle], conflict.step, at_node=at_node)


def _assignment(
    problem: Problem, names: Sequence[str], attempt: Attempt, best: float
) -> ExplainedAssignment:
    tree = attempt.tree
    nodes = tuple(_node(problem, names, tree, node) for node in tree.nodes or ())
    assignment = attempt.assignment
    return ExplainedAssignment(assignment.targets, assignment.cost, attempt.best_cost, best, nodes)


def _node(
    problem: Problem, names: Sequence[str], tree: ConstraintTree, node: Node
) -> ExplainedNode:
    table = problem.table
    constraint = node.constraints[-1] if node.constraints else None
    cells = problem.cells_of(Solution(tree.assignment, node.paths))
    status: NodeStatus = "expanded" if node.expanded else "open"
    return ExplainedNode(
        number=node.number,
        parent=node.parent,
        constraint=""
        if constraint is None
        else constraint.notation(table, names[constraint.vehicle]),
        conflicts=tuple(dict.fromkeys(entries(table, node, names))),
        path_map=RelativePathMap.padded(names, cells),
        cost=node.cost,
        status="solution" if node is tree.solution else status,
    )
