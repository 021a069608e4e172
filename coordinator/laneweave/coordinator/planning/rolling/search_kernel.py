"""Compiled code of the rolling planner: the search over the paths of all vehicles.

Ejection chains and reorderings improve a plan; see `path_search`.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from laneweave.coordinator.planning.random_kernel import random_below
from laneweave.coordinator.planning.rolling.paths_kernel import (
    MAX_EJECTED,
    NO_PATH,
    PENALTY,
    find_hit,
    find_path,
    follow,
    put,
    restore,
    save,
    stay,
)

_PENALTY_GROWTH = 3
"""Increase in a vehicle's penalty each time a chain hits it."""
_MIN_SOFTNESS, _SOFTNESS_RANGE = 15.0, 25.0
"""Cost of a conflict in a chain: minimum, and range of a random addition."""
_MAX_DELAY_COST = 0.9
_TRIES = 4
"""Maximum number of ejection chains for a vehicle without a path."""
_FIRST_SLACK, _COOLED_AFTER = 16.0, 0.67
"""Initially allowed increase in total cost, and the share of the work after which it is 0."""
_REORDER_EVERY = 8
_MAX_REORDERED = 13
_IDLE_ROUNDS = 200
"""Maximum number of rounds spent only on cheaper paths, when no reachable lane is missed."""
_IDLE_SOFTNESS = 3.0
_STAYING_CHANGES_EVERY = 100
"""Number of rounds after which the penalty for staying in another vehicle's place is switched off
or on again. With it, paths lead on through others to free cells beyond them, which keeps chains
short in dense traffic. Without it, the other vehicle moves to the free cell."""
_ROUNDING = 1e-4


@njit(cache=True, nogil=True)
def set_paths(table, paths, costs, kept, first, rng, scratch):
    """Add every vehicle to the table, on its earlier path if that is still valid.

    kept: columns and lanes of the earlier paths, one vehicle after another; (cells, 2).
    first: index in `kept` of the first cell of each vehicle.
    """
    count = len(paths.cost)
    for v in range(count):
        if paths.held[v]:
            stay(table, paths, costs, v)
            put(table, paths, v, 1)
    for v in range(count):
        if paths.group[v] > 0 and not paths.held[v]:
            _set_bounds(table, paths, costs, v, scratch)
    for v in range(count):
        if not paths.held[v] and follow(table, paths, costs, v, kept[first[v] : first[v + 1]]):
            put(table, paths, v, 1)
    # Foremost vehicles first: they have the least time left.
    for v in range(count - 1, -1, -1):
        if paths.placed[v]:
            continue
        paths.cost[v] = find_path(table, paths, costs, v, 0.0, NO_PATH, scratch)
        if paths.cost[v] < NO_PATH:
            put(table, paths, v, 1)
            continue
        paths.cost[v] = NO_PATH
        for _ in range(_TRIES):
            if _eject(table, paths, costs, v, _MIN_SOFTNESS, 0.0, rng, scratch) > 0.0:
                break
        if not paths.placed[v]:
            _hold(table, paths, costs, v, scratch)


@njit(cache=True, nogil=True)
def _set_bounds(table, paths, costs, v, scratch):
    """Set the bounds on the cost of a vehicle to whose type rules apply; only held ones are placed.

    The table then tells whether it can arrive, or must drive where it may not. Others make room for
    it if it drives there although it could do without, or misses a lane that it could reach.
    """
    cost = find_path(table, paths, costs, v, 0.0, NO_PATH, scratch)
    paths.min_cost[v] = cost
    paths.can_arrive[v] = cost < NO_PATH
    paths.urgent_cost[v] = cost + costs.restricted - _ROUNDING


@njit(cache=True, nogil=True)
def _hold(table, paths, costs, start, scratch):
    """Make a vehicle without a path stay in its cell, and in turn every vehicle it conflicts with.

    No conflicts remain, since vehicles that stay never conflict.
    """
    queue, hit = scratch.queue, scratch.hit
    queue[0] = start
    waiting = 1
    while waiting > 0:
        waiting -= 1
        v = queue[waiting]
        stay(table, paths, costs, v)
        for i in range(find_hit(table, paths, v, hit)):
            put(table, paths, hit[i], -1)
            queue[waiting] = hit[i]
            waiting += 1
        put(table, paths, v, 1)


@njit(cache=True, nogil=True)
def _eject(table, paths, costs, start, softness, slack, rng, scratch):
    """Reroute a vehicle through others by an ejection chain; return the decrease in total cost.

    Vehicles that are hit are rerouted in turn, and may hit others (ejection chains: Glover 1996).
    Each hit raises the penalty of the vehicle hit. The chain is undone, and the decrease is 0, if
    there are more than `MAX_EJECTED` hits or the total cost grows by `slack` or more.
    """
    saved, queue, hit, marked = scratch.saved, scratch.queue, scratch.hit, scratch.marked
    was_placed = paths.placed[start]
    queue[0] = start
    waiting, kept, hits, before = 1, 1, 0, paths.cost[start]
    save(paths, saved, 0, start)
    marked[start] = True
    if was_placed:
        put(table, paths, start, -1)
    while waiting > 0 and hits <= MAX_EJECTED:
        waiting -= 1
        i = random_below(rng, waiting + 1)
        v, queue[i] = queue[i], queue[waiting]
        _draw_delays(scratch.delay, rng)
        paths.cost[v] = find_path(table, paths, costs, v, softness, NO_PATH, scratch)
        scratch.delay[:] = 0.0
        if paths.cost[v] >= NO_PATH:
            hits = MAX_EJECTED + 1
            break
        count = find_hit(table, paths, v, hit)
        hits += count
        if hits > MAX_EJECTED:
            break
        for i in range(count):
            u = hit[i]
            if not marked[u]:
                marked[u] = True
                save(paths, saved, kept, u)
                kept += 1
                before += paths.cost[u]
            put(table, paths, u, -1)
            paths.penalty[u] += _PENALTY_GROWTH
            queue[waiting] = u
            waiting += 1
        put(table, paths, v, 1)
    after = 0.0
    for k in range(kept):
        after += paths.cost[saved.vehicle[k]]
    better = hits <= MAX_EJECTED and after < before + slack
    _finish_chain(table, paths, kept, better, was_placed, scratch)
    return before - after if better else 0.0


@njit(cache=True, nogil=True)
def _draw_delays(delay, rng):
    """Draw a random extra cost for moves in each slot.

    Without this, two vehicles that must swap would compete for the same slot forever.
    """
    for s in range(len(delay)):
        delay[s] = np.float32(_MAX_DELAY_COST * random_below(rng, 1000) / 1000.0)


@njit(cache=True, nogil=True)
def _finish_chain(table, paths, kept, better, was_placed, scratch):
    """End a chain that changed `kept` paths: reset penalties; undo the chain unless `better`."""
    saved = scratch.saved
    for k in range(kept):
        v = saved.vehicle[k]
        scratch.marked[v] = False
        # The table holds the penalty with which a path was added.
        again = paths.placed[v] and (not better or paths.penalty[v] != PENALTY)
        if again:
            put(table, paths, v, -1)
        paths.penalty[v] = PENALTY
        if again and better:
            put(table, paths, v, 1)
    if not better:
        paths.cost[saved.vehicle[0]] = saved.cost[0]
        restore(table, paths, saved, 0 if was_placed else 1, kept)


@njit(cache=True, nogil=True)
def _remove_neighbours(table, paths, seed, size, share, rng, scratch):
    """Remove a vehicle and some neighbours from the table, in random order; return how many."""
    saved, chosen = scratch.saved, scratch.chosen
    count = len(paths.cost)
    near = 0
    # Vehicles are sorted by column, so those with neighbouring indices are the nearest.
    low = high = seed
    while near < size:
        pick_low = low - 1 >= 0 and (high + 1 >= count or random_below(rng, 2) == 0)
        if pick_low:
            low -= 1
        elif high + 1 < count:
            high += 1
        else:
            break
        v = low if pick_low else high
        if not paths.held[v] and random_below(rng, 100) < share:
            chosen[near] = v
            near += 1
    chosen[near] = seed
    near += 1
    for i in range(near):
        other = i + random_below(rng, near - i)
        chosen[i], chosen[other] = chosen[other], chosen[i]
        save(paths, saved, i, chosen[i])
        put(table, paths, chosen[i], -1)
    return near


@njit(cache=True, nogil=True)
def _reorder(table, paths, costs, seed, size, slack, rng, scratch):
    """Remove some neighbours and reroute them in another order; return the decrease in cost.

    (Large neighbourhood search: Shaw 1998.)
    """
    saved, chosen = scratch.saved, scratch.chosen
    near = _remove_neighbours(table, paths, seed, size, 67, rng, scratch)
    before = min_cost = 0.0
    for i in range(near):
        before += saved.cost[i]
        min_cost += paths.min_cost[chosen[i]]
    after = 0.0
    for i in range(near):
        v = chosen[i]
        min_cost -= paths.min_cost[v]
        upper_bound = before + slack - after - min_cost
        paths.cost[v] = find_path(table, paths, costs, v, 0.0, upper_bound, scratch)
        after += paths.cost[v]
        if after + min_cost >= before + slack:
            restore(table, paths, saved, 0, near)
            return 0.0
        put(table, paths, v, 1)
    return before - after


@njit(cache=True, nogil=True)
def _list_costly(paths, off_lane, costly):
    """List the vehicles for which others must make room, and others above their minimum cost.

    The first miss a lane that they could reach, or drive where they may not without need.
    """
    missing_count = costly_count = 0
    for v in range(len(paths.cost)):
        if paths.can_arrive[v]:
            if paths.cost[v] >= paths.urgent_cost[v]:
                off_lane[missing_count] = v
                missing_count += 1
            elif paths.cost[v] > paths.min_cost[v] + _ROUNDING:
                costly[costly_count] = v
                costly_count += 1
    return missing_count, costly_count


@njit(cache=True, nogil=True)
def _change_staying(table, paths):
    """Switch the penalty for staying in another vehicle's place off, or on again."""
    for v in range(len(paths.cost)):
        put(table, paths, v, -1)
    for k in range(table.first[0], table.first[1]):
        if table.offsets[k, 0] == 0 and table.offsets[k, 1] == 0 and table.offsets[k, 2] == 0:
            table.offsets[k, 3] = 1 - table.offsets[k, 3]
    for v in range(len(paths.cost)):
        put(table, paths, v, 1)


@njit(cache=True, nogil=True)
def _anneal(table, paths, costs, rounds, max_paths, rng, scratch):
    """Improve all paths for some rounds; return the number of rounds.

    While vehicles miss their lanes, ejection chains and reorderings alternate; the permitted cost
    increase falls to zero. Afterwards a few more rounds look for cheaper paths.
    """
    off_lane, costly = scratch.off_lane, scratch.costly
    turn = idle = 0
    scratch.searches[0] = 0
    while turn < rounds and scratch.searches[0] < max_paths and idle < _IDLE_ROUNDS:
        missing_count, costly_count = _list_costly(paths, off_lane, costly)
        if missing_count == 0 and costly_count == 0:
            break
        slack = -_ROUNDING
        if missing_count > 0:
            done = max(turn / rounds, scratch.searches[0] / max_paths)
            slack = max(slack, _FIRST_SLACK * (1.0 - done / _COOLED_AFTER))
        else:
            idle += 1
        if missing_count > 0 and (turn + 1) % _STAYING_CHANGES_EVERY == 0:
            _change_staying(table, paths)
        if missing_count > 0 and turn % _REORDER_EVERY > 0:
            v = off_lane[random_below(rng, missing_count)]
            softness = _MIN_SOFTNESS + _SOFTNESS_RANGE * random_below(rng, 1000) / 1000.0
            _eject(table, paths, costs, v, softness, slack, rng, scratch)
        elif missing_count == 0 and turn % 2 > 0:
            v = costly[random_below(rng, costly_count)]
            softness = _IDLE_SOFTNESS * random_below(rng, 1000) / 1000.0 + 0.2
            _eject(table, paths, costs, v, softness, slack, rng, scratch)
        else:
            v = (
                costly[random_below(rng, costly_count)]
                if costly_count > 0
                else off_lane[random_below(rng, missing_count)]
            )
            size = min(2 + random_below(rng, _MAX_REORDERED - 1), len(paths.cost) - 1)
            _reorder(table, paths, costs, v, size, slack, rng, scratch)
        turn += 1
    return turn


@njit(cache=True, nogil=True)
def improve(table, paths, costs, rounds, max_paths, anneals, rng, scratch):
    """Improve all paths by up to `anneals` annealings; return the number of rounds.

    Another annealing follows only while vehicles miss lanes that they could reach. `rounds` and
    `max_paths` limit the rounds and path searches of each.
    """
    turns = 0
    for _ in range(anneals):
        turns += _anneal(table, paths, costs, rounds, max_paths, rng, scratch)
        if _list_costly(paths, scratch.off_lane, scratch.costly)[0] == 0:
            break
    return turns
