"""Compiled code of the rolling planner: paths of single vehicles.

The style is that of `exact.multipliers_kernel`. The table of a window holds, for each move (slot,
cell, displacement), the total penalty of all vehicles whose moves conflict with it (`load`). Adding
a vehicle to the table or removing it changes a few entries; the search for a path only reads them.
"""

from __future__ import annotations

import numpy as np
from numba import njit

FIXED = 100_000
"""Penalty of a vehicle that cannot be moved."""
PENALTY = 8
"""Initial penalty of a conflict with a vehicle."""
ENTERING = 8
"""Penalty factor of a conflicting move. The factor is 1 for waiting in the cell in which the other
vehicle waits, so that taking its place is not penalized again in each slot."""
MAX_EJECTED = 100
"""Maximum number of ejections in one ejection chain."""
_IMPASSABLE = 5e3
"""Cost at which paths are rejected, and factor of forbidden conflicts. Conflict-free paths cost at
most a quarter of this."""
UNREACHED = 1e9
NO_PATH = 1e9
"""Cost of a vehicle without a path."""


@njit(cache=True, nogil=True)
def put(table, paths, v, sign):
    """Add a vehicle's path to the table (sign 1), or remove it (sign -1)."""
    load, vehicle, move = table.load, table.vehicle, table.move
    offsets, first = table.offsets, table.first
    _, _, lanes, columns = load.shape
    amount = sign * paths.penalty[v]
    for s in range(paths.slots[v]):
        column, lane, d = paths.column[v, s], paths.lane[v, s], paths.move[v, s]
        if sign > 0:
            vehicle[s, lane, column] = v
            move[s, lane, column] = d
        else:
            vehicle[s, lane, column] = -1
        for k in range(first[d], first[d + 1]):
            c, n = column + offsets[k, 0], lane + offsets[k, 1]
            if 0 <= c < columns and 0 <= n < lanes:
                load[s, offsets[k, 2], n, c] += amount * offsets[k, 3]
    paths.placed[v] = sign > 0


@njit(cache=True, nogil=True)
def _relax(here, there, load, base, scale):
    """Relax one displacement for neighbouring columns; compiled to vector instructions."""
    for i in range(len(here)):
        there[i] = min(there[i], here[i] + base + scale * load[i])


@njit(cache=True, nogil=True)
def _relax_permitted(here, there, load, forbidden, place, base, scale):
    """Relax one displacement, as `_relax`, for a group of types that may not make all moves.

    `place`: index in `forbidden` of the first column.
    """
    group, s, d, lane, first = place
    extra = forbidden[group, s, d, lane, first : first + len(here)]
    for i in range(len(here)):
        there[i] = min(there[i], here[i] + base + scale * load[i] + extra[i])


@njit(cache=True, nogil=True)
def find_path(table, paths, costs, v, softness, upper_bound, scratch):
    """Set the cheapest path of a vehicle that is not in the table; return the path's own cost.

    Dynamic programming over slots, lanes and columns, for a path below `upper_bound`. If softness
    is 0, conflicts are forbidden; otherwise a conflict costs softness per `PENALTY`, and only
    `FIXED` vehicles are avoided. If there is no such path, returns `NO_PATH` and sets nothing.
    """
    load, steps, of_move, value = table.load, table.steps, costs.of_move, scratch.value
    zone, left, row = table.zone, table.left, scratch.row
    forbidden, group = table.forbidden, paths.group[v]
    scratch.searches[0] += 1
    slots, fan, lanes, _ = load.shape
    scale = np.float32(softness / (PENALTY * ENTERING) if softness > 0.0 else _IMPASSABLE)
    # Offsets in `value` are columns minus this.
    shift = paths.column[v, 0] - (value.shape[2] // 2)
    value[:] = UNREACHED
    low = high = value.shape[2] // 2
    value[0, paths.lane[v, 0], low] = 0.0
    best, best_s, best_offset, best_lane = min(upper_bound, _IMPASSABLE), -1, 0, 0
    for s in range(slots + 1):
        for lane in range(lanes):
            for offset in range(max(low, table.first_left[s, lane] - shift), high + 1):
                if s < slots and not left[s, lane, offset + shift]:
                    continue
                total = value[s, lane, offset]
                if total < best:
                    if not paths.target[v, zone[s, lane, offset + shift]]:
                        total += paths.missing_cost[v]
                    if total < best:
                        best, best_s, best_offset, best_lane = total, s, offset, lane
                value[s, lane, offset] = UNREACHED
        high = min(high, table.road_end[s] - 1 - shift)
        if s == slots or high < low:
            break
        moves = (
            low + shift <= table.moving_columns[s, 1] and high + shift >= table.moving_columns[s, 0]
        )
        for lane in range(lanes):
            here = value[s, lane, low : high + 1]
            stay_cost = np.float32(0.0)
            if table.mixed[lane]:
                for i in range(len(here)):
                    row[i] = here[i] + paths.zone_cost[v, zone[s, lane, low + shift + i]]
                here = row[: high + 1 - low]
            else:
                stay_cost = paths.zone_cost[v, zone[s, lane, low + shift]]
            for d in range(fan if moves and s >= paths.waits[v] else 1):
                to_lane, to = lane + steps[d, 1], low + steps[d, 0]
                if 0 <= to_lane < lanes and paths.drives[v, d]:
                    base = stay_cost + of_move[d] + (scratch.delay[s] if d > 0 else np.float32(0.0))
                    there = value[s + 1, to_lane, to : to + high + 1 - low]
                    loads = load[s, d, lane, low + shift : high + shift + 1]
                    if group == 0:
                        _relax(here, there, loads, base, scale)
                    else:
                        place = group - 1, s, d, lane, low + shift
                        _relax_permitted(here, there, loads, forbidden, place, base, scale)
        if moves:
            low, high = max(1, low - 1), min(value.shape[2] - 2, high + 1)
    if best_s < 0:
        return NO_PATH
    _trace(table, paths, costs, v, scale, best_s, best_lane, best_offset, scratch)
    return own_cost(table, paths, costs, v)


@njit(cache=True, nogil=True)
def _trace(table, paths, costs, v, scale, slots, lane, offset, scratch):
    """Set the path found by `find_path`, from its end to its beginning."""
    load, steps, value = table.load, table.steps, scratch.value
    forbidden, group = table.forbidden, paths.group[v]
    fan, lanes = load.shape[1:3]
    shift = paths.column[v, 0] - (value.shape[2] // 2)
    paths.slots[v] = slots
    for s in range(slots - 1, -1, -1):
        paths.column[v, s + 1], paths.lane[v, s + 1] = offset + shift, lane
        best, move = np.float32(np.inf), 0
        for d in range(fan if s >= paths.waits[v] else 1):
            before, from_lane = offset - steps[d, 0], lane - steps[d, 1]
            if not (0 <= from_lane < lanes and 1 <= before < value.shape[2] - 1):
                continue
            if not paths.drives[v, d]:
                continue
            if group > 0 and forbidden[group - 1, s, d, from_lane, before + shift] > 0.0:
                continue
            if table.left[s, from_lane, before + shift]:
                continue
            total = value[s, from_lane, before] + costs.of_move[d]
            if d > 0:
                total += scratch.delay[s]
            total += scale * load[s, d, from_lane, before + shift]
            total += paths.zone_cost[v, table.zone[s, from_lane, before + shift]]
            if total < best:
                best, move = total, d
        paths.move[v, s] = move
        offset, lane = offset - steps[move, 0], lane - steps[move, 1]


@njit(cache=True, nogil=True)
def own_cost(table, paths, costs, v):
    """Return the cost of a vehicle's path without penalties."""
    total, slots = 0.0, paths.slots[v]
    for s in range(slots):
        total += costs.of_move[paths.move[v, s]]
        total += paths.zone_cost[v, table.zone[s, paths.lane[v, s], paths.column[v, s]]]
    if not paths.target[v, table.zone[slots, paths.lane[v, slots], paths.column[v, slots]]]:
        total += paths.missing_cost[v]
    return total


@njit(cache=True, nogil=True)
def follow(table, paths, costs, v, cells):
    """Set an earlier path if it is still valid and conflict-free; return whether it was set.

    `cells`: columns and lanes at the beginning of each slot, up to the end of its last section.
    """
    slots, fan = table.load.shape[:2]
    if len(cells) == 0 or cells[0, 0] != paths.column[v, 0] or cells[0, 1] != paths.lane[v, 0]:
        return False
    s, group = 0, paths.group[v]
    while s < slots and not table.left[s, paths.lane[v, s], paths.column[v, s]]:
        if s + 1 >= len(cells):
            return False
        column, lane = paths.column[v, s], paths.lane[v, s]
        move = -1
        for d in range(fan):
            step = table.steps[d]
            if cells[s + 1, 0] == column + step[0] and cells[s + 1, 1] == lane + step[1]:
                move = d
        if move < 0 or not paths.drives[v, move] or table.load[s, move, lane, column] > 0.0:
            return False
        if move > 0 and s < paths.waits[v]:
            return False
        if group > 0 and table.forbidden[group - 1, s, move, lane, column] > 0.0:
            return False
        paths.move[v, s] = move
        paths.column[v, s + 1], paths.lane[v, s + 1] = cells[s + 1, 0], cells[s + 1, 1]
        s += 1
    paths.slots[v] = s
    paths.cost[v] = own_cost(table, paths, costs, v)
    return True


@njit(cache=True, nogil=True)
def stay(table, paths, costs, v):
    """Set the path of a vehicle that stays in its cell."""
    s = 0
    column, lane = paths.column[v, 0], paths.lane[v, 0]
    while s < len(table.load) and not table.left[s, lane, column]:
        paths.column[v, s + 1], paths.lane[v, s + 1] = column, lane
        paths.move[v, s] = 0
        s += 1
    paths.slots[v] = s
    paths.cost[v] = own_cost(table, paths, costs, v)


@njit(cache=True, nogil=True)
def find_hit(table, paths, v, hit):
    """List the vehicles in conflict with a path that is not in the table; return how many."""
    load, vehicle, move = table.load, table.vehicle, table.move
    offsets, first = table.offsets, table.first
    _, _, lanes, columns = load.shape
    count = 0
    for s in range(paths.slots[v]):
        column, lane, d = paths.column[v, s], paths.lane[v, s], paths.move[v, s]
        if load[s, d, lane, column] == 0:
            continue
        for k in range(first[d], first[d + 1]):
            c, n = column + offsets[k, 0], lane + offsets[k, 1]
            if 0 <= c < columns and 0 <= n < lanes:
                u = vehicle[s, n, c]
                if u >= 0 and move[s, n, c] == offsets[k, 2]:
                    known = False
                    for i in range(count):
                        known |= hit[i] == u
                    if not known:
                        hit[count] = u
                        count += 1
    return count


@njit(cache=True, nogil=True)
def save(paths, saved, count, v):
    """Save a vehicle's path at index `count`."""
    saved.vehicle[count] = v
    saved.slots[count] = paths.slots[v]
    saved.cost[count] = paths.cost[v]
    saved.column[count] = paths.column[v]
    saved.lane[count] = paths.lane[v]
    saved.move[count] = paths.move[v]


@njit(cache=True, nogil=True)
def restore(table, paths, saved, begin, count):
    """Restore saved paths in the table, replacing the current paths of these vehicles."""
    for i in range(begin, count):
        if paths.placed[saved.vehicle[i]]:
            put(table, paths, saved.vehicle[i], -1)
    for i in range(begin, count):
        v = saved.vehicle[i]
        paths.slots[v] = saved.slots[i]
        paths.cost[v] = saved.cost[i]
        paths.column[v] = saved.column[i]
        paths.lane[v] = saved.lane[i]
        paths.move[v] = saved.move[i]
        put(table, paths, v, 1)
