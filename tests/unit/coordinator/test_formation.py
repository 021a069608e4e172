"""Which formations are closed, when they may start, and which cells they go to."""

from __future__ import annotations

import pytest
from attrs import evolve
from hypothesis import given
from hypothesis import strategies as st

from laneweave.coordinator.formation import (
    closed_formations,
    parallel_targets,
    plan_request,
    start_time_s,
    steps_left,
)
from laneweave.protocol.lattice import Cell
from laneweave.protocol.messages import Census, CensusEntry, Name
from laneweave.protocol.scenario import FormationSettings, Road, Scenario

SCENARIO = Scenario()
LATTICE = SCENARIO.lattice
CLOSES_S = LATTICE.passing_time_s(LATTICE.block_range(0)[0])
"""When the rear column of block 0 passes the start of the road: 3 s."""


def census(t_s: float, **cells: Cell) -> Census:
    entries = tuple(CensusEntry(Name(name), cell, 0, 0.0) for name, cell in cells.items())
    return Census(t_s, entries, ())


def test_a_formation_closes_when_its_block_has_passed() -> None:
    now = census(CLOSES_S, a=(0, 0))
    assert closed_formations(now, CLOSES_S, SCENARIO) == {}
    later = CLOSES_S + 0.1
    assert closed_formations(census(later, a=(0, 0)), later, SCENARIO)[0].roster == ("a",)


@pytest.mark.parametrize(("census_s", "clock_s"), [(3.0, 9.0), (9.0, 3.0)])
def test_neither_an_old_census_nor_an_old_clock_closes_it(census_s: float, clock_s: float) -> None:
    """A census from before the block passed could lack a member."""
    assert closed_formations(census(census_s, a=(0, 0)), clock_s, SCENARIO) == {}


def test_members_are_grouped_by_the_block_of_their_entry_and_sorted() -> None:
    found = closed_formations(census(8.0, d=(-4, 0), b=(-3, 1), a=(-1, 1), c=(0, 2)), 8.0, SCENARIO)
    assert {number: formation.roster for number, formation in found.items()} == {
        0: ("a", "b", "c"),
        1: ("d",),
    }
    assert 1 not in closed_formations(census(6.9, d=(-4, 0)), 6.9, SCENARIO)


def test_who_leaves_is_no_member_and_an_empty_formation_is_none() -> None:
    assert closed_formations(census(50.0, a=(0, 0), b=(-1, 1)), 50.0, SCENARIO)[0].roster == (
        "a",
        "b",
    )
    assert closed_formations(census(60.0, b=(-1, 1)), 60.0, SCENARIO)[0].roster == ("b",)
    assert closed_formations(census(70.0), 70.0, SCENARIO) == {}


@given(
    number=st.integers(0, 50),
    gap_m=st.sampled_from([12.0, 15.0, 20.0]),
    sorting_m=st.floats(0.0, 900.0),
    not_before_s=st.floats(0.0, 1000.0),
)
def test_nobody_changes_lanes_before_the_rear_body_is_in_s3(
    number: int, gap_m: float, sorting_m: float, not_before_s: float
) -> None:
    scenario = Scenario(
        road=Road(s1_m=0.0, s2_m=sorting_m), formation=FormationSettings(gap_m=gap_m)
    )
    lattice, tick_s = scenario.lattice, scenario.runtime.tick_s
    start_s = start_time_s(number, not_before_s, scenario)
    assert start_s >= not_before_s - 1e-6
    rear_bumper_m = (
        lattice.cell_s_m(lattice.block_range(number)[0], start_s) - scenario.vehicle.length_m
    )
    assert rear_bumper_m >= sorting_m - 1e-3
    assert abs(start_s / tick_s - round(start_s / tick_s)) < 1e-6
    # It is the earliest tick of that kind.
    assert start_s - tick_s < not_before_s or rear_bumper_m - 15.0 * tick_s < sorting_m + 1e-3


def test_steps_left() -> None:
    front_leaves_s = SCENARIO.road.length_m / SCENARIO.formation.speed_mps
    assert steps_left(0, front_leaves_s, SCENARIO) == 0
    assert steps_left(0, front_leaves_s + 100.0, SCENARIO) == 0
    assert steps_left(0, front_leaves_s - 4.0, SCENARIO) == 1
    assert steps_left(0, front_leaves_s - 11.9, SCENARIO) == 2
    assert steps_left(1, front_leaves_s, SCENARIO) == 1  # the next block is a slot behind


@given(
    cells=st.lists(
        st.tuples(st.integers(0, 7), st.integers(0, 2)), min_size=0, max_size=8, unique=True
    ),
    lane=st.integers(0, 2),
)
def test_targets_are_as_many_as_vehicles_contiguous_and_inside(
    cells: list[Cell], lane: int
) -> None:
    targets = parallel_targets(lane, cells, 8)
    assert len(targets) == len(cells)
    assert {target[1] for target in targets} <= {lane}
    columns = [target[0] for target in targets]
    assert columns == list(range(columns[0], columns[0] + len(columns))) if columns else True
    assert all(0 <= column < 8 for column in columns)


def test_targets_are_where_the_ways_are_short() -> None:
    assert parallel_targets(1, [(2, 1), (3, 1)], 8) == [(2, 1), (3, 1)]
    assert parallel_targets(1, [(6, 0), (7, 2)], 8) == [(6, 1), (7, 1)]
    assert parallel_targets(0, [], 8) == []


def test_more_vehicles_than_cells_get_all_cells_of_the_lane() -> None:
    cells = [(column, lane) for column in range(2) for lane in range(2)]
    assert parallel_targets(0, cells, 2) == [(0, 0), (1, 0)]


def test_the_request_is_in_the_blocks_own_columns() -> None:
    cells: dict[Name, Cell] = {Name("b"): (-4, 0), Name("a"): (-7, 1)}
    request = plan_request(1, cells, {Name("a"): 0, Name("b"): 2}, SCENARIO)
    assert [(v.id, v.cell, v.lane) for v in request.vehicles] == [
        ("b", (3, 0), 2),
        ("a", (0, 1), 0),
    ]
    assert (request.grid.columns, request.grid.lanes) == (4, 3)
    assert sorted(lane for _, lane in request.targets) == [0, 2]
    assert request.mode == SCENARIO.formation.mode
    assert request.conflicts == SCENARIO.formation.conflict_kinds


def test_the_request_follows_the_scenario() -> None:
    scenario = evolve(SCENARIO, formation=FormationSettings(mode=2, planning_deadline_s=1.5))
    request = plan_request(0, {Name("a"): (0, 0)}, {Name("a"): 1}, scenario)
    assert (request.mode, request.conflicts, request.deadline_s) == (2, ("geometric",), 1.5)
