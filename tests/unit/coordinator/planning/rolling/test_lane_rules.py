"""Restrictions and solid lines in plans: what is never planned, and what is avoided."""

from __future__ import annotations

import math
from itertools import pairwise

import attrs
import pytest
from hypothesis import given
from hypothesis import strategies as st

from laneweave.coordinator.planning.rolling.path_search import StreamPlanner
from laneweave.coordinator.planning.rolling.problem import StreamPlan, StreamRoad, StreamVehicle
from laneweave.coordinator.planning.rolling.requested_moves import is_possible
from laneweave.coordinator.planning.rolling.rolling_validator import (
    problems_of_path,
    problems_of_plan,
)
from laneweave.coordinator.rolling.checked_planner import stream_road
from laneweave.protocol.config.scenario_files import parse_scenario
from laneweave.protocol.lattice import Cell
from laneweave.protocol.scenario.formation_table import READY_LATE_S
from laneweave.protocol.scenario.road_tables import LaneRule, Restriction, SolidLine
from oracles.lane_rules import broken_rules
from support.examples import examples
from support.rolling_oracles import ROAD, Stream, streams

TRUCKS = ("truck",)
LEFT, RIGHT = (0, 1), (0, -1)
LATERAL = frozenset({LEFT, RIGHT})
BAN = attrs.evolve(ROAD, restrictions=(Restriction(2, TRUCKS, 600.0, 800.0),))
LINE = attrs.evolve(ROAD, solid_lines=(SolidLine(1, "left", 500.0, 900.0),))


def truck(name: str, cell: Cell, targets: int | set[int]) -> StreamVehicle:
    return StreamVehicle(name, cell, targets, vehicle_type="truck")


def fronts_in(plan: StreamPlan, name: str, lane: int) -> list[float]:
    """Return the positions of the front at the ends of slots that a vehicle spends in a lane."""
    steps = enumerate(pairwise(plan.paths[name]), plan.slot)
    return [
        there[0] * ROAD.pitch_m + (s + 1) * ROAD.advance_m
        for s, (here, there) in steps
        if lane in (here[1], there[1])
    ]


# ---------------------------------------------------------------------------- whatever comes


@st.composite
def rules_of(draw: st.DrawFn, road: StreamRoad) -> StreamRoad:
    """Draw restrictions and solid lines of a road."""
    lanes = st.integers(0, road.lanes - 1)
    positions = st.sampled_from((0.0, 102.5, 200.0, 317.5, 400.0))
    lengths = st.sampled_from((7.0, 60.0, 150.0, 1000.0))
    types = st.sampled_from((("truck",), ("car",), ("car", "truck"), ("bus",)))
    restrictions = [
        Restriction(draw(lanes), draw(types), from_m, from_m + draw(lengths))
        for from_m in draw(st.lists(positions, max_size=3))
    ]
    lines = [
        SolidLine(
            draw(lanes),
            draw(st.sampled_from(("left", "right"))),
            from_m,
            from_m + draw(lengths),
            draw(st.sampled_from(((), ("truck",), ("car",)))),
        )
        for from_m in draw(st.lists(positions, max_size=3))
    ]
    return attrs.evolve(road, restrictions=tuple(restrictions), solid_lines=tuple(lines))


@st.composite
def ruled_streams(draw: st.DrawFn) -> Stream:
    """Draw streams of cars and trucks on roads with rules."""
    road, slot, vehicles, blocked = draw(streams())
    kinds = draw(st.lists(st.sampled_from(("car", "truck")), min_size=5, max_size=5))
    typed = [
        attrs.evolve(vehicle, vehicle_type=kinds[number % 5])
        for number, vehicle in enumerate(vehicles)
    ]
    return draw(rules_of(road)), slot, typed, blocked


def broken(
    road: StreamRoad, slot: int, vehicle: StreamVehicle, path: tuple[Cell, ...]
) -> list[str]:
    lattice = road.pitch_m, road.advance_m, road.body_m
    rules: list[LaneRule] = [*road.restrictions, *road.solid_lines]
    return broken_rules(path, slot, lattice, vehicle.vehicle_type, rules)


@pytest.mark.slow
@examples(60)
@given(ruled_streams())
def test_no_plan_breaks_a_rule_by_an_independent_computation(stream: Stream) -> None:
    road, slot, vehicles, blocked = stream
    planner = StreamPlanner(road)
    free = StreamPlanner(attrs.evolve(road, restrictions=(), solid_lines=()))
    # The search also starts from paths that were planned without rules.
    for before in (None, free.plan(slot, vehicles, None, blocked)):
        plan = planner.plan(slot, vehicles, before, blocked)
        assert problems_of_plan(road, plan, vehicles, blocked) == []
        for vehicle in vehicles:
            assert broken(road, slot, vehicle, plan.paths[vehicle.vehicle]) == []


@examples(100)
@given(rules_of(ROAD), st.integers(0, 40), st.integers(0, 2), st.sampled_from((LEFT, RIGHT)))
def test_the_validator_finds_what_the_independent_computation_finds(
    road: StreamRoad, column: int, lane: int, move: Cell
) -> None:
    road = attrs.evolve(road, sorting_m=(-100.0, 1000.0))
    here, there = (column, lane), (column + move[0], lane + move[1])
    if not 0 <= there[1] < road.lanes:
        return
    waits = math.ceil((road.length_m - column * road.pitch_m) / road.advance_m)
    path = (here, *([there] * max(1, waits)))
    for kind in ("car", "truck", "bus"):
        vehicle = StreamVehicle("v", here, lane, vehicle_type=kind)
        found = [
            problem
            for problem in problems_of_path(road, 0, vehicle, path, frozenset())
            if "may not" in problem
        ]
        assert bool(found) == bool(broken(road, 0, vehicle, path))


def test_rules_of_other_types_change_nothing() -> None:
    vehicles = [
        StreamVehicle(f"v{column}-{lane}", (column, lane), (column + lane) % 3)
        for column in range(0, 24, 2)
        for lane in range(3)
    ]
    road = attrs.evolve(BAN, solid_lines=(SolidLine(0, "left", vehicle_types=TRUCKS),))
    assert StreamPlanner(road).plan(0, vehicles) == StreamPlanner(ROAD).plan(0, vehicles)


# -------------------------------------------------------------------------------- restrictions


def test_a_lane_is_left_before_it_is_restricted_and_used_again_after() -> None:
    vehicles = [truck("t", (25, 2), 2)]
    plan = StreamPlanner(BAN).plan(0, vehicles)
    assert problems_of_plan(BAN, plan, vehicles) == []
    assert plan.missed == ()
    assert all(front_m <= 600.0 or front_m >= 865.0 for front_m in fronts_in(plan, "t", 2))
    # A car has no reason to leave it.
    car = StreamPlanner(BAN).plan(0, [StreamVehicle("t", (25, 2), 2)])
    assert {lane for _, lane in car.paths["t"]} == {2}


def test_others_make_room_for_a_vehicle_that_must_leave_its_lane() -> None:
    road = attrs.evolve(BAN, sorting_m=(350.0, 1000.0))
    cars = [
        StreamVehicle(f"c{column}-{lane}", (column, lane), lane)
        for column in range(20, 33)
        for lane in (0, 1)
        if (column, lane) not in {(22, 0), (28, 1)}
    ]
    vehicles = [truck("t", (26, 2), 1), *cars]
    plan = StreamPlanner(road).plan(0, vehicles)
    assert problems_of_plan(road, plan, vehicles) == []
    assert all(front_m <= 600.0 for front_m in fronts_in(plan, "t", 2))


def test_a_vehicle_that_cannot_leave_its_lane_drives_on() -> None:
    held = [StreamVehicle(f"c{column}", (column, 1), 1, held=True) for column in range(20, 60)]
    vehicles = [attrs.evolve(truck("t", (26, 2), 1), moves=LATERAL), *held]
    plan = StreamPlanner(BAN).plan(0, vehicles)
    assert problems_of_plan(BAN, plan, vehicles) == []
    assert {lane for _, lane in plan.paths["t"]} == {2}
    assert plan.missed == ("t",)
    assert plan.rounds < 250  # there is nothing to search for


def test_a_vehicle_in_a_restricted_part_leaves_it_at_once() -> None:
    plan = StreamPlanner(BAN).plan(0, [truck("t", (42, 2), 2)])  # at 630 m
    assert plan.paths["t"][1] == (42, 1)
    assert plan.missed == ()


def test_vehicles_that_make_room_do_not_enter_a_restricted_part() -> None:
    """A car needs the lane of a truck, which would make room in the left lane."""
    road = attrs.evolve(ROAD, restrictions=(Restriction(2, TRUCKS),))
    vehicles = [
        StreamVehicle("c", (26, 0), 1, moves=LATERAL),
        attrs.evolve(truck("t", (26, 1), {1, 2}), moves=LATERAL),
    ]
    assert StreamPlanner(ROAD).plan(0, vehicles).missed == ()
    plan = StreamPlanner(road).plan(0, vehicles)
    assert problems_of_plan(road, plan, vehicles) == []
    assert plan.missed == ("c",)
    assert {lane for _, lane in plan.paths["t"]} <= {0, 1}


# --------------------------------------------------------------------------------- solid lines


def test_a_solid_line_is_crossed_before_it_or_after_it() -> None:
    for column in (27, 32):
        plan = StreamPlanner(LINE).plan(0, [StreamVehicle("v", (column, 1), 2)])
        assert plan.missed == ()
        path = plan.paths["v"]
        crossing = next(s for s, cell in enumerate(path) if cell[1] == 2) - 1
        front_m = path[crossing][0] * ROAD.pitch_m + crossing * ROAD.advance_m
        before, after = front_m + ROAD.advance_m <= 500.0, front_m - ROAD.body_m >= 900.0
        assert (before, after) == (column == 27, column != 27)


def test_a_solid_line_may_be_crossed_from_its_other_side() -> None:
    vehicles = [StreamVehicle("v", (36, 2), 1)]  # at 540 m
    assert StreamPlanner(LINE).plan(0, vehicles).paths["v"][1] == (36, 1)


def test_requests_obey_the_rules() -> None:
    car, lorry = StreamVehicle("v", (42, 1), 1), truck("t", (42, 1), 1)  # at 630 m
    assert is_possible(BAN, 0, car, LEFT)
    assert not is_possible(BAN, 0, lorry, LEFT)
    assert is_possible(BAN, 0, lorry, RIGHT)
    assert not is_possible(LINE, 0, car, LEFT)


# ---------------------------------------------------------------------------- of the scenario


def test_the_road_of_a_scenario_has_its_rules_with_room_for_late_moves() -> None:
    scenario = parse_scenario(
        {
            "formation": {"operation": "rolling"},
            "vehicle_type": [{"name": "truck", "share": 0.1}],
            "road": {
                "restrictions": [{"lane": 2, "vehicle_types": ["truck"], "from_m": 600.0}],
                "solid_lines": [{"lane": 0, "to": "left", "from_m": 5.0, "to_m": 700.0}],
            },
        }
    )
    road = stream_road(scenario)
    late_m = READY_LATE_S * scenario.formation.speed_mps + scenario.types.room_ahead_m
    assert road.restrictions == (Restriction(2, TRUCKS, 600.0 - late_m),)
    assert road.solid_lines == (SolidLine(0, "left", 0.0, 700.0),)
