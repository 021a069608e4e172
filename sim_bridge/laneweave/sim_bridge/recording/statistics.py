"""Rounding and percentiles of the numbers in summaries and benchmarks."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray


def finite(value: float) -> float | None:
    """Return a number for JSON, rounded to three decimals; None for infinities and NaN."""
    return round(value, 3) if math.isfinite(value) else None


def percentiles_of(
    values: NDArray[Any], *percentiles: int, largest: bool = False
) -> dict[str, float | None]:
    """Return percentiles by name (with `largest`, also `max`); None if there are no values."""
    ranks = {f"p{percentile}": percentile for percentile in percentiles}
    if largest:
        ranks["max"] = 100
    with np.errstate(all="ignore"):
        return {
            name: finite(float(np.percentile(values, rank))) if len(values) else None
            for name, rank in ranks.items()
        }
