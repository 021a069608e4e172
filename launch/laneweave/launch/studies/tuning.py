"""Random search for the best settings of a method on a road.

Random search finds good settings as often as a grid with far fewer runs, since few of the settings
matter (J. Bergstra, Y. Bengio, "Random Search for Hyper-Parameter Optimization", Journal of Machine
Learning Research 13, 2012). The first set is that of the method itself.
"""

from __future__ import annotations

import math
import random
from collections.abc import Iterable, Mapping, Sequence
from operator import attrgetter
from statistics import fmean
from types import MappingProxyType
from typing import Final

from attrs import frozen

from laneweave.launch.recordings.runs import Run
from laneweave.launch.run_methods import LC2013, RULE, labelled
from laneweave.launch.sweep.points import Variant
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.scenario.fields import Scenario

DEFAULT_SET: Final = "default"
MAX_BUDGET: Final = 10_000
MAX_TRIES: Final = 1000
"""Maximum number of draws for a set that the scenario allows."""
OTHER_LANE_S: Final = 1.0
"""Seconds that a percent of vehicles costs which leave in another lane than the preferred one."""
_LOGARITHMIC: Final = 10.0
"""Ranges whose ends have at least this ratio are drawn uniformly in the logarithm."""


@frozen
class Margin:
    """Range of a field within which the search draws."""

    low: float
    high: float
    whole: bool = False
    """Whether the field has whole numbers only."""

    def draw(self, generator: random.Random) -> float | int:
        """Return a value, rounded to three digits."""
        if self.whole:
            return generator.randint(math.ceil(self.low), math.floor(self.high))
        if self.low > 0.0 and self.high / self.low >= _LOGARITHMIC:
            value = math.exp(generator.uniform(math.log(self.low), math.log(self.high)))
        else:
            value = generator.uniform(self.low, self.high)
        return min(max(float(f"{value:.3g}"), self.low), self.high)


MARGINS: Final[Mapping[str, Mapping[str, Margin]]] = MappingProxyType(
    {
        LC2013: {
            "lc2013.min_gap_m": Margin(0.0, 2.5),
            "lc2013.accel_mps2": Margin(1.0, 5.0),
            "lc2013.decel_mps2": Margin(2.0, 10.0),
            "lc2013.strategic": Margin(0.3, 100.0),
            "lc2013.cooperative": Margin(0.0, 1.0),
            "lc2013.assertive": Margin(0.5, 5.0),
        },
        RULE: {
            "rule.standstill_gap_m": Margin(1.0, 8.0),
            "rule.stop_distance_m": Margin(20.0, 400.0),
            "rule.slow_down_mps2": Margin(1.0, 6.0),
        },
    }
)
"""Margins of the reference methods: how they drive. Headways and durations of lane changes, which
describe vehicles, keep their values unless margins of them are given."""


def margins_of(method: str, given: Iterable[str], base: Scenario) -> dict[str, Margin]:
    """Return the margins of a search.

    Args:
        method: label of the method.
        given: margins as `table.field=LOW:HIGH`, which replace or extend those of the method.
        base: scenario, whose fields may be varied.

    Raises:
        BadInputError: a margin is malformed, or of no number in the scenario; or there are none.
    """
    margins = dict(MARGINS.get(labelled(method).method, {}))
    for text in given:
        name, _, limits = text.partition("=")
        margins[name] = _margin(name, limits, text, base)
    if not margins:
        allowed = f"at least one margin: there are none of {method} without it"
        raise BadInputError("--margin", "", allowed)
    return margins


def _margin(name: str, limits: str, text: str, base: Scenario) -> Margin:
    low_text, _, high_text = limits.partition(":")
    try:
        low, high = float(low_text), float(high_text)
    except ValueError:
        raise BadInputError("--margin", text, "TABLE.FIELD=LOW:HIGH, two numbers") from None
    if not -math.inf < low <= high < math.inf:
        raise BadInputError("--margin", text, "TABLE.FIELD=LOW:HIGH with LOW <= HIGH")
    try:
        value = attrgetter(name)(base)
    except AttributeError:
        value = ""
    whole = isinstance(value, int)
    if name.count(".") != 1 or isinstance(value, bool) or not isinstance(value, float | int | None):
        raise BadInputError("--margin", text, "a field of a scenario file with one number")
    if whole and math.ceil(low) > math.floor(high):
        raise BadInputError("--margin", text, "a range with a whole number")
    return Margin(low, high, whole)


def draw_sets(
    method: str, margins: Mapping[str, Margin], base: Scenario, budget: int
) -> tuple[Variant, ...]:
    """Return the sets to compare: that of the method, and others drawn with the scenario's seed.

    Raises:
        BadInputError: no set within the margins is allowed in the scenario.
    """
    if not 2 <= budget <= MAX_BUDGET:
        raise BadInputError("--budget", budget, f"[2, {MAX_BUDGET}]")
    # Equal seeds draw equal sets.
    generator = random.Random(f"{base.seed}/tuning/{method}")  # noqa: S311 (no secrets)
    sets, digits = [Variant(DEFAULT_SET, {})], len(f"{budget - 1}")
    while len(sets) < budget:
        sets.append(_drawn(f"set-{len(sets):0{digits}}", method, margins, base, generator))
    return tuple(sets)


def _drawn(
    label: str,
    method: str,
    margins: Mapping[str, Margin],
    base: Scenario,
    generator: random.Random,
) -> Variant:
    problem: BadInputError | None = None
    for _ in range(MAX_TRIES):
        values = {name: margin.draw(generator) for name, margin in margins.items()}
        variant = Variant(label, values)
        try:
            variant.scenario(method, base)
        except BadInputError as error:
            problem = error
            continue
        return variant
    reason = "" if problem is None else f" ({problem})"
    raise BadInputError("--margin", method, f"margins with a set that is allowed{reason}")


@frozen
class Score:
    """Result of a set, over volumes and seeds."""

    label: str
    score_s: float
    """Mean travel time, plus `OTHER_LANE_S` for each percent in other lanes; infinite: the set is
    not eligible."""
    travel_time_s: float | None
    """Mean travel time from the demanded arrival."""
    in_lane_percent: float | None
    """Share of the vehicles that left in their preferred lanes."""
    overlaps: int
    hard_brakes: int
    min_ttc_s: float | None
    failed: int
    """Number of runs that failed, or did not finish."""


def score_of(label: str, runs: Sequence[Run], wanted: int) -> Score:
    """Return the score of a set with a wanted number of runs; see `Score`.

    A set with a run that failed for another reason than an overlap is not eligible: reference
    methods let bodies of 2 m overlap while they change lanes at once.
    """
    summaries = [run.summary for run in runs if run.summary is not None]
    times_s = [one.travel_time_s.mean for one in summaries if one.travel_time_s.mean is not None]
    shares = [one for run in runs if (one := run.preferred_percent) is not None]
    left_all = [one for one in summaries if one.vehicles.left == one.vehicles.demanded]
    complete = len(left_all) == len(times_s) == len(shares) == wanted
    score_s = math.inf
    if complete:
        score_s = fmean(times_s) + OTHER_LANE_S * (100.0 - fmean(shares))
    ttcs_s = [one.safety.min_ttc_s for one in summaries if one.safety.min_ttc_s is not None]
    return Score(
        label=label,
        score_s=score_s,
        travel_time_s=fmean(times_s) if times_s else None,
        in_lane_percent=fmean(shares) if shares else None,
        overlaps=sum(one.safety.overlaps for one in summaries),
        hard_brakes=sum(one.safety.hard_brakes or 0 for one in summaries),
        min_ttc_s=min(ttcs_s, default=None),
        failed=wanted - len(left_all),
    )
