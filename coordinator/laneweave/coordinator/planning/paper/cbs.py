"""CBSA, the conflict-based searching algorithm (paper, Algorithm 2), for one assignment.

A node N_i of the constraint tree T has the paper's four attributes: constraints, conflicts, path
set M_i and cost L_i. With all improvements off the tree is the paper's: one child for each entry of
a node's conflict list. `Improvements` change which constraints the children of a node get, and end
the search early (`limit`).

Among the shortest paths of a vehicle, SPPA chooses one with the fewest conflicts with the paths of
the other vehicles (`shortest_paths`); the paper leaves this choice open. At the root, paths are
planned independently.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Iterator, Sequence

import attrs

from laneweave.coordinator.planning.budget import Budget
from laneweave.coordinator.planning.paper.constraints import (
    CARDINAL,
    Conflict,
    Constraint,
    bans_for,
    cardinality,
    constraints_of,
    disjoint_constraints,
    is_at_node,
)
from laneweave.coordinator.planning.problem import Diagram, Path, Problem
from laneweave.coordinator.planning.shortest_paths import (
    choose_path,
    conflicting_moves,
    free_paths,
    paths_of,
)

Limit = Callable[[], float]
"""Function that returns the cost that a path set must stay below; called before each node."""


@attrs.frozen
class Improvements:
    """Additions to Algorithms 1 and 2; without any of them the algorithms are the paper's.

    The result stays exact with each addition. `benchmarks/planner_switches.py` measures their
    effects; docs/PLANNING.md has the figures.

    cutoff: CBSA ends for an assignment as soon as it cannot find a path set that costs less than
        C'* (`tappa`).
    cardinal: a node gets children for only one of its conflicts, the one that raises their costs
        most, instead of for all conflicts (`constraints`).
    bicliques: the constraints of a node's two children are sets of moves, and no path set
        satisfies both (`constraints`). Has an effect only with `cardinal`.
    joint: when a tree grows large, A* over the cells of all vehicles takes turns with it
        (`exact.joint_search`), unless its code is not compiled and must not be.
    """

    cutoff: bool = True
    cardinal: bool = True
    bicliques: bool = True
    joint: bool = True

    @classmethod
    def none(cls) -> Improvements:
        """Return no improvements: the algorithms as the paper prints them."""
        return cls(cutoff=False, cardinal=False, bicliques=False, joint=False)


@attrs.define(eq=False)
class Node:
    """A node N_i of the constraint tree.

    constraints: the constraints of this node and of all its ancestors.
    paths: the path set M_i.
    conflicts: the conflicts in the path set.
    diagrams: all shortest paths of each vehicle under the constraints; M_i is chosen from them.
    number: i, counted from 1 in order of creation.
    parent: number of the parent; 0: none.
    expanded: whether the node's children have been created.
    """

    constraints: tuple[Constraint, ...]
    paths: tuple[Path, ...]
    conflicts: tuple[Conflict, ...]
    diagrams: tuple[Diagram, ...]
    number: int = 1
    parent: int = 0
    expanded: bool = False

    @property
    def cost(self) -> int:
        """Return the cost L_i of the path set."""
        return sum(len(path) for path in self.paths)

    def moves(self, conflict: Conflict) -> tuple[int, int]:
        """Return the conflicting moves of both vehicles."""
        step = conflict.step
        first, second = (
            self.paths[v][step] if step < len(self.paths[v]) else self.diagrams[v].target
            for v in (conflict.first, conflict.second)
        )
        return first, second


class ConstraintTree:
    """The constraint tree T of one assignment.

    nodes: all nodes, if they are recorded.
    solution: the node with the optimal path set, if it was found.
    """

    def __init__(
        self,
        problem: Problem,
        assignment: Sequence[int],
        budget: Budget,
        improvements: Improvements,
        *,
        record: bool = False,
    ) -> None:
        """Prepare the search."""
        self.assignment = tuple(assignment)
        self.solution: Node | None = None
        self.nodes: list[Node] | None = [] if record else None
        self._problem = problem
        self._budget = budget
        self._improvements = improvements
        self._count = 0
        self._open: list[tuple[int, int, int, Node]] = []

    @property
    def lower_bound(self) -> float:
        """Return the lowest L_i in T, or infinity if T is empty."""
        return self._open[0][0] if self._open else math.inf

    def search(self, limit: Limit) -> Node | None:
        """Apply Algorithm 2; return the node with the optimal path set, or None.

        None: there is no path set, or none that costs less than the limit. Nodes at or above the
        limit are dropped, so the limit must not grow.

        Raises:
            BudgetSpentError: the deadline has passed or too many nodes were taken from T.
        """
        root = self._root()  # lines 1 to 4
        if root is not None:
            self._add(root)  # line 5
        while self._open:  # line 6
            bound = limit()
            if self.lower_bound >= bound:
                return None
            self._budget.take_node()
            node = heapq.heappop(self._open)[-1]  # lines 7 and 8: the minimum L_i
            if not node.conflicts:  # line 9
                self.solution = node  # lines 10 and 11
                return node
            node.expanded = True
            for added in self._constraints(node):  # lines 13, 15 and 16
                child = self._child(node, added)  # lines 14, 17 and 18
                if child is not None and child.cost < bound:
                    self._add(child)  # line 19, where the paper prints N_i for N_c
        return None

    def _add(self, node: Node) -> None:
        """Add a node to T; ties in L_i go to the node with the fewest conflicts."""
        self._count += 1
        node.number = self._count
        heapq.heappush(self._open, (node.cost, len(node.conflicts), node.number, node))
        if self.nodes is not None:
            self.nodes.append(node)

    def _root(self) -> Node | None:
        """Return N_1, or None if a target cannot be reached."""
        problem, table = self._problem, self._problem.table
        diagrams = []
        for vehicle, target in enumerate(self.assignment):
            self._budget.check_time()
            diagram = free_paths(problem, vehicle, target)
            if diagram is None:
                return None
            diagrams.append(diagram)
        paths = tuple(
            choose_path(table, diagram, [0] * diagram.cost, self._budget) for diagram in diagrams
        )
        conflicts: set[Conflict] = set()
        for vehicle in range(len(paths)):
            self._budget.check_time()
            conflicts.update(self._conflicts_of(vehicle, diagrams, paths))
        return Node((), paths, tuple(sorted(conflicts)), tuple(diagrams))

    def _constraints(self, node: Node) -> Iterator[Constraint]:
        """Yield the constraint that each child of a node adds."""
        table = self._problem.table
        if not self._improvements.cardinal:
            # A vehicle in conflict with two others at one node has one entry.
            yield from dict.fromkeys(
                constraint
                for conflict in node.conflicts
                for constraint in constraints_of(table, conflict, node.moves(conflict))
            )
            return
        conflict = self._most_cardinal(node)
        moves = node.moves(conflict)
        if self._improvements.bicliques:
            yield from disjoint_constraints(table, conflict, moves, node.diagrams)
        else:
            yield from constraints_of(table, conflict, moves)

    def _most_cardinal(self, node: Node) -> Conflict:
        """Return the conflict that raises the cost of the most children; ties go to the first."""
        table = self._problem.table
        best, highest = node.conflicts[0], -1
        for conflict in node.conflicts:
            found = cardinality(table, conflict, node.moves(conflict), node.diagrams)
            if found > highest:
                best, highest = conflict, found
            if highest == CARDINAL:
                break
        return best

    def _child(self, node: Node, added: Constraint) -> Node | None:
        """Return the child with one more constraint (SPPA), or None if a vehicle has no path."""
        problem, table = self._problem, self._problem.table
        constraints = (*node.constraints, added)
        diagrams, paths = list(node.diagrams), list(node.paths)
        rerouted = []
        for vehicle, diagram in enumerate(node.diagrams):
            if added.is_satisfied_by(vehicle, diagram):
                continue
            self._budget.check_time()
            bans = bans_for(vehicle, constraints)
            shortest = paths_of(problem, vehicle, diagram.target, bans)
            if shortest is None:
                return None
            diagrams[vehicle] = shortest
            if not _is_among(paths[vehicle], shortest):
                rerouted.append(vehicle)
        for vehicle in rerouted:
            others = [
                (path, other.target)
                for i, (path, other) in enumerate(zip(paths, diagrams, strict=True))
                if i != vehicle
            ]
            diagram = diagrams[vehicle]
            conflicting = conflicting_moves(table, others, diagram.cost)
            paths[vehicle] = choose_path(table, diagram, conflicting, self._budget)
        conflicts = set(node.conflicts)
        for vehicle in rerouted:
            conflicts = {c for c in conflicts if vehicle not in (c.first, c.second)}
            conflicts.update(self._conflicts_of(vehicle, diagrams, paths))
        listed = tuple(sorted(conflicts)) if rerouted else node.conflicts
        return Node(constraints, tuple(paths), listed, tuple(diagrams), parent=node.number)

    def _conflicts_of(
        self, vehicle: int, diagrams: Sequence[Diagram], paths: Sequence[Path]
    ) -> list[Conflict]:
        """Return the conflicts between one vehicle and all others."""
        table = self._problem.table
        conflicts = table.conflicts
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
                    found.append(Conflict(step, not is_at_node(table, mine, theirs), *pair))
        return found


def _is_among(path: Path, diagram: Diagram) -> bool:
    """Return whether a diagram contains a path."""
    return len(path) == diagram.cost and all(
        layer >> move & 1 for layer, move in zip(diagram.layers, path, strict=True)
    )
