"""Exact large-neighbourhood search: some vehicles at a time are planned anew around all others.

Six to fourteen vehicles that are in each other's way are taken out of a path set. What the others
use is forbidden to them; whether they can be cheaper then is decided by the same branch and bound
as the whole problem (`branching_kernel`), mostly in a few milliseconds. If so, they take the new
ways, and perhaps other targets of theirs. (Large-neighbourhood search: Shaw, CP 1998; for
multi-agent path finding: Li et al., IJCAI 2021, whose choice of agents that block one another is
used, too.)
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from laneweave.coordinator.planning.exact.arrays import Floats, Ints, Lattice, Teams, part
from laneweave.coordinator.planning.exact.branching_kernel import search
from laneweave.coordinator.planning.exact.relaxation import Relaxation, ceiling_of, stack
from laneweave.coordinator.planning.exact.relaxation_kernel import FOUND, OPEN, PARKED, REFUTED
from laneweave.coordinator.planning.exact.repair_kernel import choose, put_back, take_out
from laneweave.coordinator.planning.exact.trial import Trial

LEAST_VEHICLES = 16
"""Fewer vehicles are decided together."""
_SIZES = 6, 14
"""Vehicles that are taken out: more when smaller neighbourhoods hold nothing better."""
_PATIENCE = 6
_CHUNKS, _NODES, _STACK = 20, 2, 16
"""To decide a neighbourhood: looks at the clock, nodes after each, and room for open ones."""
_MOST_BYTES, _BYTES_OF_A_MOVE = 50_000_000, 40
"""Larger tables are not worth it; and what a move needs in them, but for the stack."""


class Repair:
    """The search and how large its neighbourhoods are now."""

    def __init__(self, lattice: Lattice, teams: Teams) -> None:
        """Prepare; `begin` comes next."""
        self._lattice = lattice
        self._teams = teams
        self._number = 0

    def begin(self, prices: Floats) -> None:
        """Start with small neighbourhoods; prices (T, R) are those of the whole problem."""
        self._prices = prices
        self._size, self._in_vain = _SIZES[0], 0

    def fits(self, trial: Trial) -> bool:
        """Tell whether there are enough vehicles, and tables do not get too large."""
        moves = len(self._teams.pair) * len(trial.use) * self._lattice.valid.size
        size = (_STACK + _BYTES_OF_A_MOVE) * moves
        return len(self._teams.start) >= LEAST_VEHICLES and size <= _MOST_BYTES

    def attempt(self, trial: Trial, check_time: Callable[[], None]) -> bool:
        """Plan some vehicles anew; return whether they are cheaper now.

        When `check_time` raises an error the trial is spoilt.
        """
        self._number += 1
        chosen = choose(self._lattice, self._teams, trial, self._size, self._number % 3)
        taken = take_out(self._lattice, self._teams, trial, chosen)
        steps = len(taken)
        targets = np.sort(trial.target[chosen])
        some = part(self._teams, chosen, targets)
        problem = Relaxation(self._lattice, some, steps, taken)
        check_time()
        problem.prices[: len(self._prices)] = self._prices[:steps]
        nodes = stack(some, problem.prices, self._lattice.valid, _STACK)
        problem.put_whole(nodes)
        cost = int(trial.cost[chosen].sum())
        depth, ending = 1, OPEN
        for _ in range(_CHUNKS):
            check_time()
            ending, depth, _ = search(
                self._lattice,
                some,
                nodes,
                depth,
                problem.scratch,
                problem.memory,
                ceiling_of(cost - 1),
                _NODES,
            )
            if ending != OPEN:
                break
        if ending == FOUND:
            self._take(trial, chosen, targets, problem.scratch.best_way)
        put_back(self._lattice, self._teams, trial, chosen)
        self._learn(ending)
        return bool(ending == FOUND)

    def _take(self, trial: Trial, chosen: Ints, targets: Ints, ways: Ints) -> None:
        """Let the chosen vehicles have other ways, and the targets that these end at."""
        held = {int(self._teams.target[j]): j for j in targets}
        for i, way in zip(chosen, ways, strict=True):
            moves = np.flatnonzero(way > 0)
            arrival = int(moves[-1]) + 1 if len(moves) else 0
            trial.way[i] = PARKED
            trial.way[i, :arrival] = way[:arrival]
            trial.cost[i] = arrival
            trial.target[i] = held[int(self._teams.start[i] + self._lattice.step[way[moves]].sum())]

    def _learn(self, ending: int) -> None:
        """Have larger neighbourhoods when small ones hold nothing, smaller when they take long."""
        if ending == REFUTED:
            self._in_vain += 1
            if self._in_vain > _PATIENCE:
                self._size, self._in_vain = min(self._size + 1, _SIZES[1]), 0
        elif ending == FOUND:
            self._in_vain = 0
        else:
            self._size = max(self._size - 1, _SIZES[0])
