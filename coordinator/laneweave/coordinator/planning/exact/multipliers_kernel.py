"""Compiled code of `lagrangian_bound`.

Parameters are the named tuples of `arrays` and `lagrangian_bound`. Arrays are read from their
tuples before loops, and inner loops are separate functions; otherwise they take five times as long.
"""

from __future__ import annotations

import numpy as np
from numba import njit

UNREACHABLE = 1e9
"""Represents infinity in sums of costs."""
PER_MOVE = 1e-5
"""Cost of each move that is not a wait, so that ties go to the fewest moves."""
PARKED = -1
"""In a path: the vehicle has arrived for good."""
REFUTED, FOUND, OPEN = 0, 1, 2
"""No solution below the upper bound exists; one has been found; undecided."""
BOUND, STEP_SIZE, STALE, WEIGHT, WEIGHTS, BEST = range(6)
"""Indices into the state of `improve`: the best lower bound, the step-size factor, iterations
without a better bound, the weight of the next relaxed solution, the sum of all weights, the value
of the best conflict-free relaxed solution."""
_HALF = 0.5 * UNREACHABLE
_TOLERANCE = 1e-7
_MOMENTUM = 0.6
_STEP = 0.6
_PATIENCE = 12
"""Iterations without a better bound after which the step size is reduced."""
_SHORTER, _SHORTEST = 0.6, 0.0005
_FADING = 0.92
"""Weight of a relaxed solution relative to its successor."""


@njit(cache=True, nogil=True)
def cliques_of_moves(members, valid):
    """Return each move's cliques of at least two moves (D, X, M), and the number of cliques.

    members: (., 4) pattern, columns and lanes from the anchor, and displacement of each member of a
    pattern, in ascending order of patterns; valid: (D, columns, lanes) moves of the grid.
    """
    displacements, columns, lanes = valid.shape
    reach, across = 0, 0
    for i in range(len(members)):
        reach, across = max(reach, abs(members[i, 1])), max(across, abs(members[i, 2]))
    patterns = 1 + members[-1, 0] if len(members) else 0
    index = np.zeros((patterns, columns + 2 * reach, lanes + 2 * across), np.int64)
    of_displacement = np.zeros(displacements, np.int64)
    for i in range(len(members)):
        pattern, c, side, d = members[i]
        of_displacement[d] += 1
        for column in range(columns):
            for lane in range(lanes):
                if valid[d, column, lane]:
                    index[pattern, column - c + reach, lane - side + across] += 1
    count = 0
    flat = index.ravel()
    for anchor in range(len(flat)):  # from sizes to indices
        large = flat[anchor] > 1
        flat[anchor] = count if large else -1
        count += large
    found = np.full((displacements, columns * lanes, max(1, of_displacement.max())), -1)
    used = np.zeros((displacements, columns * lanes), np.int64)
    for i in range(len(members)):
        pattern, c, side, d = members[i]
        for column in range(columns):
            for lane in range(lanes):
                clique = index[pattern, column - c + reach, lane - side + across]
                if valid[d, column, lane] and clique >= 0:
                    cell = column * lanes + lane
                    found[d, cell, used[d, cell]] = clique
                    used[d, cell] += 1
    return found[:, :, : max(1, used.max())].copy(), count


@njit(cache=True, nogil=True)
def min_steps(drives, step, pairs_from, pair_cell):
    """Return the minimum steps (X, P) from every cell to each pair's target, without conflicts.

    Parameters: see `arrays.Teams`.
    """
    teams, displacements, cells = drives.shape
    found = np.full((cells, len(pair_cell)), UNREACHABLE)
    queue = np.empty(cells, np.int64)
    for k in range(teams):
        valid = drives[k]
        for p in range(pairs_from[k], pairs_from[k + 1]):
            found[pair_cell[p], p] = 0.0
            queue[0] = pair_cell[p]
            head, end = 0, 1
            while head < end:
                next_cell = queue[head]
                head += 1
                for d in range(displacements):
                    cell = next_cell - step[d]
                    if 0 <= cell < cells and valid[d, cell] and found[cell, p] == UNREACHABLE:
                        found[cell, p] = found[next_cell, p] + 1.0
                        queue[end] = cell
                        end += 1
    return found


@njit(cache=True, nogil=True)
def begin(arrays, allowed, multipliers, scratch, state):
    """List the allowed moves of every step, and reset the subgradient method.

    Returns the number of moves, and the number of steps up to the last one with a move.
    """
    moves, span = _list_moves(arrays, allowed, scratch)
    start_over(multipliers, span, scratch, state)
    return moves, span


@njit(cache=True)
def _list_moves(arrays, allowed, scratch):
    teams, steps, displacements, cells = allowed.shape
    move, move_from, step = scratch.move, scratch.move_from, arrays.step
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


@njit(cache=True)
def start_over(multipliers, span, scratch, state):
    """Reset the subgradient method; steps without moves have no multipliers."""
    multipliers[span:] = 0.0
    scratch.present[:] = multipliers
    scratch.direction[:] = 0.0
    scratch.mass[:] = 0.0
    state[BOUND], state[STALE], state[WEIGHT], state[WEIGHTS] = -UNREACHABLE, 0.0, 1.0, 0.0


@njit(cache=True, nogil=True)
def improve(
    arrays, teams, allowed, earliest, multipliers, span, scratch, state, count, upper_bound, goal
):
    """Run the subgradient method until the bound exceeds `upper_bound` or a solution is below it.

    count: maximum number of iterations. goal: target value for the step size; negative: estimate.
    """
    cliques = multipliers.shape[1]
    present, direction, use = scratch.present, scratch.direction, scratch.use
    for _ in range(count):
        bound = evaluate(arrays, teams, earliest, present, span, scratch)
        if bound > _HALF:
            state[BOUND] = UNREACHABLE
            return REFUTED
        state[STALE] = 0.0 if bound > state[BOUND] + 0.01 else state[STALE] + 1.0
        if bound > state[BOUND]:
            state[BOUND] = bound
            multipliers[:] = present
            if bound > upper_bound:
                return REFUTED
        value, arrived = _follow_paths(
            arrays, teams, allowed, earliest, present, span, scratch, state
        )
        clash, square = _excess(present, use, span)
        if not clash and arrived and value < state[BEST] - _TOLERANCE:
            state[BEST] = value
            scratch.best_path[:] = scratch.path
        if state[BEST] <= upper_bound < _HALF:
            return FOUND
        if square == 0.0:
            return OPEN
        if state[STALE] >= _PATIENCE:
            state[STEP_SIZE] = max(_SHORTER * state[STEP_SIZE], _SHORTEST)
            state[STALE] = 0.0
            present[:] = multipliers
            direction[:] = 0.0
            continue
        aim = goal if goal >= 0.0 else 1.12 * max(state[BOUND], 0.0) + 2.0
        factor = _STEP * state[STEP_SIZE] * (aim - bound) / square
        for t in range(span):
            for clique in range(cliques):
                change = _MOMENTUM * direction[t, clique] + use[t, clique]
                direction[t, clique] = change
                if change != 0.0:
                    present[t, clique] = max(present[t, clique] + factor * change, 0.0)
    return OPEN


@njit(cache=True, nogil=True)
def evaluate(arrays, teams, earliest, multipliers, span, scratch):
    """Return the bound at these multipliers; fill in costs to go and the assignment."""
    _fill_costs_to_go(arrays, teams, earliest, multipliers, span, scratch)
    total = 0.0
    for t in range(span):
        for clique in range(multipliers.shape[1]):
            total += multipliers[t, clique]
    return _assign_targets(teams, scratch) - total


@njit(cache=True)
def _fill_costs_to_go(arrays, teams, earliest, multipliers, span, scratch):
    """Fill in the minimum cost, before each step, from each cell to each pair's target.

    Every step until the final arrival costs 1, plus the multipliers of the move's cliques. A
    vehicle that has arrived waits, which also costs multipliers.
    """
    cost_to_go, parked = scratch.cost_to_go, scratch.parked
    move, move_from, move_cost = scratch.move, scratch.move_from, scratch.move_cost
    clique, cell_of, pairs_from = arrays.clique, teams.pair_cell, teams.pairs_from
    parked[span] = 0.0
    if span == len(multipliers):
        cost_to_go[span] = teams.distance
    else:
        cost_to_go[span] = UNREACHABLE
        for p in range(len(cell_of)):
            if earliest[p] <= span:
                cost_to_go[span, cell_of[p], p] = 0.0
    for t in range(span - 1, -1, -1):
        cost_to_go[t] = UNREACHABLE
        for k in range(len(pairs_from) - 1):
            _relax_moves(
                move,
                move_cost,
                move_from[t, k],
                move_from[t, k + 1],
                pairs_from[k],
                pairs_from[k + 1],
                clique,
                multipliers[t],
                cost_to_go[t],
                cost_to_go[t + 1],
            )
        for p in range(len(cell_of)):
            cell = cell_of[p]
            stay = parked[t + 1, p] + penalty_of(clique, multipliers, t, 0, cell)
            parked[t, p] = stay
            if t >= earliest[p] and stay <= cost_to_go[t, cell, p]:
                cost_to_go[t, cell, p] = stay


@njit(cache=True)
def _relax_moves(
    move, move_cost, begin, end, first_pair, end_pair, clique, multipliers, costs, next_costs
):
    # The sum of multipliers is inlined: a call would take four times as long.
    max_cliques = clique.shape[2]
    for m in range(begin, end):
        d, cell, next_cell = move[m, 0], move[m, 1], move[m, 2]
        cost = 1.0
        if d != 0:
            cost += PER_MOVE
        for n in range(max_cliques):
            r = clique[d, cell, n]
            if r < 0:
                break
            cost += multipliers[r]
        move_cost[m] = cost
        for p in range(first_pair, end_pair):
            costs[cell, p] = min(costs[cell, p], cost + next_costs[next_cell, p])


@njit(cache=True)
def penalty_of(clique, multipliers, t, d, cell):
    """Return the sum of the multipliers of the cliques that contain a move."""
    total = 0.0
    for m in range(clique.shape[2]):
        r = clique[d, cell, m]
        if r < 0:
            break
        total += multipliers[t, r]
    return total


@njit(cache=True)
def _assign_targets(teams, scratch):
    """Assign targets at minimum cost; set each target's vehicle (or -1) and dual value.

    Successive shortest paths with potentials (Jonker and Volgenant, Computing 38, 1987).
    """
    cost_to_go, start, pair = scratch.cost_to_go, teams.start, teams.pair
    cost, holder_of, dual_of = scratch.cost, scratch.holder, scratch.dual
    vehicles, goals = cost.shape
    for i in range(vehicles):
        for j in range(goals):
            p = pair[teams.team[i], j]
            cost[i, j] = cost_to_go[0, start[i], p] if p >= 0 else UNREACHABLE
    value = np.zeros(vehicles + 1)
    dual = np.zeros(goals + 1)
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
            min_slack, nearest = np.inf, -1
            for j in range(goals):
                if done[j]:
                    continue
                length = cost[i, j] - value[i] - dual[j]
                if length < slack[j]:
                    slack[j] = length
                    came_from[j] = at
                if slack[j] < min_slack:
                    min_slack, nearest = slack[j], j
            for j in range(goals + 1):
                if done[j]:
                    value[holder[j]] += min_slack
                    dual[j] -= min_slack
                else:
                    slack[j] -= min_slack
            at = nearest
        while at != goals:
            before = came_from[at]
            holder[at] = holder[before]
            at = before
    total = 0.0
    for j in range(goals):
        holder_of[j], dual_of[j] = holder[j], dual[j]
        if holder[j] >= 0:
            total += cost[holder[j], j]
    return min(total, UNREACHABLE)


@njit(cache=True)
def _follow_paths(arrays, teams, allowed, earliest, multipliers, span, scratch, state):
    """Follow each vehicle's cheapest path; count the uses of cliques and add up masses.

    Returns the total cost and whether all vehicles arrive.
    """
    clique, step = arrays.clique, arrays.step
    cost_to_go, parked = scratch.cost_to_go, scratch.parked
    use, mass, path = scratch.use, scratch.mass, scratch.path
    weight = state[WEIGHT]
    use[:] = 0.0
    path[:] = PARKED
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
            if cell == target and t >= earliest[p] and parked[t, p] <= cost_to_go[t, cell, p]:
                arrived = True
            d = 0
            if not arrived:
                best = np.inf
                for e in range(len(step)):
                    if allowed[k, t, e, cell]:
                        total = (
                            penalty_of(clique, multipliers, t, e, cell)
                            + cost_to_go[t + 1, cell + step[e], p]
                        )
                        if e != 0:
                            total += PER_MOVE
                        if total < best - 1e-12:
                            best, d = total, e
                path[i, t] = d
                value += 1.0
                if d != 0:
                    value += PER_MOVE
            mass[k, t, d, cell] += weight
            for m in range(clique.shape[2]):
                r = clique[d, cell, m]
                if r < 0:
                    break
                use[t, r] += 1.0
            cell += step[d]
        all_arrived = all_arrived and cell == target
    state[WEIGHTS] += weight
    state[WEIGHT] = weight / _FADING
    return value, all_arrived


@njit(cache=True)
def _excess(multipliers, use, span):
    """Turn uses of cliques into a subgradient.

    Returns whether any clique is used more than once, and the subgradient's squared norm.
    """
    clash, square = False, 0.0
    for t in range(span):
        for clique in range(use.shape[1]):
            over = use[t, clique] - 1.0
            if over > 0.0:
                clash = True
            elif multipliers[t, clique] <= 0.0:
                over = 0.0
            use[t, clique] = over
            square += over * over
    return clash, square


@njit(cache=True, nogil=True)
def begin_below(arrays, teams, allowed, earliest, multipliers, scratch, state, upper_bound):
    """Call `begin`, and forbid moves and arrivals that no solution below the upper bound contains.

    Returns the lower bound, and the number of steps up to the last one with a move before that.
    """
    _, span = begin(arrays, allowed, multipliers, scratch, state)
    bound, _ = fix_by_reduced_cost(
        arrays, teams, allowed, earliest, multipliers, span, scratch, upper_bound
    )
    return bound, span


@njit(cache=True)
def fix_by_reduced_cost(arrays, teams, allowed, earliest, multipliers, span, scratch, upper_bound):
    """Forbid moves and arrivals that no solution below the upper bound contains.

    Returns the lower bound and how many of the listed moves are still allowed. Afterwards
    `scratch.reach` holds the minimum reduced cost of being in a cell before a step.
    """
    groups, cells = len(allowed), allowed.shape[3]
    bound = evaluate(arrays, teams, earliest, multipliers, span, scratch)
    budget = upper_bound - bound + _TOLERANCE
    cost_to_go, parked = scratch.cost_to_go, scratch.parked
    min_cost, reach = scratch.min_cost, scratch.reach
    move, move_from, move_cost = scratch.move, scratch.move_from, scratch.move_cost
    dual, pair_target = scratch.dual, teams.pair_target
    for k in range(groups):
        begin, end = teams.pairs_from[k], teams.pairs_from[k + 1]
        for t in range(span + 1):
            for cell in range(cells):
                value = UNREACHABLE
                for p in range(begin, end):
                    value = min(value, cost_to_go[t, cell, p] - dual[pair_target[p]])
                min_cost[k, t, cell] = value
    reach[:] = UNREACHABLE
    for i in range(len(teams.start)):
        reach[teams.team[i], 0, teams.start[i]] = 0.0
    kept = 0
    for t in range(span):
        for k in range(groups):
            for m in range(move_from[t, k], move_from[t, k + 1]):
                d, cell, next_cell = move[m, 0], move[m, 1], move[m, 2]
                extra = move_cost[m] + min_cost[k, t + 1, next_cell] - min_cost[k, t, cell]
                total = reach[k, t, cell] + max(extra, 0.0)
                if total > budget or min_cost[k, t + 1, next_cell] > _HALF:
                    allowed[k, t, d, cell] = False
                    continue
                kept += 1
                if total < reach[k, t + 1, next_cell]:
                    reach[k, t + 1, next_cell] = total
    for k in range(groups):
        for p in range(teams.pairs_from[k], teams.pairs_from[k + 1]):
            cell, dual_of = teams.pair_cell[p], dual[pair_target[p]]
            t = earliest[p]
            while t < span:
                extra = parked[t, p] - dual_of - min_cost[k, t, cell]
                if reach[k, t, cell] + max(extra, 0.0) <= budget:
                    break
                t += 1
            earliest[p] = t
    return bound, kept


@njit(cache=True, nogil=True)
def may_need_more_steps(teams, steps, scratch, budget):
    """Return whether, within a budget, a vehicle may be off its targets after the last step."""
    reach = scratch.reach
    for k in range(len(reach)):
        for cell in range(reach.shape[2]):
            if reach[k, steps, cell] > budget:
                continue
            at_target = False
            for p in range(teams.pairs_from[k], teams.pairs_from[k + 1]):
                at_target = at_target or teams.pair_cell[p] == cell
            if not at_target:
                return True
    return False
