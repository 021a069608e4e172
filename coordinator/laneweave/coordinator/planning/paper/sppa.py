"""SPPA, the single-vehicle path planning algorithm of the paper.

The paper uses A* in space and time. All paths of least cost are already in the vehicle's diagram
(see `diagram`); what is left is to choose one: the fewest conflicts with the paths of the other
vehicles, then the fewest moves, then the lowest index.
"""

from __future__ import annotations

from collections.abc import Sequence

from laneweave.coordinator.planning.moves import MoveTable
from laneweave.coordinator.planning.paper.path_diagram import Diagram

Path = tuple[int, ...]
"""The moves of one vehicle until its final arrival."""


def conflicting_moves(
    table: MoveTable, others: Sequence[tuple[Path, int]], steps: int
) -> list[int]:
    """Return, per step, the moves that conflict with a move of another vehicle.

    Each other vehicle is given as its path and its target, where it waits after arrival.
    """
    conflicts = table.conflicts
    taken = [0] * steps
    for path, target in others:
        arrived = len(path)
        for step in range(steps):
            taken[step] |= conflicts[path[step] if step < arrived else target]
    return taken


def choose_path(table: MoveTable, diagram: Diagram, taken: Sequence[int]) -> Path:
    """Return the best path of a diagram, given the moves that conflict with other vehicles."""
    fan, shifts = table.fan, table.shifts
    conflict_weight = diagram.cost + 1
    worth = {diagram.target: 0}
    choices: list[dict[int, int]] = []
    for step in range(diagram.cost - 1, -1, -1):
        layer, bad = diagram.layers[step], taken[step]
        earlier: dict[int, int] = {}
        choice: dict[int, int] = {}
        while layer:
            low = layer & -layer
            layer ^= low
            bit = low.bit_length() - 1
            d = bit % fan
            cell = bit - d
            value = worth[cell + shifts[d]]
            if d:
                value += 1
            if bad & low:
                value += conflict_weight
            if cell not in earlier or value < earlier[cell]:
                earlier[cell] = value
                choice[cell] = bit
        worth = earlier
        choices.append(choice)
    path: list[int] = []
    if choices:
        (cell,) = worth
        for choice in reversed(choices):
            path.append(choice[cell])
            cell = table.landing(choice[cell])
    return tuple(path)
