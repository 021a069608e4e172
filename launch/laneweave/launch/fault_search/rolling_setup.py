"""What a seed draws for the rolling operation: a stretch of cells, who is in them, whose is each.

The road is short, since the whole rest of it is planned for in each slot: some of the vehicles are
in S3 at the start, the others enter behind them, and all leave at its end.
"""

from __future__ import annotations

import math
import random
from collections.abc import Iterator, Sequence

from attrs import frozen

from laneweave.launch.fault_search.faults import LEASE_S
from laneweave.launch.fault_search.light_road import Grant, Visit
from laneweave.launch.fault_search.profiles import Profile
from laneweave.protocol.lattice import Cell
from laneweave.protocol.scenario.deployment import Network
from laneweave.protocol.scenario.tables import FormationSettings, Road, Runtime, Scenario

SLOTS_S = (1.0, 1.0, 1.0, 2.0)
"""Lengths of a slot to choose from. In the shortest, ballots are often given up in the middle."""
MODES = (1, 1, 2)
MOVE_SHARE = 0.8
"""Of a slot that a move takes."""
SLOTS_ON_ROAD = 45
"""Slots in which a column passes the road."""
BEHIND = 3
"""Empty columns at most behind whoever enters last on a lane that become its own."""


def make_rolling_scenario(lanes: int, tick_s: float, rng: random.Random) -> Scenario:
    """Return the scenario of a run."""
    slot_s = rng.choice(SLOTS_S)
    formation = FormationSettings(
        operation="rolling",
        cycle_s=slot_s,
        move_s=round(MOVE_SHARE * slot_s / tick_s) * tick_s,
        mode=rng.choice(MODES),
    )
    length_m = SLOTS_ON_ROAD * slot_s * formation.speed_mps
    return Scenario(
        seed=rng.randrange(2**31),
        road=Road(lanes=lanes, s1_m=0.0, s2_m=0.0, s3_m=length_m),
        formation=formation,
        network=Network(heartbeat_s=0.2, election_s=0.6, lease_s=LEASE_S),
        runtime=Runtime(tick_s=tick_s, agent_silent_s=1.5),
    )


@frozen
class Stretch:
    """Columns from `first` backwards, and the cells of them in which vehicles enter."""

    first: int
    columns: int
    cells: tuple[Cell, ...]

    @classmethod
    def drawn(cls, profile: Profile, scenario: Scenario, rng: random.Random) -> Stretch:
        """Draw from a profile; at least the foremost column is in S3 at the start."""
        lanes = scenario.road.lanes
        count = rng.randint(*profile.vehicles)
        columns = max(2, math.ceil(count / (lanes * rng.uniform(*profile.density))))
        first = rng.randint(1, columns + 1)
        every = [(first - index, lane) for index in range(columns) for lane in range(lanes)]
        return cls(first, columns, tuple(sorted(rng.sample(every, count), reverse=True)))


def grants(scenario: Scenario, stretch: Stretch, visits: Sequence[Visit]) -> Iterator[Grant]:
    """Return whose the empty cells are: of whoever entered last before them on their lane.

    A cell is granted when nobody can enter in it any more. Those that nobody is ahead of are the
    first one's: on a real road they are nobody's, but a short stretch needs all the room it has.
    """
    lattice, spread_s = scenario.lattice, scenario.formation.entry_spread_s
    by_cell = {visit.cell: visit for visit in visits}
    for lane in range(lattice.lanes):
        on_lane = [visit for visit in visits if visit.cell[1] == lane]
        owner = max(on_lane or visits, key=lambda visit: visit.cell)
        for column in range(stretch.first, stretch.first - stretch.columns - BEHIND, -1):
            visit = by_cell.get((column, lane))
            if visit is not None:
                owner = visit
                continue
            closed_s = max(0.0, lattice.passing_time_s(column) + spread_s)
            yield Grant(max(closed_s, owner.enters_s), owner.vehicle, (column, lane))
