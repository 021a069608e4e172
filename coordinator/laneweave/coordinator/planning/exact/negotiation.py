"""Path sets early, for any number of vehicles: ways are negotiated.

At first vehicles may be in conflict. Then all whose way is contested look for another one, one
after the other and again and again, while the price of what others use rises, and what stays
contested gets dearer for good. That settles nearly always (McMurchie and Ebeling, PathFinder,
FPGA 1995, who route wires in this way).

After that a few vehicles at a time are taken out, perhaps exchange targets, and negotiate again
around all others; what is not worse is kept (large-neighbourhood search). Where that finds nothing
any more, neighbourhoods are decided exactly (`repair`). When that has been in vain for long, too,
all begins anew, from the newest prices and targets that were suggested.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from laneweave.coordinator.planning.exact.arrays import UNREACHABLE, Floats, Ints, Lattice, Teams
from laneweave.coordinator.planning.exact.negotiation_kernel import improve_ways, negotiate
from laneweave.coordinator.planning.exact.relaxation_kernel import PARKED
from laneweave.coordinator.planning.exact.repair import Repair
from laneweave.coordinator.planning.exact.trial import trial

_STRETCH, _MORE_STRETCH, _MOST_STRETCH = 2.0, 1.25, 10.0
"""The horizon, relative to the steps with prices, and how it grows if it was too short."""
_PASSES = 300
_SPARE_STEPS = 4
_ATTEMPTS = 4
"""Attempts to improve that count as a pass."""
_MOST_OUT = (6, 12)
"""Vehicles that are taken out at most, by turns."""
_EXACT_AFTER = 60
"""After so many attempts in vain exact ones begin."""
_IDLE_ATTEMPTS, _IDLE_REPAIRS = 800, 50
"""After so many attempts in vain, or so many exact ones, all begins anew."""


class Negotiation:
    """The best path set so far; equal problems and equal work give equal path sets.

    cost: of the best path set; None: there is none yet.
    way: (N, T) its displacements.
    stale: how often work has been in vain since it was found.
    """

    def __init__(self, lattice: Lattice, teams: Teams, prices: Floats, target: Ints) -> None:
        """Begin.

        Args:
            lattice: the moves.
            teams: the vehicles.
            prices: (T, R) of rows, to begin with.
            target: (N,) number of the target of each vehicle, to begin with.
        """
        self.cost: int | None = None
        self.way: Ints = np.empty((0, 0), dtype=np.int64)
        self.stale = 0
        self._lattice = lattice
        self._teams = teams
        self._prices = prices
        self._target = target
        self._repair = Repair(lattice, teams)
        self._rounds = 0
        self._stretch = _STRETCH
        self._begin()

    def suggest(self, prices: Floats, target: Ints) -> None:
        """Begin the next round from other prices, and from other targets if they are legal."""
        self._prices = prices
        pair = self._teams.pair[self._teams.team, target]
        reachable = self._teams.distance[self._teams.start, pair] < UNREACHABLE
        if np.all(pair >= 0) and np.all(reachable) and len(np.unique(target)) == len(target):
            self._target = target

    def _begin(self) -> None:
        """Begin a round."""
        steps = int(np.ceil(self._stretch * len(self._prices)))
        memory = np.zeros((steps, self._prices.shape[1]))
        memory[: len(self._prices)] = self._prices
        way = np.full((len(self._target), steps), PARKED, dtype=np.int64)
        self._trial = trial(self._lattice, way, self._target.copy(), memory)
        self._trial.random[0] = self._rounds
        self._rounds += 1
        self._passes, self._idle, self._idle_repairs = 0, 0, 0
        self._settled = False
        self._repair.begin(self._prices)

    def work(self, check_time: Callable[[], None]) -> bool:
        """Do a little; return whether there is a better path set now.

        `check_time` may raise an error to end all work.
        """
        check_time()
        self.stale += 1
        if self._settled:
            return self._improve(check_time)
        self._settled = negotiate(self._lattice, self._teams, self._trial, self._passes)
        self._passes += 1
        if self._settled:
            self._shorten()
            return self._keep()
        if self._passes >= _PASSES:
            self._stretch = min(_MORE_STRETCH * self._stretch, _MOST_STRETCH)
            self._begin()
        return False

    def _improve(self, check_time: Callable[[], None]) -> bool:
        before = self._trial.cost.sum()
        most = _MOST_OUT[self._idle // 100 % len(_MOST_OUT)]
        idle = improve_ways(self._lattice, self._teams, self._trial, _ATTEMPTS, most)
        self._idle = self._idle + idle if idle >= _ATTEMPTS else idle
        if self._idle >= _EXACT_AFTER and self._repair.fits(self._trial):
            self._idle_repairs += 1
            if self._repair.attempt(self._trial, check_time):
                self._idle = _EXACT_AFTER
        better = self._keep()
        if self._trial.cost.sum() < before:
            self._idle_repairs = 0
            self._shorten()
        if self._idle > _IDLE_ATTEMPTS or self._idle_repairs > _IDLE_REPAIRS:
            self._begin()
        return better

    def _keep(self) -> bool:
        cost = int(self._trial.cost.sum())
        if self.cost is not None and cost >= self.cost:
            return False
        self.cost, self.way, self.stale = cost, self._trial.way.copy(), 0
        return True

    def _shorten(self) -> None:
        """Drop the steps in which nobody moves any more, but a few."""
        old = self._trial
        steps = int(old.cost.max()) + _SPARE_STEPS
        if steps < old.way.shape[1]:
            way = np.ascontiguousarray(old.way[:, :steps])
            new = trial(self._lattice, way, old.target, np.zeros((steps, old.use.shape[1])))
            new.use[:] = old.use[:steps]
            new.random[:] = old.random
            self._trial = new
