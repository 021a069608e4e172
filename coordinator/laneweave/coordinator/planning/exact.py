"""The sweep solver: a bound by relaxation, then sweeps that close the gap.

1. Prices on the conflict rows give a lower bound (`relaxation`).
2. For the least cost that is still possible, sweeps decide whether it is (`sweep`): forwards and
   backwards by turns, with growing budgets. What one direction proves that its columns cost makes
   the budget of the other one smaller. When the budgets of both directions together exceed the
   whole, or one sweep of the whole budget ends with nothing, no solution of this cost exists, and
   the next cost is looked at.

The first cost that is possible is the least one, and the solution found has the fewest moves of all
that cost as much. A path set that is found by other means (`reachability`, `incumbent`) is the
answer when the deadline comes first, and ends the search when the bound reaches its cost.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from itertools import chain, repeat
from typing import Final

import numpy as np
from attrs import define
from scipy.optimize import linear_sum_assignment

from laneweave.coordinator.planning.arrays import UNREACHABLE, Teams, lattice, teams
from laneweave.coordinator.planning.budget import Budget, BudgetSpentError
from laneweave.coordinator.planning.conflicts import ConflictModel
from laneweave.coordinator.planning.grid import Grid
from laneweave.coordinator.planning.incumbent import Incumbent, Solution, tidied
from laneweave.coordinator.planning.problem import Problem
from laneweave.coordinator.planning.reachability import explore
from laneweave.coordinator.planning.relaxation import Penalties, Subgradient, penalties
from laneweave.coordinator.planning.request import PlanRequest, VehicleRequest
from laneweave.coordinator.planning.rows import row_patterns
from laneweave.coordinator.planning.sweep import Course, Sweep, courses, run_sweep
from laneweave.coordinator.planning.sweep_kernel import DEAD, OVER_LIMIT, PARK, SOLVED

STATES_PER_NODE: Final = 100
"""Partial solutions that count as one node of the budget."""
_TOLERANCE = 1e-6
_SPARE_STEPS = 6
"""Steps with prices beyond the longest way; more when a solution may need more."""
_QUICK = ((20, 500), (60, 5_000), (120, 20_000))
"""At first: so many iterations, then sweeps of so many partial solutions in all. They are enough
for most small formations."""
_ITERATIONS = 300
"""Of a round after these."""
_AT_A_TIME = 10
"""Iterations between two looks at the clock."""
_PUZZLE_VEHICLES, _PUZZLE_STATES = 9, 1_000_000
"""So few vehicles with so many partial solutions are a puzzle, and left to trees."""
_SHARE = 0.25
"""Part of a step by which the budget of one direction grows."""
_FIRST_STATES, _GROWTH = 20_000, 4
"""Most partial solutions of a sweep, before the other direction is tried; then more of both."""
_STATES_PER_S = 1_000_000
"""No machine in question does less; so long a sweep may be when the deadline is near."""
_EXPLORE_MOVES = 20_000
_INCUMBENT_NODES = 100
"""How long the first path set is improved; see `Incumbent.work`."""
_STEPS_GUESSED, _MOST_NUMBERS = 32, 50_000_000
"""Larger tables do not fit into memory."""
_MOST_LANES, _MOST_OCCUPANTS = 16, 1 << 60
"""So many lanes are recorded in 64 bits, so many ways to occupy a column are told apart."""


def can_sweep(problem: Problem, choices: Sequence[frozenset[int]]) -> bool:
    """Tell whether a problem can be swept: see `RowPatterns.local`; and not too many teams."""
    table = problem.table
    teams_ = len(set(choices))
    lanes, cells = table.grid.lanes, table.grid.lanes * table.grid.columns
    numbers = cells * (len(problem.targets) + 3 * teams_ * table.fan) * _STEPS_GUESSED
    fits = lanes <= _MOST_LANES and (teams_ + 2) ** lanes < _MOST_OCCUPANTS
    return fits and numbers < _MOST_NUMBERS and row_patterns(table.mode, table.model).local


@cache
def warm_up() -> None:
    """Load the compiled code; where there is none yet, compile it, which takes half a minute."""
    vehicle = VehicleRequest("v", (0, 0))
    request = PlanRequest(Grid(2, 1), 1, ("geometric",), (vehicle,), ((1, 0),))
    model = ConflictModel(request.conflicts)
    problem = Problem(request.grid, request.mode, model, [vehicle.cell], request.targets)
    Exact(problem, request, request.choices(), Budget()).run()


class Exact:
    """The state of the sweep solver; the same to its caller as `Tappa`.

    best: the cheapest path set so far.
    lower_bound: no path set costs less; infinite: there is none.
    finished: the search is complete; `best` is optimal, or nothing exists.
    """

    def __init__(
        self,
        problem: Problem,
        request: PlanRequest,
        choices: Sequence[frozenset[int]],
        budget: Budget,
    ) -> None:
        """Prepare the search."""
        self.lower_bound: float = 0
        self.finished = False
        self.tried = 0
        self.gave_up = False
        """Trees are the better tool: there is more to be told apart than a sweep can (`TOO_WIDE`),
        or the problem is a puzzle."""
        self._explore_moves = _EXPLORE_MOVES
        self._incumbent = Incumbent(problem, choices, budget)
        self._problem = problem
        self._choices = choices
        self._budget = budget
        table = problem.table
        self._lattice = lattice(table.grid, table.mode, table.model)
        starts = [vehicle.cell for vehicle in request.vehicles]
        self._teams = teams(table.grid, table.mode, starts, request.targets, choices)

    @property
    def best(self) -> Solution | None:
        """Return the cheapest path set so far."""
        return self._incumbent.best

    def run(self) -> None:
        """Search until the optimum is proven or the budget is spent."""
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
        prices = np.zeros((steps, self._lattice.row_count))
        search = Subgradient(self._lattice, self._teams, prices)
        # Few vehicles on little room are a puzzle: much is possible, and trees are better at it.
        most = _PUZZLE_STATES if len(self._choices) <= _PUZZLE_VEHICLES else None
        for iterations, patience in chain(_QUICK, repeat((_ITERATIONS, most))):
            if iterations == _ITERATIONS and self.best is None:
                self._look_for_any()
            self._improve(search, iterations)
            if search.bound >= UNREACHABLE:
                self.lower_bound, self.finished = math.inf, True
                return
            gap = penalties(self._lattice, self._teams, search.prices)
            self._close(gap, courses(self._lattice, self._teams, search.prices, gap), patience)
            if self.finished or self.gave_up:
                return
            if iterations == _ITERATIONS:
                prices = np.pad(search.prices, ((0, _SPARE_STEPS), (0, 0)))
                search = Subgradient(self._lattice, self._teams, prices)

    def _improve(self, search: Subgradient, iterations: int) -> None:
        """Improve prices, a few iterations at a time: compiled code does not look at the clock."""
        for _ in range(0, iterations, _AT_A_TIME):
            self._budget.check_time()
            search.improve(_AT_A_TIME)
            if search.bound < UNREACHABLE:
                self.lower_bound = max(self.lower_bound, math.ceil(search.bound - _TOLERANCE))

    def _longest_way(self) -> int:
        nearest = [
            min(self._teams.distance[j, start] for j in choice)
            for start, choice in zip(self._teams.start, self._choices, strict=True)
        ]
        finite = [steps for steps in nearest if steps < UNREACHABLE]
        return int(max(finite, default=0))

    def _close(self, gap: Penalties, both: list[Course], patience: int | None) -> None:
        """Look at one cost after the other, until patience ends.

        Returns when the search is finished, when it gave up, when it needs better prices, or prices
        in more steps because a solution may take as many.
        """
        hurried = patience is not None and patience < _PUZZLE_STATES
        while not self.finished:
            if self.best is not None and self.best.cost <= self.lower_bound:
                self.finished = True
                return
            budget = self.lower_bound - gap.bound
            if _may_be_late(gap, self._teams, budget):
                return
            contest = _Contest(both, budget, self._budget)
            done = contest.decide(patience)
            if done.ending == SOLVED:
                self._incumbent.offer(self._solution(done, mirrored=contest.side == 1))
            elif done.ending == DEAD:
                self.lower_bound += 1
            else:
                self.gave_up = not hurried
                return

    def _look_for_any(self) -> None:
        """Find some path set, or show that there is none; more is tried each time."""
        assignment = self._nearest_targets()
        self._incumbent.work(_INCUMBENT_NODES, [assignment])
        if self.best is not None:
            return
        verdict = explore(self._problem, self._choices, self._budget, self._explore_moves)
        self._explore_moves *= _GROWTH
        if verdict.impossible:
            self.lower_bound, self.finished = math.inf, True
        elif verdict.solution is not None:
            plain = tidied(self._problem, verdict.solution, self._budget)
            self._incumbent.begin_with(plain)
            self._incumbent.work(2 * _INCUMBENT_NODES, [plain.assignment])

    def _nearest_targets(self) -> tuple[int, ...]:
        """Return the assignment with the shortest ways, conflicts aside."""
        ways = np.where(
            self._teams.eligible[self._teams.team],
            self._teams.distance[:, self._teams.start].T,
            UNREACHABLE,
        )
        return tuple(int(target) for target in linear_sum_assignment(ways)[1])

    def _solution(self, done: Sweep, *, mirrored: bool) -> Solution:
        """Walk the vehicles through what a sweep decided."""
        ways, table = self._lattice, self._problem.table
        last = ways.columns - 1
        paths, assignment = [], []
        for start in self._teams.start.tolist():
            column, lane = divmod(start, ways.lanes)
            path: list[int] = []
            for t in range(done.decision.shape[1]):
                seen = (last - column if mirrored else column) * ways.lanes + lane
                d = int(done.decision[seen, t])
                if d == PARK:
                    break
                along = int(-ways.along[d] if mirrored else ways.along[d])
                move = (column, lane), (column + along, lane + int(ways.across[d]))
                path.append(table.number(move))
                column, lane = move[1]
            paths.append(tuple(path))
            assignment.append(self._problem.targets.index(table.bit((column, lane))))
        return Solution(tuple(assignment), tuple(paths))


def _may_be_late(gap: Penalties, vehicles: Teams, budget: float) -> bool:
    """Tell whether a cheapest solution within a budget may have moves after the priced steps.

    If all who are not there yet stood on targets of theirs then, they could as well stay, and the
    solution would be cheaper. So some vehicle is elsewhere.
    """
    last = gap.reach[:, -1].copy()
    for k, options in enumerate(vehicles.eligible):
        last[k, vehicles.target[options]] = UNREACHABLE
    return bool(last.min() <= budget + _TOLERANCE)


@define
class _Contest:
    """The question whether some solution pays no more than a budget of penalties."""

    both: list[Course]
    budget: float
    limits: Budget
    side: int = 0
    """The direction of the last sweep: 0 forwards, 1 backwards."""

    def decide(self, patience: int | None) -> Sweep:
        """Return the sweep that decides it, or one that was over the limit when patience ended.

        Args:
            patience: most partial solutions of all sweeps; None: as many as the budget allows.

        Raises:
            BudgetSpentError: before it was decided.
        """
        spent = 0
        columns = self.both[0].lattice.columns
        # What the first columns of each direction pay at least: the line after them included, or
        # left out.
        within = np.zeros((2, columns + 1))
        without = np.zeros((2, columns + 1))
        share = [min(_SHARE, self.budget)] * 2
        effort, blocked, most = [0, 0], [False, False], _FIRST_STATES
        while True:
            if all(blocked):
                most *= _GROWTH
                blocked = [False, False]
            side = 1 if blocked[0] or (effort[1] < effort[0] and not blocked[1]) else 0
            self.side = side
            later = np.maximum(0.0, without[1 - side][::-1] - (self.budget - share[side]))
            done = run_sweep(
                self.both[side],
                share[side],
                whole_budget=self.budget,
                later=later,
                limit=min(
                    most if patience is None else patience,
                    self.limits.states_left(STATES_PER_NODE, _STATES_PER_S),
                ),
            )
            if done.ending == SOLVED:
                return done
            self.limits.take_states(done.states, STATES_PER_NODE)
            effort[side] = done.states
            spent += done.states
            if done.ending == OVER_LIMIT:
                if patience is not None and spent > patience:
                    return done
                blocked[side] = True
                continue
            if done.ending != DEAD or share[side] >= self.budget - _TOLERANCE:
                return done
            at = done.column + 1
            within[side, at:] = np.maximum(within[side, at:], share[side])
            without[side, at + 1 :] = np.maximum(without[side, at + 1 :], share[side])
            together = np.maximum(
                within[0] + without[1, ::-1],
                without[0] + within[1, ::-1],
            )
            if together.max() > self.budget + _TOLERANCE:
                return done
            share[side] = min(self.budget, share[side] + _SHARE)
