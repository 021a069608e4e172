"""A lower bound on the cost of all path sets: Lagrangian relaxation of the conflicts.

Without conflicts the problem decomposes: each vehicle takes a shortest path, and targets are
assigned at minimum cost. Every conflict clique in every step has a Lagrange multiplier, the cost of
each move in the clique. The shortest paths then avoid contested cliques, and their cost minus the
sum of all multipliers is a lower bound on every solution's cost, whatever its length: beyond the
last step with multipliers, vehicles ignore each other. Good multipliers are found by a subgradient
method (Held, Wolfe and Crowder, Mathematical Programming 6, 1974) with momentum.

At given multipliers, each move of a team has a reduced cost, a lower bound on the extra cost of
every solution that contains the move. So for a given upper bound, moves whose reduced cost is too
high are forbidden (reduced-cost fixing), which shrinks the problem and raises its lower bound.

Costs are the steps until final arrival plus `PER_MOVE` for each move that is not a wait.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from laneweave.coordinator.planning.exact.arrays import Bools, Floats, Ints, MoveArrays, Teams
from laneweave.coordinator.planning.exact.multipliers_kernel import (
    BEST,
    BOUND,
    PER_MOVE,
    STEP_SIZE,
    UNREACHABLE,
    begin,
    begin_below,
    evaluate,
    improve,
    may_need_more_steps,
)

_ESTIMATE = -1.0
"""Value of `goal` that makes `multipliers_kernel.improve` estimate it."""
_TOLERANCE = 1e-6


class Scratch(NamedTuple):
    """Working memory for the compiled code. Shapes: T steps, R cliques; others as in `arrays`."""

    cost_to_go: Floats
    """(T + 1, X, P) minimum cost, before each step, from each cell to each pair's target."""
    parked: Floats
    """(T + 1, P) sum of multipliers for waiting at the target from each step on."""
    move: Ints
    """(moves, 3) displacement, from-cell and to-cell of the allowed moves, by step and team."""
    move_from: Ints
    """(T, K + 1) index in `move` at which the moves of each step and team begin."""
    move_cost: Floats
    """(moves,) cost of each move in `move`."""
    present: Floats
    """(T, R) multipliers of the current iteration."""
    direction: Floats
    """(T, R) subgradient with momentum."""
    use: Floats
    """(T, R) number of cheapest paths that use each clique; then the subgradient."""
    mass: Floats
    """(K, T, D, X) total weight of the relaxed solutions that contain each move."""
    mass_of_team: Floats
    """(T, R, K) mass of each team's moves in each clique."""
    mass_of_cell: Floats
    """(T, R, `residue_count`) mass of the moves from each cell in each clique."""
    reach: Floats
    """(K, T + 1, X) minimum reduced cost at which a team is in a cell before a step."""
    min_cost: Floats
    """(K, T + 1, X) minimum over a team's targets of `cost_to_go` minus the dual value."""
    cost: Floats
    """(N, J) minimum cost for each vehicle to reach each target."""
    holder: Ints
    """(J,) vehicle assigned to each target; -1: none."""
    dual: Floats
    """(J,) dual values of the targets."""
    path: Ints
    """(N, T) displacements of the vehicles; `PARKED`: arrived."""
    best_path: Ints
    """(N, T) paths of the best conflict-free relaxed solution."""


class Stack(NamedTuple):
    """The open nodes of branch and bound. Shapes: S nodes; others as in `Scratch`."""

    allowed: Bools
    """(S, K, T, D, X) whether each team may make each move."""
    earliest: Ints
    """(S, P) earliest step by whose start a vehicle may have arrived for good."""
    multipliers: Floats
    """(S, T, R) Lagrange multipliers."""
    step_size: Floats
    """(S,) step-size factor."""


def scratch(arrays: MoveArrays, teams: Teams, steps: int) -> Scratch:
    """Return working memory for a number of steps."""
    displacements, cells = arrays.valid.shape
    groups, goals = teams.pair.shape
    vehicles, pairs, cliques = len(teams.start), len(teams.pair_cell), arrays.clique_count
    max_moves = groups * steps * int(arrays.valid.sum())
    return Scratch(
        cost_to_go=np.zeros((steps + 1, cells, pairs)),
        parked=np.zeros((steps + 1, pairs)),
        move=np.zeros((max_moves, 3), dtype=np.int64),
        move_from=np.zeros((steps, groups + 1), dtype=np.int64),
        move_cost=np.zeros(max_moves),
        present=np.zeros((steps, cliques)),
        direction=np.zeros((steps, cliques)),
        use=np.zeros((steps, cliques)),
        mass=np.zeros((groups, steps, displacements, cells)),
        mass_of_team=np.zeros((steps, cliques, groups)),
        mass_of_cell=np.zeros((steps, cliques, arrays.residue_count)),
        reach=np.zeros((groups, steps + 1, cells)),
        min_cost=np.zeros((groups, steps + 1, cells)),
        cost=np.zeros((vehicles, goals)),
        holder=np.zeros(goals, dtype=np.int64),
        dual=np.zeros(goals),
        path=np.zeros((vehicles, steps), dtype=np.int64),
        best_path=np.zeros((vehicles, steps), dtype=np.int64),
    )


def upper_bound_of(cost: int) -> float:
    """Return an upper bound on the value of solutions of this cost, for any number of moves.

    Values are multiples of `PER_MOVE`, so half of it is a margin for rounding.
    """
    return cost * (1.0 + PER_MOVE) + 0.5 * PER_MOVE


class Relaxation:
    """The relaxed problem with the best multipliers so far.

    multipliers: (T, R); T is the number of steps in which cliques have multipliers.
    """

    def __init__(
        self, arrays: MoveArrays, teams: Teams, steps: int, max_steps: int | None = None
    ) -> None:
        """Start with multipliers of 0 in `steps` steps.

        Args:
            arrays: the moves.
            teams: the vehicles and targets.
            steps: number of steps with multipliers.
            max_steps: number of steps after which all vehicles have arrived; None: any number.
        """
        self._max_steps = max_steps
        self.arrays = arrays
        self.teams = teams
        self.state = np.zeros(BEST + 1)
        self.state[BOUND], self.state[STEP_SIZE], self.state[BEST] = -UNREACHABLE, 1.0, UNREACHABLE
        self._allocate(np.zeros((steps, arrays.clique_count)))

    def _allocate(self, multipliers: Floats) -> None:
        self.multipliers = multipliers
        self.scratch = scratch(self.arrays, self.teams, len(multipliers))
        shape = len(self.teams.pair), len(multipliers), *self.arrays.valid.shape
        self.allowed = np.empty(shape, dtype=np.bool_)
        self.allowed[:] = self.teams.drives[:, None]
        if self._max_steps is not None:
            self.allowed[:, self._max_steps :] = False
        self.earliest = np.zeros(len(self.teams.pair_cell), dtype=np.int64)
        # Forbid moves from cells that no vehicle can reach in time.
        self._begin_below(self.allowed, self.earliest, self.multipliers, UNREACHABLE)
        self._begin()

    def _begin(self) -> None:
        """List the allowed moves and reset the subgradient method."""
        _, self._span = begin(self.arrays, self.allowed, self.multipliers, self.scratch, self.state)

    def _begin_below(
        self, allowed: Bools, earliest: Ints, multipliers: Floats, upper_bound: float
    ) -> float:
        """Begin, and forbid moves that no solution below an upper bound contains.

        Returns:
            The lower bound.
        """
        bound, self._span = begin_below(
            self.arrays,
            self.teams,
            allowed,
            earliest,
            multipliers,
            self.scratch,
            self.state,
            upper_bound,
        )
        return float(bound)

    @property
    def min_cost(self) -> float:
        """Lower bound on the cost of every solution, in steps; infinite: no solution exists."""
        bound = float(self.state[BOUND])
        if bound >= UNREACHABLE:
            return math.inf
        return math.ceil(bound / (1.0 + PER_MOVE) - _TOLERANCE)

    def stack(self, size: int) -> Stack:
        """Return an empty stack for nodes of this problem."""
        return Stack(
            allowed=np.zeros((size, *self.allowed.shape), dtype=np.bool_),
            earliest=np.zeros((size, *self.earliest.shape), dtype=np.int64),
            multipliers=np.zeros((size, *self.multipliers.shape)),
            step_size=np.ones(size),
        )

    def improve(self, iterations: int) -> None:
        """Run some iterations of the subgradient method."""
        improve(
            self.arrays,
            self.teams,
            self.allowed,
            self.earliest,
            self.multipliers,
            self._span,
            self.scratch,
            self.state,
            iterations,
            UNREACHABLE,
            _ESTIMATE,
        )

    def assignment(self) -> Ints:
        """Return the best target index (N,) of each vehicle at the current multipliers."""
        self._begin()
        evaluate(self.arrays, self.teams, self.earliest, self.multipliers, self._span, self.scratch)
        return self.held_targets()

    def held_targets(self) -> Ints:
        """Return the target index (N,) of each vehicle in the last relaxed solution."""
        target = np.zeros(len(self.teams.start), dtype=np.int64)
        taken = np.flatnonzero(self.scratch.holder >= 0)
        target[self.scratch.holder[taken]] = taken
        return target

    def put(self, nodes: Stack, upper_bound: float) -> bool | None:
        """Initialize a stack with the moves that solutions below an upper bound may contain.

        Returns:
            Whether such a solution may exist; None: it may need more steps than have multipliers.
        """
        nodes.allowed[0], nodes.earliest[0] = self.allowed, self.earliest
        nodes.multipliers[0], nodes.step_size[0] = self.multipliers, 1.0
        bound = self._begin_below(
            nodes.allowed[0], nodes.earliest[0], nodes.multipliers[0], upper_bound
        )
        if bound > upper_bound:
            return False
        steps = len(self.multipliers)
        if self._span == steps and may_need_more_steps(
            self.teams, steps, self.scratch, upper_bound - bound + _TOLERANCE
        ):
            return None
        return True

    def lengthen(self, steps: int) -> None:
        """Add multipliers for more steps; this discards the best relaxed solution so far."""
        self.state[BEST] = UNREACHABLE
        self._allocate(np.pad(self.multipliers, ((0, steps), (0, 0))))
