"""Planner of the rolling operation that grants requested moves instead of searching for paths.

Every vehicle may request one move for the next slot; without a request it holds. A request is
granted if the road and the vehicle's type allow the move, and if it conflicts with no other
vehicle. Of two requests that conflict only with each other, that of the vehicle farther ahead is
granted; with equal columns, that in the lower lane. A refused vehicle holds. After the slot all
paths hold their cells, since no later requests are known.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

from laneweave.coordinator.planning.rolling.problem import (
    CellPath,
    OpenRoad,
    StreamPlan,
    StreamRoad,
    StreamVehicle,
)
from laneweave.coordinator.planning.rolling.rolling_validator import (
    conflicting_displacements,
    problems_of_path,
)
from laneweave.protocol.lattice import WAIT, Cell, displacements


class RequestPlanner:
    """Planner that grants requested moves; `plan` is a `Planner` of the rolling operation."""

    def __init__(self, road: StreamRoad) -> None:
        """Begin without requests."""
        self.road = road
        self.requests: Mapping[str, Cell] = {}
        """Requested displacement (columns, lanes) of each vehicle; others hold."""
        self.granted: Mapping[str, Cell] = {}
        """Requests that the newest plan grants."""

    def plan(
        self,
        slot: int,
        vehicles: Sequence[StreamVehicle],
        before: StreamPlan | None = None,
        blocked: Collection[Cell] = (),
        now: OpenRoad | None = None,
    ) -> StreamPlan:
        """Return paths with the granted moves in this slot; see `StreamPlanner.plan`."""
        del before
        road, closed = self.road.as_open(now), frozenset(blocked)
        moves = {vehicle.cell: WAIT for vehicle in vehicles}
        for vehicle in vehicles:
            wanted = self.requests.get(vehicle.vehicle, WAIT)
            if wanted != WAIT and is_possible(road, slot, vehicle, wanted, closed):
                moves[vehicle.cell] = wanted
        _refuse_conflicts(road, moves)
        paths = {
            vehicle.vehicle: _path(road, slot, vehicle.cell, moves[vehicle.cell])
            for vehicle in vehicles
        }
        self.granted = {
            vehicle.vehicle: moves[vehicle.cell]
            for vehicle in vehicles
            if moves[vehicle.cell] != WAIT
        }
        missed = tuple(
            vehicle.vehicle
            for vehicle in vehicles
            if road.last_section(slot, paths[vehicle.vehicle]) not in vehicle.targets
        )
        return StreamPlan(slot, paths, missed)


def is_possible(
    road: StreamRoad,
    slot: int,
    vehicle: StreamVehicle,
    move: Cell,
    blocked: frozenset[Cell] = frozenset(),
) -> bool:
    """Return whether a vehicle may make a move in a slot as far as only the road matters."""
    if move not in displacements(road.mode) or not 0 <= vehicle.cell[1] + move[1] < road.lanes:
        return False
    path = _path(road, slot, vehicle.cell, move)
    # Beyond the end of its lane a vehicle makes no moves.
    return len(path) > 1 and not any(problems_of_path(road, slot, vehicle, path, blocked))


def _path(road: StreamRoad, slot: int, cell: Cell, move: Cell) -> CellPath:
    """Return the path of a vehicle that makes a move in a slot and then holds."""
    path = [cell]
    if not road.has_left(slot, cell):
        cell = cell[0] + move[0], cell[1] + move[1]
        path.append(cell)
        while not road.has_left(slot + len(path) - 1, cell):
            path.append(cell)
    return tuple(path)


def _refuse_conflicts(road: StreamRoad, moves: dict[Cell, Cell]) -> None:
    """Replace conflicting moves by waiting.

    No remaining move conflicts with another vehicle, and each replaced one would.

    Args:
        road: defines conflicts.
        moves: displacement of each vehicle by its cell; changed in place.
    """
    near = {
        step: conflicting_displacements(road.mode, road.model, step)
        for step in displacements(road.mode)
    }
    wanted = moves.copy()

    def conflicts(cell: Cell, move: Cell) -> bool:
        return any(
            moves.get((cell[0] + column, cell[1] + lane)) in conflicting
            for (column, lane), conflicting in near[move].items()
        )

    # From the rear, so that the vehicle ahead keeps its move.
    from_rear = sorted(moves, key=lambda cell: (cell[0], -cell[1]))
    # A refused vehicle waits, which may conflict with moves that did not conflict with its own.
    refused = True
    while refused:
        refused = False
        for cell in from_rear:
            if moves[cell] != WAIT and conflicts(cell, moves[cell]):
                moves[cell] = WAIT
                refused = True
    # Grant again what was refused only because of moves that were refused later.
    for cell in reversed(from_rear):
        if wanted[cell] != moves[cell] and not conflicts(cell, wanted[cell]):
            moves[cell] = wanted[cell]
