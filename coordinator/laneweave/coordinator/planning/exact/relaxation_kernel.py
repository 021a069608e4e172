"""Compiled code of `relaxation`.

Types are those of `arrays` and `relaxation`; numba compiles for what it is called with. Arrays are
taken out of their tuples before loops, and inner loops are functions of their own: without that
they take five times as long.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from laneweave.coordinator.planning.exact.arrays_kernel import UNREACHABLE

PER_MOVE = 1e-5
"""Added to the cost of each move that is not a wait: of equal costs the fewest moves win."""
PARKED = -1
"""In a way: the vehicle has arrived for good."""
REFUTED, FOUND, OPEN = 0, 1, 2
"""No solution below the ceiling; a solution below it; neither is known yet."""
BOUND, PACE, STALE, WEIGHT, WEIGHTS, BEST = range(6)
"""Places in the memory of `improve`: the best bound, the factor of the step length, iterations
without a better bound, the weight of the next relaxed solution, the sum of all weights, the value
of the best solution that happened to be free of conflicts."""
_HALF = 0.5 * UNREACHABLE
_TOLERANCE = 1e-7
_MOMENTUM = 0.6
_STEP = 0.6
_PATIENCE = 12
"""After so many iterations without a better bound the steps become shorter."""
_SHORTER, _SHORTEST = 0.6, 0.0005
_FADING = 0.92
"""Weight of a relaxed solution, relative to the next one."""


@njit(cache=True, nogil=True)
def list_moves(lattice, allowed, scratch):
    """List the allowed moves of every step; return their number and the steps there are any in."""
    teams, steps, displacements, cells = allowed.shape
    move, move_from, step = scratch.move, scratch.move_from, lattice.step
    count, span = 0, 0
    for t in range(steps):
        for k in range(teams):
            move_from[t, k] = count
            for cell in range(cells):
                for d in range(displacements):
                    if allowed[k, t, d, cell]:
                        move[count, 0] = d
                        move[count, 1] = cell
                        move[count, 2] = cell + step[d]
                        count += 1
        move_from[t, teams] = count
        if count > move_from[t, 0]:
            span = t + 1
    return count, span


@njit(cache=True, nogil=True)
def forbid_taken(lattice, teams, taken, allowed, first):
    """Forbid the moves that use a row which is taken, and arrivals before such a wait."""
    row = lattice.row
    displacements, cells, most_rows = row.shape
    for t in range(len(taken)):
        for d in range(displacements):
            for cell in range(cells):
                for m in range(most_rows):
                    r = row[d, cell, m]
                    if r < 0:
                        break
                    if taken[t, r]:
                        allowed[:, t, d, cell] = False
                        if d == 0:
                            for p in range(len(first)):
                                if teams.pair_cell[p] == cell:
                                    first[p] = t + 1
                        break


@njit(cache=True, nogil=True)
def start_over(prices, span, scratch, memory):
    """Begin to improve prices; there are none where nobody can move any more."""
    prices[span:] = 0.0
    scratch.present[:] = prices
    scratch.direction[:] = 0.0
    scratch.mass[:] = 0.0
    memory[BOUND], memory[STALE], memory[WEIGHT], memory[WEIGHTS] = -UNREACHABLE, 0.0, 1.0, 0.0


@njit(cache=True, nogil=True)
def improve(lattice, teams, allowed, first, prices, span, scratch, memory, count, ceiling, goal):
    """Go on with a subgradient method, until the ceiling is passed or a solution below it is found.

    goal: the value that the steps aim at; negative: guess.
    """
    rows = prices.shape[1]
    present, direction, use = scratch.present, scratch.direction, scratch.use
    for _ in range(count):
        bound = evaluate(lattice, teams, first, present, span, scratch)
        if bound > _HALF:
            memory[BOUND] = UNREACHABLE
            return REFUTED
        memory[STALE] = 0.0 if bound > memory[BOUND] + 0.01 else memory[STALE] + 1.0
        if bound > memory[BOUND]:
            memory[BOUND] = bound
            prices[:] = present
            if bound > ceiling:
                return REFUTED
        value, arrived = _walk(lattice, teams, allowed, first, present, span, scratch, memory)
        clash, square = _excess(present, use, span)
        if not clash and arrived and value < memory[BEST] - _TOLERANCE:
            memory[BEST] = value
            scratch.best_way[:] = scratch.way
        if memory[BEST] <= ceiling < _HALF:
            return FOUND
        if square == 0.0:
            return OPEN
        if memory[STALE] >= _PATIENCE:
            memory[PACE] = max(_SHORTER * memory[PACE], _SHORTEST)
            memory[STALE] = 0.0
            present[:] = prices
            direction[:] = 0.0
            continue
        aim = goal if goal >= 0.0 else 1.12 * max(memory[BOUND], 0.0) + 2.0
        factor = _STEP * memory[PACE] * (aim - bound) / square
        for t in range(span):
            for row in range(rows):
                change = _MOMENTUM * direction[t, row] + use[t, row]
                direction[t, row] = change
                if change != 0.0:
                    present[t, row] = max(present[t, row] + factor * change, 0.0)
    return OPEN


@njit(cache=True, nogil=True)
def evaluate(lattice, teams, first, prices, span, scratch):
    """Return the bound at some prices; fills in costs to go and the assignment."""
    _look_back(lattice, teams, first, prices, span, scratch)
    total = 0.0
    for t in range(span):
        for row in range(prices.shape[1]):
            total += prices[t, row]
    return _match(teams, scratch) - total


@njit(cache=True)
def _look_back(lattice, teams, first, prices, span, scratch):
    """Fill in the least priced cost from each cell before each step to the target of each pair.

    Every step until the final arrival costs 1. Who has arrived waits, which pays for rows, too.
    """
    to_go, parked = scratch.to_go, scratch.parked
    move, move_from, move_price = scratch.move, scratch.move_from, scratch.move_price
    row, cell_of, pairs_from = lattice.row, teams.pair_cell, teams.pairs_from
    parked[span] = 0.0
    if span == len(prices):
        to_go[span] = teams.distance
    else:
        to_go[span] = UNREACHABLE
        for p in range(len(cell_of)):
            if first[p] <= span:
                to_go[span, cell_of[p], p] = 0.0
    for t in range(span - 1, -1, -1):
        to_go[t] = UNREACHABLE
        for k in range(len(pairs_from) - 1):
            _step_back(
                move,
                move_price,
                move_from[t, k],
                move_from[t, k + 1],
                pairs_from[k],
                pairs_from[k + 1],
                row,
                prices[t],
                to_go[t],
                to_go[t + 1],
            )
        for p in range(len(cell_of)):
            cell = cell_of[p]
            stay = parked[t + 1, p] + price_of(row, prices, t, 0, cell)
            parked[t, p] = stay
            if t >= first[p] and stay <= to_go[t, cell, p]:
                to_go[t, cell, p] = stay


@njit(cache=True)
def _step_back(move, move_price, begin, end, first_pair, end_pair, row, prices, here, then):
    # The sum of prices is written out: as a call it takes four times as long.
    most_rows = row.shape[2]
    for m in range(begin, end):
        d, cell, next_cell = move[m, 0], move[m, 1], move[m, 2]
        price = 1.0
        if d != 0:
            price += PER_MOVE
        for n in range(most_rows):
            r = row[d, cell, n]
            if r < 0:
                break
            price += prices[r]
        move_price[m] = price
        for p in range(first_pair, end_pair):
            total = price + then[next_cell, p]
            if total < here[cell, p]:
                here[cell, p] = total


@njit(cache=True)
def price_of(row, prices, t, d, cell):
    """Return the sum of the prices of the rows that a move is in."""
    total = 0.0
    for m in range(row.shape[2]):
        r = row[d, cell, m]
        if r < 0:
            break
        total += prices[t, r]
    return total


@njit(cache=True)
def _match(teams, scratch):
    """Assign targets at least cost; fill in each target's vehicle (or -1) and dual value.

    Successive shortest paths with potentials (Jonker and Volgenant, Computing 38, 1987).
    """
    to_go, start, pair = scratch.to_go, teams.start, teams.pair
    cost, holder_of, worth_of = scratch.cost, scratch.holder, scratch.worth
    vehicles, goals = cost.shape
    for i in range(vehicles):
        for j in range(goals):
            p = pair[teams.team[i], j]
            cost[i, j] = to_go[0, start[i], p] if p >= 0 else UNREACHABLE
    value = np.zeros(vehicles + 1)
    worth = np.zeros(goals + 1)
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
                length = cost[i, j] - value[i] - worth[j]
                if length < slack[j]:
                    slack[j] = length
                    came_from[j] = at
                if slack[j] < least:
                    least, then = slack[j], j
            for j in range(goals + 1):
                if done[j]:
                    value[holder[j]] += least
                    worth[j] -= least
                else:
                    slack[j] -= least
            at = then
        while at != goals:
            before = came_from[at]
            holder[at] = holder[before]
            at = before
    total = 0.0
    for j in range(goals):
        holder_of[j], worth_of[j] = holder[j], worth[j]
        if holder[j] >= 0:
            total += cost[holder[j], j]
    return min(total, UNREACHABLE)


@njit(cache=True)
def _walk(lattice, teams, allowed, first, prices, span, scratch, memory):
    """Let each vehicle take its cheapest way; count the uses of rows and add up masses.

    Returns the cost of all, and whether all have arrived in the end.
    """
    row, step, to_go, parked = lattice.row, lattice.step, scratch.to_go, scratch.parked
    use, mass, way = scratch.use, scratch.mass, scratch.way
    weight = memory[WEIGHT]
    use[:] = 0.0
    way[:] = PARKED
    value, all_arrived = 0.0, True
    for j in range(len(scratch.holder)):
        i = scratch.holder[j]
        if i < 0:
            continue
        k, cell = teams.team[i], teams.start[i]
        p = teams.pair[k, j]
        target = teams.pair_cell[p]
        arrived = False
        for t in range(span):
            if cell == target and t >= first[p] and parked[t, p] <= to_go[t, cell, p]:
                arrived = True
            d = 0
            if not arrived:
                least = np.inf
                for e in range(len(step)):
                    if allowed[k, t, e, cell]:
                        total = price_of(row, prices, t, e, cell) + to_go[t + 1, cell + step[e], p]
                        if e != 0:
                            total += PER_MOVE
                        if total < least - 1e-12:
                            least, d = total, e
                way[i, t] = d
                value += 1.0
                if d != 0:
                    value += PER_MOVE
            mass[k, t, d, cell] += weight
            for m in range(row.shape[2]):
                r = row[d, cell, m]
                if r < 0:
                    break
                use[t, r] += 1.0
            cell += step[d]
        all_arrived = all_arrived and cell == target
    memory[WEIGHTS] += weight
    memory[WEIGHT] = weight / _FADING
    return value, all_arrived


@njit(cache=True)
def _excess(prices, use, span):
    """Turn uses of rows into a subgradient; return whether one is used twice, and its square."""
    clash, square = False, 0.0
    for t in range(span):
        for row in range(use.shape[1]):
            over = use[t, row] - 1.0
            if over > 0.0:
                clash = True
            elif prices[t, row] <= 0.0:
                over = 0.0
            use[t, row] = over
            square += over * over
    return clash, square


@njit(cache=True, nogil=True)
def forbid_dear(lattice, teams, allowed, first, prices, span, scratch, ceiling):
    """Forbid what no solution below the ceiling contains.

    Returns the bound and how many of the listed moves are still allowed. `scratch.reach` tells then
    how much more than the bound it costs at least to be in a cell before a step.
    """
    groups, cells = len(allowed), allowed.shape[3]
    bound = evaluate(lattice, teams, first, prices, span, scratch)
    budget = ceiling - bound + _TOLERANCE
    to_go, parked, least, reach = scratch.to_go, scratch.parked, scratch.least, scratch.reach
    move, move_from, move_price = scratch.move, scratch.move_from, scratch.move_price
    worth, pair_target = scratch.worth, teams.pair_target
    for k in range(groups):
        begin, end = teams.pairs_from[k], teams.pairs_from[k + 1]
        for t in range(span + 1):
            for cell in range(cells):
                value = UNREACHABLE
                for p in range(begin, end):
                    value = min(value, to_go[t, cell, p] - worth[pair_target[p]])
                least[k, t, cell] = value
    reach[:] = UNREACHABLE
    for i in range(len(teams.start)):
        reach[teams.team[i], 0, teams.start[i]] = 0.0
    kept = 0
    for t in range(span):
        for k in range(groups):
            for m in range(move_from[t, k], move_from[t, k + 1]):
                d, cell, next_cell = move[m, 0], move[m, 1], move[m, 2]
                extra = move_price[m] + least[k, t + 1, next_cell] - least[k, t, cell]
                total = reach[k, t, cell] + max(extra, 0.0)
                if total > budget or least[k, t + 1, next_cell] > _HALF:
                    allowed[k, t, d, cell] = False
                    continue
                kept += 1
                if total < reach[k, t + 1, next_cell]:
                    reach[k, t + 1, next_cell] = total
    for k in range(groups):
        for p in range(teams.pairs_from[k], teams.pairs_from[k + 1]):
            cell, worth_of = teams.pair_cell[p], worth[pair_target[p]]
            t = first[p]
            while t < span:
                extra = parked[t, p] - worth_of - least[k, t, cell]
                if reach[k, t, cell] + max(extra, 0.0) <= budget:
                    break
                t += 1
            first[p] = t
    return bound, kept


@njit(cache=True, nogil=True)
def may_be_late(teams, steps, scratch, budget):
    """Tell whether some vehicle may be away from its targets after all steps, within a budget."""
    reach = scratch.reach
    for k in range(len(reach)):
        for cell in range(reach.shape[2]):
            if reach[k, steps, cell] > budget:
                continue
            at_home = False
            for p in range(teams.pairs_from[k], teams.pairs_from[k + 1]):
                at_home = at_home or teams.pair_cell[p] == cell
            if not at_home:
                return True
    return False
