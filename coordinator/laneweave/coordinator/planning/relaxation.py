"""A lower bound, and prices that prove it: Lagrangian relaxation of the conflict rows.

Without conflicts the problem falls apart: each vehicle takes a shortest path, and targets are
assigned at least cost. With a price on every row in every step, paid by each move that is in it,
the shortest paths avoid what is contested, and their cost less the sum of all prices is a lower
bound on every solution, whatever its number of steps: beyond the last priced step vehicles ignore
each other. Good prices are found by a subgradient method (Held, Wolfe and Crowder, Mathematical
Programming 6, 1974) with momentum.

At given prices every solution costs the bound plus *penalties*, none of which is negative:

- the reduced cost of each move and of each arrival, which is what it adds to its vehicle's least
  priced cost;
- the price of each row that no move uses;
- for each target that stays empty, what it is worth to the others.

So what collects more penalties than is still to be gained is no part of a better solution.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from attrs import define, field

from laneweave.coordinator.planning.arrays import (
    UNREACHABLE,
    Floats,
    Lattice,
    Teams,
)
from laneweave.coordinator.planning.relaxation_kernel import improve_prices, penalties_of


class Penalties(NamedTuple):
    """Penalties at given prices; see the module. Shapes: T priced steps."""

    bound: float
    move: Floats
    """(K, T, D, X) reduced cost of a move of a team."""
    arrival: Floats
    """(K, J, T + 1) reduced cost of arriving at a target for good before a step."""
    reach: Floats
    """(K, T + 1, X) least penalty with which some vehicle of a team is in a cell before a step."""
    empty: Floats
    """(J,) of a target that stays empty; `UNREACHABLE`: all targets are needed."""


@define
class Subgradient:
    """The search for good prices; it can be interrupted and continued."""

    lattice: Lattice
    teams: Teams
    prices: Floats
    """(T, rows) the best prices so far; T is the number of steps in which rows have prices."""
    _present: Floats = field(init=False)
    _direction: Floats = field(init=False)
    _memory: Floats = field(init=False)

    def __attrs_post_init__(self) -> None:
        """Begin with the prices given."""
        self._present = self.prices.copy()
        self._direction = np.zeros_like(self.prices)
        self._memory = np.array([-UNREACHABLE, 1.0, 0.0])

    @property
    def bound(self) -> float:
        """At least what every solution costs; `UNREACHABLE`: there is none."""
        return float(self._memory[0])

    def improve(self, iterations: int) -> None:
        """Do some iterations."""
        improve_prices(
            self.lattice,
            self.teams,
            self._present,
            self.prices,
            self._direction,
            self._memory,
            iterations,
        )


def penalties(lattice: Lattice, teams: Teams, prices: Floats) -> Penalties:
    """Return what solutions pay beyond the bound of some prices."""
    bound, move, arrival, reach, worth = penalties_of(lattice, teams, prices)
    all_needed = len(teams.target) == len(teams.start)
    empty = np.full(len(worth), UNREACHABLE) if all_needed else -worth
    return Penalties(bound, move, arrival, reach, empty)
