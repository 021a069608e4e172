"""The optimal cost as a mixed-integer programme on the time-expanded grid, solved by HiGHS.

One flow per team of vehicles with the same eligible targets. A vehicle on an eligible target may
park: it then stays for ever and costs nothing more; every step before that costs one, waiting too.

Where two vehicles cannot be in one cell (`node` or `geometric`), the moves of a step that exclude
one another form a graph that does not depend on who makes them; its edges are covered by cliques,
one row each. Otherwise every vehicle is a team of its own, and there is one row for each pair of
vehicles and move of the first.
"""

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import permutations
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from oracles.binary_programme import Row, cheapest_choice
from oracles.path_rules import Cell, Move, Path, Problem

PROGRAMME_LIMIT_S = 60.0
"""A programme that takes longer is given up, unless asked otherwise; few do."""
FORBIDDEN = 10_000
"""Distance to a target that a vehicle may not take or cannot reach."""


class UndecidedError(Exception):
    """Neither a solution nor a proof that there is none was found within the limits."""


@dataclass(frozen=True)
class Solution:
    cost: int
    steps: int
    assignment: list[int]
    paths: list[Path]

    def response(self) -> dict[str, Any]:
        """As a plan response."""
        return {
            "status": "optimal",
            "cost": self.cost,
            "lower_bound": self.cost,
            "steps": self.steps,
            "assignment": self.assignment,
            "paths": self.paths,
        }


def optimal_cost(
    request: dict[str, Any], horizon: int | None = None, limit_s: float = PROGRAMME_LIMIT_S
) -> int | None:
    """The least cost over any number of steps; None: proven that there is no solution."""
    solution = optimal_solution(request, horizon, limit_s)
    return None if solution is None else solution.cost


def optimal_solution(
    request: dict[str, Any], horizon: int | None = None, limit_s: float = PROGRAMME_LIMIT_S
) -> Solution | None:
    """A solution of least cost; `horizon` is only where the search for a proof begins."""
    problem = Problem.of(request)
    if any(moves is not None for moves in problem.drivable):
        raise UndecidedError("the programme assumes that every vehicle drives all moves")
    distance = _distances(problem)
    if _matching_cost(distance) >= FORBIDDEN:
        return None
    first = _bottleneck(distance) + 1 if horizon is None else horizon
    solution = _first_solution(problem, first, limit_s)
    if solution is None:
        return None
    # Whoever arrives at a step later than this makes the whole cost no less than what is found.
    longest = solution.cost - 1 - _least_cost_of_the_others(distance)
    if longest <= solution.steps:
        return solution
    cheaper = solve(
        problem,
        longest,
        longer_than=solution.steps,
        cheaper_than=solution.cost,
        limit_s=limit_s,
    )
    return solution if cheaper is None else cheaper


def _first_solution(problem: Problem, horizon: int, limit_s: float) -> Solution | None:
    """A solution that is optimal for some horizon; None: proven that there is no solution."""
    while True:
        solution = solve(problem, horizon, limit_s=limit_s)
        if solution is not None:
            return solution
        if horizon > 2 * (problem.columns + problem.lanes):
            depth = fewest_steps(problem)
            if depth is None:
                return None
            return solve(problem, max(horizon, depth), limit_s=limit_s)
        horizon += 3


# -------------------------------------------------------------------------------- lower bounds


def _distances(problem: Problem) -> np.ndarray[Any, np.dtype[np.int64]]:
    table = np.full((len(problem.starts), len(problem.targets)), FORBIDDEN, dtype=np.int64)
    for i, start in enumerate(problem.starts):
        reached = problem.distances_from(start)
        for j in problem.eligible[i]:
            table[i, j] = reached.get(problem.targets[j], FORBIDDEN)
    return table


def _matching_cost(distance: np.ndarray[Any, np.dtype[np.int64]]) -> int:
    if distance.shape[0] > distance.shape[1]:
        return FORBIDDEN
    rows, columns = linear_sum_assignment(distance)
    return int(distance[rows, columns].sum())


def _least_cost_of_the_others(distance: np.ndarray[Any, np.dtype[np.int64]]) -> int:
    """What all vehicles but one cost at least, whichever that one is."""
    rows = range(distance.shape[0])
    return min(_matching_cost(np.delete(distance, i, axis=0)) for i in rows)


def _bottleneck(distance: np.ndarray[Any, np.dtype[np.int64]]) -> int:
    """The least longest distance of any assignment."""
    for limit in sorted({int(d) for d in distance.flat}):
        if _matching_cost(np.where(distance <= limit, distance, FORBIDDEN)) < FORBIDDEN:
            return limit
    raise AssertionError("no assignment")


# -------------------------------------------------------------------------- conflicts as rows


def is_exclusive(problem: Problem) -> bool:
    """Whether the conflicts keep two vehicles from ever being in the same cell."""
    return "node" in problem.conflicts or "geometric" in problem.conflicts


def conflict_cliques(problem: Problem) -> list[frozenset[Move]]:
    """Cliques that cover exactly the pairs of moves which exclude one another.

    Two moves out of one cell exclude one another as well, for no cell holds two vehicles.
    """
    moves = [move for cell in problem.free_cells() for move in problem.moves_from(cell)]
    beside: dict[Move, set[Move]] = {move: set() for move in moves}
    for a in moves:
        for b in moves:
            near = abs(a[0][0] - b[0][0]) <= 3 and abs(a[0][1] - b[0][1]) <= 2
            if a != b and near and (a[0] == b[0] or problem.conflict(a, b)):
                beside[a].add(b)
    uncovered = {move: set(others) for move, others in beside.items()}
    cliques: list[frozenset[Move]] = []
    for seed in (*_likely_cliques(moves), *([move] for move in moves)):
        first = seed[0]
        while uncovered[first]:
            clique = _clique(seed, beside, uncovered)
            if not any(uncovered[a] & clique for a in clique):
                break
            for a in clique:
                uncovered[a] -= clique
            cliques.append(frozenset(clique))
    return cliques


def _likely_cliques(moves: list[Move]) -> Iterator[list[Move]]:
    """Sets that are cliques for most choices of conflicts; `_clique` leaves out what does not fit.

    First those into and out of one cell, then those with one midpoint.
    """
    groups: dict[tuple[int, int, int], list[Move]] = defaultdict(list)
    for move in moves:
        (c0, l0), (c1, l1) = move
        groups[0, c0, l0].append(move)
        if move[0] != move[1]:
            groups[0, c1, l1].append(move)
            groups[1, c0 + c1, l0 + l1].append(move)
    for key in sorted(groups):
        yield groups[key]


def _clique(
    seed: list[Move], beside: dict[Move, set[Move]], uncovered: dict[Move, set[Move]]
) -> set[Move]:
    clique = {seed[0]}
    common = set(beside[seed[0]])
    for move in seed[1:]:
        if move in common:
            clique.add(move)
            common &= beside[move]
    while common:
        best = max(common, key=lambda move: (len(uncovered[move] & clique), move))
        clique.add(best)
        common &= beside[best]
    return clique


# ------------------------------------------------------------------------------- the programme


Team = tuple[frozenset[int], tuple[int, ...]]
"""Eligible targets, and the vehicles that have just these."""


def _teams(problem: Problem) -> list[Team]:
    if not is_exclusive(problem):
        return [(eligible, (i,)) for i, eligible in enumerate(problem.eligible)]
    members: dict[frozenset[int], list[int]] = defaultdict(list)
    for i, eligible in enumerate(problem.eligible):
        members[eligible].append(i)
    return [(eligible, tuple(vehicles)) for eligible, vehicles in members.items()]


class _Programme:
    def __init__(self, problem: Problem, steps: int) -> None:
        self.problem = problem
        self.steps = steps
        self.teams = _teams(problem)
        self.costs: list[float] = []
        self.rows: list[Row] = []
        # (team, step, move) of a vehicle that has not parked; (team, step, target): parks there
        # at that step; (team, step, target): is parked there during that step.
        self.move: dict[tuple[int, int, Move], int] = {}
        self.park: dict[tuple[int, int, int], int] = {}
        self.parked: dict[tuple[int, int, int], int] = {}
        for k, team in enumerate(self.teams):
            self._add_variables(k, team)
            self._add_flow(k, team)
        at: dict[tuple[int, int, Move], list[int]] = defaultdict(list)
        for (k, t, move), x in self.move.items():
            at[k, t, move].append(x)
        for (k, t, j), x in self.parked.items():
            cell = problem.targets[j]
            at[k, t, (cell, cell)].append(x)
        if is_exclusive(problem):
            self._add_cliques(at)
        else:
            self._add_pairs(at)

    def _variable(self, cost: float) -> int:
        self.costs.append(cost)
        return len(self.costs) - 1

    def _add_variables(self, k: int, team: Team) -> None:
        problem, steps = self.problem, self.steps
        eligible, vehicles = team
        begin = _nearest([problem.distances_from(problem.starts[i]) for i in vehicles])
        end = _nearest([problem.distances_from(problem.targets[j]) for j in eligible])
        for cell in problem.free_cells():
            for move in problem.moves_from(cell):
                first, last = begin.get(cell, steps), steps - 1 - end.get(move[1], steps)
                for t in range(first, last + 1):
                    self.move[k, t, move] = self._variable(1.0)
        for j in eligible:
            for t in range(begin.get(problem.targets[j], steps + 1), steps + 1):
                self.park[k, t, j] = self._variable(0.0)
                self.parked[k, t, j] = self._variable(0.0)

    def _add_flow(self, k: int, team: Team) -> None:
        problem = self.problem
        eligible, vehicles = team
        balance: dict[tuple[int, Cell], list[tuple[int, float]]] = defaultdict(list)
        for i in vehicles:
            balance[0, problem.starts[i]] += []
        for (team_of, t, move), x in self.move.items():
            if team_of == k:
                balance[t, move[0]].append((x, -1.0))
                balance[t + 1, move[1]].append((x, 1.0))
        for j in eligible:
            for t in range(self.steps + 1):
                if (k, t, j) not in self.park:
                    continue
                balance[t, problem.targets[j]].append((self.park[k, t, j], -1.0))
                held = [(self.parked[k, t, j], 1.0), (self.park[k, t, j], -1.0)]
                if (k, t - 1, j) in self.parked:
                    held.append((self.parked[k, t - 1, j], -1.0))
                self.rows.append((held, 0.0, 0.0))
        starts = [problem.starts[i] for i in vehicles]
        for (t, cell), terms in balance.items():
            supply = -float(starts.count(cell)) if t == 0 else 0.0
            self.rows.append((terms, supply, supply))

    def _add_cliques(self, at: dict[tuple[int, int, Move], list[int]]) -> None:
        teams = range(len(self.teams))
        for clique in (*conflict_cliques(self.problem), *self._isolated_moves()):
            for t in range(self.steps):
                terms = [(x, 1.0) for k in teams for a in clique for x in at.get((k, t, a), ())]
                if len(terms) > 1:
                    self.rows.append((terms, -np.inf, 1.0))
        # Vehicles that park at the very end meet in no later step.
        self._add_distinct_targets()

    def _isolated_moves(self) -> list[frozenset[Move]]:
        """A cell from which no other move is possible still holds one vehicle only."""
        cells = self.problem.free_cells()
        return [frozenset({(v, v)}) for v in cells if len(self.problem.moves_from(v)) == 1]

    def _add_distinct_targets(self) -> None:
        for j in range(len(self.problem.targets)):
            keys = [(k, self.steps, j) for k in range(len(self.teams))]
            terms = [(self.parked[key], 1.0) for key in keys if key in self.parked]
            self.rows.append((terms, -np.inf, 1.0))

    def _add_pairs(self, at: dict[tuple[int, int, Move], list[int]]) -> None:
        problem = self.problem
        moves = [move for cell in problem.free_cells() for move in problem.moves_from(cell)]
        against = {a: [b for b in moves if problem.conflict(a, b)] for a in moves}
        for i, j in permutations(range(len(self.teams)), 2):
            for t in range(self.steps):
                for a in moves:
                    own = [(x, 1.0) for x in at.get((i, t, a), ())]
                    other = [(x, 1.0) for b in against[a] for x in at.get((j, t, b), ())]
                    if own and other:
                        self.rows.append((own + other, -np.inf, 1.0))
        self._add_distinct_targets()

    def require_arrival_after(self, step: int) -> None:
        late = [(x, 1.0) for (_, t, _), x in self.park.items() if t > step]
        self.rows.append((late, 1.0, np.inf))

    def require_cost_below(self, cost: int) -> None:
        self.rows.append(([(x, 1.0) for x in self.move.values()], -np.inf, cost - 1.0))

    def solve(self, limit_s: float) -> Solution | None:
        if not self.costs:
            return None
        result = cheapest_choice(self.costs, self.rows, limit_s)
        if result.status == 2:
            return None
        if result.status != 0:
            raise UndecidedError(result.message)
        assert abs(result.fun - round(result.fun)) < 1e-5
        return self._solution(round(result.fun), result.x > 0.5)

    def _solution(self, cost: int, chosen: np.ndarray[Any, np.dtype[np.bool_]]) -> Solution:
        """Vehicles of one team are never in one cell, so the flow falls into paths in one way."""
        problem = self.problem
        paths: list[Path] = [[start] for start in problem.starts]
        for t in range(self.steps):
            for k, (_, vehicles) in enumerate(self.teams):
                follow = {
                    move[0]: move[1]
                    for i in vehicles
                    for move in problem.moves_from(paths[i][t])
                    if (k, t, move) in self.move and chosen[self.move[k, t, move]]
                }
                for i in vehicles:
                    paths[i].append(follow.get(paths[i][t], paths[i][t]))
        assignment = [problem.targets.index(path[-1]) for path in paths]
        return Solution(cost, self.steps, assignment, paths)


def _nearest(tables: list[dict[Cell, int]]) -> dict[Cell, int]:
    nearest: dict[Cell, int] = {}
    for table in tables:
        for cell, distance in table.items():
            nearest[cell] = min(distance, nearest.get(cell, distance))
    return nearest


def solve(
    problem: Problem,
    steps: int,
    *,
    longer_than: int | None = None,
    cheaper_than: int | None = None,
    limit_s: float = PROGRAMME_LIMIT_S,
) -> Solution | None:
    """A cheapest solution in which all vehicles have arrived after `steps` steps.

    Of those only in which somebody arrives after step `longer_than`, and which cost less than
    `cheaper_than`.
    """
    programme = _Programme(problem, steps)
    if longer_than is not None:
        programme.require_arrival_after(longer_than)
    if cheaper_than is not None:
        programme.require_cost_below(cheaper_than)
    return programme.solve(limit_s)


# ---------------------------------------------------------------------------- exhaustive search


def fewest_steps(problem: Problem, limit: int = 200_000) -> int | None:
    """After how many steps all vehicles can be on targets; None: never, proven exhaustively."""
    if not is_exclusive(problem):
        raise UndecidedError("too long for the programme, and vehicles may share cells")
    teams = _teams(problem)
    goals = [frozenset(problem.targets[j] for j in eligible) for eligible, _ in teams]
    start = tuple(frozenset(problem.starts[i] for i in vehicles) for _, vehicles in teams)
    seen = {start}
    layer = [start]
    depth = 0
    while layer:
        following = []
        for state in layer:
            if all(cells <= goal for cells, goal in zip(state, goals, strict=True)):
                return depth
            for successor in _successors(problem, state):
                if successor not in seen:
                    seen.add(successor)
                    following.append(successor)
            if len(seen) > limit:
                raise UndecidedError(f"more than {limit} joint configurations")
        layer = following
        depth += 1
    return None


def _successors(
    problem: Problem, state: tuple[frozenset[Cell], ...]
) -> set[tuple[frozenset[Cell], ...]]:
    vehicles = [(k, cell) for k, cells in enumerate(state) for cell in sorted(cells)]
    found: set[tuple[frozenset[Cell], ...]] = set()

    def extend(chosen: list[Move]) -> None:
        if len(chosen) == len(vehicles):
            ends: list[set[Cell]] = [set() for _ in state]
            for (k, _), move in zip(vehicles, chosen, strict=True):
                ends[k].add(move[1])
            found.add(tuple(frozenset(cells) for cells in ends))
            return
        for move in problem.moves_from(vehicles[len(chosen)][1]):
            if not any(problem.conflict(move, other) for other in chosen):
                extend([*chosen, move])

    extend([])
    return found
