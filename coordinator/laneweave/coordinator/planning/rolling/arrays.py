"""What the compiled code of `stream` works on: one window of the lattice, as arrays.

A window holds the columns that the vehicles on the road can reach, and the slots until the last of
them has left the road. Indices: slot s from the current one, column c from the window's lowest,
lane, and displacement d as numbered by `displacements`.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from functools import lru_cache
from typing import NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from laneweave.coordinator.planning.conflicts import ConflictModel
from laneweave.coordinator.planning.grid import Cell, Mode, displacements
from laneweave.coordinator.planning.moves import conflict_offsets
from laneweave.coordinator.planning.rolling.problem import StreamCosts, StreamRoad, StreamVehicle

FIXED = 100_000
"""Price of a vehicle that cannot be moved out of the way."""
PRICE = 8
"""Least price of a vehicle; prices grow by parts of it."""
ENTERING = 8
"""How often the price is paid by moves that conflict with a vehicle; by staying in its cell as
long as it does: once. So who takes its place does not pay anew with each slot."""
MOST_EJECTED = 100
"""Vehicles hit by one chain of ejections."""
_SAVED = MOST_EJECTED + 32
"""Ways that are kept while a chain or a new order is tried."""
ROUNDING_M = 1e-6

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Bools = NDArray[np.bool_]


class Table(NamedTuple):
    """Who makes which moves, and with which moves that conflicts."""

    load: Singles
    """Sum of the prices of all whose moves conflict with this one, and `FIXED` for moves that
    nobody may make; (slots, displacements, lanes, columns)."""
    who: NDArray[np.int32]
    """Who is in a cell at the beginning of a slot, -1: nobody; (slots, lanes, columns)."""
    made: NDArray[np.int8]
    """Displacement that it makes in the slot; same shape."""
    offsets: Ints
    """Column, lane and displacement of what conflicts with a move, and how often it pays the
    price; (conflicts, 4)."""
    first: Ints
    """Where in `offsets` the conflicts of each displacement begin; (displacements + 1)."""
    steps: Ints
    """Column and lane of each displacement; (displacements, 2)."""
    opened: Ints
    """First and last column from which there are moves in a slot; (slots, 2)."""
    ended: Ints
    """Column from which on all are beyond the end of the road; (slots + 1)."""


class Ways(NamedTuple):
    """The vehicles, by column, and the way of each; first index: vehicle."""

    column: Ints
    """At the beginning of each slot; (vehicles, slots + 1)."""
    lane: Ints
    made: NDArray[np.int8]
    """Displacements; (vehicles, slots)."""
    slots: Ints
    """How many slots the way has until the road ends."""
    wanted: Ints
    """Lane that is needed."""
    held: Bools
    missing: Floats
    """Cost of ending off the lane."""
    least: Floats
    """No way that ends on the lane costs less."""
    able: Bools
    """Whether there are slots enough to reach the lane, if nobody were in the way."""
    price: Ints
    """What it costs another one to be in its way."""
    cost: Floats
    placed: Bools
    """Whether the way is in the table."""


class Costs(NamedTuple):
    """`StreamCosts` for the compiled code."""

    of_move: Singles
    """Of each displacement."""
    off_lane: np.float32


class Saved(NamedTuple):
    """Ways as they were before a change that may be undone."""

    who: Ints
    slots: Ints
    cost: Floats
    column: Ints
    lane: Ints
    made: NDArray[np.int8]


class Scratch(NamedTuple):
    """Memory of the search, allocated once."""

    saved: Saved
    queue: Ints
    victims: Ints
    chosen: Ints
    failing: Ints
    dear: Ints
    """Up to all vehicles, each."""
    marked: Bools
    """Vehicles whose ways are saved."""
    value: Singles
    """Least cost of being somewhere; (slots + 1, lanes, columns about the own one, and one more on
    either side that nobody leaves)."""
    delay: Singles
    """What a move costs more in each slot."""
    laid: Ints
    """How many ways were looked for; (1)."""


class Window(NamedTuple):
    """All arrays of one planning."""

    low: int
    """Column of the lattice that is the window's lowest."""
    table: Table
    ways: Ways
    costs: Costs
    scratch: Scratch


def window(
    road: StreamRoad,
    costs: StreamCosts,
    slot: int,
    vehicles: Sequence[StreamVehicle],
    blocked: Collection[Cell],
) -> Window:
    """Return the arrays for vehicles that are sorted by column and on the road; no way is laid."""
    start_m, end_m = road.sorting_m
    # Nobody moves in more slots than it takes to pass S3.
    reach = max(0, int((end_m - start_m) / road.advance_m) + 1)
    low = vehicles[0].cell[0] - reach
    columns = vehicles[-1].cell[0] + reach - low + 1
    now_m = (np.arange(columns) + low) * road.pitch_m + slot * road.advance_m
    rearmost_m = now_m[reach]
    slots = max(1, int(np.ceil((road.length_m - rearmost_m) / road.advance_m)) + 1)
    # Whoever falls behind has further to go.
    slots += int(np.ceil(reach * road.pitch_m / road.advance_m))
    at_m = now_m + np.arange(slots + 1)[:, None] * road.advance_m
    table = _table(road, at_m, low, blocked)
    return Window(
        low,
        table,
        _ways(costs, table, low, vehicles),
        _costs(costs, table.steps),
        _scratch(len(vehicles), slots, reach, road.lanes),
    )


def _table(road: StreamRoad, at_m: Floats, low: int, blocked: Collection[Cell]) -> Table:
    """Return an empty table; `at_m`: where columns are at the beginning of slots."""
    slots, columns = at_m.shape[0] - 1, at_m.shape[1]
    offsets, first = _offsets(road.mode, road.model)
    barred = np.zeros((road.lanes, columns), dtype=np.bool_)
    for column, lane in blocked:
        if 0 <= column - low < columns and 0 <= lane < road.lanes:
            barred[lane, column - low] = True
    steps = displacements(road.mode)
    load = np.zeros((slots, len(steps), road.lanes, columns), dtype=np.float32)
    may_move = _may_move(road, at_m, barred)
    load[:, 1:][~may_move] = FIXED * ENTERING
    may_leave: NDArray[np.bool_] = np.asarray(may_move.any(axis=(1, 2)), dtype=np.bool_)
    opened = np.stack([may_leave.argmax(axis=1), columns - 1 - may_leave[:, ::-1].argmax(axis=1)])
    opened[:, ~may_leave.any(axis=1)] = [[columns], [-1]]
    return Table(
        load,
        np.full((slots, road.lanes, columns), -1, dtype=np.int32),
        np.zeros((slots, road.lanes, columns), dtype=np.int8),
        offsets,
        first,
        np.array(steps, dtype=np.int64),
        np.ascontiguousarray(opened.T),
        (at_m <= road.length_m + ROUNDING_M).sum(axis=1),
    )


def _may_move(road: StreamRoad, at_m: Floats, barred: Bools) -> Bools:
    """Tell which moves stay on the road and in S3, and enter nothing that is blocked.

    The corners of an oblique move count as entered, except where the vehicle is anyway. Shape:
    (slots, displacements without the first, lanes, columns).
    """
    start_m, end_m = road.sorting_m
    rear = at_m[:-1] - road.body_m >= start_m - ROUNDING_M
    front = at_m[1:] <= end_m + ROUNDING_M
    lanes, columns = barred.shape
    steps = displacements(road.mode)[1:]
    allowed = np.zeros((len(rear), len(steps), lanes, columns), dtype=np.bool_)
    for d, (column, lane) in enumerate(steps):
        here_c = slice(max(0, -column), columns - max(0, column))
        there_c = slice(max(0, column), columns + min(0, column))
        here_l = slice(max(0, -lane), lanes - max(0, lane))
        there_l = slice(max(0, lane), lanes + min(0, lane))
        inside = (rear & front)[:, here_c] & (rear & front)[:, there_c]
        free = ~barred[there_l, there_c]
        if column and lane:
            free &= ~barred[here_l, there_c] & ~barred[there_l, here_c]
        allowed[:, d, here_l, here_c] = inside[:, None, :] & free
    return allowed


def _ways(costs: StreamCosts, table: Table, low: int, vehicles: Sequence[StreamVehicle]) -> Ways:
    slots, count = len(table.load), len(vehicles)
    column = np.zeros((count, slots + 1), dtype=np.int64)
    lane = np.zeros((count, slots + 1), dtype=np.int64)
    column[:, 0] = [vehicle.cell[0] - low for vehicle in vehicles]
    lane[:, 0] = [vehicle.cell[1] for vehicle in vehicles]
    wanted = np.array([vehicle.lane for vehicle in vehicles], dtype=np.int64)
    held = np.array([vehicle.held for vehicle in vehicles], dtype=np.bool_)
    # It may move sidewards in these slots, if nothing is in the way.
    begin, end = table.opened.T[:, :, None]
    may_move = (begin <= column[:, 0]) & (column[:, 0] <= end)
    chances = may_move.sum(axis=0)
    # So many slots begin off the lane in any case, and so many moves are made.
    away = np.abs(lane[:, 0] - wanted)
    waits = np.where(away > 0, may_move.argmax(axis=0), 0)
    least = away * (costs.move + costs.off_lane) + waits * costs.off_lane
    least += chances * min(0.0, costs.forward)
    return Ways(
        column,
        lane,
        np.zeros((count, slots), dtype=np.int8),
        np.zeros(count, dtype=np.int64),
        wanted,
        held,
        costs.missing * (1.0 + 1.0 / (1.0 + chances)),
        least,
        ~held & (chances >= away),
        np.where(held, FIXED, PRICE),
        np.zeros(count),
        np.zeros(count, dtype=np.bool_),
    )


def _costs(costs: StreamCosts, steps: Ints) -> Costs:
    of_move = np.where((steps != 0).any(axis=1), costs.move, 0.0)
    of_move += np.where(steps[:, 0] < 0, costs.backward, 0.0)
    of_move += np.where(steps[:, 0] > 0, costs.forward, 0.0)
    return Costs(of_move.astype(np.float32), np.float32(costs.off_lane))


def _scratch(count: int, slots: int, reach: int, lanes: int) -> Scratch:
    return Scratch(
        Saved(
            np.zeros(_SAVED, dtype=np.int64),
            np.zeros(_SAVED, dtype=np.int64),
            np.zeros(_SAVED),
            np.zeros((_SAVED, slots + 1), dtype=np.int64),
            np.zeros((_SAVED, slots + 1), dtype=np.int64),
            np.zeros((_SAVED, slots), dtype=np.int8),
        ),
        np.zeros(count + 1, dtype=np.int64),
        np.zeros(count + 1, dtype=np.int64),
        np.zeros(count + 1, dtype=np.int64),
        np.zeros(count + 1, dtype=np.int64),
        np.zeros(count + 1, dtype=np.int64),
        np.zeros(count, dtype=np.bool_),
        np.zeros((slots + 1, lanes, 2 * reach + 3), dtype=np.float32),
        np.zeros(slots, dtype=np.float32),
        np.zeros(1, dtype=np.int64),
    )


@lru_cache(maxsize=16)
def _offsets(mode: Mode, model: ConflictModel) -> tuple[Ints, Ints]:
    """Return the conflicts of all displacements in a row, and where those of each begin."""
    table = conflict_offsets(mode, model)
    flat = [
        (*entry, 1 if (d, *entry) == (0, 0, 0, 0) else ENTERING)
        for d, entries in enumerate(table)
        for entry in entries
    ]
    first = np.cumsum([0, *(len(entries) for entries in table)])
    return np.array(flat, dtype=np.int64), cast("Ints", first)
