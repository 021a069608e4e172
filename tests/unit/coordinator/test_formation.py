"""Which formations are closed, who belongs to them, and when they may start."""

from __future__ import annotations

import pytest
from attrs import evolve
from hypothesis import given
from hypothesis import strategies as st

from laneweave.coordinator.formation import (
    Formation,
    closed_formations,
    closing_time_s,
    start_time_s,
    steps_left,
)
from laneweave.coordinator.groups import Groups
from laneweave.protocol.lattice import Cell
from laneweave.protocol.messages import Census, CensusEntry, Name
from laneweave.protocol.scenario import FormationSettings, Road, Scenario
from paper import FORMATIONS, PAPER

SCENARIO = PAPER
LATTICE = SCENARIO.lattice
CLOSES_S = closing_time_s((0,), SCENARIO)
"""A column after the rear one of block 0 passes the start of the road, which it does at 3 s."""


def census(t_s: float, **cells: Cell) -> Census:
    entries = tuple(CensusEntry(Name(name), cell, 0, 0.0) for name, cell in cells.items())
    return Census(t_s, entries, ())


def closed(
    seen: Census, t_s: float | None = None, groups: Groups | None = None
) -> dict[int, Formation]:
    return closed_formations(seen, seen.t_s if t_s is None else t_s, SCENARIO, groups or Groups())


def joined(*numbers: int) -> Groups:
    groups = Groups()
    groups.join(numbers)
    return groups


def test_a_formation_closes_when_nobody_can_enter_its_block_any_more() -> None:
    assert CLOSES_S == 4.5
    assert closed(census(CLOSES_S, a=(0, 0))) == {}
    assert closed(census(CLOSES_S + 0.1, a=(0, 0)))[0].roster == ("a",)


@pytest.mark.parametrize(("census_s", "clock_s"), [(4.5, 9.0), (9.0, 4.5)])
def test_neither_an_old_census_nor_an_old_clock_closes_it(census_s: float, clock_s: float) -> None:
    """A census from before the block passed could lack a member."""
    assert closed(census(census_s, a=(0, 0)), clock_s) == {}


def test_members_are_grouped_by_the_block_of_their_entry_and_sorted() -> None:
    found = closed(census(8.6, d=(-4, 0), b=(-3, 1), a=(-1, 1), c=(0, 2)))
    assert {number: (each.numbers, each.roster) for number, each in found.items()} == {
        0: ((0,), ("a", "b", "c")),
        1: ((1,), ("d",)),
    }
    assert 1 not in closed(census(8.5, d=(-4, 0)))


def test_who_leaves_is_no_member_and_an_empty_formation_is_none() -> None:
    assert closed(census(50.0, a=(0, 0), b=(-1, 1)))[0].roster == ("a", "b")
    assert closed(census(60.0, b=(-1, 1)))[0].roster == ("b",)
    assert closed(census(70.0)) == {}


def test_joined_formations_are_one_under_the_least_number() -> None:
    seen = census(16.0, a=(0, 0), b=(-5, 1), c=(-4, 0), d=(-9, 1))
    found = closed(seen, groups=joined(0, 1))
    assert {number: (each.numbers, each.roster) for number, each in found.items()} == {
        0: ((0, 1), ("a", "b", "c")),
        2: ((2,), ("d",)),
    }


def test_joined_formations_are_closed_when_the_last_block_has_passed() -> None:
    both = census(8.5, a=(0, 0), b=(-5, 1))
    assert closed(both, groups=joined(0, 1)) == {}
    assert closed(both) != {}
    later = census(8.6, a=(0, 0), b=(-5, 1))
    assert closed(later, groups=joined(0, 1))[0].roster == ("a", "b")
    # Also when nobody of the last block has entered yet, or its vehicles have left.
    assert closed(census(8.5, a=(0, 0)), groups=joined(0, 1)) == {}
    assert closed(census(8.6, a=(0, 0)), groups=joined(0, 1))[0].numbers == (0, 1)
    assert closed(census(8.6, b=(-5, 1)), groups=joined(0, 1))[0].roster == ("b",)


@given(st.lists(st.integers(0, 9), min_size=1, max_size=4, unique=True))
def test_closing_is_one_and_a_half_columns_after_the_rear_one_of_the_last_block(
    numbers: list[int],
) -> None:
    several = tuple(sorted(numbers))
    closes_s = closing_time_s(several, SCENARIO)
    assert closes_s == max(closing_time_s((number,), SCENARIO) for number in several)
    rear = min(column for number in several for column in LATTICE.block_range(number))
    assert LATTICE.cell_s_m(rear, closes_s) == pytest.approx(1.5 * LATTICE.pitch_m)


def test_a_rolling_formation_closes_half_a_column_after_its_rear_one() -> None:
    rolling = Scenario(formation=FormationSettings(operation="rolling"))
    assert closing_time_s((0,), rolling) == 3.5


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
        road=Road(s1_m=0.0, s2_m=sorting_m), formation=evolve(FORMATIONS, gap_m=gap_m)
    )
    lattice, tick_s = scenario.lattice, scenario.runtime.tick_s
    start_s = start_time_s((number,), not_before_s, scenario)
    assert start_s >= not_before_s - 1e-6
    rear_bumper_m = (
        lattice.cell_s_m(lattice.block_range(number)[0], start_s) - scenario.vehicle.length_m
    )
    assert rear_bumper_m >= sorting_m - 1e-3
    assert abs(start_s / tick_s - round(start_s / tick_s)) < 1e-6
    # It is the earliest tick of that kind.
    assert start_s - tick_s < not_before_s or rear_bumper_m - 15.0 * tick_s < sorting_m + 1e-3


def test_joined_formations_start_with_the_last_one() -> None:
    assert start_time_s((2, 3), 0.0, SCENARIO) == start_time_s((3,), 0.0, SCENARIO)
    assert start_time_s((2, 3), 0.0, SCENARIO) > start_time_s((2,), 0.0, SCENARIO)


def test_steps_left() -> None:
    front_leaves_s = SCENARIO.road.length_m / SCENARIO.formation.speed_mps
    assert steps_left((0,), front_leaves_s, SCENARIO) == 0
    assert steps_left((0,), front_leaves_s + 100.0, SCENARIO) == 0
    assert steps_left((0,), front_leaves_s - 4.0, SCENARIO) == 1
    assert steps_left((0,), front_leaves_s - 11.9, SCENARIO) == 2
    assert steps_left((1,), front_leaves_s, SCENARIO) == 1  # the next block is a slot behind
    assert steps_left((0, 1), front_leaves_s, SCENARIO) == 0  # the first of several counts
