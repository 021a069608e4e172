"""The solver for large formations: branch and bound with Lagrange multipliers.

1. Multipliers of the conflict cliques give a lower bound and reduced costs (`relaxation`).
2. For the lowest cost that is still possible a search decides whether there is a solution of this
   cost. In each of its nodes multipliers are improved, and moves that no such solution contains are
   forbidden by their reduced cost. Then either the lower bound exceeds the cost; or the vehicles on
   their cheapest paths are not in conflict, which is a solution; or the node is split at a clique:
   at most one of its moves is made in its step, so either all moves of a team (or from a cell) are
   forbidden in this clique, or all others (`branching_kernel`; this kind of branching is by Beale
   and Tomlin, Proc. 5th Int. Conf. on Operational Research, 1970).
3. If no node is left, the next cost is tried.

The first cost with a solution is the minimum. A small cost of moves lets the search continue for a
solution of the same cost with fewer moves, for about half as long as it took until then.

The gap between the cost and the lower bound is small; so few moves remain, and most nodes are
decided soon. Unlike in trees of conflicts between single vehicles, the number of vehicles in a team
that could replace one another does not matter.

Between the nodes path sets are made by negotiation (`negotiation`), so that there is an answer if
the deadline comes first; if that fails, by a joint search (`reachability`), which can also prove
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
from laneweave.coordinator.planning.exact.arrays import Floats, Ints, move_arrays, teams
from laneweave.coordinator.planning.exact.branching_kernel import FULL, STUCK, search
from laneweave.coordinator.planning.exact.lagrangian_bound import Relaxation, Stack, upper_bound_of
from laneweave.coordinator.planning.exact.lagrangian_kernel import (
    BEST,
    FOUND,
    OPEN,
    PARKED,
    PER_MOVE,
    REFUTED,
    UNREACHABLE,
)
from laneweave.coordinator.planning.exact.negotiation import Negotiation
from laneweave.coordinator.planning.exact.reachability import explore
from laneweave.coordinator.planning.problem import Grid, Problem, Search, Solution
from laneweave.coordinator.planning.request import PlanRequest, VehicleRequest
from laneweave.coordinator.planning.shortest_paths import without_needless_moves

_SPARE_STEPS, _MORE_STEPS = 8, 6
"""Steps with multipliers beyond the longest path; more when a solution may need more."""
_ITERATIONS, _FEW_ITERATIONS, _BATCH = 40, 10, 10
"""Iterations for the first multipliers with many or few vehicles; iterations between two checks."""
_FEW_VEHICLES = 11
_FIRST_STACK = 16
_CHUNK_S = 0.005
"""Approximate time between two readings of the clock."""
_NODES_BETWEEN = 8
"""Nodes between two attempts to find path sets by other means."""
_MANY_VEHICLES = 20
"""Formations from this size on take long to decide, so they get a path set first."""
_FIRST_WORK, _WORK_FOR_GAP, _STALE = 200, 100, 100
"""Passes of negotiation until there is a path set; later, passes for a gap of 100 %, and the number
of passes without improvement that halves them."""
_EXPLORE_NODES, _EXPLORE_MOVES, _MAX_EXPLORE_MOVES, _GROWTH = 16, 5_000, 1_500_000, 4
"""Nodes before the joint search is tried, if there is no path set yet, and its limit of joint
moves; both grow by `_GROWTH`."""
_TIE_NODES = 10
_WARM_UP_WORK = 8
_BYTES_PER_S = 1_000_000_000
"""Approximate speed at which arrays are filled."""


@cache
def warm_up() -> None:
    """Load the compiled code; compile it if there is no cache yet, which takes half a minute."""
    # Two vehicles that change places: an instance that needs branching.
    vehicles = (VehicleRequest("a", (0, 0), lane=1), VehicleRequest("b", (0, 1), lane=0))
    request = PlanRequest(Grid(2, 2), 1, ("geometric",), vehicles, ((0, 0), (0, 1)))
    branching = Branching(request.problem(), request.choices(), Budget())
    branching.run()
    branching.negotiate(branching.relaxation(_SPARE_STEPS), _WARM_UP_WORK)


class Branching(Search):
    """The state of the search; `gave_up`: stuck (`branching_kernel.STUCK`), or out of memory."""

    def __init__(self, problem: Problem, choices: Sequence[frozenset[int]], budget: Budget) -> None:
        """Prepare the search."""
        super().__init__()
        self._negotiation: Negotiation | None = None
        self._problem = problem
        self._choices = choices
        self._budget = budget
        self._nodes = 0
        self._next_look = _NODES_BETWEEN
        self._explore_nodes, self._explore_moves = _EXPLORE_NODES, _EXPLORE_MOVES
        self._s_per_node = 0.0
        self._s_per_iteration = 1.0
        self._stuck_at: int | None = None
        self._best_value = UNREACHABLE
        table = problem.table
        pairs = sum(map(len, set(choices)))
        if 8 * pairs * table.grid.columns * table.grid.lanes > budget.max_bytes:
            self.gave_up = True
            return
        self._arrays = move_arrays(table.grid, table.mode, table.model)
        starts = [table.cell(start) for start in problem.starts]
        targets = [table.cell(target) for target in problem.targets]
        self._teams = teams(self._arrays, starts, targets, choices)

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
        steps = self._longest_path() + _SPARE_STEPS
        if not self._fits(steps, _FIRST_STACK):
            self.gave_up = True
            return
        whole = self.relaxation(steps)
        few = len(self._choices) <= _FEW_VEHICLES
        for number in range(0, _FEW_ITERATIONS if few else _ITERATIONS, _BATCH):
            self._improve(whole, _BATCH)
            if math.isinf(self.lower_bound) or self._is_proven():
                break
            if number == _BATCH and len(self._choices) >= _MANY_VEHICLES:
                self.negotiate(whole, _FIRST_WORK, stop_at_first=True)
        nodes = whole.stack(_FIRST_STACK)
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
        """Improve the first multipliers; check the clock every few iterations."""
        while iterations > 0:
            count = max(1, min(iterations, int(_CHUNK_S / max(self._s_per_iteration, 1e-6))))
            started = time.thread_time()
            whole.improve(count)
            self._s_per_iteration = (time.thread_time() - started) / count
            iterations -= count
            self._budget.check_time()
        self._keep_relaxed_solution(whole)
        self.lower_bound = max(self.lower_bound, whole.min_cost)

    def _fits(self, steps: int, nodes: int) -> bool:
        """Return whether arrays of so many steps and nodes fit into the memory limit.

        Raises:
            BudgetSpentError: they do, but there is no time left to fill them.
        """
        displacements, cells = self._arrays.valid.shape
        groups, rows = len(self._teams.pair), self._arrays.clique_count
        moves, masses = groups * displacements * cells, groups + self._arrays.residue_count
        size = 8 * cells * len(self._teams.pair_cell) + 33 * moves + 8 * rows * (masses + 3)
        size = int(steps * (size + nodes * (moves + 8 * rows)))
        if size >= self._budget.max_bytes:
            return False
        self._budget.check_time(size / _BYTES_PER_S)
        return True

    def relaxation(self, steps: int) -> Relaxation:
        """Return the relaxed problem with multipliers of 0."""
        return Relaxation(self._arrays, self._teams, steps)

    def _longest_path(self) -> int:
        """Return the steps of the longest path when targets are assigned at minimum cost."""
        pairs = self._teams.pair[self._teams.team]
        distances = np.where(
            pairs >= 0, self._teams.distance[self._teams.start[:, None], pairs], UNREACHABLE
        )
        steps = distances[linear_sum_assignment(distances)]
        return int(max(steps[steps < UNREACHABLE], default=0))

    def _decide(self, whole: Relaxation, nodes: Stack, cost: int) -> Stack:
        """Find a solution of a cost, prove that there is none, or add steps with multipliers."""
        self._budget.check_time()
        upper_bound = upper_bound_of(cost)
        may_be = whole.put(nodes, upper_bound)
        if may_be is None:
            return self._with_more_steps(whole, nodes)
        depth, ending = 1, OPEN if may_be else REFUTED
        first = True
        while ending in (OPEN, FULL):
            if ending == FULL:
                if not self._fits(len(whole.multipliers), 2 * len(nodes.step_size)):
                    break
                nodes = _doubled(nodes)
            ending, depth = self._search_nodes(
                whole, nodes, depth, upper_bound, 1 if first else None
            )
            if first and depth > 1:
                whole.set_multipliers(nodes.multipliers[0])
            first = False
            if ending == OPEN:
                self._search_otherwise(whole, nodes.multipliers[depth - 1])
                if self.finished or (self.best is not None and self.best.cost <= cost):
                    return nodes
        if ending == REFUTED:
            self.lower_bound = cost + 1
        elif ending == FOUND:
            self._search_fewer_moves(whole, nodes, depth)
            self.finished = True
        elif ending == STUCK and self._stuck_at != cost:
            # A vehicle may have to cross a target of its team after the last step with multipliers.
            self._stuck_at = cost
            return self._with_more_steps(whole, nodes)
        else:
            self.gave_up = True
        return nodes

    def _with_more_steps(self, whole: Relaxation, nodes: Stack) -> Stack:
        """Add steps with multipliers; return an empty stack."""
        more = max(_MORE_STEPS, len(whole.multipliers) // 2)
        if not self._fits(len(whole.multipliers) + more, len(nodes.step_size)):
            self.gave_up = True
            return nodes
        whole.lengthen(more)
        return whole.stack(len(nodes.step_size))

    def _break_ties(self, whole: Relaxation, nodes: Stack) -> Stack:
        """Search for a solution of the same cost as the best one with fewer moves."""
        upper_bound = self._best_value - 0.5 * PER_MOVE
        may_be = whole.put(nodes, upper_bound)
        if may_be:
            whole.state[BEST] = self._best_value
            self._search_fewer_moves(whole, nodes, 1)
        self.has_fewest_moves = self.has_fewest_moves or may_be is False
        return nodes

    def _search_fewer_moves(self, whole: Relaxation, nodes: Stack, depth: int) -> None:
        """Continue a search for about half as many nodes; ends quietly at the deadline."""
        left = self._nodes // 2 + _TIE_NODES
        try:
            while left > 0 and depth > 0:
                upper_bound = self._best_value - 0.5 * PER_MOVE
                before = self._nodes
                ending, depth = self._search_nodes(whole, nodes, depth, upper_bound, left)
                left -= self._nodes - before
                if ending not in (OPEN, FOUND):
                    self.has_fewest_moves = ending == REFUTED
                    return
        except BudgetSpentError:
            return

    def _search_nodes(
        self, whole: Relaxation, nodes: Stack, depth: int, upper_bound: float, max_nodes: int | None
    ) -> tuple[int, int]:
        """Examine some nodes; return the outcome and the new depth."""
        left = self._budget.nodes_left(self._s_per_node)
        chunk = max(1, int(_CHUNK_S / max(self._s_per_node, 1e-5)))
        if left < 1:
            raise BudgetSpentError
        # By default up to the next look, which does not depend on the speed of the machine.
        if max_nodes is None:
            max_nodes = max(1, self._next_look - self._nodes)
        count = min(chunk, left, max_nodes)
        started = time.thread_time()
        ending, depth, examined = search(
            self._arrays, self._teams, nodes, depth, whole.scratch, whole.state, upper_bound, count
        )
        if examined:
            spent = (time.thread_time() - started) / examined
            self._s_per_node = max(spent, 0.5 * (self._s_per_node + spent))
        self._keep_relaxed_solution(whole)
        self._nodes += examined
        self._budget.take_nodes(examined)
        return ending, depth

    def _keep_relaxed_solution(self, whole: Relaxation) -> None:
        """Keep the best relaxed solution without conflicts, if there is one."""
        if whole.state[BEST] < self._best_value - 0.5 * PER_MOVE:
            self._prefer(self._solution(whole.scratch.best_path))

    def _search_otherwise(self, whole: Relaxation, multipliers: Floats) -> None:
        """Every few nodes, look for path sets by negotiation and joint search."""
        if self._nodes < self._next_look:
            return
        self._next_look = self._nodes + _NODES_BETWEEN
        if self._negotiation is None or self._negotiation.cost is None:
            self.negotiate(whole, _FIRST_WORK, stop_at_first=True)
        else:
            self._negotiation.suggest(multipliers.copy(), whole.held_targets())
            hope = 1.0 / (1.0 + self._negotiation.stale / _STALE)
            self.negotiate(whole, 1 + int(_WORK_FOR_GAP * self._gap() * hope))
        if self.best is None and self._nodes >= self._explore_nodes:
            self._explore()

    def _gap(self) -> float:
        if self.best is None or self.lower_bound <= 0:
            return 0.0
        return min(1.0, (self.best.cost - self.lower_bound) / self.lower_bound)

    def negotiate(self, whole: Relaxation, work: int, *, stop_at_first: bool = False) -> None:
        """Continue the negotiation for so many passes; see `Negotiation.work`."""
        if self._negotiation is None:
            self._negotiation = Negotiation(
                self._arrays, self._teams, whole.multipliers, whole.assignment()
            )
        for _ in range(work):
            if self._negotiation.work(self._budget.check_time):
                self._prefer(self._solution(self._negotiation.path))
                if stop_at_first:
                    return

    def _explore(self) -> None:
        verdict = explore(self._problem, self._choices, self._budget, self._explore_moves)
        self._explore_nodes *= _GROWTH
        self._explore_moves = min(self._explore_moves * _GROWTH, _MAX_EXPLORE_MOVES)
        if verdict.impossible:
            self.lower_bound, self.finished = math.inf, True
        elif verdict.solution is not None:
            self._prefer(without_needless_moves(self._problem, verdict.solution, self._budget))

    def _prefer(self, solution: Solution) -> None:
        """Keep a path set if it is cheaper than the best so far, or equal with fewer moves."""
        value = self._value(solution)
        if value < self._best_value:
            self.best, self._best_value = solution, value

    def _value(self, solution: Solution) -> float:
        """Return the cost including `PER_MOVE`."""
        landing = self._problem.table.landing
        moves = 0
        for start, path in zip(self._problem.starts, solution.paths, strict=True):
            cells = [start, *map(landing, path)]
            moves += sum(a != b for a, b in pairwise(cells))
        return solution.cost + PER_MOVE * moves

    def _solution(self, paths: Ints) -> Solution:
        """Return paths (N, T) of displacements as a solution."""
        table, lanes = self._problem.table, self._arrays.lanes
        moves_of, assignment = [], []
        for start, path in zip(self._teams.start.tolist(), paths.tolist(), strict=True):
            cell = start
            moves: list[int] = []
            arrival = 0
            for d in path:
                if d == PARKED:
                    break
                then = cell + int(self._arrays.step[d])
                moves.append(table.number((divmod(cell, lanes), divmod(then, lanes))))
                if then != cell:
                    arrival = len(moves)
                cell = then
            moves_of.append(tuple(moves[:arrival]))
            assignment.append(self._problem.targets.index(table.bit(divmod(cell, lanes))))
        return Solution(tuple(assignment), tuple(moves_of))


def _doubled(nodes: Stack) -> Stack:
    """Return a stack of twice the size."""
    return Stack(*(np.concatenate([array, np.zeros_like(array)]) for array in nodes))
