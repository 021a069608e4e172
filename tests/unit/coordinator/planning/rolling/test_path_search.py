"""The stream planner: legal for any input, repeatable, and nearly optimal."""

from __future__ import annotations

from itertools import combinations, pairwise
from random import Random

import attrs
import numpy as np
import pytest
from attrs import evolve
from hypothesis import given
from numpy.typing import NDArray

from laneweave.coordinator.planning.conflict_kinds import ConflictModel
from laneweave.coordinator.planning.rolling import search_kernel as kernel
from laneweave.coordinator.planning.rolling.arrays import window
from laneweave.coordinator.planning.rolling.path_search import StreamPlanner
from laneweave.coordinator.planning.rolling.problem import (
    MovingPart,
    OpenRoad,
    StreamCosts,
    StreamPlan,
    StreamRoad,
    StreamVehicle,
)
from laneweave.coordinator.planning.rolling.rolling_validator import problems_of_plan
from laneweave.coordinator.rolling.checked_planner import stream_road
from laneweave.protocol.config.scenario_files import load_scenario
from laneweave.protocol.lattice import Cell
from laneweave.protocol.road_layout import LaneSection
from support import rolling_oracles as oracle
from support.examples import examples
from support.rolling_oracles import ROAD, SHORT, Stream, streams

JAM = 1
"""Seed of a jam."""


def dense(
    random: Random, columns: range, share: float, road: StreamRoad = ROAD
) -> list[StreamVehicle]:
    cells = [(c, lane) for c in columns for lane in range(road.lanes) if random.random() < share]
    return [StreamVehicle(f"v{i}", cell, random.randrange(3)) for i, cell in enumerate(cells)]


def driven(plan: StreamPlan, vehicles: list[StreamVehicle]) -> list[StreamVehicle]:
    """Return the vehicles on the road in the next slot, in the next cells of their paths."""
    ways = plan.paths
    return [attrs.evolve(v, cell=ways[v.vehicle][1]) for v in vehicles if len(ways[v.vehicle]) > 2]


def is_legal(road: StreamRoad, plan: StreamPlan, vehicles: list[StreamVehicle]) -> bool:
    """Check all pairs in all slots by the independent rules of the tests."""
    starts = {v.vehicle: v.cell for v in vehicles}
    if {name: way[0] for name, way in plan.paths.items()} != starts:
        return False
    for one, other in combinations(plan.paths.values(), 2):
        pairs = zip(pairwise(one), pairwise(other), strict=False)
        if any(oracle.conflicts(road.model, a, b) for a, b in pairs):
            return False
    return True


# --------------------------------------------------------------------------- whatever comes


@pytest.mark.slow
@examples(60)
@given(streams())
def test_every_stream_gets_complete_paths_without_conflicts(stream: Stream) -> None:
    road, slot, vehicles, blocked = stream
    planner = StreamPlanner(road)
    plan = planner.plan(slot, vehicles, None, blocked)
    assert problems_of_plan(road, plan, vehicles, blocked) == []
    assert is_legal(road, plan, vehicles)
    # What was planned is driven for a slot, with other cells blocked then.
    later = driven(plan, vehicles)
    again = planner.plan(slot + 1, later, plan, blocked[1:])
    assert problems_of_plan(road, again, later, blocked[1:]) == []


@pytest.mark.slow
@examples(30)
@given(streams())
def test_vehicles_need_not_be_where_they_were_planned(stream: Stream) -> None:
    """All vehicles are a cell further; some are new, held, gone, or have other targets."""
    road, slot, vehicles, blocked = stream
    planner = StreamPlanner(road)
    plan = planner.plan(slot, vehicles)
    moved = [
        attrs.evolve(
            v,
            vehicle=v.vehicle if i % 3 else f"new{i}",
            cell=(v.cell[0] + 1, v.cell[1]),
            targets={(n + i % 2) % len(road.sections) for n in v.targets},
            held=i % 7 == 0,
        )
        for i, v in enumerate(vehicles[1:])
    ]
    for skipped in (1, 3):
        later = planner.plan(slot + skipped, moved, plan, blocked)
        assert problems_of_plan(road, later, moved, blocked) == []


def test_an_empty_road() -> None:
    assert StreamPlanner(ROAD).plan(3, []) == StreamPlan(3, {}, ())


@pytest.mark.parametrize("column", [-400, -3, 0, 30, 66, 67, 400])
def test_one_vehicle_from_anywhere(column: int) -> None:
    """It reaches its lane if there are enough slots."""
    for lane in range(3):
        vehicle = StreamVehicle("v", (column, lane), 0)
        plan = StreamPlanner(ROAD).plan(0, [vehicle])
        assert problems_of_plan(ROAD, plan, [vehicle]) == []
        slots = (1000 - 15 * column) // 60
        assert plan.missed == (("v",) if lane > max(0, slots) else ())


def test_a_lone_vehicle_that_has_missed_its_lane_is_planned_anew() -> None:
    """Its cells were blocked before; the earlier path is still valid, but leads elsewhere."""
    vehicle = StreamVehicle("v", (30, 1), 0)
    blocked = [(column, 0) for column in range(20, 60)]
    planner = StreamPlanner(ROAD)
    before = planner.plan(0, [vehicle], None, blocked)
    assert before.missed == ("v",)
    assert planner.plan(1, [vehicle], before).missed == ()


def test_vehicles_beyond_the_road_have_no_path() -> None:
    vehicles = [StreamVehicle("past", (67, 0), 2), StreamVehicle("last", (66, 0), 0)]
    plan = StreamPlanner(ROAD).plan(0, vehicles)
    assert plan.paths == {"past": ((67, 0),), "last": ((66, 0), (66, 0))}
    assert plan.missed == ("past",)


def test_shared_cells_and_unknown_lanes_are_refused() -> None:
    planner = StreamPlanner(ROAD)
    with pytest.raises(ValueError, match="a and b are both in"):
        planner.plan(0, [StreamVehicle("a", (1, 1), 0), StreamVehicle("b", (1, 1), 0)])
    with pytest.raises(ValueError, match="3 lanes"):
        planner.plan(0, [StreamVehicle("a", (1, 3), 0)])
    with pytest.raises(ValueError, match="share a cell"):
        attrs.evolve(ROAD, model=ConflictModel(("edge",)))


def test_blocked_cells_may_be_left_but_not_entered() -> None:
    blocked = [(30, 0), (30, 1)]
    vehicles = [StreamVehicle("in", (30, 0), 2), StreamVehicle("beside", (30, 2), 0)]
    plan = StreamPlanner(ROAD).plan(0, vehicles, None, blocked)
    assert problems_of_plan(ROAD, plan, vehicles, blocked) == []
    assert plan.missed == ()
    assert plan.paths["in"][1] in {(29, 0), (31, 0)}
    assert set(plan.paths["beside"]).isdisjoint(blocked)


def test_held_vehicles_stay_and_others_drive_around_them() -> None:
    vehicles = [
        StreamVehicle("held", (30, 1), 0, held=True),
        StreamVehicle("a", (30, 0), 2),
        StreamVehicle("b", (30, 2), 0),
    ]
    plan = StreamPlanner(ROAD).plan(0, vehicles)
    assert set(plan.paths["held"]) == {(30, 1)}
    assert plan.missed == ("held",)


LATERAL = frozenset({(0, 1), (0, -1)})


@pytest.mark.slow
@examples(30)
@given(streams())
def test_vehicles_that_do_not_change_columns_stay_in_theirs(stream: Stream) -> None:
    road, slot, drawn, blocked = stream
    vehicles = [
        attrs.evolve(vehicle, moves=LATERAL) if number % 3 == 0 else vehicle
        for number, vehicle in enumerate(drawn)
    ]
    planner = StreamPlanner(road)
    plan = planner.plan(slot, vehicles, None, blocked)
    assert problems_of_plan(road, plan, vehicles, blocked) == []
    for vehicle in vehicles[::3]:
        assert {column for column, _ in plan.paths[vehicle.vehicle]} == {vehicle.cell[0]}
    # Nor on earlier paths, which were planned for other types.
    free = planner.plan(slot, drawn, None, blocked)
    plan = planner.plan(slot, vehicles, free, blocked)
    assert problems_of_plan(road, plan, vehicles, blocked) == []


def test_others_make_room_for_a_vehicle_that_does_not_change_columns() -> None:
    vehicles = [
        StreamVehicle("truck", (25, 0), 2, moves=LATERAL),
        StreamVehicle("a", (25, 1), 1),
        StreamVehicle("b", (25, 2), 2),
    ]
    plan = StreamPlanner(ROAD).plan(0, vehicles)
    assert plan.missed == ()
    assert problems_of_plan(ROAD, plan, vehicles) == []
    # Two that must pass each other in one column cannot.
    vehicles[2] = StreamVehicle("b", (25, 2), 0, moves=LATERAL)
    assert StreamPlanner(ROAD).plan(0, vehicles).missed == ("truck", "b")


@pytest.mark.parametrize("gaps", [(), (3,), (1, 2, 4)])
def test_others_leave_a_lane_in_which_they_could_stay(gaps: tuple[int, ...]) -> None:
    """A move to the third lane costs less than a vehicle beside it that cannot leave its lane."""
    road = lanes(LaneSection(0, to_m=800.0, exit="off"), *through(1, 2))
    vehicles = [
        StreamVehicle(f"{lane}-{column}", (column, lane), {1, 2}, moves=LATERAL)
        for column in (25, *(25 + gap for gap in gaps))
        for lane in (0, 1)
    ]
    plan = StreamPlanner(road).plan(0, vehicles)
    assert problems_of_plan(road, plan, vehicles) == []
    assert plan.missed == ()


def test_a_path_blocked_by_a_held_vehicle_is_replaced() -> None:
    planner = StreamPlanner(ROAD)
    vehicles = [StreamVehicle("a", (30, 0), 2), StreamVehicle("b", (31, 1), 1)]
    before = planner.plan(0, vehicles)
    held = [vehicles[0], StreamVehicle("b", (30, 1), 1, held=True)]
    assert problems_of_plan(ROAD, before, held) != []
    plan = planner.plan(0, held, before)
    assert problems_of_plan(ROAD, plan, held) == []
    assert plan.missed == ()


# ----------------------------------------------------------------------- lanes that end, exits


def lanes(*sections: LaneSection, start_m: float = 150.0) -> StreamRoad:
    count = 1 + max(section.lane for section in sections)
    return StreamRoad(
        count, 15.0, 60.0, (start_m, 1000.0), 1000.0, 5.0, max_paths=2000, sections=sections
    )


def through(*numbers: int) -> list[LaneSection]:
    return [LaneSection(lane, to_m=1000.0, exit="end") for lane in numbers]


def test_a_lane_that_ends_is_left_in_time_even_in_dense_traffic() -> None:
    road = lanes(*through(0, 1), LaneSection(2, to_m=800.0))
    random = Random(7)
    cells = [(c, lane) for c in range(-20, 10) for lane in range(3)]
    # Nine tenths of the cells of the two other lanes are taken afterwards.
    vehicles = [
        StreamVehicle(f"v{i}", cell, {0, 1}) for i, cell in enumerate(random.sample(cells, 54))
    ]
    plan = StreamPlanner(road).plan(0, vehicles)
    assert problems_of_plan(road, plan, vehicles) == []
    assert plan.missed == ()


def test_a_blocked_lane_is_used_before_and_after() -> None:
    again = LaneSection(0, 600.0, 1000.0, exit="end")
    road = lanes(LaneSection(0, to_m=500.0), *through(1), again)
    to_its_lane = StreamVehicle("a", (15, 0), 2)
    plan = StreamPlanner(road).plan(0, [to_its_lane])
    assert plan.missed == ()
    visited = [lane for _, lane in plan.paths["a"]]
    assert visited[0] == visited[-1] == 0
    assert 1 in visited


def test_vehicles_take_their_exits_and_others_keep_out_of_them() -> None:
    """A weaving section: a lane from 400 m to 700 m, by which vehicles come and go."""
    road = lanes(LaneSection(0, 400.0, 700.0, exit="off"), *through(1, 2))
    comes, goes, stays = (
        StreamVehicle("comes", (22, 0), {1, 2}),  # on the ramp, at 330 m
        StreamVehicle("goes", (22, 1), 0),
        StreamVehicle("stays", (23, 1), {1, 2}),
    )
    plan = StreamPlanner(road).plan(0, [comes, goes, stays])
    assert problems_of_plan(road, plan, [comes, goes, stays]) == []
    assert plan.missed == ()
    assert len(plan.paths["goes"]) < len(plan.paths["stays"])
    off_m = [
        15 * column + 60 * s for s, (column, lane) in enumerate(plan.paths["goes"]) if not lane
    ]
    assert off_m[0] >= 405.0
    assert off_m[-1] > 700.0
    assert all(lane > 0 for _, lane in plan.paths["stays"])


def test_a_vehicle_in_a_lane_without_way_out_is_planned_to_its_end() -> None:
    road = lanes(*through(0), LaneSection(1, to_m=800.0))
    late = StreamVehicle("late", (52, 1), 0)  # at 780 m
    plan = StreamPlanner(road).plan(0, [late])
    assert plan.paths == {"late": ((52, 1), (52, 1))}
    assert plan.missed == ("late",)


OPEN = lanes(*through(0, 1), start_m=400.0)
CLOSED_AT_700 = (
    LaneSection(0, 0.0, 1000.0, exit="end"),
    LaneSection(1, 790.0, 1000.0, exit="end"),
    LaneSection(1, 0.0, 700.0),
)


@pytest.mark.parametrize("lane", [0, 1])
def test_no_lane_is_missed_in_the_lane_that_is_closed(lane: int) -> None:
    """Neither vehicle can reach its lane, and it costs the same wherever they miss it."""
    vehicle = StreamVehicle("a", (28, lane), 1)  # at 420 m; behind 790 m there is no room
    road = evolve(OPEN.as_open(OpenRoad(CLOSED_AT_700)), sorting_m=(400.0, 700.0))
    plan = StreamPlanner(road).plan(0, [vehicle])
    assert plan.missed == ("a",)
    assert plan.paths["a"][-1][1] == 0


def test_lanes_are_changed_earlier_while_a_part_is_closed() -> None:
    early = evolve(OPEN, around_m=100.0)
    assert early.as_open(OpenRoad(CLOSED_AT_700)).sorting_m[0] == 100.0
    assert list(early.as_open(OpenRoad(CLOSED_AT_700)).closing) == [2]
    assert early.as_open(OpenRoad(OPEN.sections)).sorting_m[0] == 400.0
    vehicle = StreamVehicle("a", (10, 1), 0)  # at 150 m
    assert StreamPlanner(early).plan(0, [vehicle]).paths["a"][1] == (10, 1)
    plan = StreamPlanner(early).plan(0, [vehicle], now=OpenRoad(CLOSED_AT_700))
    assert plan.paths["a"][1][1] == 0


FASTER = MovingPart(1, 100.0, 300.0, 90.0)
"""Cleared for a vehicle that gains 30 m in a slot on the lattice."""


def touches(part: MovingPart, road: StreamRoad, slot: int, cell: Cell) -> bool:
    """Return whether a body is in a moving part when a slot begins, or half a slot later."""
    for share in (0.0, 0.5, 1.0):
        front_m = road.position_m(0, cell[0]) + (slot + share) * road.advance_m
        moved_m = (slot + share) * part.advance_m
        if front_m > part.from_m + moved_m and front_m - road.body_m < part.to_m + moved_m:
            return cell[1] == part.lane
    return False


@pytest.mark.parametrize("advance_m", [0.0, 30.0, 60.0, 90.0])
def test_vehicles_leave_a_part_that_is_cleared_and_none_enters_it(advance_m: float) -> None:
    part = evolve(FASTER, advance_m=advance_m)
    road = evolve(lanes(*through(0, 1, 2)), lanes=3)
    now = OpenRoad(road.sections, cleared=(part,))
    inside = [StreamVehicle(f"in-{column}", (column, 1), 1) for column in (11, 13, 16)]
    beside = [StreamVehicle(f"beside-{column}", (column, 0), 1) for column in (12, 14)]
    plan = StreamPlanner(road).plan(0, [*inside, *beside], now=now)
    assert problems_of_plan(road.as_open(now), plan, [*inside, *beside], frozenset()) == []
    for name, path in plan.paths.items():
        was_in = False
        for slot, cell in enumerate(path):
            is_in = touches(part, road, slot, cell)
            # They leave it with their first move; nobody enters it.
            assert not is_in or (name.startswith("in") and slot == 0) or not was_in
            assert not is_in or slot == 0
            was_in = is_in
    if advance_m >= 60.0:
        return  # the part does not fall behind
    assert plan.missed == ()  # all return to their lane once it has fallen behind


def test_a_plan_that_enters_a_cleared_part_is_invalid() -> None:
    road = evolve(lanes(*through(0, 1, 2)), lanes=3)
    vehicle = StreamVehicle("a", (12, 0), 1)
    plan = StreamPlanner(road).plan(0, [vehicle])
    assert plan.paths["a"][1] == (12, 1)
    assert list(problems_of_plan(road, plan, [vehicle], frozenset())) == []
    now = road.as_open(OpenRoad(road.sections, cleared=(FASTER,)))
    (problem,) = problems_of_plan(now, plan, [vehicle], frozenset())
    assert "from lane 0 to 1" in problem


@pytest.mark.slow
def test_streams_on_lanes_that_end_cost_the_minimum_nearly_always() -> None:
    """The least cost: a mixed-integer programme."""
    random = Random(9)
    road = attrs.evolve(
        SHORT,
        sections=(
            LaneSection(0, to_m=150.0, exit="end"),
            LaneSection(1, 20.0, 150.0, exit="end"),
            LaneSection(2, to_m=90.0, exit="off"),
        ),
    )
    equal = 0
    for seed in range(8):
        cells = random.sample([(c, lane) for c in range(3) for lane in range(3)], 4)
        vehicles = [
            StreamVehicle(f"v{i}", cell, oracle.targets(road, random))
            for i, cell in enumerate(cells)
        ]
        plan = StreamPlanner(road, seed=seed).plan(0, vehicles)
        assert problems_of_plan(road, plan, vehicles) == []
        cost = oracle.cost_of_plan(road, plan, vehicles)
        least = oracle.Programme(road, 0, vehicles).least_cost()
        assert cost >= least - 1e-6
        equal += cost <= least + 1e-6
    assert equal >= 6


# ------------------------------------------------------------------------- the same each time


def test_equal_streams_get_equal_plans_from_any_planner() -> None:
    vehicles = dense(Random(1), range(24), 0.8)
    first, second = StreamPlanner(ROAD, seed=5), StreamPlanner(ROAD, seed=5)
    plan = first.plan(0, vehicles)
    for slot in range(1, 8):
        vehicles = driven(plan, vehicles)
        later = first.plan(slot, vehicles, plan)
        # It knows only the last plan, and is given the vehicles in another order.
        assert second.plan(slot, vehicles[::-1], plan) == attrs.evolve(
            later, missed=later.missed[::-1]
        )
        plan = later


def test_paths_change_only_for_cheaper_ones() -> None:
    planner = StreamPlanner(ROAD)
    vehicles = dense(Random(2), range(30), 0.6)
    plan = planner.plan(0, vehicles)
    kept = 0
    for slot in range(1, 9):
        vehicles = driven(plan, vehicles)
        later = planner.plan(slot, vehicles, plan)
        old = StreamPlan(slot, {v.vehicle: plan.paths[v.vehicle][1:] for v in vehicles}, ())
        gained = oracle.cost_of_plan(ROAD, old, vehicles) - oracle.cost_of_plan(
            ROAD, later, vehicles
        )
        if later.paths == old.paths:
            kept += 1
        else:
            assert gained > 0
        plan = later
    assert kept >= 1
    assert plan.missed == ()


def test_an_optimal_plan_is_kept_without_a_round() -> None:
    planner = StreamPlanner(ROAD)
    vehicles = [StreamVehicle("a", (0, 0), 1), StreamVehicle("b", (8, 2), 0)]
    plan = planner.plan(0, vehicles)
    again = planner.plan(1, driven(plan, vehicles), plan)
    assert again.rounds == 0
    assert all(again.paths[name] == way[1:] for name, way in plan.paths.items())


# ------------------------------------------------------------------------------ how good it is


def excess_costs(costs: StreamCosts, count: int, draws: int) -> tuple[NDArray[np.float64], float]:
    """Return costs beyond the minimum, by a mixed-integer programme, and the sum of the minima."""
    random, excess, minima = Random(3), [], 0.0
    for seed in range(draws):
        vehicles = random.sample(dense(random, range(3), 1.0, SHORT), count)
        plan = StreamPlanner(SHORT, costs, seed).plan(0, vehicles)
        assert is_legal(SHORT, plan, vehicles)
        minimum = oracle.Programme(SHORT, 0, vehicles).least_cost()
        excess.append(oracle.cost_of_plan(SHORT, plan, vehicles) - minimum)
        minima += minimum
    assert min(excess) >= -1e-6
    return np.array(excess), minima


@pytest.mark.more
@pytest.mark.slow
@pytest.mark.parametrize("count", [5, 2, 7, 9])
def test_streams_cost_the_minimum_nearly_always_where_forward_moves_are_free(
    count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    costs = StreamCosts(forward=0.0)
    monkeypatch.setattr(oracle, "COSTS", costs)
    excess, _ = excess_costs(costs, count, 6)
    assert (excess <= 1e-6).sum() >= 4


@pytest.mark.more
@pytest.mark.slow
def test_streams_cost_the_minimum_nearly_always() -> None:
    found = [excess_costs(oracle.COSTS, count, 18) for count in (2, 5, 7, 9)]
    excess = np.concatenate([one for one, _ in found])
    assert (excess <= 1e-6).mean() >= 0.75
    assert excess.sum() <= 0.05 * sum(minima for _, minima in found)


def test_ejection_chains_solve_streams_that_reorderings_do_not() -> None:
    vehicles = dense(Random(JAM), range(20, 30), 0.85)
    assert StreamPlanner(ROAD).plan(0, vehicles).missed == ()
    order = sorted(vehicles, key=lambda one: one.cell)
    table, ways, costs, scratch = window(ROAD, StreamCosts(), 0, order, ())[1:]
    rng = np.array([1], dtype=np.uint64)
    nothing = np.zeros((0, 2), dtype=np.int64), np.zeros(len(order) + 1, dtype=np.int64)
    kernel.set_paths(table, ways, costs, *nothing, rng, scratch)
    assert (ways.cost >= ways.missing_cost).any()
    for turn in range(3000):
        seed, size = turn % len(order), 2 + turn % 12
        kernel._reorder(table, ways, costs, seed, size, 0.0, rng, scratch)
    assert (ways.cost >= ways.missing_cost).any()


@pytest.mark.parametrize("forward", [-0.6, 5.0])
def test_drift_follows_its_cost(forward: float) -> None:
    vehicles = dense(Random(4), range(20), 0.3)
    costs = StreamCosts(forward=forward)
    plan = StreamPlanner(ROAD, costs).plan(0, vehicles)
    assert problems_of_plan(ROAD, plan, vehicles) == []
    drift = sum(way[-1][0] - way[0][0] for way in plan.paths.values())
    assert drift > 3 * len(vehicles) if forward < 0 else drift <= 1


def test_the_limit_on_path_searches_is_kept() -> None:
    vehicles = dense(Random(5), range(20, 40), 1.0)
    quick = attrs.evolve(ROAD, rounds=3)
    assert StreamPlanner(quick).plan(0, vehicles).rounds == 3
    assert StreamPlanner(attrs.evolve(ROAD, max_paths=1)).plan(0, vehicles).rounds <= 2
    quick = attrs.evolve(ROAD, rounds=3, anneals=4)
    assert StreamPlanner(quick).plan(0, vehicles).rounds == 12


def test_the_search_goes_on_while_vehicles_miss_their_lanes() -> None:
    missed = {1: 0, 6: 0}
    finished = 0
    for seed in range(40):
        vehicles = dense(Random(seed), range(20, 40), 0.7)
        once, longer = (
            StreamPlanner(attrs.evolve(ROAD, rounds=100, anneals=anneals)).plan(0, vehicles)
            for anneals in missed
        )
        assert is_legal(ROAD, longer, vehicles)
        missed[1] += len(once.missed)
        missed[6] += len(longer.missed)
        if not once.missed:
            finished += 1
            assert longer.paths == once.paths
    assert finished > 5
    assert 2 * missed[6] < missed[1]


@pytest.mark.parametrize(("s3_m", "anneals"), [(1e-3, 6), (600.0, 6), (1500.0, 2), (9600.0, 1)])
def test_paths_are_annealed_less_often_on_longer_roads(s3_m: float, anneals: int) -> None:
    scenario = load_scenario(None, formation__operation="rolling")
    road = evolve(scenario.road, s3_m=s3_m)
    assert stream_road(evolve(scenario, road=road)).anneals == anneals


@pytest.mark.parametrize(
    ("cycle_s", "mode", "anneals"),
    [(6.0, 1, 6), (5.0, 1, 6), (4.0, 1, 4), (6.0, 2, 6), (5.0, 2, 5), (4.0, 2, 2)],
)
def test_paths_are_annealed_less_often_in_short_slots_and_with_more_moves(
    cycle_s: float, mode: int, anneals: int
) -> None:
    scenario = load_scenario(None, formation__cycle_s=cycle_s, formation__mode=mode)
    assert stream_road(scenario).anneals == anneals
