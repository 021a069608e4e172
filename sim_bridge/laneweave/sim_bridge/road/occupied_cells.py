"""The cells that the vehicles on a road occupy."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping

from laneweave.protocol.lattice import Cell
from laneweave.protocol.wire.messages import Name
from laneweave.sim_bridge.road.vehicle import RoadVehicle

REACH_COLUMNS = 2
"""Distance from its cell beyond which a vehicle occupies none."""
GAP = "gap"
"""The occupant of cells that are kept free for a vehicle that waits at the end of its lane."""


class OccupiedCells:
    """An `Occupancy`: finds the vehicles that are in cells, or are moving into them or out of them.

    Plans never lead through such cells (docs/SAFETY.md).
    """

    def __init__(
        self, vehicles: Mapping[Name, RoadVehicle], is_kept_free: Callable[[Cell], bool]
    ) -> None:
        """Create the lookup.

        Args:
            vehicles: the vehicles on the road, which the owner of the mapping adds and removes.
            is_kept_free: returns whether a cell belongs to a gap for re-entry.
        """
        self._vehicles = vehicles
        self._is_kept_free = is_kept_free

    def occupant(self, cells: Collection[Cell], vehicle: object) -> str | None:
        """Return what occupies any of the cells, other than the vehicle with this controller."""
        column, _ = next(iter(cells))
        for name, one in self._vehicles.items():
            controller = one.controller
            if controller is vehicle or abs(controller.hold_cell[0] - column) > REACH_COLUMNS:
                continue
            if not controller.occupied.isdisjoint(cells):
                return name
        return GAP if any(map(self._is_kept_free, cells)) else None
