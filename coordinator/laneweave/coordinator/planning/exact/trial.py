"""A path set in the making, for the compiled code that improves it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from laneweave.coordinator.planning.exact.arrays import Floats, Ints, Lattice
from laneweave.coordinator.planning.exact.relaxation_kernel import PARKED


class Trial(NamedTuple):
    """What the compiled code works on. Shapes: N vehicles, T steps, R rows, X cells."""

    way: Ints
    """(N, T) displacements; `PARKED`: arrived."""
    cost: Ints
    """(N,)"""
    target: Ints
    """(N,) number of the target of each vehicle."""
    use: Floats
    """(T, R)"""
    own: Floats
    """(T, R) uses by those who are taken out."""
    memory: Floats
    """(T, R) what a row costs because it was contested."""
    weight: Floats
    """(T, R) what a row costs now."""
    to_go: Floats
    """(T + 1, X)"""
    parked: Floats
    """(T + 1,)"""
    random: NDArray[np.uint64]
    """(1,) state of the random numbers."""


def trial(lattice: Lattice, way: Ints, target: Ints, memory: Floats) -> Trial:
    """Return a trial of ways (N, T), whose uses of rows are not counted yet."""
    shape = memory.shape
    return Trial(
        way=way,
        cost=np.count_nonzero(way != PARKED, axis=1).astype(np.int64),
        target=target,
        use=np.zeros(shape),
        own=np.zeros(shape),
        memory=memory,
        weight=np.zeros(shape),
        to_go=np.zeros((way.shape[1] + 1, lattice.valid.shape[1])),
        parked=np.zeros(way.shape[1] + 1),
        random=np.zeros(1, dtype=np.uint64),
    )
