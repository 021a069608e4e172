"""Programmes with binary variables, solved by HiGHS."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from scipy.optimize import Bounds, LinearConstraint, milp
from scipy.sparse import coo_array

Row = tuple[Iterable[tuple[int, float]], float, float]
"""Terms (variable, coefficient), and the bounds of their sum."""


def cheapest_choice(costs: Sequence[float], rows: Sequence[Row], limit_s: float = np.inf) -> Any:  # noqa: ANN401
    """Return what `scipy.optimize.milp` answers: an optimal choice of variables, or why none."""
    entries = [(i, x, value) for i, (terms, _, _) in enumerate(rows) for x, value in terms]
    row, column, value = zip(*entries, strict=True)
    matrix = coo_array((value, (row, column)), shape=(len(rows), len(costs))).tocsr()
    lower, upper = [lower for _, lower, _ in rows], [upper for _, _, upper in rows]
    return milp(
        np.array(costs),
        integrality=np.ones(len(costs)),
        bounds=Bounds(0, 1),
        constraints=LinearConstraint(matrix, lower, upper),
        options={"mip_rel_gap": 0.0, "time_limit": limit_s},
    )
