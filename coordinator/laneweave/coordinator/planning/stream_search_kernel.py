"""Compiled code of `stream`: the search over ways of all vehicles."""

from __future__ import annotations

import numpy as np
from numba import njit

from laneweave.coordinator.planning.negotiation_kernel import random_below
from laneweave.coordinator.planning.stream_arrays import MOST_EJECTED, PRICE
from laneweave.coordinator.planning.stream_kernel import (
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
"""Added to the price of a vehicle each time that a chain of ejections hits it."""


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
        for softness in (0.3, 0.5, 1.0, 1.5, 3.0):
            if eject(table, ways, costs, v, softness, MOST_EJECTED, 0.0, rng, scratch) > 0.0:
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
def eject(table, ways, costs, start, softness, most, slack, rng, scratch):
    """Give a vehicle a better way, at the price of those that are in it; return what is gained.

    Whoever is hit is planned anew in turn, and may hit others (ejection chains: Glover 1996). The
    chain is undone, and nothing gained, if it hits more than `most` or does not lower the sum of
    costs by more than -`slack`.
    """
    saved, queue, victims, delay = scratch.saved, scratch.queue, scratch.victims, scratch.delay
    marked = scratch.marked
    queue[0] = start
    waiting, kept, before = 1, 1, ways.cost[start]
    save(ways, saved, 0, start)
    marked[start] = True
    was_placed = ways.placed[start]
    if was_placed:
        put(table, ways, start, -1)
    failed, hits = False, 0
    while waiting > 0:
        waiting -= 1
        v = queue[waiting]
        # Who was hit goes round the others if it can.
        if v != start:
            ways.cost[v] = find_way(table, ways, costs, v, 0.0, ways.missing[v], scratch)
            if ways.cost[v] < NO_WAY:
                put(table, ways, v, 1)
                continue
        # Two that must swap would take the same slot for ever if they did not sometimes hesitate.
        for s in range(len(delay)):
            delay[s] = np.float32(0.1 * random_below(rng, 10)) if hits > 0 else 0.0
        ways.cost[v] = find_way(table, ways, costs, v, softness, NO_WAY, scratch)
        if ways.cost[v] >= NO_WAY:
            failed = True
            break
        count = find_victims(table, ways, v, victims)
        hits += count
        if hits > most:
            failed = True
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
    delay[:] = 0.0
    after = 0.0
    for k in range(kept):
        after += ways.cost[saved.who[k]]
    worse = failed or after >= before + slack
    for k in range(kept):
        v = saved.who[k]
        marked[v] = False
        if worse and ways.placed[v]:
            put(table, ways, v, -1)
        # Nobody keeps its price: it is back to the least before the way is in for good.
        elif ways.price[v] != PRICE and ways.placed[v]:
            put(table, ways, v, -1)
            ways.price[v] = PRICE
            put(table, ways, v, 1)
        ways.price[v] = PRICE
    if worse:
        ways.cost[start] = saved.cost[0]
        restore(table, ways, saved, 0 if was_placed else 1, kept)
        return 0.0
    return before - after


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
def improve(table, ways, costs, rounds, rng, scratch):
    """Improve all ways for some rounds; return how many rounds it took.

    While somebody misses its lane, chains of ejections and new orders take turns; slack cools down
    from a few moves to none. Afterwards a few rounds more look for cheaper ways.
    """
    count = len(ways.cost)
    failing = scratch.chosen
    turn = 0
    while turn < rounds:
        missed = 0
        for v in range(count):
            if ways.cost[v] >= ways.missing[v] and not ways.held[v]:
                failing[missed] = v
                missed += 1
        slack = 8.0 * max(0.0, 1.0 - 1.5 * turn / rounds) if missed else -1e-9
        if missed and turn % 8 < 7:
            v = failing[random_below(rng, missed)]
            softness = 2.0 + 2.0 * random_below(rng, 12)
            eject(table, ways, costs, v, softness, MOST_EJECTED, slack, rng, scratch)
        else:
            seed = random_below(rng, count)
            if missed and turn % 2:
                seed = failing[random_below(rng, missed)]
            size = 2 + random_below(rng, 12)
            if not ways.held[seed]:
                _reorder(table, ways, costs, seed, min(size, count - 1), slack, rng, scratch)
        turn += 1
        if not missed and turn > rounds // 8:
            break
    return turn
