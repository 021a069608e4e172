"""Check the plan of a stream, independently of the search.

Only the definitions of conflicts and of sections are shared with the planner. Every plan is checked
before it is issued; a check takes about 1 ms for 130 vehicles.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from functools import lru_cache

from laneweave.coordinator.planning.conflict_kinds import ConflictModel
from laneweave.coordinator.planning.rolling.problem import (
    ROUNDING_M,
    CellPath,
    StreamPlan,
    StreamRoad,
    StreamVehicle,
)
from laneweave.protocol.lattice import Cell, Mode, displacements


def problems_of_plan(
    road: StreamRoad,
    plan: StreamPlan,
    vehicles: Sequence[StreamVehicle],
    blocked: Collection[Cell] = (),
) -> list[str]:
    """Return the errors in a plan for these vehicles; a valid plan has none."""
    names = {vehicle.vehicle for vehicle in vehicles}
    if plan.paths.keys() != names:
        return [f"paths of {sorted(plan.paths)} for vehicles {sorted(names)}"]
    blocked_cells = frozenset(blocked)
    problems: list[str] = []
    for vehicle in vehicles:
        problems += problems_of_path(
            road, plan.slot, vehicle, plan.paths[vehicle.vehicle], blocked_cells
        )
    missed = {
        v.vehicle
        for v in vehicles
        if plan.paths[v.vehicle]
        and road.last_section(plan.slot, plan.paths[v.vehicle]) not in v.targets
    }
    if set(plan.missed) != missed:
        problems.append(
            f"reports {sorted(plan.missed)} off their targets instead of {sorted(missed)}"
        )
    return problems or list(_conflicts(road, plan))


def problems_of_path(
    road: StreamRoad, slot: int, vehicle: StreamVehicle, path: CellPath, blocked: frozenset[Cell]
) -> Iterator[str]:
    """Yield the errors in a path from a slot on, without regard to other vehicles."""
    name = vehicle.vehicle
    if not path or path[0] != vehicle.cell:
        yield f"{name} starts at {path[:1]} instead of {vehicle.cell}"
        return
    here = path[0]
    for s, there in enumerate(path[1:], start=slot):
        if there != here:
            yield from _problems_of_move(road, s, vehicle, here, there, blocked)
            if not vehicle.drives(there[0] - here[0], there[1] - here[1]):
                yield f"{name} cannot drive from {here} to {there} in slot {s}"
            if vehicle.held:
                yield f"{name} is held, but moves in slot {s}"
            if s < slot + vehicle.waits:
                yield f"{name} moves in slot {s}, before {slot + vehicle.waits}"
            here = there
    if not road.has_left(slot + len(path) - 1, path[-1]):
        yield f"the path of {name} ends in {path[-1]}, on the road"
    # All slots of the path must begin on the road.
    for s, cell in enumerate(path[:-1], start=slot):
        if road.position_m(s, cell[0]) > road.first_end_m and road.has_left(s, cell):
            yield f"the path of {name} continues from {cell} in slot {s}, off the road"
            return


def _problems_of_move(
    road: StreamRoad,
    slot: int,
    vehicle: StreamVehicle,
    here: Cell,
    there: Cell,
    blocked: frozenset[Cell],
) -> Iterator[str]:
    name = vehicle.vehicle
    columns, lanes = abs(there[0] - here[0]), abs(there[1] - here[1])
    lanes_of = {here[1], there[1]} & {*range(road.lanes)}
    if (columns + lanes if road.mode == 1 else max(columns, lanes)) != 1:
        yield f"{name} jumps from {here} to {there} in slot {slot}"
    if not 0 <= there[1] < road.lanes:
        yield f"{name} leaves the road to {there} in slot {slot}"
    entered = {there, (here[0], there[1]), (there[0], here[1])} - {here}
    if not blocked.isdisjoint(entered):
        yield f"{name} enters {sorted(blocked & entered)} (blocked) in slot {slot}"
    later_m = road.start_m(road.position_m(slot, here[0]), lanes_of) - road.position_m(
        slot, here[0]
    )
    rear_m = road.position_m(slot, min(here[0], there[0])) - road.body_m + later_m
    front_m = road.position_m(slot + 1, max(here[0], there[0])) + later_m
    start_m, end_m = road.sorting_m
    if rear_m < start_m - ROUNDING_M or front_m > end_m + ROUNDING_M:
        yield f"{name} moves between {rear_m} m and {front_m} m in slot {slot}"
        return
    for lane in lanes_of:
        # A section must be open for the whole body and the whole slot.
        if not road.is_open(lane, rear_m, front_m):
            yield f"{name} moves between {rear_m} m and {front_m} m, where lane {lane} is closed"
    change = here[1], there[1]
    if road.forbids(vehicle.vehicle_type, change, slot, rear_m, front_m):
        yield (
            f"{name} changes from lane {change[0]} to {change[1]} between {rear_m} m and "
            f"{front_m} m, where a {vehicle.vehicle_type} may not"
        )


def _conflicts(road: StreamRoad, plan: StreamPlan) -> Iterator[str]:
    """Yield the conflicts of each move with the moves of nearby vehicles in the same slot."""
    near = {
        step: conflicting_displacements(road.mode, road.model, step)
        for step in displacements(road.mode)
    }
    for s in range(max((len(path) for path in plan.paths.values()), default=1) - 1):
        moves: dict[Cell, tuple[Cell, str]] = {}
        moving: list[Cell] = []
        for name, path in plan.paths.items():
            if s + 1 < len(path):
                here, there = path[s], path[s + 1]
                if here in moves:
                    yield f"{name} and {moves[here][1]} are both in {here} in slot {plan.slot + s}"
                moves[here] = (there[0] - here[0], there[1] - here[1]), name
                if here != there:
                    moving.append(here)
        for here in moving:
            step, name = moves[here]
            for (column, lane), conflicting in near[step].items():
                other = moves.get((here[0] + column, here[1] + lane))
                if other is not None and other[0] in conflicting:
                    kind = conflicting[other[0]]
                    yield f"{kind} conflict of {name} and {other[1]} in slot {plan.slot + s}"


@lru_cache(maxsize=256)
def conflicting_displacements(
    mode: Mode, model: ConflictModel, step: Cell
) -> dict[Cell, dict[Cell, str]]:
    """Return the conflicting displacements and conflict kinds, by offset of the other vehicle."""
    columns, lanes = model.reach
    found: dict[Cell, dict[Cell, str]] = {}
    for column in range(-columns, columns + 1):
        for lane in range(-lanes, lanes + 1):
            for other in displacements(mode):
                b = (column, lane), (column + other[0], lane + other[1])
                kind = model.kind(((0, 0), step), b)
                if kind is not None and (column, lane) != (0, 0):
                    found.setdefault((column, lane), {})[other] = kind
    return found
