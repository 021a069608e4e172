"""Compiled code of `joint_search`; see `multipliers_kernel` for its style.

Each vehicle of a state is one number, its code: cell * `base` + label, where the label is 2 * team,
plus 1 if the vehicle is active. The codes of a state are sorted. A key of the open list contains
the lower bound F of a state, the cost g so far (the higher one first) and the number of the state.
"""

from __future__ import annotations

import numpy as np
from numba import njit

RUNNING, FULL, FOUND, EMPTY = range(4)
"""Outcomes: the work is done; the arrays are full; the start is found; the open list is empty."""
STATES, OPEN, CURRENT, DEPTH, EXPANDED_AT, NEXT, BOUND, CUT, HEAD = range(9)
"""Indices of `Progress.head`: number of states; size of the open list; state that is expanded, or
-1; vehicle whose moves are tried; the F of this expansion, and the lowest one above it; highest F
so far; whether states with an F of `MAX_COST` and more were left out. `HEAD`: their number."""
MAX_COST = 1 << 15
_COST_BITS, _STATE_BITS = 15, 32


@njit(cache=True, nogil=True)
def add_goals(arrays, store, progress, slot_team, eligible):
    """Open a state for each choice of targets from which the start can be reached.

    There must be room for all. slot_team: (N,) team of each vehicle, ascending; eligible: (K, J)
    cells that the vehicles of a team may take, padded with -1.
    """
    vehicles = len(slot_team)
    taken, code = np.zeros(vehicles, np.int64), np.zeros(vehicles, np.int64)
    made = np.zeros(vehicles, np.int8)
    last = np.empty(vehicles, np.int64)  # so that enough cells remain for the rest of the team
    for slot in range(vehicles - 1, -1, -1):
        team = slot_team[slot]
        if slot < vehicles - 1 and slot_team[slot + 1] == team:
            last[slot] = last[slot + 1] - 1
        else:
            last[slot] = np.sum(eligible[team] >= 0) - 1
    depth = 0
    taken[0] = -1
    while depth >= 0:
        team = slot_team[depth]
        taken[depth] += 1
        if taken[depth] > last[depth]:
            depth -= 1
            continue
        cell = eligible[team, taken[depth]]
        code[depth] = cell * arrays.base + 2 * team
        free = True
        for other in range(depth):
            free = free and code[other] // arrays.base != cell
        if not free:
            continue
        if depth < vehicles - 1:
            depth += 1
            # The vehicles of a team take their cells in order.
            taken[depth] = taken[depth - 1] if slot_team[depth] == team else -1
            continue
        bound = 0
        for vehicle in range(vehicles):
            steps = arrays.steps[slot_team[vehicle], code[vehicle] // arrays.base]
            bound = -1 if steps < 0 or bound < 0 else bound + steps
        if bound >= MAX_COST:
            progress.head[CUT] = 1
        elif bound >= 0:
            _open(store, progress, code, bound, 0, -1, made)


@njit(cache=True, nogil=True)
def search(arrays, store, progress, below, work):
    """Try up to `work` moves, and return the outcome.

    A state that is taken from the open list counts as a move. States with an F of at least `below`,
    which must not grow, are left out.
    """
    head = progress.head
    while work > 0:
        if _is_full(store, head):
            return FULL
        if head[CURRENT] < 0:
            if head[OPEN] == 0:
                return EMPTY
            work -= 1
            key = _pop(store.heap, head)
            state = key & ((1 << _STATE_BITS) - 1)
            bound = key >> (_STATE_BITS + _COST_BITS)
            if bound >= below:
                return EMPTY
            head[BOUND] = max(head[BOUND], bound)
            head[CURRENT] = state
            if _is_start(arrays, store.codes[state]):
                return FOUND
            _begin(arrays, store.codes[state], progress)
            head[EXPANDED_AT] = bound
        work -= _expand(arrays, store, progress, below, work)
    return RUNNING


@njit(cache=True)
def _is_start(arrays, codes):
    """Return whether all vehicles are at their starts; some of them may never have moved."""
    at_start = True
    for i in range(len(codes)):
        at_start = at_start and codes[i] | 1 == arrays.start[i]
    return at_start


@njit(cache=True)
def _begin(arrays, codes, progress):
    """Set what vehicles i and later contribute at least to the F of a state before this one."""
    head, active, longest, rest = progress.head, progress.active, progress.longest, progress.rest
    head[DEPTH], head[NEXT] = 0, MAX_COST
    progress.choice[0] = -1
    for i in range(len(codes) - 1, -1, -1):
        cell, label = codes[i] // arrays.base, codes[i] % arrays.base
        steps = arrays.steps[label >> 1, cell]
        active[i] = active[i + 1] + (label & 1)
        longest[i] = max(longest[i + 1], steps - 1)
        rest[i] = rest[i + 1] + (0 if label & 1 else steps)


@njit(cache=True)
def _expand(arrays, store, progress, below, work):
    """Open those predecessors of the current state that have the F of its expansion.

    Returns the number of moves that were tried. After the last move, the state is opened again with
    the next higher F.
    """
    head, choice = progress.head, progress.choice
    state, bound, depth = head[CURRENT], head[EXPANDED_AT], head[DEPTH]
    codes, cost = store.codes[state], store.cost[state]
    vehicles, displacements, base = len(codes), len(arrays.step), arrays.base
    tried = 0
    while tried < work:
        tried += 1
        choice[depth] += 1
        d = choice[depth]
        if d >= displacements:
            depth -= 1
            if depth < 0:
                head[CURRENT] = -1
                if head[NEXT] < min(below, MAX_COST):
                    _push(store.heap, head, _key(head[NEXT], cost, state))
                return tried
            continue
        cell, label = codes[depth] // base, codes[depth] % base
        origin = arrays.from_cell[d, cell]
        if origin < 0 or not arrays.drives[label >> 1, d]:
            continue
        steps = arrays.steps[label >> 1, origin]
        if steps < 0:
            continue
        if d != 0:
            label |= 1
        active = progress.active_to[depth] + (label & 1)
        longest = max(progress.longest_to[depth], steps)
        rest = progress.rest_to[depth] + (0 if label & 1 else steps)
        least = (active + progress.active[depth + 1]) * (
            1 + max(longest, progress.longest[depth + 1])
        )
        least += cost + rest + progress.rest[depth + 1]
        if least > bound:
            if least >= MAX_COST:
                head[CUT] = 1
            elif least < head[NEXT] and not _conflicts(arrays, progress, depth, origin, d):
                head[NEXT] = least
            continue
        if _conflicts(arrays, progress, depth, origin, d):
            continue
        progress.column[depth], progress.lane[depth] = origin // arrays.lanes, origin % arrays.lanes
        progress.code[depth] = origin * base + label
        depth += 1
        if depth < vehicles:
            progress.active_to[depth], progress.longest_to[depth] = active, longest
            progress.rest_to[depth] = rest
            choice[depth] = -1
            continue
        depth -= 1
        if least == bound:  # those with less are open already
            _open(store, progress, progress.code, bound, cost + active, state, choice)
            if _is_full(store, head):
                break
    head[DEPTH] = depth
    return tried


@njit(cache=True)
def _conflicts(arrays, progress, vehicle, origin, d):
    """Return whether a move conflicts with one that was chosen for an earlier vehicle."""
    columns_reach, lanes_reach = arrays.reach[0], arrays.reach[1]
    column = origin // arrays.lanes - columns_reach
    lane = origin % arrays.lanes - lanes_reach
    for other in range(vehicle):
        c, across = progress.column[other] - column, progress.lane[other] - lane
        if (
            0 <= c <= 2 * columns_reach
            and 0 <= across <= 2 * lanes_reach
            and arrays.conflicts[d, c, across, progress.choice[other]]
        ):
            return True
    return False


@njit(cache=True)
def _open(store, progress, code, bound, cost, after, made):
    """Open a state, given by codes in any order, unless it is known.

    A known state was reached at no higher cost, because states are opened in ascending order of F.
    after: the state that follows, or -1; made: the displacements on the way to it, in its order.
    """
    head, codes = progress.head, progress.ordered
    vehicles = len(codes)
    for i in range(vehicles):
        k = i
        while k > 0 and codes[k - 1] > code[i]:
            codes[k] = codes[k - 1]
            k -= 1
        codes[k] = code[i]
    slot = _slot(store, codes)
    if store.slot[slot] >= 0:
        return
    state = head[STATES]
    head[STATES] += 1
    store.slot[slot] = state
    store.codes[state] = codes
    store.cost[state], store.after[state] = cost, after
    for i in range(vehicles):
        store.made[state, i] = made[i]
    _push(store.heap, head, _key(bound, cost, state))


@njit(cache=True)
def _slot(store, codes):
    """Return the slot of the hash table that contains a state, or a free one for it."""
    mask = np.uint64(len(store.slot) - 1)
    hashed = np.uint64(14695981039346656037)  # FNV-1a, with codes instead of bytes
    for code in codes:
        hashed = (hashed ^ np.uint64(code)) * np.uint64(1099511628211)
    slot = (hashed ^ (hashed >> np.uint64(29))) & mask
    while store.slot[slot] >= 0:
        known = store.codes[store.slot[slot]]
        same = True
        for i in range(len(codes)):
            if known[i] != codes[i]:
                same = False
                break
        if same:
            break
        slot = (slot + np.uint64(1)) & mask
    return slot


@njit(cache=True, nogil=True)
def fill_slots(store, states):
    """Enter all states in an empty hash table."""
    for state in range(states):
        store.slot[_slot(store, store.codes[state])] = state


@njit(cache=True)
def _is_full(store, head):
    """Return whether there may be no room for one more state."""
    return head[STATES] + 1 >= len(store.cost) or head[OPEN] + 2 >= len(store.heap)


@njit(cache=True)
def _key(bound, cost, state):
    return (((bound << _COST_BITS) | (MAX_COST - 1 - cost)) << _STATE_BITS) | state


@njit(cache=True)
def _push(heap, head, key):
    i = head[OPEN]
    head[OPEN] += 1
    while i > 0 and heap[(i - 1) >> 1] > key:
        heap[i] = heap[(i - 1) >> 1]
        i = (i - 1) >> 1
    heap[i] = key


@njit(cache=True)
def _pop(heap, head):
    first = heap[0]
    head[OPEN] -= 1
    count = head[OPEN]
    key, i = heap[count], 0
    while 2 * i + 1 < count:
        child = 2 * i + 1
        if child + 1 < count and heap[child + 1] < heap[child]:
            child += 1
        if heap[child] >= key:
            break
        heap[i] = heap[child]
        i = child
    heap[i] = key
    return first
