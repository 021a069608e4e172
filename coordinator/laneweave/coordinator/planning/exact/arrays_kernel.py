"""Compiled code of `arrays`; see `relaxation_kernel` for its style."""

from __future__ import annotations

import numpy as np
from numba import njit

UNREACHABLE = 1e9
"""Stands for infinity, and can be added to."""


@njit(cache=True, nogil=True)
def least_steps(valid, step, targets):
    """Return (X, P) the least steps from every cell to each target, as if it were alone."""
    displacements, cells = valid.shape
    found = np.full((cells, len(targets)), UNREACHABLE)
    queue = np.empty(cells, np.int64)
    for p in range(len(targets)):
        found[targets[p], p] = 0.0
        queue[0] = targets[p]
        begin, end = 0, 1
        while begin < end:
            then = queue[begin]
            begin += 1
            for d in range(displacements):
                cell = then - step[d]
                if 0 <= cell < cells and valid[d, cell] and found[cell, p] == UNREACHABLE:
                    found[cell, p] = found[then, p] + 1.0
                    queue[end] = cell
                    end += 1
    return found
