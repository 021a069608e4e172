"""Formation building out of the stream of arrivals.

Vehicles enter in interlaced structure; those whose entry cells lie in the same block of columns
form a formation (paper, Section 5.2.1: interlaced for driving, parallel after lane sorting). A
formation is *closed* when its whole block has passed the start of the road: nobody can join it any
more, so its roster is known from the census.
"""

from __future__ import annotations

import math

from attrs import frozen

from laneweave.coordinator.groups import Groups, Numbers
from laneweave.protocol.messages import Census, CensusEntry, Name
from laneweave.protocol.scenario import Scenario


@frozen
class Formation:
    """A closed formation, or joined ones, and the members on the road, in order of their names."""

    numbers: Numbers
    members: tuple[CensusEntry, ...]

    @property
    def roster(self) -> tuple[Name, ...]:
        """Names of the members."""
        return tuple(member.vehicle for member in self.members)


def closed_formations(
    census: Census, t_s: float, scenario: Scenario, groups: Groups
) -> dict[int, Formation]:
    """Return the formations that are complete and on the road at road time `t_s`.

    The census must be at least as new as the moment at which the block passed; an older one could
    lack a member, and its formation is left out, together with all that are joined with it.

    Returns:
        Each formation under its least number.
    """
    lattice = scenario.lattice
    known_s = min(t_s, census.t_s)
    members: dict[int, list[CensusEntry]] = {}
    for entry in census.on_road:
        first = groups.of(lattice.block_of(entry.cell[0]))[0]
        members.setdefault(first, []).append(entry)
    return {
        first: Formation(groups.of(first), tuple(sorted(each, key=lambda entry: entry.vehicle)))
        for first, each in sorted(members.items())
        if closing_time_s(groups.of(first), scenario) < known_s
    }


def closing_time_s(numbers: Numbers, scenario: Scenario) -> float:
    """Return the road time from which on nobody can enter the last block any more."""
    lattice = scenario.lattice
    passing_s = lattice.passing_time_s(lattice.block_range(numbers[-1])[0])
    return passing_s + scenario.formation.entry_spread_s


def start_time_s(numbers: Numbers, not_before_s: float, scenario: Scenario) -> float:
    """Return the road time at which formations may begin to change lanes, on a tick.

    That is when their rearmost body is in S3, and never before `not_before_s`.
    """
    lattice, road = scenario.lattice, scenario.road
    rear_column = lattice.block_range(numbers[-1])[0]
    in_sorting_s = lattice.passing_time_s(
        rear_column, road.sorting_start_m + scenario.vehicle.length_m
    )
    tick_s = scenario.runtime.tick_s
    return math.ceil(max(in_sorting_s, not_before_s) / tick_s - 1e-6) * tick_s


def steps_left(numbers: Numbers, t_s: float, scenario: Scenario) -> int:
    """Return how many whole steps fit in before the front column reaches the end of the road."""
    lattice = scenario.lattice
    end_s = lattice.passing_time_s(lattice.block_range(numbers[0])[-1], scenario.road.length_m)
    return max(0, math.floor((end_s - t_s) / scenario.formation.cycle_s + 1e-6))
