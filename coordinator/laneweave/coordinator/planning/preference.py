"""The preference matrix P of the paper: which vehicle may be assigned to which target.

The paper multiplies the costs of forbidden pairs by a large number M. Here P is boolean and
forbidden pairs do not exist for the assignment, so no choice of M can let one slip through.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from laneweave.coordinator.planning.grid import Cell

BoolMatrix = npt.NDArray[np.bool_]


def eligible_targets(
    targets: Sequence[Cell], lane: int | None, eligible: Sequence[int] | None
) -> frozenset[int]:
    """Return the targets of one vehicle: those on `lane`, those in `eligible`, or else all."""
    if eligible is not None:
        return frozenset(eligible)
    if lane is not None:
        return frozenset(j for j, target in enumerate(targets) if target[1] == lane)
    return frozenset(range(len(targets)))


def preference_matrix(choices: Sequence[frozenset[int]], target_count: int) -> BoolMatrix:
    """Return P: row i, column j tells whether vehicle i may take target j."""
    allowed = np.zeros((len(choices), target_count), dtype=np.bool_)
    for i, choice in enumerate(choices):
        allowed[i, sorted(choice)] = True
    return allowed
