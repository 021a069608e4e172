"""Children of a node keep all solutions; disjoint children have each solution once."""

import itertools
from collections.abc import Iterator

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from laneweave.coordinator.planning.conflict_model import ConflictModel
from laneweave.coordinator.planning.paper.constraints import (
    Conflict,
    Constraint,
    bans_for,
    cardinality,
    constraints_of,
    disjoint_constraints,
    is_at_node,
)
from laneweave.coordinator.planning.problem import Bans, Diagram, Grid, MoveTable, Path, bits
from laneweave.coordinator.planning.shortest_paths import choose_path, shortest_paths
from laneweave.protocol.lattice import Mode
from laneweave.protocol.scenario.fields import CONFLICT_KINDS

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


def _move(path: Path, target: int, step: int) -> int:
    return path[step] if step < len(path) else target


def _first_conflict(case: Case) -> Conflict | None:
    table, (a, b), (p, q) = case
    for step in range(max(len(p), len(q))):
        moves = _move(p, a.target, step), _move(q, b.target, step)
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
            table.conflicts[_move(p, a.target, step)] >> _move(q, b.target, step) & 1
            for step in steps
        ):
            yield p, q


def _obeys(path: Path, target: int, vehicle: int, constraints: tuple[Constraint, ...]) -> bool:
    bans = bans_for(vehicle, constraints)
    if len(path) < bans.earliest or (bans.latest is not None and len(path) > bans.latest):
        return False
    for step in range(max([len(path), *bans.at, *bans.since]) + 1):
        banned = bans.at.get(step, 0)
        for since, mask in bans.since.items():
            banned |= mask if step >= since else 0
        if banned >> _move(path, target, step) & 1:
            return False
    return True


def _in_child(case: Case, solution: tuple[Path, Path], constraints: tuple[Constraint, ...]) -> bool:
    return all(
        _obeys(path, diagram.target, vehicle, constraints)
        for vehicle, (path, diagram) in enumerate(zip(solution, case[1], strict=True))
    )


@settings(max_examples=80, deadline=None)
@given(pairs())
def test_each_solution_is_in_exactly_one_disjoint_child_and_in_one_of_the_papers(
    case: Case,
) -> None:
    table, diagrams, (p, q) = case
    conflict = _first_conflict(case)
    assume(conflict is not None)
    assert conflict is not None
    moves = _move(p, diagrams[0].target, conflict.step), _move(q, diagrams[1].target, conflict.step)
    disjoint = disjoint_constraints(table, conflict, moves, diagrams)
    of_the_paper = constraints_of(table, conflict, moves)
    for solution in itertools.islice(_solutions(case), 200):
        assert sorted(_in_child(case, solution, (c,)) for c in disjoint) == [False, True]
        assert any(_in_child(case, solution, (c,)) for c in of_the_paper)


@settings(max_examples=60, deadline=None)
@given(pairs())
def test_neither_child_keeps_the_conflicting_pair_of_moves(case: Case) -> None:
    table, diagrams, paths = case
    conflict = _first_conflict(case)
    assume(conflict is not None)
    assert conflict is not None
    moves = (
        _move(paths[0], diagrams[0].target, conflict.step),
        _move(paths[1], diagrams[1].target, conflict.step),
    )
    for make in (
        disjoint_constraints(table, conflict, moves, diagrams),
        constraints_of(table, conflict, moves),
    ):
        for constraint in make:
            assert not _in_child(case, paths, (constraint,))


def _cost_of_child(
    table: MoveTable, diagrams: tuple[Diagram, Diagram], constraints: tuple[Constraint, ...]
) -> int | None:
    total = 0
    for vehicle, diagram in enumerate(diagrams):
        (start,) = bits(table.starts(diagram.layer(0)))
        bans = bans_for(vehicle, constraints)
        narrowed = shortest_paths(table, start, diagram.target, bans)
        if narrowed is None:
            return None
        total += narrowed.cost
    return total


@settings(max_examples=60, deadline=None)
@given(pairs())
def test_children_cost_more_as_predicted(case: Case) -> None:
    table, diagrams, (p, q) = case
    conflict = _first_conflict(case)
    assume(conflict is not None)
    assert conflict is not None
    moves = _move(p, diagrams[0].target, conflict.step), _move(q, diagrams[1].target, conflict.step)
    children = disjoint_constraints(table, conflict, moves, diagrams)
    costs = [_cost_of_child(table, diagrams, (c,)) for c in children]
    before = diagrams[0].cost + diagrams[1].cost
    rising = sum(cost is None or cost > before for cost in costs)
    assert rising >= cardinality(table, conflict, moves, diagrams)


@pytest.mark.parametrize("vehicle", [0, 1])
def test_a_constraint_spares_a_diagram_that_it_does_not_touch(vehicle: int) -> None:
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
