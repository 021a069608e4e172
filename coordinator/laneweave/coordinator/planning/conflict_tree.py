"""The conflict tree as the paper draws it: one child per entry of a node's conflict list.

A conflict of two vehicles gives two entries, one per vehicle, written
{N | (x, y), step, id} or {E | (x1, y1), (x2, y2), step, id}; a constraint is written in the same
way and forbids that vehicle to arrive at the node, or to travel along the edge, in that step.
The planner itself uses `cbs`; this tree is for the case study and for teaching.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import attrs

from laneweave.coordinator.planning.conflicts import KINDS
from laneweave.coordinator.planning.diagram import Bans, shortest_paths
from laneweave.coordinator.planning.grid import Cell
from laneweave.coordinator.planning.path_map import FoundConflict, RelativePathMap
from laneweave.coordinator.planning.problem import Problem
from laneweave.coordinator.planning.sppa import Path, choose_path, conflicting_moves


@attrs.frozen
class Entry:
    """A conflict C^f or a constraint C^t of one vehicle; vehicles and steps count from 0.

    cells: the node, or the two ends of the edge.
    """

    cells: tuple[Cell, ...]
    step: int
    vehicle: int

    @property
    def is_node(self) -> bool:
        """Tell whether this is about a node rather than an edge."""
        return len(self.cells) == 1

    def __str__(self) -> str:
        """Return the paper's notation; vehicles and steps count from 1."""
        where = ", ".join(f"({c},{lane})" for c, lane in self.cells)
        return f"{{{'N' if self.is_node else 'E'} | {where}, {self.step + 1}, {self.vehicle + 1}}}"


@attrs.frozen
class PaperNode:
    """A node N_k with its constraints, conflicts, path set and cost."""

    constraints: tuple[Entry, ...]
    conflicts: tuple[Entry, ...]
    paths: tuple[Path, ...]
    path_map: RelativePathMap

    @property
    def cost(self) -> int:
        """Return the total cost of the path set."""
        return sum(len(path) for path in self.paths)


def root(problem: Problem, assignment: Sequence[int]) -> PaperNode | None:
    """Return N_1, or None if a target cannot be reached."""
    paths = [_path(problem, assignment, vehicle, (), ()) for vehicle in range(len(assignment))]
    complete = [path for path in paths if path is not None]
    return _node(problem, (), complete) if len(complete) == len(paths) else None


def expand_all(problem: Problem, assignment: Sequence[int], node: PaperNode) -> list[PaperNode]:
    """Return the children of a node, one per entry of its conflict list.

    Only the vehicle that is named by the new constraint is planned again; among its shortest
    paths it takes the one with the fewest conflicts with the paths of the others.
    """
    children = []
    for entry in node.conflicts:
        constraints = (*node.constraints, entry)
        path = _path(problem, assignment, entry.vehicle, constraints, node.paths)
        if path is not None:
            paths = [*node.paths]
            paths[entry.vehicle] = path
            children.append(_node(problem, constraints, paths))
    return children


def _path(
    problem: Problem,
    assignment: Sequence[int],
    vehicle: int,
    constraints: Sequence[Entry],
    paths: Sequence[Path],
) -> Path | None:
    """Apply SPPA to one vehicle."""
    table, target = problem.table, problem.targets[assignment[vehicle]]
    bans = _bans(problem, [c for c in constraints if c.vehicle == vehicle])
    diagram = shortest_paths(table, problem.starts[vehicle], target, bans)
    if diagram is None:
        return None
    others = [
        (path, problem.targets[assignment[i]]) for i, path in enumerate(paths) if i != vehicle
    ]
    return choose_path(table, diagram, conflicting_moves(table, others, diagram.cost))


def _node(problem: Problem, constraints: tuple[Entry, ...], paths: Sequence[Path]) -> PaperNode:
    """List the conflicts of a path set."""
    table = problem.table
    rows = [
        [table.cell(start), *(table.move(move)[1] for move in path)]
        for start, path in zip(problem.starts, paths, strict=True)
    ]
    path_map = RelativePathMap.padded([str(i + 1) for i in range(len(rows))], rows)
    found = sorted(path_map.conflicts(table.model), key=lambda c: (c.step, KINDS.index(c.kind), c))
    conflicts = tuple(entry for conflict in found for entry in _entries(path_map, conflict))
    return PaperNode(constraints, conflicts, tuple(paths), path_map)


def _entries(path_map: RelativePathMap, conflict: FoundConflict) -> Iterator[Entry]:
    for vehicle in (conflict.first, conflict.second):
        move = path_map.move(vehicle, conflict.step)
        yield Entry(move[1:] if conflict.kind == "node" else move, conflict.step, vehicle)


def _bans(problem: Problem, constraints: Sequence[Entry]) -> Bans:
    table = problem.table
    bans = Bans()
    for constraint in constraints:
        if constraint.is_node:
            banned = table.leading_to(1 << table.bit(constraint.cells[0]))
        else:
            banned = 1 << table.number((constraint.cells[0], constraint.cells[1]))
        bans.at[constraint.step] = bans.at.get(constraint.step, 0) | banned
    return bans
