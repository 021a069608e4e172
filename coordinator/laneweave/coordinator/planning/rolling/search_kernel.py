"""Compiled code of `stream`: the search over ways of all vehicles."""

from __future__ import annotations

import numpy as np
from numba import njit

from laneweave.coordinator.planning.exact.negotiation_kernel import random_below
from laneweave.coordinator.planning.rolling.arrays import MOST_EJECTED, PRICE
from laneweave.coordinator.planning.rolling.paths_kernel import (
    NO_WAY,
    find_victims,
    find_way,
    follow,
    put,
    restore,
    save,
    stay,
)

_PRICE_GROWTH = 3
"""Added to the price of a vehicle, at first `PRICE`, each time that a chain hits it."""
_LEAST_SOFTNESS, _MORE_SOFTNESS = 15.0, 25.0
"""What it costs in a chain to be in the way of a vehicle: so much, and up to so much more."""
_HESITATION = 0.9
_TRIES = 4
"""Chains for a vehicle that has no way at all."""
_FIRST_SLACK, _COOLED_AFTER = 16.0, 0.67
"""By how much the sum of costs may grow at first, and when that is over, in parts of all work."""
_REORDER_EVERY = 8
_MOST_REORDERED = 13
_IDLE_ROUNDS = 200
"""Rounds after nobody misses its lane any more."""
_IDLE_SOFTNESS = 3.0
_ROUNDING = 1e-4


@njit(cache=True, nogil=True)
def lay(table, ways, costs, kept, first, rng, scratch):
    """Put every vehicle into the table: on its old way where that still holds.

    kept: columns and lanes of the old ways, one vehicle after the other; (cells, 2).
    first: where those of each vehicle begin.
    """
    count = len(ways.cost)
    for v in range(count):
        if ways.held[v]:
            stay(table, ways, costs, v)
            put(table, ways, v, 1)
    for v in range(count):
        if not ways.held[v] and follow(table, ways, costs, v, kept[first[v] : first[v + 1]]):
            put(table, ways, v, 1)
    # Foremost first: they have the least time.
    for v in range(count - 1, -1, -1):
        if ways.placed[v]:
            continue
        ways.cost[v] = find_way(table, ways, costs, v, 0.0, NO_WAY, scratch)
        if ways.cost[v] < NO_WAY:
            put(table, ways, v, 1)
            continue
        ways.cost[v] = NO_WAY
        for _ in range(_TRIES):
            if _eject(table, ways, costs, v, _LEAST_SOFTNESS, 0.0, rng, scratch) > 0.0:
                break
        if not ways.placed[v]:
            _let_stand(table, ways, costs, v, scratch)


@njit(cache=True, nogil=True)
def _let_stand(table, ways, costs, start, scratch):
    """Let a vehicle that has no way stay in its cell, and whoever is in the way of that likewise.

    It always works: if all stay where they are, nobody meets.
    """
    queue, victims = scratch.queue, scratch.victims
    queue[0] = start
    waiting = 1
    while waiting > 0:
        waiting -= 1
        v = queue[waiting]
        stay(table, ways, costs, v)
        for i in range(find_victims(table, ways, v, victims)):
            put(table, ways, victims[i], -1)
            queue[waiting] = victims[i]
            waiting += 1
        put(table, ways, v, 1)


@njit(cache=True, nogil=True)
def _eject(table, ways, costs, start, softness, slack, rng, scratch):
    """Give a vehicle a better way, at the price of those that are in it; return what is gained.

    Whoever is hit is planned anew in turn, and may hit others (ejection chains: Glover 1996). Each
    time the price of who is hit grows. The chain is undone, and nothing gained, if it hits more
    than `MOST_EJECTED` or the sum of costs does not stay below what it was and `slack`.
    """
    saved, queue, victims, marked = scratch.saved, scratch.queue, scratch.victims, scratch.marked
    was_placed = ways.placed[start]
    queue[0] = start
    waiting, kept, hits, before = 1, 1, 0, ways.cost[start]
    save(ways, saved, 0, start)
    marked[start] = True
    if was_placed:
        put(table, ways, start, -1)
    while waiting > 0 and hits <= MOST_EJECTED:
        waiting -= 1
        i = random_below(rng, waiting + 1)
        v, queue[i] = queue[i], queue[waiting]
        _hesitate(scratch.delay, rng)
        ways.cost[v] = find_way(table, ways, costs, v, softness, NO_WAY, scratch)
        scratch.delay[:] = 0.0
        if ways.cost[v] >= NO_WAY:
            hits = MOST_EJECTED + 1
            break
        count = find_victims(table, ways, v, victims)
        hits += count
        if hits > MOST_EJECTED:
            break
        for i in range(count):
            u = victims[i]
            if not marked[u]:
                marked[u] = True
                save(ways, saved, kept, u)
                kept += 1
                before += ways.cost[u]
            put(table, ways, u, -1)
            ways.price[u] += _PRICE_GROWTH
            queue[waiting] = u
            waiting += 1
        put(table, ways, v, 1)
    after = 0.0
    for k in range(kept):
        after += ways.cost[saved.who[k]]
    better = hits <= MOST_EJECTED and after < before + slack
    _settle(table, ways, kept, better, was_placed, scratch)
    return before - after if better else 0.0


@njit(cache=True, nogil=True)
def _hesitate(delay, rng):
    """Draw what moves cost more in each slot, for the next way.

    Two that must swap would want the same slot for ever if they did not sometimes hesitate.
    """
    for s in range(len(delay)):
        delay[s] = np.float32(_HESITATION * random_below(rng, 1000) / 1000.0)


@njit(cache=True, nogil=True)
def _settle(table, ways, kept, better, was_placed, scratch):
    """End a chain that has changed `kept` ways: prices are the least again, or all is undone."""
    saved = scratch.saved
    for k in range(kept):
        v = saved.who[k]
        scratch.marked[v] = False
        # The table holds the price that a way was put in with.
        again = ways.placed[v] and (not better or ways.price[v] != PRICE)
        if again:
            put(table, ways, v, -1)
        ways.price[v] = PRICE
        if again and better:
            put(table, ways, v, 1)
    if not better:
        ways.cost[saved.who[0]] = saved.cost[0]
        restore(table, ways, saved, 0 if was_placed else 1, kept)


@njit(cache=True, nogil=True)
def _take_out(table, ways, seed, size, share, rng, scratch):
    """Take a vehicle and some neighbours out of the table, in a random order; return how many."""
    saved, chosen = scratch.saved, scratch.chosen
    count = len(ways.cost)
    near = 0
    # Those nearest by column: vehicles are in the order of their columns.
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
        if not ways.held[v] and random_below(rng, 100) < share:
            chosen[near] = v
            near += 1
    chosen[near] = seed
    near += 1
    for i in range(near):
        other = i + random_below(rng, near - i)
        chosen[i], chosen[other] = chosen[other], chosen[i]
        save(ways, saved, i, chosen[i])
        put(table, ways, chosen[i], -1)
    return near


@njit(cache=True, nogil=True)
def _reorder(table, ways, costs, seed, size, slack, rng, scratch):
    """Take some neighbours out and put them in anew, in another order; return what is gained.

    (Large neighbourhood search: Shaw 1998.)
    """
    saved, chosen = scratch.saved, scratch.chosen
    near = _take_out(table, ways, seed, size, 67, rng, scratch)
    before = least = 0.0
    for i in range(near):
        before += saved.cost[i]
        least += ways.least[chosen[i]]
    after = 0.0
    for i in range(near):
        v = chosen[i]
        least -= ways.least[v]
        ceiling = before + slack - after - least
        ways.cost[v] = find_way(table, ways, costs, v, 0.0, ceiling, scratch)
        after += ways.cost[v]
        if after + least >= before + slack:
            restore(table, ways, saved, 0, near)
            return 0.0
        put(table, ways, v, 1)
    return before - after


@njit(cache=True, nogil=True)
def _list_dear(ways, failing, dear):
    """List who misses its lane and may reach it, and who has a way that is not the cheapest."""
    missed = more = 0
    for v in range(len(ways.cost)):
        if ways.able[v]:
            if ways.cost[v] >= ways.missing[v]:
                failing[missed] = v
                missed += 1
            elif ways.cost[v] > ways.least[v] + _ROUNDING:
                dear[more] = v
                more += 1
    return missed, more


@njit(cache=True, nogil=True)
def improve(table, ways, costs, rounds, most_ways, rng, scratch):
    """Improve all ways for some rounds; return how many rounds it took.

    While somebody misses its lane, chains of ejections and new orders take turns; slack cools down
    from some moves to none. Afterwards a few rounds more look for cheaper ways.
    """
    failing, dear = scratch.failing, scratch.dear
    turn = idle = 0
    scratch.laid[0] = 0
    while turn < rounds and scratch.laid[0] < most_ways and idle < _IDLE_ROUNDS:
        missed, more = _list_dear(ways, failing, dear)
        if missed == 0 and more == 0:
            break
        slack = -_ROUNDING
        if missed > 0:
            done = max(turn / rounds, scratch.laid[0] / most_ways)
            slack = max(slack, _FIRST_SLACK * (1.0 - done / _COOLED_AFTER))
        else:
            idle += 1
        if missed > 0 and turn % _REORDER_EVERY > 0:
            v = failing[random_below(rng, missed)]
            softness = _LEAST_SOFTNESS + _MORE_SOFTNESS * random_below(rng, 1000) / 1000.0
            _eject(table, ways, costs, v, softness, slack, rng, scratch)
        elif missed == 0 and turn % 2 > 0:
            v = dear[random_below(rng, more)]
            softness = _IDLE_SOFTNESS * random_below(rng, 1000) / 1000.0 + 0.2
            _eject(table, ways, costs, v, softness, slack, rng, scratch)
        else:
            v = dear[random_below(rng, more)] if more > 0 else failing[random_below(rng, missed)]
            size = min(2 + random_below(rng, _MOST_REORDERED - 1), len(ways.cost) - 1)
            _reorder(table, ways, costs, v, size, slack, rng, scratch)
        turn += 1
    return turn
