"""Streams to plan, what plans cost, and what they cost at least."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from itertools import pairwise, product
from random import Random

import attrs
from hypothesis import strategies as st

from laneweave.coordinator.planning.conflict_kinds import ConflictModel, Move
from laneweave.coordinator.planning.geometry.conflict_table import conflict_table
from laneweave.coordinator.planning.geometry.swept_bodies import BodyGeometry
from laneweave.coordinator.planning.rolling.problem import (
    CellPath,
    StreamCosts,
    StreamPlan,
    StreamRoad,
    StreamVehicle,
)
from laneweave.protocol.lattice import Cell
from laneweave.protocol.road_layout import LaneSection
from oracles.binary_programme import Row, cheapest_choice
from oracles.path_rules import conflict_kinds

ROAD = StreamRoad(3, 15.0, 60.0, (400.0, 1000.0), 1000.0, 5.0, max_paths=2000)
SHORT = StreamRoad(3, 15.0, 30.0, (-20.0, 150.0), 150.0, 5.0)
"""Everybody sorts from the beginning, in up to five slots."""
FOLLOWING = ConflictModel(("node", "edge", "special-1", "closing"))
MODELS = (
    FOLLOWING,
    ConflictModel(("node",)),
    ConflictModel(("node", "edge", "special-2", "special-4")),
    ConflictModel(("geometric",)),
    ConflictModel(("geometric", "closing"), conflict_table(BodyGeometry())),
    ConflictModel(("geometric",), conflict_table(BodyGeometry(lateness_s=0.5))),
)
COSTS = StreamCosts()

Stream = tuple[StreamRoad, int, list[StreamVehicle], list[Cell]]
"""Road, slot, vehicles, and cells that are blocked."""


@st.composite
def streams(draw: st.DrawFn) -> Stream:
    """Draw streams up to full density, in which everything may be out of order."""
    road = StreamRoad(
        draw(st.integers(1, 4)),
        15.0,
        draw(st.sampled_from((30.0, 60.0))),
        (draw(st.sampled_from((-10.0, 100.0, 400.0))), draw(st.sampled_from((500.0, 550.0)))),
        500.0,
        5.0,
        draw(st.sampled_from((1, 2))),
        draw(st.sampled_from(MODELS)),
        max_paths=400,
    )
    slot = draw(st.integers(0, 9))
    begin = draw(st.integers(-6, 36)) - int(slot * road.advance_m / road.pitch_m)
    road = attrs.evolve(road, sections=draw(sections_of(road)))
    every = list(product(range(begin, begin + draw(st.integers(1, 10))), range(road.lanes)))
    density = draw(st.sampled_from((0.2, 0.7, 0.9, 1.0)))
    random = draw(st.randoms(use_true_random=False))
    cells = random.sample(every, max(1, int(density * len(every))))
    share_held = draw(st.sampled_from((0.0, 0.0, 0.1, 0.5)))
    vehicles = [
        StreamVehicle(f"v{i}", cell, targets(road, random), random.random() < share_held)
        for i, cell in enumerate(cells)
    ]
    blocked = draw(st.lists(st.sampled_from(every), max_size=4))
    return road, slot, vehicles, blocked


@st.composite
def sections_of(draw: st.DrawFn, road: StreamRoad) -> tuple[LaneSection, ...]:
    """Draw the sections of the lanes of a road; about half of the roads are straight."""
    found = [*road.sections]
    if draw(st.booleans()):
        return tuple(found)
    for lane in draw(st.sets(st.integers(0, road.lanes - 1), max_size=2)):
        from_m = draw(st.sampled_from((-1000.0, 150.0, 315.0)))
        to_m = from_m + draw(st.sampled_from((45.0, 120.0, 1200.0)))
        found[lane] = LaneSection(lane, from_m, min(to_m, road.length_m), exit="left")
        if to_m + 10.0 < road.length_m and draw(st.booleans()):
            opens_m = to_m + draw(st.sampled_from((10.0, 100.0)))
            found.append(LaneSection(lane, opens_m, max(opens_m, road.length_m), exit="again"))
    return tuple(found)


def targets(road: StreamRoad, random: Random) -> set[int]:
    """Draw one or two sections."""
    return {random.randrange(len(road.sections)) for _ in range(random.randint(1, 2))}


def section_at(road: StreamRoad, position_m: float, lane: int) -> tuple[int, bool]:
    """Return the section that has begun last in a lane, and whether a position is beyond its end.

    A section ends before the next one by more than a vehicle can gain in a slot.
    """
    begun = [
        (each.from_m, number)
        for number, each in enumerate(road.sections)
        if each.lane == lane and each.from_m <= position_m + 1e-6
    ]
    if not begun:
        return -1, False
    _, number = max(begun)
    to_m = road.sections[number].to_m
    for each in road.sections:
        if each.lane == lane and each.from_m > road.sections[number].from_m:
            to_m = min(to_m, each.from_m - road.advance_m - road.pitch_m)
    return number, position_m > to_m + 1e-6


def left(road: StreamRoad, slot: int, cell: Cell) -> bool:
    return section_at(road, place_m(road, slot, cell), cell[1])[1]


def off_target(road: StreamRoad, slot: int, vehicle: StreamVehicle, cell: Cell) -> bool:
    return section_at(road, place_m(road, slot, cell), cell[1])[0] not in vehicle.targets


def place_m(road: StreamRoad, slot: int, cell: Cell) -> float:
    return cell[0] * road.pitch_m + slot * road.advance_m


def may_move(road: StreamRoad, slot: int, move: Move) -> bool:
    if not 0 <= move[1][1] < road.lanes:
        return False
    places = [place_m(road, slot, cell) for cell in move]
    rear_m, front_m = min(places) - road.body_m, max(places) + road.advance_m
    if rear_m < road.sorting_m[0] or front_m > road.sorting_m[1]:
        return False
    rears = [section_at(road, rear_m, cell[1]) for cell in move]
    fronts = [section_at(road, front_m, cell[1]) for cell in move]
    return rears == fronts and all(n >= 0 and not beyond for n, beyond in fronts)


def moves_from(road: StreamRoad, slot: int, vehicle: StreamVehicle, cell: Cell) -> list[Move]:
    """Return all moves of mode 1."""
    found = [(cell, cell)]
    for column, lane in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        move = cell, (cell[0] + column, cell[1] + lane)
        if not vehicle.held and may_move(road, slot, move):
            found.append(move)
    return found


def missing(road: StreamRoad, slot: int, vehicle: StreamVehicle) -> float:
    """Return what it costs that a vehicle ends off its lane."""
    chances, s = 0, slot
    while place_m(road, s, vehicle.cell) <= road.length_m:
        here = vehicle.cell, vehicle.cell
        chances += may_move(road, s, here)
        s += 1
    return COSTS.missing * (1.0 + 1.0 / (1.0 + chances))


def step_cost(road: StreamRoad, slot: int, vehicle: StreamVehicle, move: Move) -> float:
    cost = COSTS.off_lane * off_target(road, slot, vehicle, move[0])
    cost += COSTS.move * (move[0] != move[1])
    cost += COSTS.forward * (move[1][0] > move[0][0])
    return cost + COSTS.backward * (move[1][0] < move[0][0])


def cost_of(road: StreamRoad, slot: int, vehicle: StreamVehicle, way: CellPath) -> float:
    cost = sum(step_cost(road, s, vehicle, move) for s, move in enumerate(pairwise(way), slot))
    last = off_target(road, slot + len(way) - 1, vehicle, way[-1])
    return cost + missing(road, slot, vehicle) * last


def cost_of_plan(road: StreamRoad, plan: StreamPlan, vehicles: Sequence[StreamVehicle]) -> float:
    return sum(cost_of(road, plan.slot, v, plan.paths[v.vehicle]) for v in vehicles)


def conflicts(model: ConflictModel, a: Move, b: Move) -> bool:
    if model.table is not None:
        return model.kind(a, b) is not None
    return bool(conflict_kinds(a, b, model.kinds))


class Programme:
    """The least cost in mode 1 with node, edge and following conflicts: a flow for each vehicle.

    Moves that touch a cell exclude each other, and so do those that close up from three columns.
    """

    def __init__(self, road: StreamRoad, slot: int, vehicles: Sequence[StreamVehicle]) -> None:
        """Lay down all moves."""
        self.cost: list[float] = []
        self.rows: list[Row] = []
        rivals: dict[tuple[int, str, Cell], set[int]] = defaultdict(set)
        for vehicle in vehicles:
            into: dict[Cell, set[int]] = {vehicle.cell: set()}
            supply = 1.0
            s = slot
            while into:
                following: dict[Cell, set[int]] = defaultdict(set)
                for cell, arriving in into.items():
                    leaving = set()
                    for move in moves_from(road, s, vehicle, cell):
                        x = self._variable(road, slot, s, vehicle, move)
                        leaving.add(x)
                        for key in _rows_of(move):
                            rivals[s, *key].add(x)
                        if not left(road, s + 1, move[1]):
                            following[move[1]].add(x)
                    out = [(x, 1.0) for x in leaving]
                    back = [(x, -1.0) for x in arriving]
                    self.rows.append((out + back, supply, supply))
                    supply = 0.0
                into = following
                s += 1
        self.rows += [([(x, 1.0) for x in xs], 0.0, 1.0) for xs in rivals.values() if len(xs) > 1]

    def _variable(
        self, road: StreamRoad, first: int, slot: int, vehicle: StreamVehicle, move: Move
    ) -> int:
        cost = step_cost(road, slot, vehicle, move)
        if left(road, slot + 1, move[1]) and off_target(road, slot + 1, vehicle, move[1]):
            cost += missing(road, first, vehicle)
        self.cost.append(cost)
        return len(self.cost) - 1

    def least_cost(self) -> float:
        result = cheapest_choice(self.cost, self.rows)
        assert result.status == 0, result.message
        return float(result.fun)


def _rows_of(move: Move) -> list[tuple[str, Cell]]:
    rows = [("cell", cell) for cell in set(move)]
    if move[1][0] > move[0][0]:
        rows.append(("closing", move[0]))
    if move[1][0] < move[0][0]:
        rows.append(("closing", (move[0][0] - 3, move[0][1])))
    return rows
