"""Formations derived from the census, and their time on the road.

The roadside builds formations from the stream of arrivals and assigns blocks of columns to them. A
formation is *closed* when no more vehicles can enter its blocks; once a census reports this, its
roster is complete.

**Joined formations** are planned under one ballot. Such a plan may use the blocks of all of them,
and its roster comprises all vehicles that entered there. After a plan has used two blocks, a
vehicle from either may be in the other, so no later plan may use one without the vehicles of both:
formations stay joined until their vehicles have left. Every vehicle stores the joined blocks
(`VehicleState.record.joined`), so every leader learns them from the promises.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from itertools import pairwise

from attrs import define, field, frozen

from laneweave.coordinator.formations.stages import WHOLE_ROAD, Stage, stages
from laneweave.protocol.lattice import Cell
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.wire.messages import Census, CensusEntry, Name

STAGE_LEAD_S = 5.0
"""Lead time for planning a change of structure, longer than planning takes. If possible,
`pacing.paced` makes the previous plan complete by then."""

Numbers = tuple[int, ...]
"""Block numbers, ascending."""


@frozen
class Formation:
    """A closed formation, or joined ones, with the members that are on the road."""

    numbers: Numbers
    """Block numbers, ascending."""
    members: tuple[CensusEntry, ...]
    """Members, sorted by name."""
    closed_s: float = 0.0
    """Road time at which the last of the formations was closed."""
    joined: int = 1
    """Number of formations that were joined; 1: a single one."""
    deserted: Numbers = ()
    """Blocks of joined formations whose vehicles have all left the road. Plans avoid them, since
    vehicles of formations joined under another leader may be there."""
    stage: Stage = WHOLE_ROAD
    """Stage to plan."""
    goals: tuple[frozenset[int], ...] = ()
    """Goal lanes of each member; empty: it forms a structure, with any member in any place."""

    @property
    def sorts(self) -> bool:
        """Whether the formation sorts its lanes."""
        return bool(self.goals)

    @property
    def goal_lanes(self) -> dict[Name, frozenset[int]]:
        """Goal lanes of the members; empty if the formation forms a structure."""
        return dict(zip(self.roster, self.goals, strict=self.sorts))

    @property
    def roster(self) -> tuple[Name, ...]:
        """Names of the members."""
        return tuple(member.vehicle for member in self.members)


@define
class Groups:
    """Groups of blocks planned together, as known to one leader.

    Groups only grow, and are forgotten when all their vehicles have left the road.
    """

    changed: bool = False
    """Set when blocks are joined; the reader resets it."""
    _group: dict[int, Numbers] = field(factory=dict)

    def of(self, number: int) -> Numbers:
        """Return the group of a block, including the block itself."""
        return self._group.get(number, (number,))

    def join(self, numbers: Iterable[int]) -> bool:
        """Merge the groups of some blocks; return whether this changes anything."""
        union = tuple(sorted({other for number in numbers for other in self.of(number)}))
        if not union or self.of(union[0]) == union:
            return False
        self._group |= dict.fromkeys(union, union)
        self.changed = True
        return True

    def forget_departed(self, census: Census, block_of: Callable[[int], int]) -> None:
        """Discard the groups whose vehicles have all left the road.

        Args:
            census: vehicles on the road, and the last block that no vehicle can enter any more.
            block_of: returns the block of a column.
        """
        present = {block_of(entry.cell[0]) for entry in census.on_road}
        self._group = {
            number: numbers
            for number, numbers in self._group.items()
            if numbers[-1] > census.closed_to or not present.isdisjoint(numbers)
        }

    def forget(self) -> None:
        """Discard all groups: a new road has other formations."""
        self._group.clear()


def closed_formations(
    census: Census,
    t_s: float,
    scenario: Scenario,
    groups: Groups,
    stages_of: Callable[[Numbers], Sequence[Stage]] | None = None,
) -> dict[int, Formation]:
    """Return the closed formations on the road by their lowest block number.

    Formations with a block that is not closed in the census are left out, since a member could be
    missing. Vehicles without cells, which wait at the end of a lane, have left their formations.

    Args:
        census: vehicles on the road, and the blocks of each formation.
        t_s: road time.
        scenario: lattice, structures.
        groups: blocks planned together; the blocks of each closed formation are merged here.
        stages_of: returns the stages of the road for a formation as they are now; None: no part
            is closed for a time, and no vehicle overtakes.
    """
    lattice = scenario.lattice
    closed_s: dict[int, list[float]] = {}
    for closed in census.formations:
        groups.join(closed.blocks)
    for closed in census.formations:
        closed_s.setdefault(groups.of(closed.first_block)[0], []).append(closed.closed_s)
    members: dict[int, list[CensusEntry]] = {}
    for entry in census.on_lattice:
        first = groups.of(lattice.block_of(entry.cell[0]))[0]
        members.setdefault(first, []).append(entry)
    listed_blocks = {block for closed in census.formations for block in closed.blocks}
    formations: dict[int, Formation] = {}
    for first, each in sorted(members.items()):
        numbers, times_s = groups.of(first), closed_s.get(first, [0.0])
        if numbers[-1] <= census.closed_to:
            of_road = stages_of(numbers) if stages_of else stages(scenario)
            stage = stage_at(numbers, t_s, of_road, scenario)
            each.sort(key=lambda entry: entry.vehicle)
            goals = (stage.goal_lanes(entry.preferred_lane, entry.destination) for entry in each)
            formations[first] = Formation(
                numbers,
                tuple(each),
                closed_s=max(times_s),
                joined=len(times_s),
                deserted=tuple(block for block in numbers if block not in listed_blocks),
                stage=stage,
                goals=tuple(goals) if stage.structure is None else (),
            )
    return formations


def stage_at(numbers: Numbers, t_s: float, of_road: Sequence[Stage], scenario: Scenario) -> Stage:
    """Return the stage of a road that a formation should plan at a road time.

    The first stage is planned at once. Each later one is planned `STAGE_LEAD_S` before the rear of
    the formation reaches it, but not before the rear has passed a stage in which lanes are sorted.
    """
    begun = sum(
        max(
            stage_begin_s(numbers, stage, scenario) - STAGE_LEAD_S,
            stage_end_s(numbers, before, scenario),
        )
        <= t_s
        for before, stage in pairwise(of_road)
    )
    return of_road[begun]


def stage_begin_s(numbers: Numbers, stage: Stage, scenario: Scenario) -> float:
    """Return the road time at which all bodies in some blocks have passed the start of a stage."""
    return _all_pass_s(numbers, stage.from_m, scenario)


def _all_pass_s(numbers: Numbers, position_m: float, scenario: Scenario) -> float:
    rear = scenario.lattice.block_range(numbers[-1])[0]
    return scenario.lattice.passing_time_s(rear, position_m + scenario.types.longest_body_m)


def stage_end_s(numbers: Numbers, stage: Stage, scenario: Scenario) -> float:
    """Return the road time by which the plan of a stage should be complete.

    At this time the next stage is planned or, in the last one, the front of the formation leaves
    the road. In lanes that end with the stage, moves must be complete before (`moves_end_s`).
    """
    lattice = scenario.lattice
    if stage.structure is not None:
        return _all_pass_s(numbers, stage.to_m, scenario) - STAGE_LEAD_S
    rear, front = lattice.block_range(numbers[-1])[0], lattice.block_range(numbers[0])[-1]
    return lattice.passing_time_s(front if stage.is_last else rear, stage.to_m)


def moves_end_s(
    cells: Collection[Cell], numbers: Numbers, stage: Stage, scenario: Scenario
) -> float:
    """Return the road time by which moves from and to some cells should be complete.

    A cell of a lane that ends passes the end of the stage then; in the last stage, any cell. For a
    vehicle that overtakes the formation, its lane must be free at one time.
    """
    to_m, ends_s = stage.to_m, min(stage_end_s(numbers, stage, scenario), stage.until_s)
    if stage.is_last:
        return exit_time_s(cells, scenario, to_m)
    ending = [cell for cell in cells if cell[1] in stage.ending_lanes]
    return min(ends_s, exit_time_s(ending, scenario, to_m)) if ending else ends_s


def joinable(
    formations: Mapping[int, Formation], t_s: float, scenario: Scenario
) -> Iterator[Numbers]:
    """Yield the blocks of neighbours whose vehicles fit into one formation (paper, Fig. 2b).

    Pairs join only if `formation.join` is "room" and the formation ahead has not begun to sort.
    """
    formation = scenario.formation
    if formation.join != "room":
        return
    paired: set[int] = set()
    for ahead, behind in pairwise(sorted(formations)):
        front, rear = formations[ahead], formations[behind]
        if (
            ahead not in paired
            and front.numbers[-1] + 1 == rear.numbers[0]
            and front.joined + rear.joined <= formation.max_joined
            and len(front.members) + len(rear.members) <= formation.max_vehicles
            and not front.stage.sorted_before
            and (front.stage.structure or t_s < stage_begin_s(front.numbers, front.stage, scenario))
        ):
            paired |= {ahead, behind}
            yield (*front.numbers, *rear.numbers)


def start_time_s(
    cells: Collection[Cell], not_before_s: float, scenario: Scenario, from_m: float | None = None
) -> float:
    """Return the tick [s] from which vehicles in these cells may change lanes.

    The rearmost body has passed `from_m` by then, by default the start of S3; the tick is
    >= `not_before_s`.
    """
    if from_m is None:
        from_m = scenario.road.sorting_start_m
    rear = min(column for column, _ in cells)
    begin_s = scenario.lattice.passing_time_s(rear, from_m + scenario.types.longest_body_m)
    return on_tick(max(begin_s, not_before_s), scenario)


def sorting_start_s(
    cells: Collection[Cell], not_before_s: float, scenario: Scenario, from_m: float
) -> float:
    """Return the tick [s] from which vehicles in these cells may sort their lanes in a stage.

    The rearmost body has passed `from_m` by then, and vehicles from ramps have settled. In S3,
    others have S1 and S2 to settle; where these are too short, the start gate waits for them.
    """
    early = from_m < scenario.road.sorting_start_m
    if settling := [cell for cell in cells if early or scenario.geometry.entry_m[cell[1]] > 0.0]:
        not_before_s = max(not_before_s, settled_s(settling, scenario))
    return start_time_s(cells, not_before_s, scenario, from_m)


def settled_s(cells: Iterable[Cell], scenario: Scenario) -> float:
    """Return the road time by which vehicles that entered in these cells have settled."""
    formation, lattice = scenario.formation, scenario.lattice
    entered_s = max(
        lattice.passing_time_s(column, scenario.geometry.entry_m[lane]) for column, lane in cells
    )
    return entered_s + formation.entry_spread_s + formation.settle_s


def on_tick(t_s: float, scenario: Scenario) -> float:
    """Return the first tick [s] at or after a road time."""
    tick_s = scenario.runtime.tick_s
    return math.ceil(t_s / tick_s - 1e-6) * tick_s


def exit_time_s(cells: Collection[Cell], scenario: Scenario, to_m: float | None = None) -> float:
    """Return the road time at which the foremost cell reaches `to_m`, by default the road's end."""
    front = max(column for column, _ in cells)
    return scenario.lattice.passing_time_s(front, scenario.road.length_m if to_m is None else to_m)


def steps_left(cells: Collection[Cell], t_s: float, slot_s: float, scenario: Scenario) -> int:
    """Return the number of whole steps until the foremost cell reaches the end of the road."""
    return max(0, math.floor((exit_time_s(cells, scenario) - t_s) / slot_s + 1e-6))
