"""Which columns become one formation, and when it is closed."""

from __future__ import annotations

import math
from collections import Counter
from itertools import pairwise

import pytest
from attrs import define, field, frozen
from hypothesis import given
from hypothesis import strategies as st

from laneweave.protocol.lattice import Lattice
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.formation_table import formation_columns
from laneweave.protocol.scenario.road_tables import EntryPoint
from laneweave.protocol.wire.messages import ClosedFormation
from laneweave.sim_bridge.road.demand import Arrival
from laneweave.sim_bridge.road.entry import Admission, EntryMeter
from laneweave.sim_bridge.road.formation_building import (
    ColumnBlocks,
    Entrances,
    FormationBuilder,
    GrowingFormations,
    formation_builder,
)
from support.examples import examples
from support.paper import PAPER

TICK_S = 0.1
SPREAD_S = 0.5
"""Half of the time between two columns, as with free entry."""
BLOCK_COLUMNS = 4


def lattice(lanes: int = 3, block_columns: int = 1) -> Lattice:
    return Lattice(15.0, 15.0, 3.5, lanes, block_columns)


def growing(lanes: int = 3, vehicles: int = 6, columns: int = 7) -> GrowingFormations:
    return GrowingFormations(lattice(lanes), vehicles, columns, SPREAD_S, Entrances(lanes))


# --- an entrance ------------------------------------------------------------------------------


@define
class Entrance:
    """Lets vehicles in, tick by tick, and checks at every tick what holds at every tick."""

    grid: Lattice
    builder: FormationBuilder
    spread_s: float
    interlaced: bool = False
    entry_points: tuple[EntryPoint, ...] = ()
    reserve_s: tuple[float, ...] = ()
    """Times at which columns are reserved."""
    reserved: list[range] = field(factory=list)
    admissions: list[Admission] = field(factory=list)
    formations: list[ClosedFormation] = field(factory=list)

    @property
    def columns_ahead(self) -> int:
        """How far apart two cells are at most that may be entered at the same time."""
        return math.floor(2.0 * self.spread_s)

    def run(self, stream: list[Arrival]) -> None:
        """Run until all vehicles have entered and the last formation is closed."""
        meter = EntryMeter(
            self.grid,
            self.spread_s,
            self.builder,
            interlaced=self.interlaced,
            entry_points=self.entry_points,
        )
        pending, tick, rest = list(stream), 0, 0
        while rest < 400:
            t_s = TICK_S * tick
            while pending and pending[0].t_s <= t_s + TICK_S:
                meter.demand(pending.pop(0))
            self._tick(meter, t_s)
            rest += not pending and not meter.waiting
            tick += 1
            assert tick < 20_000

    def _tick(self, meter: EntryMeter, t_s: float) -> None:
        closed_to = self.builder.closed_to
        entered = meter.admit(t_s)
        blocks = [self.grid.block_of(admission.cell[0]) for admission in entered]
        assert all(block > closed_to for block in blocks), "a vehicle enters a closed column"
        self.admissions += entered
        if any(t_s - TICK_S < reserve_s <= t_s for reserve_s in self.reserve_s):
            self.reserved.append(meter.keep_free(self.grid.lanes - 1, GAP, t_s))
        for closed in self.builder.closed(t_s):
            assert closed.closed_s <= t_s + 1e-9
            assert closed.first_block > closed_to, "a column has two formations"
            closed_to = closed.last_block
            self.formations.append(closed)
        assert self.builder.closed_to >= closed_to

    def members(self, closed: ClosedFormation) -> list[Admission]:
        """Return the vehicles that entered in the columns of a formation."""
        columns = closed.columns(self.grid)
        return [admission for admission in self.admissions if admission.cell[0] in columns]


def check(entrance: Entrance, most_vehicles: int, most_columns: int) -> None:
    """Check the columns and members of formations when all are closed."""
    lanes = entrance.grid.lanes
    for one, other in pairwise(entrance.formations):
        assert one.last_block < other.first_block
        assert one.closed_s <= other.closed_s
    found = [each for closed in entrance.formations for each in entrance.members(closed)]
    assert Counter(each.arrival.vehicle for each in found) == Counter(
        each.arrival.vehicle for each in entrance.admissions
    ), "a vehicle is not in exactly one formation"
    for closed in entrance.formations:
        members, length = entrance.members(closed), len(closed.columns(entrance.grid))
        preferring = Counter(each.arrival.preferred_lane for each in members)
        assert 1 <= len(members) <= most_vehicles
        assert max(preferring.values()) <= length
        assert length <= max(most_columns, len(members), 1 + entrance.columns_ahead)
        if lanes > 1 and entrance.grid.block_columns == 1:
            assert length * lanes >= len(members) + lanes, "there is no free column"


@frozen
class Case:
    """An entrance and its demand."""

    lanes: int
    most_vehicles: int
    most_columns: int
    spread_s: float
    interlaced: bool
    stream: tuple[Arrival, ...]


@st.composite
def cases(draw: st.DrawFn) -> Case:
    """Any demand, from few vehicles to a queue on each lane."""
    lanes = draw(st.integers(1, 5))
    vehicles = draw(st.integers(1, 8))
    end_s = draw(st.sampled_from([5.0, 30.0, 200.0]))
    lane = st.integers(0, lanes - 1)
    drawn = draw(st.lists(st.tuples(st.floats(0.0, end_s), lane, lane), max_size=40))
    stream = tuple(
        Arrival(f"v{number:04d}", entry, preferred, t_s)
        for number, (t_s, entry, preferred) in enumerate(sorted(drawn), start=1)
    )
    # The shortest length that holds so many is the least that makes sense.
    shortest = math.ceil((vehicles + lanes) / lanes) if lanes > 1 else vehicles
    columns = draw(st.integers(shortest, 10))
    interlaced = draw(st.booleans())
    spread_s = draw(st.sampled_from([0.0, 1.5] if interlaced else [0.0, 0.25, SPREAD_S, 0.75]))
    return Case(lanes, vehicles, columns, spread_s, interlaced, stream)


@pytest.mark.slow
@pytest.mark.parametrize("grows", [True, False], ids=["growing", "blocks of columns"])
@given(case=cases())
@examples(150)
def test_every_vehicle_is_in_one_formation_that_has_room_for_all_of_its_wishes(
    case: Case, *, grows: bool
) -> None:
    grid = lattice(case.lanes, 1 if grows else BLOCK_COLUMNS)
    builder: FormationBuilder = (
        GrowingFormations(
            grid, case.most_vehicles, case.most_columns, case.spread_s, Entrances(case.lanes)
        )
        if grows
        else ColumnBlocks(grid, case.most_vehicles, case.spread_s, Entrances(case.lanes))
    )
    entrance = Entrance(grid, builder, case.spread_s, case.interlaced)
    entrance.run(list(case.stream))
    assert {each.arrival for each in entrance.admissions} == set(case.stream)
    check(entrance, case.most_vehicles, case.most_columns if grows else 10)


@pytest.mark.parametrize("bug", ["column-given-twice", "closed-too-early", "columns-forgotten"])
def test_the_check_notices_a_roadside_that_is_wrong(bug: str) -> None:
    """It gives a column to two formations, closes one too early, or leaves columns out."""
    builder = BUGS[bug](lattice(), 6, 7, SPREAD_S, Entrances(3))
    entrance = Entrance(builder.lattice, builder, SPREAD_S)
    stream = [
        Arrival(f"v{number:04d}", number % 3, number % 2, 0.6 * number) for number in range(60)
    ]
    with pytest.raises(AssertionError):
        run_and_check(entrance, stream)
    run_and_check(Entrance(lattice(), growing(), SPREAD_S), stream)


def run_and_check(entrance: Entrance, stream: list[Arrival]) -> None:
    entrance.run(stream)
    check(entrance, 6, 7)


class GivesAColumnTwice(GrowingFormations):
    """The last column of a formation is the first one of the next, too."""

    def _complete_open(self, last_column: int, t_s: float) -> None:
        super()._complete_open(last_column, t_s)
        self.first_open_column += 1


class ClosesTooEarly(GrowingFormations):
    """The census reports a formation as closed when its first vehicle has entered."""

    @property
    def closed_to(self) -> int:
        """All blocks up to the rear of the open formation."""
        rear = 0 if self._open is None else self._open.rear
        return max(super().closed_to, self.lattice.block_of(rear))


class ForgetsColumns(GrowingFormations):
    """A formation ends where its last vehicle is; it gets no columns for sorting."""

    def _length_for(self, vehicles: int) -> int:
        return min(1, vehicles)


BUGS = {
    "column-given-twice": GivesAColumnTwice,
    "closed-too-early": ClosesTooEarly,
    "columns-forgotten": ForgetsColumns,
}


# --- ramps and reserved columns ---------------------------------------------------------------

GAP = 4
RAMP_M = 52.0


@pytest.mark.slow
@pytest.mark.parametrize("grows", [True, False], ids=["growing", "blocks of columns"])
@given(case=cases(), reserve_s=st.lists(st.floats(0.0, 60.0), max_size=3), on_ramp=st.booleans())
@examples(60)
def test_ramps_and_reserved_columns_leave_every_vehicle_in_one_formation(
    case: Case, reserve_s: list[float], *, on_ramp: bool, grows: bool
) -> None:
    """A formation is closed when its columns have passed the ramp; nobody enters a gap."""
    lanes = case.lanes + 1
    entry_m = (RAMP_M if on_ramp else 0.0, *(0.0,) * case.lanes)
    ramps = frozenset({0}) if on_ramp else frozenset[int]()
    entrances = Entrances(case.lanes, ramps, max(entry_m), 2 if on_ramp else 0)
    grid = lattice(lanes, 1 if grows else BLOCK_COLUMNS)
    most = case.most_vehicles if grows else min(case.most_vehicles, max(3 * case.lanes, 1))
    builder: FormationBuilder = (
        GrowingFormations(grid, most, case.most_columns, case.spread_s, entrances)
        if grows
        else ColumnBlocks(grid, most, case.spread_s, entrances)
    )
    points = tuple(EntryPoint(lane, at_m) for lane, at_m in enumerate(entry_m))
    entrance = Entrance(
        grid, builder, case.spread_s, case.interlaced, points, tuple(sorted(reserve_s))
    )
    entrance.run(list(case.stream))
    assert {each.arrival for each in entrance.admissions} == set(case.stream)
    columns = Counter(
        column for closed in entrance.formations for column in closed.columns(grid)
    ) + Counter(column for gap in entrance.reserved for column in gap)
    assert max(columns.values(), default=1) == 1, "a column belongs to two"
    for admission in entrance.admissions:
        assert columns[admission.cell[0]] == 1
        assert not any(admission.cell[0] in gap for gap in entrance.reserved)
    for closed in entrance.formations:
        count, length = len(entrance.members(closed)), len(closed.columns(grid))
        assert count >= 1
        assert not grows or length >= formation_columns(count, case.lanes)
        assert grows or count <= max(most, (length - 1) * case.lanes)


def test_a_formation_keeps_room_for_vehicles_from_a_ramp() -> None:
    entrances = Entrances(3, frozenset({0}), 45.0, 2)
    builder = GrowingFormations(lattice(4), 6, 7, SPREAD_S, entrances)
    assert builder.shortest_length == 4  # 6 and 2 vehicles, 3 free cells, in 3 lanes
    taken = take(builder, *((column, lane, -1) for column in (0, -1) for lane in (1, 2, 3)))
    assert all(taken)
    assert builder.closed(1.0) == [], "the ramp has not passed"
    # A fourth vehicle would leave fewer free cells than there are lanes.
    coming = [(column, 0, -1) for column in (1, 0, -1, -2)]
    assert take(builder, *coming) == [True, True, True, False]
    rear_s = builder.lattice.passing_time_s(-2, 45.0) + SPREAD_S
    assert builder.closed(rear_s - 0.1) == []
    (closed,) = builder.closed(rear_s + 0.1)
    assert (closed.first_block, closed.last_block) == (-1, 2)


def test_a_refused_vehicle_from_a_ramp_makes_the_open_formation_no_longer() -> None:
    entered, refused = ((3, 1, 1), (3, 2, 1), (2, 1, 1)), ((1, 0, 1), (0, 0, 1), (-1, 0, 1))
    closed = []
    for vehicles in (entered, (*entered, *refused)):
        entrances = Entrances(3, frozenset({0}), 45.0, 0)
        builder = GrowingFormations(lattice(3), 6, 7, SPREAD_S, entrances)
        taken = take(builder, *vehicles)
        assert taken == [vehicle in entered for vehicle in vehicles]
        builder.reserve(-1, 1, 10.0)  # completes the open formation
        closed.append(builder.closed(60.0))
    assert closed[0] == closed[1]


def test_a_vehicle_from_a_ramp_enters_also_if_formations_are_short() -> None:
    builder = GrowingFormations(lattice(2), 1, 1, 1.5, Entrances(1, frozenset({0}), 45.0, 0))
    assert take(builder, (-2, 0, -1)) == [True]
    assert sum(len(each.columns(builder.lattice)) for each in builder.closed(60.0)) >= 1


def test_a_vehicle_from_a_ramp_begins_a_formation_where_there_is_none() -> None:
    entrances = Entrances(3, frozenset({0}), 45.0, 2)
    builder = GrowingFormations(lattice(4), 6, 7, SPREAD_S, entrances)
    assert take(builder, (2, 0, -1), (-1, 1, -1)) == [True, True]
    (closed,) = builder.closed(60.0)
    assert (closed.first_block, closed.last_block) == (-3, 3)


# --- lengths that follow the traffic ----------------------------------------------------------


def take(builder: GrowingFormations, *vehicles: tuple[int, int, int]) -> list[bool]:
    """Let vehicles (column, lane, preferred lane) enter as their cells pass."""
    return [
        builder.try_add((column, lane), preferred, builder.lattice.passing_time_s(column))
        for column, lane, preferred in vehicles
    ]


def columns(builder: GrowingFormations, t_s: float = 0.0) -> list[tuple[int, int]]:
    """Return the foremost and the rear column of each formation closed since the last call."""
    found = [closed.columns(builder.lattice) for closed in builder.closed(t_s)]
    return [(each[-1], each[0]) for each in found]


def test_a_formation_is_closed_when_it_has_its_most_vehicles() -> None:
    builder = growing()
    taken = take(builder, (0, 0, 0), (0, 1, 1), (-1, 2, 2), (-2, 0, 1), (-3, 1, 2))
    assert all(taken)
    assert (columns(builder), builder.closed_to) == ([], -1)
    assert take(builder, (-3, 2, 0)) == [True]
    (closed,) = builder.closed(0.0)
    assert closed == ClosedFormation(0, 3, builder.lattice.passing_time_s(-3))
    assert (builder.closed_to, builder.first_open_column) == (3, -4)
    # Its columns belong to no other formation.
    assert take(builder, (-3, 0, 0), (-4, 0, 0)) == [False, True]


def test_a_formation_in_two_rows_gets_a_free_column() -> None:
    builder = growing()
    take(builder, *((column, lane, lane) for column in (0, -1) for lane in range(3)))
    assert columns(builder) == [(0, -2)]
    assert builder.closed_to == 2


def test_a_formation_is_closed_before_it_asks_for_more_places_on_a_lane_than_the_shortest_has() -> (
    None
):
    builder = growing()
    assert builder.shortest_length == 3
    take(builder, (0, 0, 1), (-1, 1, 1), (-2, 2, 1), (-3, 0, 0))
    assert take(builder, (-3, 1, 1)) == [False]
    assert columns(builder) == [(0, -3)]
    assert take(builder, (-4, 1, 1)) == [True]


def test_with_as_many_columns_as_vehicles_prefer_a_lane() -> None:
    """Two vehicles beside each other want the same lane: one of them needs another column."""
    builder = growing(lanes=6)
    take(builder, *((0, lane, 5) for lane in range(2)), *((0, lane, lane) for lane in (2, 3, 4)))
    assert take(builder, (0, 5, 5)) == [False]  # the shortest has two
    assert columns(builder) == [(0, -1)]


def test_a_formation_is_closed_at_its_greatest_length() -> None:
    """Few vehicles do not wait for each other, and are not reported too early."""
    builder = growing()
    assert take(builder, (-20, 1, 0)) == [True]
    # On another lane a vehicle may still enter a column further ahead.
    rear_s = builder.lattice.passing_time_s(-19 - 6) + SPREAD_S
    assert columns(builder, rear_s - 0.01) == []
    (closed,) = builder.closed(rear_s + 3.0)
    assert closed == ClosedFormation(19, 25, rear_s)
    assert builder.closed_to == 25


def test_a_vehicle_behind_the_maximum_length_begins_another_formation() -> None:
    builder = growing()
    assert take(builder, (-20, 1, 0), (-26, 0, 0)) == [True, True]
    assert columns(builder) == [(-19, -25)]
    assert columns(builder, 100.0) == [(-26, -32)]


def test_columns_without_vehicles_belong_to_no_formation() -> None:
    builder = growing()
    assert columns(builder, 100.0) == []
    assert builder.closed_to == -1
    take(builder, (-20, 1, 0))
    columns(builder, 100.0)
    take(builder, (-50, 1, 0))
    assert columns(builder, 100.0) == [(-49, -55)]
    assert builder.closed_to == 55


def test_on_one_lane_a_formation_needs_no_free_column() -> None:
    builder = growing(lanes=1)
    assert builder.shortest_length == 6
    take(builder, *((-column, 0, 0) for column in range(6)))
    assert columns(builder) == [(0, -5)]


# --- blocks of columns ------------------------------------------------------------------------


def test_a_block_is_closed_when_its_last_column_has_passed() -> None:
    grid = lattice(block_columns=BLOCK_COLUMNS)
    builder = ColumnBlocks(grid, 6, 1.5, Entrances(3))
    assert builder.try_add((-1, 1), 0, 1.0)
    assert builder.try_add((-9, 1), 0, 9.0)
    assert builder.closed(4.4) == []
    assert builder.closed_to == -1
    assert builder.closed(4.5) == [ClosedFormation(0, 0, 4.5)]
    assert builder.closed(8.5) == []  # block 1 is empty
    assert builder.closed_to == 1
    assert builder.closed(13.0) == [ClosedFormation(2, 2, 12.5)]
    assert not builder._vehicles


# --- which one a scenario has -----------------------------------------------------------------


def test_the_scenario_selects_the_builder() -> None:
    grows = formation_builder(Scenario())
    assert isinstance(grows, GrowingFormations)
    assert (grows.max_vehicles, grows.max_columns, grows.spread_s) == (6, 7, 0.75)
    blocks = formation_builder(PAPER)
    assert isinstance(blocks, ColumnBlocks)
    assert (blocks.max_vehicles, blocks.lattice.block_columns, blocks.spread_s) == (6, 4, 1.5)


@pytest.mark.parametrize(("max_columns", "length"), [(7, 4), (3, 3)])
def test_vehicles_that_cannot_change_columns_get_one_more(max_columns: int, length: int) -> None:
    """Six vehicles in three lanes need three columns."""
    for truck, expected in ((None, 3), (2, length)):
        builder = GrowingFormations(lattice(3), 6, max_columns, 0.0, Entrances(3))
        for number in range(6):
            column, lane = -(number // 3), number % 3
            passing_s = builder.lattice.passing_time_s(column)
            is_truck = number == truck
            assert builder.try_add((column, lane), lane, passing_s, column_bound=is_truck)
        (closed,) = builder.closed(60.0)
        assert len(closed.columns(builder.lattice)) == expected
