"""Targets: one for each vehicle, on its lane if possible, with short paths."""

from __future__ import annotations

from itertools import combinations, permutations

from hypothesis import given
from hypothesis import strategies as st

from laneweave.coordinator.planning.targets import (
    Targets,
    placements,
    reachable_lanes,
)
from laneweave.protocol.lattice import Cell
from laneweave.protocol.wire.messages import Name
from support.examples import examples

COLUMNS, LANES = 4, 3
GRID = [(column, lane) for column in range(COLUMNS) for lane in range(LANES)]


@st.composite
def formations(
    draw: st.DrawFn, *, most_blocked: int = 4, fitting: bool = False
) -> tuple[dict[Name, Cell], dict[Name, int], set[Cell]]:
    """Draw cells, preferred lanes and blocked cells; `fitting`: no lane is overfull."""
    blocked = set(draw(st.lists(st.sampled_from(GRID), max_size=most_blocked, unique=True)))
    free = [cell for cell in GRID if cell not in blocked]
    cells = draw(st.lists(st.sampled_from(free), max_size=min(6, len(free)), unique=True))
    names = [Name(f"v{index}") for index in range(len(cells))]
    if fitting:
        lanes = [lane for _, lane in draw(st.permutations(free))]
    else:
        lanes = draw(st.lists(st.integers(0, LANES - 1), min_size=6, max_size=6))
    return (
        dict(zip(names, cells, strict=True)),
        dict(zip(names, lanes, strict=False)),
        blocked,
    )


def way(cell: Cell, target: Cell) -> int:
    return abs(cell[0] - target[0]) + abs(cell[1] - target[1])


def place_all(
    cells: dict[Name, Cell], lanes: dict[Name, int], blocked: set[Cell] | None = None
) -> Targets:
    return next(placements(cells, lanes, COLUMNS, LANES, blocked or set()))


def parallel_targets(
    lane: int, cells: list[Cell], columns: int, free: list[int] | None = None
) -> list[Cell]:
    """Return the targets on a lane that all vehicles prefer."""
    open_columns = range(columns) if free is None else free
    blocked = {(column, lane) for column in range(columns) if column not in open_columns}
    held = {Name(f"v{index}"): cell for index, cell in enumerate(cells)}
    targets = next(placements(held, dict.fromkeys(held, lane), columns, LANES, blocked))
    return [cell for cell in targets.cells if cell not in targets.off_lane.values()]


# --- a whole formation ------------------------------------------------------------------------


@examples(200)
@given(formations())
def test_each_lane_provides_free_cells_for_those_who_prefer_it(
    drawn: tuple[dict[Name, Cell], dict[Name, int], set[Cell]],
) -> None:
    """Exactly the vehicles that do not fit on their lanes get individual targets."""
    cells, lanes, blocked = drawn
    targets = place_all(cells, lanes, blocked)
    assert len(targets.cells) == len(set(targets.cells)) == len(cells)
    assert set(targets.cells) <= set(GRID) - blocked
    shared = [cell for cell in targets.cells if cell not in targets.off_lane.values()]
    for lane in range(LANES):
        wanting = [name for name in cells if lanes[name] == lane]
        free = sum((column, lane) not in blocked for column in range(COLUMNS))
        assert sum(cell[1] == lane for cell in shared) == min(len(wanting), free)
        assert sum(name in targets.off_lane for name in wanting) == max(0, len(wanting) - free)


@examples(100)
@given(formations(most_blocked=0, fitting=True))
def test_without_blocked_cells_it_is_the_parallel_structure_of_each_lane(
    drawn: tuple[dict[Name, Cell], dict[Name, int], set[Cell]],
) -> None:
    cells, lanes, _ = drawn
    expected = [
        target
        for lane in range(LANES)
        for target in shortest_row(lane, [cells[name] for name in cells if lanes[name] == lane])
    ]
    assert list(place_all(cells, lanes).cells) == expected


def shortest_row(lane: int, cells: list[Cell]) -> list[Cell]:
    """Return the run of neighbouring cells with the shortest paths, by trying all.

    Among equals the one whose middle is nearest to the block's, then the rearmost.
    """
    count = len(cells)
    rows = [
        [(first + index, lane) for index in range(count)] for first in range(COLUMNS - count + 1)
    ]

    def rank(row: list[Cell]) -> tuple[int, float, Cell]:
        shortest = min(sum(map(way, cells, order)) for order in permutations(row))
        middle = sum(column for column, _ in row) / count
        return shortest, abs(middle - (COLUMNS - 1) / 2), row[0]

    return min(rows, key=rank) if count else []


def test_the_furthest_vehicles_are_displaced_from_a_full_lane() -> None:
    names = [Name(letter) for letter in "abcde"]
    cells: dict[Name, Cell] = dict(
        zip(names, [(0, 2), (1, 0), (2, 1), (3, 0), (0, 0)], strict=True)
    )
    targets = place_all(cells, dict.fromkeys(names, 0))
    assert set(targets.cells[:4]) == {(column, 0) for column in range(4)}
    assert targets.off_lane == {Name("a"): (0, 2)}  # it stays where it is
    assert targets.cells[4] == (0, 2)


def test_ties_between_displaced_vehicles_are_broken_by_name() -> None:
    cells: dict[Name, Cell] = {Name(letter): (0, 0) for letter in "cab"}
    assert set(next(placements(cells, dict.fromkeys(cells, 0), 2, 2)).off_lane) == {Name("c")}


def test_a_displaced_vehicle_gets_the_nearest_free_cell() -> None:
    """Not its current one if another vehicle needs that; of equal ones the rearmost."""
    names = [Name(letter) for letter in "abcdef"]
    cells: dict[Name, Cell] = dict(
        zip(names, [(0, 2), (1, 2), (2, 2), (3, 1), (1, 0), (2, 0)], strict=True)
    )
    lanes = dict.fromkeys(names, 2) | {Name("c"): 0}
    targets = place_all(cells, lanes)
    assert (2, 0) in targets.cells  # for c
    assert targets.off_lane == {Name("f"): (1, 0)}


# --- one lane ---------------------------------------------------------------------------------


@given(
    free=st.lists(st.integers(0, 7), max_size=8, unique=True).map(sorted),
    cells=st.lists(st.tuples(st.integers(0, 7), st.integers(0, 2)), max_size=8, unique=True),
)
def test_only_free_columns_are_targets_and_none_between_is_left_out(
    free: list[int], cells: list[Cell]
) -> None:
    columns = [column for column, _ in parallel_targets(1, cells, 8, free)]
    assert len(columns) == min(len(cells), len(free))
    if columns:
        assert columns == [column for column in free if columns[0] <= column <= columns[-1]]


# --- vehicles that cannot change columns ------------------------------------------------------

A, B, C, D = (Name(letter) for letter in "ABCD")


def test_vehicles_in_a_column_keep_their_order() -> None:
    cells: dict[Name, Cell] = {A: (1, 0), B: (1, 1), C: (2, 0), D: (1, 2)}
    goals = {A: {2}, B: {0, 2}, C: {2}, D: {0}}
    found = reachable_lanes(cells, goals, {A, B, C}, GRID)
    # A and B cannot both have their goals; B has one beside A, and D changes columns.
    assert found == {A: {0, 1, 2}, B: {0, 2}, C: {2}, D: {0}}
    assert reachable_lanes(cells, goals, (), GRID) == goals


def test_vehicles_pass_no_cell_that_is_not_free() -> None:
    free = [cell for cell in GRID if cell != (1, 1)]
    found = reachable_lanes({A: (1, 0), B: (1, 2)}, {A: {1, 2}, B: {1, 2}}, {A, B}, free)
    assert found == {A: {0}, B: {2}}


@st.composite
def columns(draw: st.DrawFn) -> tuple[dict[Name, Cell], dict[Name, set[int]], list[Cell]]:
    """Draw vehicles in a column of five lanes, and free cells that include theirs."""
    lanes = draw(st.lists(st.integers(0, 4), min_size=1, max_size=4, unique=True))
    others = draw(st.sets(st.integers(0, 4)))
    names = [Name(f"v{number}") for number in range(len(lanes))]
    goals = {name: draw(st.sets(st.integers(0, 4), min_size=1)) for name in names}
    cells: dict[Name, Cell] = {name: (3, lane) for name, lane in zip(names, lanes, strict=True)}
    return cells, goals, sorted({(3, lane) for lane in {*lanes, *others}})


@given(columns())
def test_as_many_as_possible_reach_their_goals(
    drawn: tuple[dict[Name, Cell], dict[Name, set[int]], list[Cell]],
) -> None:
    cells, goals, free = drawn
    found = reachable_lanes(cells, goals, cells, free)
    in_order = sorted(cells, key=lambda name: cells[name])

    def is_possible(lanes: tuple[int, ...]) -> bool:
        """Without passing each other, or a cell that is not free."""
        between = (
            range(min(lane, cells[name][1]), max(lane, cells[name][1]) + 1)
            for name, lane in zip(in_order, lanes, strict=True)
        )
        return all((3, lane) in free for each in between for lane in each)

    def satisfied(lanes: tuple[int, ...]) -> int:
        return sum(lane in goals[name] for name, lane in zip(in_order, lanes, strict=True))

    possible = [lanes for lanes in combinations(range(5), len(in_order)) if is_possible(lanes)]
    allowed = [
        lanes
        for lanes in possible
        if all(lane in found[name] for name, lane in zip(in_order, lanes, strict=True))
    ]
    assert max(map(satisfied, allowed)) == max(map(satisfied, possible))
    reaching = sum(found[name] <= goals[name] for name in cells)
    assert reaching >= max(map(satisfied, possible))
