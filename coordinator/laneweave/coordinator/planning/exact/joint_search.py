"""A* over the cells of all vehicles together.

All vehicles planned together (one meta-agent, in the terms of Sharon et al., AIJ 219, 2015, section
7) have a finite state space. It is small where there are few vehicles, or few empty cells; there,
most combinations of cheapest paths conflict, and other searches take long, or never end if there is
no path set. Vehicles with the same eligible targets that can drive the same moves form a team and
are interchangeable, so one search covers all assignments: its lower bound holds for each of them,
and its path set is optimal.

The search goes backwards from the targets. A vehicle is active in a state if it still has to move;
each active vehicle costs one per step. Backwards, a vehicle becomes active with its first move and
stays active, so its cost is the number of steps from there to the start. A lower bound on what is
left: all active vehicles need as many steps as the furthest of all, the others at least their own.

Expansion is partial (Yoshizumi, Miura and Ishida, AAAI 2000; Goldenberg et al., JAIR 50, 2014):
with F, the cost and the lower bound together, only the states before one with the same F are
opened; they are found by choosing the vehicles' moves one after another, which ends as soon as the
lower bound of the vehicles so far exceeds F. A state remains open with its next F, at which few are
ever expanded.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from laneweave.coordinator.planning.budget import Budget
from laneweave.coordinator.planning.conflict_kinds import ConflictModel, conflict_offsets
from laneweave.coordinator.planning.exact.arrays import Bools, Ints, valid_moves
from laneweave.coordinator.planning.exact.joint_kernel import (
    BOUND,
    CURRENT,
    CUT,
    EMPTY,
    FOUND,
    FULL,
    HEAD,
    MAX_COST,
    OPEN,
    STATES,
    add_goals,
    fill_slots,
    search,
)
from laneweave.coordinator.planning.problem import MoveTable, Problem, Solution
from laneweave.protocol.lattice import Mode

_MAX_GOALS = 20_000
"""Maximum number of choices of targets."""
_FIRST_STATES = 1 << 12
_MAX_BYTES, _SHARE = 200_000_000, 0.25
"""Upper bounds on the memory of the states: in bytes, and as a share of the limit of a search."""
_MAX_MOVES = 20_000_000
"""Maximum number of tried moves: about half a second with six vehicles."""
_BYTES_PER_S = 500_000_000
"""Approximate speed at which arrays grow."""
_MOVES_BETWEEN = 50_000
"""Tried moves between readings of the clock: 1 to 3 ms."""


class JointMoves(NamedTuple):
    """Moves, conflicts and teams. Shapes: D displacements, X cells, K teams, N vehicles."""

    lanes: int
    base: int
    """Twice the number of teams."""
    step: Ints
    """(D,) change in the cell number."""
    from_cell: Ints
    """(D, X) cell from which a move ends in a cell; -1: none."""
    drives: Bools
    """(K, D) whether the vehicles of a team can make a move."""
    reach: Ints
    """(2,) maximum distance in columns and in lanes of moves that conflict."""
    conflicts: Bools
    """(D, C, L, D) whether the move of a vehicle conflicts with that of another one, by their
    displacements and the distance of their from-cells plus `reach`."""
    start: Ints
    """(N,) codes of the start, sorted, with all vehicles active."""
    steps: Ints
    """(K, X) least number of steps from a team's nearest start to a cell; -1: no path."""


class Store(NamedTuple):
    """Arrays of states, which grow. Shapes: S states, N vehicles."""

    codes: Ints
    """(S, N) cells and labels, sorted (`joint_kernel`)."""
    cost: Ints
    """(S,) cost from there to the targets."""
    after: Ints
    """(S,) the state that follows; -1: none."""
    made: Ints
    """(S, N) displacements on the way to the state that follows, in its order."""
    heap: Ints
    """Binary heap of the keys of open states."""
    slot: Ints
    """Hash table: the state in each slot; -1: free."""

    @classmethod
    def of(cls, states: int, vehicles: int) -> Store:
        """Return empty arrays for a number of states, a power of two."""
        return cls(
            np.zeros((states, vehicles), np.int32),
            np.zeros(states, np.int32),
            np.zeros(states, np.int32),
            np.zeros((states, vehicles), np.int8),
            np.zeros(2 * states, np.int64),
            np.full(4 * states, -1, np.int32),
        )

    @staticmethod
    def size_of(states: int, vehicles: int) -> int:
        """Return the memory of the arrays [bytes]."""
        return states * (5 * vehicles + 40)


class Progress(NamedTuple):
    """Where the search is: an expansion may be continued later. Shapes: N vehicles."""

    head: Ints
    """Numbers by the indices of `joint_kernel`."""
    choice: Ints
    """(N,) displacement that is tried for each vehicle."""
    column: Ints
    lane: Ints
    code: Ints
    """(N,) cell and code of each vehicle before its move."""
    ordered: Ints
    """(N,) scratch memory for sorted codes."""
    active: Ints
    longest: Ints
    rest: Ints
    """(N + 1,) number of active vehicles, most steps, and steps of inactive vehicles, at least, of
    vehicle i and those after it."""
    active_to: Ints
    longest_to: Ints
    rest_to: Ints
    """(N + 1,) the same for the chosen moves of the vehicles before vehicle i."""

    @classmethod
    def of(cls, vehicles: int) -> Progress:
        """Return the beginning."""
        head = np.zeros(HEAD, np.int64)
        head[CURRENT] = -1
        sizes = 5 * (vehicles,) + 6 * (vehicles + 1,)
        return cls(head, *(np.zeros(size, np.int64) for size in sizes))


class JointSearch:
    """The search; works in portions.

    lower_bound: lower bound on the cost of all path sets; infinite: no path set exists.
    solution: the optimal path set, once it is found; None if it has too many steps, which the
        search does not count.
    ended: whether the search is complete or has reached its limits.
    """

    def __init__(self, problem: Problem, choices: Sequence[frozenset[int]], budget: Budget) -> None:
        """Prepare the search; `choices` are the eligible targets of each vehicle."""
        self.lower_bound: float = 0
        self.solution: Solution | None = None
        self.ended = False
        self._problem, self._budget = problem, budget
        self._max_bytes = min(_MAX_BYTES, _SHARE * budget.max_bytes)
        self._moves_left = _MAX_MOVES
        members = list(zip(choices, problem.excluded, strict=True))
        teams = list(dict.fromkeys(members))
        team = [teams.index(member) for member in members]
        goals = math.prod(
            math.comb(len(choice), team.count(number)) for number, (choice, _) in enumerate(teams)
        )
        states = max(_FIRST_STATES, 1 << (2 * goals).bit_length())
        if goals > _MAX_GOALS or Store.size_of(states, len(team)) > self._max_bytes:
            self.ended = True
            return
        starts = self._numbers(problem.starts)
        self._moves = _joint_moves(problem.table, [excluded for _, excluded in teams], team, starts)
        self._vehicles = sorted(range(len(team)), key=lambda v: (starts[v], team[v]))
        self._progress = Progress.of(len(team))
        self._store = Store.of(states, len(team))
        targets = self._numbers(problem.targets)
        eligible = np.full((len(teams), 1 + max(len(choice) for choice, _ in teams)), -1)
        for number, (choice, _) in enumerate(teams):
            eligible[number, : len(choice)] = sorted(targets[j] for j in choice)
        add_goals(self._moves, self._store, self._progress, np.array(sorted(team)), eligible)
        if not self._progress.head[OPEN]:
            self._end(math.inf)

    def work(self, moves: int, below: float = math.inf) -> None:
        """Try about `moves` more moves of vehicles.

        Args:
            moves: how much to do; with six vehicles a move takes some 25 ns.
            below: path sets that cost at least this are not sought; must not grow.

        Raises:
            BudgetSpentError: the deadline has passed.
        """
        limit = int(min(below, MAX_COST))
        while moves > 0 and not self.ended:
            self._budget.check_time()
            portion = min(moves, _MOVES_BETWEEN)
            outcome = search(self._moves, self._store, self._progress, limit, portion)
            moves -= portion
            self._moves_left -= portion
            self.lower_bound = max(self.lower_bound, int(self._progress.head[BOUND]))
            if outcome == FULL:
                self.grow()
            elif outcome == FOUND:
                solution, self.ended = self._found(), True
                if not self._problem.is_too_long(solution):
                    self.solution = solution
            elif outcome == EMPTY:
                self._end(below)
            elif self._moves_left <= 0:
                self.ended = True

    def _end(self, bound: float) -> None:
        """End the search: no path set costs less than the bound."""
        self.ended = True
        proven = min(bound, MAX_COST) if self._progress.head[CUT] else bound
        self.lower_bound = max(self.lower_bound, proven)

    def grow(self) -> None:
        """Double the arrays, or end if they would need too much memory."""
        old, states = self._store, int(self._progress.head[STATES])
        size = Store.size_of(2 * len(old.cost), len(self._vehicles))
        if size > self._max_bytes:
            self.ended = True
            return
        self._budget.check_time(size / _BYTES_PER_S)
        self._store = Store.of(2 * len(old.cost), len(self._vehicles))
        for new, known in zip(self._store[:4], old[:4], strict=True):
            new[:states] = known[:states]
        self._store.heap[: len(old.heap)] = old.heap
        fill_slots(self._store, states)

    def _numbers(self, cells: Sequence[int]) -> list[int]:
        """Return the numbers of cells that are given as bit indices."""
        table = self._problem.table
        return [column * table.grid.lanes + lane for column, lane in map(table.cell, cells)]

    def _found(self) -> Solution:
        """Return the paths of the vehicles from the start to their targets."""
        table, base, store = self._problem.table, self._moves.base, self._store
        count = len(self._vehicles)
        state = int(self._progress.head[CURRENT])
        places = list(range(count))
        """Index of each vehicle, in the order of `_vehicles`, in the current state."""
        paths: list[list[int]] = [[] for _ in range(count)]
        arrivals = [0] * count
        while (after := int(store.after[state])) >= 0:
            made, codes = store.made[state].tolist(), store.codes[after].tolist()
            before = []
            for index, (code, d) in enumerate(zip(codes, made, strict=True)):
                cell, label = divmod(code, base)
                origin = int(self._moves.from_cell[d, cell])
                before.append((origin * base + (label | (d != 0)), index, origin, d))
            before.sort()
            for number, place in enumerate(places):
                _, index, origin, d = before[place]
                paths[number].append(table.bit(divmod(origin, table.grid.lanes)) + d)
                if d:
                    arrivals[number] = len(paths[number])
                places[number] = index
            state = after
        ends = [int(store.codes[state, place]) // base for place in places]
        targets = self._numbers(self._problem.targets)
        by_vehicle = sorted(zip(self._vehicles, ends, paths, arrivals, strict=True))
        return Solution(
            tuple(targets.index(end) for _, end, _, _ in by_vehicle),
            tuple(tuple(path[:arrival]) for _, _, path, arrival in by_vehicle),
        )


def _joint_moves(
    table: MoveTable,
    excluded: Sequence[frozenset[int]],
    team: Sequence[int],
    starts: Sequence[int],
) -> JointMoves:
    """Return the arrays of a problem, by the excluded displacements of each team."""
    lanes, cells = table.grid.lanes, table.grid.columns * table.grid.lanes
    step = np.array([column * lanes + lane for column, lane in table.steps])
    from_cell = np.full((len(step), cells), -1)
    for d, valid in enumerate(valid_moves(table.grid, table.mode)):
        origins = np.flatnonzero(valid)
        from_cell[d, origins + step[d]] = origins
    drives = np.array([[d not in one for d in range(len(step))] for one in excluded], np.bool_)
    base = 2 * len(excluded)
    start = sorted(start * base + 2 * k + 1 for start, k in zip(starts, team, strict=True))
    reach, conflicts = _conflicts(table.mode, table.model)
    steps = np.full((len(excluded), cells), -1)
    for number, not_driven in enumerate(excluded):
        of_team = {
            table.bit(divmod(c, lanes)) for c, k in zip(starts, team, strict=True) if k == number
        }
        undrivable = table.with_displacements(not_driven)
        for cell, distance in table.distances(sum(1 << bit for bit in of_team), undrivable).items():
            column, lane = table.cell(cell)
            steps[number, column * lanes + lane] = distance
    return JointMoves(
        lanes,
        base,
        step,
        from_cell,
        drives.reshape(len(excluded), len(step)),
        reach,
        conflicts,
        np.array(start),
        steps,
    )


@lru_cache(maxsize=16)
def _conflicts(mode: Mode, model: ConflictModel) -> tuple[Ints, Bools]:
    """Return `JointMoves.reach` and `JointMoves.conflicts`."""
    offsets = conflict_offsets(mode, model)
    columns, lanes = model.reach
    found = np.zeros((len(offsets), 2 * columns + 1, 2 * lanes + 1, len(offsets)), np.bool_)
    for d, others in enumerate(offsets):
        for column, lane, e in others:
            found[d, column + columns, lane + lanes, e] = True
    if not model.vehicles_share_cells:
        found[:, columns, lanes, :] = True
    return np.array([columns, lanes]), found
