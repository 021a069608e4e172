"""Why a plan leaves members of a formation off their goal lanes: reasons for the log.

The reasons follow from the sorting task. The planner itself only says that there is no plan in
which every member reaches its lane.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from attrs import frozen

from laneweave.protocol.wire.messages import Name
from laneweave.protocol.wire.reasons import BLOCKED, CLOSED_LANE, NO_AGENT, NO_ROOM, TOO_LATE

if TYPE_CHECKING:
    from laneweave.coordinator.formations.sorting import SortingTask


@frozen
class OutOfReach:
    """Why a member does not reach its lane."""

    reason: str
    """`TOO_LATE`, `NO_AGENT`, `CLOSED_LANE`, `BLOCKED` or `NO_ROOM` (`wire.reasons`)."""
    blocked_by: tuple[Name, ...] = ()
    """Members that hold cells on its way, nearest first."""


def reasons_of(task: SortingTask, missed: Iterable[Name]) -> dict[Name, OutOfReach]:
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
    goal = min(task.goal_lanes[name], key=lambda one: abs(one - lane))
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
