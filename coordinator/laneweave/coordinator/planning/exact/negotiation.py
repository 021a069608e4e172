"""Path sets by negotiation: early solutions for any number of vehicles.

Vehicles first take their cheapest paths, which may conflict. Then all vehicles on contested cliques
are rerouted repeatedly, one after another; the cost of cliques in use rises with each pass, and
contested cliques gain a permanent cost. This nearly always resolves all conflicts (McMurchie and
Ebeling, PathFinder, FPGA 1995, a method for routing wires).

After that, a few vehicles at a time are removed, may exchange targets, and negotiate again around
the others; the result is kept unless it is worse (large-neighbourhood search). After many attempts
without improvement, negotiation restarts from the latest suggested multipliers and targets.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from laneweave.coordinator.planning.exact.arrays import Floats, Ints, MoveArrays, Teams
from laneweave.coordinator.planning.exact.multipliers_kernel import PARKED, UNREACHABLE
from laneweave.coordinator.planning.exact.negotiation_kernel import improve_paths, negotiate

_HORIZON, _HORIZON_GROWTH, _MAX_HORIZON = 2.0, 1.25, 10.0
"""Horizon relative to the steps with multipliers, its growth if it is too short, its maximum."""
_PASSES = 300
_SPARE_STEPS = 4
_ATTEMPTS = 4
"""Attempts to improve the path set in one pass."""
_MAX_REMOVED = (6, 12)
"""Maximum number of vehicles removed together; the two values alternate."""
_IDLE_ATTEMPTS = 800
"""Attempts without improvement after which negotiation restarts."""


class CandidatePaths(NamedTuple):
    """A path set under construction. Shapes: N vehicles, T steps, R cliques, X cells."""

    path: Ints
    """(N, T) displacements; `PARKED`: arrived."""
    cost: Ints
    """(N,) cost of each path."""
    target: Ints
    """(N,) target index of each vehicle."""
    use: Floats
    """(T, R) number of vehicles in each clique."""
    own: Floats
    """(T, R) number of removed vehicles in each clique."""
    history: Floats
    """(T, R) permanent cost of contested cliques."""
    weight: Floats
    """(T, R) current cost of each clique."""
    cost_to_go: Floats
    """(T + 1, X) minimum cost, before each step, from each cell to one vehicle's target."""
    parked: Floats
    """(T + 1,) cost of staying at the target from each step on."""
    random: NDArray[np.uint64]
    """(1,) state of the random number generator."""


def candidate_paths(
    arrays: MoveArrays, path: Ints, target: Ints, history: Floats
) -> CandidatePaths:
    """Return a candidate with paths (N, T) whose uses of cliques are not yet counted."""
    shape = history.shape
    return CandidatePaths(
        path=path,
        cost=np.count_nonzero(path != PARKED, axis=1).astype(np.int64),
        target=target,
        use=np.zeros(shape),
        own=np.zeros(shape),
        history=history,
        weight=np.zeros(shape),
        cost_to_go=np.zeros((path.shape[1] + 1, arrays.valid.shape[1])),
        parked=np.zeros(path.shape[1] + 1),
        random=np.zeros(1, dtype=np.uint64),
    )


class Negotiation:
    """A deterministic negotiation and its best path set so far.

    cost: cost of the best path set; None: there is none yet.
    path: (N, T) displacements of the best path set.
    """

    def __init__(self, arrays: MoveArrays, teams: Teams, multipliers: Floats, target: Ints) -> None:
        """Prepare the first pass.

        Args:
            arrays: the moves.
            teams: the vehicles.
            multipliers: (T, R) initial costs of cliques.
            target: (N,) initial target index of each vehicle.
        """
        self.cost: int | None = None
        self.path: Ints = np.empty((0, 0), dtype=np.int64)
        self._arrays = arrays
        self._teams = teams
        self._multipliers = multipliers
        self._target = target
        self._rounds = 0
        self._horizon = _HORIZON
        self._restart()

    def suggest(self, multipliers: Floats, target: Ints) -> None:
        """Start the next round from these multipliers, and from these targets if valid."""
        self._multipliers = multipliers
        pair = self._teams.pair[self._teams.team, target]
        reachable = self._teams.distance[self._teams.start, pair] < UNREACHABLE
        if np.all(pair >= 0) and np.all(reachable) and len(np.unique(target)) == len(target):
            self._target = target

    def _restart(self) -> None:
        steps = int(np.ceil(self._horizon * len(self._multipliers)))
        history = np.zeros((steps, self._multipliers.shape[1]))
        history[: len(self._multipliers)] = self._multipliers
        path = np.full((len(self._target), steps), PARKED, dtype=np.int64)
        self._candidate = candidate_paths(self._arrays, path, self._target.copy(), history)
        self._candidate.random[0] = self._rounds
        self._rounds += 1
        self._passes = self._idle = 0
        self._conflict_free = False

    def work(self, check_time: Callable[[], None]) -> bool:
        """Run one pass; return whether it found a better path set.

        `check_time` may raise an error to stop the work.
        """
        check_time()
        if self._conflict_free:
            return self._improve()
        self._conflict_free = negotiate(self._arrays, self._teams, self._candidate, self._passes)
        self._passes += 1
        if self._conflict_free:
            self._drop_idle_steps()
            return self._keep()
        if self._passes >= _PASSES:
            self._horizon = min(_HORIZON_GROWTH * self._horizon, _MAX_HORIZON)
            self._restart()
        return False

    def _improve(self) -> bool:
        before = self._candidate.cost.sum()
        max_size = _MAX_REMOVED[self._idle // 100 % len(_MAX_REMOVED)]
        idle = improve_paths(self._arrays, self._teams, self._candidate, _ATTEMPTS, max_size)
        self._idle = self._idle + idle if idle >= _ATTEMPTS else idle
        better = self._keep()
        if self._candidate.cost.sum() < before:
            self._drop_idle_steps()
        if self._idle > _IDLE_ATTEMPTS:
            self._restart()
        return better

    def _keep(self) -> bool:
        """Keep the candidate if it is the best so far; return whether it is."""
        cost = int(self._candidate.cost.sum())
        if self.cost is not None and cost >= self.cost:
            return False
        self.cost, self.path = cost, self._candidate.path.copy()
        return True

    def _drop_idle_steps(self) -> None:
        """Drop all but a few of the final steps, in which no vehicle moves."""
        old = self._candidate
        steps = int(old.cost.max()) + _SPARE_STEPS
        if steps < old.path.shape[1]:
            path = np.ascontiguousarray(old.path[:, :steps])
            history = np.zeros((steps, old.use.shape[1]))
            new = candidate_paths(self._arrays, path, old.target, history)
            new.use[:] = old.use[:steps]
            new.random[:] = old.random
            self._candidate = new
