"""Costs, preferences and assignments in non-decreasing order of cost (paper, section `candi`).

The cost matrix C holds the formation relative distance, FRD (equation `rd`):

    d^r_ij = l^o N^{r,o}_ij + l^s N^{r,s}_ij

N^{r,o} counts the oblique edges of a shortest path, the smaller of the two coordinate differences;
N^{r,s} counts its straight edges, the rest of the larger one. The paper sets l^s = l^o = 1, so that
FRD counts steps in mode 2. In mode 1 an oblique edge takes two steps, hence l^o = 2 there.
TAPPA stops once the next assignment costs at least as much as the best path set; this is correct
only if C is a lower bound on steps; other weights are rejected.

The preference matrix P says which vehicle may be assigned to which target. The paper multiplies
the costs of forbidden pairs by a large number M. Here P is boolean and forbidden pairs are never
assigned, so the result does not depend on a choice of M.

Assignments are enumerated by Murty's method: the set of all assignments is split into parts that
are described by a prefix of fixed pairs and by forbidden targets for the next row. Taking the best
assignment out of its part splits the part again. Each new part differs from its parent in one
freed vehicle, so its best assignment is found by one shortest augmenting path from the parent's
dual variables.

Costs are whole numbers. Ties between assignments go to the lexicographically smallest vector:
the cost is extended by the vector read as a number with one digit per vehicle, which
makes all costs distinct and the order independent of the algorithm.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Sequence

import attrs
import numpy as np
import numpy.typing as npt

from laneweave.coordinator.planning.budget import Budget
from laneweave.coordinator.planning.problem import Problem
from laneweave.coordinator.planning.request import PlanRequest
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.lattice import Cell, Mode

BoolMatrix = npt.NDArray[np.bool_]
IntMatrix = npt.NDArray[np.int64]
Row = dict[int, int]
"""One vehicle's allowed targets and their extended costs."""


@attrs.frozen
class Weights:
    """The weights l^s and l^o of straight and oblique edges."""

    straight: int
    oblique: int

    @classmethod
    def for_mode(cls, mode: Mode) -> Weights:
        """Return the largest weights for which the distance is a lower bound on steps."""
        return cls(straight=1, oblique=2 if mode == 1 else 1)

    def checked(self, mode: Mode) -> Weights:
        """Return the weights if they are valid in this mode.

        Raises:
            BadInputError: they give no lower bound on steps in this mode.
        """
        maximum = Weights.for_mode(mode)
        for name, value, limit in (
            ("l_s", self.straight, maximum.straight),
            ("l_o", self.oblique, maximum.oblique),
        ):
            if not 0 <= value <= limit:
                raise BadInputError(name, value, f"0 to {limit} in mode {mode}, a lower bound")
        return self


def frd(vehicle: Cell, target: Cell, weights: Weights) -> int:
    """Return the formation relative distance from a vehicle's cell to a target (equation `rd`)."""
    x = abs(vehicle[0] - target[0])
    y = abs(vehicle[1] - target[1])
    return weights.oblique * min(x, y) + weights.straight * (max(x, y) - min(x, y))


def cost_matrix(vehicles: Sequence[Cell], targets: Sequence[Cell], weights: Weights) -> IntMatrix:
    """Return C: row i, column j holds the distance from vehicle i to target j."""
    rows = [[frd(v, t, weights) for t in targets] for v in vehicles]
    return np.array(rows, dtype=np.int64).reshape(len(vehicles), len(targets))


def preference_matrix(choices: Sequence[frozenset[int]], target_count: int) -> BoolMatrix:
    """Return P: row i, column j is true if vehicle i may take target j."""
    allowed = np.zeros((len(choices), target_count), dtype=np.bool_)
    for i, choice in enumerate(choices):
        allowed[i, sorted(choice)] = True
    return allowed


def matrices(
    request: PlanRequest, problem: Problem, weights: Weights, budget: Budget
) -> tuple[IntMatrix, BoolMatrix]:
    """Return the cost matrix C and the preference matrix P of a request.

    Blocked cells, or moves that a vehicle cannot drive, may make a path longer than the formation
    relative distance, or impossible. Both only improve the lower bound: C takes the longer
    distance, and P drops targets that cannot be reached, or not within the permitted steps.
    """
    budget.check_time()
    starts = [vehicle.cell for vehicle in request.vehicles]
    costs = cost_matrix(starts, request.targets, weights)
    allowed = preference_matrix(request.choices(), len(request.targets))
    for i, (start, undrivable) in enumerate(zip(problem.starts, problem.undrivable, strict=True)):
        if request.grid.blocked or undrivable:
            budget.check_time()
            distances = problem.table.distances(1 << start, undrivable)
            for j, target in enumerate(problem.targets):
                if target in distances:
                    costs[i, j] = max(costs[i, j], distances[target])
                else:
                    allowed[i, j] = np.False_
    if problem.max_steps is not None:
        allowed &= costs <= problem.max_steps
    return costs, allowed


@attrs.frozen
class Assignment:
    """The assignment vector a (0-based targets) and its cost C."""

    targets: tuple[int, ...]
    cost: int


@attrs.define(eq=False)
class _Matching:
    """A minimum-cost matching with the dual variables that prove its optimality.

    Dummy rows of cost 0 make the matrix square; they take the remaining targets.

    rows: target of each row.
    columns: row of each target.
    u, v: potentials of rows and targets.
    """

    rows: list[int]
    columns: list[int]
    u: list[int]
    v: list[int]

    def copy(self) -> _Matching:
        """Return an independent copy."""
        return _Matching(self.rows[:], self.columns[:], self.u[:], self.v[:])

    def augment(self, costs: Sequence[Row], row: int, fixed: int, banned: frozenset[int]) -> bool:
        """Match the free `row` along a shortest augmenting path; return whether there is one.

        Rows before `fixed` keep their targets; `row` itself must not take a `banned` target.
        """
        distance: dict[int, int] = {}
        reached_from: dict[int, int] = {}
        done: dict[int, int] = {}
        heap: list[tuple[int, int]] = []
        at, travelled = row, 0
        while True:
            base = travelled - self.u[at]
            for j, cost in costs[at].items():
                if j in done or self._is_fixed(j, fixed) or (at == row and j in banned):
                    continue
                length = base + cost - self.v[j]
                if j not in distance or length < distance[j]:
                    distance[j] = length
                    reached_from[j] = at
                    heapq.heappush(heap, (length, j))
            while heap and heap[0][1] in done:
                heapq.heappop(heap)
            if not heap:
                return False
            travelled, column = heapq.heappop(heap)
            if self.columns[column] < 0:
                break
            done[column] = travelled
            at = self.columns[column]
        self.u[row] += travelled
        for j, length in done.items():
            self.u[self.columns[j]] += travelled - length
            self.v[j] -= travelled - length
        while True:
            at = reached_from[column]
            self.columns[column] = at
            self.rows[at], column = column, self.rows[at]
            if at == row:
                return True

    def _is_fixed(self, column: int, fixed: int) -> bool:
        return 0 <= self.columns[column] < fixed


@attrs.define(order=True)
class _Part:
    """A part of the set of all assignments, ordered by the cost of its best assignment."""

    key: int
    matching: _Matching = attrs.field(order=False)
    fixed: int = attrs.field(order=False)
    banned: frozenset[int] = attrs.field(order=False)


def assignments(
    costs: IntMatrix, allowed: BoolMatrix, budget: Budget | None = None
) -> Iterator[Assignment]:
    """Yield all assignments of allowed pairs, cheapest first, ties in lexicographic order.

    There may be more targets than vehicles. Assignments are computed lazily.
    """
    budget = budget or Budget()
    vehicle_count, target_count = costs.shape
    if vehicle_count > target_count:
        return
    scale = max(target_count, 1) ** vehicle_count
    rows = _extended_costs(costs, allowed, scale)
    first = _best(rows, vehicle_count, target_count, budget)
    heap = [] if first is None else [_Part(_key(rows, first, vehicle_count), first, 0, frozenset())]
    while heap:
        part = heapq.heappop(heap)
        chosen = tuple(part.matching.rows[:vehicle_count])
        yield Assignment(chosen, part.key // scale)
        for row in range(part.fixed, vehicle_count):
            budget.check_time()
            banned = {chosen[row]} | (part.banned if row == part.fixed else frozenset())
            child = part.matching.copy()
            child.columns[chosen[row]] = -1
            child.rows[row] = -1
            if child.augment(rows, row, row, frozenset(banned)):
                key = _key(rows, child, vehicle_count)
                heapq.heappush(heap, _Part(key, child, row, frozenset(banned)))


def _extended_costs(costs: IntMatrix, allowed: BoolMatrix, scale: int) -> list[Row]:
    """Return the costs with tie-breaking digits, followed by a row of zeros per idle target."""
    vehicle_count, target_count = costs.shape
    rows = []
    digit = scale
    for i in range(vehicle_count):
        digit //= target_count
        rows.append(
            {j: int(costs[i, j]) * scale + j * digit for j in range(target_count) if allowed[i, j]}
        )
    idle: Row = dict.fromkeys(range(target_count), 0)
    return rows + [idle] * (target_count - vehicle_count)


def _best(
    rows: list[Row], vehicle_count: int, target_count: int, budget: Budget
) -> _Matching | None:
    """Return the cheapest matching of all rows, or None if some vehicle has no target left."""
    none = [-1] * target_count
    matching = _Matching(none[:], none[:], [0] * target_count, [0] * target_count)
    for row in range(vehicle_count):
        budget.check_time()
        if not matching.augment(rows, row, 0, frozenset()):
            return None
    # An unassigned target still has potential 0, so an idle row at cost 0 is tight.
    remaining = (j for j, row in enumerate(matching.columns) if row < 0)
    for row, j in enumerate(remaining, start=vehicle_count):
        matching.rows[row] = j
        matching.columns[j] = row
    return matching


def _key(rows: list[Row], matching: _Matching, vehicle_count: int) -> int:
    return sum(rows[i][matching.rows[i]] for i in range(vehicle_count))
