"""Compiled code of `branching`; see `relaxation_kernel` for its style."""

from __future__ import annotations

import numpy as np
from numba import njit

from laneweave.coordinator.planning.exact.relaxation_kernel import (
    OPEN,
    PACE,
    REFUTED,
    WEIGHTS,
    forbid_dear,
    improve,
    list_moves,
    start_over,
)

STUCK, FULL = 3, 4
"""Nothing is left to be told apart, and yet it is not decided; there is no room on the stack."""
BY_TEAM, BY_CELL = 0, 1
_ITERATIONS = 10
_KEPT = 0.8
"""If fewer of the moves are still allowed, prices are improved again first."""
_ROUNDS = 12
"""After so many rounds without a choice between masses any choice is taken."""
_ABOVE_CEILING = 0.5
_LEAST_PACE = 0.05
_LEAST_MASS = 0.01
_CELLS_COUNT = 0.5
"""How much a choice by from-cell counts against one by team."""
_PRICE_COUNTS = 10.0


@njit(cache=True, nogil=True)
def search(lattice, teams, stack, depth, scratch, memory, ceiling, nodes):
    """Look at so many nodes of the stack, depth first.

    Returns REFUTED when none is left, FOUND, STUCK or FULL at once, or else OPEN; the new depth;
    and the number of nodes that were looked at. After FOUND its node is still on the stack.
    """
    choice = np.zeros(5, np.int64)
    for looked_at in range(nodes):
        if depth == 0:
            return REFUTED, depth, looked_at
        top = depth - 1
        allowed, first, prices = stack.allowed[top], stack.first[top], stack.prices[top]
        memory[PACE] = stack.pace[top]
        ending = _look_at(lattice, teams, allowed, first, prices, scratch, memory, ceiling, choice)
        if ending == REFUTED:
            depth -= 1
            continue
        if ending != OPEN or depth == len(stack.pace):
            return (FULL if ending == OPEN else ending), depth, looked_at + 1
        stack.allowed[depth], stack.first[depth], stack.prices[depth] = allowed, first, prices
        stack.pace[top] = stack.pace[depth] = max(memory[PACE], _LEAST_PACE)
        likely = choice[4] == 1
        _divide(lattice, teams, choice, not likely, allowed, first)
        _divide(lattice, teams, choice, likely, stack.allowed[depth], stack.first[depth])
        depth += 1
    return (OPEN if depth > 0 else REFUTED), depth, nodes


@njit(cache=True)
def _look_at(lattice, teams, allowed, first, prices, scratch, memory, ceiling, choice):
    """Decide a node, or choose what to tell apart.

    Prices are improved, and what is too dear is forbidden, for as long as that makes it much
    smaller.
    """
    moves, span = list_moves(lattice, allowed, scratch)
    start_over(prices, span, scratch, memory)
    for attempt in range(2 * _ROUNDS):
        ending = improve(
            lattice,
            teams,
            allowed,
            first,
            prices,
            span,
            scratch,
            memory,
            _ITERATIONS,
            ceiling,
            ceiling + _ABOVE_CEILING,
        )
        if ending != OPEN:
            return ending
        _, kept = forbid_dear(lattice, teams, allowed, first, prices, span, scratch, ceiling)
        if kept < _KEPT * moves:
            moves, span = list_moves(lattice, allowed, scratch)
            start_over(prices, span, scratch, memory)
            continue
        if _choose(lattice, teams, allowed, first, prices, span, scratch, memory, choice, True):
            return OPEN
        if attempt < _ROUNDS:
            continue
        if _choose(lattice, teams, allowed, first, prices, span, scratch, memory, choice, False):
            return OPEN
        # No two moves are left that exclude each other: there is nothing to pay for.
        prices[:] = 0.0
        start_over(prices, span, scratch, memory)
    return STUCK


@njit(cache=True)
def _choose(lattice, teams, allowed, first, prices, span, scratch, memory, choice, by_mass):
    """Choose a row, and some of its moves to be told from the others: a team's, or a cell's.

    Best is a dear row of which both parts have much mass, that is, a large share of the relaxed
    solutions. Without masses each move counts as much.

    choice: step, row, `BY_TEAM` or `BY_CELL`, number of the team or cell, 1 if its part is the
        larger one.
    """
    mass = scratch.mass
    groups = len(mass)
    of_team, of_cell = scratch.mass_of_team, scratch.mass_of_cell
    of_team[:] = 0.0
    of_cell[:] = 0.0
    scale = 1.0 / memory[WEIGHTS] if by_mass else 0.0
    for t in range(span):
        for k in range(groups):
            for m in range(scratch.move_from[t, k], scratch.move_from[t, k + 1]):
                d, cell = scratch.move[m, 0], scratch.move[m, 1]
                share = scale * mass[k, t, d, cell] if by_mass else 1.0
                if share > _LEAST_MASS:
                    _add(lattice, t, k, d, cell, share, of_team, of_cell)
            for p in range(teams.pairs_from[k], teams.pairs_from[k + 1]):
                cell = teams.pair_cell[p]
                if not allowed[k, t, 0, cell] and t >= first[p]:
                    share = scale * mass[k, t, 0, cell] if by_mass else 1.0
                    if share > _LEAST_MASS:
                        _add(lattice, t, k, 0, cell, share, of_team, of_cell)
    best = 1e-6 if by_mass else 0.0
    found = False
    for t in range(span):
        for row in range(prices.shape[1]):
            if by_mass and prices[t, row] <= 0.0:
                continue
            price = 1.0 + _PRICE_COUNTS * min(prices[t, row], 1.0)
            whole = of_team[t, row].sum()
            for kind in range(2):
                masses = of_team[t, row] if kind == BY_TEAM else of_cell[t, row]
                factor = price if kind == BY_TEAM else _CELLS_COUNT * price
                for number in range(len(masses)):
                    score = factor * min(masses[number], whole - masses[number])
                    if score > best:
                        best, found = score, True
                        choice[0], choice[1], choice[2], choice[3] = t, row, kind, number
                        choice[4] = 1 if 2.0 * masses[number] >= whole else 0
    return found


@njit(cache=True)
def _add(lattice, t, k, d, cell, share, of_team, of_cell):
    for m in range(lattice.row.shape[2]):
        row = lattice.row[d, cell, m]
        if row < 0:
            break
        of_team[t, row, k] += share
        of_cell[t, row, lattice.near[cell]] += share


@njit(cache=True)
def _divide(lattice, teams, choice, inside, allowed, first):
    """Leave only the chosen moves of the row, or only the others."""
    t, chosen_row, kind, number = choice[0], choice[1], choice[2], choice[3]
    groups, _, displacements, cells = allowed.shape
    for d in range(displacements):
        for cell in range(cells):
            for m in range(lattice.row.shape[2]):
                if lattice.row[d, cell, m] != chosen_row:
                    continue
                for k in range(groups):
                    chosen = k == number if kind == BY_TEAM else lattice.near[cell] == number
                    if chosen == inside:
                        continue
                    allowed[k, t, d, cell] = False
                    if d == 0:
                        for p in range(teams.pairs_from[k], teams.pairs_from[k + 1]):
                            if teams.pair_cell[p] == cell:
                                first[p] = max(first[p], t + 1)
