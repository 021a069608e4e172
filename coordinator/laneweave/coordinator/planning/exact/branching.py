"""The solver for large formations: branch and bound with prices.

1. Prices on the conflict rows give a lower bound, and tell what is too dear (`relaxation`).
2. For the least cost that is still possible a search decides whether it is. In each of its nodes
   prices are improved and what no solution of this cost contains is forbidden. Either the bound
   passes the cost, or the vehicles on their cheapest ways happen not to be in conflict, which is a
   solution, or the moves of one row are told apart: at most one of them is made in its step, so
   either all moves of a team (or from a cell) are forbidden in this row, or all others
   (`branching_kernel`; this kind of branching is by Beale and Tomlin, Proc. 5th Int. Conf. on
   Operational Research, 1970).
3. If no node is left, the next cost is looked at.

The first cost that is possible is the least one. A little price on moves lets the search go on for
a solution with fewer moves of the same cost, for about half as long as it took until then.

The budget for what is too dear, the cost less the bound, is small; so few moves are left, and most
nodes are decided soon. Other than trees of conflicts between single vehicles, it does not matter
how many vehicles of a team could take one another's place.

Between the nodes path sets are made by negotiation (`negotiation`), so that there is an answer when
the deadline comes first; if that fails, by a joint search (`reachability`), which also finds out
that there is none.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from functools import cache
from itertools import pairwise

import numpy as np
from scipy.optimize import linear_sum_assignment

from laneweave.coordinator.planning.budget import Budget, BudgetSpentError
from laneweave.coordinator.planning.exact.arrays import UNREACHABLE, Floats, Ints, lattice, teams
from laneweave.coordinator.planning.exact.branching_kernel import FULL, STUCK, search
from laneweave.coordinator.planning.exact.negotiation import Negotiation
from laneweave.coordinator.planning.exact.reachability import explore
from laneweave.coordinator.planning.exact.relaxation import Relaxation, Stack, ceiling_of, stack
from laneweave.coordinator.planning.exact.relaxation_kernel import (
    BEST,
    FOUND,
    OPEN,
    PARKED,
    PER_MOVE,
    REFUTED,
)
from laneweave.coordinator.planning.exact.repair import Repair
from laneweave.coordinator.planning.exact.trial import trial
from laneweave.coordinator.planning.grid import Grid
from laneweave.coordinator.planning.problem import Problem
from laneweave.coordinator.planning.request import PlanRequest, VehicleRequest
from laneweave.coordinator.planning.solution import Solution, tidied

_SPARE_STEPS, _MORE_STEPS = 8, 6
"""Steps with prices beyond the longest way; more when a solution may need more."""
_ITERATIONS, _FEW_ITERATIONS, _AT_A_TIME = 40, 10, 10
"""For first prices, if there are many or few vehicles; iterations between two looks at bounds."""
_FEW_VEHICLES = 11
_FIRST_STACK = 16
_CHUNK_S = 0.005
"""How long the search goes on between two looks at the clock, about."""
_NODES_BETWEEN = 8
"""Nodes between two looks for path sets by other means."""
_MANY_VEHICLES = 20
"""So many are not decided soon: they get a path set first."""
_FIRST_WORK, _WORK_FOR_GAP, _STALE = 200, 100, 100
"""How much is negotiated then until there is a path set; later, the more the larger the gap is, and
half as much after so much work in vain."""
_EXPLORE_NODES, _EXPLORE_MOVES, _MOST_EXPLORE_MOVES, _GROWTH = 16, 5_000, 1_500_000, 4
"""When the joint search is tried, if there is no path set yet, and how far; then more of both."""
_TIE_NODES = 10
_WARM_UP_WORK = 8
_MOST_BYTES, _BYTES_PER_S = 1_500_000_000, 1_000_000_000
"""Larger tables are not made; and how fast they are filled, about."""


@cache
def warm_up() -> None:
    """Load the compiled code; where there is none yet, compile it, which takes half a minute."""
    # Two who change places, which is not decided at once.
    vehicles = (VehicleRequest("a", (0, 0), lane=1), VehicleRequest("b", (0, 1), lane=0))
    request = PlanRequest(Grid(2, 2), 1, ("geometric",), vehicles, ((0, 0), (0, 1)))
    starts = [vehicle.cell for vehicle in vehicles]
    model = request.conflict_model
    problem = Problem(request.grid, request.mode, model, starts, request.targets)
    search_ = Branching(problem, request.choices(), Budget())
    search_.run()
    search_.negotiate(search_.relaxation(_SPARE_STEPS), _WARM_UP_WORK)
    search_.repair_once()


class Branching:
    """The state of the search; the same to its caller as `Tappa`.

    best: the cheapest path set so far.
    lower_bound: no path set costs less; infinite: there is none.
    finished: the search is complete; `best` is optimal, or nothing exists.
    has_fewest_moves: it is proven, too, that nothing as cheap has fewer moves.
    """

    def __init__(self, problem: Problem, choices: Sequence[frozenset[int]], budget: Budget) -> None:
        """Prepare the search."""
        self.lower_bound: float = 0
        self.finished = False
        self.tried = 0
        self.has_fewest_moves = False
        self.gave_up = False
        """It is stuck (`branching_kernel.STUCK`), or its tables would get too large."""
        self.best: Solution | None = None
        self._negotiation: Negotiation | None = None
        self._problem = problem
        self._choices = choices
        self._budget = budget
        self._nodes = 0
        self._look_around = _NODES_BETWEEN
        self._explore_nodes, self._explore_moves = _EXPLORE_NODES, _EXPLORE_MOVES
        self._s_per_node = 0.0
        self._s_per_iteration = 1.0
        self._stuck_at: int | None = None
        self._best_value = UNREACHABLE
        table = problem.table
        pairs = sum(map(len, set(choices)))
        if 8 * pairs * table.grid.columns * table.grid.lanes > _MOST_BYTES:
            self.gave_up = True
            return
        self._lattice = lattice(table.grid, table.mode, table.model)
        starts = [table.cell(start) for start in problem.starts]
        targets = [table.cell(target) for target in problem.targets]
        self._teams = teams(self._lattice, starts, targets, choices)

    def run(self) -> None:
        """Search until the optimum is proven or the budget is spent."""
        if self.gave_up:
            return
        try:
            self._search()
        except BudgetSpentError:
            if self.best is not None:
                self.lower_bound = min(self.lower_bound, self.best.cost)

    def _search(self) -> None:
        if len(self._teams.target) < len(self._teams.start) or not all(self._choices):
            self.lower_bound, self.finished = math.inf, True
            return
        steps = self._longest_way() + _SPARE_STEPS
        if not self._may_make(steps, _FIRST_STACK):
            self.gave_up = True
            return
        whole = self.relaxation(steps)
        few = len(self._choices) <= _FEW_VEHICLES
        for number in range(0, _FEW_ITERATIONS if few else _ITERATIONS, _AT_A_TIME):
            self._improve(whole, _AT_A_TIME)
            if math.isinf(self.lower_bound) or self._is_proven():
                break
            if number == _AT_A_TIME and len(self._choices) >= _MANY_VEHICLES:
                self.negotiate(whole, _FIRST_WORK, stop_at_first=True)
        nodes = self._stack(whole, _FIRST_STACK)
        while not self.finished and not self.gave_up:
            if math.isinf(self.lower_bound):
                self.finished = True
            elif self._is_proven():
                nodes = self._break_ties(whole, nodes)
                self.finished = True
            else:
                nodes = self._decide(whole, nodes, int(self.lower_bound))

    def _is_proven(self) -> bool:
        return self.best is not None and self.best.cost <= self.lower_bound

    def _improve(self, whole: Relaxation, iterations: int) -> None:
        """Improve the first prices; looks at the clock between a few iterations."""
        while iterations > 0:
            count = max(1, min(iterations, int(_CHUNK_S / max(self._s_per_iteration, 1e-6))))
            started = time.thread_time()
            whole.improve(count)
            self._s_per_iteration = (time.thread_time() - started) / count
            iterations -= count
            self._budget.check_time()
        self._take_chance(whole)
        self.lower_bound = max(self.lower_bound, whole.least_cost)

    def _may_make(self, steps: int, nodes: int) -> bool:
        """Tell whether tables of so many steps and nodes fit into memory.

        Raises:
            BudgetSpentError: they do, but there is no time left to fill them.
        """
        displacements, cells = self._lattice.valid.shape
        groups, rows = len(self._teams.pair), self._lattice.row_count
        moves, masses = groups * displacements * cells, groups + self._lattice.near_count
        size = 8 * cells * len(self._teams.pair_cell) + 33 * moves + 8 * rows * (masses + 3)
        size = int(steps * (size + nodes * (moves + 8 * rows)))
        if size >= _MOST_BYTES:
            return False
        self._budget.check_time(size / _BYTES_PER_S)
        return True

    def relaxation(self, steps: int) -> Relaxation:
        """Return the problem without prices."""
        return Relaxation(self._lattice, self._teams, steps)

    def _stack(self, whole: Relaxation, size: int) -> Stack:
        return stack(self._teams, whole.prices, self._lattice.valid, size)

    def _longest_way(self) -> int:
        """Return the steps of the longest way when targets are assigned at least cost."""
        pairs = self._teams.pair[self._teams.team]
        ways = np.where(
            pairs >= 0, self._teams.distance[self._teams.start[:, None], pairs], UNREACHABLE
        )
        steps = ways[linear_sum_assignment(ways)]
        return int(max(steps[steps < UNREACHABLE], default=0))

    def _decide(self, whole: Relaxation, nodes: Stack, cost: int) -> Stack:
        """Find a solution of a cost, or show that there is none; or have more steps priced."""
        self._budget.check_time()
        ceiling = ceiling_of(cost)
        may_be = whole.put(nodes, ceiling)
        if may_be is None:
            return self._lengthened(whole, nodes)
        depth, ending = 1, OPEN if may_be else REFUTED
        first = True
        while ending in (OPEN, FULL):
            if ending == FULL:
                if not self._may_make(len(whole.prices), 2 * len(nodes.pace)):
                    break
                nodes = _doubled(nodes)
            ending, depth = self._go_on(whole, nodes, depth, ceiling, 1 if first else None)
            if first and depth > 1:
                whole.take_prices(nodes.prices[0])
            first = False
            if ending == OPEN:
                self._look_for_others(whole, nodes.prices[depth - 1])
                if self.finished or (self.best is not None and self.best.cost <= cost):
                    return nodes
        if ending == REFUTED:
            self.lower_bound = cost + 1
        elif ending == FOUND:
            self._search_fewer_moves(whole, nodes, depth)
            self.finished = True
        elif ending == STUCK and self._stuck_at != cost:
            # Perhaps somebody must pass another target of its team after the last priced step.
            self._stuck_at = cost
            return self._lengthened(whole, nodes)
        else:
            self.gave_up = True
        return nodes

    def _lengthened(self, whole: Relaxation, nodes: Stack) -> Stack:
        """Have more steps priced; return an empty stack."""
        more = max(_MORE_STEPS, len(whole.prices) // 2)
        if not self._may_make(len(whole.prices) + more, len(nodes.pace)):
            self.gave_up = True
            return nodes
        whole.lengthen(more)
        return self._stack(whole, len(nodes.pace))

    def _break_ties(self, whole: Relaxation, nodes: Stack) -> Stack:
        """Look for a solution that costs as much as the best one, with fewer moves."""
        ceiling = self._best_value - 0.5 * PER_MOVE
        may_be = whole.put(nodes, ceiling)
        if may_be:
            whole.memory[BEST] = self._best_value
            self._search_fewer_moves(whole, nodes, 1)
        self.has_fewest_moves = self.has_fewest_moves or may_be is False
        return nodes

    def _search_fewer_moves(self, whole: Relaxation, nodes: Stack, depth: int) -> None:
        """Go on with a search for about half as long; the deadline does not matter any more."""
        left = self._nodes // 2 + _TIE_NODES
        try:
            while left > 0 and depth > 0:
                ceiling = self._best_value - 0.5 * PER_MOVE
                before = self._nodes
                ending, depth = self._go_on(whole, nodes, depth, ceiling, left)
                left -= self._nodes - before
                if ending not in (OPEN, FOUND):
                    self.has_fewest_moves = ending == REFUTED
                    return
        except BudgetSpentError:
            return

    def _go_on(
        self, whole: Relaxation, nodes: Stack, depth: int, ceiling: float, most: int | None
    ) -> tuple[int, int]:
        """Look at some nodes; return how that ended and the new depth."""
        left = self._budget.nodes_left(self._s_per_node)
        chunk = max(1, int(_CHUNK_S / max(self._s_per_node, 1e-5)))
        if left < 1:
            raise BudgetSpentError
        # Without a limit until others are looked for, so the same however fast the machine is.
        most = max(1, self._look_around - self._nodes) if most is None else most
        count = min(chunk, left, most)
        started = time.thread_time()
        ending, depth, looked_at = search(
            self._lattice, self._teams, nodes, depth, whole.scratch, whole.memory, ceiling, count
        )
        if looked_at:
            spent = (time.thread_time() - started) / looked_at
            self._s_per_node = max(spent, 0.5 * (self._s_per_node + spent))
        self._take_chance(whole)
        self._nodes += looked_at
        self._budget.take_nodes(looked_at)
        return ending, depth

    def _take_chance(self, whole: Relaxation) -> None:
        """Keep the best of the relaxed solutions that happened to be free of conflicts."""
        if whole.memory[BEST] < self._best_value - 0.5 * PER_MOVE:
            self._prefer(self._solution(whole.scratch.best_way))

    def _look_for_others(self, whole: Relaxation, prices: Floats) -> None:
        """Every now and then find path sets by other means, or show that there are none."""
        if self._nodes < self._look_around:
            return
        self._look_around = self._nodes + _NODES_BETWEEN
        if self._negotiation is None or self._negotiation.cost is None:
            self.negotiate(whole, _FIRST_WORK, stop_at_first=True)
        else:
            self._negotiation.suggest(prices.copy(), whole.held_targets())
            hope = 1.0 / (1.0 + self._negotiation.stale / _STALE)
            self.negotiate(whole, 1 + int(_WORK_FOR_GAP * self._gap() * hope))
        if self.best is None and self._nodes >= self._explore_nodes:
            self._explore()

    def _gap(self) -> float:
        if self.best is None or self.lower_bound <= 0:
            return 0.0
        return min(1.0, (self.best.cost - self.lower_bound) / self.lower_bound)

    def negotiate(self, whole: Relaxation, work: int, *, stop_at_first: bool = False) -> None:
        """Go on with the negotiation for so much work; see `Negotiation.work`."""
        if self._negotiation is None:
            self._negotiation = Negotiation(
                self._lattice, self._teams, whole.prices, whole.assignment()
            )
        for _ in range(work):
            if self._negotiation.work(self._budget.check_time):
                self._prefer(self._solution(self._negotiation.way))
                if stop_at_first:
                    return

    def repair_once(self) -> None:
        """Plan the vehicles anew around nobody, in vain: for `warm_up`."""
        whole = self.relaxation(_SPARE_STEPS)
        nowhere = np.full((len(self._choices), _SPARE_STEPS), PARKED, dtype=np.int64)
        parked = trial(self._lattice, nowhere, whole.assignment(), np.zeros_like(whole.prices))
        repair = Repair(self._lattice, self._teams)
        repair.begin(whole.prices)
        repair.attempt(parked, self._budget.check_time)

    def _explore(self) -> None:
        verdict = explore(self._problem, self._choices, self._budget, self._explore_moves)
        self._explore_nodes *= _GROWTH
        self._explore_moves = min(self._explore_moves * _GROWTH, _MOST_EXPLORE_MOVES)
        if verdict.impossible:
            self.lower_bound, self.finished = math.inf, True
        elif verdict.solution is not None:
            self._prefer(tidied(self._problem, verdict.solution, self._budget))

    def _prefer(self, solution: Solution) -> None:
        """Keep a path set if it is cheaper than the best so far, or as cheap with fewer moves."""
        value = self._value(solution)
        if value < self._best_value:
            self.best, self._best_value = solution, value

    def _value(self, solution: Solution) -> float:
        """Return the cost with the price of moves."""
        landing = self._problem.table.landing
        moves = 0
        for start, path in zip(self._problem.starts, solution.paths, strict=True):
            cells = [start, *map(landing, path)]
            moves += sum(a != b for a, b in pairwise(cells))
        return solution.cost + PER_MOVE * moves

    def _solution(self, way: Ints) -> Solution:
        """Walk the vehicles along their ways."""
        table, lanes = self._problem.table, self._lattice.lanes
        paths, assignment = [], []
        for number, displacements in zip(self._teams.start.tolist(), way.tolist(), strict=True):
            cell = number
            path: list[int] = []
            arrival = 0
            for d in displacements:
                if d == PARKED:
                    break
                then = cell + int(self._lattice.step[d])
                path.append(table.number((divmod(cell, lanes), divmod(then, lanes))))
                if then != cell:
                    arrival = len(path)
                cell = then
            paths.append(tuple(path[:arrival]))
            assignment.append(self._problem.targets.index(table.bit(divmod(cell, lanes))))
        return Solution(tuple(assignment), tuple(paths))


def _doubled(nodes: Stack) -> Stack:
    """Return a stack with twice the room."""
    return Stack(*(np.concatenate([array, np.zeros_like(array)]) for array in nodes))
