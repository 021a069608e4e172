"""Compiled code of `stream`: ways of single vehicles; see `relaxation_kernel` for its style.

The table of a window says, for each slot, cell and displacement, what it costs that somebody is in
the way: the sum of the prices of all vehicles whose own moves conflict (`load`). Putting a vehicle
into the table and taking it out again changes a few entries; looking one up is all that the search
for a way needs.
"""

from __future__ import annotations

from numba import njit

from laneweave.coordinator.planning.stream_arrays import FIXED, PRICE

_PASSABLE = FIXED - 1
NO_WAY = 1e9
"""Cost of a vehicle that has no way."""


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
def _may_move(table, s, column, lane, d):
    """Tell whether a move stays on the road and in S3, and enters nothing that is blocked.

    The corners of an oblique move count as entered, except where the vehicle is anyway.
    """
    to_column, to_lane = column + table.steps[d, 0], lane + table.steps[d, 1]
    columns, lanes = table.blocked.shape
    if not (0 <= to_column < columns and 0 <= to_lane < lanes):
        return False
    if not (table.rear[s, min(column, to_column)] and table.front[s, max(column, to_column)]):
        return False
    if table.blocked[to_column, to_lane]:
        return False
    if to_column == column or to_lane == lane:
        return True
    return not (table.blocked[column, to_lane] or table.blocked[to_column, lane])


@njit(cache=True, nogil=True)
def find_way(table, ways, costs, v, softness, ceiling, scratch):
    """Lay the cheapest way of a vehicle that is not in the table; return what it costs by itself.

    A way below `ceiling` is looked for, by dynamic programming over slots, columns and lanes. With
    a softness of 0 nobody may be in its way; otherwise that costs softness for each least price,
    and only what is `FIXED` is never passed. Without such a way: `NO_WAY`, and nothing is laid.
    """
    load, steps, of_move = table.load, table.steps, costs.of_move
    value, came, delay = scratch.value, scratch.came, scratch.delay
    slots, columns, lanes, fan = load.shape
    reach = (value.shape[1] - 1) // 2
    column0, wanted, missing = ways.column[v, 0], ways.wanted[v], ways.missing[v]
    limit = _PASSABLE if softness > 0.0 else 0
    per_price = softness / PRICE
    value[:] = NO_WAY
    value[0, reach, ways.lane[v, 0]] = 0.0
    best, best_s, best_offset, best_lane = ceiling, -1, 0, 0
    low = high = reach
    for s in range(slots + 1):
        alive, next_low, next_high = False, low, high
        for offset in range(low, high + 1):
            column = column0 + offset - reach
            for lane in range(lanes):
                so_far = value[s, offset, lane]
                if so_far >= best:
                    continue
                if s == slots or table.gone[s, column]:
                    total = so_far + (0.0 if lane == wanted else missing)
                    if total < best:
                        best, best_s, best_offset, best_lane = total, s, offset, lane
                    continue
                alive = True
                if lane != wanted:
                    so_far += costs.off_lane
                for d in range(fan):
                    if load[s, column, lane, d] > limit:
                        continue
                    to, to_lane = offset + steps[d, 0], lane + steps[d, 1]
                    total = so_far + of_move[d] + per_price * load[s, column, lane, d]
                    if d > 0:
                        if ways.held[v] or not 0 <= to <= 2 * reach:
                            continue
                        if not _may_move(table, s, column, lane, d):
                            continue
                        total += delay[s]
                    to_go = min(missing, abs(to_lane - wanted) * costs.per_lane)
                    if total + to_go + costs.rebate * (slots - s) >= best:
                        continue
                    if total < value[s + 1, to, to_lane]:
                        value[s + 1, to, to_lane] = total
                        came[s + 1, to, to_lane] = d
                        next_low, next_high = min(next_low, to), max(next_high, to)
        if not alive:
            break
        low, high = next_low, next_high
    if best_s < 0:
        return NO_WAY
    ways.slots[v] = best_s
    offset, lane = best_offset, best_lane
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
def follow(table, ways, costs, v, cells):
    """Lay an old way, if it still is one, and nobody is in it; tell whether it was laid.

    `cells`: columns and lanes at the beginning of each slot. It need not reach the road's end.
    """
    slots, columns, lanes, fan = table.load.shape
    if len(cells) == 0 or cells[0, 0] != ways.column[v, 0] or cells[0, 1] != ways.lane[v, 0]:
        return False
    s = 0
    while s < slots and not table.gone[s, ways.column[v, s]]:
        if s + 1 >= len(cells):
            return False
        column, lane = ways.column[v, s], ways.lane[v, s]
        made = -1
        for d in range(fan):
            if cells[s + 1, 0] - column == table.steps[d, 0]:
                if cells[s + 1, 1] - lane == table.steps[d, 1]:
                    made = d
        if made < 0 or table.load[s, column, lane, made] > 0:
            return False
        if made > 0 and not _may_move(table, s, column, lane, made):
            return False
        ways.made[v, s] = made
        ways.column[v, s + 1], ways.lane[v, s + 1] = cells[s + 1, 0], cells[s + 1, 1]
        s += 1
    ways.slots[v] = s
    ways.cost[v] = own_cost(ways, costs, v)
    return True


@njit(cache=True, nogil=True)
def stay(table, ways, costs, v):
    """Lay the way of a vehicle that stays in its cell."""
    s = 0
    while s < len(table.load) and not table.gone[s, ways.column[v, s]]:
        ways.column[v, s + 1], ways.lane[v, s + 1] = ways.column[v, s], ways.lane[v, s]
        ways.made[v, s] = 0
        s += 1
    ways.slots[v] = s
    ways.cost[v] = own_cost(ways, costs, v)


@njit(cache=True, nogil=True)
def find_victims(table, ways, v, victims):
    """List those in the table whose moves conflict with a way that is not in it; return how many."""
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
def save(ways, saved, count, v):
    """Keep a vehicle's way as number `count`."""
    saved.who[count] = v
    saved.slots[count] = ways.slots[v]
    saved.cost[count] = ways.cost[v]
    saved.column[count] = ways.column[v]
    saved.lane[count] = ways.lane[v]
    saved.made[count] = ways.made[v]


@njit(cache=True, nogil=True)
def restore(table, ways, saved, begin, count):
    """Put kept ways back into the table, instead of what is there of the same vehicles."""
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
