"""Which formations are closed, who belongs to them, and when they may start."""

from __future__ import annotations

import pytest
from attrs import evolve
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from laneweave.coordinator.formations.roster import (
    Formation,
    Groups,
    Numbers,
    closed_formations,
    exit_time_s,
    start_time_s,
    steps_left,
)
from laneweave.coordinator.formations.stages import stages
from laneweave.protocol.lattice import Cell
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.road_tables import Road
from laneweave.protocol.wire.messages import Census, CensusEntry, ClosedFormation, Name
from support.paper import FORMATIONS, PAPER, closed_blocks, closing_time_s

SCENARIO = PAPER
GROWING = Scenario()
"""Blocks are single columns, of which each formation has several."""
LATTICE = SCENARIO.lattice
CLOSES_S = closing_time_s(0)
"""A column and a half after the rear one of block 0 passes the start of the road, at 3 s."""
NOW_S = 50.0


def entries_of(**cells: Cell) -> tuple[CensusEntry, ...]:
    return tuple(CensusEntry(Name(name), cell, 0, 0.0) for name, cell in cells.items())


def formation_of(
    numbers: Numbers,
    members: tuple[CensusEntry, ...],
    closed_s: float,
    joined: int = 1,
    deserted: Numbers = (),
) -> Formation:
    """Return a formation whose members all prefer lane 0, on a road with one stage."""
    goals = (frozenset({0}),) * len(members)
    (stage,) = stages(PAPER if numbers == (0,) else GROWING)
    return Formation(numbers, members, closed_s, joined, deserted, stage, goals)


def census(t_s: float, **cells: Cell) -> Census:
    """Return what the roadside of the paper's operation tells."""
    entries = entries_of(**cells)
    return Census(t_s, entries, (), *closed_blocks(entries, t_s))


def closed(seen: Census, groups: Groups | None = None) -> dict[int, Formation]:
    return closed_formations(seen, NOW_S, SCENARIO, groups or Groups())


def joined(*numbers: int) -> Groups:
    groups = Groups()
    groups.join(numbers)
    return groups


def test_a_formation_closes_when_no_vehicle_can_enter_its_block() -> None:
    assert CLOSES_S == 4.5
    assert closed(census(CLOSES_S - 0.1, a=(0, 0))) == {}
    (formation,) = closed(census(CLOSES_S, a=(0, 0))).values()
    assert formation == formation_of((0,), entries_of(a=(0, 0)), CLOSES_S)


def test_members_are_grouped_by_the_block_of_their_entry_and_sorted() -> None:
    found = closed(census(8.5, d=(-4, 0), b=(-3, 1), a=(-1, 1), c=(0, 2)))
    assert {number: (each.numbers, each.roster) for number, each in found.items()} == {
        0: ((0,), ("a", "b", "c")),
        1: ((1,), ("d",)),
    }
    assert 1 not in closed(census(8.4, d=(-4, 0)))


def test_joined_formations_are_one_under_the_least_number() -> None:
    seen = census(16.0, a=(0, 0), b=(-5, 1), c=(-4, 0), d=(-9, 1))
    found = closed(seen, groups=joined(0, 1))
    assert {number: (each.numbers, each.roster) for number, each in found.items()} == {
        0: ((0, 1), ("a", "b", "c")),
        2: ((2,), ("d",)),
    }


def test_joined_formations_are_closed_when_the_last_block_has_passed() -> None:
    both = census(8.4, a=(0, 0), b=(-5, 1))
    assert closed(both, groups=joined(0, 1)) == {}
    assert closed(both) != {}
    later = census(8.5, a=(0, 0), b=(-5, 1))
    assert closed(later, groups=joined(0, 1))[0].roster == ("a", "b")
    # Also when nobody of the last block has entered yet, or its vehicles have left.
    assert closed(census(8.4, a=(0, 0)), groups=joined(0, 1)) == {}
    assert closed(census(8.5, a=(0, 0)), groups=joined(0, 1))[0].numbers == (0, 1)
    assert closed(census(8.5, b=(-5, 1)), groups=joined(0, 1))[0].roster == ("b",)


def test_a_formation_has_all_of_its_blocks_and_is_planned_only_as_a_whole() -> None:
    """The census says which blocks are whose."""
    formations = (ClosedFormation(0, 3, 3.0), ClosedFormation(4, 6, 9.0))
    seen = Census(9.0, entries_of(d=(-6, 1), a=(0, 0), c=(-4, 2), b=(-2, 2)), (), formations, 6)
    assert closed_formations(seen, NOW_S, GROWING, Groups()) == {
        0: formation_of((0, 1, 2, 3), entries_of(a=(0, 0), b=(-2, 2)), 3.0),
        4: formation_of((4, 5, 6), entries_of(c=(-4, 2), d=(-6, 1)), 9.0),
    }
    assert list(closed_formations(replace(seen, closed_to=5), NOW_S, GROWING, Groups())) == [0]


def test_joined_formations_have_the_blocks_of_all_and_the_latest_closing() -> None:
    """Also when a vehicle has told only that two of their blocks are joined."""
    formations = (ClosedFormation(0, 3, 3.0), ClosedFormation(4, 6, 9.0))
    seen = Census(9.0, entries_of(a=(0, 0), c=(-4, 2)), (), formations, 6)
    assert closed_formations(seen, NOW_S, GROWING, joined(3, 4)) == {
        0: formation_of(tuple(range(7)), entries_of(a=(0, 0), c=(-4, 2)), 9.0, joined=2)
    }
    assert closed_formations(replace(seen, closed_to=5), NOW_S, GROWING, joined(3, 4)) == {}


def test_what_the_census_has_told_of_a_formation_is_remembered() -> None:
    """It stays joined with another one that has left, as its vehicles know."""
    groups, both = Groups(), (ClosedFormation(0, 1, 3.0), ClosedFormation(2, 3, 5.0))
    closed_formations(
        Census(5.0, entries_of(a=(0, 0), b=(-2, 0)), (), both, 3), NOW_S, GROWING, groups
    )
    groups.join((1, 2))
    later = Census(50.0, entries_of(b=(-2, 0)), (), both[1:], 3)
    assert closed_formations(later, NOW_S, GROWING, groups) == {
        0: formation_of((0, 1, 2, 3), entries_of(b=(-2, 0)), 5.0, deserted=(0, 1))
    }


@given(st.lists(st.integers(0, 9), min_size=1, max_size=4, unique=True))
def test_closing_is_one_and_a_half_columns_after_the_rear_one_of_the_last_block(
    numbers: list[int],
) -> None:
    cells = {f"v{number}": (LATTICE.block_range(number)[-1], 0) for number in numbers}
    (formation,) = closed(census(1000.0, **cells), joined(*numbers)).values()
    rear = LATTICE.block_range(max(numbers))[0]
    assert LATTICE.cell_s_m(rear, formation.closed_s) == pytest.approx(1.5 * LATTICE.pitch_m)


@given(
    cells=st.lists(st.tuples(st.integers(-200, 0), st.integers(0, 2)), min_size=1, max_size=6),
    gap_m=st.sampled_from([12.0, 15.0, 20.0]),
    sorting_m=st.floats(0.0, 900.0),
    not_before_s=st.floats(0.0, 1000.0),
)
def test_no_vehicle_changes_lanes_before_the_rear_body_is_in_s3(
    cells: list[Cell], gap_m: float, sorting_m: float, not_before_s: float
) -> None:
    scenario = Scenario(
        road=Road(s1_m=0.0, s2_m=sorting_m), formation=evolve(FORMATIONS, gap_m=gap_m)
    )
    lattice, tick_s = scenario.lattice, scenario.runtime.tick_s
    start_s = start_time_s(cells, not_before_s, scenario)
    assert start_s >= not_before_s - 1e-6
    rear_bumper_m = lattice.cell_s_m(min(cells)[0], start_s) - scenario.vehicle.length_m
    assert rear_bumper_m >= sorting_m - 1e-3
    assert abs(start_s / tick_s - round(start_s / tick_s)) < 1e-6
    # It is the earliest tick of that kind.
    assert start_s - tick_s < not_before_s or rear_bumper_m - 15.0 * tick_s < sorting_m + 1e-3


@given(slot_s=st.sampled_from(GROWING.timing.slots_s), left_s=st.floats(-5.0, 100.0))
def test_longer_slots_are_fewer(slot_s: float, left_s: float) -> None:
    """The last one ends before the foremost cell is at the end of the road."""
    cells: list[Cell] = [(-3, 0), (-1, 2)]
    t_s = GROWING.lattice.passing_time_s(-1, GROWING.road.length_m) - left_s
    assert exit_time_s(cells, GROWING) - t_s == pytest.approx(left_s)
    steps = steps_left(cells, t_s, slot_s, GROWING)
    assert steps * slot_s <= max(left_s, 0.0) + 1e-3
    assert (steps + 1) * slot_s > left_s


# --- departed vehicles ------------------------------------------------------------------------


def test_groups_are_forgotten_when_all_their_vehicles_have_left() -> None:
    groups = joined(0, 1)
    groups.join((2, 3))
    groups.join((4, 5))
    groups.join((5, 6))
    seen = Census(NOW_S, entries_of(d=(LATTICE.block_range(3)[0], 0)), (), closed_to=5)
    groups.forget_departed(seen, LATTICE.block_of)
    assert groups.of(0) == (0,)
    assert groups.of(2) == (2, 3)  # a vehicle of block 3 is on the road
    assert groups.of(4) == (4, 5, 6)  # vehicles may still enter block 6
    groups.forget_departed(replace(seen, closed_to=6), LATTICE.block_of)
    assert groups.of(4) == (4,)
    assert groups.of(2) == (2, 3)
