"""The solver for large formations: branch and bound with Lagrange multipliers.

1. Multipliers of the conflict cliques give a lower bound and reduced costs (`lagrangian_bound`).
2. For the lowest cost that is still possible, a search decides whether a solution of this cost
   exists. At each node, multipliers are improved, and moves that no such solution contains are
   forbidden by reduced cost. Then either the lower bound exceeds the cost; or the vehicles'
   cheapest paths do not conflict and are a solution; or the node is split at a clique: at most one
   of its moves is made in its step, so either all its moves by one team (or from one cell) are
   forbidden, or all its other moves (`branching_kernel`; branching on sets: Beale and Tomlin,
   Proc. 5th Int. Conf. on Operational Research, 1970).
3. If no node is left, the next cost is tried.

The first cost with a solution is the minimum. Moves have a small cost, so the search continues, for
about half as many nodes again, to find a solution that costs the same but has fewer moves.

The gap between the cost and the lower bound is small, so few moves remain, and most nodes are
fathomed quickly. Unlike in conflict trees, interchangeable vehicles do not multiply the nodes.

Every few nodes, negotiation (`negotiation`) looks for path sets, so that a plan exists if the
deadline passes first; if it fails, a search of the reachable joint states (`reachability`) looks
for a path set or proves that there is none. With few vehicles, A* over the cells of all of them
(`joint_search`) takes turns with the nodes: it is faster where few cells are empty.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from scipy.optimize import linear_sum_assignment

from laneweave.coordinator.planning.budget import Budget, BudgetSpentError
from laneweave.coordinator.planning.exact.arrays import Floats, Ints, move_arrays, teams
from laneweave.coordinator.planning.exact.branching_kernel import FULL, STUCK, search
from laneweave.coordinator.planning.exact.joint_search import JointSearch
from laneweave.coordinator.planning.exact.lagrangian_bound import Relaxation, Stack, upper_bound_of
from laneweave.coordinator.planning.exact.multipliers_kernel import (
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
from laneweave.coordinator.planning.grid import Grid
from laneweave.coordinator.planning.problem import Problem, Search, Solution
from laneweave.coordinator.planning.request import PlanRequest, VehicleRequest
from laneweave.coordinator.planning.shortest_paths import without_needless_moves

_SPARE_STEPS, _MORE_STEPS = 8, 6
"""Steps with multipliers beyond the longest path; steps added when a solution may need more."""
_FEW_VEHICLES = 11
_ITERATIONS, _FEW_ITERATIONS, _BATCH = 40, 10, 10
"""Iterations at the root with more than `_FEW_VEHICLES` vehicles and with fewer; iterations between
checks."""
_FIRST_STACK = 16
_CHUNK_S = 0.005
"""Approximate time between clock readings."""
_NODES_BETWEEN = 8
"""Nodes between attempts to find path sets by heuristics."""
_MANY_VEHICLES = 20
"""Formation size from which a path set is sought first, since the search takes long."""
_FIRST_WORK, _WORK_FOR_GAP = 200, 300
"""Maximum number of negotiation passes per call until a path set is found; afterwards, with more
than `_FEW_VEHICLES` vehicles, the number of additional passes at a gap of 100 %."""
_EXPLORE_NODES, _EXPLORE_MOVES, _MAX_EXPLORE_MOVES, _GROWTH = 16, 5_000, 1_500_000, 4
"""Nodes after which reachable states are explored if no path set is known, and the initial and
maximum limit on joint moves; nodes and limit grow by the factor `_GROWTH`."""
_TIE_NODES = 10
_FIRST_JOINT_MOVES, _JOINT_MOVES = 20_000, 200_000
"""Moves of the joint search in its first turn, and the maximum: each turn has twice as many as the
one before. There is a turn every `_NODES_BETWEEN` nodes."""
_CALL_WORK = 8
_BYTES_PER_S = 1_000_000_000
"""Approximate speed at which arrays are filled."""
_MAX_WORK = 20_000_000
"""Maximum size of the relaxed problem: moves times pairs of a team and a target times steps. Larger
grids are mostly empty, and TAPPA plans them."""
_S_PER_WORK, _MAX_SETUP_SHARE = 1.5e-8, 0.5
"""Set-up time per unit of this size, and the maximum share of the remaining time for the set-up."""
_ITERATIONS_PER_NODE = 20
"""Estimated number of iterations per node, used until the first node has been timed."""


def call_kernels() -> None:
    """Call every kernel, which loads or compiles it; see `kernels`."""
    # Two vehicles that swap cells: an instance that needs branching.
    vehicles = (VehicleRequest("a", (0, 0), lane=1), VehicleRequest("b", (0, 1), lane=0))
    request = PlanRequest(Grid(2, 2), 1, ("geometric",), vehicles, ((0, 0), (0, 1)))
    branching = Branching(request.problem(), request.choices(), Budget())
    branching.run()
    branching.negotiate(branching.relaxation(_SPARE_STEPS), _CALL_WORK)
    joint = JointSearch(request.problem(), request.choices(), Budget())
    joint.grow()
    joint.work(_CALL_WORK)


class Branching(Search):
    """Branch and bound.

    Aborts if it is stuck (`branching_kernel.STUCK`), out of memory, or the problem is too large.
    """

    def __init__(self, problem: Problem, choices: Sequence[frozenset[int]], budget: Budget) -> None:
        """Prepare the search."""
        super().__init__()
        self._negotiation: Negotiation | None = None
        self._joint: JointSearch | None = None
        self._joint_moves = _FIRST_JOINT_MOVES
        self._problem = problem
        self._choices = choices
        self._budget = budget
        self._nodes = 0
        self._next_check = _NODES_BETWEEN
        self._explore_nodes, self._explore_moves = _EXPLORE_NODES, _EXPLORE_MOVES
        self._s_per_node = 0.0
        self._s_per_iteration = 1.0
        self._stuck_at: int | None = None
        self._best_value = UNREACHABLE
        table = problem.table
        pairs = sum(len(choice) for choice, _ in set(zip(choices, problem.excluded, strict=True)))
        if 8 * pairs * table.grid.columns * table.grid.lanes > budget.max_bytes:
            self.aborted = True
            return
        self._arrays = move_arrays(table.grid, table.mode, table.model)
        starts = [table.cell(start) for start in problem.starts]
        targets = [table.cell(target) for target in problem.targets]
        self._teams = teams(self._arrays, starts, targets, choices, problem.excluded)

    def run(self) -> None:
        """Search until the optimum is proven or the budget is spent."""
        if self.aborted:
            return
        try:
            self._search()
        except BudgetSpentError:
            if self._joint is not None:
                self.lower_bound = max(self.lower_bound, self._joint.lower_bound)
            if self.best is not None:
                self.lower_bound = min(self.lower_bound, self.best.cost)

    def _search(self) -> None:
        if len(self._teams.target) < len(self._teams.start) or not all(self._choices):
            self.lower_bound, self.finished = math.inf, True
            return
        steps = self._longest_path() + _SPARE_STEPS
        if self._problem.max_steps is not None:
            steps = min(steps, self._problem.max_steps + 1)
        if self._is_too_large(steps) or not self._fits(steps, _FIRST_STACK):
            self.aborted = True
            return
        root = self.relaxation(steps)
        for number in range(0, _FEW_ITERATIONS if self._few else _ITERATIONS, _BATCH):
            self._improve(root, _BATCH)
            if math.isinf(self.lower_bound) or self._is_proven():
                break
            if number == _BATCH and len(self._choices) >= _MANY_VEHICLES:
                self.negotiate(root, _FIRST_WORK, stop_at_first=True)
        self._s_per_node = _ITERATIONS_PER_NODE * self._s_per_iteration
        nodes = root.stack(_FIRST_STACK)
        while not self.finished and not self.aborted:
            if math.isinf(self.lower_bound) or self.lower_bound > self._problem.max_cost:
                self.lower_bound, self.finished = math.inf, True
            elif self._is_proven():
                nodes = self._break_ties(root, nodes)
                self.finished = True
            else:
                nodes = self._decide(root, nodes, int(self.lower_bound))

    @property
    def _few(self) -> bool:
        return len(self._choices) <= _FEW_VEHICLES

    def _is_proven(self) -> bool:
        return self.best is not None and self.best.cost <= self.lower_bound

    def _improve(self, root: Relaxation, iterations: int) -> None:
        """Improve the root's multipliers; check the clock every few iterations."""
        while iterations > 0:
            count = max(1, min(iterations, int(_CHUNK_S / max(self._s_per_iteration, 1e-6))))
            started = time.thread_time()
            root.improve(count)
            self._s_per_iteration = (time.thread_time() - started) / count
            iterations -= count
            self._budget.check_time()
        self._keep_relaxed_solution(root)
        self.lower_bound = max(self.lower_bound, root.min_cost)

    def _is_too_large(self, steps: int) -> bool:
        """Return whether the relaxed problem exceeds `_MAX_WORK`, or its set-up takes too long."""
        work = steps * self._arrays.valid.size * len(self._teams.pair_cell)
        return work > _MAX_WORK or _S_PER_WORK * work > _MAX_SETUP_SHARE * self._budget.left_s

    def _fits(self, steps: int, nodes: int) -> bool:
        """Return whether the arrays for a number of steps and nodes fit within the memory limit.

        Raises:
            BudgetSpentError: they fit, but there is no time left to fill them.
        """
        displacements, cells = self._arrays.valid.shape
        groups, cliques = len(self._teams.pair), self._arrays.clique_count
        moves, masses = groups * displacements * cells, groups + self._arrays.residue_count
        size = 8 * cells * len(self._teams.pair_cell) + 33 * moves + 8 * cliques * (masses + 3)
        size = int(steps * (size + nodes * (moves + 8 * cliques)))
        if size >= self._budget.max_bytes:
            return False
        self._budget.check_time(size / _BYTES_PER_S)
        return True

    def relaxation(self, steps: int) -> Relaxation:
        """Return the relaxed problem with multipliers of 0."""
        return Relaxation(self._arrays, self._teams, steps, self._problem.max_steps)

    def _longest_path(self) -> int:
        """Return the length of the longest path when targets are assigned at minimum cost."""
        pairs = self._teams.pair[self._teams.team]
        distances = np.where(
            pairs >= 0, self._teams.distance[self._teams.start[:, None], pairs], UNREACHABLE
        )
        steps = distances[linear_sum_assignment(distances)]
        return int(max(steps[steps < UNREACHABLE], default=0))

    def _decide(self, root: Relaxation, nodes: Stack, cost: int) -> Stack:
        """Find a solution of this cost, prove that none exists, or add steps with multipliers."""
        self._budget.check_time()
        upper_bound = upper_bound_of(cost)
        may_exist = root.put(nodes, upper_bound)
        if may_exist is None:
            return self._with_more_steps(root, nodes)
        depth, outcome = 1, OPEN if may_exist else REFUTED
        first = True
        while outcome in (OPEN, FULL):
            if outcome == FULL:
                if not self._fits(len(root.multipliers), 2 * len(nodes.step_size)):
                    break
                nodes = _doubled(nodes)
            outcome, depth = self._search_nodes(
                root, nodes, depth, upper_bound, 1 if first else None
            )
            if first and depth > 1:
                root.multipliers = nodes.multipliers[0].copy()
            first = False
            if outcome == OPEN:
                self._run_heuristics(root, nodes.multipliers[depth - 1])
                if self.finished or self.lower_bound > cost or self._is_proven():
                    return nodes
        if outcome == REFUTED:
            self.lower_bound = cost + 1
        elif outcome == FOUND:
            self._search_fewer_moves(root, nodes, depth)
            self.finished = True
        elif outcome == STUCK and self._stuck_at != cost:
            # A vehicle may have to cross a target of its team after the last step with multipliers.
            self._stuck_at = cost
            return self._with_more_steps(root, nodes)
        else:
            self.aborted = True
        return nodes

    def _with_more_steps(self, root: Relaxation, nodes: Stack) -> Stack:
        """Add steps with multipliers; return an empty stack."""
        more = max(_MORE_STEPS, len(root.multipliers) // 2)
        if not self._fits(len(root.multipliers) + more, len(nodes.step_size)):
            self.aborted = True
            return nodes
        root.lengthen(more)
        return root.stack(len(nodes.step_size))

    def _break_ties(self, root: Relaxation, nodes: Stack) -> Stack:
        """Search for a solution that costs the same as the best one but has fewer moves."""
        upper_bound = self._best_value - 0.5 * PER_MOVE
        may_exist = root.put(nodes, upper_bound)
        if may_exist:
            root.state[BEST] = self._best_value
            self._search_fewer_moves(root, nodes, 1)
        self.has_fewest_moves = self.has_fewest_moves or may_exist is False
        return nodes

    def _search_fewer_moves(self, root: Relaxation, nodes: Stack, depth: int) -> None:
        """Continue a search for about half as many nodes again, or until the deadline."""
        left = self._nodes // 2 + _TIE_NODES
        try:
            while left > 0 and depth > 0:
                upper_bound = self._best_value - 0.5 * PER_MOVE
                before = self._nodes
                outcome, depth = self._search_nodes(root, nodes, depth, upper_bound, left)
                left -= self._nodes - before
                if outcome not in (OPEN, FOUND):
                    self.has_fewest_moves = outcome == REFUTED
                    return
        except BudgetSpentError:
            return

    def _search_nodes(
        self, root: Relaxation, nodes: Stack, depth: int, upper_bound: float, max_nodes: int | None
    ) -> tuple[int, int]:
        """Examine some nodes; return the outcome and the new depth."""
        left = self._budget.nodes_left(self._s_per_node)
        chunk = max(1, int(_CHUNK_S / max(self._s_per_node, 1e-5)))
        if left < 1:
            raise BudgetSpentError
        # By default, stop at the next check, which does not depend on the machine's speed.
        if max_nodes is None:
            max_nodes = max(1, self._next_check - self._nodes)
        count = min(chunk, left, max_nodes)
        started = time.thread_time()
        outcome, depth, examined = search(
            self._arrays, self._teams, nodes, depth, root.scratch, root.state, upper_bound, count
        )
        if examined:
            spent = (time.thread_time() - started) / examined
            self._s_per_node = max(spent, 0.5 * (self._s_per_node + spent))
        self._keep_relaxed_solution(root)
        self._nodes += examined
        self._budget.take_nodes(examined)
        return outcome, depth

    def _keep_relaxed_solution(self, root: Relaxation) -> None:
        """Keep the best conflict-free relaxed solution if it is better than the best so far."""
        if root.state[BEST] < self._best_value - 0.5 * PER_MOVE:
            self._keep_if_better(self._solution(root.scratch.best_path))

    def _run_heuristics(self, root: Relaxation, multipliers: Floats) -> None:
        """Every few nodes, look for path sets by negotiation and joint search."""
        if self._nodes < self._next_check:
            return
        self._next_check = self._nodes + _NODES_BETWEEN
        if self._few:
            self._search_jointly()
            if self.finished or self._is_proven():
                return
        if self._negotiation is None or self._negotiation.cost is None:
            self.negotiate(root, _FIRST_WORK, stop_at_first=True)
        else:
            self._negotiation.suggest(multipliers.copy(), root.held_targets())
            self.negotiate(root, 1 if self._few else 1 + int(_WORK_FOR_GAP * self._gap()))
        if self.best is None and self._nodes >= self._explore_nodes:
            self._explore()

    def _gap(self) -> float:
        if self.best is None or self.lower_bound <= 0:
            return 0.0
        return min(1.0, (self.best.cost - self.lower_bound) / self.lower_bound)

    def negotiate(self, root: Relaxation, work: int, *, stop_at_first: bool = False) -> None:
        """Continue the negotiation for `work` passes."""
        if self._negotiation is None:
            self._negotiation = Negotiation(
                self._arrays, self._teams, root.multipliers, root.assignment()
            )
        for _ in range(work):
            if self._negotiation.work(self._budget.check_time):
                self._keep_if_better(self._solution(self._negotiation.path))
                if stop_at_first:
                    return

    def _search_jointly(self) -> None:
        """Continue the joint search, and keep what it has found."""
        if self._joint is None:
            self._joint = JointSearch(self._problem, self._choices, self._budget)
        if self._joint.ended:
            return
        self._joint.work(self._joint_moves, math.inf if self.best is None else self.best.cost)
        self._joint_moves = min(2 * self._joint_moves, _JOINT_MOVES)
        self.lower_bound = max(self.lower_bound, self._joint.lower_bound)
        if math.isinf(self.lower_bound):
            self.finished = True
        elif self._joint.solution is not None:
            self._keep_if_better(
                without_needless_moves(self._problem, self._joint.solution, self._budget)
            )

    def _explore(self) -> None:
        reached = explore(self._problem, self._choices, self._budget, self._explore_moves)
        self._explore_nodes *= _GROWTH
        self._explore_moves = min(self._explore_moves * _GROWTH, _MAX_EXPLORE_MOVES)
        if reached.infeasible:
            self.lower_bound, self.finished = math.inf, True
        elif reached.solution is not None:
            self._explore_nodes = sys.maxsize  # it would find the same path set again
            self._keep_if_better(
                without_needless_moves(self._problem, reached.solution, self._budget)
            )

    def _keep_if_better(self, solution: Solution) -> None:
        """Keep a path set that is cheaper than the best so far, or as cheap with fewer moves.

        Path sets with too many steps are rejected: negotiation and `explore` do not limit them.
        """
        value = self._value(solution)
        if value < self._best_value and not self._problem.is_too_long(solution):
            self.best, self._best_value = solution, value

    def _value(self, solution: Solution) -> float:
        """Return the cost plus `PER_MOVE` for each move."""
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
                next_cell = cell + int(self._arrays.step[d])
                moves.append(table.number((divmod(cell, lanes), divmod(next_cell, lanes))))
                if next_cell != cell:
                    arrival = len(moves)
                cell = next_cell
            moves_of.append(tuple(moves[:arrival]))
            assignment.append(self._problem.targets.index(table.bit(divmod(cell, lanes))))
        return Solution(tuple(assignment), tuple(moves_of))


def _doubled(nodes: Stack) -> Stack:
    """Return a stack of twice the size."""
    return Stack(*(np.concatenate([array, np.zeros_like(array)]) for array in nodes))


def new_search(
    request: PlanRequest,
    problem: Problem,
    weights: object,  # noqa: ARG001 (of TAPPA)
    budget: Budget,
) -> Search:
    """Return the search of branch and bound for a request."""
    return Branching(problem, request.choices(), budget)
