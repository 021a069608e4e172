"""Lane sorting of one formation, or of joined ones: from promises to moves.

The grid consists of the blocks of the formations, in the lanes that are open. Vehicles without an
agent block their cells. Vehicles take any cells of their goal lanes; those that cannot change
columns take cells in their own columns. With `formation.targets = "parallel"` they form the
parallel structure instead, if every vehicle has one goal lane, all can change columns, and no lane
ends. If complete sorting is infeasible, one vehicle is exempted from reaching its lane, so that a
single blocked vehicle does not prevent all others from sorting; the vehicles are tried one by one.
Before sorting, a formation may form other structures, in which every vehicle may take any place.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from functools import partial
from itertools import islice, product

from attrs import evolve, field, frozen

from laneweave.coordinator.formations.roster import Numbers
from laneweave.coordinator.formations.stages import Stage
from laneweave.coordinator.planning.budget import Clock
from laneweave.coordinator.planning.formation_structures import is_formed, shortage
from laneweave.coordinator.planning.grid import Grid
from laneweave.coordinator.planning.request import MAX_STEPS, PlanRequest, VehicleRequest
from laneweave.coordinator.planning.response import PlanFunction, PlanResponse
from laneweave.coordinator.planning.targets import (
    choose_lanes,
    placements,
    reachable_lanes,
)
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.lattice import Cell, PlannedMove
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.formation_table import DrivingStructure
from laneweave.protocol.wire.messages import Name
from laneweave.protocol.wire.reasons import BLOCKED, CLOSED_LANE, NO_AGENT, NO_ROOM, TOO_LATE

MAX_PLACEMENTS = 6
"""Maximum number of placements of the parallel structure that are tried until a plan has few enough
steps."""
MAX_SHORTER_PLANS = 4
"""Maximum number of further requests if the cheapest plan into lanes has too many steps. The first
one limits the plan to the steps that fit, each later one permits one step more."""
NODES_SHARE = 0.25
"""Share of the node limit for each of these requests."""
MIN_DEADLINE_S = 0.05
"""Minimum deadline for one attempt."""


@frozen
class SortingTask:
    """Input of lane sorting."""

    numbers: Numbers
    """Blocks that may be used, ascending."""
    hold_cells: Mapping[Name, Cell]
    """Lattice cell of each member, in the order of the result."""
    goal_lanes: Mapping[Name, frozenset[int]]
    """Lanes in one of which each member should be at the end; not used with a structure."""
    unattended: Collection[Name]
    """Members without an agent, or too late for the stage; they only hold."""
    scenario: Scenario
    """Mode, conflict kinds, lattice."""
    deadline_s: float
    """Deadline for all attempts together [s]."""
    steps: int = MAX_STEPS
    """Number of steps that fit on the road; if a plan has more, a shorter one is requested."""
    deserted: Numbers = ()
    """Blocks of `numbers` in which only the members' hold cells may be used."""
    structure: DrivingStructure | None = None
    """Structure to form, with any vehicle in any place; None: sort by lanes."""
    stage: Stage | None = None
    """Stage of the road; its closed lanes are not used. None: all lanes are open."""
    moves: Mapping[Name, frozenset[Cell]] = field(factory=dict)
    """Moves (columns, lanes) that members of some types can drive; others drive all."""
    too_late: Collection[Name] = frozenset()
    """Those of `unattended` that have agents, but are too late for the stage."""

    @property
    def columns(self) -> range:
        """Columns from the rear of the last block to the front of the first one."""
        lattice = self.scenario.lattice
        return range(
            lattice.block_range(self.numbers[-1]).start, lattice.block_range(self.numbers[0]).stop
        )

    @property
    def movers(self) -> dict[Name, Cell]:
        """Grid cell of each member that can move."""
        first = self.columns.start
        return {
            name: (column - first, lane)
            for name, (column, lane) in self.hold_cells.items()
            if name not in self.unattended and lane in self.open_lanes
        }

    @property
    def open_lanes(self) -> frozenset[int]:
        """Lanes that plans may use; vehicles in other lanes hold."""
        every = frozenset(range(self.scenario.road.lanes))
        return every if self.stage is None else self.stage.lanes

    @property
    def column_bound(self) -> frozenset[Name]:
        """Members that do not change columns."""
        return frozenset(
            name for name, moves in self.moves.items() if not any(columns for columns, _ in moves)
        )

    @property
    def blocked(self) -> tuple[Cell, ...]:
        """Grid cells that paths must avoid.

        These are the cells of members that only hold, the cells between the blocks, the cells of
        deserted blocks, and those of closed lanes.
        """
        first, lattice = self.columns.start, self.scenario.lattice
        usable, open_lanes = {*self.numbers} - {*self.deserted}, self.open_lanes
        foreign = {
            (column, lane)
            for column in self.columns
            for lane in range(lattice.lanes)
            if lane not in open_lanes or lattice.block_of(column) not in usable
        } - {*self.hold_cells.values()}
        movers = self.movers
        held = {cell for name, cell in self.hold_cells.items() if name not in movers}
        cells = foreign | held
        return tuple(sorted((column - first, lane) for column, lane in cells))

    @property
    def free(self) -> tuple[Cell, ...]:
        """Grid cells that are not blocked."""
        blocked = {*self.blocked}
        cells = product(range(self.scenario.road.lanes), range(len(self.columns)))
        return tuple((column, lane) for lane, column in cells if (column, lane) not in blocked)

    @property
    def hindered(self) -> frozenset[Name]:
        """Members that cannot reach a goal lane, whatever the others do."""
        movers, bound = self.movers, self.column_bound
        goals = {name: self.goal_lanes[name] for name in movers}
        possible = reachable_lanes(movers, goals, bound.intersection(movers), self.free)
        return frozenset(name for name, lanes in possible.items() if not lanes <= goals[name])


@frozen
class OutOfReach:
    """Why a member does not reach its lane."""

    reason: str
    """`TOO_LATE`, `NO_AGENT`, `CLOSED_LANE`, `BLOCKED` or `NO_ROOM` (`wire.reasons`)."""
    blocked_by: tuple[Name, ...] = ()
    """Members that hold cells on its way, nearest first."""


@frozen
class Sorting:
    """Result of lane sorting."""

    response: PlanResponse | None
    """Response of the planner; None: no vehicle can move."""
    moves: dict[Name, tuple[PlannedMove, ...]]
    """Moves of each member on the lattice."""
    out_of_reach: tuple[Name, ...]
    """Members that do not reach their lanes."""
    short_of_room: bool
    """Whether a member that can move, and is not hindered, does not reach its lane, so more blocks
    could help."""
    impossible: str = ""
    """Why the structure has too few cells, in which case no member moves; empty: it has enough."""
    reasons: Mapping[Name, OutOfReach] = field(factory=dict)
    """Why each of `out_of_reach` does not reach its lane."""

    @property
    def solved(self) -> bool:
        """Whether there is a plan."""
        return self.response is None or bool(self.response.paths)


def plan_requests(task: SortingTask, exempt: Name | None = None) -> Iterator[PlanRequest]:
    """Yield plan requests: the first one, and those to try if its plan has too many steps.

    Further placements of the parallel structure are also tried if it has no plan.

    Args:
        task: a task with at least one vehicle that can move.
        exempt: a vehicle that need not reach its lane.
    """
    wanted = {
        name: frozenset({cell[1]}) if name == exempt else task.goal_lanes[name]
        for name, cell in task.movers.items()
    }
    lanes_end = task.stage is not None and bool(task.stage.ending_lanes)
    all_free = task.column_bound.isdisjoint(wanted)
    one_each = all(len(lanes) == 1 for lanes in wanted.values())
    parallel = task.scenario.formation.targets == "parallel"
    if parallel and not lanes_end and all_free and one_each:
        lane_of = {name: min(each) for name, each in wanted.items()}
        yield from islice(_into_parallel_structure(task, lane_of), MAX_PLACEMENTS)
    else:
        request = _into_lanes(task, wanted)
        yield request
        first = max(1, task.steps)
        for steps in range(first, first + MAX_SHORTER_PLANS):
            yield evolve(request, max_steps=steps)


def _into_parallel_structure(
    task: SortingTask, wanted: Mapping[Name, int]
) -> Iterator[PlanRequest]:
    """Yield one plan request for each placement of the parallel structure."""
    scenario = task.scenario
    for targets in placements(
        task.movers,
        wanted,
        len(task.columns),
        scenario.road.lanes,
        task.blocked,
        ahead=scenario.formation.closes_by_vehicles,
    ):
        index = {cell: number for number, cell in enumerate(targets.cells)}
        vehicles = [
            VehicleRequest(name, cell, eligible=(index[targets.off_lane[name]],))
            if name in targets.off_lane
            else VehicleRequest(name, cell, wanted[name])
            for name, cell in task.movers.items()
        ]
        yield _plan_request(task, vehicles, targets.cells)


def _into_lanes(task: SortingTask, wanted: Mapping[Name, frozenset[int]]) -> PlanRequest:
    """Return the request in which each vehicle may take any free cell of its goal lanes.

    Vehicles for which these have too few cells may take any cell of the lanes that go on; those
    that cannot change columns and reach no goal lane, any cell of their columns.
    """
    free = task.free
    through = task.open_lanes if task.stage is None else task.stage.through_lanes
    column_bound = task.column_bound.intersection(wanted)
    possible = reachable_lanes(task.movers, wanted, column_bound, free)
    chosen = choose_lanes(task.movers, possible, through, free, column_bound)
    targets = tuple(cell for cell in free if any(cell[1] in lanes for lanes in chosen.values()))
    vehicles = [
        VehicleRequest(
            name,
            cell,
            eligible=tuple(
                number
                for number, (column, lane) in enumerate(targets)
                if lane in chosen[name] and (name not in column_bound or column == cell[0])
            ),
        )
        for name, cell in task.movers.items()
    ]
    return _plan_request(task, vehicles, targets)


def _plan_request(
    task: SortingTask,
    vehicles: Iterable[VehicleRequest],
    targets: tuple[Cell, ...] = (),
    structure: DrivingStructure | None = None,
) -> PlanRequest:
    formation = task.scenario.formation
    vehicles = [
        evolve(one, moves=tuple(sorted(moves)))
        if (moves := task.moves.get(Name(one.id))) is not None
        else one
        for one in vehicles
    ]
    return PlanRequest(
        Grid(len(task.columns), task.scenario.road.lanes, task.blocked),
        1 if formation.mode == 1 else 2,
        formation.conflict_kinds,
        tuple(vehicles),
        targets,
        task.deadline_s,
        solver=formation.solver,
        structure=structure.structure if structure else None,
        lanes=(structure.lanes or None) if structure else None,
    )


def sort_lanes(
    task: SortingTask,
    max_nodes: int,
    plan: PlanFunction,
    clock: Clock,
) -> Sorting:
    """Plan lane sorting; if it is infeasible, exempt one member from reaching its lane.

    Args:
        task: the sorting task.
        max_nodes: maximum number of search nodes per attempt.
        plan: answers a request.
        clock: returns the time for the deadline [s]; the plan reads it, too.
    """
    if not task.movers:
        return _sorting(task, None)
    memory_mb = task.scenario.service.worker_memory_mb
    make_plan = partial(plan, max_memory_mb=memory_mb, clock=clock)
    if task.structure is not None:
        return _form(task, task.structure, partial(make_plan, max_nodes=max_nodes))
    ends_s = clock() + task.deadline_s
    for exempt in (None, *task.movers):
        best: PlanResponse | None = None
        for request in plan_requests(task, exempt):
            left_s, limit = ends_s - clock(), request.max_steps
            if best is not None and (
                left_s <= MIN_DEADLINE_S
                or (limit is not None and (not best.paths or _steps(best) <= limit))
            ):
                break
            nodes = max_nodes if limit is None else math.ceil(NODES_SHARE * max_nodes)
            asked = evolve(request, deadline_s=max(left_s, MIN_DEADLINE_S))
            response = make_plan(asked, max_nodes=nodes)
            timed_out = limit is None and response.status == "timeout"
            if best is None or _steps(response) < _steps(best) or (timed_out and not best.paths):
                best = response
            if timed_out or _steps(best) <= task.steps:
                break
        if best is not None and best.status != "infeasible":
            break
    return _sorting(task, best)


def _steps(response: PlanResponse) -> float:
    """Return the number of steps of a plan, or infinity if there is no plan."""
    return math.inf if response.steps is None else response.steps


def _form(
    task: SortingTask, structure: DrivingStructure, make_plan: Callable[[PlanRequest], PlanResponse]
) -> Sorting:
    """Plan the paths into a structure; if it has too few cells, all members hold."""
    members = [VehicleRequest(name, cell) for name, cell in task.movers.items()]
    try:
        request = _plan_request(task, members, structure=structure)
    except BadInputError as error:
        if error.field != "structure":
            raise
        return evolve(_sorting(task, None), impossible=error.allowed)
    return _sorting(task, make_plan(request))


def has_formed(task: SortingTask) -> bool:
    """Return whether the members that can move form the structure, or have too little room."""
    if task.structure is None:
        return True
    movers = [*task.movers.values()]
    grid = Grid(len(task.columns), task.scenario.road.lanes, task.blocked)
    lanes = task.structure.lanes or range(grid.lanes)
    form, unnamed = task.structure.structure, [None] * len(movers)
    return bool(shortage(form, lanes, grid, unnamed)) or is_formed(form, lanes, grid, movers)


def _sorting(task: SortingTask, response: PlanResponse | None) -> Sorting:
    first = task.columns.start
    moves: dict[Name, tuple[PlannedMove, ...]] = dict.fromkeys(task.hold_cells, ())
    ends = dict(task.hold_cells)
    paths = response.paths if response is not None else ()
    for name, path in zip(task.movers, paths, strict=False):
        cells = [(column + first, lane) for column, lane in path]
        moves[name] = tuple(
            (step, cells[step], cells[step + 1])
            for step in range(len(cells) - 1)
            if cells[step] != cells[step + 1]
        )
        ends[name] = cells[-1]
    missed: tuple[Name, ...] = ()
    if task.structure is None:
        missed = tuple(name for name, cell in ends.items() if cell[1] not in task.goal_lanes[name])
    # After a timeout it is unknown whether there is room, and planning more blocks takes longer.
    known = response is not None and response.status != "timeout"
    short = {*missed}.difference(task.unattended)
    short_of_room = known and bool(short) and not task.hindered.issuperset(short)
    return Sorting(response, moves, missed, short_of_room, reasons=_out_of_reach(task, missed))


def _out_of_reach(task: SortingTask, missed: Iterable[Name]) -> dict[Name, OutOfReach]:
    """Return why each of the given members does not reach a goal lane."""
    return {name: _reason(task, name) for name in missed}


def _reason(task: SortingTask, name: Name) -> OutOfReach:
    if name in task.too_late:
        return OutOfReach(TOO_LATE)
    if name in task.unattended:
        return OutOfReach(NO_AGENT)
    if name not in task.movers:
        return OutOfReach(CLOSED_LANE)
    holders = _holders(task, name)
    if holders and not _overfull(task, name):
        return OutOfReach(BLOCKED, holders)
    return OutOfReach(NO_ROOM)


def _holders(task: SortingTask, name: Name) -> tuple[Name, ...]:
    """Return the members that only hold, in a lane between a member's cell and its goal lanes."""
    column, lane = task.hold_cells[name]
    goal = min(task.goal_lanes[name], key=lambda one: abs(one - lane), default=lane)
    lanes = range(min(lane, goal), max(lane, goal) + 1)
    movers, bound = task.movers, name in task.column_bound
    holders = [
        other
        for other, cell in task.hold_cells.items()
        if other not in movers and cell[1] in lanes and (cell[0] == column or not bound)
    ]
    return tuple(sorted(holders, key=lambda other: abs(task.hold_cells[other][0] - column)))


def _overfull(task: SortingTask, name: Name) -> bool:
    """Return whether more members want a member's goal lanes than these have cells in all."""
    goals, lattice = task.goal_lanes[name], task.scenario.lattice
    wanting = sum(lanes <= goals for lanes in task.goal_lanes.values())
    usable = {*task.numbers} - {*task.deserted}
    columns = sum(lattice.block_of(column) in usable for column in task.columns)
    return wanting > columns * len(goals & task.open_lanes)
