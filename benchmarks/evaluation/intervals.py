"""Confidence intervals over the seeds of a sweep, and differences between methods by seed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import StrEnum
from typing import Final, NamedTuple

import numpy as np
from attrs import frozen
from scipy.stats import bootstrap

MIN_SEEDS: Final = 10
"""Fewer values give no interval: with five, bootstrap intervals contain only 82 % of the means."""
CONFIDENCE: Final = 0.95
_RESAMPLES: Final = 9999
_EQUAL: Final = 1e-12
"""Relative difference of values that count as equal, for which the bootstrap is not defined."""


class Interval(NamedTuple):
    """Bounds of a confidence interval."""

    low: float
    high: float


class Verdict(StrEnum):
    """What a difference of two methods shows."""

    LESS = "less"
    MORE = "more"
    NONE = "no difference"
    UNKNOWN = "unknown"
    """There are too few seeds."""


def interval(values: Sequence[float]) -> Interval | None:
    """Return the bootstrap interval of a mean.

    None: there are fewer than `MIN_SEEDS` values, or some are not finite. The interval is
    bias-corrected and accelerated (Efron 1987), with 95 % confidence. Equal values give equal
    intervals, whatever was computed before.
    """
    if len(values) < MIN_SEEDS or not np.all(np.isfinite(values)):
        return None
    if np.ptp(values) <= _EQUAL * max(map(abs, values)):
        return Interval(min(values), max(values))
    found = bootstrap(
        (np.array(values),),
        np.mean,
        confidence_level=CONFIDENCE,
        n_resamples=_RESAMPLES,
        method="BCa",
        rng=np.random.default_rng(0),
    ).confidence_interval
    return Interval(float(found.low), float(found.high))


@frozen
class Difference:
    """Difference of a figure between two methods, over the seeds that both have."""

    mean: float
    bounds: Interval | None
    percent: float
    """The mean difference, relative to the mean of the other method over these seeds [%]."""
    seeds: int
    """Number of these seeds."""

    @property
    def verdict(self) -> Verdict:
        """What the interval shows: a difference only where it excludes 0."""
        if self.bounds is None:
            return Verdict.UNKNOWN
        if self.bounds.high < 0.0:
            return Verdict.LESS
        return Verdict.MORE if self.bounds.low > 0.0 else Verdict.NONE


def difference(own: Mapping[int, float], other: Mapping[int, float]) -> Difference | None:
    """Return the difference of two methods, paired by seed; None: they have no seed in common.

    Args:
        own: value by seed.
        other: value of the other method by seed.
    """
    seeds = sorted(own.keys() & other.keys())
    if not seeds:
        return None
    pairs = [own[seed] - other[seed] for seed in seeds]
    mean = float(np.mean(pairs))
    percent = 100.0 * mean / float(np.mean([other[seed] for seed in seeds]))
    return Difference(mean, interval(pairs), percent, len(seeds))
