"""Setup of a run: road, vehicles, lasting faults, and preferred lanes.

On a drawn entrance, some vehicles are in S3 at the start (rolling operation), and the others enter
behind them. At the real roadside, all vehicles enter one after another.
"""

from __future__ import annotations

import math
import random
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property

from attrs import evolve, frozen

from laneweave.launch.fault_search.events.lasting_faults import (
    CLOCK_DRIFT,
    CLOCK_OFFSET_S,
    LastingFaults,
)
from laneweave.launch.fault_search.profiles import Profile
from laneweave.launch.fault_search.road.drawn_entrance import DrawnTraffic, Grant, drawn_roadside
from laneweave.launch.fault_search.road.drawn_roads import (
    EXIT,
    DrawnRoad,
    draw_interchange,
    draw_road,
)
from laneweave.launch.fault_search.road.drawn_surprises import draw_surprises
from laneweave.launch.fault_search.road.light_vehicle import Visit
from laneweave.launch.fault_search.road_setup import (
    BLOCK_COLUMNS,
    MAX_SIZE,
    MODES,
    TRUCK,
    RoadSetup,
    draw_rolling_road,
    own_rng,
)
from laneweave.protocol.lattice import Cell
from laneweave.protocol.road_layout import END_OF_ROAD
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.formation_table import FormationSettings
from laneweave.protocol.scenario.road_tables import Closure
from laneweave.protocol.wire.messages import CAR, ClosedFormation, Name
from laneweave.sim_bridge.road.demand import Arrival
from laneweave.sim_bridge.road.roadside import Roadside

LEAVES_S = (2.0, 9.0)
"""Range of times that vehicles spend on the road if they leave during the fault phase."""

MEAN_HEADWAYS_S = (0.3, 3.0)
"""Range of the mean headway, beyond the minimum of 1 s, between arrivals at the real roadside."""

LAST_COLUMNS = (1, 1, -3, -7)
"""Rear columns of the rearmost formation to draw from. Vehicles in columns >= 0 are on the road at
the start; the others enter later, and the formation closes when its rear column enters."""
LENGTHS = (2, 7)
"""Range of formation lengths if they differ, in columns."""
GAPS = (0, 0, 1)
"""Gaps to draw from, between formations of different lengths, in columns."""
MAX_JOINED_SIZE = 10
"""Maximum number of vehicles in two formations that may join, to limit planning time."""

MAX_BEHIND = 3
"""Number of empty cells that the last vehicle in a lane owns behind itself."""
BEFORE_COLUMNS = (3, 4, 6)
"""Lengths of the road before S3 to draw from at the real roadside, in columns."""
LANE_ENDS_M = (150.0, 300.0)
"""Range of distances between the first position of moves and the end of lane 0."""
WITH_TRUCKS = 0.3
"""Share of drawn roads with trucks."""
LEAVING = 0.4
"""Share of vehicles that leave by the exit of a drawn road."""


@frozen
class Setup:
    """Setup of a run."""

    road: RoadSetup
    lasting: LastingFaults
    visits: tuple[Visit, ...]
    formations: tuple[ClosedFormation, ...] = ()
    """Formations on a drawn entrance, foremost first."""
    crowded: bool = False
    """Whether more vehicles may prefer a lane than their block has cells in that lane."""
    grants: tuple[Grant, ...] = ()
    """Assignments of empty cells to owners on a drawn entrance (rolling operation)."""
    stretch_columns: int = 0
    """Number of columns in which vehicles enter (rolling operation)."""
    leaving: tuple[Name, ...] = ()
    """Vehicles that leave by the exit of a drawn road."""

    @cached_property
    def scenario(self) -> Scenario:
        """Scenario of the road."""
        return self.road.make_scenario()

    @cached_property
    def visit_of(self) -> dict[Name, Visit]:
        """Visit of each vehicle."""
        return {visit.vehicle: visit for visit in self.visits}

    @property
    def adjoin(self) -> bool:
        """Whether there are two adjacent formations that can join."""
        if len(self.formations) != 2:
            return False
        ahead, behind = self.formations
        return behind.first_block == ahead.last_block + 1

    @classmethod
    def drawn(cls, profile: Profile, rng: random.Random) -> Setup:
        """Draw a setup from a profile."""
        lanes = rng.randint(*profile.lanes)
        if profile.roadside:
            return cls._drawn_at_roadside(profile, lanes, rng)
        if profile.rolling:
            return cls._drawn_rolling(profile, lanes, rng)
        growing = rng.random() < profile.growing
        road = RoadSetup(
            lanes=lanes,
            max_joined=rng.randint(*profile.max_joined),
            growing=growing,
            mode=rng.choice(MODES),
        )
        scenario = road.make_scenario()
        formations = tuple(_draw_formations(profile, scenario, rng))
        lasting = LastingFaults.drawn(profile, rng)
        visits = tuple(_draw_visits(profile, scenario, formations, lasting, rng))
        return cls(road, lasting, visits, formations, rng.random() < profile.crowding)

    @classmethod
    def _drawn_rolling(cls, profile: Profile, lanes: int, rng: random.Random) -> Setup:
        road = draw_rolling_road(lanes, rng)
        scenario = road.make_scenario()
        lasting = LastingFaults.drawn(profile, rng)
        # At least the foremost column is in S3 at the start.
        count = rng.randint(*profile.vehicles)
        columns = max(2, math.ceil(count / (lanes * rng.uniform(*profile.density))))
        first = rng.randint(1, columns + 1)
        cells = [(first - index, lane) for index in range(columns) for lane in range(lanes)]
        visits = tuple(
            _visit(number, cell, rng.random() < profile.leavers, scenario, lasting, rng)
            for number, cell in enumerate(sorted(rng.sample(cells, count), reverse=True), start=1)
        )
        return cls(
            road,
            lasting,
            visits,
            crowded=rng.random() < profile.crowding,
            grants=tuple(_grants(scenario, first, columns, visits)),
            stretch_columns=columns,
        )

    @classmethod
    def _drawn_at_roadside(cls, profile: Profile, lanes: int, rng: random.Random) -> Setup:
        if profile.rolling:
            road = draw_rolling_road(lanes, rng, before_columns=rng.choice(BEFORE_COLUMNS))
            if profile.lane_ends:
                ends_m = road.before_m + rng.uniform(*LANE_ENDS_M)
                road = evolve(road, drawn=DrawnRoad((Closure(0, ends_m),)))
            elif profile.roads:
                step_m = FormationSettings().speed_mps * road.slot_s
                road = evolve(road, drawn=draw_road(lanes, road.before_m, step_m, rng))
            elif profile.interchanges:
                step_m = FormationSettings().speed_mps * road.slot_s
                road = evolve(road, drawn=draw_interchange(lanes, road.before_m, step_m, rng))
        else:
            road = RoadSetup(
                lanes=lanes,
                roadside=True,
                max_joined=rng.randint(*profile.max_joined),
                growing=rng.random() < profile.growing,
                max_vehicles=rng.randint(2, MAX_SIZE),
                mode=rng.choice(MODES),
            )
            if profile.roads:
                straight = road.make_scenario()
                before_m = rng.choice(BEFORE_COLUMNS) * straight.formation.gap_m
                step_m = straight.formation.speed_mps * road.slot_s
                drawn = draw_road(lanes, before_m, step_m, rng, straight.formation.longest_m)
                seed = rng.randrange(2**31)
                road = evolve(road, before_m=before_m, drawn=drawn, seed=seed)
        if profile.roads:
            road = evolve(road, trucks=own_rng(road, "road").random() < WITH_TRUCKS)
        if profile.surprises[1]:
            road = evolve(road, seed=road.seed or rng.randrange(2**31))
            own = own_rng(road, "surprises")
            count = own.randint(*profile.surprises)
            road = evolve(road, surprises=draw_surprises(count, range(lanes), own))
        scenario = road.make_scenario()
        lasting = LastingFaults.drawn(profile, rng)
        mean_s = rng.uniform(*MEAN_HEADWAYS_S)
        points = scenario.geometry.entry_points
        next_s = {point: rng.uniform(0.0, mean_s) for point in scenario.flow.inflows}
        visits, types_rng = [], own_rng(road, "vehicles")
        for number in range(1, rng.randint(*profile.vehicles) + 1):
            arrival_s, point = min((t_s, point) for point, t_s in next_s.items())
            next_s[point] += 1.0 + rng.expovariate(1.0 / mean_s)
            leaves = number > 1 and rng.random() < profile.leavers
            cell = (0, points[point].lane)
            visit = _visit(number, cell, leaves, scenario, lasting, rng)
            is_truck = road.trucks and types_rng.random() < TRUCK.share
            vehicle_type = TRUCK.name if is_truck else CAR
            visits.append(
                evolve(visit, enters_s=arrival_s, vehicle_type=vehicle_type, entry_point=point)
            )
        crowded = rng.random() < profile.crowding
        leaving = tuple(
            visit.vehicle
            for visit in visits
            for exit_ in road.drawn.exit
            if rng.random() < LEAVING and points[visit.entry_point].at_m < exit_.at_m
        )
        return cls(
            road,
            lasting,
            tuple(visits),
            crowded=crowded,
            stretch_columns=len(visits),
            leaving=leaving,
        )

    def make_roadside(self, preferred_lanes: Mapping[Name, int], bridge: int) -> Roadside:
        """Return the roadside of a road with preferred lanes and the incarnation of its bridge."""
        if not self.road.roadside:
            traffic = DrawnTraffic(self.visits, preferred_lanes)
            return drawn_roadside(self.scenario, traffic, self.formations, self.grants, bridge)
        stream = tuple(
            Arrival(
                visit.vehicle,
                visit.cell[1],
                preferred_lanes[visit.vehicle],
                visit.enters_s,
                EXIT if visit.vehicle in self.leaving else END_OF_ROAD,
                visit.vehicle_type,
                entry_point=visit.entry_point,
            )
            for visit in sorted(self.visits, key=lambda visit: visit.enters_s)
        )
        breakdowns = self.road.surprises.breakdowns
        return Roadside(self.scenario, stream, bridge, breakdowns=breakdowns)

    def preferences(self, rng: random.Random, *, last: bool) -> dict[Name, int]:
        """Draw the preferred lane of each vehicle.

        If `last`, all can be satisfied: in each formation (or each pair that may join),
        no lane is preferred by more vehicles than it has cells. At the real roadside, formations
        form by the preferred lanes at entry, so only these can all be satisfied.
        """
        lanes, lattice = self.scenario.road.lanes, self.scenario.lattice
        columns = [len(one.columns(lattice)) for one in self.formations]
        if self.road.rolling or self.road.roadside:
            room = [self.stretch_columns] * lanes
            length_m = self.scenario.road.length_m
            reaching = {one.lane for one in self.scenario.geometry.sections if one.to_m >= length_m}
            for lane in {*range(lanes)} - reaching:
                room[lane] = 0
            weights = [6.0 if self.crowded and lane == 0 else 1.0 for lane in range(lanes)]
            vehicles = [visit.vehicle for visit in self.visits]
            return _draw_lanes(vehicles, room, weights, rng)
        may_join = self.adjoin and self.road.max_joined >= 2
        if self.crowded and (may_join or not last):
            # One lane is preferred more often than the others.
            room = [sum(columns)] * lanes if last else [99] * lanes
            frequent = rng.randrange(lanes)
            weights = [6.0 if lane == frequent else 1.0 for lane in range(lanes)]
            return _draw_lanes([visit.vehicle for visit in self.visits], room, weights, rng)
        preferences: dict[Name, int] = {}
        for formation, length in zip(self.formations, columns, strict=True):
            members = [
                visit.vehicle
                for visit in self.visits
                if lattice.block_of(visit.cell[0]) in formation.blocks
            ]
            preferences |= _draw_lanes(members, [length] * lanes, [1.0] * lanes, rng)
        return preferences


def _draw_lanes(
    vehicles: list[Name], room: list[int], weights: list[float], rng: random.Random
) -> dict[Name, int]:
    left, lanes = list(room), range(len(room))
    preferences: dict[Name, int] = {}
    for vehicle in vehicles:
        (lane,) = rng.choices(
            lanes, [weight if left[lane] else 0.0 for lane, weight in enumerate(weights)]
        )
        left[lane] -= 1
        preferences[vehicle] = lane
    return preferences


def _draw_formations(
    profile: Profile, scenario: Scenario, rng: random.Random
) -> list[ClosedFormation]:
    """Draw the formations from rear to front; return them foremost first."""
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
    lasting: LastingFaults,
    rng: random.Random,
) -> Iterator[Visit]:
    """Draw the vehicles: in each formation at least one, and at most one for every two cells."""
    lattice = scenario.lattice
    cells = [
        [(column, lane) for column in one.columns(lattice) for lane in range(lattice.lanes)]
        for one in formations
    ]
    blocks = range(len(formations))
    room = [min(len(each) // 2, MAX_SIZE) for each in cells]
    if scenario.formation.max_joined > 1:
        # Every second formation is small.
        for block in blocks[rng.randrange(2) :: 2]:
            room[block] = min(room[block], MAX_JOINED_SIZE - MAX_SIZE)
    wanted = min(max(rng.randint(*profile.vehicles), len(blocks)), sum(room))
    counts = [1] * len(blocks)
    while sum(counts) < wanted:
        counts[rng.choice([block for block in blocks if counts[block] < room[block]])] += 1
    number = 0
    for block in blocks:
        for index, cell in enumerate(rng.sample(cells[block], counts[block])):
            number += 1
            # The first vehicle stays, because formations are never empty.
            leaves = index > 0 and rng.random() < profile.leavers
            yield _visit(number, cell, leaves, scenario, lasting, rng)


def _visit(
    number: int,
    cell: Cell,
    leaves: bool,
    scenario: Scenario,
    lasting: LastingFaults,
    rng: random.Random,
) -> Visit:
    enters_s = max(0.0, scenario.lattice.passing_time_s(cell[0]))
    wrong = 1.0 if lasting.wrong_clocks else 0.0
    return Visit(
        vehicle=Name(f"v{number:02}"),
        cell=cell,
        enters_s=enters_s,
        leaves_s=enters_s + rng.uniform(*LEAVES_S) if leaves else None,
        clock_offset_s=wrong * rng.uniform(-CLOCK_OFFSET_S, CLOCK_OFFSET_S),
        clock_drift=wrong * rng.uniform(-CLOCK_DRIFT, CLOCK_DRIFT),
    )


def _grants(
    scenario: Scenario, first: int, columns: int, visits: Sequence[Visit]
) -> Iterator[Grant]:
    """Yield the assignment of each empty cell to the last vehicle that entered in its lane.

    A cell is granted once vehicles can no longer enter it. Cells ahead of all vehicles go to the
    first one; the bridge would leave these cells without owners, but this stretch is short.
    """
    lattice, spread_s = scenario.lattice, scenario.formation.entry_spread_s
    by_cell = {visit.cell: visit for visit in visits}
    for lane in range(lattice.lanes):
        in_lane = [visit for visit in visits if visit.cell[1] == lane]
        owner = max(in_lane or visits, key=lambda visit: visit.cell)
        for column in range(first, first - columns - MAX_BEHIND, -1):
            visit = by_cell.get((column, lane))
            if visit is not None:
                owner = visit
                continue
            closed_s = max(0.0, lattice.passing_time_s(column) + spread_s)
            yield Grant(max(closed_s, owner.enters_s), owner.vehicle, (column, lane))
