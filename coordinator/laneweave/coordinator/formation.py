"""Formation building out of the stream of arrivals, and the targets of a formation.

Vehicles enter in interlaced structure; those whose entry cells lie in the same block of columns
form a formation (paper, Section 5.2.1: interlaced for driving, parallel after lane sorting). A
formation is *closed* when its whole block has passed the start of the road: nobody can join it any
more, so its roster is known from the census.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from attrs import frozen
from scipy.optimize import linear_sum_assignment

from laneweave.coordinator.planning import PlanRequest
from laneweave.protocol.lattice import Cell
from laneweave.protocol.messages import Census, CensusEntry, Name
from laneweave.protocol.scenario import Scenario


@frozen
class Formation:
    """A closed formation and its members that are on the road, in order of their names."""

    number: int
    members: tuple[CensusEntry, ...]

    @property
    def roster(self) -> tuple[Name, ...]:
        """Names of the members."""
        return tuple(member.vehicle for member in self.members)


def closed_formations(census: Census, t_s: float, scenario: Scenario) -> dict[int, Formation]:
    """Return the formations that are complete and on the road at road time `t_s`.

    The census must be at least as new as the moment at which the block passed; an older one could
    lack a member, and its formation is left out.
    """
    lattice = scenario.lattice
    groups: dict[int, list[CensusEntry]] = {}
    for entry in census.on_road:
        groups.setdefault(lattice.block_of(entry.cell[0]), []).append(entry)
    known_s = min(t_s, census.t_s)
    return {
        number: Formation(number, tuple(sorted(members, key=lambda entry: entry.vehicle)))
        for number, members in sorted(groups.items())
        if lattice.passing_time_s(lattice.block_range(number)[0]) < known_s
    }


def start_time_s(number: int, not_before_s: float, scenario: Scenario) -> float:
    """Return the road time at which a formation may begin to change lanes, on a tick.

    That is when its rearmost body is in S3, and never before `not_before_s`.
    """
    lattice, road = scenario.lattice, scenario.road
    rear_column = lattice.block_range(number)[0]
    in_sorting_s = lattice.passing_time_s(
        rear_column, road.sorting_start_m + scenario.vehicle.length_m
    )
    tick_s = scenario.runtime.tick_s
    return math.ceil(max(in_sorting_s, not_before_s) / tick_s - 1e-6) * tick_s


def steps_left(number: int, t_s: float, scenario: Scenario) -> int:
    """Return how many whole steps fit in before the front column reaches the end of the road."""
    lattice = scenario.lattice
    end_s = lattice.passing_time_s(lattice.block_range(number)[-1], scenario.road.length_m)
    return max(0, math.floor((end_s - t_s) / scenario.formation.cycle_s + 1e-6))


def plan_request(
    number: int,
    hold_cells: Mapping[Name, Cell],
    preferred_lanes: Mapping[Name, int],
    scenario: Scenario,
) -> PlanRequest:
    """Return the request for a formation: from the hold cells to the parallel structure.

    Args:
        number: the formation; its block is the grid.
        hold_cells: lattice cell of each member, in the order of the answer.
        preferred_lanes: lane that each member needs.
        scenario: mode, conflict kinds, deadline.
    """
    columns = scenario.lattice.block_range(number)
    vehicles = [
        {"id": vehicle, "cell": [cell[0] - columns[0], cell[1]], "lane": preferred_lanes[vehicle]}
        for vehicle, cell in hold_cells.items()
    ]
    targets: list[Cell] = []
    for lane in range(scenario.road.lanes):
        targets += parallel_targets(
            lane,
            [
                (cell[0] - columns[0], cell[1])
                for vehicle, cell in hold_cells.items()
                if preferred_lanes[vehicle] == lane
            ],
            len(columns),
        )
    formation = scenario.formation
    return PlanRequest.from_dict(
        {
            "schema": "laneweave.plan.request/1",
            "grid": {"columns": len(columns), "lanes": scenario.road.lanes, "blocked": []},
            "mode": formation.mode,
            "conflicts": list(formation.conflict_kinds),
            "vehicles": vehicles,
            "targets": [list(target) for target in targets],
            "deadline_s": formation.planning_deadline_s,
        }
    )


def parallel_targets(lane: int, cells: Sequence[Cell], columns: int) -> list[Cell]:
    """Return neighbouring target cells on a lane for the vehicles that need it.

    As many as there are vehicles, without gaps (parallel structure), placed where the vehicles
    have the shortest way, so that lane sorting moves nobody ahead or back on average.

    Args:
        lane: the lane that all of them need.
        cells: where they are.
        columns: columns of the grid.
    """
    count = min(len(cells), columns)
    if count == 0:
        return []
    best: tuple[float, int] | None = None
    for first in range(columns - count + 1):
        ways = np.array(
            [
                [
                    abs(column - target) + abs(own_lane - lane)
                    for target in range(first, first + count)
                ]
                for column, own_lane in cells
            ]
        )
        rows, chosen = linear_sum_assignment(ways)
        # Equal ways: the place nearest to the middle of the block.
        off_middle = abs(first + (count - 1) / 2 - (columns - 1) / 2)
        rank = (float(ways[rows, chosen].sum()) + off_middle / (10 * columns), first)
        best = rank if best is None else min(best, rank)
    assert best is not None  # noqa: S101 (count >= 1 leaves at least one place)
    return [(column, lane) for column in range(best[1], best[1] + count)]
