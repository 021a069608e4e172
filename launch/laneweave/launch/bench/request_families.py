"""Seeded families of planning requests, for `laneweave bench planner` and for tests.

Vehicles prefer random lanes, and the targets are parallel: each lane has one per vehicle that
prefers it. In `block_request` and `formation_request`, vehicles start interlaced (on a
checkerboard), and the targets are in the middle columns. In `traffic_request`, random traffic
defines the starts, and `targets.placements` places the targets as for a formation on the road.
"""

from __future__ import annotations

import math
import random
from collections import deque
from collections.abc import Sequence

import attrs

from laneweave.coordinator.planning.grid import Grid
from laneweave.coordinator.planning.request import PlanRequest, VehicleRequest
from laneweave.coordinator.planning.targets import placements
from laneweave.protocol.lattice import Cell, Mode
from laneweave.protocol.scenario.formation_table import DEFAULT_CONFLICTS
from laneweave.protocol.wire.messages import Name

_SPARE_COLUMNS = (2, 4)

TRAFFIC_KINDS = ("node", "edge", "special-1", "closing")
"""The conflict kinds of a scenario's formations in mode 1."""
_TRAFFIC_VOLUMES = (1000, 2000)
"""veh/(lane h)"""
_MIN_HEADWAY_S = 1.0
_TRAFFIC_LANES, _TRAFFIC_COLUMNS = 3, (3, 7)
"""Number of lanes; (lowest, highest) number of columns of a formation."""


def block_request(
    seed: int,
    *,
    vehicles: int = 6,
    columns: int = 4,
    lanes: int = 3,
    mode: Mode = 1,
    conflicts: Sequence[str] | None = None,
    deadline_s: float = 4.0,
) -> PlanRequest:
    """Return a request for a block without spare columns, that is, with few empty cells."""
    rng = random.Random(seed)  # noqa: S311
    starts = _checkerboard(vehicles, columns, lanes, first_column=0)
    preferred = _preferred_lanes(rng, vehicles, lanes, columns=columns)
    return _request(Grid(columns, lanes), starts, preferred, mode, conflicts, deadline_s)


def formation_request(
    seed: int,
    *,
    vehicles: int = 6,
    lanes: int = 3,
    mode: Mode = 1,
    conflicts: Sequence[str] | None = None,
    deadline_s: float = 4.0,
) -> PlanRequest:
    """Return a request for a formation with 2 to 4 spare columns ahead of it and behind it."""
    rng = random.Random(seed)  # noqa: S311
    behind, ahead = rng.randint(*_SPARE_COLUMNS), rng.randint(*_SPARE_COLUMNS)
    occupied = -(-2 * vehicles // lanes)
    columns = behind + occupied + ahead
    starts = _checkerboard(vehicles, columns, lanes, first_column=behind)
    preferred = _preferred_lanes(rng, vehicles, lanes, columns=columns)
    return _request(Grid(columns, lanes), starts, preferred, mode, conflicts, deadline_s)


def traffic_request(
    seed: int,
    *,
    vehicles: int = 6,
    mode: Mode = 1,
    conflicts: Sequence[str] = TRAFFIC_KINDS,
    deadline_s: float = 4.0,
) -> PlanRequest:
    """Return a request for the second formation of random traffic in three lanes.

    The volume is between 1000 and 2000 veh/(lane h). A formation has 3 to 7 columns: it ends with
    its last vehicle, before a column with too many vehicles, or with its seventh column.
    """
    rng = random.Random(seed)  # noqa: S311
    stream = _Arrivals(rng, rng.uniform(*_TRAFFIC_VOLUMES), vehicles)
    stream.formation()
    columns, entered = stream.formation()
    cells = {Name(f"v{i + 1}"): cell for i, (cell, _) in enumerate(entered)}
    preferred = {Name(f"v{i + 1}"): lane for i, (_, lane) in enumerate(entered)}
    targets = next(placements(cells, preferred, columns, _TRAFFIC_LANES))
    return PlanRequest(
        Grid(columns, _TRAFFIC_LANES),
        mode,
        tuple(conflicts),
        tuple(VehicleRequest(name, cells[name], lane=preferred[name]) for name in cells),
        targets.cells,
        deadline_s,
    )


@attrs.define
class _Vehicle:
    """A vehicle's arrival time [s] in its lane, and its preferred lane."""

    arrival_s: float
    preferred_lane: int


class _Arrivals:
    """Vehicles that arrive in each lane while one column of cells passes per second.

    A headway is 1 s plus an exponentially distributed time.
    """

    def __init__(self, rng: random.Random, volume: float, max_vehicles: int) -> None:
        self._rng = rng
        self._max_vehicles = max_vehicles
        self._mean_rest_s = 3600.0 / volume - _MIN_HEADWAY_S
        self._column = 0
        self._waiting: list[deque[_Vehicle]] = [deque() for _ in range(_TRAFFIC_LANES)]
        self._last_s = [0.0] * _TRAFFIC_LANES

    def _first_vehicles(self) -> list[tuple[int, _Vehicle]]:
        """Return (lane, vehicle) pairs that may enter the next column, in order of arrival."""
        first = []
        for lane, queue in enumerate(self._waiting):
            while not queue or self._last_s[lane] <= self._column:
                headway_s = _MIN_HEADWAY_S + self._rng.expovariate(1.0 / self._mean_rest_s)
                self._last_s[lane] += headway_s
                queue.append(_Vehicle(self._last_s[lane], self._rng.randrange(_TRAFFIC_LANES)))
            if queue[0].arrival_s <= self._column:
                first.append((lane, queue[0]))
        return sorted(first, key=lambda head: (head[1].arrival_s, head[0]))

    def formation(self) -> tuple[int, list[tuple[Cell, int]]]:
        """Return the next formation's column count, and each vehicle's cell and preferred lane."""
        shortest, longest = _TRAFFIC_COLUMNS
        self._column = max(
            self._column, math.ceil(min(q[0].arrival_s for q in self._nonempty_queues()))
        )
        entered: list[tuple[int, int, int]] = []
        columns = 0
        while columns < longest and (len(entered) < self._max_vehicles or columns < shortest):
            max_per_lane = max(shortest, columns + 1)
            preferred = [preferred_lane for _, _, preferred_lane in entered]
            entering = []
            for lane, vehicle in self._first_vehicles():
                # A vehicle waits if its preferred lane has no target left for it.
                if preferred.count(vehicle.preferred_lane) < max_per_lane:
                    preferred.append(vehicle.preferred_lane)
                    entering.append(lane)
            free_places = self._max_vehicles - len(entered)
            if len(entering) > free_places and columns >= shortest:
                break
            entered += [
                (columns, lane, self._waiting[lane].popleft().preferred_lane)
                for lane in entering[:free_places]
            ]
            columns += 1
            self._column += 1
        return columns, [
            ((columns - 1 - back, lane), preferred_lane) for back, lane, preferred_lane in entered
        ]

    def _nonempty_queues(self) -> list[deque[_Vehicle]]:
        """Fill the queues and return them, each with at least one vehicle."""
        self._first_vehicles()
        return self._waiting


def _checkerboard(vehicles: int, columns: int, lanes: int, first_column: int) -> list[Cell]:
    board = [
        (column, lane)
        for column in range(first_column, columns)
        for lane in range(lanes)
        if (column - first_column + lane) % 2 == 0
    ]
    if len(board) < vehicles:
        raise ValueError(f"{vehicles} vehicles do not fit into {columns} x {lanes} interlaced")
    return board[:vehicles]


def _preferred_lanes(rng: random.Random, vehicles: int, lanes: int, columns: int) -> list[int]:
    """Draw preferred lanes until no lane is preferred by more vehicles than it has columns."""
    if vehicles > columns * lanes:
        raise ValueError(f"{vehicles} vehicles do not fit in {lanes} lanes of {columns} columns")
    while True:
        preferred = [rng.randrange(lanes) for _ in range(vehicles)]
        if all(preferred.count(lane) <= columns for lane in range(lanes)):
            return preferred


def _request(
    grid: Grid,
    starts: Sequence[Cell],
    preferred: Sequence[int],
    mode: Mode,
    conflicts: Sequence[str] | None,
    deadline_s: float,
) -> PlanRequest:
    targets = []
    for lane in range(grid.lanes):
        count = preferred.count(lane)
        first = (grid.columns - count) // 2
        targets += [(first + k, lane) for k in range(count)]
    vehicles = [
        VehicleRequest(f"v{i + 1}", cell, lane=lane)
        for i, (cell, lane) in enumerate(zip(starts, preferred, strict=True))
    ]
    kinds = DEFAULT_CONFLICTS[mode] if conflicts is None else tuple(conflicts)
    return PlanRequest(grid, mode, kinds, tuple(vehicles), tuple(targets), deadline_s)
