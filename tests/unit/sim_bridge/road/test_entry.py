"""The entry meter keeps its rules for any demand, and decides without looking ahead."""

from __future__ import annotations

import math
from collections import Counter
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from laneweave.protocol.config.scenario_files import parse_scenario
from laneweave.protocol.lattice import Lattice
from laneweave.protocol.road_layout import ANY_LANE
from laneweave.sim_bridge.road.demand import Arrival, arrivals
from laneweave.sim_bridge.road.entry import Admission, EntryMeter, Goals
from laneweave.sim_bridge.road.formation_building import ColumnBlocks, Entrances
from support.examples import examples

COLUMN_S, SMALL_S = 1.0, 1e-6


def lattice(lanes: int = 3, block_columns: int = 4) -> Lattice:
    return Lattice(15.0, 15.0, 3.5, lanes, block_columns)


@st.composite
def demands(draw: st.DrawFn) -> tuple[Lattice, int, list[Arrival]]:
    """A lattice, a formation size, and any demand, dense enough to queue."""
    lanes = draw(st.integers(1, 5))
    grid = lattice(lanes, draw(st.integers(1, 6)))
    drawn = draw(
        st.lists(
            st.tuples(st.floats(0, 60), st.integers(0, lanes - 1), st.integers(0, lanes - 1)),
            max_size=60,
        )
    )
    stream = [
        Arrival(f"v{number:04d}", lane, preferred, t_s)
        for number, (t_s, lane, preferred) in enumerate(sorted(drawn), start=1)
    ]
    return grid, draw(st.integers(1, 12)), stream


def interlaced_meter(grid: Lattice, most: int = 6, spread_s: float = 0.0) -> EntryMeter:
    """Return the meter of the paper's operation."""
    builder = ColumnBlocks(grid, most, spread_s, Entrances(grid.lanes))
    return EntryMeter(grid, spread_s, builder, interlaced=True)


def check(grid: Lattice, spread_s: float, admissions: list[Admission]) -> None:
    """Check the rules of every entry."""
    assert len({admission.cell for admission in admissions}) == len(admissions)
    for admission in admissions:
        column, lane = admission.cell
        passing_s = grid.passing_time_s(column)
        assert lane == admission.arrival.lane
        assert abs(passing_s - admission.t_s) <= spread_s + SMALL_S
        assert admission.offset_m == pytest.approx(15.0 * (passing_s - admission.t_s))
        assert admission.t_s >= admission.arrival.t_s
    assert [a.t_s for a in admissions] == sorted(a.t_s for a in admissions)
    for lane in range(grid.lanes):
        mine = [admission for admission in admissions if admission.cell[1] == lane]
        for first, second in pairwise(mine):
            assert second.cell[0] < first.cell[0]
            assert second.t_s >= first.t_s + COLUMN_S - SMALL_S
            assert second.arrival.t_s >= first.arrival.t_s


@given(
    demands(), st.sampled_from([(0.0, True), (0.25, True), (1.0, True), (0.5, False), (0.7, False)])
)
@examples(250)
def test_rules_hold_and_everyone_enters(
    case: tuple[Lattice, int, list[Arrival]], how: tuple[float, bool]
) -> None:
    (grid, most, stream), (spread_s, interlaced) = case, how
    meter = interlaced_meter(grid, most, spread_s) if interlaced else EntryMeter(grid, spread_s)
    for arrival in stream:
        meter.demand(arrival)
    admissions = meter.admit(60.0 + 10.0 * grid.block_columns * len(stream) + 10.0)
    check(grid, spread_s, admissions)
    assert {admission.arrival for admission in admissions} == set(stream)
    assert meter.waiting == ()
    if interlaced:
        assert all(grid.interlaced(admission.cell) for admission in admissions)
        blocks = [grid.block_of(admission.cell[0]) for admission in admissions]
        assert all(count <= most for count in Counter(blocks).values())
        wishes = (admission.arrival.preferred_lane for admission in admissions)
        preferring = Counter(zip(blocks, wishes, strict=True))
        assert all(count <= grid.block_columns for count in preferring.values())


@given(demands(), st.floats(0.05, 7.0))
@examples(100)
def test_decisions_need_no_knowledge_of_the_future(
    case: tuple[Lattice, int, list[Arrival]], tick_s: float
) -> None:
    grid, most, stream = case
    whole, stepwise = interlaced_meter(grid, most), interlaced_meter(grid, most)
    for arrival in stream:
        whole.demand(arrival)
    end_s = 120.0
    expected = whole.admit(end_s)
    admissions = []
    pending = list(stream)
    for number in range(int(end_s / tick_s) + 2):
        now_s = min(number * tick_s, end_s)
        while pending and pending[0].t_s <= now_s + 1e-9:
            stepwise.demand(pending.pop(0))
        admissions += stepwise.admit(now_s)
    assert admissions == expected


def test_a_vehicle_takes_the_first_interlaced_cell_that_it_can_reach() -> None:
    meter = interlaced_meter(lattice())
    meter.demand(Arrival("early", 0, 0, 0.0))
    meter.demand(Arrival("later", 1, 0, 0.2))
    meter.demand(Arrival("behind", 0, 0, 0.1))
    found = {a.arrival.vehicle: a for a in meter.admit(10.0)}
    assert found["early"].cell == (0, 0)
    assert found["later"].cell == (-1, 1)
    assert found["behind"].cell == (-2, 0)
    assert found["behind"].t_s == 2.0
    assert found["behind"].t_s - found["behind"].arrival.t_s == pytest.approx(1.9)


@pytest.mark.parametrize(
    ("block_columns", "most", "rows", "preferred_lane", "by_block"),
    [(4, 6, 2, 1, [4, 2]), (8, 5, 4, None, [5, 5, 2]), (4, 12, 4, None, [6, 6])],
    ids=["four cells of a lane", "largest formation", "interlaced cells of the paper's block"],
)
def test_a_block_takes_no_more_than_it_has_room_for(
    block_columns: int, most: int, rows: int, preferred_lane: int | None, by_block: list[int]
) -> None:
    grid = lattice(block_columns=block_columns)
    meter = interlaced_meter(grid, most)
    for number in range(rows):
        for lane in range(3):
            preferred = lane if preferred_lane is None else preferred_lane
            meter.demand(Arrival(f"{number}-{lane}", lane, preferred, 0.0))
    blocks = Counter(grid.block_of(entry.cell[0]) for entry in meter.admit(100.0))
    assert list(blocks.values()) == by_block


def test_a_late_demand_takes_no_column_that_has_passed() -> None:
    meter = interlaced_meter(lattice())
    assert meter.admit(5.0) == []
    meter.demand(Arrival("late", 0, 0, 1.0))
    (admission,) = meter.admit(20.0)
    assert admission.cell == (-6, 0)
    assert admission.t_s == 6.0


@pytest.mark.parametrize(("passes_parts", "expected"), [(False, [0, 2]), (True, [0])])
def test_a_gap_in_a_lane_past_a_closed_part_leaves_its_columns_less_room(
    passes_parts: bool, expected: list[int]
) -> None:
    grid = lattice()
    meter = EntryMeter(grid, 0.0)
    meter.most_in_column = 2
    kept = meter.keep_free(1, 1, 0.0, passes_parts=passes_parts)
    for lane in (0, 2):
        meter.demand(Arrival(f"v{lane}", lane, lane, 0.0))

    entered = meter.admit(0.0)

    assert [one.cell for one in entered] == [(kept.start, lane) for lane in expected]


def test_impossible_demands_are_refused() -> None:
    meter = interlaced_meter(lattice())
    meter.demand(Arrival("twice", 0, 0, 0.0))
    with pytest.raises(ValueError, match="already waiting"):
        meter.demand(Arrival("twice", 1, 0, 0.0))
    with pytest.raises(ValueError, match="an entry point of its lane"):
        meter.demand(Arrival("off", 3, 0, 0.0))
    with pytest.raises(ValueError, match="an entry point of its lane"):
        meter.demand(Arrival("off", 1, 0, 0.0, entry_point=0))
    with pytest.raises(ValueError, match="lanes 0 to 2"):
        meter.demand(Arrival("off", 0, -2, 0.0))


@pytest.mark.parametrize(("volume", "most_s"), [(1000.0, 1.5), (1450.0, 2.5), (1600.0, 4.0)])
def test_delay_stays_small_below_capacity(volume: float, most_s: float) -> None:
    demand = {"volume_veh_per_lane_h": volume, "duration_s": 600.0}
    scenario = parse_scenario({"demand": demand, "formation": {"operation": "paper"}})
    meter = interlaced_meter(scenario.lattice, scenario.formation.max_vehicles)
    stream = arrivals(scenario)
    for arrival in stream:
        meter.demand(arrival)
    delays = [entry.t_s - entry.arrival.t_s for entry in meter.admit(700.0)]
    assert len(delays) == len(stream)
    assert sum(delays) / len(delays) < most_s


def truck(name: str, t_s: float, lane: int, preferred: int) -> Arrival:
    return Arrival(name, lane, preferred, t_s, vehicle_type="truck")


@pytest.mark.parametrize(
    ("first", "second", "together"),
    [
        ((0, 2), (2, 0), False),
        ((0, 1), (2, 1), False),
        ((0, 0), (2, 2), True),
        ((0, 1), (2, 2), True),
        ((0, ANY_LANE), (2, 0), False),
        ((0, ANY_LANE), (2, 1), True),
        ((0, ANY_LANE), (2, ANY_LANE), True),
    ],
)
def test_trucks_that_would_have_to_pass_each_other_enter_in_different_columns(
    first: tuple[int, int], second: tuple[int, int], *, together: bool
) -> None:
    for types, bound in (({"truck"}, True), ({"bus"}, False)):
        meter = EntryMeter(lattice(), 0.5, column_bound=types)
        meter.demand(truck("a", 10.0, *first))
        meter.demand(truck("b", 10.0, *second))
        one, other = meter.admit(20.0)
        assert (one.cell[0] == other.cell[0]) == (together or not bound)
        assert other.cell[0] >= one.cell[0] - 1


def test_trucks_enter_a_column_only_if_the_road_has_lanes_for_all_of_them() -> None:
    # Lane 0 ends: three trucks side by side could not drive on in two lanes.
    meter = EntryMeter(
        lattice(), 0.5, column_bound={"truck"}, goals_of=lambda _: Goals((1, 2), math.inf)
    )
    for lane in range(3):
        meter.demand(truck(f"v{lane}", 10.0, lane, ANY_LANE))
    columns = [one.cell[0] for one in meter.admit(20.0)]
    assert sorted(columns, reverse=True) == [columns[0], columns[0], columns[0] - 1]
    # A single truck enters in any case.
    meter = EntryMeter(
        lattice(), 0.5, column_bound={"truck"}, goals_of=lambda _: Goals((), math.inf)
    )
    meter.demand(truck("a", 10.0, 0, 0))
    assert len(meter.admit(20.0)) == 1


def test_a_truck_that_enters_a_later_column_takes_one_place_in_its_formation() -> None:
    grid = lattice(block_columns=4)
    builder = ColumnBlocks(grid, 2, 0.5, Entrances(grid.lanes))
    meter = EntryMeter(grid, 0.5, builder, column_bound={"truck"})
    meter.demand(truck("a", 10.0, 0, 2))
    meter.demand(truck("b", 10.0, 2, 0))
    one, other = meter.admit(20.0)
    assert one.cell[0] != other.cell[0]
    assert grid.block_of(one.cell[0]) == grid.block_of(other.cell[0])


@pytest.mark.parametrize("pitch_m", [15.0, 19.3, 20.0])
def test_a_queue_of_trucks_uses_every_cell(pitch_m: float) -> None:
    grid = Lattice(pitch_m, 15.0, 3.5, 1, 4)
    meter = EntryMeter(grid, 0.5, column_bound={"truck"})
    for number in range(200):
        meter.demand(truck(f"v{number}", 0.0, 0, 0))
    columns = [one.cell[0] for one in meter.admit(1000.0)]
    assert columns == list(range(columns[0], columns[0] - 200, -1))


@given(st.lists(st.floats(0.0, 60.0), min_size=1, max_size=30), st.integers(0, 2**20))
@examples(60)
def test_trucks_enter_exactly_in_their_cells(times_s: list[float], bits: int) -> None:
    meter = EntryMeter(lattice(), 0.5, column_bound={"truck"})
    for number, t_s in enumerate(sorted(times_s)):
        kind = "truck" if bits >> number & 1 else "car"
        meter.demand(Arrival(f"v{number}", 0, 0, t_s, vehicle_type=kind))
    admissions = meter.admit(1000.0)
    check(lattice(), 0.5, admissions)
    assert len(admissions) == len(times_s)
    trucks = [one for one in admissions if one.arrival.vehicle_type == "truck"]
    assert all(one.offset_m == pytest.approx(0.0, abs=1e-6) for one in trucks)
