"""Compiled code of `branching`: the search over the open nodes, depth first.

A node is fathomed by its lower bound or by a relaxed solution without conflicts; otherwise it is
split at a conflict clique. See `multipliers_kernel` for the style.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from laneweave.coordinator.planning.exact.multipliers_kernel import (
    OPEN,
    REFUTED,
    STEP_SIZE,
    WEIGHTS,
    begin,
    fix_by_reduced_cost,
    improve,
    start_over,
)

STUCK, FULL = 3, 4
"""STUCK: no choice left to branch on, node not fathomed; FULL: the stack is full."""
BY_TEAM, BY_CELL = 0, 1
_ITERATIONS = 10
_KEPT = 0.8
"""If the fraction of moves kept is lower, multipliers are improved again before branching."""
_ROUNDS = 12
"""Attempts to choose by mass (`_choose`) before all moves count equally."""
_ABOVE_UPPER_BOUND = 0.5
_MIN_STEP_SIZE = 0.05
_MIN_MASS = 0.01
_CELL_WEIGHT = 0.5
"""Weight of branching on a from-cell relative to branching on a team."""
_MULTIPLIER_WEIGHT = 10.0


@njit(cache=True, nogil=True)
def search(arrays, teams, stack, depth, scratch, state, upper_bound, nodes):
    """Examine up to `nodes` nodes of the stack, depth first.

    Returns the outcome, the new depth and the number of examined nodes. FOUND (its node stays on
    the stack), STUCK and FULL are returned at once, REFUTED if the stack is empty, otherwise OPEN.
    """
    choice = np.zeros(5, np.int64)
    for examined in range(nodes):
        if depth == 0:
            return REFUTED, depth, examined
        top = depth - 1
        allowed, earliest = stack.allowed[top], stack.earliest[top]
        multipliers = stack.multipliers[top]
        state[STEP_SIZE] = stack.step_size[top]
        outcome = _examine(
            arrays, teams, allowed, earliest, multipliers, scratch, state, upper_bound, choice
        )
        if outcome == REFUTED:
            depth -= 1
            continue
        if outcome != OPEN or depth == len(stack.step_size):
            return (FULL if outcome == OPEN else outcome), depth, examined + 1
        stack.allowed[depth], stack.earliest[depth] = allowed, earliest
        stack.multipliers[depth] = multipliers
        stack.step_size[top] = stack.step_size[depth] = max(state[STEP_SIZE], _MIN_STEP_SIZE)
        likely = choice[4] == 1
        _restrict(arrays, teams, choice, not likely, allowed, earliest)
        _restrict(arrays, teams, choice, likely, stack.allowed[depth], stack.earliest[depth])
        depth += 1
    return (OPEN if depth > 0 else REFUTED), depth, nodes


@njit(cache=True)
def _examine(arrays, teams, allowed, earliest, multipliers, scratch, state, upper_bound, choice):
    """Fathom a node, or choose what to branch on.

    Multipliers are improved and moves fixed by reduced cost as long as that removes many moves.
    """
    moves, span = begin(arrays, allowed, multipliers, scratch, state)
    for attempt in range(2 * _ROUNDS):
        outcome = improve(
            arrays,
            teams,
            allowed,
            earliest,
            multipliers,
            span,
            scratch,
            state,
            _ITERATIONS,
            upper_bound,
            upper_bound + _ABOVE_UPPER_BOUND,
        )
        if outcome != OPEN:
            return outcome
        _, kept = fix_by_reduced_cost(
            arrays, teams, allowed, earliest, multipliers, span, scratch, upper_bound
        )
        if kept < _KEPT * moves:
            moves, span = begin(arrays, allowed, multipliers, scratch, state)
            continue
        if _choose(
            arrays, teams, allowed, earliest, multipliers, span, scratch, state, choice, True
        ):
            return OPEN
        if attempt < _ROUNDS:
            continue
        if _choose(
            arrays, teams, allowed, earliest, multipliers, span, scratch, state, choice, False
        ):
            return OPEN
        # No two allowed moves exclude each other: no multiplier is needed.
        multipliers[:] = 0.0
        start_over(multipliers, span, scratch, state)
    return STUCK


@njit(cache=True)
def _choose(arrays, teams, allowed, earliest, multipliers, span, scratch, state, choice, by_mass):
    """Choose a clique and the part of its moves to branch on: by one team, or from one cell.

    The best clique has a high multiplier, and both its parts have a large mass, that is, weight in
    the relaxed solutions. Unless `by_mass`, all moves count equally.

    choice: set to step, clique, `BY_TEAM` or `BY_CELL`, team index or cell residue, and 1 if that
        part has the larger mass.
    """
    mass = scratch.mass
    groups = len(mass)
    of_team, of_cell = scratch.mass_of_team, scratch.mass_of_cell
    of_team[:] = 0.0
    of_cell[:] = 0.0
    scale = 1.0 / state[WEIGHTS] if by_mass else 0.0
    for t in range(span):
        for k in range(groups):
            for m in range(scratch.move_from[t, k], scratch.move_from[t, k + 1]):
                d, cell = scratch.move[m, 0], scratch.move[m, 1]
                share = scale * mass[k, t, d, cell] if by_mass else 1.0
                if share > _MIN_MASS:
                    _add(arrays, t, k, d, cell, share, of_team, of_cell)
            for p in range(teams.pairs_from[k], teams.pairs_from[k + 1]):
                cell = teams.pair_cell[p]
                if not allowed[k, t, 0, cell] and t >= earliest[p]:
                    share = scale * mass[k, t, 0, cell] if by_mass else 1.0
                    if share > _MIN_MASS:
                        _add(arrays, t, k, 0, cell, share, of_team, of_cell)
    best = 1e-6 if by_mass else 0.0
    found = False
    for t in range(span):
        for clique in range(multipliers.shape[1]):
            if by_mass and multipliers[t, clique] <= 0.0:
                continue
            weight = 1.0 + _MULTIPLIER_WEIGHT * min(multipliers[t, clique], 1.0)
            whole = of_team[t, clique].sum()
            for kind in range(2):
                masses = of_team[t, clique] if kind == BY_TEAM else of_cell[t, clique]
                factor = weight if kind == BY_TEAM else _CELL_WEIGHT * weight
                for number in range(len(masses)):
                    score = factor * min(masses[number], whole - masses[number])
                    if score > best:
                        best, found = score, True
                        choice[0], choice[1], choice[2], choice[3] = t, clique, kind, number
                        choice[4] = 1 if 2.0 * masses[number] >= whole else 0
    return found


@njit(cache=True)
def _add(arrays, t, k, d, cell, share, of_team, of_cell):
    for m in range(arrays.clique.shape[2]):
        clique = arrays.clique[d, cell, m]
        if clique < 0:
            break
        of_team[t, clique, k] += share
        of_cell[t, clique, arrays.residue[cell]] += share


@njit(cache=True)
def _restrict(arrays, teams, choice, inside, allowed, earliest):
    """Allow only the chosen moves of the clique, or only the others."""
    t, chosen_clique, kind, number = choice[0], choice[1], choice[2], choice[3]
    groups, _, displacements, cells = allowed.shape
    for d in range(displacements):
        for cell in range(cells):
            for m in range(arrays.clique.shape[2]):
                if arrays.clique[d, cell, m] != chosen_clique:
                    continue
                for k in range(groups):
                    chosen = k == number if kind == BY_TEAM else arrays.residue[cell] == number
                    if chosen == inside:
                        continue
                    allowed[k, t, d, cell] = False
                    if d == 0:
                        for p in range(teams.pairs_from[k], teams.pairs_from[k + 1]):
                            if teams.pair_cell[p] == cell:
                                earliest[p] = max(earliest[p], t + 1)
