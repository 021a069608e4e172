"""Exact search column by column: what is still possible within a budget of penalties.

A formation is long and narrow. What the columns on one side of a line between two columns do
concerns the other side only by the moves that cross the line; for every step that is a small set.
So the whole problem is solved by dynamic programming along the road: the columns are swept one
after the other, each of them step by step, and of all partial solutions with the same crossings
and the same occupants of the present column only the best one is kept.

Partial solutions are kept apart by what they still have to agree on. What they have paid so far are
penalties (see `relaxation`), which are never negative. One that has paid more than the budget,
together with what the columns ahead cost at least, cannot become a better solution and is dropped.
With a good bound few are left; the number of columns matters little.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from laneweave.coordinator.planning.arrays import Floats, Ints, Lattice, Teams
from laneweave.coordinator.planning.relaxation import Penalties
from laneweave.coordinator.planning.sweep_kernel import sweep_columns


class Course(NamedTuple):
    """A problem as it is swept, in one of the two directions."""

    lattice: Lattice
    penalties: Penalties
    occupant: Ints
    """(X,) team + 1 of the vehicle that starts in a cell; 0: none."""
    target: Ints
    """(X,) number of the target in a cell; -1: none."""
    credit_from: Floats
    """(T, D, X) prices of the rows in the column of its from-cell that a move uses."""
    credit_to: Floats
    """(T, D, X) the same in the column of its to-cell, where that is another one."""
    unused: Floats
    """(columns, T) prices of all rows of a column."""


class Sweep(NamedTuple):
    """What a sweep came to."""

    ending: int
    penalty: float
    """Of the solution; `UNREACHABLE`: there is none."""
    column: int
    """Where it ended, if it did not get to the end."""
    states: int
    """Partial solutions that were kept."""
    decision: Ints
    """(X, T) displacement of the vehicle in a cell in a step, `PARK` or `NOBODY`."""


def courses(lattice: Lattice, teams: Teams, prices: Floats, penalties: Penalties) -> list[Course]:
    """Return the problem as it is swept forwards and backwards."""
    cells = lattice.columns * lattice.lanes
    occupant = np.zeros(cells, dtype=np.int64)
    occupant[teams.start] = teams.team + 1
    target = np.full(cells, -1, dtype=np.int64)
    target[teams.target] = np.arange(len(teams.target))
    credit_from, credit_to, unused = _credits(lattice, prices)
    forward = Course(lattice, penalties, occupant, target, credit_from, credit_to, unused)
    column, lane = np.divmod(np.arange(cells), lattice.lanes)
    cell = (lattice.columns - 1 - column) * lattice.lanes + lane
    turned = [
        int(np.flatnonzero((lattice.along == -c) & (lattice.across == left))[0])
        for c, left in zip(lattice.along, lattice.across, strict=True)
    ]
    mirrored = penalties._replace(
        move=np.ascontiguousarray(penalties.move[:, :, turned][..., cell]),
        reach=np.ascontiguousarray(penalties.reach[..., cell]),
    )
    backward = Course(
        lattice,
        mirrored,
        occupant[cell],
        target[cell],
        np.ascontiguousarray(credit_from[:, turned][..., cell]),
        np.ascontiguousarray(credit_to[:, turned][..., cell]),
        np.ascontiguousarray(unused[::-1]),
    )
    return [forward, backward]


def _credits(lattice: Lattice, prices: Floats) -> tuple[Floats, Floats, Floats]:
    steps = len(prices)
    column = np.arange(lattice.valid.shape[1]) // lattice.lanes
    padded = np.concatenate([prices, np.zeros((steps, 1))], axis=1)
    row_column = np.append(lattice.row_column, -1)
    home = row_column[lattice.row] == column[None, :, None]
    paid = padded[:, lattice.row]
    credit_from = np.ascontiguousarray(np.where(home, paid, 0.0).sum(axis=3))
    credit_to = np.ascontiguousarray(np.where(home, 0.0, paid).sum(axis=3))
    unused = np.zeros((lattice.columns, steps))
    np.add.at(unused, lattice.row_column, prices.T)
    return credit_from, credit_to, unused


def run_sweep(
    course: Course,
    budget: float,
    *,
    whole_budget: float,
    later: Floats,
    limit: int,
) -> Sweep:
    """Sweep all columns.

    Args:
        course: the problem.
        budget: partial solutions that have paid more are dropped.
        whole_budget: what a whole solution may pay; moves that cannot be in one are left out.
        later: (columns + 1,) what the columns from each one on cost at least, the moves across
            the line before it excluded.
        limit: most partial solutions.
    """
    ending, penalty, column, states, decision = sweep_columns(
        course, budget, whole_budget, later, limit
    )
    return Sweep(ending, penalty, column, states, decision)
