"""Compiled code of `stream`: ways of single vehicles; see `relaxation_kernel` for its style.

The table of a window says, for each slot, cell and displacement, what it costs that somebody is in
the way: the sum of the prices of all vehicles whose own moves conflict (`load`). Putting a vehicle
into the table and taking it out again changes a few entries; looking one up is all that the search
for a way needs.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from laneweave.coordinator.planning.rolling.arrays import ENTERING, PRICE

_IMPASSABLE = 5e3
"""More than all that a way may cost; less than being in the way of what is `FIXED`, in chains for
somebody who misses its lane. Others have a way at a hundredth of that."""
_UNREACHED = 1e9
NO_WAY = 1e9
"""Cost of a vehicle that has no way."""


@njit(cache=True, nogil=True)
def put(table, ways, v, sign):
    """Put a vehicle's way into the table (sign 1), or take it out (sign -1)."""
    load, who, made, offsets, first = table.load, table.who, table.made, table.offsets, table.first
    _, _, lanes, columns = load.shape
    amount = sign * ways.price[v]
    for s in range(ways.slots[v]):
        column, lane, d = ways.column[v, s], ways.lane[v, s], ways.made[v, s]
        if sign > 0:
            who[s, lane, column] = v
            made[s, lane, column] = d
        else:
            who[s, lane, column] = -1
        for k in range(first[d], first[d + 1]):
            c, n = column + offsets[k, 0], lane + offsets[k, 1]
            if 0 <= c < columns and 0 <= n < lanes:
                load[s, offsets[k, 2], n, c] += amount * offsets[k, 3]
    ways.placed[v] = sign > 0


@njit(cache=True, nogil=True)
def _relax(here, there, load, base, scale):
    """Offer what a displacement of neighbouring columns costs; compiled to vector instructions."""
    for i in range(len(here)):
        there[i] = min(there[i], here[i] + base + scale * load[i])


@njit(cache=True, nogil=True)
def find_way(table, ways, costs, v, softness, ceiling, scratch):
    """Lay the cheapest way of a vehicle that is not in the table; return what it costs by itself.

    A way below `ceiling` is looked for, by dynamic programming over slots, lanes and columns. With
    a softness of 0 nobody may be in its way; otherwise that costs softness for each least price,
    and only what is `FIXED` is never passed. Without such a way: `NO_WAY`, and nothing is laid.
    """
    load, steps, of_move, value = table.load, table.steps, costs.of_move, scratch.value
    scratch.laid[0] += 1
    slots, fan, lanes, _ = load.shape
    wanted = ways.wanted[v]
    scale = np.float32(softness / (PRICE * ENTERING) if softness > 0.0 else _IMPASSABLE)
    # Offsets in `value` are columns less this.
    shift = ways.column[v, 0] - (value.shape[2] // 2)
    value[:] = _UNREACHED
    low = high = value.shape[2] // 2
    value[0, ways.lane[v, 0], low] = 0.0
    best, best_s, best_offset, best_lane = min(ceiling, _IMPASSABLE), -1, 0, 0
    for s in range(slots + 1):
        end = table.ended[s] - shift if s < slots else low
        for lane in range(lanes):
            for offset in range(max(low, end), high + 1):
                total = value[s, lane, offset] + (0.0 if lane == wanted else ways.missing[v])
                if total < best:
                    best, best_s, best_offset, best_lane = total, s, offset, lane
        high = min(high, end - 1)
        if high < low:
            break
        moves = low + shift <= table.opened[s, 1] and high + shift >= table.opened[s, 0]
        for lane in range(lanes):
            here = value[s, lane, low : high + 1]
            for d in range(fan if moves else 1):
                to_lane, to = lane + steps[d, 1], low + steps[d, 0]
                if 0 <= to_lane < lanes:
                    base = of_move[d] + (scratch.delay[s] if d > 0 else np.float32(0.0))
                    if lane != wanted:
                        base += costs.off_lane
                    there = value[s + 1, to_lane, to : to + high + 1 - low]
                    loads = load[s, d, lane, low + shift : high + shift + 1]
                    _relax(here, there, loads, base, scale)
        if moves:
            low, high = max(1, low - 1), min(value.shape[2] - 2, high + 1)
    if best_s < 0:
        return NO_WAY
    _trace(table, ways, costs, v, scale, best_s, best_lane, best_offset, scratch)
    return own_cost(ways, costs, v)


@njit(cache=True, nogil=True)
def _trace(table, ways, costs, v, scale, slots, lane, offset, scratch):
    """Lay the way that `find_way` has found, from its end to its beginning."""
    load, steps, value = table.load, table.steps, scratch.value
    fan, lanes = load.shape[1:3]
    shift = ways.column[v, 0] - (value.shape[2] // 2)
    ways.slots[v] = slots
    for s in range(slots - 1, -1, -1):
        ways.column[v, s + 1], ways.lane[v, s + 1] = offset + shift, lane
        best, made = np.float32(np.inf), 0
        for d in range(fan):
            before, from_lane = offset - steps[d, 0], lane - steps[d, 1]
            if not (0 <= from_lane < lanes and 1 <= before < value.shape[2] - 1):
                continue
            if before + shift >= table.ended[s]:
                continue
            total = value[s, from_lane, before] + costs.of_move[d]
            if d > 0:
                total += scratch.delay[s]
            total += scale * load[s, d, from_lane, before + shift]
            if from_lane != ways.wanted[v]:
                total += costs.off_lane
            if total < best:
                best, made = total, d
        ways.made[v, s] = made
        offset, lane = offset - steps[made, 0], lane - steps[made, 1]


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
    slots, fan = table.load.shape[:2]
    if len(cells) == 0 or cells[0, 0] != ways.column[v, 0] or cells[0, 1] != ways.lane[v, 0]:
        return False
    s = 0
    while s < slots and ways.column[v, s] < table.ended[s]:
        if s + 1 >= len(cells):
            return False
        column, lane = ways.column[v, s], ways.lane[v, s]
        made = -1
        for d in range(fan):
            step = table.steps[d]
            if cells[s + 1, 0] == column + step[0] and cells[s + 1, 1] == lane + step[1]:
                made = d
        if made < 0 or table.load[s, made, lane, column] > 0.0:
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
    while s < len(table.load) and ways.column[v, s] < table.ended[s]:
        ways.column[v, s + 1], ways.lane[v, s + 1] = ways.column[v, s], ways.lane[v, s]
        ways.made[v, s] = 0
        s += 1
    ways.slots[v] = s
    ways.cost[v] = own_cost(ways, costs, v)


@njit(cache=True, nogil=True)
def find_victims(table, ways, v, victims):
    """List those whose moves conflict with a way that is not in the table; return how many."""
    load, who, made, offsets, first = table.load, table.who, table.made, table.offsets, table.first
    _, _, lanes, columns = load.shape
    count = 0
    for s in range(ways.slots[v]):
        column, lane, d = ways.column[v, s], ways.lane[v, s], ways.made[v, s]
        if load[s, d, lane, column] == 0:
            continue
        for k in range(first[d], first[d + 1]):
            c, n = column + offsets[k, 0], lane + offsets[k, 1]
            if 0 <= c < columns and 0 <= n < lanes:
                u = who[s, n, c]
                if u >= 0 and made[s, n, c] == offsets[k, 2]:
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
