"""The validator finds every kind of error in a plan."""

from typing import Any

import attrs
import pytest

from laneweave.coordinator.planning.grid import Grid
from laneweave.coordinator.planning.plan_validator import problems_of_paths, problems_of_response
from laneweave.coordinator.planning.request import PlanRequest, VehicleRequest
from laneweave.coordinator.planning.response import PlanResponse
from laneweave.coordinator.planning.solve import plan
from laneweave.protocol.lattice import Cell, Mode
from support.tables import for_each

REQUEST = PlanRequest(
    Grid(4, 3, [(0, 2)]),
    1,
    ("node", "edge", "special-1"),
    (VehicleRequest("a", (0, 0), lane=0), VehicleRequest("b", (1, 1), eligible=(1, 2))),
    ((2, 0), (1, 2), (3, 0)),
    deadline_s=60.0,
)
ASSIGNMENT = (0, 1)
GOOD: tuple[tuple[Cell, ...], ...] = (
    ((0, 0), (1, 0), (2, 0)),
    ((1, 1), (1, 2), (1, 2)),
)


def test_a_good_plan_has_no_problems() -> None:
    assert problems_of_paths(REQUEST, ASSIGNMENT, GOOD) == []


A, B = GOOD
BAD: list[tuple[tuple[int, ...], tuple[tuple[Cell, ...], ...], str]] = [
    ((0,), GOOD, "2 vehicles"),
    (ASSIGNMENT, (A,), "2 vehicles"),
    (ASSIGNMENT, (A, B[:2]), "different lengths"),
    (ASSIGNMENT, ((), ()), "different lengths"),
    (ASSIGNMENT, (((1, 0), (1, 0), (2, 0)), B), "a starts at"),
    (ASSIGNMENT, (((0, 0), (0, 0), (2, 0)), B), "a jumps"),
    (ASSIGNMENT, (A, ((1, 1), (0, 2), (1, 2))), "b jumps"),
    (ASSIGNMENT, (A, ((1, 1), (0, 2), (1, 2))), "blocked or outside"),
    (ASSIGNMENT, (((0, 0), (0, -1), (2, 0)), B), "blocked or outside"),
    (ASSIGNMENT, (((0, 0), (1, 0), (1, 0)), B), "a ends at"),
    ((1, 1), (((0, 0), (1, 0), (1, 2)), B), "prefers lane 0"),
    ((0, 0), (A, ((1, 1), (1, 0), (2, 0))), "not eligible"),
    ((0, 0), (A, ((1, 1), (1, 0), (2, 0))), "both assigned"),
    ((0, 7), GOOD, "does not exist"),
    ((0, -1), GOOD, "does not exist"),
    (ASSIGNMENT, (A, ((1, 1), (1, 0), (1, 1))), "node conflict of a and b in step 1"),
    (
        ASSIGNMENT,
        (((0, 0), (1, 0), (1, 1)), ((1, 1), (1, 1), (1, 0))),
        "edge conflict of a and b in step 2",
    ),
    (
        ASSIGNMENT,
        (((0, 0), (1, 0), (1, 1)), ((1, 1), (1, 1), (1, 2))),
        "special-1 conflict of a and b in step 2",
    ),
]


@for_each(("assignment", "paths", "text"), BAD)
def test_problems_are_found(
    assignment: tuple[int, ...], paths: tuple[tuple[Cell, ...], ...], text: str
) -> None:
    assert any(text in problem for problem in problems_of_paths(REQUEST, assignment, paths))


@pytest.mark.parametrize(("mode", "kinds"), [(1, REQUEST.conflicts), (2, ("geometric",))])
def test_closing_moves_three_columns_apart_are_compared(mode: Mode, kinds: tuple[str, ...]) -> None:
    vehicles = VehicleRequest("a", (0, 0), eligible=(0,)), VehicleRequest("b", (3, 0), lane=0)
    paths = ((0, 0), (1, 0)), ((3, 0), (2, 0))
    targets = ((1, 0), (2, 0))
    request = PlanRequest(Grid(4, 1), mode, (*kinds, "closing"), vehicles, targets)
    found = problems_of_paths(request, (0, 1), paths)
    assert found == ["closing conflict of a and b in step 1"]
    free = PlanRequest(Grid(4, 1), mode, kinds, vehicles, targets)
    assert problems_of_paths(free, (0, 1), paths) == []


def test_vehicles_make_only_moves_that_they_can_drive() -> None:
    def with_moves(*moves: Cell) -> PlanRequest:
        limited = attrs.evolve(REQUEST.vehicles[1], moves=moves)
        return attrs.evolve(REQUEST, vehicles=(REQUEST.vehicles[0], limited))

    assert problems_of_paths(with_moves((0, 1)), ASSIGNMENT, GOOD) == []
    found = problems_of_paths(with_moves((0, -1), (1, 0)), ASSIGNMENT, GOOD)
    assert found == ["b cannot drive (1, 1) to (1, 2) in step 1"]


def test_oblique_moves_belong_to_mode_2() -> None:
    paths = (((0, 0), (1, 0), (2, 0)), ((1, 1), (2, 2), (1, 2)))
    assert any("b jumps" in p for p in problems_of_paths(REQUEST, ASSIGNMENT, paths))
    assert problems_of_paths(attrs.evolve(REQUEST, mode=2), ASSIGNMENT, paths) == []


def _response() -> PlanResponse:
    response = plan(REQUEST)
    assert response.status == "optimal"
    return response


def test_a_good_response_has_no_problems() -> None:
    assert problems_of_response(REQUEST, _response()) == []


@pytest.mark.parametrize(
    "change",
    [
        {"cost": 2},
        {"cost": None},
        {"steps": 7},
        {"lower_bound": 99},
        {"lower_bound": 0},
        {"lower_bound": None},
        {"status": "infeasible"},
        {"status": "timeout"},
        {"paths": ()},
        {"assignment": (1, 0)},
    ],
)
def test_wrong_claims_of_a_response_are_found(change: dict[str, Any]) -> None:
    assert problems_of_response(REQUEST, attrs.evolve(_response(), **change)) != []
