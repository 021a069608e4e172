"""A lower bound on the cost of all path sets: Lagrangian relaxation of the conflicts.

Without conflicts the problem falls apart: each vehicle takes a shortest path, and targets are
assigned at least cost. With a price on every row in every step, paid by each move that is in it,
the shortest paths avoid what is contested, and their cost less the sum of all prices is a lower
bound on every solution, whatever its number of steps: beyond the last priced step vehicles ignore
each other. Good prices are found by a subgradient method (Held, Wolfe and Crowder, Mathematical
Programming 6, 1974) with momentum.

At given prices each move of a team has a reduced cost: what it adds at least to the bound of every
solution that contains it. So for a given ceiling, what is too dear is forbidden, which makes the
rest smaller and its bound higher.

Costs are steps until the final arrival, and `PER_MOVE` for each move that is not a wait.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from laneweave.coordinator.planning.exact.arrays import (
    UNREACHABLE,
    Bools,
    Floats,
    Ints,
    Lattice,
    Teams,
)
from laneweave.coordinator.planning.exact.relaxation_kernel import (
    BEST,
    BOUND,
    PACE,
    PER_MOVE,
    evaluate,
    forbid_dear,
    forbid_taken,
    improve,
    list_moves,
    may_be_late,
    start_over,
)

_GUESS = -1.0
_LEAST_SHARE = 1e-6


class Scratch(NamedTuple):
    """What the compiled code writes on. Shapes: T steps, R rows; others as in `arrays`."""

    to_go: Floats
    """(T + 1, X, P) least priced cost from a cell before a step to the target of a pair."""
    parked: Floats
    """(T + 1, P) price of waiting on the target from a step on."""
    move: Ints
    """(moves, 3) displacement, from-cell and to-cell of the allowed moves, by step and team."""
    move_from: Ints
    """(T, K + 1) where the moves of a step and team begin."""
    move_price: Floats
    """(moves,)"""
    present: Floats
    """(T, R) prices that are tried."""
    direction: Floats
    """(T, R)"""
    use: Floats
    """(T, R) of each row, by the vehicles on their cheapest ways."""
    mass: Floats
    """(K, T, D, X) weights of the relaxed solutions that contain a move."""
    mass_of_team: Floats
    """(T, R, K)"""
    mass_of_cell: Floats
    """(T, R, numbers of from-cells in a row)"""
    reach: Floats
    """(K, T + 1, X) least reduced cost with which a team gets to a cell before a step."""
    least: Floats
    """(K, T + 1, X) least of `to_go`, less the worth of the target."""
    cost: Floats
    """(N, J)"""
    holder: Ints
    """(J,) the vehicle that has a target; -1: none."""
    worth: Floats
    """(J,) dual values of the targets."""
    way: Ints
    """(N, T) displacements of the vehicles; `PARKED`: none any more."""
    best_way: Ints
    """(N, T) of the best solution that was free of conflicts."""


class Stack(NamedTuple):
    """Parts of the problem that are still to be looked at. Shape: S nodes and those above."""

    allowed: Bools
    """(S, K, T, D, X) moves that a team may make."""
    first: Ints
    """(S, P) first step before which a vehicle may arrive for good."""
    prices: Floats
    """(S, T, R)"""
    pace: Floats
    """(S,) factor of the step length."""


def scratch(lattice: Lattice, teams: Teams, steps: int) -> Scratch:
    """Return scratch arrays for so many steps."""
    displacements, cells = lattice.valid.shape
    groups, goals = teams.pair.shape
    vehicles, pairs, rows = len(teams.start), len(teams.pair_cell), lattice.row_count
    most_moves = groups * steps * int(lattice.valid.sum())
    return Scratch(
        to_go=np.zeros((steps + 1, cells, pairs)),
        parked=np.zeros((steps + 1, pairs)),
        move=np.zeros((most_moves, 3), dtype=np.int64),
        move_from=np.zeros((steps, groups + 1), dtype=np.int64),
        move_price=np.zeros(most_moves),
        present=np.zeros((steps, rows)),
        direction=np.zeros((steps, rows)),
        use=np.zeros((steps, rows)),
        mass=np.zeros((groups, steps, displacements, cells)),
        mass_of_team=np.zeros((steps, rows, groups)),
        mass_of_cell=np.zeros((steps, rows, lattice.near_count)),
        reach=np.zeros((groups, steps + 1, cells)),
        least=np.zeros((groups, steps + 1, cells)),
        cost=np.zeros((vehicles, goals)),
        holder=np.zeros(goals, dtype=np.int64),
        worth=np.zeros(goals),
        way=np.zeros((vehicles, steps), dtype=np.int64),
        best_way=np.zeros((vehicles, steps), dtype=np.int64),
    )


def stack(teams: Teams, prices: Floats, valid: Bools, size: int) -> Stack:
    """Return an empty stack."""
    groups, pairs = len(teams.pair), len(teams.pair_cell)
    return Stack(
        allowed=np.zeros((size, groups, len(prices), *valid.shape), dtype=np.bool_),
        first=np.zeros((size, pairs), dtype=np.int64),
        prices=np.zeros((size, *prices.shape)),
        pace=np.ones(size),
    )


def ceiling_of(cost: int) -> float:
    """Return what no solution of a cost is above, whatever its number of moves.

    Values are multiples of the price of a move, so half of it is room for rounding.
    """
    return cost * (1.0 + PER_MOVE) + 0.5 * PER_MOVE


class Relaxation:
    """The whole problem at its best prices so far.

    prices: (T, R); T is the number of steps in which rows have prices.
    bound: at least what every solution costs; `UNREACHABLE`: there is none.
    """

    def __init__(
        self, lattice: Lattice, teams: Teams, steps: int, taken: Bools | None = None
    ) -> None:
        """Begin without prices.

        Args:
            lattice: the moves.
            teams: the vehicles.
            steps: in which rows have prices.
            taken: (steps, R) rows that may not be used.
        """
        self.lattice = lattice
        self.teams = teams
        self._taken = taken
        self.memory = np.zeros(BEST + 1)
        self.memory[BOUND], self.memory[PACE], self.memory[BEST] = -UNREACHABLE, 1.0, UNREACHABLE
        self._lay_out(np.zeros((steps, lattice.row_count)))

    def _lay_out(self, prices: Floats) -> None:
        self.prices = prices
        self.scratch = scratch(self.lattice, self.teams, len(prices))
        shape = len(self.teams.pair), len(prices), *self.lattice.valid.shape
        self.allowed = np.empty(shape, dtype=np.bool_)
        self.allowed[:] = self.lattice.valid
        self.first = np.zeros(len(self.teams.pair_cell), dtype=np.int64)
        if self._taken is not None:
            forbid_taken(self.lattice, self.teams, self._taken, self.allowed, self.first)
        # Where nobody can get in time, nobody moves.
        self._list()
        self._forbid(self.allowed, self.first, self.prices, UNREACHABLE)
        self._begin()

    def _list(self) -> None:
        self._span = list_moves(self.lattice, self.allowed, self.scratch)[1]

    def _begin(self) -> None:
        self._list()
        start_over(self.prices, self._span, self.scratch, self.memory)

    def _forbid(self, allowed: Bools, first: Ints, prices: Floats, ceiling: float) -> float:
        bound, _ = forbid_dear(
            self.lattice, self.teams, allowed, first, prices, self._span, self.scratch, ceiling
        )
        return float(bound)

    @property
    def bound(self) -> float:
        """At least what every solution costs; `UNREACHABLE`: there is none."""
        return float(self.memory[BOUND])

    @property
    def least_cost(self) -> float:
        """The bound as a number of steps; infinite: there is no solution."""
        if self.bound >= UNREACHABLE:
            return math.inf
        return math.ceil(self.bound / (1.0 + PER_MOVE) - _LEAST_SHARE)

    def improve(self, iterations: int) -> None:
        """Do some iterations for better prices."""
        improve(
            self.lattice,
            self.teams,
            self.allowed,
            self.first,
            self.prices,
            self._span,
            self.scratch,
            self.memory,
            iterations,
            UNREACHABLE,
            _GUESS,
        )

    def assignment(self) -> Ints:
        """Return (N,) the number of the target of each vehicle that is best at the prices."""
        self._begin()
        evaluate(self.lattice, self.teams, self.first, self.prices, self._span, self.scratch)
        return self.held_targets()

    def held_targets(self) -> Ints:
        """Return (N,) the number of the target of each vehicle in the last relaxed solution."""
        target = np.zeros(len(self.teams.start), dtype=np.int64)
        taken = np.flatnonzero(self.scratch.holder >= 0)
        target[self.scratch.holder[taken]] = taken
        return target

    def put(self, nodes: Stack, ceiling: float) -> bool | None:
        """Put what solutions below a ceiling may contain at the bottom of a stack.

        Returns:
            Whether there may be one; None: perhaps one that needs more steps than have prices.
        """
        self.put_whole(nodes)
        self._begin()
        bound = self._forbid(nodes.allowed[0], nodes.first[0], nodes.prices[0], ceiling)
        if bound > ceiling:
            return False
        steps = len(self.prices)
        if self._span == steps and may_be_late(
            self.teams, steps, self.scratch, ceiling - bound + _LEAST_SHARE
        ):
            return None
        return True

    def put_whole(self, nodes: Stack) -> None:
        """Put everything that is allowed at the bottom of a stack, at the present prices."""
        nodes.allowed[0], nodes.first[0] = self.allowed, self.first
        nodes.prices[0], nodes.pace[0] = self.prices, 1.0

    def take_prices(self, prices: Floats) -> None:
        """Go on from other prices."""
        self.prices = prices.copy()

    def lengthen(self, steps: int) -> None:
        """Let rows have prices in more steps; the best solution so far is forgotten."""
        self.memory[BEST] = UNREACHABLE
        if self._taken is not None:
            self._taken = np.pad(self._taken, ((0, steps), (0, 0)))
        self._lay_out(np.pad(self.prices, ((0, steps), (0, 0))))
