"""Plans: dependencies against the definition in words, and every defect is found."""

from __future__ import annotations

import random
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from laneweave.protocol.lattice import Cell, PlannedMove
from laneweave.protocol.vehicle.plans import dependencies, followers, plan_problems
from laneweave.protocol.wire.messages import Name, Plan
from support.examples import examples
from support.states import make_plan

A, B, C = Name("a"), Name("b"), Name("c")


# a goes ahead, then b follows into the cell that a left, then to the side; c stands beside.
GOOD = make_plan(
    {A: (1, 0), B: (0, 0), C: (0, 2)},
    {
        A: ((0, (1, 0), (2, 0)),),
        B: ((1, (0, 0), (1, 0)), (3, (1, 0), (1, 1))),
        C: (),
    },
)


# --- an independent definition ----------------------------------------------------------------


def occupied_cells(origin: Cell, target: Cell) -> set[Cell]:
    """Return {from, to}, with both corner cells if the move is diagonal."""
    cells = {origin, target}
    if origin[0] != target[0] and origin[1] != target[1]:
        cells |= {(origin[0], target[1]), (target[0], origin[1])}
    return cells


def needs_in_words(plan: Plan, own: PlannedMove, other: Name) -> int:
    """1 + index of the other's last move in a step before whose footprint meets; 0: none."""
    step, origin, target = own
    earlier = [
        index
        for index, (other_step, *cells) in enumerate(plan.moves[other])
        if other_step < step
        and not occupied_cells(origin, target).isdisjoint(occupied_cells(*cells))
    ]
    return 1 + max(earlier) if earlier else 0


def is_executable_in_words(plan: Plan) -> bool:
    """Play a plan step by step: bodies never share a cell. The plan's shape is taken as good."""
    cells = dict(plan.start_cells)
    last = max((move[0] for own in plan.moves.values() for move in own), default=0)
    for step in range(last + 1):
        bodies = []
        for vehicle in plan.roster:
            targets = [target for at, _, target in plan.moves[vehicle] if at == step]
            target = targets[0] if targets else cells[vehicle]
            bodies.append(occupied_cells(cells[vehicle], target))
            cells[vehicle] = target
        if sum(map(len, bodies)) != len(set().union(*bodies)):
            return False
    return True


# --- drawing plans ----------------------------------------------------------------------------


def draw_plan(seed: int, *, careful: bool) -> Plan:
    """Draw a plan on a small grid; a careful one keeps the bodies of each step apart."""
    rng = random.Random(seed)
    grid = [(column, lane) for column in range(4) for lane in range(3)]
    names = [Name(f"v{index}") for index in range(rng.randint(1, 6))]
    starts = dict(zip(names, rng.sample(grid, len(names)), strict=True))
    cells, moves = dict(starts), {name: list[PlannedMove]() for name in names}
    for step in range(rng.randint(1, 8)):
        taken = {name: {cell} for name, cell in cells.items()}
        for name in rng.sample(names, len(names)):
            column, lane = cells[name]
            target = (column + rng.randint(-1, 1), lane + rng.randint(-1, 1))
            body = occupied_cells(cells[name], target)
            free = all(body.isdisjoint(taken[other]) for other in names if other != name)
            if target in grid and target != cells[name] and (free or not careful):
                moves[name].append((step, cells[name], target))
                taken[name] = body
        for name, own in moves.items():
            if own and own[-1][0] == step:
                cells[name] = own[-1][2]
    return make_plan(starts, {name: tuple(own) for name, own in moves.items()})


VALID_PLANS = st.integers(0, 2**32).map(lambda seed: draw_plan(seed, careful=True))
ANY_PLANS = st.integers(0, 2**32).map(lambda seed: draw_plan(seed, careful=False))


# --- dependencies -----------------------------------------------------------------------------


@examples(150)
@given(VALID_PLANS | ANY_PLANS)
def test_dependencies_are_those_of_the_definition(plan: Plan) -> None:
    for vehicle in plan.roster:
        needs = dependencies(plan, vehicle)
        assert len(needs) == len(plan.moves[vehicle])
        for own, found in zip(plan.moves[vehicle], needs, strict=True):
            expected = {
                other: needs_in_words(plan, own, other) for other in plan.roster if other != vehicle
            }
            assert found == {other: count for other, count in expected.items() if count}


@examples(150)
@given(VALID_PLANS | ANY_PLANS)
def test_the_steps_of_followers_are_those_of_moves_that_depend_on_the_vehicle(plan: Plan) -> None:
    for vehicle in plan.roster:
        expected = {
            move[0]
            for other in plan.roster
            for move, needs in zip(plan.moves[other], dependencies(plan, other), strict=True)
            if vehicle in needs
        }
        assert followers(plan, vehicle) == tuple(sorted(expected))


@examples(100)
@given(VALID_PLANS, st.integers(0, 2**32))
def test_any_order_that_keeps_the_waits_is_safe_and_ends(plan: Plan, seed: int) -> None:
    rng = random.Random(seed)
    needs = {vehicle: dependencies(plan, vehicle) for vehicle in plan.roster}
    done = dict.fromkeys(plan.roster, 0)
    bodies = {vehicle: {cell} for vehicle, cell in plan.start_cells.items()}
    moving: set[Name] = set()

    def may_start(vehicle: Name) -> bool:
        return (
            vehicle not in moving
            and done[vehicle] < len(needs[vehicle])
            and all(done[other] >= k for other, k in needs[vehicle][done[vehicle]].items())
        )

    while moving or any(map(may_start, plan.roster)):
        vehicle = rng.choice([name for name in plan.roster if name in moving or may_start(name)])
        _, origin, target = plan.moves[vehicle][done[vehicle]]
        if vehicle in moving:
            moving.remove(vehicle)
            done[vehicle] += 1
            bodies[vehicle] = {target}
        else:
            moving.add(vehicle)
            bodies[vehicle] = occupied_cells(origin, target)
        assert sum(map(len, bodies.values())) == len(set().union(*bodies.values()))
    assert done == {vehicle: len(plan.moves[vehicle]) for vehicle in plan.roster}


# --- problems ---------------------------------------------------------------------------------


def test_the_example_has_no_problems() -> None:
    assert plan_problems(GOOD) == []
    assert plan_problems(make_plan({}, {})) == []


@examples(300)
@given(VALID_PLANS | ANY_PLANS)
def test_a_plan_has_problems_exactly_if_bodies_meet(plan: Plan) -> None:
    assert (plan_problems(plan) == []) is is_executable_in_words(plan)


EVERYWHERE = tuple((column, lane) for column in range(-3, 6) for lane in range(-1, 5))


def with_moves(vehicle: Name, *moves: PlannedMove) -> dict[str, Any]:
    return {"moves": GOOD.moves | {vehicle: moves}}


DEFECTS: list[tuple[str, dict[str, Any]]] = [
    ("roster names a vehicle twice", {"roster": (A, B, C, A)}),
    ("incarnations does not cover", {"roster": (A, B, C, Name("d"))}),
    ("start_cells does not cover", {"roster": (A, B)}),
    ("incarnations does not cover", {"incarnations": {A: 1, B: 1}}),
    ("start_cells does not cover", {"start_cells": {A: (1, 0), B: (0, 0)}}),
    ("moves does not cover", {"moves": {A: (), B: ()}}),
    ("steps do not ascend", with_moves(B, (1, (0, 0), (1, 0)), (1, (1, 0), (1, 1)))),
    ("steps do not ascend", with_moves(B, (3, (0, 0), (1, 0)), (1, (1, 0), (1, 1)))),
    ("steps do not ascend", with_moves(A, (-1, (1, 0), (2, 0)))),
    ("but it is in", with_moves(B, (1, (5, 0), (5, 1)))),
    ("but it is in", with_moves(B, (1, (0, 0), (1, 0)), (3, (0, 0), (0, 1)))),
    ("not neighbours", with_moves(A, (0, (1, 0), (3, 0)))),
    ("not neighbours", with_moves(A, (0, (1, 0), (1, 2)))),
    ("not neighbours", with_moves(A, (0, (1, 0), (1, 0)))),
    (
        "start in the same cell",
        {"start_cells": GOOD.start_cells | {C: (1, 0)}, "territory": EVERYWHERE},
    ),
    ("meet in step 0", with_moves(B, (0, (0, 0), (1, 0)))),
    ("meet in step 1", with_moves(A)),
    ("meet in step 1", with_moves(C, (0, (0, 2), (0, 1)), (1, (0, 1), (0, 0)))),
    ("territory lacks", {"territory": GOOD.territory[1:]}),
    ("territory lacks", {"territory": ()}),
]


@pytest.mark.parametrize(("text", "changes"), DEFECTS)
def test_each_kind_of_defect_is_found(text: str, changes: dict[str, Any]) -> None:
    problems = plan_problems(replace(GOOD, **changes))
    assert any(text in problem for problem in problems), problems


@examples(60)
@given(VALID_PLANS)
def test_every_cell_of_the_territory_is_needed(plan: Plan) -> None:
    for index in range(len(plan.territory)):
        cells = plan.territory[:index] + plan.territory[index + 1 :]
        assert plan_problems(replace(plan, territory=cells))
