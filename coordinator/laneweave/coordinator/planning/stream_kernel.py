"""Compiled code of `stream`; see `relaxation_kernel` for its style.

The table of a window says, for each slot, cell and displacement, what it costs that somebody is in
the way: the sum of the prices of all vehicles whose own moves conflict (`load`). Putting a vehicle
into the table and taking it out again changes a few entries; looking one up is all that the search
for a way needs.
"""

from __future__ import annotations

from numba import njit

from laneweave.coordinator.planning.negotiation_kernel import random_below

FIXED = 1_000_000
"""Price of a vehicle that cannot be moved out of the way."""
NO_WAY = 1e9
"""Cost of a vehicle that has no way."""
PRICE = 10
"""Least price of a vehicle, so that a price can grow by tenths of itself."""
_FIRST_SOFTNESS, _SOFTNESS_GROWTH, _TURNS = 0.5, 1.25, 25
_MEMORY = 0.3
_PRICE_GROWTH = 3
"""Added to the price of a vehicle each time that a chain of ejections hits it."""


@njit(cache=True, nogil=True)
def put(table, ways, v, sign):
    """Put a vehicle's way into the table (sign 1), or take it out (sign -1)."""
    load, who, made, offsets, first = table.load, table.who, table.made, table.offsets, table.first
    _, columns, lanes, _ = load.shape
    amount = sign * ways.price[v]
    for s in range(ways.slots[v]):
        column, lane, d = ways.column[v, s], ways.lane[v, s], ways.made[v, s]
        if sign > 0:
            who[s, column, lane] = v
            made[s, column, lane] = d
        else:
            who[s, column, lane] = -1
        for k in range(first[d], first[d + 1]):
            c, n = column + offsets[k, 0], lane + offsets[k, 1]
            if 0 <= c < columns and 0 <= n < lanes:
                load[s, c, n, offsets[k, 2]] += amount
    ways.placed[v] = sign > 0


@njit(cache=True, nogil=True)
def find_way(table, soft, ways, costs, v, limit, softness, scratch):
    """Lay the cheapest way of a vehicle that is in neither table; return its own cost.

    Nobody of `table` whose price is above `limit` is in the way of it; those of `soft` cost
    softness times their prices, and what the memory of places says.
    """
    load, steps = table.load, table.steps
    value, came, delay, memory = scratch.value, scratch.came, scratch.delay, scratch.memory
    priced = softness > 0.0
    slots, columns, lanes, fan = load.shape
    reach = (value.shape[1] - 1) // 2
    column0, wanted = ways.column[v, 0], ways.wanted[v]
    value[:] = NO_WAY
    value[0, reach, ways.lane[v, 0]] = 0.0
    best, best_s, best_c, best_l = NO_WAY, -1, 0, 0
    widest = 0
    for s in range(slots + 1):
        alive, widened = False, widest
        for offset in range(reach - widest, reach + widest + 1):
            column = column0 + offset - reach
            if not 0 <= column < columns:
                continue
            for lane in range(lanes):
                so_far = value[s, offset, lane]
                if so_far >= best:
                    continue
                if s == slots or table.gone[s, column]:
                    total = so_far + (0.0 if lane == wanted else ways.missing[v])
                    if total < best:
                        best, best_s, best_c, best_l = total, s, offset, lane
                    continue
                alive = True
                for d in range(fan):
                    c, n = column + steps[d, 0], lane + steps[d, 1]
                    if d > 0:
                        if ways.held[v] or not (0 <= c < columns and 0 <= n < lanes):
                            continue
                        if not (table.rear[s, min(c, column)] and table.front[s, max(c, column)]):
                            continue
                        if table.blocked[c, n] or table.blocked[column, n] or table.blocked[c, lane]:
                            continue
                        if not 0 <= offset + steps[d, 0] <= 2 * reach:
                            continue
                    if load[s, column, lane, d] > limit:
                        continue
                    total = so_far + costs.of_move[d]
                    if priced:
                        total += softness * soft.load[s, column, lane, d] / PRICE
                        total += memory[s, c, n]
                    if lane != wanted:
                        total += costs.off_lane
                    if d > 0:
                        total += delay[s]
                    to = offset + steps[d, 0]
                    if total < value[s + 1, to, n]:
                        value[s + 1, to, n] = total
                        came[s + 1, to, n] = d
                        if abs(to - reach) > widened:
                            widened = abs(to - reach)
        if not alive:
            break
        widest = widened
    if best_s < 0:
        return NO_WAY
    ways.slots[v] = best_s
    offset, lane = best_c, best_l
    for s in range(best_s, -1, -1):
        ways.column[v, s], ways.lane[v, s] = column0 + offset - reach, lane
        if s > 0:
            d = came[s, offset, lane]
            ways.made[v, s - 1] = d
            offset, lane = offset - steps[d, 0], lane - steps[d, 1]
    return own_cost(ways, costs, v)


@njit(cache=True, nogil=True)
def own_cost(ways, costs, v):
    """Return what a vehicle's way costs by itself."""
    total, slots = 0.0, ways.slots[v]
    for s in range(slots):
        total += costs.of_move[ways.made[v, s]]
        if ways.lane[v, s] != ways.wanted[v]:
            total += costs.off_lane
    if ways.lane[v, slots] != ways.wanted[v]:
        total += ways.missing[v]
    return total


@njit(cache=True, nogil=True)
def _save(ways, saved, count, v):
    saved.who[count] = v
    saved.slots[count] = ways.slots[v]
    saved.cost[count] = ways.cost[v]
    saved.column[count] = ways.column[v]
    saved.lane[count] = ways.lane[v]
    saved.made[count] = ways.made[v]


@njit(cache=True, nogil=True)
def _restore(table, ways, saved, begin, count):
    for i in range(begin, count):
        if ways.placed[saved.who[i]]:
            put(table, ways, saved.who[i], -1)
    for i in range(begin, count):
        v = saved.who[i]
        ways.slots[v] = saved.slots[i]
        ways.cost[v] = saved.cost[i]
        ways.column[v] = saved.column[i]
        ways.lane[v] = saved.lane[i]
        ways.made[v] = saved.made[i]
        put(table, ways, v, 1)


@njit(cache=True, nogil=True)
def _victims(table, ways, v, victims):
    """List those in the table whose moves conflict with a way that is not in it."""
    load, who, made, offsets, first = table.load, table.who, table.made, table.offsets, table.first
    _, columns, lanes, _ = load.shape
    count = 0
    for s in range(ways.slots[v]):
        column, lane, d = ways.column[v, s], ways.lane[v, s], ways.made[v, s]
        if load[s, column, lane, d] == 0:
            continue
        for k in range(first[d], first[d + 1]):
            c, n = column + offsets[k, 0], lane + offsets[k, 1]
            if 0 <= c < columns and 0 <= n < lanes:
                u = who[s, c, n]
                if u >= 0 and made[s, c, n] == offsets[k, 2]:
                    known = False
                    for i in range(count):
                        known |= victims[i] == u
                    if not known:
                        victims[count] = u
                        count += 1
    return count


@njit(cache=True, nogil=True)
def eject(table, ways, costs, start, softness, most, slack, rng, scratch):
    """Give a vehicle a better way, at the price of those that are in it; return what is gained.

    Whoever is hit is replanned in turn, and may hit others. The chain is undone, and nothing
    gained, if it gets longer than `most` or does not lower the sum of costs by more than `slack`.
    """
    saved, queue, victims, delay = scratch.saved, scratch.queue, scratch.victims, scratch.delay
    queue[0] = start
    waiting, kept, before = 1, 1, ways.cost[start]
    _save(ways, saved, 0, start)
    was_placed = ways.placed[start]
    if was_placed:
        put(table, ways, start, -1)
    failed, hits = False, 0
    while waiting > 0:
        waiting -= 1
        v = queue[waiting]
        # Who was hit goes round the others if it can.
        if v != start:
            ways.cost[v] = find_way(table, table, ways, costs, v, 0, 0.0, scratch)
            if ways.cost[v] < ways.missing[v]:
                put(table, ways, v, 1)
                continue
        # Two that must swap would take the same slot for ever if they did not sometimes hesitate.
        for s in range(len(delay)):
            delay[s] = 0.1 * random_below(rng, 10) if hits > 0 else 0.0
        ways.cost[v] = find_way(table, table, ways, costs, v, FIXED - 1, softness, scratch)
        if ways.cost[v] >= NO_WAY:
            failed = True
            break
        count = _victims(table, ways, v, victims)
        hits += count
        if hits > most:
            failed = True
            break
        for i in range(count):
            u = victims[i]
            known = False
            for k in range(kept):
                known |= saved.who[k] == u
            if not known:
                _save(ways, saved, kept, u)
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
    if worse:
        for k in range(kept):
            if ways.placed[saved.who[k]]:
                put(table, ways, saved.who[k], -1)
    # Prices are back to their least before anybody is put in for good.
    for k in range(kept):
        v = saved.who[k]
        if ways.price[v] != PRICE:
            if not worse:
                put(table, ways, v, -1)
                ways.price[v] = PRICE
                put(table, ways, v, 1)
            else:
                ways.price[v] = PRICE
    if worse:
        ways.cost[start] = saved.cost[0]
        _restore(table, ways, saved, 0 if was_placed else 1, kept)
        return 0.0
    return before - after


@njit(cache=True, nogil=True)
def stand(table, ways, costs, start, scratch):
    """Let a vehicle that has no way stay in its cell, and whoever is in the way of that likewise.

    It always works: if all stay where they are, nobody meets.
    """
    queue, victims = scratch.queue, scratch.victims
    queue[0] = start
    waiting = 1
    slots = len(table.load)
    while waiting > 0:
        waiting -= 1
        v = queue[waiting]
        s = 0
        while s < slots and not table.gone[s, ways.column[v, s]]:
            ways.column[v, s + 1], ways.lane[v, s + 1] = ways.column[v, s], ways.lane[v, s]
            ways.made[v, s] = 0
            s += 1
        ways.slots[v] = s
        ways.cost[v] = own_cost(ways, costs, v)
        for i in range(_victims(table, ways, v, victims)):
            put(table, ways, victims[i], -1)
            queue[waiting] = victims[i]
            waiting += 1
        put(table, ways, v, 1)


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
        _save(ways, saved, i, chosen[i])
        put(table, ways, chosen[i], -1)
    return near


@njit(cache=True, nogil=True)
def _negotiate(table, soft, ways, costs, seed, size, rng, scratch):
    """Let a vehicle and its neighbours bargain for their ways; return what is gained.

    Each in turn takes the way that is cheapest for it when every conflict with another of them has
    a price. Prices grow, and places that were fought over are remembered, until nobody conflicts
    (negotiated congestion, as for the path sets of `negotiation`).
    """
    saved, chosen, memory = scratch.saved, scratch.chosen, scratch.memory
    near = _take_out(table, ways, seed, size, 90, rng, scratch)
    before = 0.0
    for i in range(near):
        before += saved.cost[i]
    softness, conflicts = _FIRST_SOFTNESS, 1
    for turn in range(_TURNS):
        conflicts = 0
        for i in range(near):
            v = chosen[i]
            if ways.placed[v]:
                if turn > 0 and not _meets(soft, ways, v):
                    continue
                put(soft, ways, v, -1)
            ways.cost[v] = find_way(table, soft, ways, costs, v, 0, softness, scratch)
            if ways.cost[v] >= NO_WAY:
                conflicts = -1
                break
            for s in range(ways.slots[v]):
                column, lane = ways.column[v, s], ways.lane[v, s]
                if soft.load[s, column, lane, ways.made[v, s]] > 0:
                    memory[s, column, lane] += _MEMORY
                    conflicts += 1
            put(soft, ways, v, 1)
        if conflicts <= 0:
            break
        softness *= _SOFTNESS_GROWTH
    after = 0.0
    for i in range(near):
        v = chosen[i]
        after += ways.cost[v]
        if ways.placed[v]:
            put(soft, ways, v, -1)
    memory[:] = 0.0
    if conflicts != 0 or after >= before:
        _restore(table, ways, saved, 0, near)
        return 0.0
    for i in range(near):
        put(table, ways, chosen[i], 1)
    return before - after


@njit(cache=True, nogil=True)
def _meets(soft, ways, v):
    """Tell whether a vehicle's way meets another one's; its own moves do not count."""
    for s in range(ways.slots[v]):
        if soft.load[s, ways.column[v, s], ways.lane[v, s], ways.made[v, s]] > PRICE * (
            soft.own[ways.made[v, s]]
        ):
            return True
    return False


@njit(cache=True, nogil=True)
def _reorder(table, ways, costs, seed, size, slack, rng, scratch):
    """Take some neighbours out and put them in anew, in another order; return what is gained."""
    saved, chosen = scratch.saved, scratch.chosen
    near = _take_out(table, ways, seed, size, 67, rng, scratch)
    before = after = 0.0
    for i in range(near):
        before += saved.cost[i]
    for i in range(near):
        v = chosen[i]
        ways.cost[v] = find_way(table, table, ways, costs, v, 0, 0.0, scratch)
        after += ways.cost[v]
        if after >= before + slack:
            break
        put(table, ways, v, 1)
    if after >= before + slack:
        _restore(table, ways, saved, 0, near)
        return 0.0
    return before - after


@njit(cache=True, nogil=True)
def improve(table, soft, ways, costs, rounds, most, rng, scratch):
    """Improve all ways for some rounds; return how many vehicles miss their lanes.

    While somebody misses its lane, chains of ejections and new orders take turns; slack cools down
    from a few moves to none. Afterwards a few rounds more look for cheaper ways.
    """
    count = len(ways.cost)
    failing = scratch.failing
    missed = 0
    for turn in range(rounds):
        missed = 0
        for v in range(count):
            if ways.cost[v] >= ways.missing[v] and not ways.held[v]:
                failing[missed] = v
                missed += 1
        slack = 8.0 * max(0.0, 1.0 - 1.5 * turn / rounds) if missed else -1e-9
        if missed and turn % 30 == 31:
            v = failing[random_below(rng, missed)]
            size = min(6 + random_below(rng, 20), count - 1)
            _negotiate(table, soft, ways, costs, v, size, rng, scratch)
        elif missed and turn % 8 < 7:
            v = failing[random_below(rng, missed)]
            softness = 2.0 + 2.0 * random_below(rng, 12)
            eject(table, ways, costs, v, softness, most, slack, rng, scratch)
        else:
            seed = failing[random_below(rng, missed)] if missed and turn % 2 else random_below(
                rng, count
            )
            if ways.held[seed]:
                continue
            size = 2 + random_below(rng, 12)
            _reorder(table, ways, costs, seed, min(size, count - 1), slack, rng, scratch)
        if not missed and turn > rounds // 8:
            break
    return missed
