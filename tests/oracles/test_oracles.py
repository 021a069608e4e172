"""The oracles against each other, and the rules against cases worked out by hand."""

from itertools import permutations
from typing import Any

import pytest

from oracles import joint_search, milp_oracle
from oracles.instances import (
    CLOSING,
    EVERY_VARIANT,
    Variant,
    meeting_request,
    random_request,
    small_request,
)
from oracles.path_rules import KINDS, Move, Problem, check_paths, conflict_kinds
from support.variants import variants

DIAGONAL: Move = ((0, 0), (1, 1))
FOOTPRINT_KINDS = KINDS[: KINDS.index("geometric") + 1]
"""The kinds of the paper and `geometric`, which contains them."""
CLOSING_KINDS = (*FOOTPRINT_KINDS, "closing")

# The case study of the paper, cells from 0: cost 7 with node and edge conflicts in mode 2.
CASE_STUDY: dict[str, Any] = {
    "schema": "laneweave.plan.request/1",
    "grid": {"columns": 3, "lanes": 3},
    "mode": 2,
    "conflicts": ["node", "edge"],
    "vehicles": [
        {"id": "1", "cell": [0, 0], "eligible": [0, 3]},
        {"id": "2", "cell": [0, 2], "eligible": [0, 3]},
        {"id": "3", "cell": [1, 1], "eligible": [1, 4]},
        {"id": "4", "cell": [2, 0], "eligible": [1, 4]},
        {"id": "5", "cell": [2, 2], "eligible": [2]},
    ],
    "targets": [[0, 0], [0, 2], [1, 1], [2, 0], [2, 2]],
}


# ------------------------------------------------------------------------------------- rules


@pytest.mark.parametrize(
    ("a", "b", "kinds"),
    [
        # one moves to where the other stays; two move to one cell
        (((0, 0), (1, 0)), ((1, 0), (1, 0)), "node geometric"),
        (((0, 0), (1, 0)), ((2, 0), (1, 0)), "node geometric"),
        (((0, 0), (1, 0)), ((1, 1), (1, 0)), "node geometric"),
        # swap, straight and oblique
        (((0, 0), (1, 0)), ((1, 0), (0, 0)), "edge special-1 geometric"),
        (DIAGONAL, ((1, 1), (0, 0)), "edge special-1 geometric"),
        # crossing diagonals, in both directions of the second
        (DIAGONAL, ((1, 0), (0, 1)), "edge geometric"),
        (DIAGONAL, ((0, 1), (1, 0)), "edge geometric"),
        # one follows the other: straight on, round a corner, obliquely
        (((0, 0), (1, 0)), ((1, 0), (2, 0)), "special-1 geometric"),
        (((0, 0), (1, 0)), ((1, 0), (1, 1)), "special-1 geometric"),
        (DIAGONAL, ((1, 1), (2, 2)), "special-1 geometric"),
        # oblique and longitudinal in one square: away from its end, into its start, into its end
        (DIAGONAL, ((1, 1), (0, 1)), "special-1 special-2 geometric"),
        (DIAGONAL, ((1, 0), (0, 0)), "special-1 special-2 geometric"),
        (DIAGONAL, ((0, 1), (1, 1)), "node special-2 geometric"),
        # the same with a lateral move
        (DIAGONAL, ((1, 1), (1, 0)), "special-1 special-3 geometric"),
        (DIAGONAL, ((0, 1), (0, 0)), "special-1 special-3 geometric"),
        (DIAGONAL, ((1, 0), (1, 1)), "node special-3 geometric"),
        # out of one cell
        (DIAGONAL, ((0, 0), (1, 0)), "special-2 geometric"),
        (DIAGONAL, ((0, 0), (0, 1)), "special-3 geometric"),
        # three cells, but not those of one square
        (DIAGONAL, ((1, 1), (2, 1)), "special-1 geometric"),
        (DIAGONAL, ((1, 1), (1, 2)), "special-1 geometric"),
        # beside an oblique move: staying, leaving, coming
        (DIAGONAL, ((1, 0), (1, 0)), "special-4 geometric"),
        (DIAGONAL, ((0, 1), (0, 1)), "special-4 geometric"),
        (DIAGONAL, ((1, 0), (2, 0)), "special-2 geometric"),
        (DIAGONAL, ((2, 0), (1, 0)), "special-2 geometric"),
        (DIAGONAL, ((1, 0), (1, -1)), "special-3 geometric"),
        (DIAGONAL, ((1, -1), (1, 0)), "special-3 geometric"),
        (DIAGONAL, ((1, 0), (2, 1)), "geometric"),
        (DIAGONAL, ((1, 0), (2, -1)), "geometric"),
        # side by side, and apart
        (((0, 0), (1, 0)), ((0, 1), (1, 1)), ""),
        (DIAGONAL, ((0, 2), (1, 2)), ""),
        (DIAGONAL, ((1, 2), (2, 2)), ""),
        (DIAGONAL, ((0, -1), (1, 0)), "geometric"),
        (DIAGONAL, ((0, 2), (1, 3)), ""),
        (((0, 0), (0, 0)), ((1, 0), (2, 0)), ""),
    ],
)
def test_two_moves(a: Move, b: Move, kinds: str) -> None:
    for first, second in ((a, b), (b, a)):
        assert conflict_kinds(first, second, FOOTPRINT_KINDS) == kinds.split()
        for turn in (_turned, _mirrored):
            swapped = conflict_kinds(turn(first), turn(second), FOOTPRINT_KINDS)
            exchange = {"special-2": "special-3", "special-3": "special-2"}
            expected = [exchange.get(k, k) for k in kinds.split()] if turn is _turned else None
            assert swapped == (expected or kinds.split())


def _turned(move: Move) -> Move:
    """Columns and lanes exchanged, which exchanges longitudinal and lateral."""
    return ((move[0][1], move[0][0]), (move[1][1], move[1][0]))


def _mirrored(move: Move) -> Move:
    return ((-move[0][0], move[0][1]), (-move[1][0], move[1][1]))


@pytest.mark.parametrize(
    ("a", "b", "closing"),
    [
        # two free cells become none: on one lane, and where lanes are changed
        (((0, 0), (1, 0)), ((3, 0), (2, 0)), True),
        (DIAGONAL, ((3, 1), (2, 1)), True),
        (DIAGONAL, ((3, 0), (2, 0)), True),
        (DIAGONAL, ((3, 1), (2, 0)), True),
        (DIAGONAL, ((3, 2), (2, 1)), True),
        (DIAGONAL, ((3, 0), (2, -1)), True),
        (DIAGONAL, ((3, 1), (2, 2)), True),
        (((0, 1), (1, 0)), ((3, 1), (2, 1)), True),
        (((0, 0), (1, 0)), ((3, 0), (2, 1)), True),
        # no lane of both
        (((0, 0), (1, 0)), ((3, 1), (2, 1)), False),
        (DIAGONAL, ((3, 2), (2, 2)), False),
        (((0, 0), (1, -1)), ((3, 1), (2, 2)), False),
        # three become one, two become one or stay two
        (((0, 0), (1, 0)), ((4, 0), (3, 0)), False),
        (((0, 0), (1, 0)), ((3, 0), (3, 0)), False),
        (((0, 0), (1, 0)), ((3, 0), (3, 1)), False),
        (((0, 0), (1, 0)), ((3, 0), (4, 0)), False),
        (((1, 0), (0, 0)), ((3, 0), (4, 0)), False),
        (((1, 0), (0, 0)), ((2, 0), (3, 0)), False),
    ],
)
def test_two_that_close_up(a: Move, b: Move, closing: bool) -> None:
    for turn in (lambda move: move, _mirrored):
        for first, second in ((a, b), (b, a)):
            found = conflict_kinds(turn(first), turn(second), CLOSING_KINDS)
            assert found == ["closing"] * closing


def test_edge_conflict_is_where_the_points_on_two_paths_meet() -> None:
    """Points that travel at constant speed and are neither at the start nor the end together."""
    moves = [((0, 0), (dc, dl)) for dc in (-1, 0, 1) for dl in (-1, 0, 1) if (dc, dl) != (0, 0)]
    starts = [(c, lane) for c in range(-2, 3) for lane in range(-2, 3) if (c, lane) != (0, 0)]
    for a in moves:
        for start in starts:
            for _, (dc, dl) in moves:
                b = (start, (start[0] + dc, start[1] + dl))
                meet = a[1] != b[1] and any(
                    all(
                        (4 - k) * (a[0][axis] - b[0][axis]) + k * (a[1][axis] - b[1][axis]) == 0
                        for axis in (0, 1)
                    )
                    for k in (1, 2, 3)
                )
                assert ("edge" in conflict_kinds(a, b)) == meet


def test_faults_in_a_response_are_found() -> None:
    request: dict[str, Any] = {
        "grid": {"columns": 3, "lanes": 2, "blocked": [[2, 0]]},
        "mode": 1,
        "vehicles": [{"id": "a", "cell": [0, 0], "lane": 0}, {"id": "b", "cell": [0, 1]}],
        "targets": [[1, 0], [1, 1]],
    }
    good: dict[str, Any] = {
        "cost": 2,
        "lower_bound": 2,
        "steps": 1,
        "assignment": [0, 1],
        "paths": [[[0, 0], [1, 0]], [[0, 1], [1, 1]]],
    }
    assert check_paths(request, good) == []
    faults: list[tuple[dict[str, Any], str]] = [
        ({"cost": 1}, "the paths cost 2"),
        ({"lower_bound": 3}, "lower bound"),
        ({"steps": 2}, "lengths of paths"),
        ({"assignment": [1, 0]}, "not eligible"),
        ({"assignment": [0, 0]}, "assigned twice"),
        ({"assignment": [0]}, "1 assigned"),
        ({"paths": [[[0, 0], [1, 0]], [[0, 1], [0, 1]]]}, "not at target 1"),
        ({"paths": [[[0, 0], [1, 0]], [[0, 0], [1, 1]]]}, "not a move"),
        ({"paths": [[[0, 0], [1, 0]], [[1, 0], [1, 1]]]}, "starts at (1, 0)"),
        ({"paths": [[[0, 0], [1, 0]], [[0, 1], [1, 0]]]}, "node"),
        ({"paths": [[[0, 0], [2, 0]], [[0, 1], [1, 1]]]}, "(2, 0) is not free"),
        ({"paths": [[[0, 0], [1, 0]], [[0, 1], [0, 2]]]}, "(0, 2) is not free"),
    ]
    for change, message in faults:
        found = check_paths(request, {**good, **change})
        assert any(message in fault for fault in found), (change, found)


# ----------------------------------------------------------------------------------- oracles


def _assert_oracles_agree(request: dict[str, Any]) -> int | None:
    exact = joint_search.optimal_response(request)
    solution = milp_oracle.optimal_solution(request)
    if exact is None or solution is None:
        assert exact is None
        assert solution is None
        return None
    assert check_paths(request, exact) == []
    assert check_paths(request, solution.response()) == []
    assert solution.cost == exact["cost"]
    return solution.cost


@pytest.mark.parametrize("code", variants(range(len(EVERY_VARIANT)), 4))
def test_oracles_agree(code: int) -> None:
    mode, conflicts = EVERY_VARIANT[code]
    shapes = (3, 2, 2), (4, 2, 2), (3, 3, 2), (5, 3, 2), (3, 2, 3), (4, 2, 3), (3, 3, 3)
    for seed, (columns, lanes, count) in enumerate(shapes, 10 * code):
        request = small_request(
            seed, columns=columns, lanes=lanes, count=count, mode=mode, conflicts=conflicts
        )
        _assert_oracles_agree(request)


@pytest.mark.parametrize("chosen", CLOSING)
def test_oracles_agree_on_vehicles_that_meet(chosen: Variant) -> None:
    requests = [meeting_request(seed, chosen) for seed in range(40)]
    costs = [_assert_oracles_agree(r) for r in requests if len(r["vehicles"]) == 2]
    assert len(costs) >= 5


@pytest.mark.parametrize("kinds", [*KINDS, "edge special-1", "special-2 special-4", ""])
def test_oracles_agree_on_each_kind_alone(kinds: str) -> None:
    for seed in range(3):
        request = small_request(seed, columns=3, lanes=2, count=2, mode=2, conflicts=kinds.split())
        _assert_oracles_agree(request)


@pytest.mark.parametrize("mode", [1, 2])
def test_exchange_at_the_only_bay(mode: int) -> None:
    """Two vehicles exchange places at the only bay of a lane."""
    request = {
        "grid": {
            "columns": 6,
            "lanes": 2,
            "blocked": [[0, 1], [1, 1], [2, 1], [4, 1], [5, 1]],
        },
        "mode": mode,
        "conflicts": ["node", "edge", "special-1"],
        "vehicles": [
            {"id": "a", "cell": [0, 0], "eligible": [0]},
            {"id": "b", "cell": [1, 0], "eligible": [1]},
        ],
        "targets": [[1, 0], [0, 0]],
    }
    assert _assert_oracles_agree(request) is not None
    problem = Problem.of(request)
    fewest = milp_oracle.fewest_steps(problem)
    assert fewest is not None
    assert milp_oracle.solve(problem, fewest - 1) is None
    assert milp_oracle.solve(problem, fewest) is not None


def test_exchange_without_a_bay_is_infeasible() -> None:
    request = {
        "grid": {"columns": 5, "lanes": 1},
        "mode": 1,
        "vehicles": [
            {"id": "a", "cell": [0, 0], "eligible": [0]},
            {"id": "b", "cell": [1, 0], "eligible": [1]},
        ],
        "targets": [[1, 0], [0, 0]],
    }
    assert _assert_oracles_agree(request) is None


@pytest.mark.more
def test_start_of_the_horizon_does_not_matter() -> None:
    for seed in (3, 27, 51):
        request = random_request(seed)
        costs = {milp_oracle.optimal_cost(request, horizon) for horizon in (1, 6, 10)}
        assert len(costs) == 1


def test_rows_cover_exactly_the_moves_that_exclude_one_another() -> None:
    for mode, conflicts in EVERY_VARIANT:
        request = small_request(1, columns=3, lanes=3, count=2, mode=mode, conflicts=conflicts)
        problem = Problem.of(request)
        covered = {
            pair
            for clique in milp_oracle.conflict_cliques(problem)
            for pair in permutations(clique, 2)
        }
        moves = [move for cell in problem.free_cells() for move in problem.moves_from(cell)]
        expected = {
            (a, b) for a, b in permutations(moves, 2) if a[0] == b[0] or problem.conflict(a, b)
        }
        assert covered == expected


def test_case_study_of_the_paper() -> None:
    solution = milp_oracle.optimal_solution(CASE_STUDY)
    assert solution is not None
    assert check_paths(CASE_STUDY, solution.response()) == []
    assert solution.cost == 7


@pytest.mark.parametrize(("assignment", "cost"), [((0, 3, 1, 4, 2), 7), ((0, 3, 4, 1, 2), 8)])
def test_assignments_of_the_case_study(assignment: tuple[int, ...], cost: int) -> None:
    vehicles = [
        {**vehicle, "eligible": [j]}
        for vehicle, j in zip(CASE_STUDY["vehicles"], assignment, strict=True)
    ]
    assert milp_oracle.optimal_cost({**CASE_STUDY, "vehicles": vehicles}) == cost
