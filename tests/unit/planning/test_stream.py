"""Planning of a whole stream: complete ways without conflicts, whatever the stream looks like."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from laneweave.coordinator.planning.conflicts import ConflictModel
from laneweave.coordinator.planning.stream import StreamPlanner
from laneweave.coordinator.planning.stream_types import StreamRoad, StreamVehicle
from laneweave.coordinator.planning.stream_validate import problems_of_ways

LANES = 3
MODELS = (ConflictModel(("node", "edge", "special-1", "closing")), ConflictModel(("geometric",)))


def road(mode: int = 1, model: ConflictModel = MODELS[0], rounds: int = 40) -> StreamRoad:
    return StreamRoad(
        lanes=LANES,
        pitch_m=15.0,
        advance_m=60.0,
        sorting_m=(100.0, 500.0),
        length_m=500.0,
        body_m=5.0,
        mode=1 if mode == 1 else 2,
        model=model,
        rounds=rounds,
    )


CELLS = st.tuples(st.integers(0, 30), st.integers(0, LANES - 1))


@st.composite
def streams(draw: st.DrawFn) -> list[StreamVehicle]:
    cells = draw(st.lists(CELLS, max_size=40, unique=True))
    return [
        StreamVehicle(
            f"v{number}",
            cell,
            draw(st.integers(0, LANES - 1)),
            held=draw(st.integers(0, 9)) == 0,
        )
        for number, cell in enumerate(cells)
    ]


@given(streams(), st.sampled_from([(1, MODELS[0]), (1, MODELS[1]), (2, MODELS[1])]), st.data())
@settings(max_examples=80, deadline=None)
def test_ways_are_complete_and_never_conflict(
    stream: list[StreamVehicle], kind: tuple[int, ConflictModel], data: st.DataObject
) -> None:
    where = road(*kind)
    blocked = data.draw(st.frozensets(CELLS, max_size=20))
    slot = data.draw(st.integers(-2, 3))
    planner = StreamPlanner(where, seed=1)
    plan = planner.plan(slot, stream, None, blocked)
    assert list(problems_of_ways(where, plan, stream, blocked)) == []
    # A slot later somebody is not where it should be, and others have got in the way of nobody.
    taken: set[tuple[int, int]] = set()
    later = []
    for vehicle in stream:
        way = plan.ways[vehicle.vehicle]
        if len(way) < 2:
            continue
        moved = data.draw(st.integers(0, 4)) > 0
        cell = way[1] if moved else way[0]
        if cell not in taken:
            taken.add(cell)
            later.append(StreamVehicle(vehicle.vehicle, cell, vehicle.lane, vehicle.held))
    after = planner.plan(slot + 1, later, plan, blocked)
    assert list(problems_of_ways(where, after, later, blocked)) == []


def test_equal_streams_and_seeds_have_equal_plans() -> None:
    stream = [StreamVehicle(f"v{n}", (n % 11, n % 3), (n * 7) % 3) for n in range(33)]
    plans = [StreamPlanner(road(), seed=5).plan(1, stream) for _ in range(2)]
    assert plans[0] == plans[1]


def test_ways_are_kept_where_nothing_has_changed() -> None:
    stream = [StreamVehicle(f"v{n}", (4 * n, n % 3), (n + 1) % 3) for n in range(8)]
    planner = StreamPlanner(road(), seed=5)
    plan = planner.plan(0, stream)
    assert plan.missed == ()
    moved = [
        StreamVehicle(one.vehicle, plan.ways[one.vehicle][1], one.lane)
        for one in stream
        if len(plan.ways[one.vehicle]) > 1
    ]
    later = planner.plan(1, moved, plan)
    assert {name: way[1:] for name, way in plan.ways.items() if name in later.ways} == later.ways


@pytest.mark.parametrize("stream", [[], [StreamVehicle("alone", (3, 0), 2)]])
def test_few(stream: list[StreamVehicle]) -> None:
    plan = StreamPlanner(road()).plan(0, stream)
    assert [way[-1][1] for way in plan.ways.values()] == [one.lane for one in stream]
    assert plan.missed == ()


def test_two_side_by_side_swap_their_lanes() -> None:
    """Neither can make way for the other one without a detour."""
    stream = [StreamVehicle("right", (6, 0), 1), StreamVehicle("left", (6, 1), 0)]
    plan = StreamPlanner(road()).plan(0, stream)
    assert plan.missed == ()
