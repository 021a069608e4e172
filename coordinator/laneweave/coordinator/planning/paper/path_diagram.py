"""All shortest paths of one vehicle under its constraints, step by step.

Space-time A* with an exact heuristic visits the states on shortest paths. Here they are found for
all cells of a step at once, as sets of moves (see `moves`): forwards from the start until the
target can be kept for good, then backwards to drop the moves that do not lead there. The result is
known in the literature as a multi-valued decision diagram.
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
