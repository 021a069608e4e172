"""One planning problem as the search sees it, with everything that assignments have in common."""

from __future__ import annotations

from collections.abc import Sequence

from laneweave.coordinator.planning.conflicts import ConflictModel
from laneweave.coordinator.planning.diagram import Bans, Diagram, compatible, shortest_paths
from laneweave.coordinator.planning.grid import Cell, Grid, Mode
from laneweave.coordinator.planning.moves import MoveTable

_REMEMBERED_PAIRS = 50_000


class Problem:
    """Vehicles and targets on a grid, and results that many conflict trees ask for again.

    The unconstrained paths of a vehicle to a target, and whether two diagrams are compatible, do
    not depend on the rest of the assignment.
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
        self._compatible: dict[tuple[int, int], tuple[bool, Diagram, Diagram]] = {}

    def free_paths(self, vehicle: int, target: int) -> Diagram | None:
        """Return the shortest paths of a vehicle to a target (an index) without constraints."""
        key = vehicle, target
        if key not in self._free:
            self._free[key] = shortest_paths(
                self.table, self.starts[vehicle], self.targets[target], Bans()
            )
        return self._free[key]

    def compatible(self, a: Diagram, b: Diagram) -> bool:
        """Tell whether two vehicles can both have a shortest path; remembers the answer."""
        key = id(a), id(b)
        known = self._compatible.get(key)
        if known is None:
            if len(self._compatible) >= _REMEMBERED_PAIRS:
                self._compatible.clear()
            known = compatible(self.table, a, b), a, b
            self._compatible[key] = known
        return known[0]
