"""Improvement to TAPPA: A* over the cells of all vehicles together.

Where there are few empty cells, most combinations of cheapest paths conflict, and constraint trees
grow very large; without a solution they never end. All vehicles planned together (one meta-agent,
in the terms of Sharon et al., AIJ 219, 2015, section 7) have a finite state space, which is small
in these cases. Vehicles with the same eligible targets that can drive the same moves form a team
and are interchangeable, so one search covers all assignments: its lower bound holds for every C'_k,
and its path set is optimal.

The search goes backwards from the targets. A vehicle is active in a state if it still has to move;
each active vehicle costs one per step. Backwards, a vehicle becomes active with its first move and
stays active, so its cost is the number of steps from there to the start; the heuristic uses this.

The joint moves that end in a set of occupied cells do not depend on which vehicle is where. They
are computed once for each set, as permutations of labels: (team, whether the vehicle is active).
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Sequence
from itertools import combinations, islice
from operator import itemgetter

from laneweave.coordinator.planning.budget import Budget
from laneweave.coordinator.planning.problem import Problem, Solution, bits

Cells = tuple[int, ...]
Labels = tuple[int, ...]
"""2 * team + (1 if active), for each occupied cell."""
State = tuple[Cells, Labels]

_MAX_GOALS = 2_000
_MAX_MOVES = 2_000_000
"""Limits that keep memory below about 1 GB."""
_MOVES_BETWEEN = 1000
"""Joint moves between readings of the clock."""

JointMove = tuple[Cells, Callable[[Labels], Labels], tuple[int, ...]]
"""The sorted cells before the move; a function that returns their labels, given the labels after
the move followed by the same labels with all vehicles active (for vehicles that move); and the move
of each vehicle as a set of one."""


class JointSearch:
    """The joint search; runs in portions.

    lower_bound: lower bound on the cost of all path sets; infinite: no path set exists.
    solution: the optimal path set, once found.
    ended: whether the search is complete or has reached its limits.
    """

    def __init__(self, problem: Problem, choices: Sequence[frozenset[int]], budget: Budget) -> None:
        """Prepare the search; `choices` are the eligible targets of each vehicle."""
        self.lower_bound: float = 0
        self.solution: Solution | None = None
        self.ended = False
        self._problem = problem
        self._budget = budget
        self._share_cells = problem.table.model.vehicles_share_cells
        self._credit = 0
        self._move_count = 0
        members = list(zip(choices, problem.undrivable, strict=True))
        teams = sorted(set(members), key=lambda team: (sorted(team[0]), team[1]))
        self._undrivable = [undrivable for _, undrivable in teams]
        labels = [2 * teams.index(member) + 1 for member in members]
        self._vehicles = sorted(range(len(choices)), key=lambda v: (problem.starts[v], labels[v]))
        self._start = tuple(problem.starts[v] for v in self._vehicles)
        self._start_labels = tuple(labels[v] for v in self._vehicles)
        self._distance = [
            problem.table.distances(
                sum(
                    1 << s for s, label in zip(problem.starts, labels, strict=True) if label == own
                ),
                self._undrivable[own >> 1],
            )
            for own in range(1, 2 * len(teams), 2)
        ]
        self._active: dict[Labels, int] = {}
        self._joint_moves: dict[Cells, list[JointMove]] = {}
        self._moves_into: dict[int, list[tuple[int, int, int]]] = {}
        self._cost: dict[State, int] = {}
        self._next: dict[State, tuple[State, Callable[[Labels], Labels]]] = {}
        self._open: list[tuple[int, int, State]] = []
        sizes = [labels.count(2 * k + 1) for k in range(len(teams))]
        self._add_goals([choice for choice, _ in teams], sizes)

    def work(self, moves: int) -> None:
        """Make about `moves` more joint moves; any excess is deducted from the next call."""
        self._credit += moves
        while self._credit > 0 and not self.ended:
            before = self._move_count
            self._expand()
            self._credit -= 1 + self._move_count - before

    def _add_goals(self, teams: Sequence[frozenset[int]], sizes: Sequence[int]) -> None:
        """Add a goal state for every choice of targets for the teams."""
        targets = self._problem.targets
        goals: list[dict[int, int]] = [{}]
        for k, (team, size) in enumerate(zip(teams, sizes, strict=True)):
            extended = (
                goal | dict.fromkeys(chosen, 2 * k)
                for goal in goals
                for chosen in combinations(sorted(team - goal.keys()), size)
            )
            goals = list(islice(extended, _MAX_GOALS + 1))
            if len(goals) > _MAX_GOALS:
                self.ended = True
                return
        for goal in goals:
            placed = sorted((targets[j], label) for j, label in goal.items())
            self._open_state((tuple(c for c, _ in placed), tuple(label for _, label in placed)), 0)
        if not self._open:
            self.lower_bound, self.ended = math.inf, True

    def _open_state(self, state: State, cost: int) -> bool:
        """Add a state to the open list; return whether it can be reached from the start."""
        steps = active = inactive_steps = 0
        for cell, label in zip(*state, strict=True):
            distance = self._distance[label >> 1].get(cell)
            if distance is None:
                return False
            steps = max(steps, distance)
            if label & 1:
                active += 1
            else:
                inactive_steps += distance
        self._cost[state] = cost
        heapq.heappush(self._open, (cost + active * steps + inactive_steps, -cost, state))
        return True

    def _expand(self) -> None:
        """Take the most promising state and make the joint moves that end in it."""
        if not self._open:
            self.lower_bound, self.ended = math.inf, True
            return
        bound, negative_cost, state = heapq.heappop(self._open)
        if self._cost[state] < -negative_cost:
            return
        self.lower_bound = max(self.lower_bound, bound)
        cells, labels = state
        if cells == self._start and tuple(label | 1 for label in labels) == self._start_labels:
            self.solution, self.ended = self._solution_from(state), True
            return
        both = labels + tuple(label | 1 for label in labels)
        active, known = self._active, self._cost
        moves = self._joint_moves_to(cells)
        self._move_count += len(moves)
        for number, (cells_before, labels_before, made) in enumerate(moves):
            if number % _MOVES_BETWEEN == 0:
                self._budget.check_time()
            before = labels_before(both)
            if any(self._undrivable) and not self._can_drive(before, made):
                continue
            if before not in active:
                active[before] = sum(label & 1 for label in before)
            cost = active[before] - negative_cost
            reached = cells_before, before
            if known.get(reached, math.inf) > cost and self._open_state(reached, cost):
                self._next[reached] = state, labels_before
        if self._move_count > _MAX_MOVES:
            self.ended = True

    def _can_drive(self, labels: Labels, moves: Sequence[int]) -> bool:
        """Return whether all vehicles can drive their moves."""
        undrivable = self._undrivable
        return not any(
            undrivable[label >> 1] & move for label, move in zip(labels, moves, strict=True)
        )

    def _joint_moves_to(self, cells: Cells) -> list[JointMove]:
        """Return all conflict-free joint moves that end in these cells."""
        found = self._joint_moves.get(cells)
        if found is not None:
            return found
        partial: list[tuple[Cells, Cells, int]] = [((), (), 0)]
        for cell in cells:
            self._budget.check_time()
            partial = [
                ((*starts, start), (*made, move), excluded | more)
                for starts, made, excluded in partial
                for move, start, more in self._moves_into_cell(cell)
                if not excluded & move
            ]
        found = []
        count = len(cells)
        for number, (starts, made, _) in enumerate(partial):
            if number % _MOVES_BETWEEN == 0:
                self._budget.check_time()
            origins = [
                i if start == cell else i + count
                for i, (start, cell) in enumerate(zip(starts, cells, strict=True))
            ]
            ordered = sorted(zip(starts, origins, made, strict=True))
            before, picked, moves = zip(*ordered, strict=True)
            found.append((before, _picker(picked), moves))
        self._move_count += len(found)
        self._joint_moves[cells] = found
        return found

    def _moves_into_cell(self, cell: int) -> list[tuple[int, int, int]]:
        """Return (one-bit set, start, excluded moves) for each move into a cell."""
        found = self._moves_into.get(cell)
        if found is None:
            table = self._problem.table
            found = self._moves_into[cell] = []
            for move in bits(table.leading_to(1 << cell)):
                start = move - move % table.fan
                same_start = 0 if self._share_cells else table.starting_in(1 << start)
                found.append((1 << move, start, table.conflicts[move] | same_start))
        return found

    def _solution_from(self, state: State) -> Solution:
        """Return the paths of the vehicles from the start to their targets."""
        problem, table = self._problem, self._problem.table
        count = len(self._vehicles)
        places = list(range(count))
        paths: list[list[int]] = [[] for _ in range(count)]
        arrivals = [0] * count
        cells = state[0]
        step = self._next.get(state)
        while step is not None:
            state, labels_before = step
            origin = labels_before(tuple(range(2 * count)))
            places_after = [origin[place] % count for place in places]
            for i, (place, after) in enumerate(zip(places, places_after, strict=True)):
                here, there = cells[place], state[0][after]
                paths[i].append(table.number((table.cell(here), table.cell(there))))
                if here != there:
                    arrivals[i] = len(paths[i])
            places, cells = places_after, state[0]
            step = self._next.get(state)
        by_vehicle = sorted(zip(self._vehicles, places, paths, arrivals, strict=True))
        return Solution(
            tuple(problem.targets.index(cells[place]) for _, place, _, _ in by_vehicle),
            tuple(tuple(path[:arrival]) for _, _, path, arrival in by_vehicle),
        )


def _picker(places: tuple[int, ...]) -> Callable[[Labels], Labels]:
    """Return a function that picks the labels at these places."""
    if len(places) == 1:
        return lambda labels: (labels[places[0]],)
    return itemgetter(*places)
