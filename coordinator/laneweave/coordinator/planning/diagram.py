"""All shortest paths of one vehicle under its constraints, step by step.

Space-time A* with an exact heuristic visits the states on shortest paths. Here they are found for
all cells of a step at once, as sets of moves (see `moves`): forwards from the start until the
target can be kept for good, then backwards to drop the moves that do not lead there. The result,
known in the literature as a multi-valued decision diagram, also says which conflicts cannot be
avoided without a longer path: those that meet every move of a step.
"""

from __future__ import annotations

import attrs

from laneweave.coordinator.planning.moves import MoveTable


@attrs.frozen
class Bans:
    """The moves a vehicle must not make; steps count from 0.

    at: sets of moves for single steps.
    since: sets of moves that are banned in a step and all later ones.
    earliest, latest: the least and the largest number of steps until the final arrival.
    """

    at: dict[int, int] = attrs.field(factory=dict)
    since: dict[int, int] = attrs.field(factory=dict)
    earliest: int = 0
    latest: int | None = None


@attrs.frozen(eq=False)
class Diagram:
    """Every path of least cost from a start to a target, for one vehicle.

    layers: per step, the moves that lie on at least one such path; there are `cost` steps.
    target: the bit of the target cell, and so of waiting there ever after.
    """

    layers: tuple[int, ...]
    target: int

    @property
    def cost(self) -> int:
        """Return the number of steps until the final arrival."""
        return len(self.layers)

    def layer(self, step: int) -> int:
        """Return the possible moves of a step, which after arrival is waiting at the target."""
        return self.layers[step] if step < len(self.layers) else 1 << self.target


def shortest_paths(table: MoveTable, start: int, target: int, bans: Bans) -> Diagram | None:
    """Return all paths of least cost that respect the bans, or None if there is no path at all."""
    last_ban = max(*bans.at, *bans.since, bans.earliest, -1)
    limit = last_ban + table.cell_count + 2 if bans.latest is None else bans.latest
    arrival = bans.earliest
    for step, banned in bans.at.items():
        if banned >> target & 1:
            arrival = max(arrival, step + 1)
    for banned in bans.since.values():
        if banned >> target & 1:
            return None
    cells = arriving = 1 << start
    layers: list[int] = []
    lasting = 0
    while len(layers) < arrival or not arriving >> target & 1:
        step = len(layers)
        if not cells or step >= limit:
            return None
        lasting |= bans.since.get(step, 0)
        moves = table.starting_in(cells) & ~(bans.at.get(step, 0) | lasting)
        layers.append(moves)
        cells = table.ends(moves)
        # Who has waited at the target arrived earlier, unless waiting there was forbidden later.
        arriving = cells if not moves >> target & 1 else table.ends(moves & ~(1 << target))
    if layers:
        layers[-1] &= ~(1 << target)
    cells = 1 << target
    for step in range(len(layers) - 1, -1, -1):
        layers[step] &= table.leading_to(cells)
        cells = table.starts(layers[step])
    return Diagram(tuple(layers), target)


def compatible(table: MoveTable, a: Diagram, b: Diagram) -> bool:
    """Tell whether some shortest path of `a` and some shortest path of `b` do not conflict.

    Both diagrams are walked together: for each cell of the first vehicle, the set of cells in
    which the second may be at the same time.
    """
    conflicts = table.conflicts
    start = table.starts(a.layer(0))
    together = {start.bit_length() - 1: table.starts(b.layer(0))}
    for step in range(max(a.cost, b.cost)):
        first_layer, second_layer = a.layer(step), b.layer(step)
        moves_into: dict[int, int] = {}
        for cell, partners in together.items():
            options = table.starting_in(partners) & second_layer
            mine = first_layer >> cell & table.every
            d = 0
            while mine:
                if mine & 1:
                    possible = options & ~conflicts[cell + d]
                    if possible:
                        to = cell + table.shifts[d]
                        moves_into[to] = moves_into.get(to, 0) | possible
                mine >>= 1
                d += 1
        if not moves_into:
            return False
        together = {to: table.ends(moves) for to, moves in moves_into.items()}
    return True
