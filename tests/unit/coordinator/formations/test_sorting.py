"""Lane sorting: from promises to a request, and from paths to moves."""

from __future__ import annotations

import time
from typing import Any

import pytest
from attrs import evolve
from hypothesis import given
from hypothesis import strategies as st

from laneweave.coordinator.formations.roster import Numbers
from laneweave.coordinator.formations.sorting import (
    Sorting,
    SortingTask,
    has_formed,
    plan_requests,
    sort_lanes,
)
from laneweave.coordinator.formations.stages import stages
from laneweave.coordinator.planning.request import PlanRequest
from laneweave.coordinator.planning.response import PlanResponse
from laneweave.coordinator.planning.solve import plan
from laneweave.protocol.lattice import Cell, footprint
from laneweave.protocol.road_layout import ANY_LANE
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.formation_table import DrivingStructure
from laneweave.protocol.scenario.road_tables import Closure, Road
from laneweave.protocol.wire.messages import Name
from support.examples import examples
from support.paper import FORMATIONS, PAPER

SCENARIO = PAPER
LATTICE = SCENARIO.lattice
NODES = SCENARIO.formation.max_nodes
DEADLINE_S = 60.0
A, B, C, D, E, F = (Name(letter) for letter in "ABCDEF")


def task(
    cells: dict[Name, Cell],
    lanes: dict[Name, int],
    *unattended: Name,
    numbers: Numbers = (0,),
    scenario: Scenario = SCENARIO,
) -> SortingTask:
    deadline_s = scenario.formation.planning_deadline_s
    goals = {name: frozenset({lane}) for name, lane in lanes.items()}
    return SortingTask(numbers, cells, goals, unattended, scenario, deadline_s or DEADLINE_S)


def sort(order: SortingTask) -> Sorting:
    return sort_lanes(order, NODES, plan, time.monotonic)


def ends(order: SortingTask, sorting: Sorting) -> dict[Name, Cell]:
    return {
        name: moves[-1][2] if moves else order.hold_cells[name]
        for name, moves in sorting.moves.items()
    }


# --- the request ------------------------------------------------------------------------------


def test_the_request_is_in_the_blocks_own_columns_and_in_the_order_of_the_roster() -> None:
    order = task({B: (-4, 0), A: (-7, 1)}, {A: 0, B: 2}, numbers=(1,))
    request = next(plan_requests(order))
    assert [(v.id, v.cell, v.lane) for v in request.vehicles] == [(B, (3, 0), 2), (A, (0, 1), 0)]
    assert (request.grid.columns, request.grid.lanes) == (4, 3)
    assert sorted(lane for _, lane in request.targets) == [0, 2]
    assert request.mode == SCENARIO.formation.mode
    assert request.conflicts == SCENARIO.formation.conflict_kinds


def test_of_blocks_without_vehicles_only_held_cells_are_used() -> None:
    """Deserted blocks may hold vehicles that the leader has not heard of."""
    order = task({A: (-5, 0), B: (-1, 1)}, {A: 1, B: 2}, numbers=(0, 1))
    kept_out = evolve(order, deserted=(1,))
    first = order.columns.start
    in_block = {(column - first, lane) for column, lane in LATTICE.block_cells(1)}
    assert order.blocked == ()
    assert set(kept_out.blocked) == in_block - {kept_out.movers[A]}
    moves = sort(kept_out).moves
    assert all(target[0] > -4 for each in moves.values() for _, _, target in each), (
        "out of the block only"
    )


def test_the_request_follows_the_scenario() -> None:
    scenario = evolve(
        SCENARIO, formation=evolve(FORMATIONS, mode=2, planning_deadline_s=1.5, solver="branching")
    )
    request = next(plan_requests(task({A: (0, 0)}, {A: 1}, scenario=scenario)))
    assert (request.mode, request.conflicts, request.deadline_s, request.solver) == (
        2,
        ("geometric", "closing"),
        1.5,
        "branching",
    )


def test_joined_formations_have_one_grid_from_the_last_rear_to_the_first_front() -> None:
    order = task({A: (0, 0), B: (-7, 1)}, {A: 0, B: 1}, numbers=(0, 1))
    assert (order.columns, order.blocked) == (range(-7, 1), ())
    assert order.movers == {A: (7, 0), B: (0, 1)}


def test_blocks_between_joined_formations_are_blocked() -> None:
    """Formations 0 and 2 were joined by others; what lies between belongs to formation 1."""
    order = task({A: (0, 0), B: (-11, 1)}, {A: 0, B: 1}, numbers=(0, 2))
    between = LATTICE.block_cells(1)
    assert {(column - 11, lane) for column, lane in order.blocked} == between
    sorting = sort(order)
    assert sorting.solved
    assert sorting.moves == {A: (), B: ()}


def test_a_vehicle_without_agent_blocks_its_cell() -> None:
    order = task({A: (0, 0), B: (-1, 1), C: (-2, 0)}, {A: 1, B: 0, C: 0}, B)
    request = next(plan_requests(order))
    assert request.grid.blocked == {(2, 1)}
    assert [vehicle.id for vehicle in request.vehicles] == [A, C]
    assert (2, 1) not in request.targets


def test_a_vehicle_without_a_place_on_its_lane_gets_a_target_of_its_own() -> None:
    cells: dict[Name, Cell] = {A: (0, 0), B: (-1, 0), C: (-2, 0), D: (-3, 0), E: (0, 2)}
    request = next(plan_requests(task(cells, dict.fromkeys(cells, 0))))
    for vehicle in request.vehicles:
        if vehicle.id == E:
            assert [request.targets[index] for index in vehicle.eligible or ()] == [(3, 2)]
        else:
            assert (vehicle.lane, vehicle.eligible) == (0, None)


def test_an_excused_vehicle_keeps_to_its_lane() -> None:
    order = task({A: (0, 0), B: (-1, 1)}, {A: 2, B: 2})
    lanes = [vehicle.lane for vehicle in next(plan_requests(order, A)).vehicles]
    assert lanes == [0, 2]


# --- sorting ----------------------------------------------------------------------------------


def test_paths_become_moves_on_the_lattice() -> None:
    order = task({A: (-4, 0), B: (-6, 0)}, {A: 2, B: 0}, numbers=(1,))
    sorting = sort(order)
    assert sorting.moves == {A: ((0, (-4, 0), (-4, 1)), (1, (-4, 1), (-4, 2))), B: ()}
    assert (sorting.out_of_reach, sorting.short_of_room, sorting.solved) == ((), False, True)


def test_without_movable_vehicles_nothing_is_planned() -> None:
    sorting = sort(task({A: (0, 0), B: (-1, 1)}, {A: 1, B: 1}, A, B))
    assert sorting.response is None
    assert sorting.solved
    assert sorting.moves == {A: (), B: ()}
    assert (sorting.out_of_reach, sorting.short_of_room) == ((A,), False)


def walled_in() -> SortingTask:
    """Return a sorting in which A, which wants lane 2, cannot leave its corner.

    C and E have no agents, B wants lane 0 (front to the right):

        lane 2  .  .  .  .
        lane 1  .  B  .  C
        lane 0  .  .  E  A
    """
    cells: dict[Name, Cell] = {A: (0, 0), B: (-2, 1), C: (0, 1), E: (-1, 0)}
    return task(cells, {A: 2, B: 0, C: 1, E: 0}, C, E)


def test_one_in_a_corner_does_not_keep_the_others_from_their_lanes() -> None:
    order = walled_in()
    whole = next(plan_requests(order))
    assert plan(whole, max_nodes=NODES).status == "infeasible"
    sorting = sort(order)
    assert sorting.solved
    assert sorting.moves[A] == ()
    assert ends(order, sorting)[B][1] == 0
    assert sorting.out_of_reach == (A,)
    assert sorting.short_of_room


def test_without_any_plan_no_vehicle_moves() -> None:
    """A and B are both walled in: with one of them dropped, the other is still stuck."""
    held: dict[Name, Cell] = {C: (0, 1), D: (-1, 0), E: (-2, 0), F: (-3, 1)}
    order = task(
        {A: (0, 0), B: (-3, 0)} | held,
        {A: 2, B: 2} | {name: lane for name, (_, lane) in held.items()},
        *held,
    )
    sorting = sort(order)
    assert sorting.response is not None
    assert (sorting.response.status, sorting.solved) == ("infeasible", False)
    assert set(sorting.moves.values()) == {()}
    assert sorting.out_of_reach == (A, B)
    assert sorting.short_of_room


@pytest.mark.slow
def test_a_search_that_ran_out_of_nodes_says_nothing_of_room() -> None:
    """With a neighbour's block as well it would only take longer."""
    cells = {A: (0, 0), B: (-1, 1), C: (-2, 0), D: (-3, 1), E: (0, 2), F: (-2, 2)}
    order = task(cells, {A: 2, B: 2, C: 1, D: 0, E: 0, F: 1})
    sorting = sort_lanes(order, 1, plan, time.monotonic)
    assert sorting.response is not None
    assert sorting.response.status == "timeout"
    assert (sorting.solved, sorting.short_of_room) == (False, False)
    assert sort(order).solved


def test_a_structure_without_room_for_all_is_not_tried() -> None:
    cells = {A: (0, 0), B: (-1, 1), C: (-2, 0)}
    order = task(cells, dict.fromkeys(cells, 0))
    one_lane = DrivingStructure(from_m=200.0, structure="interlaced", lanes=(0,))
    sorting = sort(evolve(order, structure=one_lane))
    assert "3 vehicles" in sorting.impossible
    assert (sorting.solved, sorting.short_of_room, sorting.out_of_reach) == (True, False, ())
    assert set(sorting.moves.values()) == {()}
    two_lanes = evolve(one_lane, lanes=(0, 1))
    assert sort(evolve(order, structure=two_lanes)).impossible == ""


def test_a_structure_that_cannot_be_reached_is_planned_once() -> None:
    """Excusing one vehicle from its lane, as in a sorting, would plan the same request again."""
    asked = list[PlanRequest]()

    def count(request: PlanRequest, **limits: Any) -> PlanResponse:  # noqa: ANN401
        asked.append(request)
        return plan(request, **limits)

    held: dict[Name, Cell] = {C: (0, 1), D: (-1, 0), E: (-2, 0), F: (-3, 1)}
    order = task({A: (0, 0), B: (-3, 0)} | held, dict.fromkeys([A, B, *held], 0), *held)
    lane_2 = DrivingStructure(from_m=200.0, structure="parallel", lanes=(2,))
    sorting = sort_lanes(evolve(order, structure=lane_2), NODES, count, time.monotonic)
    assert (sorting.solved, len(asked)) == (False, 1)


def test_whether_a_structure_is_formed() -> None:
    order = task({A: (-1, 0), B: (-1, 1), C: (-2, 0)}, {})
    assert has_formed(order)  # no structure
    right, left = (DrivingStructure(0.0, "parallel", lanes) for lanes in ((0, 1), (1, 2)))
    assert has_formed(evolve(order, structure=right))
    assert not has_formed(evolve(order, structure=left))
    # A vehicle without agent is in the way, so that the others form a structure around it.
    others = evolve(order, unattended={B}, structure=DrivingStructure(0.0, "parallel", (0,)))
    assert has_formed(others)
    assert not has_formed(evolve(others, structure=DrivingStructure(0.0, "parallel", (1,))))
    # There are too few cells for the vehicles, so there is nothing to form.
    crowd = {Name(f"v{n}"): (-(n % 4), n // 4) for n in range(6)}
    narrow = DrivingStructure(0.0, "interlaced", (0, 1))
    assert has_formed(evolve(task(crowd, {}), structure=narrow))


@pytest.mark.slow
def test_all_placements_share_one_deadline() -> None:
    """Each attempt takes 2 s of a deadline of 5 s, and every plan has too many steps."""
    asked, now_s = list[float](), [100.0]

    def slow_plan(request: PlanRequest, **limits: Any) -> PlanResponse:  # noqa: ANN401
        asked.append(request.deadline_s)
        now_s[0] += 2.0
        return plan(request, **limits | {"clock": time.monotonic})

    cells = {A: (0, 0), B: (-1, 1), C: (-2, 0), D: (-3, 1), E: (0, 2), F: (-2, 2)}
    order = task(cells, {A: 2, B: 2, C: 1, D: 0, E: 0, F: 1}, numbers=(0, 1))
    hurried = evolve(order, deadline_s=5.0, steps=0)
    assert len(list(plan_requests(hurried))) > 3
    assert sort_lanes(hurried, NODES, slow_plan, lambda: now_s[0]).solved
    assert asked == [5.0, 3.0, 1.0]


def test_a_placement_that_cannot_be_reached_is_followed_by_others() -> None:
    """The nearest cell of the vehicle's lane is enclosed by blocked cells; farther ones are not."""
    cells = {A: (-3, 0), B: (-3, 1), C: (-2, 2)}
    order = task(cells, {A: 2, B: 1, C: 2}, B, C)
    first, second, *_ = plan_requests(order)
    assert plan(first).status == "infeasible"
    assert plan(second).status == "optimal"
    sorting = sort(order)
    assert sorting.out_of_reach == ()
    assert ends(order, sorting)[A][1] == 2


@pytest.mark.parametrize("steps", [-2, 0, 1])
def test_without_time_for_a_step_the_shortest_of_some_plans_is_taken(steps: int) -> None:
    """`SortingTask.steps` counts from the front of the formation, so it may be 0 or negative."""
    scenario = evolve(SCENARIO, formation=evolve(FORMATIONS, targets="lane", solver=None))
    cells = {A: (0, 0), B: (-1, 1), C: (-2, 0), D: (-3, 1), E: (0, 2), F: (-2, 2)}
    order = task(cells, {A: 2, B: 2, C: 1, D: 0, E: 0, F: 1}, scenario=scenario)
    asked = list[int | None]()

    def count(request: PlanRequest, **limits: Any) -> PlanResponse:  # noqa: ANN401
        asked.append(request.max_steps)
        return plan(request, **limits)

    found = sort_lanes(evolve(order, steps=steps), NODES, count, time.monotonic)
    assert found.response is not None
    assert found.response.steps == 3
    assert asked == [None, 1, 2]


LANES_ONLY = frozenset({(0, 1), (0, -1)})


def test_cars_make_room_for_trucks_that_keep_their_columns() -> None:
    """Two cars are in the way of a truck; without trucks the formation becomes parallel."""
    cells: dict[Name, Cell] = {A: (-1, 0), B: (-1, 1), C: (-1, 2), D: (0, 0)}
    order = task(cells, {A: 2, B: 0, C: 1, D: 2})
    with_truck = evolve(order, moves={A: LANES_ONLY})
    sorting = sort(with_truck)
    final = ends(with_truck, sorting)
    assert {name: lane for name, (_, lane) in final.items()} == {A: 2, B: 0, C: 1, D: 2}
    assert final[A] == (-1, 2)
    assert all(vehicle.eligible is None for vehicle in next(plan_requests(order)).vehicles)


def test_trucks_that_would_have_to_pass_each_other_stay() -> None:
    """Others sort nevertheless."""
    cells: dict[Name, Cell] = {A: (-1, 0), B: (-1, 1), C: (-2, 0)}
    order = evolve(task(cells, {A: 2, B: 0, C: 2}), moves=dict.fromkeys((A, B), LANES_ONLY))
    sorting = sort(order)
    final = ends(order, sorting)
    assert sorting.solved
    assert set(sorting.out_of_reach) == {A, B}
    assert final == {A: (-1, 0), B: (-1, 1), C: (-2, 2)}


def test_several_trucks_that_are_hindered_do_not_keep_others_from_sorting() -> None:
    """Vehicles without agents are beside two trucks; a third one would have to pass a fourth."""
    held: dict[Name, Cell] = {C: (-1, 1), D: (-2, 1)}
    cells = {A: (-1, 0), B: (-2, 0), E: (-3, 0), F: (-3, 1), Name("G"): (0, 0)} | held
    goals = {A: 2, B: 2, E: 2, F: 0, Name("G"): 1} | dict.fromkeys(held, 1)
    order = evolve(task(cells, goals, *held), moves=dict.fromkeys((A, B, E, F), LANES_ONLY))
    sorting = sort(order)
    assert sorting.solved
    assert {A, B} <= set(sorting.out_of_reach) <= {A, B, E, F}
    assert ends(order, sorting)[Name("G")][1] == 1
    # More columns would not help.
    assert not sorting.short_of_room


def test_more_columns_help_a_truck_if_others_can_step_aside() -> None:
    scenario = evolve(
        SCENARIO, road=evolve(SCENARIO.road, lanes=2), formation=evolve(FORMATIONS, block_columns=1)
    )
    order = task({A: (0, 0), B: (0, 1)}, {A: 1, B: 1}, scenario=scenario)
    order = evolve(order, moves={A: LANES_ONLY})
    found = sort(order)
    assert (found.out_of_reach, found.short_of_room) == ((A,), True)
    assert sort(evolve(order, numbers=(0, 1))).out_of_reach == ()


@st.composite
def tasks(draw: st.DrawFn) -> SortingTask:
    numbers = draw(st.sampled_from([(0,), (1,), (0, 1)]))
    block = sorted(cell for number in numbers for cell in LATTICE.block_cells(number))
    cells = draw(st.lists(st.sampled_from(block), min_size=1, max_size=5, unique=True))
    names = [Name(f"v{index}") for index in range(len(cells))]
    lanes = draw(st.lists(st.integers(0, 2), min_size=5, max_size=5))
    unattended = draw(st.lists(st.sampled_from(names), max_size=2, unique=True))
    held = dict(zip(names, cells, strict=True))
    trucks = draw(st.lists(st.sampled_from(names), max_size=2, unique=True))
    order = task(held, dict(zip(names, lanes, strict=False)), *unattended, numbers=numbers)
    return evolve(order, moves=dict.fromkeys(trucks, LANES_ONLY))


@examples(60)
@given(tasks())
def test_sortings_stay_inside_and_name_vehicles_off_their_lanes(order: SortingTask) -> None:
    sorting = sort(order)
    inside = {cell for number in order.numbers for cell in LATTICE.block_cells(number)}
    assert set(sorting.moves) == set(order.hold_cells)
    held = {order.hold_cells[name] for name in order.unattended}
    for name, moves in sorting.moves.items():
        cell = order.hold_cells[name]
        for _, origin, target in moves:
            assert target != origin == cell
            assert name not in order.unattended
            assert footprint(origin, target) <= inside - held
            assert name not in order.moves or target[0] == origin[0]
            cell = target
    final = ends(order, sorting)
    assert len(set(final.values())) == len(final)
    missed = {name for name, cell in final.items() if cell[1] not in order.goal_lanes[name]}
    assert set(sorting.out_of_reach) == missed
    if sorting.solved:
        assert sorting.short_of_room == bool(missed - order.hindered.union(order.unattended))


def test_a_sorting_without_paths_is_not_solved() -> None:
    response = sort(task({A: (0, 0)}, {A: 1})).response
    assert isinstance(response, PlanResponse)
    assert not Sorting(evolve(response, paths=()), {}, (), short_of_room=False).solved


# --- roads whose lanes end --------------------------------------------------------------------

DROP = evolve(SCENARIO, road=Road(s1_m=50.0, s2_m=100.0, s3_m=850.0, closures=(Closure(0, 800.0),)))


@st.composite
def tasks_on_roads(draw: st.DrawFn) -> SortingTask:
    """Vehicles anywhere in a block, in one of the two stages of a lane drop."""
    number = draw(st.integers(0, 1))
    stage = stages(DROP)[number]
    every = sorted(LATTICE.block_cells(0))
    cells = draw(st.lists(st.sampled_from(every), min_size=1, max_size=6, unique=True))
    names = [Name(f"v{index}") for index in range(len(cells))]
    goals = {
        name: stage.goal_lanes(draw(st.sampled_from([ANY_LANE, ANY_LANE, 1, 2]))) for name in names
    }
    unattended = draw(st.lists(st.sampled_from(names), max_size=1))
    hold_cells = dict(zip(names, cells, strict=True))
    return SortingTask((0,), hold_cells, goals, unattended, DROP, DEADLINE_S, stage=stage)


@given(order=tasks_on_roads())
@examples(60)
def test_closed_lanes_are_not_used_and_all_find_a_cell_in_lanes_that_go_on(
    order: SortingTask,
) -> None:
    sorting = sort(order)
    final = ends(order, sorting)
    stage = order.stage
    assert stage is not None
    assert len(set(final.values())) == len(final)
    for name, moves in sorting.moves.items():
        assert not moves or order.hold_cells[name][1] in stage.lanes
        assert all(target[1] in stage.lanes for _, _, target in moves)
        assert not moves or name not in order.unattended
    assert set(sorting.out_of_reach) == {
        name for name, cell in final.items() if cell[1] not in order.goal_lanes[name]
    }
    if sorting.solved and not order.unattended and len(order.movers) == len(final):
        assert all(cell[1] in stage.through_lanes for cell in final.values())


def test_of_the_vehicles_that_need_a_full_lane_the_furthest_take_another_that_goes_on() -> None:
    stage = stages(DROP)[0]
    cells = {Name(f"v{number}"): (-number, number % 2) for number in range(4)}
    cells |= {E: (-1, 2), F: (-3, 2)}
    goals = {name: frozenset({2}) for name in cells}
    sorting = sort(SortingTask((0,), cells, goals, (), DROP, DEADLINE_S, stage=stage))
    assert sorting.solved
    final = ends(SortingTask((0,), cells, goals, (), DROP, DEADLINE_S, stage=stage), sorting)
    in_lane = [name for name, cell in final.items() if cell[1] == 2]
    assert len(in_lane) == 4
    assert {E, F} < {*in_lane}


def test_a_plan_with_too_many_steps_is_made_again_with_fewer() -> None:
    stage = stages(DROP)[0]
    cells = {A: (0, 0), B: (0, 1), C: (-1, 0), D: (-1, 1), E: (-2, 0), F: (-3, 2)}
    order = SortingTask(
        (0,), cells, dict.fromkeys(cells, frozenset({1, 2})), (), DROP, DEADLINE_S, stage=stage
    )
    asked: list[PlanRequest] = []

    def slow(request: PlanRequest, **limits: Any) -> PlanResponse:  # noqa: ANN401
        asked.append(request)
        response = plan(request, **limits)
        return evolve(response, steps=9) if len(asked) == 1 else response

    in_time = evolve(order, steps=3)
    found = sort_lanes(in_time, NODES, slow, time.monotonic)
    assert len(asked) == 2
    assert asked[1] == evolve(asked[0], max_steps=3, deadline_s=asked[1].deadline_s)
    assert found.response is not None
    assert found.response.steps is not None
    assert found.response.steps <= 3
