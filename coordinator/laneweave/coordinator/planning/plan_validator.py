"""Check a plan against its request, independently of the search.

Only the definitions of a conflict and of the cost are shared with the planner. `solve.plan` checks
every plan.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations

from laneweave.coordinator.planning.request import PlanRequest, VehicleRequest
from laneweave.coordinator.planning.response import PlanResponse
from laneweave.protocol.lattice import Cell


def problems_of_response(request: PlanRequest, response: PlanResponse) -> list[str]:
    """Return the errors in a response; a valid response has none."""
    if request.structure is not None:
        problems = list(_problems_of_targets(request, response.targets or ()))
        if problems:
            return problems
        request = request.with_targets(response.targets or ())
    if response.status in ("infeasible", "timeout"):
        empty = not response.paths and not response.assignment and response.cost is None
        return [] if empty else [f"a plan although the status is {response.status}"]
    problems = problems_of_paths(request, response.assignment, response.paths)
    if problems:
        return problems
    cost = response.path_map(request.ids).cost()
    if response.cost != cost:
        problems.append(f"cost {response.cost}, but the paths cost {cost}")
    if response.steps != len(response.paths[0]) - 1:
        problems.append(f"steps {response.steps}, but paths of {len(response.paths[0])} cells")
    if response.lower_bound is None or response.lower_bound > cost:
        problems.append(f"lower bound {response.lower_bound} above the cost {cost}")
    if response.status == "optimal" and response.lower_bound != cost:
        problems.append(f"optimal, but lower bound {response.lower_bound} is not the cost {cost}")
    return problems


def problems_of_paths(
    request: PlanRequest, assignment: Sequence[int], paths: Sequence[Sequence[Cell]]
) -> list[str]:
    """Return the errors in a path set; a valid path set has none."""
    problems = list(_problems_of_shape(request, assignment, paths))
    if problems:
        return problems
    steps = len(paths[0]) - 1
    if request.max_steps is not None and steps > request.max_steps:
        problems.append(f"{steps} steps, but at most {request.max_steps} are permitted")
    for i, vehicle in enumerate(request.vehicles):
        problems += _problems_of_vehicle(request, vehicle, assignment[i], paths[i])
    for i, j in combinations(range(len(assignment)), 2):
        if assignment[i] == assignment[j]:
            ids = f"{request.vehicles[i].id} and {request.vehicles[j].id}"
            problems.append(f"{ids} are both assigned to target {assignment[i]}")
    return problems + list(_conflicts(request, paths))


def _problems_of_targets(request: PlanRequest, targets: Sequence[Cell]) -> Iterator[str]:
    """Yield the errors in the targets of a requested structure."""
    if len(targets) != len(request.vehicles) or len(set(targets)) != len(targets):
        yield f"{len(set(targets))} targets for {len(request.vehicles)} vehicles"
    for cell in targets:
        if not request.grid.is_free(cell):
            yield f"target {cell} is blocked or outside the grid"
        if cell[1] not in request.structure_lanes:
            yield f"target {cell} is not in a lane of the structure"
    if request.structure == "interlaced" and len({sum(cell) % 2 for cell in targets}) > 1:
        yield "targets of an interlaced structure have even and odd column + lane"


def _problems_of_shape(
    request: PlanRequest, assignment: Sequence[int], paths: Sequence[Sequence[Cell]]
) -> Iterator[str]:
    count = len(request.vehicles)
    if len(assignment) != count or len(paths) != count:
        yield f"{count} vehicles, but {len(assignment)} targets and {len(paths)} paths"
    elif len({len(path) for path in paths}) != 1 or not paths[0]:
        yield f"paths of different lengths: {sorted({len(path) for path in paths})}"


def _problems_of_vehicle(
    request: PlanRequest, vehicle: VehicleRequest, target: int, path: Sequence[Cell]
) -> Iterator[str]:
    name, grid = vehicle.id, request.grid
    if tuple(path[0]) != vehicle.cell:
        yield f"{name} starts at {path[0]} instead of {vehicle.cell}"
    for cell in path:
        if not grid.is_free(cell):
            yield f"{name} is in {cell}, which is blocked or outside the grid"
    for step in range(len(path) - 1):
        columns = abs(path[step][0] - path[step + 1][0])
        lanes = abs(path[step][1] - path[step + 1][1])
        if (columns + lanes if request.mode == 1 else max(columns, lanes)) > 1:
            yield f"{name} jumps from {path[step]} to {path[step + 1]} in step {step + 1}"
        elif vehicle.moves is not None and columns + lanes > 0:
            move = path[step + 1][0] - path[step][0], path[step + 1][1] - path[step][1]
            if move not in vehicle.moves:
                yield f"{name} cannot drive {path[step]} to {path[step + 1]} in step {step + 1}"
    if not 0 <= target < len(request.targets):
        yield f"{name} is assigned to target {target}, which does not exist"
        return
    cell = request.targets[target]
    if tuple(path[-1]) != cell:
        yield f"{name} ends at {path[-1]} instead of {cell}"
    if vehicle.lane is not None and cell[1] != vehicle.lane:
        yield f"{name} prefers lane {vehicle.lane} but is assigned to {cell}"
    if vehicle.eligible is not None and target not in vehicle.eligible:
        yield f"{name} is assigned to target {target}, which is not eligible"


def _conflicts(request: PlanRequest, paths: Sequence[Sequence[Cell]]) -> Iterator[str]:
    model = request.conflict_model
    columns, lanes = model.reach
    for (i, a), (j, b) in combinations(enumerate(paths), 2):
        for step in range(len(a) - 1):
            # Most pairs are too far apart for any conflict.
            if abs(a[step][0] - b[step][0]) > columns or abs(a[step][1] - b[step][1]) > lanes:
                continue
            kind = model.kind((a[step], a[step + 1]), (b[step], b[step + 1]))
            if kind is not None:
                ids = f"{request.vehicles[i].id} and {request.vehicles[j].id}"
                yield f"{kind} conflict of {ids} in step {step + 1}"
