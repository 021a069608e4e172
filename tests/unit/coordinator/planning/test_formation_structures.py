"""Targets of the parallel and the interlaced structure, and requests that name a structure."""

from __future__ import annotations

from itertools import product
from typing import Any

import attrs
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment

from laneweave.coordinator.planning.formation_structures import (
    STRUCTURES,
    is_formed,
    shortage,
    structure_targets,
)
from laneweave.coordinator.planning.grid import Grid
from laneweave.coordinator.planning.plan_validator import problems_of_response
from laneweave.coordinator.planning.request import PlanRequest
from laneweave.coordinator.planning.response import PlanResponse
from laneweave.coordinator.planning.solve import plan
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.lattice import Cell
from support.examples import examples
from support.tables import for_each

INTERLACED = [[5, 1], [4, 0], [4, 2], [3, 1], [2, 0], [2, 2]]
LANE_DROP: dict[str, Any] = {
    "schema": "laneweave.plan.request/1",
    "grid": {"columns": 8, "lanes": 3},
    "vehicles": [{"id": f"v{i}", "cell": cell} for i, cell in enumerate(INTERLACED)],
    "structure": "parallel",
    "lanes": [0, 1],
}


def targets_of(structure: str, lanes: list[int], **changes: Any) -> set[Cell]:  # noqa: ANN401
    request = LANE_DROP | {"structure": structure, "lanes": lanes} | changes
    return set(PlanRequest.from_dict(request).resolved().targets)


# --- vehicles that name no lane ---------------------------------------------------------------


def test_a_parallel_structure_fills_its_columns() -> None:
    assert targets_of("parallel", [0, 1]) == set(product((2, 3, 4), (0, 1)))
    assert targets_of("parallel", [2]) == set(product(range(1, 7), (2,)))
    assert targets_of("parallel", [2, 0, 1]) == set(product((3, 4), (0, 1, 2)))


def test_an_interlaced_structure_takes_every_other_cell() -> None:
    assert targets_of("interlaced", [0, 1, 2]) == {(c, lane) for c, lane in INTERLACED}
    assert targets_of("interlaced", [0, 1]) == {(1, 1), (2, 0), (3, 1), (4, 0), (5, 1), (6, 0)}


def test_the_last_column_is_filled_from_the_right() -> None:
    vehicles = LANE_DROP["vehicles"][:4]
    assert targets_of("parallel", [0, 1, 2], vehicles=vehicles) == {
        *product((4,), (0, 1, 2)),
        (3, 0),
    }


def test_blocked_cells_are_left_out() -> None:
    grid = {"columns": 8, "lanes": 3, "blocked": [[3, 0], [4, 1]]}
    targets = targets_of("parallel", [0, 1], grid=grid)
    assert targets.isdisjoint({(3, 0), (4, 1)})
    assert len(targets) == 6


# --- vehicles that name lanes -----------------------------------------------------------------


@st.composite
def crowds(draw: st.DrawFn) -> tuple[Grid, list[Cell], list[int | None]]:
    columns, lanes = draw(st.integers(4, 7)), draw(st.integers(1, 3))
    everywhere = list(product(range(columns), range(lanes)))
    blocked = draw(st.lists(st.sampled_from(everywhere), max_size=3, unique=True))
    free = [cell for cell in everywhere if cell not in blocked]
    cells = draw(st.lists(st.sampled_from(free), min_size=1, max_size=5, unique=True))
    lane = st.integers(0, lanes - 1)
    named: st.SearchStrategy[list[int | None]] = st.lists(
        lane if draw(st.booleans()) else st.none() | lane,
        min_size=len(cells),
        max_size=len(cells),
    )
    return Grid(columns, lanes, blocked), cells, draw(named)


def cells_of(structure: str, grid: Grid, parity: int) -> list[Cell]:
    """All cells that a structure may use."""
    return [
        cell
        for cell in product(range(grid.columns), range(grid.lanes))
        if grid.is_free(cell) and (structure == "parallel" or sum(cell) % 2 == parity)
    ]


def total_way(starts: list[Cell], targets: list[Cell]) -> int:
    ways = np.array([[abs(a[0] - b[0]) + abs(a[1] - b[1]) for b in targets] for a in starts])
    rows, places = linear_sum_assignment(ways)
    return int(ways[rows, places].sum())


def shortest_total_way(
    structure: str, grid: Grid, cells: list[Cell], preferred: list[int | None]
) -> int | None:
    """Try every run of neighbouring cells on each lane; None: there are too few cells."""
    totals = []
    for parity in (0, 1):
        total = 0
        for lane in set(preferred):
            places = [c for c in cells_of(structure, grid, parity) if c[1] == lane]
            starts = [c for c, own in zip(cells, preferred, strict=True) if own == lane]
            runs = [places[i : i + len(starts)] for i in range(len(places) - len(starts) + 1)]
            if not runs:
                break
            total += min(total_way(starts, run) for run in runs)
        else:
            totals.append(total)
    return min(totals, default=None)


@pytest.mark.slow
@examples(300)
@given(crowds(), st.sampled_from(STRUCTURES))
def test_targets_of_vehicles_that_name_no_lane_form_the_structure(
    crowd: tuple[Grid, list[Cell], list[int | None]], structure: str
) -> None:
    grid, cells, _ = crowd
    lanes = range(grid.lanes)
    assume(shortage(structure, lanes, grid, [None] * len(cells)) is None)
    targets = structure_targets(structure, lanes, grid, cells, [None] * len(cells))
    assert is_formed(structure, lanes, grid, targets)
    if not any({*cells} <= {*cells_of(structure, grid, parity)} for parity in (0, 1)):
        assert not is_formed(structure, lanes, grid, cells)


@for_each(
    ("structure", "cells", "formed"),
    [
        ("parallel", [(3, 0), (3, 1), (3, 2)], True),
        ("parallel", [(3, 0), (3, 1), (1, 0)], False),  # a gap
        ("parallel", [(3, 1), (3, 2)], False),  # filled from the left
        ("interlaced", [(4, 0), (4, 2), (3, 1)], True),
        ("interlaced", [(5, 0), (5, 2), (4, 1)], True),
        ("interlaced", [(5, 0), (5, 2), (4, 0)], False),  # even and odd cells
        ("parallel", [], True),
    ],
)
def test_structures_are_formed_wherever_their_front_is(
    structure: str, cells: list[Cell], formed: bool
) -> None:
    assert is_formed(structure, range(3), Grid(8, 3), cells) is formed


@pytest.mark.slow
@examples(300)
@given(crowds(), st.sampled_from(STRUCTURES))
def test_targets_are_a_structure_with_the_shortest_total_distance(
    crowd: tuple[Grid, list[Cell], list[int | None]], structure: str
) -> None:
    grid, cells, preferred = crowd
    try:
        targets = structure_targets(structure, range(grid.lanes), grid, cells, preferred)
    except ValueError:
        for parity in (0, 1):
            places = cells_of(structure, grid, parity)
            lanes = [lane for _, lane in places]
            few = [lane for lane in preferred if lane is not None]
            assert len(places) < len(cells) or any(
                few.count(lane) > lanes.count(lane) for lane in few
            )
        return
    assert len(set(targets)) == len(cells)
    assert any(set(targets) <= set(cells_of(structure, grid, parity)) for parity in (0, 1))
    for lane in set(preferred) - {None}:
        assert sum(target[1] == lane for target in targets) >= preferred.count(lane)
    if None not in preferred:
        assert sorted(lane for _, lane in targets) == sorted(preferred, key=str)
        wanted = [[t for t in targets if t[1] == lane] for lane in sorted({t[1] for t in targets})]
        ways = sum(
            total_way([c for c, own in zip(cells, preferred, strict=True) if own == run[0][1]], run)
            for run in wanted
        )
        assert ways == shortest_total_way(structure, grid, cells, preferred)
    else:
        _assert_filled(structure, grid, list(targets), preferred)


def _assert_filled(
    structure: str, grid: Grid, targets: list[Cell], preferred: list[int | None]
) -> None:
    """All cells behind the front are used, except those behind the last one of their lane."""
    front, parity = max(targets)[0], sum(targets[0]) % 2
    for lane in {lane for _, lane in targets}:
        rear = min(column for column, own in targets if own == lane)
        for column, own in cells_of(structure, grid, parity):
            if own == lane and rear <= column <= front:
                assert (column, lane) in targets
    assert len(targets) == len(preferred)


# --- requests ---------------------------------------------------------------------------------


def test_the_response_holds_the_targets_of_the_structure() -> None:
    request = PlanRequest.from_dict(LANE_DROP)
    response = plan(request)
    assert response.status == "optimal"
    assert response.targets is not None
    ends = [response.targets[target] for target in response.assignment]
    assert ends == [path[-1] for path in response.paths]
    assert PlanResponse.from_dict(response.to_dict()) == response
    assert PlanRequest.from_dict(request.to_dict()) == request
    by_hand = request.with_targets(response.targets)
    assert by_hand.to_dict()["targets"] == [list(target) for target in response.targets]
    assert attrs.evolve(plan(by_hand), targets=response.targets, solve_ms=0.0) == (
        attrs.evolve(response, solve_ms=0.0)
    )


def test_targets_of_another_structure_are_detected() -> None:
    request = PlanRequest.from_dict(LANE_DROP | {"structure": "interlaced"})
    response = plan(request)
    assert response.targets is not None
    wrong = [
        (*response.targets[:-1], (0, 2)),
        (*response.targets[:-1], (0, 0), (1, 0)),
        response.targets[:-1],
        (*response.targets[:-1], response.targets[0]),
        (*response.targets[:-1], (8, 0)),
        (*response.targets[:-1], (response.targets[0][0] + 1, response.targets[0][1])),
    ]
    for targets in wrong:
        assert problems_of_response(request, attrs.evolve(response, targets=targets))
    assert problems_of_response(request, attrs.evolve(response, targets=None))
    assert not problems_of_response(request, response)


@for_each(
    ("changes", "line"),
    [
        ({"structure": "wedge"}, "structure: got 'wedge'; allowed: one of parallel, interlaced"),
        ({"structure": 3}, "structure: got 3; allowed: a string"),
        ({"targets": [[0, 0]]}, "allowed: structure or targets, not both"),
        ({"targets": []}, "allowed: structure or targets, not both"),
        ({"lanes": []}, "lanes: got 0 items; allowed: 1 to 16 items"),
        ({"lanes": 1}, "lanes: got 1; allowed: a list"),
        ({"lanes": [0, 3]}, "lanes[1]: got 3; allowed: a whole number from 0 to 2"),
        ({"lanes": [[0]]}, "lanes[0]: got [0]; allowed: an integer"),
        ({"lanes": [1, 1]}, "lanes[1]: got 1; allowed: each lane once"),
        (
            {"vehicles": [{"id": "a", "cell": [0, 0], "lane": 2}]},
            "vehicles[0].lane: got 2; allowed: one of the structure's lanes 0, 1",
        ),
        (
            {"vehicles": [{"id": "a", "cell": [0, 0], "moves": [[0, 1]]}]},
            "vehicles[0].moves: got ((0, 1),); allowed: none: any vehicle may get any place",
        ),
        (
            {"vehicles": [{"id": "a", "cell": [0, 0], "eligible": [0]}]},
            "vehicles[0].eligible: got (0,); allowed: lane, or neither",
        ),
        (
            {"grid": {"columns": 6, "lanes": 3}, "structure": "interlaced", "lanes": [0]},
            "a structure with a free cell for each vehicle; its lanes have 3 such cells for 6",
        ),
    ],
)
def test_impossible_structures_are_refused(changes: dict[str, Any], line: str) -> None:
    with pytest.raises(BadInputError) as refused:
        PlanRequest.from_dict(LANE_DROP | changes)
    assert line in str(refused.value)


def test_errors_name_a_lane_with_too_many_vehicles() -> None:
    vehicles = [vehicle | {"lane": 1} for vehicle in LANE_DROP["vehicles"]]
    grid = {"columns": 6, "lanes": 3, "blocked": [[0, 1]]}
    with pytest.raises(BadInputError, match="lane 1 has 5 such cells for 6 vehicles"):
        PlanRequest.from_dict(LANE_DROP | {"vehicles": vehicles, "grid": grid})


def test_lanes_belong_to_a_structure() -> None:
    request = {name: value for name, value in LANE_DROP.items() if name != "structure"}
    with pytest.raises(BadInputError, match=r"lanes: got .*unless a structure is given"):
        PlanRequest.from_dict(request | {"targets": [[c, 0] for c in range(6)]})
