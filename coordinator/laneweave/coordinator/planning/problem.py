"""One planning problem as the search sees it, with everything that assignments have in common."""

from __future__ import annotations

from collections.abc import Sequence

from laneweave.coordinator.planning.conflicts import ConflictModel
from laneweave.coordinator.planning.grid import Cell, Grid, Mode
from laneweave.coordinator.planning.moves import MoveTable
from laneweave.coordinator.planning.paper.path_diagram import Bans, Diagram, shortest_paths


class Problem:
    """Vehicles and targets on a grid.

    The unconstrained paths of a vehicle to a target do not depend on the rest of the assignment,
    so all constraint trees share them.
    """

    def __init__(
        self,
        grid: Grid,
        mode: Mode,
        model: ConflictModel,
        starts: Sequence[Cell],
        targets: Sequence[Cell],
    ) -> None:
        """Number the moves of the grid."""
        self.table = MoveTable(grid, mode, model)
        self.starts = tuple(self.table.bit(cell) for cell in starts)
        self.targets = tuple(self.table.bit(cell) for cell in targets)
        self._free: dict[tuple[int, int], Diagram | None] = {}

    def free_paths(self, vehicle: int, target: int) -> Diagram | None:
        """Return the shortest paths of a vehicle to a target (an index) without constraints."""
        key = vehicle, target
        if key not in self._free:
            self._free[key] = shortest_paths(
                self.table, self.starts[vehicle], self.targets[target], Bans()
            )
        return self._free[key]
