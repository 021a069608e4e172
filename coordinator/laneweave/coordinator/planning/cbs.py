"""CBSA, the conflict-based searching algorithm (paper, Algorithm 2), for one assignment.

The conflict tree is searched in order of cost. A node has the paper's four attributes:
constraints, conflicts, path set and cost. What differs from the paper keeps the result exact:

- a node is split at one conflict, not at all of them (see `conflict_tree` for the paper's way);
- the two bans of a conflict are grown to sets of moves, and the two children exclude each other
  (see `constraints`);
- the conflict that raises the cost most is taken first, and pairs of vehicles that cannot both
  keep their cost raise the lower bound of a node;
- a child that costs no more and has fewer conflicts replaces its parent's paths ("bypass");
- the search can be interrupted and continued, and is told the best cost found elsewhere.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Sequence

import attrs

from laneweave.coordinator.planning.budget import Budget
from laneweave.coordinator.planning.constraints import (
    Conflict,
    Constraint,
    Split,
    bans_for,
    rises,
    split_by_cost,
    split_by_moves,
)
from laneweave.coordinator.planning.diagram import Diagram, shortest_paths
from laneweave.coordinator.planning.problem import Problem
from laneweave.coordinator.planning.sppa import Path, choose_path, conflicting_moves

_EXACT_COVER_EDGES = 16

UNBOUNDED = math.inf
BOTH = 2
"""Both children of a split cost more."""


@attrs.define(eq=False)
class Node:
    """A node of the conflict tree.

    constraints: of this node and all nodes above it.
    diagrams: all shortest paths of each vehicle under its constraints.
    paths: the path set, chosen from the diagrams.
    conflicts: of the path set.
    bound: a lower bound on the cost of every solution below this node.
    """

    constraints: tuple[Constraint, ...]
    diagrams: tuple[Diagram, ...]
    paths: tuple[Path, ...]
    conflicts: tuple[Conflict, ...]
    bound: int
    evaluated: bool = False

    @property
    def cost(self) -> int:
        """Return the cost of the path set."""
        return sum(len(path) for path in self.paths)


class ConflictTree:
    """The conflict tree of one assignment, searched best first."""

    def __init__(self, problem: Problem, assignment: Sequence[int], budget: Budget) -> None:
        """Create the tree with its root node N_1."""
        self.problem = problem
        self.assignment = tuple(assignment)
        self.solution: Node | None = None
        self.expanded = 0
        self._budget = budget
        self._serial = 0
        self._open: list[tuple[int, int, int, Node]] = []
        root = self._root()
        if root is not None:
            self._push(root)

    @property
    def lower_bound(self) -> float:
        """Return a bound on all solutions that are not found yet; infinite if there are none."""
        return self._open[0][0] if self._open else UNBOUNDED

    def search(self, *, below: float, nodes: int) -> Node | None:
        """Expand up to `nodes` nodes; return a solution that costs less than `below`, if found.

        `below` must not grow between calls: nodes that cost as much are dropped. The first
        solution found is the best one of this assignment, and ends the tree.
        """
        last = self.expanded + nodes
        while self._open and self._open[0][0] < below and self.expanded < last:
            self._budget.take_node()
            bound, _, _, node = self._open[0]
            if not node.evaluated:
                self._raise_bound(node)
                if node.bound > bound:
                    heapq.heappop(self._open)
                    self._push(node)
                    continue
            self.expanded += 1
            if not node.conflicts:
                self._open.clear()
                self.solution = node
                return node
            children = self._children(node)
            heapq.heappop(self._open)
            for child in children:
                if child.bound < below:
                    self._push(child)
        return None

    def _push(self, node: Node) -> None:
        self._serial += 1
        heapq.heappush(self._open, (node.bound, len(node.conflicts), self._serial, node))

    def _root(self) -> Node | None:
        problem = self.problem
        diagrams: list[Diagram] = []
        paths: list[Path] = []
        for vehicle, target in enumerate(self.assignment):
            self._budget.check_time()
            diagram = problem.free_paths(vehicle, target)
            if diagram is None:
                return None
            others = [(p, d.target) for p, d in zip(paths, diagrams, strict=True)]
            taken = conflicting_moves(problem.table, others, diagram.cost)
            paths.append(choose_path(problem.table, diagram, taken))
            diagrams.append(diagram)
        cost = sum(len(path) for path in paths)
        conflicts = self._all_conflicts(diagrams, paths)
        return Node((), tuple(diagrams), tuple(paths), conflicts, cost)

    def _children(self, node: Node) -> list[Node]:
        """Return the children of a node, after bypassing conflicts that cost nothing."""
        while True:
            split = self._choose_split(node)
            children = []
            for constraint in (split.without, split.using):
                child = self._child(node, constraint)
                if child is None:
                    continue
                if child.cost == node.cost and len(child.conflicts) < len(node.conflicts):
                    node.paths = child.paths
                    node.conflicts = child.conflicts
                    break
                children.append(child)
            else:
                return children
            if not node.conflicts:
                return [node]

    def _child(self, node: Node, added: Sequence[Constraint]) -> Node | None:
        """Return the node with these constraints added, or None if some vehicle has no path."""
        problem, table = self.problem, self.problem.table
        constraints = (*node.constraints, *added)
        diagrams = list(node.diagrams)
        changed = []
        for vehicle, diagram in enumerate(node.diagrams):
            if all(constraint.spares(vehicle, diagram) for constraint in added):
                continue
            self._budget.check_time()
            bans = bans_for(vehicle, constraints)
            narrowed = shortest_paths(table, problem.starts[vehicle], diagram.target, bans)
            if narrowed is None:
                return None
            diagrams[vehicle] = narrowed
            changed.append(vehicle)
        paths = list(node.paths)
        rerouted = [v for v in changed if not respects(paths[v], diagrams[v])]
        for vehicle in rerouted:
            diagram = diagrams[vehicle]
            others = [
                (path, other.target)
                for i, (path, other) in enumerate(zip(paths, diagrams, strict=True))
                if i != vehicle
            ]
            self._budget.check_time()
            taken = conflicting_moves(table, others, diagram.cost)
            paths[vehicle] = choose_path(table, diagram, taken)
        conflicts = set(node.conflicts)
        for vehicle in rerouted:
            conflicts = {c for c in conflicts if vehicle not in (c.first, c.second)}
            conflicts.update(self._conflicts_of(vehicle, diagrams, paths))
        bound = max(sum(len(path) for path in paths), node.bound)
        return Node(constraints, tuple(diagrams), tuple(paths), tuple(sorted(conflicts)), bound)

    def _all_conflicts(
        self, diagrams: Sequence[Diagram], paths: Sequence[Path]
    ) -> tuple[Conflict, ...]:
        found = []
        for vehicle in range(len(paths)):
            self._budget.check_time()
            found += self._conflicts_of(vehicle, diagrams[: vehicle + 1], paths[: vehicle + 1])
        return tuple(sorted(found))

    def _conflicts_of(
        self, vehicle: int, diagrams: Sequence[Diagram], paths: Sequence[Path]
    ) -> list[Conflict]:
        """Return the conflicts between one vehicle and all others."""
        conflicts = self.problem.table.conflicts
        own, own_target = paths[vehicle], diagrams[vehicle].target
        found = []
        for other, path in enumerate(paths):
            if other == vehicle:
                continue
            target = diagrams[other].target
            arrived = len(path)
            for step in range(max(len(own), arrived)):
                mine = own[step] if step < len(own) else own_target
                theirs = path[step] if step < arrived else target
                if conflicts[mine] >> theirs & 1:
                    pair = (vehicle, other) if vehicle < other else (other, vehicle)
                    found.append(Conflict(step, *pair))
        return found

    def _choose_split(self, node: Node) -> Split:
        """Return the split whose children cost most; among equal ones the earliest."""
        table, diagrams = self.problem.table, node.diagrams
        best, most = node.conflicts[0], -1
        for conflict in node.conflicts:
            rising = rises(table, conflict, _moves(node, conflict), diagrams)
            if rising > most:
                best, most = conflict, rising
            if most == BOTH:
                return split_by_moves(table, best, _moves(node, best), diagrams)
        for conflict in node.conflicts:
            if not self.problem.compatible(diagrams[conflict.first], diagrams[conflict.second]):
                return split_by_cost(table, conflict, diagrams)
        return split_by_moves(table, best, _moves(node, best), diagrams)

    def _raise_bound(self, node: Node) -> None:
        """Add what pairs of vehicles that cannot both keep their cost must pay at least."""
        node.evaluated = True
        pairs = sorted({(c.first, c.second) for c in node.conflicts})
        edges = [
            pair
            for pair in pairs
            if not self.problem.compatible(node.diagrams[pair[0]], node.diagrams[pair[1]])
        ]
        node.bound = max(node.bound, node.cost + least_cover(edges))


def least_cover(edges: Sequence[tuple[int, int]]) -> int:
    """Return the least number of vertices that touch all edges (a lower bound if many edges)."""
    if not edges:
        return 0
    a, b = edges[0]
    without_a = [e for e in edges if a not in e]
    without_b = [e for e in edges if b not in e]
    if len(edges) > _EXACT_COVER_EDGES:
        return 1 + least_cover([e for e in without_a if b not in e])
    return 1 + min(least_cover(without_a), least_cover(without_b))


def respects(path: Path, diagram: Diagram) -> bool:
    """Tell whether a path is one of the diagram's."""
    return len(path) == diagram.cost and all(
        layer >> move & 1 for layer, move in zip(diagram.layers, path, strict=True)
    )


def _moves(node: Node, conflict: Conflict) -> tuple[int, int]:
    """Return the conflicting moves of both vehicles."""
    step = conflict.step
    first, second = (
        node.paths[v][step] if step < len(node.paths[v]) else node.diagrams[v].target
        for v in (conflict.first, conflict.second)
    )
    return first, second
