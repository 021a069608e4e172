"""Diagrams and the choice of a path, compared with listing all paths."""

import itertools
from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from laneweave.coordinator.planning.conflict_kinds import ConflictModel
from laneweave.coordinator.planning.grid import Grid
from laneweave.coordinator.planning.problem import Bans, Diagram, MoveTable, Path, bits
from laneweave.coordinator.planning.shortest_paths import (
    choose_path,
    conflicting_moves,
    shortest_paths,
)
from support.examples import examples
from support.planning_oracles import obeys

MODEL = ConflictModel(["node", "edge", "special-1"])
TABLES = [
    MoveTable(grid, mode, MODEL)
    for grid in (Grid(3, 2), Grid(4, 1), Grid(3, 2, [(1, 0)]))
    for mode in (1, 2)
]
HORIZON = 6


def _walks(table: MoveTable, start: int, steps: int) -> Iterator[Path]:
    if steps == 0:
        yield ()
        return
    for bit in bits(table.starting_in(1 << start)):
        for rest in _walks(table, table.landing(bit), steps - 1):
            yield (bit, *rest)


def _all_shortest(table: MoveTable, start: int, target: int, bans: Bans) -> list[Path]:
    for cost in range(HORIZON):
        found = [
            path
            for path in _walks(table, start, cost)
            if (table.landing(path[-1]) if path else start) == target
            and path[-1:] != (target,)  # otherwise it arrived earlier
            and obeys(path, target, bans)
        ]
        if found:
            return found
    return []


def _listed(table: MoveTable, diagram: Diagram) -> set[Path]:
    found = set()
    for path in itertools.product(*(list(bits(layer)) for layer in diagram.layers)):
        cells = [table.landing(bit) for bit in path]
        starts = [bit - bit % table.fan for bit in path]
        if cells[:-1] == starts[1:]:
            found.add(path)
    return found


@st.composite
def problems(draw: st.DrawFn) -> tuple[MoveTable, int, int, Bans]:
    table = draw(st.sampled_from(TABLES))
    cells = list(bits(table.cells))
    moves = list(bits(table.valid))
    some = st.lists(st.sampled_from(moves), max_size=4).map(lambda b: sum(1 << m for m in set(b)))
    at = draw(st.dictionaries(st.integers(0, 2), some, max_size=3))
    since = draw(st.dictionaries(st.integers(0, 2), some, max_size=1))
    earliest = draw(st.just(0) | st.integers(0, 4))
    latest = draw(st.none() | st.integers(0, 4))
    start, target = draw(st.sampled_from(cells)), draw(st.sampled_from(cells))
    return table, start, target, Bans(at, since, earliest, latest)


@pytest.mark.slow
@examples(150)
@given(problems())
def test_diagram_holds_all_shortest_paths(case: tuple[MoveTable, int, int, Bans]) -> None:
    table, start, target, bans = case
    diagram = shortest_paths(table, start, target, bans)
    expected = _all_shortest(table, start, target, bans)
    if diagram is None:
        assert expected == []
    elif diagram.cost < HORIZON:
        assert _listed(table, diagram) == set(expected)


@pytest.mark.slow
@examples(100)
@given(problems(), st.data())
def test_choice_has_fewest_conflicts_then_fewest_moves_then_lowest_index(
    case: tuple[MoveTable, int, int, Bans], data: st.DataObject
) -> None:
    table, start, target, bans = case
    diagram = shortest_paths(table, start, target, bans)
    if diagram is None or diagram.cost > 4:
        return
    moves = list(bits(table.valid))
    some = st.lists(st.sampled_from(moves), max_size=6).map(lambda b: sum(1 << m for m in set(b)))
    taken = [data.draw(some) for _ in range(diagram.cost)]

    def worth(path: Path) -> tuple[int, int, Path]:
        conflicts = sum(taken[step] >> bit & 1 for step, bit in enumerate(path))
        return conflicts, sum(bit % table.fan > 0 for bit in path), path

    expected = min(_listed(table, diagram), key=worth)
    assert choose_path(table, diagram, taken) == expected


def test_a_target_that_must_be_left_is_reached_again_later() -> None:
    table = MoveTable(Grid(3, 1), 1, MODEL)
    middle = table.bit((1, 0))
    diagram = shortest_paths(table, middle, middle, Bans(at={2: 1 << middle}))
    assert diagram is not None
    assert diagram.cost == 3
    path = choose_path(table, diagram, [0] * 3)
    assert [table.move(bit)[1] for bit in path] == [(1, 0), (2, 0), (1, 0)]


def test_others_conflict_while_they_move_and_when_they_have_arrived() -> None:
    table = MoveTable(Grid(3, 1), 1, ConflictModel(["node"]))
    right, middle = table.bit((2, 0)), table.bit((1, 0))
    path = (table.number(((2, 0), (1, 0))),)
    taken = conflicting_moves(table, [(path, middle)], 2)
    into_the_middle = table.leading_to(1 << middle)
    assert taken == [into_the_middle, into_the_middle]
    assert not taken[0] >> right & 1
