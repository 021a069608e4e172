"""Planning of a whole stream: a complete path for every vehicle, replanned each slot.

The problem is that of the paper's Section 3, without formations: every vehicle on the road gets a
path from its cell to the end of the road, in one window that moves with the lattice. The
paths never conflict, so each plan can be executed. A vehicle whose path misses its lane is
planned again in the next slot.

A path is found by exact dynamic programming over (slot, column, lane) around all others. If a
vehicle then misses its lane, *ejection chains* make room: the vehicle takes a path through others
at a penalty, the vehicles that it hits are rerouted in turn, and the chain is kept if the total
cost decreases. In between, neighbours are removed and rerouted in another order
(large-neighbourhood search). Paths are carried over from slot to slot.

Conflicts are those of the `ConflictModel`, as for the other planners.
"""

from __future__ import annotations

import time
from collections.abc import Collection, Mapping, Sequence
from itertools import chain

import numpy as np

from laneweave.coordinator.planning.rolling import search_kernel as kernel
from laneweave.coordinator.planning.rolling.arrays import window
from laneweave.coordinator.planning.rolling.problem import (
    CellPath,
    OpenRoad,
    StreamCosts,
    StreamPlan,
    StreamRoad,
    StreamVehicle,
)
from laneweave.coordinator.planning.rolling.window_arrays import Ints, Window
from laneweave.protocol.lattice import Cell


def call_kernels() -> None:
    """Call every kernel, which loads or compiles it; see `kernels`."""
    road = StreamRoad(2, 15.0, 60.0, (0.0, 600.0), 600.0, 5.0)
    # Two vehicles that swap lanes.
    vehicles = [StreamVehicle("a", (5, 0), 1), StreamVehicle("b", (5, 1), 0)]
    StreamPlanner(road).plan(0, vehicles)


class StreamPlanner:
    """A slot-by-slot stream planner; plans depend only on the seed and the arguments of `plan`."""

    def __init__(self, road: StreamRoad, costs: StreamCosts | None = None, seed: int = 0) -> None:
        """Prepare the planner; `seed` determines all random choices."""
        self.road = road
        self.costs = costs or StreamCosts()
        self._seed = seed

    def plan(
        self,
        slot: int,
        vehicles: Sequence[StreamVehicle],
        before: StreamPlan | None = None,
        blocked: Collection[Cell] = (),
        now: OpenRoad | None = None,
    ) -> StreamPlan:
        """Return paths for all vehicles from the beginning of a slot on.

        Args:
            slot: number of the slot; in slot 0, column 0 is at the start of the road.
            vehicles: all vehicles on the road, each in a different cell.
            before: an earlier plan; the search starts from its paths that are still valid.
            blocked: cells that must not be entered; a vehicle in one may leave it.
            now: what of the road is open now; None: as always.

        Raises:
            ValueError: two vehicles share a cell, or one is off the lanes.
        """
        began_s = time.monotonic()
        road = self.road.as_open(now)
        _check(road, vehicles)
        end = road.length_m - slot * road.advance_m
        paths: dict[str, CellPath] = {v.vehicle: (v.cell,) for v in vehicles}
        order = [v for v in vehicles if v.cell[0] * road.pitch_m <= end + 1e-6]
        order.sort(key=lambda one: one.cell)
        rounds = 0
        if order:
            arrays = window(road, self.costs, slot, order, blocked)
            earlier = _earlier_paths(slot, order, before, arrays.low)
            # Hashed, so that the sequences of neighbouring slots are independent.
            rng = np.random.SeedSequence((self._seed, slot & 0xFFFFFFFF)).generate_state(1, "u8")
            kernel.set_paths(
                arrays.table, arrays.paths, arrays.costs, *earlier, rng, arrays.scratch
            )
            rounds = kernel.improve(
                arrays.table,
                arrays.paths,
                arrays.costs,
                road.rounds,
                road.max_paths,
                road.anneals,
                rng,
                arrays.scratch,
            )
            paths |= _paths_of(order, arrays)
        missed = tuple(
            v.vehicle
            for v in vehicles
            if road.last_section(slot, paths[v.vehicle]) not in v.targets
        )
        solve_ms = round(1e3 * (time.monotonic() - began_s), 3)
        return StreamPlan(slot, paths, missed, rounds, solve_ms)


def _check(road: StreamRoad, vehicles: Sequence[StreamVehicle]) -> None:
    taken: dict[Cell, str] = {}
    for one in vehicles:
        if not 0 <= one.cell[1] < road.lanes:
            raise ValueError(f"{one.vehicle} in {one.cell}, but the road has {road.lanes} lanes")
        if taken.setdefault(one.cell, one.vehicle) is not one.vehicle:
            raise ValueError(f"{taken[one.cell]} and {one.vehicle} are both in {one.cell}")


def _earlier_paths(
    slot: int, vehicles: Sequence[StreamVehicle], before: StreamPlan | None, low: int
) -> tuple[Ints, Ints]:
    """Return the cells of all earlier paths from this slot on, and the first index of each."""
    paths: Mapping[str, CellPath] = {}
    age = 0
    if before is not None and before.slot <= slot:
        paths, age = before.paths, slot - before.slot
    old = [paths.get(vehicle.vehicle, ())[age:] for vehicle in vehicles]
    first = np.cumsum([0, *map(len, old)])
    flat = chain.from_iterable(chain.from_iterable(old))
    cells = np.fromiter(flat, dtype=np.int64, count=2 * int(first[-1])).reshape(-1, 2)
    cells[:, 0] -= low
    return cells, first


def _paths_of(vehicles: Sequence[StreamVehicle], arrays: Window) -> dict[str, CellPath]:
    columns = (arrays.paths.column + arrays.low).tolist()
    lanes = arrays.paths.lane.tolist()
    lasts = arrays.paths.slots.tolist()
    return {
        vehicle.vehicle: tuple(zip(columns[v][: last + 1], lanes[v][: last + 1], strict=True))
        for v, (vehicle, last) in enumerate(zip(vehicles, lasts, strict=True))
    }
