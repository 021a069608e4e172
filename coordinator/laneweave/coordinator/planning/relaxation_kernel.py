"""Compiled code of `relaxation`; see `sweep_kernel` for its style."""

from __future__ import annotations

import numpy as np
from numba import njit

from laneweave.coordinator.planning.arrays import UNREACHABLE

ARRIVED = -1
"""In a table of decisions: the vehicle has arrived for good."""
_TOLERANCE = 1e-6
_MOMENTUM = 0.6
_STEP = 0.6
_PATIENCE = 12
"""After so many iterations without a better bound the steps become shorter."""
_SHORTER = 0.6
_SHORTEST = 0.0005


@njit(cache=True)
def improve_prices(lattice, teams, prices, best_prices, direction, memory, iterations):
    """Go on with a subgradient method; see `relaxation.Subgradient` for what it changes.

    memory: the best bound, the factor of the step length, iterations without a better bound.
    """
    steps, rows = prices.shape
    goals = len(teams.target)
    to_go = np.empty((steps + 1, goals, lattice.valid.shape[1]))
    decision = np.empty((steps, goals, lattice.valid.shape[1]), np.int8)
    matching = np.empty(goals, np.int64)
    worth = np.empty(goals)
    excess = np.empty((steps, rows))
    for _ in range(iterations):
        _look_back(lattice, teams, prices, to_go, decision)
        bound = _match(teams, to_go[0], matching, worth) - prices.sum()
        if bound > 0.5 * UNREACHABLE:
            memory[0] = UNREACHABLE
            return
        _use_of_rows(lattice, teams, decision, matching, excess)
        square = 0.0
        for t in range(steps):
            for row in range(rows):
                over = excess[t, row] - 1.0
                if over < 0.0 and prices[t, row] <= 0.0:
                    over = 0.0
                excess[t, row] = over
                square += over * over
        memory[2] = 0.0 if bound > memory[0] + 0.01 else memory[2] + 1.0
        if bound > memory[0]:
            memory[0] = bound
            best_prices[:] = prices
        if square == 0.0:
            return
        if memory[2] >= _PATIENCE:
            memory[1] = max(_SHORTER * memory[1], _SHORTEST)
            memory[2] = 0.0
            prices[:] = best_prices
            direction[:] = 0.0
            continue
        # The method wants the best possible bound; a guess does, if it is a little too high.
        goal = 1.12 * memory[0] + 2.0
        factor = _STEP * memory[1] * (goal - bound) / square
        for t in range(steps):
            for row in range(rows):
                change = _MOMENTUM * direction[t, row] + excess[t, row]
                direction[t, row] = change
                if change != 0.0:
                    prices[t, row] = max(prices[t, row] + factor * change, 0.0)


@njit(cache=True)
def _price(rows, prices, t, d, cell):
    """Return what a move pays in a step; `rows` are those of the lattice."""
    total = 0.0
    for m in range(rows.shape[2]):
        row = rows[d, cell, m]
        if row < 0:
            break
        total += prices[t, row]
    return total


@njit(cache=True)
def _look_back(lattice, teams, prices, to_go, decision):
    """Fill in the least priced cost from each cell before each step to each target.

    Every step until the final arrival costs 1. Who has arrived waits, which pays for rows, too.
    """
    steps = len(prices)
    valid, step, rows, targets = lattice.valid, lattice.step, lattice.row, teams.target
    displacements, cells = valid.shape
    price = np.empty((displacements, cells))
    to_go[steps] = teams.distance
    stay = np.zeros(len(targets))
    for t in range(steps - 1, -1, -1):
        for d in range(displacements):
            for cell in range(cells):
                if valid[d, cell]:
                    price[d, cell] = _price(rows, prices, t, d, cell)
        for j in range(len(targets)):
            for cell in range(cells):
                least, choice = UNREACHABLE, 0
                for d in range(displacements):
                    if valid[d, cell]:
                        total = price[d, cell] + to_go[t + 1, j, cell + step[d]]
                        if total < least - 1e-12:
                            least, choice = total, d
                to_go[t, j, cell] = min(least + 1.0, UNREACHABLE)
                decision[t, j, cell] = choice
            target = targets[j]
            stay[j] += price[0, target]
            if stay[j] <= to_go[t, j, target]:
                to_go[t, j, target] = stay[j]
                decision[t, j, target] = ARRIVED


@njit(cache=True)
def _match(teams, cost_of_way, matching, worth):
    """Assign targets at least cost; fill in each target's vehicle (or -1) and dual value.

    Successive shortest paths with potentials (Jonker and Volgenant, Computing 38, 1987).
    """
    start, team, eligible = teams.start, teams.team, teams.eligible
    vehicles, goals = len(start), len(matching)
    value = np.zeros(vehicles + 1)
    worth_ = np.zeros(goals + 1)
    holder = np.full(goals + 1, -1)
    came_from = np.zeros(goals + 1, np.int64)
    slack = np.empty(goals + 1)
    done = np.empty(goals + 1, np.bool_)
    for vehicle in range(vehicles):
        holder[goals] = vehicle
        at = goals
        slack[:] = np.inf
        done[:] = False
        while holder[at] >= 0:
            done[at] = True
            i = holder[at]
            least, then = np.inf, -1
            for j in range(goals):
                if done[j]:
                    continue
                cost = UNREACHABLE
                if eligible[team[i], j]:
                    cost = cost_of_way[j, start[i]]
                length = cost - value[i] - worth_[j]
                if length < slack[j]:
                    slack[j] = length
                    came_from[j] = at
                if slack[j] < least:
                    least, then = slack[j], j
            for j in range(goals + 1):
                if done[j]:
                    value[holder[j]] += least
                    worth_[j] -= least
                else:
                    slack[j] -= least
            at = then
        while at != goals:
            before = came_from[at]
            holder[at] = holder[before]
            at = before
    total = 0.0
    for j in range(goals):
        matching[j] = holder[j]
        worth[j] = worth_[j]
        if holder[j] >= 0:
            total += cost_of_way[j, start[holder[j]]]
            if not eligible[team[holder[j]], j]:
                total = UNREACHABLE
    return min(total, UNREACHABLE)


@njit(cache=True)
def _use_of_rows(lattice, teams, decision, matching, use):
    """Count the moves in each row when each vehicle takes its way."""
    steps = len(decision)
    rows, step = lattice.row, lattice.step
    use[:] = 0.0
    for j in range(len(matching)):
        if matching[j] < 0:
            continue
        cell = teams.start[matching[j]]
        arrived = False
        for t in range(steps):
            d = decision[t, j, cell]
            arrived = arrived or d == ARRIVED
            if arrived:
                d = 0
            for m in range(rows.shape[2]):
                row = rows[d, cell, m]
                if row < 0:
                    break
                use[t, row] += 1.0
            cell += step[d]


@njit(cache=True)
def penalties_of(lattice, teams, prices):
    """Return bound, reduced costs and the targets' worth; see `relaxation.penalties`."""
    steps = len(prices)
    valid, step, rows, eligible = lattice.valid, lattice.step, lattice.row, teams.eligible
    displacements, cells = valid.shape
    groups, goals = eligible.shape
    to_go = np.empty((steps + 1, goals, cells))
    decision = np.empty((steps, goals, cells), np.int8)
    matching = np.empty(goals, np.int64)
    worth = np.empty(goals)
    _look_back(lattice, teams, prices, to_go, decision)
    bound = _match(teams, to_go[0], matching, worth) - prices.sum()
    least = np.full((groups, steps + 1, cells), UNREACHABLE)
    for k in range(groups):
        for t in range(steps + 1):
            for j in range(goals):
                if eligible[k, j]:
                    for cell in range(cells):
                        least[k, t, cell] = min(least[k, t, cell], to_go[t, j, cell] - worth[j])
    move = np.full((groups, steps, displacements, cells), UNREACHABLE)
    arrival = np.full((groups, goals, steps + 1), UNREACHABLE)
    reach = np.full((groups, steps + 1, cells), UNREACHABLE)
    for i in range(len(teams.start)):
        reach[teams.team[i], 0, teams.start[i]] = 0.0
    for k in range(groups):
        for t in range(steps):
            for d in range(displacements):
                for cell in range(cells):
                    if not valid[d, cell]:
                        continue
                    then = cell + step[d]
                    if least[k, t + 1, then] > 0.5 * UNREACHABLE:
                        continue
                    extra = 1.0 + _price(rows, prices, t, d, cell)
                    extra += least[k, t + 1, then] - least[k, t, cell]
                    move[k, t, d, cell] = max(extra, 0.0)
                    sum_ = reach[k, t, cell] + move[k, t, d, cell]
                    reach[k, t + 1, then] = min(reach[k, t + 1, then], sum_)
        for j in range(goals):
            if not eligible[k, j]:
                continue
            target = teams.target[j]
            stay = 0.0
            for t in range(steps, -1, -1):
                if t < steps:
                    stay += _price(rows, prices, t, 0, target)
                arrival[k, j, t] = max(stay - worth[j] - least[k, t, target], 0.0)
    return bound, move, arrival, reach, worth
