"""Compiled code of `negotiation`; see `relaxation_kernel` for its style."""

from __future__ import annotations

import numpy as np
from numba import njit

from laneweave.coordinator.planning.exact.relaxation_kernel import PARKED, PER_MOVE, price_of

NOT_IN_TIME = 1_000_000
"""Cost of a vehicle that does not arrive within the horizon, and price of what is taken."""
_DETOUR = 10.0
"""Who does not arrive in time ends near its target."""
_FIRST_PRICE, _GROWTH, _HIGHEST_PRICE = 2.0, 1.01, 50.0
"""Of a row that another vehicle uses; it grows with each pass."""
_MEMORY = 1.0
"""Added to the price of a row for good, each pass that it is used twice."""
_ROUNDS, _ROUND_GROWTH, _ROUND_MEMORY = 10, 1.5, 0.5
"""The same among vehicles that are taken out, which have few passes."""
_NEARNESS = 15.0
_DELAY_COUNTS = 0.5
_SWAP_SHARE = 60
"""How often targets are exchanged inside teams, of a hundred."""


@njit(cache=True)
def random_below(state, below):
    """Return a number from 0 to `below` - 1 (a linear congruential generator)."""
    state[0] = state[0] * np.uint64(6364136223846793005) + np.uint64(1442695040888963407)
    return np.int64((state[0] >> np.uint64(33)) % np.uint64(below))


@njit(cache=True)
def _cheapest_way(lattice, weight, distance, start, target, to_go, parked, way):
    """Fill in the cheapest way of one vehicle when each use of a row costs; return its steps."""
    valid, step, row = lattice.valid, lattice.step, lattice.row
    steps = len(weight)
    displacements, cells = valid.shape
    most_rows = row.shape[2]
    for cell in range(cells):
        to_go[steps, cell] = NOT_IN_TIME + _DETOUR * distance[cell]
    to_go[steps, target] = 0.0
    parked[steps] = 0.0
    lanes = lattice.lanes
    column = start // lanes
    for t in range(steps - 1, -1, -1):
        parked[t] = parked[t + 1] + price_of(row, weight, t, 0, target)
        # Nobody gets further than one column a step.
        for cell in range(max(0, column - t) * lanes, min(cells, (column + t + 1) * lanes)):
            best = np.inf
            for d in range(displacements):
                if valid[d, cell]:
                    total = 1.0 + to_go[t + 1, cell + step[d]]
                    if d != 0:
                        total += PER_MOVE
                    # Written out, as in `relaxation_kernel._step_back`.
                    for m in range(most_rows):
                        r = row[d, cell, m]
                        if r < 0:
                            break
                        total += weight[t, r]
                    best = min(best, total)
            to_go[t, cell] = best
        to_go[t, target] = min(to_go[t, target], parked[t])
    way[:] = PARKED
    cell = start
    for t in range(steps):
        if cell == target and parked[t] <= to_go[t, cell]:
            return t
        best, choice = np.inf, 0
        for d in range(displacements):
            if valid[d, cell]:
                total = 1.0 + price_of(row, weight, t, d, cell) + to_go[t + 1, cell + step[d]]
                if d != 0:
                    total += PER_MOVE
                if total < best:
                    best, choice = total, d
        way[t] = choice
        cell += step[choice]
    return steps if cell == target else NOT_IN_TIME


@njit(cache=True)
def add_uses(lattice, start, way, use, times):
    """Count the rows that a vehicle uses, or take them back."""
    row, step = lattice.row, lattice.step
    cell = start
    for t in range(len(way)):
        d = max(way[t], 0)
        for m in range(row.shape[2]):
            r = row[d, cell, m]
            if r < 0:
                break
            use[t, r] += times
        cell += step[d]


@njit(cache=True)
def _is_contested(lattice, start, way, use):
    row, step = lattice.row, lattice.step
    cell = start
    for t in range(len(way)):
        d = max(way[t], 0)
        for m in range(row.shape[2]):
            r = row[d, cell, m]
            if r < 0:
                break
            if use[t, r] > 1.5:
                return True
        cell += step[d]
    return False


@njit(cache=True)
def _shuffle(items, random):
    for i in range(len(items) - 1, 0, -1):
        j = random_below(random, i + 1)
        items[i], items[j] = items[j], items[i]


@njit(cache=True, nogil=True)
def negotiate(lattice, teams, trial, number):
    """Do one pass of negotiation, counted from 0; return whether it is settled.

    All vehicles on contested rows look for other ways, one after the other.
    """
    use, memory, weight = trial.use, trial.memory, trial.weight
    steps, rows = use.shape
    price = min(_FIRST_PRICE * _GROWTH**number, _HIGHEST_PRICE)
    order = np.arange(len(teams.start))
    _shuffle(order, trial.random)
    for i in order:
        if number > 0:
            late = trial.cost[i] >= NOT_IN_TIME
            if not late and not _is_contested(lattice, teams.start[i], trial.way[i], use):
                continue
            add_uses(lattice, teams.start[i], trial.way[i], use, -1.0)
        for t in range(steps):
            for row in range(rows):
                weight[t, row] = memory[t, row] + price * use[t, row]
        _find_way(lattice, teams, trial, i)
        add_uses(lattice, teams.start[i], trial.way[i], use, 1.0)
    settled = trial.cost.max() < NOT_IN_TIME
    for t in range(steps):
        for row in range(rows):
            if use[t, row] > 1.5:
                settled = False
                memory[t, row] += _MEMORY * (use[t, row] - 1.0)
    return settled


@njit(cache=True)
def _find_way(lattice, teams, trial, i):
    pair = teams.pair[teams.team[i], trial.target[i]]
    trial.cost[i] = _cheapest_way(
        lattice,
        trial.weight,
        teams.distance[:, pair],
        teams.start[i],
        teams.pair_cell[pair],
        trial.to_go,
        trial.parked,
        trial.way[i],
    )


@njit(cache=True, nogil=True)
def improve_ways(lattice, teams, trial, attempts, most):
    """Take a few vehicles out, let them negotiate, and keep what is not worse; so many times.

    Returns how many attempts came after the last one that made it cheaper.
    """
    start, team, pair, target = teams.start, teams.team, teams.pair, trial.target
    use, way, cost = trial.use, trial.way, trial.cost
    vehicles = len(start)
    score = np.empty(vehicles)
    old_way, old_cost, old_target = way.copy(), cost.copy(), target.copy()
    idle = 0
    for _ in range(attempts):
        idle += 1
        size = min(2 + random_below(trial.random, most - 1), vehicles)
        seed = random_below(trial.random, vehicles)
        middle = start[seed] + teams.target[target[seed]]
        for i in range(vehicles):
            delay = cost[i] - teams.distance[start[i], pair[team[i], target[i]]]
            away = 0.5 * abs(start[i] + teams.target[target[i]] - middle)
            chance = _NEARNESS * random_below(trial.random, 1000) / 1000.0
            score[i] = away + chance - _DELAY_COUNTS * delay
        score[seed] = -np.inf
        chosen = np.argsort(score)[:size]
        before = 0
        for i in chosen:
            before += cost[i]
            old_way[i], old_cost[i], old_target[i] = way[i], cost[i], target[i]
            add_uses(lattice, start[i], way[i], use, -1.0)
        if random_below(trial.random, 100) < _SWAP_SHARE:
            for i in chosen:
                j = chosen[random_below(trial.random, size)]
                if pair[team[i], target[j]] >= 0 and pair[team[j], target[i]] >= 0:
                    target[i], target[j] = target[j], target[i]
        least = 0.0
        for i in chosen:
            least += teams.distance[start[i], pair[team[i], target[i]]]
        solved = least <= before and _negotiate_among(lattice, teams, trial, chosen, before)
        after = 0
        for i in chosen:
            if not solved:
                way[i], cost[i], target[i] = old_way[i], old_cost[i], old_target[i]
            after += cost[i]
            add_uses(lattice, start[i], way[i], use, 1.0)
        if after < before:
            idle = 0
    return idle


@njit(cache=True)
def _negotiate_among(lattice, teams, trial, chosen, most):
    """Let vehicles that were taken out negotiate; what the others use is taken."""
    use, own, memory, weight = trial.use, trial.own, trial.memory, trial.weight
    way, start, cost = trial.way, teams.start, trial.cost
    steps, rows = use.shape
    own[:] = 0.0
    memory[:] = 0.0
    order = chosen.copy()
    price = 1.0
    for number in range(_ROUNDS):
        _shuffle(order, trial.random)
        for i in order:
            if number > 0:
                if not _is_contested(lattice, start[i], way[i], own):
                    continue
                add_uses(lattice, start[i], way[i], own, -1.0)
            for t in range(steps):
                for row in range(rows):
                    taken = NOT_IN_TIME * use[t, row]
                    weight[t, row] = taken + memory[t, row] + price * own[t, row]
            _find_way(lattice, teams, trial, i)
            if trial.to_go[0, start[i]] >= NOT_IN_TIME:
                return False
            add_uses(lattice, start[i], way[i], own, 1.0)
        total = 0
        for i in chosen:
            total += cost[i]
        if total > most:
            return False
        solved = True
        for t in range(steps):
            for row in range(rows):
                if own[t, row] > 1.5:
                    solved = False
                    memory[t, row] += _ROUND_MEMORY
        if solved:
            return True
        price *= _ROUND_GROWTH
    return False
