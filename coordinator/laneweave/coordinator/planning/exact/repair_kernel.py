"""Compiled code of `repair`; see `relaxation_kernel` for its style."""

from __future__ import annotations

import numpy as np
from numba import njit

from laneweave.coordinator.planning.exact.negotiation_kernel import add_uses, random_below

NEAR, TOGETHER, BLOCKING = range(3)
NOBODY = -1
_CANDIDATES = 3
"""Of so many vehicles the one that is delayed most is the first."""
_BLURRED = 3.0
_DELAY_COUNTS = 0.2
_LANE_COUNTS = 3.0


@njit(cache=True, nogil=True)
def choose(lattice, teams, trial, size, kind):
    """Return (size,) vehicles that are to be planned anew together, or all if there are fewer.

    The first one is late. The others are `NEAR` it, or have targets near its target (`TOGETHER`),
    or are in its way, and in theirs, when they go straight to their targets (`BLOCKING`).
    """
    vehicles = len(teams.start)
    size = min(size, vehicles)
    first = random_below(trial.random, vehicles)
    for _ in range(_CANDIDATES - 1):
        other = random_below(trial.random, vehicles)
        if _delay(teams, trial, other) > _delay(teams, trial, first):
            first = other
    chosen = np.full(size, NOBODY)
    chosen[0] = first
    count = 1
    if kind == BLOCKING:
        count = _choose_blocking(lattice, teams, trial, chosen)
    lanes = lattice.lanes
    start, target = teams.start, teams.target[trial.target]
    score = np.empty(vehicles)
    for i in range(vehicles):
        ahead = target[i] // lanes - target[first] // lanes
        if kind == TOGETHER:
            away = abs(ahead) + _LANE_COUNTS * abs(target[i] % lanes - target[first] % lanes)
        else:
            away = 0.5 * abs(ahead + start[i] // lanes - start[first] // lanes)
        chance = _BLURRED * random_below(trial.random, 1000) / 1000.0
        score[i] = away + chance - _DELAY_COUNTS * _delay(teams, trial, i)
    for i in chosen[:count]:
        score[i] = np.inf
    for i in np.argsort(score)[: size - count]:
        chosen[count] = i
        count += 1
    return np.sort(chosen)


@njit(cache=True)
def _delay(teams, trial, i):
    pair = teams.pair[teams.team[i], trial.target[i]]
    return trial.cost[i] - teams.distance[teams.start[i], pair]


@njit(cache=True)
def _choose_blocking(lattice, teams, trial, chosen):
    """Fill in those who are in the way of the chosen ones; return how many are chosen then."""
    row, step = lattice.row, lattice.step
    steps, rows = trial.use.shape
    user = np.full((steps, rows), NOBODY)
    for i in range(len(teams.start)):
        cell = teams.start[i]
        for t in range(steps):
            d = max(trial.way[i, t], 0)
            for m in range(row.shape[2]):
                if row[d, cell, m] < 0:
                    break
                user[t, row[d, cell, m]] = i
            cell += step[d]
    count, at = 1, 0
    of_one = max(2, len(chosen) // 3)
    while at < count < len(chosen):
        i = chosen[at]
        pair = teams.pair[teams.team[i], trial.target[i]]
        cell, found = teams.start[i], 0
        for t in range(steps):
            if teams.distance[cell, pair] <= 0.0 or found == of_one or count == len(chosen):
                break
            d = _nearer(lattice, teams.distance[:, pair], cell, trial.random)
            for m in range(row.shape[2]):
                if row[d, cell, m] < 0:
                    break
                other = user[t, row[d, cell, m]]
                if other != NOBODY and count < len(chosen) and not np.any(chosen == other):
                    chosen[count] = other
                    count += 1
                    found += 1
            cell += step[d]
        at += 1
    return count


@njit(cache=True)
def _nearer(lattice, distance, cell, random):
    """Return one of the moves that lead nearer to the target."""
    choice, seen = 0, 0
    for d in range(len(lattice.step)):
        if lattice.valid[d, cell] and distance[cell + lattice.step[d]] < distance[cell]:
            seen += 1
            if random_below(random, seen) == 0:
                choice = d
    return choice


@njit(cache=True, nogil=True)
def take_out(lattice, teams, trial, chosen):
    """Take back the uses of rows by the chosen ones; return (T, R) what is taken by the others."""
    for i in chosen:
        add_uses(lattice, teams.start[i], trial.way[i], trial.use, -1.0)
    return trial.use > 0.5


@njit(cache=True, nogil=True)
def put_back(lattice, teams, trial, chosen):
    """Count the uses of rows by the chosen ones."""
    for i in chosen:
        add_uses(lattice, teams.start[i], trial.way[i], trial.use, 1.0)
