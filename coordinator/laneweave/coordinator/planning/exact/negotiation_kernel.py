"""Compiled code of `negotiation`; see `multipliers_kernel` for its style."""

from __future__ import annotations

import numpy as np
from numba import njit

from laneweave.coordinator.planning.exact.multipliers_kernel import PARKED, PER_MOVE, penalty_of
from laneweave.coordinator.planning.random_kernel import random_below

NOT_IN_TIME = 1_000_000
"""Cost of failing to arrive within the horizon, and of a clique used by a fixed vehicle."""
_DETOUR = 10.0
"""Cost of each step on the way to a target that is too far for the remaining steps."""
_FIRST_COST, _GROWTH, _MAX_COST = 2.0, 1.01, 50.0
"""Cost of a clique that another vehicle uses: initial value, growth per pass, maximum."""
_HISTORY = 1.0
"""Permanent cost that each excess use adds to a clique in each pass."""
_ROUNDS, _ROUND_GROWTH, _ROUND_HISTORY = 10, 1.5, 0.5
"""Passes, cost growth and permanent cost when only removed vehicles negotiate."""
_BLUR = 15.0
_DELAY_WEIGHT = 0.5
_SWAP_SHARE = 60
"""Percentage of attempts in which vehicles may exchange eligible targets."""


@njit(cache=True)
def _find_path(arrays, teams, candidate, i, steps):
    """Set one vehicle's cheapest path at the current clique costs, and the cost of the path.

    steps: maximum number of steps until its arrival.
    """
    valid, step, clique = teams.drives[teams.team[i]], arrays.step, arrays.clique
    weight, cost_to_go, parked = candidate.weight, candidate.cost_to_go, candidate.parked
    pair = teams.pair[teams.team[i], candidate.target[i]]
    start, target, distance = teams.start[i], teams.pair_cell[pair], teams.distance[:, pair]
    path = candidate.path[i]
    displacements, cells = valid.shape
    max_cliques = clique.shape[2]
    parked[len(weight)] = 0.0
    for t in range(len(weight) - 1, -1, -1):
        parked[t] = parked[t + 1] + penalty_of(clique, weight, t, 0, target)
    for cell in range(cells):
        cost_to_go[steps, cell] = NOT_IN_TIME + _DETOUR * distance[cell]
    cost_to_go[steps, target] = parked[steps]
    lanes = arrays.lanes
    column = start // lanes
    for t in range(steps - 1, -1, -1):
        # A vehicle moves at most one column per step.
        for cell in range(max(0, column - t) * lanes, min(cells, (column + t + 1) * lanes)):
            if distance[cell] > steps - t:
                cost_to_go[t, cell] = NOT_IN_TIME + _DETOUR * distance[cell]
                continue
            best = np.inf
            for d in range(displacements):
                if valid[d, cell]:
                    total = 1.0 + cost_to_go[t + 1, cell + step[d]]
                    if d != 0:
                        total += PER_MOVE
                    # Inlined, as in `multipliers_kernel._relax_moves`.
                    for m in range(max_cliques):
                        r = clique[d, cell, m]
                        if r < 0:
                            break
                        total += weight[t, r]
                    best = min(best, total)
            cost_to_go[t, cell] = best
        cost_to_go[t, target] = min(cost_to_go[t, target], parked[t])
    path[:] = PARKED
    cell = start
    for t in range(steps):
        if cell == target and parked[t] <= cost_to_go[t, cell]:
            candidate.cost[i] = t
            return
        best, choice = np.inf, 0
        for d in range(displacements):
            if valid[d, cell]:
                total = (
                    1.0 + penalty_of(clique, weight, t, d, cell) + cost_to_go[t + 1, cell + step[d]]
                )
                if d != 0:
                    total += PER_MOVE
                if total < best:
                    best, choice = total, d
        path[t] = choice
        cell += step[choice]
    candidate.cost[i] = steps if cell == target else NOT_IN_TIME


@njit(cache=True)
def add_uses(arrays, start, path, use, amount):
    """Add an amount to the number of uses, or to the weight, of each clique on a path."""
    clique, step = arrays.clique, arrays.step
    cell = start
    for t in range(len(path)):
        d = max(path[t], 0)
        for m in range(clique.shape[2]):
            r = clique[d, cell, m]
            if r < 0:
                break
            use[t, r] += amount
        cell += step[d]


@njit(cache=True)
def _is_contested(arrays, start, path, use):
    clique, step = arrays.clique, arrays.step
    cell = start
    for t in range(len(path)):
        d = max(path[t], 0)
        for m in range(clique.shape[2]):
            r = clique[d, cell, m]
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
def negotiate(arrays, teams, candidate, number):
    """Run pass `number` (from 0) of a negotiation; return whether a path set was found.

    Pass 0 routes all vehicles, one after another; later passes reroute those that are late or on
    contested cliques.
    """
    use, history, weight = candidate.use, candidate.history, candidate.weight
    steps, cliques = use.shape
    cost = min(_FIRST_COST * _GROWTH**number, _MAX_COST)
    order = np.arange(len(teams.start))
    _shuffle(order, candidate.random)
    for t in range(steps):
        for clique in range(cliques):
            weight[t, clique] = history[t, clique] + cost * use[t, clique]
    for i in order:
        if number > 0:
            late = candidate.cost[i] >= NOT_IN_TIME
            if not late and not _is_contested(arrays, teams.start[i], candidate.path[i], use):
                continue
            add_uses(arrays, teams.start[i], candidate.path[i], use, -1.0)
            add_uses(arrays, teams.start[i], candidate.path[i], weight, -cost)
        _find_path(arrays, teams, candidate, i, steps)
        add_uses(arrays, teams.start[i], candidate.path[i], use, 1.0)
        add_uses(arrays, teams.start[i], candidate.path[i], weight, cost)
    conflict_free = candidate.cost.max() < NOT_IN_TIME
    for t in range(steps):
        for clique in range(cliques):
            if use[t, clique] > 1.5:
                conflict_free = False
                history[t, clique] += _HISTORY * (use[t, clique] - 1.0)
    return conflict_free


@njit(cache=True, nogil=True)
def improve_paths(arrays, teams, candidate, attempts, max_size):
    """In each attempt, let a few vehicles negotiate new paths; undo it if the result is worse.

    Returns the number of attempts since the last improvement.
    """
    start, team, pair, target = teams.start, teams.team, teams.pair, candidate.target
    use, path, cost = candidate.use, candidate.path, candidate.cost
    vehicles = len(start)
    score = np.empty(vehicles)
    old_path, old_cost, old_target = path.copy(), cost.copy(), target.copy()
    idle = 0
    for _ in range(attempts):
        idle += 1
        size = min(2 + random_below(candidate.random, max_size - 1), vehicles)
        seed = random_below(candidate.random, vehicles)
        middle = start[seed] + teams.target[target[seed]]
        for i in range(vehicles):
            delay = cost[i] - teams.distance[start[i], pair[team[i], target[i]]]
            away = 0.5 * abs(start[i] + teams.target[target[i]] - middle)
            chance = _BLUR * random_below(candidate.random, 1000) / 1000.0
            score[i] = away + chance - _DELAY_WEIGHT * delay
        score[seed] = -np.inf
        chosen = np.argsort(score)[:size]
        before = 0
        for i in chosen:
            before += cost[i]
            old_path[i], old_cost[i], old_target[i] = path[i], cost[i], target[i]
            add_uses(arrays, start[i], path[i], use, -1.0)
        if random_below(candidate.random, 100) < _SWAP_SHARE:
            for i in chosen:
                j = chosen[random_below(candidate.random, size)]
                if pair[team[i], target[j]] >= 0 and pair[team[j], target[i]] >= 0:
                    target[i], target[j] = target[j], target[i]
        shortest = 0.0
        for i in chosen:
            shortest += teams.distance[start[i], pair[team[i], target[i]]]
        solved = shortest <= before and _negotiate_among(
            arrays, teams, candidate, chosen, before, before - shortest
        )
        after = 0
        for i in chosen:
            if not solved:
                path[i], cost[i], target[i] = old_path[i], old_cost[i], old_target[i]
            after += cost[i]
            add_uses(arrays, start[i], path[i], use, 1.0)
        if after < before:
            idle = 0
    return idle


@njit(cache=True)
def _negotiate_among(arrays, teams, candidate, chosen, max_cost, max_delay):
    """Negotiate paths for removed vehicles around fixed others; return whether it succeeded.

    max_cost: maximum sum of their costs.
    max_delay: `max_cost` minus the costs of their shortest paths, the longest delay of one vehicle.
    """
    use, own, weight = candidate.use, candidate.own, candidate.weight
    path, start, cost, pair = candidate.path, teams.start, candidate.cost, teams.pair
    steps, cliques = use.shape
    own[:] = 0.0
    for t in range(steps):
        for clique in range(cliques):
            weight[t, clique] = NOT_IN_TIME * use[t, clique]
    order = chosen.copy()
    cost_of_use = 1.0
    for number in range(_ROUNDS):
        _shuffle(order, candidate.random)
        for i in order:
            if number > 0:
                if not _is_contested(arrays, start[i], path[i], own):
                    continue
                add_uses(arrays, start[i], path[i], own, -1.0)
                add_uses(arrays, start[i], path[i], weight, -cost_of_use)
            shortest = teams.distance[start[i], pair[teams.team[i], candidate.target[i]]]
            max_steps = min(steps, int(shortest + max_delay))
            _find_path(arrays, teams, candidate, i, max_steps)
            if candidate.cost_to_go[0, start[i]] >= NOT_IN_TIME:
                return False
            add_uses(arrays, start[i], path[i], own, 1.0)
            add_uses(arrays, start[i], path[i], weight, cost_of_use)
        total = 0
        for i in chosen:
            total += cost[i]
        if total > max_cost:
            return False
        solved = True
        added_cost = (_ROUND_GROWTH - 1.0) * cost_of_use
        for t in range(steps):
            for clique in range(cliques):
                weight[t, clique] += added_cost * own[t, clique]
                if own[t, clique] > 1.5:
                    solved = False
                    weight[t, clique] += _ROUND_HISTORY
        if solved:
            return True
        cost_of_use *= _ROUND_GROWTH
    return False
