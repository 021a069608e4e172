r"""The formation relative distance (paper, equation `rd`) and the cost matrix C made of it.

.. math:: d^r_{ij} = l^o N^{r,o}_{ij} + l^s N^{r,s}_{ij}

N^{r,o} counts the oblique edges of a shortest path, the smaller of the two coordinate differences;
N^{r,s} counts its straight edges, the rest of the larger one. The paper sets l^s = l^o = 1, which
is the number of steps in mode 2. In mode 1 an oblique edge takes two steps, hence l^o = 2 there.

TAPPA stops as soon as the next assignment costs no less than the best path set, which is right
only if C is a lower bound on steps; weights for which it is none are rejected.
"""

from __future__ import annotations

from collections.abc import Sequence

import attrs
import numpy as np
import numpy.typing as npt

from laneweave.coordinator.planning.grid import Cell, Mode
from laneweave.protocol.errors import BadInputError

IntMatrix = npt.NDArray[np.int64]


@attrs.frozen
class Weights:
    """The weights l^s and l^o of straight and oblique edges."""

    straight: int
    oblique: int

    @classmethod
    def for_mode(cls, mode: Mode) -> Weights:
        """Return the largest weights for which the distance is a lower bound on steps."""
        return cls(straight=1, oblique=2 if mode == 1 else 1)

    def checked(self, mode: Mode) -> Weights:
        """Return the weights if they give a lower bound on steps in this mode."""
        most = Weights.for_mode(mode)
        for name, value, limit in (
            ("l_s", self.straight, most.straight),
            ("l_o", self.oblique, most.oblique),
        ):
            if not 0 <= value <= limit:
                raise BadInputError(name, value, f"0 to {limit} in mode {mode}, a lower bound")
        return self


def frd(vehicle: Cell, target: Cell, weights: Weights) -> int:
    """Return the formation relative distance from a vehicle's cell to a target (equation `rd`)."""
    x = abs(vehicle[0] - target[0])
    y = abs(vehicle[1] - target[1])
    return weights.oblique * min(x, y) + weights.straight * (max(x, y) - min(x, y))


def cost_matrix(vehicles: Sequence[Cell], targets: Sequence[Cell], weights: Weights) -> IntMatrix:
    """Return C: row i, column j holds the distance of vehicle i to target j."""
    rows = [[frd(v, t, weights) for t in targets] for v in vehicles]
    return np.array(rows, dtype=np.int64).reshape(len(vehicles), len(targets))
