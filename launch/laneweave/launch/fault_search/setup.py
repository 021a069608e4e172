"""What a seed draws before a run begins: the road, who visits it, the faults, and all wishes."""

from __future__ import annotations

import random
from collections.abc import Iterator

from attrs import frozen

from laneweave.launch.fault_search.faults import CLOCK_DRIFT, CLOCK_OFFSET_S, LEASE_S, Mix
from laneweave.launch.fault_search.light_road import Grant, Visit
from laneweave.launch.fault_search.profiles import Profile
from laneweave.launch.fault_search.rolling_setup import Stretch, grants, make_rolling_scenario
from laneweave.protocol.lattice import Cell
from laneweave.protocol.scenario.deployment import Network
from laneweave.protocol.scenario.tables import FormationSettings, Road, Runtime, Scenario
from laneweave.protocol.wire.messages import ClosedFormation, Name

SLOT_S, MOVE_S, TICK_S = 1.0, 0.8, 0.1
LAST_COLUMNS = (1, 1, -3, -7)
"""Rear column of the rearmost formation. Columns above 0 are on the road at the start; the others
enter cell by cell, so that it is closed after 3 or 7 s."""
BLOCK_COLUMNS = 4
LENGTHS = (2, 7)
"""Columns of formations whose lengths differ."""
GAPS = (0, 0, 1)
"""Columns of no formation between two of these."""
LEAVES_S = (2.0, 9.0)
THOROUGH = 0.05
"""Share of runs of the rolling operation with the stream planner; it costs ten times the rest."""
LARGEST = 6
"""Vehicles in a formation, as many as the paper's largest one has."""
LARGEST_JOINED = 10
"""In two formations that may be joined: more are too much work for the planner, often."""


def make_scenario(lanes: int, max_joined: int, *, growing: bool = False) -> Scenario:
    """Return the scenario of a run: a long road, and short times so that seeds are cheap.

    Args:
        lanes: of the road.
        max_joined: most formations that plan together.
        growing: whether formations have different lengths.
    """
    return Scenario(
        road=Road(lanes=lanes, s1_m=0.0, s2_m=0.0, s3_m=20_000.0),
        formation=FormationSettings(
            operation="formations",
            close="vehicles" if growing else "columns",
            block_columns=BLOCK_COLUMNS,
            cycle_s=SLOT_S,
            move_s=MOVE_S,
            max_joined=max_joined,
            # The bound on nodes ends a search; the clock of a busy machine must not.
            planning_deadline_s=3600.0,
            max_nodes=500,
        ),
        network=Network(heartbeat_s=0.2, election_s=0.6, lease_s=LEASE_S),
        runtime=Runtime(tick_s=TICK_S, agent_silent_s=1.5),
    )


@frozen
class Setup:
    """Everything that is fixed before a run begins."""

    scenario: Scenario
    mix: Mix
    formations: tuple[ClosedFormation, ...]
    """Foremost first."""
    visits: tuple[Visit, ...]
    crowded: bool
    """Now and then more vehicles want a lane of a block than it has cells."""
    grants: tuple[Grant, ...] = ()
    """Which empty cells are whose (rolling operation)."""
    stretch_columns: int = 0
    """Length of the stretch in which vehicles enter (rolling operation)."""
    thorough: bool = False
    """The stream planner plans, not the light one (rolling operation)."""

    @property
    def adjoin(self) -> bool:
        """Whether there are two formations, with no column between them: these can be joined."""
        if len(self.formations) != 2:
            return False
        ahead, behind = self.formations
        return behind.first_block == ahead.last_block + 1

    @classmethod
    def drawn(cls, profile: Profile, rng: random.Random) -> Setup:
        """Draw from a profile."""
        lanes = rng.randint(*profile.lanes)
        if profile.rolling:
            return cls._drawn_rolling(profile, lanes, rng)
        growing = rng.random() < profile.growing
        scenario = make_scenario(lanes, rng.randint(*profile.max_joined), growing=growing)
        formations = tuple(_draw_formations(profile, scenario, rng))
        mix = Mix.drawn(profile, rng)
        visits = tuple(_draw_visits(profile, scenario, formations, mix, rng))
        return cls(scenario, mix, formations, visits, rng.random() < profile.crowding)

    @classmethod
    def _drawn_rolling(cls, profile: Profile, lanes: int, rng: random.Random) -> Setup:
        scenario = make_rolling_scenario(lanes, TICK_S, rng)
        mix = Mix.drawn(profile, rng)
        stretch = Stretch.drawn(profile, scenario, rng)
        visits = tuple(
            _visit(Name(f"v{number:02}"), cell, rng.random() < profile.leavers, scenario, mix, rng)
            for number, cell in enumerate(stretch.cells, start=1)
        )
        return cls(
            scenario,
            mix,
            (),
            visits,
            rng.random() < profile.crowding,
            tuple(grants(scenario, stretch, visits)),
            stretch.columns,
            rng.random() < THOROUGH,
        )

    def wishes(self, rng: random.Random, *, last: bool) -> dict[Name, int]:
        """Draw the lane that each vehicle prefers.

        The last wishes can be fulfilled: in each block at most as many vehicles want a lane as it
        has cells there. Where two formations may be joined, that holds for both together.
        """
        lanes, lattice = self.scenario.road.lanes, self.scenario.lattice
        columns = [len(one.columns(lattice)) for one in self.formations]
        if self.scenario.formation.rolling:
            room = [self.stretch_columns] * lanes
            weights = [6.0 if self.crowded and lane == 0 else 1.0 for lane in range(lanes)]
            vehicles = [visit.vehicle for visit in self.visits]
            return _draw_lanes(vehicles, room, weights, rng)
        may_join = self.adjoin and self.scenario.formation.max_joined >= 2
        if self.crowded and (may_join or not last):
            # One lane that everybody likes best.
            room = [sum(columns)] * lanes if last else [99] * lanes
            favourite = rng.randrange(lanes)
            weights = [6.0 if lane == favourite else 1.0 for lane in range(lanes)]
            return _draw_lanes([visit.vehicle for visit in self.visits], room, weights, rng)
        wishes: dict[Name, int] = {}
        for formation, length in zip(self.formations, columns, strict=True):
            members = [
                visit.vehicle
                for visit in self.visits
                if lattice.block_of(visit.cell[0]) in formation.blocks
            ]
            wishes |= _draw_lanes(members, [length] * lanes, [1.0] * lanes, rng)
        return wishes


def _draw_lanes(
    vehicles: list[Name], room: list[int], weights: list[float], rng: random.Random
) -> dict[Name, int]:
    left, lanes = list(room), range(len(room))
    wishes: dict[Name, int] = {}
    for vehicle in vehicles:
        (lane,) = rng.choices(
            lanes, [weight if left[lane] else 0.0 for lane, weight in enumerate(weights)]
        )
        left[lane] -= 1
        wishes[vehicle] = lane
    return wishes


def _draw_formations(
    profile: Profile, scenario: Scenario, rng: random.Random
) -> list[ClosedFormation]:
    """Draw which columns are whose, from the rearmost formation to the foremost one."""
    lattice, growing = scenario.lattice, scenario.formation.closes_by_vehicles
    rear, formations = rng.choice(LAST_COLUMNS), []
    for _ in range(rng.randint(*profile.blocks)):
        length = rng.randint(*LENGTHS) if growing else BLOCK_COLUMNS
        front, closed_s = rear + length - 1, max(0.0, lattice.passing_time_s(rear))
        blocks = lattice.block_of(front), lattice.block_of(rear)
        formations.append(ClosedFormation(*blocks, closed_s))
        rear = front + 1 + (rng.choice(GAPS) if growing else 0)
    return formations[::-1]


def _draw_visits(
    profile: Profile,
    scenario: Scenario,
    formations: tuple[ClosedFormation, ...],
    mix: Mix,
    rng: random.Random,
) -> Iterator[Visit]:
    """Draw who is in which cell: in each formation at least one, in none more than half full."""
    lattice = scenario.lattice
    cells = [
        [(column, lane) for column in one.columns(lattice) for lane in range(lattice.lanes)]
        for one in formations
    ]
    blocks = range(len(formations))
    room = [min(len(each) // 2, LARGEST) for each in cells]
    if scenario.formation.max_joined > 1:
        # Every other one is small.
        for block in blocks[rng.randrange(2) :: 2]:
            room[block] = min(room[block], LARGEST_JOINED - LARGEST)
    least, most = profile.vehicles
    wanted = min(max(rng.randint(least, most), len(blocks)), sum(room))
    counts = [1] * len(blocks)
    while sum(counts) < wanted:
        counts[rng.choice([block for block in blocks if counts[block] < room[block]])] += 1
    number = 0
    for block in blocks:
        for index, cell in enumerate(rng.sample(cells[block], counts[block])):
            number += 1
            # The first one stays: without anybody a formation is gone, and so is its room.
            leaves = index > 0 and rng.random() < profile.leavers
            yield _visit(Name(f"v{number:02}"), cell, leaves, scenario, mix, rng)


def _visit(
    name: Name, cell: Cell, leaves: bool, scenario: Scenario, mix: Mix, rng: random.Random
) -> Visit:
    enters_s = max(0.0, scenario.lattice.passing_time_s(cell[0]))
    wrong = 1.0 if mix.wrong_clocks else 0.0
    return Visit(
        vehicle=name,
        cell=cell,
        enters_s=enters_s,
        leaves_s=enters_s + rng.uniform(*LEAVES_S) if leaves else None,
        clock_offset_s=wrong * rng.uniform(-CLOCK_OFFSET_S, CLOCK_OFFSET_S),
        clock_drift=wrong * rng.uniform(-CLOCK_DRIFT, CLOCK_DRIFT),
    )
