"""Compiled code of `sweep`.

Types are inferred when it is compiled, calls and objects cost more than in Python's own scale of
things: so there are no annotations here, few functions, and arrays are handed on one by one where
it matters.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from laneweave.coordinator.planning.arrays import UNREACHABLE, Floats, Ints

DEAD, SOLVED, OVER_LIMIT, TOO_WIDE = 0, 1, 2, 3
"""How a sweep ends: nothing is possible within the budget; a solution; more partial solutions than
allowed; too many moves cross one line to be told apart."""

PARK, NOBODY = 14, 15
"""In the record of a cell's occupant, beside its displacement: it arrives, or there is none."""
_MOST_CROSSINGS = 64
_MOST_SETS = 32_768
_TOLERANCE = 1e-6
_EQUAL = 1e-7


class _Crossings(NamedTuple):
    """Moves across one line, and the sets of them that came up, for each step."""

    listed: Ints
    """(T,)."""
    team: Ints
    """(T, 64)."""
    displacement: Ints
    cell: Ints
    """Their from-cells."""
    set_count: Ints
    """(T,)."""
    members: NDArray[np.uint64]
    """(T, sets) each set as bits."""


@njit(cache=True)
def _no_crossings(steps, sets):
    most = _MOST_CROSSINGS
    return _Crossings(
        np.zeros(steps, np.int64),
        np.zeros((steps, most), np.int64),
        np.zeros((steps, most), np.int64),
        np.zeros((steps, most), np.int64),
        np.ones(steps, np.int64),
        np.zeros((steps, sets), np.uint64),
    )


@njit(cache=True)
def _wider(crossings):
    steps, sets = crossings.members.shape
    members = np.zeros((steps, 2 * sets), np.uint64)
    members[:, :sets] = crossings.members
    return _Crossings(
        crossings.listed,
        crossings.team,
        crossings.displacement,
        crossings.cell,
        crossings.set_count,
        members,
    )


@njit(cache=True)
def _collect(course, column, t, budget, crossings):
    """List the moves across the line after a column that a solution may make; false: too many."""
    lattice, penalties = course.lattice, course.penalties
    count = 0
    if column + 1 < lattice.columns:
        for k in range(penalties.move.shape[0]):
            for d in range(len(lattice.along)):
                if lattice.along[d] == 0:
                    continue
                home = column if lattice.along[d] > 0 else column + 1
                for lane in range(lattice.lanes):
                    cell = home * lattice.lanes + lane
                    paid = penalties.reach[k, t, cell] + penalties.move[k, t, d, cell]
                    if paid > budget + _TOLERANCE:
                        continue
                    if count == _MOST_CROSSINGS:
                        return False
                    crossings.team[t, count] = k
                    crossings.displacement[t, count] = d
                    crossings.cell[t, count] = cell
                    count += 1
    crossings.listed[t] = count
    crossings.set_count[t] = 0
    return True


@njit(cache=True)
def _conflicts(table, lanes, d, cell, moves, chosen):
    """Tell whether a move conflicts with one of the first `chosen` moves."""
    column, lane = cell // lanes, cell % lanes
    for i in range(chosen):
        other = moves[i, 1]
        ahead = other // lanes - column + 2
        left = other % lanes - lane + 2
        if 0 <= ahead <= 4 and 0 <= left <= 4 and table[d, moves[i, 0], ahead, left]:
            return True
    return False


class _Work(NamedTuple):
    """Room for the enumeration of one column's moves in one step."""

    before: Ints
    """(lanes,) who is there and has not been dealt with."""
    after: Ints
    """(lanes,) who is there after the step."""
    record: Ints
    """(lanes,) what the occupant of each cell does."""
    active: Ints
    """(lanes,) lanes of the vehicles that choose."""
    moves: Ints
    """(most moves, 2) displacement and from-cell of what has been chosen."""
    option: Ints
    """(most moves,) the choice at each depth."""
    paid: Floats
    """(most moves,) penalties at each depth, credits included: may rise and fall."""
    spent: Floats
    """(most moves,) reduced costs at each depth: only rise."""
    moved: Ints
    """(most moves,) vehicles of the column that move."""
    crossing: NDArray[np.uint64]
    """(most moves,) moves across the line ahead, as bits."""


@njit(cache=True)
def _work(lanes):
    most = 4 * lanes + 8
    return _Work(
        np.zeros(lanes, np.int64),
        np.zeros(lanes, np.int64),
        np.zeros(lanes, np.int64),
        np.zeros(lanes, np.int64),
        np.zeros((most, 2), np.int64),
        np.zeros(most, np.int64),
        np.zeros(most),
        np.zeros(most),
        np.zeros(most, np.int64),
        np.zeros(most, np.uint64),
    )


class _Transitions(NamedTuple):
    """What can follow on the occupants of a column and the crossings behind it."""

    after: Ints
    crossing: NDArray[np.uint16]
    """Number of the set of crossings ahead."""
    penalty: Floats
    moved: Ints
    record: NDArray[np.uint64]


@njit(cache=True)
def _transitions(size):
    return _Transitions(
        np.empty(size, np.int64),
        np.empty(size, np.uint16),
        np.empty(size),
        np.empty(size, np.int64),
        np.empty(size, np.uint64),
    )


@njit(cache=True)
def _more_transitions(old):
    size = len(old.after)
    new = _transitions(2 * size)
    new.after[:size] = old.after
    new.crossing[:size] = old.crossing
    new.penalty[:size] = old.penalty
    new.moved[:size] = old.moved
    new.record[:size] = old.record
    return new


@njit(cache=True)
def _arrange(course, work, column, t, occupants, behind, members):
    """Carry out what is decided already: crossings behind the column, and who has arrived.

    Returns:
        The number of moves, the penalties, the vehicles that move; no moves: -1, impossible.
    """
    lattice = course.lattice
    lanes, table = lattice.lanes, lattice.conflict
    labels = course.penalties.move.shape[0] + 2
    arrived = labels - 1
    for lane in range(lanes):
        work.before[lane] = occupants % labels
        occupants //= labels
        work.after[lane] = 0
        work.record[lane] = NOBODY
    count, moved = 0, 0
    paid = course.unused[column, t]
    if column > 0:
        for i in range(behind.listed[t]):
            if not (members >> np.uint64(i)) & np.uint64(1):
                continue
            d, cell = behind.displacement[t, i], behind.cell[t, i]
            label = behind.team[t, i] + 1
            lane = cell % lanes
            if lattice.along[d] > 0:
                work.after[lane + lattice.across[d]] = label
                paid -= course.credit_to[t, d, cell]
            else:
                if work.before[lane] != label:
                    return -1, paid, moved
                work.before[lane] = 0
                work.record[lane] = d
                paid -= course.credit_from[t, d, cell]
                moved += 1
            work.moves[count, 0] = d
            work.moves[count, 1] = cell
            count += 1
    for lane in range(lanes):
        if work.before[lane] == arrived:
            cell = column * lanes + lane
            if _conflicts(table, lanes, 0, cell, work.moves, count):
                return -1, paid, moved
            work.moves[count, 0] = 0
            work.moves[count, 1] = cell
            count += 1
            work.after[lane] = arrived
            paid -= course.credit_from[t, 0, cell]
    return count, paid, moved


@njit(cache=True)
def _number_of_set(ahead, t, members):
    """Return the number of a set of crossings; -1: there is no room for a new one."""
    count = ahead.set_count[t]
    for i in range(count):
        if ahead.members[t, i] == members:
            return i
    if count == ahead.members.shape[1]:
        return -1
    ahead.members[t, count] = members
    ahead.set_count[t] = count + 1
    return count


@njit(cache=True)
def _expand(course, work, column, t, occupants, behind, members, ahead, budgets, out, filled):
    """Write all that may happen in a column in a step; return where the output ends then.

    Vehicles of the column choose one after the other: stay, change lanes, leave ahead, arrive.
    Then vehicles from ahead come in. -1: the output is full; -2: there are too many sets.
    """
    lattice, penalties = course.lattice, course.penalties
    lanes, displacements, table = lattice.lanes, len(lattice.along), lattice.conflict
    along, across = lattice.along, lattice.across
    move, arrival, reach = penalties.move, penalties.arrival, penalties.reach
    budget, whole = budgets
    labels = penalties.move.shape[0] + 2
    fixed, paid, moved = _arrange(course, work, column, t, occupants, behind, members)
    if fixed < 0:
        return filled
    choosers = 0
    for lane in range(lanes):
        if 0 < work.before[lane] < labels - 1:
            work.active[choosers] = lane
            choosers += 1
    depth = 0
    work.option[0] = -1
    work.paid[0], work.spent[0], work.moved[0] = paid, 0.0, moved
    work.crossing[0] = np.uint64(0)
    while depth >= 0:
        chosen = fixed + depth
        option = work.option[depth]
        d, cell, extra, credit, bit = -1, 0, 0.0, 0.0, -1
        if depth < choosers:
            lane = work.active[depth]
            here = column * lanes + lane
            label = work.before[lane]
            k = label - 1
            if option >= 0:  # take the last choice back
                work.record[lane] = NOBODY
                if option == displacements:
                    work.after[lane] = 0
                elif along[option] == 0:
                    work.after[lane + across[option]] = 0
            option += 1
            while option <= displacements:
                step = option if option < displacements else 0
                if option == displacements:
                    goal = course.target[here]
                    possible = goal >= 0
                    if possible:
                        extra = arrival[k, goal, t]
                else:
                    extra = move[k, t, option, here]
                    possible = along[option] >= 0
                    possible = possible and reach[k, t, here] + extra <= whole + _TOLERANCE
                if (
                    possible
                    and work.spent[depth] + extra <= budget + _TOLERANCE
                    and not _conflicts(table, lanes, step, here, work.moves, chosen)
                ):
                    d, cell = step, here
                    break
                option += 1
            if d >= 0:
                credit = course.credit_from[t, d, cell]
                if option == displacements:
                    work.after[lane] = labels - 1
                    work.record[lane] = PARK
                else:
                    work.record[lane] = option
                    if along[option] == 0:
                        work.after[lane + across[option]] = label
                    else:
                        for i in range(ahead.listed[t]):
                            if (
                                ahead.team[t, i] == k
                                and ahead.displacement[t, i] == d
                                and ahead.cell[t, i] == cell
                            ):
                                bit = i
        else:
            if option < 0:  # nobody (more) comes in
                if work.paid[depth] <= budget + _TOLERANCE:
                    if filled == len(out.after):
                        return -1
                    number = _number_of_set(ahead, t, work.crossing[depth])
                    if number < 0:
                        return -2
                    after, power, record = 0, 1, np.uint64(0)
                    for lane in range(lanes):
                        after += work.after[lane] * power
                        power *= labels
                        record |= np.uint64(work.record[lane]) << np.uint64(4 * lane)
                    out.after[filled] = after
                    out.crossing[filled] = number
                    out.penalty[filled] = work.paid[depth]
                    out.moved[filled] = work.moved[depth]
                    out.record[filled] = record
                    filled += 1
                option = work.option[depth - 1] + 1 if depth > choosers else 0
            else:
                other = ahead.cell[t, option]
                landing = other % lanes + across[ahead.displacement[t, option]]
                work.after[landing] = 0
                option += 1
            while option < ahead.listed[t]:
                step, other = ahead.displacement[t, option], ahead.cell[t, option]
                if along[step] < 0:
                    extra = move[ahead.team[t, option], t, step, other]
                    if work.spent[depth] + extra <= budget + _TOLERANCE and not _conflicts(
                        table, lanes, step, other, work.moves, chosen
                    ):
                        d, cell, bit = step, other, option
                        break
                option += 1
            if d >= 0:
                credit = course.credit_to[t, d, cell]
                work.after[cell % lanes + across[d]] = ahead.team[t, option] + 1
        work.option[depth] = option
        if d < 0:
            depth -= 1
            continue
        work.moves[chosen, 0] = d
        work.moves[chosen, 1] = cell
        work.paid[depth + 1] = work.paid[depth] + extra - credit
        work.spent[depth + 1] = work.spent[depth] + extra
        own_move = depth < choosers and d != 0
        work.moved[depth + 1] = work.moved[depth] + (1 if own_move else 0)
        crossing = work.crossing[depth]
        if bit >= 0:
            crossing |= np.uint64(1) << np.uint64(bit)
        work.crossing[depth + 1] = crossing
        depth += 1
        work.option[depth] = -1
    return filled


class _States(NamedTuple):
    """Partial solutions.

    `crossing[i, t]` is the set across the line that is open at step t: the one ahead of the present
    column for the steps that are done, the one behind it for the rest.
    """

    crossing: NDArray[np.uint16]
    """(states, T) numbers of sets."""
    occupants: Ints
    """Who is in the present column: digits for its lanes; 0: nobody, team + 1, or arrived."""
    penalty: Floats
    moved: Ints
    """Moves so far: the fewer of two that are equal otherwise."""
    parent: NDArray[np.int32]
    """Number of the state before the last step."""
    record: NDArray[np.uint64]
    """What the column's vehicles did in the last step, four bits for each lane."""


@njit(cache=True)
def _states(size, steps):
    return _States(
        np.zeros((size, steps), np.uint16),
        np.zeros(size, np.int64),
        np.zeros(size),
        np.zeros(size, np.int64),
        np.zeros(size, np.int32),
        np.zeros(size, np.uint64),
    )


@njit(cache=True)
def _chosen(old, numbers, size):
    """Return some states, with room for `size`."""
    new = _states(size, old.crossing.shape[1])
    for i in range(len(numbers)):
        j = numbers[i]
        new.crossing[i] = old.crossing[j]
        new.occupants[i] = old.occupants[j]
        new.penalty[i] = old.penalty[j]
        new.moved[i] = old.moved[j]
        new.parent[i] = old.parent[j]
        new.record[i] = old.record[j]
    return new


@njit(cache=True)
def _mixed(value):
    """Return a hash of a number (finalizer of SplitMix64)."""
    value = (value ^ (value >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    value = (value ^ (value >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return value ^ (value >> np.uint64(31))


@njit(cache=True)
def _hash(crossing, i, t, number, occupants):
    """Return the hash of a state that has another set at step t than state i."""
    value = _mixed(np.uint64(occupants) + np.uint64(0x9E3779B97F4A7C15))
    for s in range(crossing.shape[1]):
        part = np.uint64(number) if s == t else np.uint64(crossing[i, s])
        value = _mixed(value ^ (part + np.uint64(s + 1) * np.uint64(0x9E3779B97F4A7C15)))
    return value


@njit(cache=True)
def _same(new, j, old, i, t, number):
    """Tell whether new state j has the crossings of old state i, but for another set at step t."""
    if new[j, t] != number:
        return False
    for s in range(new.shape[1]):  # noqa: SIM110 (generators are not compiled)
        if s != t and new[j, s] != old[i, s]:
            return False
    return True


@njit(cache=True)
def _slots(states, count, t, size):
    """Return a hash table of states."""
    table = np.full(size, -1, np.int32)
    for i in range(count):
        number, occupants = states.crossing[i, t], states.occupants[i]
        slot = _hash(states.crossing, i, t, number, occupants) & np.uint64(size - 1)
        while table[slot] >= 0:
            slot = (slot + np.uint64(1)) & np.uint64(size - 1)
        table[slot] = i
    return table


@njit(cache=True)
def _better(penalty, moved, other_penalty, other_moved):
    if penalty < other_penalty - _EQUAL:
        return True
    return penalty < other_penalty + _EQUAL and moved < other_moved


@njit(cache=True)
def _step(course, work, column, t, old, count, behind, ahead, budgets, later, limit, out):
    """Let a column make a step. Returns the states after it, their number, and the buffers."""
    old_crossing = old.crossing
    steps = old_crossing.shape[1]
    new = _states(max(64, 2 * count), steps)
    added = 0
    size = 256
    while size < 4 * count:
        size *= 2
    table = np.full(size, -1, np.int32)
    known_size = 256
    known = np.full((known_size, 4), -1, np.int64)
    known_count, filled = 0, 0
    for i in range(count):
        occupants, set_behind = old.occupants[i], np.int64(old.crossing[i, t])
        mask = np.uint64(known_size - 1)
        slot = _mixed(np.uint64(occupants) * np.uint64(65599) + np.uint64(set_behind)) & mask
        while known[slot, 0] >= 0 and (known[slot, 0] != occupants or known[slot, 1] != set_behind):
            slot = (slot + np.uint64(1)) & mask
        if known[slot, 0] < 0:
            members = behind.members[t, set_behind]
            while True:
                end = _expand(
                    course, work, column, t, occupants, behind, members, ahead, budgets, out, filled
                )
                if end >= 0:
                    break
                if end == -1:
                    out = _more_transitions(out)
                elif ahead.members.shape[1] == _MOST_SETS:
                    return new, -1, ahead, out
                else:
                    ahead = _wider(ahead)
            known[slot, 0], known[slot, 1] = occupants, set_behind
            known[slot, 2], known[slot, 3] = filled, end
            filled = end
            known_count += 1
            first, last = known[slot, 2], known[slot, 3]
            if 2 * known_count > known_size:
                wider = np.full((4 * known_size, 4), -1, np.int64)
                mask = np.uint64(4 * known_size - 1)
                for j in range(known_size):
                    if known[j, 0] >= 0:
                        at = np.uint64(known[j, 0]) * np.uint64(65599) + np.uint64(known[j, 1])
                        slot = _mixed(at) & mask
                        while wider[slot, 0] >= 0:
                            slot = (slot + np.uint64(1)) & mask
                        wider[slot] = known[j]
                known = wider
                known_size *= 4
        else:
            first, last = known[slot, 2], known[slot, 3]
        for e in range(first, last):
            penalty = old.penalty[i] + out.penalty[e]
            if penalty + later > budgets[0] + _TOLERANCE:
                continue
            number, after = out.crossing[e], out.after[e]
            moved = old.moved[i] + out.moved[e]
            slot = _hash(old_crossing, i, t, number, after) & np.uint64(size - 1)
            while table[slot] >= 0 and not (
                new.occupants[table[slot]] == after
                and _same(new.crossing, table[slot], old_crossing, i, t, number)
            ):
                slot = (slot + np.uint64(1)) & np.uint64(size - 1)
            at = table[slot]
            if at < 0:
                if added == limit:
                    return new, -2, ahead, out
                if added == len(new.occupants):
                    new = _chosen(new, np.arange(added), 2 * added)
                at = added
                table[slot] = at
                added += 1
                new.crossing[at] = old.crossing[i]
                new.crossing[at, t] = number
                new.occupants[at] = after
            elif not _better(penalty, moved, new.penalty[at], new.moved[at]):
                continue
            new.penalty[at], new.moved[at] = penalty, moved
            new.parent[at], new.record[at] = i, out.record[e]
            if 2 * added > size:
                size *= 4
                table = _slots(new, added, t, size)
    return new, added, ahead, out


@njit(cache=True)
def _finish(course, column, states, count, budget, later):
    """Return the states in which everybody in a column has arrived, with what is still to pay."""
    penalties = course.penalties
    lanes = course.lattice.lanes
    labels = penalties.move.shape[0] + 2
    steps = states.crossing.shape[1]
    kept = np.empty(count, np.int64)
    left = 0
    for i in range(count):
        occupants, penalty = states.occupants[i], states.penalty[i]
        for lane in range(lanes):
            label = occupants % labels
            occupants //= labels
            goal = course.target[column * lanes + lane]
            if label == 0:
                if goal >= 0:
                    penalty += penalties.empty[goal]
            elif label < labels - 1:
                penalty += penalties.arrival[label - 1, goal, steps] if goal >= 0 else UNREACHABLE
        if penalty + later <= budget + _TOLERANCE:
            kept[left] = i
            left += 1
            states.penalty[i] = penalty
    return _chosen(states, kept[:left], max(left, 1)), left


@njit(cache=True)
def sweep_columns(course, budget, whole_budget, later, limit):
    """Sweep all columns; see `sweep.run_sweep`."""
    lattice = course.lattice
    columns, lanes = lattice.columns, lattice.lanes
    steps = len(course.credit_from)
    labels = course.penalties.move.shape[0] + 2
    behind, ahead = _no_crossings(steps, 256), _no_crossings(steps, 256)
    work, out = _work(lanes), _transitions(4096)
    states, count = _states(1, steps), 1
    none = np.zeros((0, 0), np.int64)
    # Of all steps of all columns: where each state came from, and what was done.
    parents = np.zeros(4096, np.int32)
    records = np.zeros(4096, np.uint64)
    offset = np.zeros(columns * steps + 1, np.int64)
    total = 0
    for column in range(columns):
        behind, ahead = ahead, behind
        occupants, power = 0, 1
        for lane in range(lanes):
            occupants += course.occupant[column * lanes + lane] * power
            power *= labels
        states.occupants[:count] = occupants
        for t in range(steps):
            if not _collect(course, column, t, whole_budget, ahead):
                return TOO_WIDE, UNREACHABLE, column, total, none
            states, count, ahead, out = _step(
                course,
                work,
                column,
                t,
                states,
                count,
                behind,
                ahead,
                (budget, whole_budget),
                later[column + 1],
                limit - total,
                out,
            )
            if count == -1:
                return TOO_WIDE, UNREACHABLE, column, total, none
            if count == -2:
                return OVER_LIMIT, UNREACHABLE, column, limit, none
            if t == steps - 1:
                states, count = _finish(course, column, states, count, budget, later[column + 1])
            total += count
            if count == 0:
                return DEAD, UNREACHABLE, column, total, none
            while total > len(parents):
                parents = np.concatenate((parents, np.zeros(len(parents), np.int32)))
                records = np.concatenate((records, np.zeros(len(records), np.uint64)))
            first = offset[column * steps + t]
            parents[first : first + count] = states.parent[:count]
            records[first : first + count] = states.record[:count]
            offset[column * steps + t + 1] = first + count
    best = 0
    for i in range(1, count):
        if _better(states.penalty[i], states.moved[i], states.penalty[best], states.moved[best]):
            best = i
    decision = np.full((columns * lanes, steps), NOBODY, np.int64)
    at = best
    for layer in range(columns * steps - 1, -1, -1):
        column, t = layer // steps, layer % steps
        record = records[offset[layer] + at]
        for lane in range(lanes):
            decision[column * lanes + lane, t] = (record >> np.uint64(4 * lane)) & np.uint64(15)
        at = parents[offset[layer] + at]
    return SOLVED, states.penalty[best], columns, total, decision
