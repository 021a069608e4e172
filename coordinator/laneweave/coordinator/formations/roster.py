"""Formations as the census describes them, and the time that they have on the road.

The roadside builds formations out of the stream of arrivals and says which blocks of columns belong
to which formation. A formation is *closed* when no vehicle can enter its blocks any more: its
roster is known for certain from that census on.

**Joined formations** plan under one ballot. Such a plan may use the blocks of all of them, and its
roster is all vehicles that entered there. Once a plan has used two blocks, a vehicle of either may
be in the other one, so no later plan may use one of them without the vehicles of both: joined
formations stay joined until their vehicles have left. Every vehicle remembers with which blocks its
formation is joined (`VehicleState.joined`), so any leader learns it from the promises that it needs
anyway.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Mapping
from itertools import pairwise

from attrs import define, field, frozen

from laneweave.protocol.lattice import Cell
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.wire.messages import Census, CensusEntry, Name

STAGE_LEAD_S = 5.0
"""How long before a change of structure its plan is made: longer than planning takes. The previous
plan has ended by then."""

Numbers = tuple[int, ...]
"""Numbers of blocks, ascending."""


@frozen
class Formation:
    """A closed formation, or joined ones, and the members on the road, in order of their names."""

    numbers: Numbers
    """Of their blocks, ascending."""
    members: tuple[CensusEntry, ...]
    closed_s: float = 0.0
    """Road time at which the last of them was closed."""
    joined: int = 1
    """How many formations these are."""
    deserted: Numbers = ()
    """Blocks of joined formations whose vehicles have all left the road. Plans avoid them: they may
    hold vehicles of formations that were joined under another leader."""
    stage: int = 0
    """Which of the scenario's structures it is to take on now."""
    sorts: bool = True
    """It has taken on all of them, and sorts its lanes."""

    @property
    def roster(self) -> tuple[Name, ...]:
        """Names of the members."""
        return tuple(member.vehicle for member in self.members)


@define
class Groups:
    """Which blocks plan together, as far as one leader knows; groups only grow."""

    changed: bool = False
    """Set when blocks are joined; the reader resets it."""
    _group: dict[int, Numbers] = field(factory=dict)

    def of(self, number: int) -> Numbers:
        """Return all blocks that plan together with one, itself included."""
        return self._group.get(number, (number,))

    def join(self, numbers: Iterable[int]) -> bool:
        """Join blocks and all that they are joined with; return whether that is new."""
        union = tuple(sorted({other for number in numbers for other in self.of(number)}))
        if not union or self.of(union[0]) == union:
            return False
        self._group |= dict.fromkeys(union, union)
        self.changed = True
        return True

    def forget(self) -> None:
        """Forget all groups: another road has other formations."""
        self._group.clear()


def closed_formations(
    census: Census, t_s: float, scenario: Scenario, groups: Groups
) -> dict[int, Formation]:
    """Return the formations that are complete and on the road.

    Formations with a block that the census does not know as closed are left out: it could lack a
    member of theirs.

    Args:
        census: the vehicles on the road, and the blocks of each formation.
        t_s: road time.
        scenario: the lattice.
        groups: which blocks plan together; the blocks of each closed formation are added.

    Returns:
        Each formation under the lowest number of its blocks.
    """
    lattice = scenario.lattice
    closed_s: dict[int, list[float]] = {}
    for closed in census.formations:
        groups.join(closed.blocks)
    for closed in census.formations:
        closed_s.setdefault(groups.of(closed.first_block)[0], []).append(closed.closed_s)
    members: dict[int, list[CensusEntry]] = {}
    for entry in census.on_road:
        first = groups.of(lattice.block_of(entry.cell[0]))[0]
        members.setdefault(first, []).append(entry)
    listed_blocks = {block for closed in census.formations for block in closed.blocks}
    return {
        first: Formation(
            groups.of(first),
            tuple(sorted(each, key=lambda entry: entry.vehicle)),
            max(closed_s.get(first, [0.0])),
            len(closed_s.get(first, [0.0])),
            tuple(block for block in groups.of(first) if block not in listed_blocks),
            stage := stage_at(groups.of(first), t_s, scenario),
            stage == len(scenario.formation.structures),
        )
        for first, each in sorted(members.items())
        if groups.of(first)[-1] <= census.closed_to
    }


def stage_at(numbers: Numbers, t_s: float, scenario: Scenario) -> int:
    """Return which structure the formation in some blocks should plan for at a road time.

    The first one at once; each later one, and the sorting behind the last one, `STAGE_LEAD_S`
    before the rear gets there.
    """
    structures = scenario.formation.structures
    later = range(1, len(structures) + 1)
    return sum(stage_begin_s(numbers, stage, scenario) - STAGE_LEAD_S <= t_s for stage in later)


def stage_begin_s(numbers: Numbers, stage: int, scenario: Scenario) -> float:
    """Return the road time at which all bodies in some blocks are where a stage begins."""
    structures, lattice = scenario.formation.structures, scenario.lattice
    sorts = stage == len(structures)
    from_m = scenario.road.sorting_start_m if sorts else structures[stage].from_m
    rear = lattice.block_range(numbers[-1])[0]
    return lattice.passing_time_s(rear, from_m + scenario.vehicle.length_m)


def pairs_to_join(
    formations: Mapping[int, Formation], t_s: float, scenario: Scenario
) -> Iterator[Numbers]:
    """Yield the blocks of neighbouring formations whose vehicles fit into one (paper, Fig. 2b).

    Where the scenario lets them join for that; not when the one ahead may sort already.
    """
    formation = scenario.formation
    if formation.join != "room":
        return
    taken: set[int] = set()
    for ahead, behind in pairwise(sorted(formations)):
        front, rear = formations[ahead], formations[behind]
        if (
            ahead not in taken
            and front.numbers[-1] + 1 == rear.numbers[0]
            and front.joined + rear.joined <= formation.max_joined
            and len(front.members) + len(rear.members) <= formation.max_vehicles
            and t_s < stage_begin_s(front.numbers, len(formation.structures), scenario)
        ):
            taken |= {ahead, behind}
            yield (*front.numbers, *rear.numbers)


def start_time_s(cells: Collection[Cell], not_before_s: float, scenario: Scenario) -> float:
    """Return the road time at which vehicles in these cells may begin to change lanes, on a tick.

    That is when the rearmost body is in S3, and never before `not_before_s`.
    """
    lattice, road = scenario.lattice, scenario.road
    in_sorting_s = lattice.passing_time_s(
        min(column for column, _ in cells), road.sorting_start_m + scenario.vehicle.length_m
    )
    return on_tick(max(in_sorting_s, not_before_s), scenario)


def on_tick(t_s: float, scenario: Scenario) -> float:
    """Return the first tick at or after a road time."""
    tick_s = scenario.runtime.tick_s
    return math.ceil(t_s / tick_s - 1e-6) * tick_s


def time_left_s(cells: Collection[Cell], t_s: float, scenario: Scenario) -> float:
    """Return how long it takes from `t_s` until the foremost cell reaches the end of the road."""
    front = max(column for column, _ in cells)
    return scenario.lattice.passing_time_s(front, scenario.road.length_m) - t_s


def steps_left(cells: Collection[Cell], t_s: float, slot_s: float, scenario: Scenario) -> int:
    """Return how many whole steps fit in before the foremost cell reaches the end of the road."""
    return max(0, math.floor(time_left_s(cells, t_s, scenario) / slot_s + 1e-6))
