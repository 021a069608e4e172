"""Random numbers for compiled code, the same on every machine."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True)
def random_below(state, below):
    """Return a number from 0 to `below` - 1 (a linear congruential generator)."""
    state[0] = state[0] * np.uint64(6364136223846793005) + np.uint64(1442695040888963407)
    return np.int64((state[0] >> np.uint64(33)) % np.uint64(below))
