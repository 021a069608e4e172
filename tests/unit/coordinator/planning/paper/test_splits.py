"""Children of a node keep all solutions; disjoint children have each solution once."""

import itertools
import math
from collections.abc import Iterator

import pytest
from hypothesis import HealthCheck, assume, given
from hypothesis import strategies as st

from laneweave.coordinator.planning.conflict_kinds import ConflictModel
from laneweave.coordinator.planning.grid import Grid
from laneweave.coordinator.planning.paper.constraints import (
    Conflict,
    Constraint,
    bans_for,
    cardinality,
    constraints_of,
    disjoint_constraints,
    is_at_node,
)
from laneweave.coordinator.planning.problem import Bans, Diagram, MoveTable, Path, bits
from laneweave.coordinator.planning.shortest_paths import choose_path, shortest_paths
from laneweave.protocol.lattice import Mode
from laneweave.protocol.scenario.formation_table import CONFLICT_KINDS
from support.examples import examples
from support.planning_oracles import move_at, obeys

STEPS = 3
Case = tuple[MoveTable, tuple[Diagram, Diagram], tuple[Path, Path]]


@st.composite
def pairs(draw: st.DrawFn) -> Case:
    """Draw two vehicles with different starts and targets, planned on their own."""
    mode: Mode = draw(st.sampled_from([1, 2]))
    kinds = draw(st.lists(st.sampled_from(CONFLICT_KINDS), min_size=1, unique=True))
    table = MoveTable(draw(st.sampled_from([Grid(3, 2), Grid(4, 1)])), mode, ConflictModel(kinds))
    cells = list(bits(table.cells))
    starts = draw(st.permutations(cells))[:2]
    targets = draw(st.permutations(cells))[:2]
    diagrams = [
        shortest_paths(table, start, target, Bans())
        for start, target in zip(starts, targets, strict=True)
    ]
    first, second = diagrams
    assert first is not None
    assert second is not None
    paths = tuple(choose_path(table, d, [0] * d.cost) for d in (first, second))
    return table, (first, second), (paths[0], paths[1])


def _first_conflict(case: Case) -> Conflict | None:
    table, (a, b), (p, q) = case
    for step in range(max(len(p), len(q))):
        moves = move_at(p, a.target, step), move_at(q, b.target, step)
        if table.conflicts[moves[0]] >> moves[1] & 1:
            return Conflict(step, not is_at_node(table, *moves), 0, 1)
    return None


def _arrivals(table: MoveTable, diagram: Diagram) -> Iterator[Path]:
    """Yield all paths of up to `STEPS` steps that end with the final arrival."""
    (start,) = bits(table.starts(diagram.layer(0)))

    def extend(path: Path, cell: int) -> Iterator[Path]:
        if cell == diagram.target and (not path or path[-1] != diagram.target):
            yield path
        if len(path) < STEPS:
            for bit in bits(table.starting_in(1 << cell)):
                yield from extend((*path, bit), table.landing(bit))

    return extend((), start)


def _solutions(case: Case) -> Iterator[tuple[Path, Path]]:
    table, (a, b), _ = case
    for p, q in itertools.product(_arrivals(table, a), _arrivals(table, b)):
        steps = range(max(len(p), len(q)))
        if not any(
            table.conflicts[move_at(p, a.target, step)] >> move_at(q, b.target, step) & 1
            for step in steps
        ):
            yield p, q


def _in_child(case: Case, solution: tuple[Path, Path], constraint: Constraint) -> bool:
    return all(
        obeys(path, diagram.target, bans_for(vehicle, (constraint,)))
        for vehicle, (path, diagram) in enumerate(zip(solution, case[1], strict=True))
    )


MANY_WITHOUT_CONFLICT = [HealthCheck.filter_too_much]
"""Paths drawn at random often have no conflict."""


@st.composite
def conflicts(draw: st.DrawFn) -> tuple[Case, Conflict, tuple[int, int]]:
    """Draw two vehicles whose paths conflict, their first conflict, and its two moves."""
    case = draw(pairs())
    conflict = _first_conflict(case)
    assume(conflict is not None)
    assert conflict is not None
    _, (a, b), (p, q) = case
    moves = move_at(p, a.target, conflict.step), move_at(q, b.target, conflict.step)
    return case, conflict, moves


@pytest.mark.slow
@examples(40, suppress_health_check=MANY_WITHOUT_CONFLICT)
@given(conflicts())
def test_children_share_the_solutions_and_none_keeps_the_conflict(
    drawn: tuple[Case, Conflict, tuple[int, int]],
) -> None:
    """Each solution is in exactly one disjoint child, and in at least one of the paper's."""
    case, conflict, moves = drawn
    table, diagrams, paths = case
    disjoint = disjoint_constraints(table, conflict, moves, diagrams)
    of_the_paper = constraints_of(table, conflict, moves)
    for solution in itertools.islice(_solutions(case), 200):
        assert sorted(_in_child(case, solution, c) for c in disjoint) == [False, True]
        assert any(_in_child(case, solution, c) for c in of_the_paper)
    assert not any(_in_child(case, paths, c) for c in (*disjoint, *of_the_paper))


def _cost_of_child(
    table: MoveTable, diagrams: tuple[Diagram, Diagram], constraint: Constraint
) -> float:
    total = 0
    for vehicle, diagram in enumerate(diagrams):
        (start,) = bits(table.starts(diagram.layer(0)))
        bans = bans_for(vehicle, (constraint,))
        narrowed = shortest_paths(table, start, diagram.target, bans)
        if narrowed is None:
            return math.inf
        total += narrowed.cost
    return total


@pytest.mark.slow
@examples(30, suppress_health_check=MANY_WITHOUT_CONFLICT)
@given(conflicts())
@pytest.mark.more
def test_children_cost_more_as_predicted(drawn: tuple[Case, Conflict, tuple[int, int]]) -> None:
    (table, diagrams, _), conflict, moves = drawn
    children = disjoint_constraints(table, conflict, moves, diagrams)
    before = diagrams[0].cost + diagrams[1].cost
    rising = sum(_cost_of_child(table, diagrams, c) > before for c in children)
    assert rising >= cardinality(table, conflict, moves, diagrams)


@pytest.mark.parametrize("vehicle", [0, 1])
def test_a_constraint_is_satisfied_by_paths_without_its_moves(vehicle: int) -> None:
    table = MoveTable(Grid(3, 1), 1, ConflictModel(["node"]))
    diagram = shortest_paths(table, table.bit((0, 0)), table.bit((1, 0)), Bans())
    assert diagram is not None
    middle, right = 1 << table.bit((1, 0)), 1 << table.bit((2, 0))
    assert Constraint(vehicle, 2, right, right).is_satisfied_by(0, diagram)
    assert not Constraint(vehicle, 2, middle, middle).is_satisfied_by(0, diagram)
    arrived = Constraint(vehicle, 0, others=middle, arrived=True)
    assert not arrived.is_satisfied_by(0, diagram)
    late = Constraint(vehicle, 1, others=right, arrived=True)
    assert late.is_satisfied_by(0, diagram)
