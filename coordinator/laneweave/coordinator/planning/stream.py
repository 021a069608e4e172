"""Planning of a whole stream at once: a complete way for every vehicle, planned anew each slot.

The problem is that of the paper's Section 3, without formations: every vehicle on the road is
planned for, from its cell to the end of the road, in one window of the lattice that moves with it.
Each vehicle has a way without conflicts at any moment, so the table can be executed as it is; who
cannot reach its lane stays in the stream, and is tried again with every slot.

A way is laid by exact dynamic programming over (slot, column, lane) against all others. Where that
leaves somebody off its lane, *chains of ejections* make room: the vehicle takes its way through
others at a price, those that it hits are planned anew in turn, and the chain is kept if the sum of
costs has fallen. In between, neighbours are taken out and put in again in another order (large
neighbourhood search). Ways are carried over from slot to slot.

What a move conflicts with is the `ConflictModel` of the other planners.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from functools import lru_cache
from typing import NamedTuple, cast

import numpy as np
from attrs import frozen
from numpy.typing import NDArray

from laneweave.coordinator.planning import stream_kernel as kernel
from laneweave.coordinator.planning.conflicts import ConflictModel
from laneweave.coordinator.planning.grid import Cell, Mode, displacements
from laneweave.coordinator.planning.moves import conflict_offsets

Way = tuple[Cell, ...]
"""Cells at the beginning of each slot, the current one first, until the road ends."""

_MOST_EJECTED = 100
"""Vehicles hit by one chain."""
_SAVED = _MOST_EJECTED + 32
"""Ways that are kept while a chain or a new order is tried."""


@frozen
class StreamRoad:
    """The road as the lattice sees it, and how the search is bounded."""

    lanes: int
    pitch_m: float
    """d_F."""
    advance_m: float
    """Way of the lattice in a slot: v_F T_F."""
    sorting_m: tuple[float, float]
    """Moves happen while the whole body is between these positions: S3."""
    length_m: float
    """End of the road."""
    body_m: float
    """Length of a body; the front bumper is what a cell's position says."""
    mode: Mode = 1
    model: ConflictModel = ConflictModel(("node", "edge", "special-1", "closing"))
    rounds: int = 400
    """Most rounds of improvement for one slot."""


@frozen
class StreamCosts:
    """What ways cost; whoever ends off its lane costs more than any way."""

    move: float = 0.3
    off_lane: float = 0.1
    """For each slot that begins off the lane."""
    backward: float = 2.0
    """More for a move that loses a column."""
    forward: float = 0.0
    """More for a move that gains one; negative: drift ahead of v_F is rewarded."""
    missing: float = 60.0
    """Ending off the lane; up to twice as much near the end of the road."""


@frozen
class StreamVehicle:
    """A vehicle on the road, at the beginning of a slot."""

    vehicle: str
    cell: Cell
    lane: int
    """The lane that it needs."""
    held: bool = False
    """It stays where it is, whatever is planned."""


@frozen
class StreamPlan:
    """Ways of all vehicles from one slot on."""

    slot: int
    ways: Mapping[str, Way]
    missed: tuple[str, ...]
    """Vehicles whose ways do not end on their lanes."""


class _Table(NamedTuple):
    load: NDArray[np.int32]
    """Price of what is in the way; shape (slots, columns, lanes, displacements)."""
    who: NDArray[np.int32]
    made: NDArray[np.int8]
    """Who is in each cell at the beginning of each slot (-1: nobody), and what it does."""
    offsets: NDArray[np.int64]
    """Column, lane and displacement of what conflicts; shape (conflicts, 3)."""
    first: NDArray[np.int64]
    """Where the conflicts of each displacement begin."""
    steps: NDArray[np.int64]
    rear: NDArray[np.bool_]
    front: NDArray[np.bool_]
    """Whether a move may have this column as its rearmost, or foremost one; (slots, columns)."""
    gone: NDArray[np.bool_]
    """Whether a column is beyond the road's end; shape (slots + 1, columns)."""
    blocked: NDArray[np.bool_]
    own: NDArray[np.int64]
    """How often each displacement conflicts with itself in the same cell: always once."""


class _Ways(NamedTuple):
    column: NDArray[np.int64]
    lane: NDArray[np.int64]
    made: NDArray[np.int8]
    slots: NDArray[np.int64]
    wanted: NDArray[np.int64]
    missing: NDArray[np.float64]
    held: NDArray[np.bool_]
    price: NDArray[np.int64]
    cost: NDArray[np.float64]
    placed: NDArray[np.bool_]


class _Costs(NamedTuple):
    of_move: NDArray[np.float64]
    off_lane: float


class _Saved(NamedTuple):
    who: NDArray[np.int64]
    slots: NDArray[np.int64]
    cost: NDArray[np.float64]
    column: NDArray[np.int64]
    lane: NDArray[np.int64]
    made: NDArray[np.int8]


class _Scratch(NamedTuple):
    saved: _Saved
    queue: NDArray[np.int64]
    victims: NDArray[np.int64]
    failing: NDArray[np.int64]
    value: NDArray[np.float64]
    came: NDArray[np.int8]
    delay: NDArray[np.float64]
    chosen: NDArray[np.int64]
    memory: NDArray[np.float64]


class StreamPlanner:
    """Plans a stream slot by slot; between slots it remembers nothing but its random state."""

    def __init__(self, road: StreamRoad, costs: StreamCosts | None = None, seed: int = 0) -> None:
        self.road = road
        self.costs = costs or StreamCosts()
        self._rng = np.array([seed * 2 + 1], dtype=np.uint64)

    def plan(
        self,
        slot: int,
        vehicles: Sequence[StreamVehicle],
        before: StreamPlan | None = None,
        blocked: Collection[Cell] = (),
    ) -> StreamPlan:
        """Return ways for all vehicles from the beginning of a slot on."""
        if not vehicles:
            return StreamPlan(slot, {}, ())
        order = sorted(vehicles, key=lambda one: (one.cell[0], one.cell[1]))
        window = _Window(self.road, self.costs, slot, order, blocked)
        kept = before.ways if before is not None and before.slot <= slot else {}
        age = slot - before.slot if before is not None else 0
        window.lay_first({name: way[age:] for name, way in kept.items()}, self._rng)
        if len(order) > 1:
            window.improve(self.road.rounds, self._rng)
        return window.result()


class _Window:
    """Arrays of one planning."""

    def __init__(
        self,
        road: StreamRoad,
        costs: StreamCosts,
        slot: int,
        vehicles: Sequence[StreamVehicle],
        blocked: Collection[Cell],
    ) -> None:
        self.slot, self.vehicles = slot, vehicles
        per_slot = road.advance_m / road.pitch_m
        start_m, end_m = road.sorting_m
        reach = int((end_m - start_m) / road.advance_m) + 1
        self.low = vehicles[0].cell[0] - reach
        columns = vehicles[-1].cell[0] + reach - self.low + 1
        self.reach = reach
        place_m = (np.arange(columns) + self.low) * road.pitch_m
        rearmost_m = place_m[0] + slot * road.advance_m
        slots = max(1, int(np.ceil((road.length_m - rearmost_m) / road.advance_m)) + 1)
        at_m = place_m[None, :] + (slot + np.arange(slots + 1))[:, None] * road.advance_m
        fan = len(displacements(road.mode))
        offsets, first = _offsets(road.mode, road.model)
        barred = np.zeros((columns, road.lanes), dtype=np.bool_)
        for column, lane in blocked:
            if 0 <= column - self.low < columns:
                barred[column - self.low, lane] = True
        self.table = _Table(
            np.zeros((slots, columns, road.lanes, fan), dtype=np.int32),
            np.full((slots, columns, road.lanes), -1, dtype=np.int32),
            np.zeros((slots, columns, road.lanes), dtype=np.int8),
            offsets,
            first,
            np.array(displacements(road.mode), dtype=np.int64),
            at_m[:-1] - road.body_m >= start_m - 1e-6,
            at_m[1:] <= end_m + 1e-6,
            at_m > road.length_m + 1e-6,
            barred,
            np.array(
                [
                    sum(
                        1
                        for column, lane, e in offsets[first[d] : first[d + 1]].tolist()
                        if (column, lane, e) == (0, 0, d)
                    )
                    for d in range(fan)
                ],
                dtype=np.int64,
            ),
        )
        self.soft = self.table._replace(
            load=np.zeros_like(self.table.load),
            who=np.zeros_like(self.table.who),
            made=np.zeros_like(self.table.made),
        )
        count = len(vehicles)
        chances = np.array([self._chances(vehicle) for vehicle in vehicles])
        self.ways = _Ways(
            np.zeros((count, slots + 1), dtype=np.int64),
            np.zeros((count, slots + 1), dtype=np.int64),
            np.zeros((count, slots), dtype=np.int8),
            np.zeros(count, dtype=np.int64),
            np.array([vehicle.lane for vehicle in vehicles], dtype=np.int64),
            costs.missing * (1.0 + 1.0 / (1.0 + chances)),
            np.array([vehicle.held for vehicle in vehicles], dtype=np.bool_),
            np.array(
                [kernel.FIXED if vehicle.held else kernel.PRICE for vehicle in vehicles],
                dtype=np.int64,
            ),
            np.zeros(count),
            np.zeros(count, dtype=np.bool_),
        )
        self.ways.column[:, 0] = [vehicle.cell[0] - self.low for vehicle in vehicles]
        self.ways.lane[:, 0] = [vehicle.cell[1] for vehicle in vehicles]
        steps = self.table.steps
        moves = np.where((steps != 0).any(axis=1), costs.move, 0.0)
        moves += np.where(steps[:, 0] < 0, costs.backward, 0.0)
        moves += np.where(steps[:, 0] > 0, costs.forward, 0.0)
        self.costs = _Costs(moves, costs.off_lane)
        self.scratch = _Scratch(
            _Saved(
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
            np.zeros((slots + 1, 2 * reach + 1, road.lanes)),
            np.zeros((slots + 1, 2 * reach + 1, road.lanes), dtype=np.int8),
            np.zeros(slots),
            np.zeros(count + 1, dtype=np.int64),
            np.zeros((slots, columns, road.lanes)),
        )

    def _chances(self, vehicle: StreamVehicle) -> int:
        """Return in how many slots it may still move, from where it is."""
        column = vehicle.cell[0] - self.low
        return int((self.table.rear[:, column] & self.table.front[:, column]).sum())

    def lay_first(self, kept: Mapping[str, Way], rng: NDArray[np.uint64]) -> None:
        """Put every vehicle into the table: on its old way where that still holds."""
        new = []
        for v, vehicle in enumerate(self.vehicles):
            way = kept.get(vehicle.vehicle, ())
            if way and way[0] == vehicle.cell and not vehicle.held and self._take(v, way):
                kernel.put(self.table, self.ways, v, 1)
            else:
                new.append(v)
        # Foremost first: they have the least time.
        new.sort(key=lambda v: (not self.vehicles[v].held, -self.ways.column[v, 0]))
        scratch = self.scratch
        for v in new:
            self.ways.cost[v] = kernel.find_way(
                self.table, self.table, self.ways, self.costs, v, 0, 0.0, scratch
            )
            if self.ways.cost[v] < kernel.NO_WAY:
                kernel.put(self.table, self.ways, v, 1)
                continue
            for softness in (0.3, 0.5, 1.0, 1.5, 3.0):
                gained = kernel.eject(
                    self.table, self.ways, self.costs, v, softness, _MOST_EJECTED, 0.0, rng, scratch
                )
                if gained > 0.0:
                    break
            else:
                kernel.stand(self.table, self.ways, self.costs, v, scratch)

    def _take(self, v: int, way: Way) -> bool:
        """Use an old way; false when it does not fit the window any more."""
        ways, steps = self.ways, {tuple(step): d for d, step in enumerate(self.table.steps.tolist())}
        slots = min(len(way) - 1, len(ways.made[v]))
        for s, (column, lane) in enumerate(way[: slots + 1]):
            ways.column[v, s], ways.lane[v, s] = column - self.low, lane
            if s > 0:
                here = (column - way[s - 1][0], lane - way[s - 1][1])
                ways.made[v, s - 1] = steps[here]
        ways.slots[v] = slots
        for s in range(slots):
            if self.table.load[s, ways.column[v, s], ways.lane[v, s], ways.made[v, s]]:
                return False
        ways.cost[v] = kernel.own_cost(ways, self.costs, v)
        return True

    def improve(self, rounds: int, rng: NDArray[np.uint64]) -> None:
        kernel.improve(
            self.table, self.soft, self.ways, self.costs, rounds, _MOST_EJECTED, rng, self.scratch
        )

    def result(self) -> StreamPlan:
        ways: dict[str, Way] = {}
        missed = []
        for v, vehicle in enumerate(self.vehicles):
            last = int(self.ways.slots[v]) + 1
            columns = (self.ways.column[v, :last] + self.low).tolist()
            lanes = self.ways.lane[v, :last].tolist()
            ways[vehicle.vehicle] = tuple(zip(columns, lanes, strict=True))
            if lanes[-1] != vehicle.lane:
                missed.append(vehicle.vehicle)
        return StreamPlan(self.slot, ways, tuple(missed))


@lru_cache(maxsize=16)
def _offsets(mode: Mode, model: ConflictModel) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    table = conflict_offsets(mode, model)
    flat = [entry for entries in table for entry in entries]
    first = np.cumsum([0, *(len(entries) for entries in table)])
    return np.array(flat, dtype=np.int64), cast("NDArray[np.int64]", first)
