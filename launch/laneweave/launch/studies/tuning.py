"""Random search for the best settings of a method on a road.

Random search finds good settings as often as a grid with far fewer runs, since few of the settings
matter (J. Bergstra, Y. Bengio, "Random Search for Hyper-Parameter Optimization", Journal of Machine
Learning Research 13, 2012). The first set is that of the method itself.
"""

from __future__ import annotations

import math
import random
from collections.abc import Iterable, Mapping, Sequence
from statistics import fmean
from types import MappingProxyType, NoneType
from typing import Final, get_args, get_type_hints

from attrs import frozen

from laneweave.launch.recordings.runs import Run
from laneweave.launch.run_methods import (
    FORMATION,
    LC2013,
    RULE,
    LabelledMethod,
    affects,
    labelled,
)
from laneweave.launch.sweep.points import checked_settings
from laneweave.protocol.config.scenario_files import to_tables
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.scenario.fields import Scenario

DEFAULT_SET: Final = "default"
SET_PREFIX: Final = "set-"
MAX_BUDGET: Final = 1000
MAX_TRIES: Final = 1000
"""Maximum number of draws for a set that the scenario allows."""
OTHER_LANE_S: Final = 1.0
"""Penalty for each percent of vehicles that leave neither in their lane nor at their exit [s]."""
_LOGARITHMIC: Final = 10.0
"""Ranges whose ends have at least this ratio are drawn uniformly in the logarithm."""
_SHARED: Final = ("road", "demand", "radio", "sensing")
"""Tables that describe the task: equal for all sets, or their results could not be compared."""


@frozen
class Range:
    """Range of a field from which the search draws."""

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


RANGES: Final[Mapping[str, Mapping[str, Range]]] = MappingProxyType(
    {
        LC2013: {
            "lc2013.min_gap_m": Range(0.0, 2.5),
            "lc2013.accel_mps2": Range(1.0, 5.0),
            "lc2013.decel_mps2": Range(2.0, 10.0),
            "lc2013.strategic": Range(0.3, 100.0),
            "lc2013.cooperative": Range(0.0, 1.0),
            "lc2013.assertive": Range(0.5, 5.0),
        },
        RULE: {
            "rule.standstill_gap_m": Range(1.0, 8.0),
            "rule.stop_distance_m": Range(20.0, 400.0),
            "rule.slow_down_mps2": Range(1.0, 6.0),
        },
    }
)
"""Ranges of the reference methods: how they drive. Headways and durations of lane changes, which
describe vehicles, keep their values unless ranges of them are given."""


def ranges_of(label: str, given: Iterable[str], base: Scenario) -> dict[str, Range]:
    """Return the ranges of a search.

    Args:
        label: label of the method.
        given: ranges as `table.field=LOW:HIGH`, which replace those of the method, or add to them.
        base: scenario, whose fields may be varied.

    Raises:
        BadInputError: a range is malformed, or of no number that affects the method; or there are
            none.
    """
    method = labelled(label).method
    ranges, tables = dict(RANGES.get(method, {})), to_tables(base)
    for text in given:
        name, _, limits = text.partition("=")
        table, _, key = name.partition(".")
        fields = tables.get(table)
        if not isinstance(fields, Mapping) or key not in fields:
            raise BadInputError("--range", text, "TABLE.FIELD=LOW:HIGH, a field of scenario files")
        if table in _SHARED:
            raise BadInputError(
                "--range", text, f"no field of {', '.join(_SHARED)}: all sets share it"
            )
        if not affects(name, method):
            raise BadInputError("--range", text, f"a field that affects how {label} drives")
        ranges[name] = _range(text, limits, get_type_hints(type(getattr(base, table)))[key])
    if not ranges:
        raise BadInputError("--range", "", f"at least one range: there are none of {label} itself")
    return ranges


def _range(text: str, limits: str, kind: object) -> Range:
    """Return the range of a field of some type."""
    kinds = set(get_args(kind) or (kind,)) - {NoneType}
    if not kinds <= {int, float}:
        raise BadInputError("--range", text, "a field with one number")
    low_text, _, high_text = limits.partition(":")
    try:
        low, high = float(low_text), float(high_text)
    except ValueError:
        raise BadInputError("--range", text, "TABLE.FIELD=LOW:HIGH, two numbers") from None
    if not -math.inf < low <= high < math.inf:
        raise BadInputError("--range", text, "TABLE.FIELD=LOW:HIGH with LOW <= HIGH")
    whole = float not in kinds
    if whole and math.ceil(low) > math.floor(high):
        raise BadInputError("--range", text, "a range with a whole number")
    return Range(low, high, whole)


def draw_sets(
    label: str, ranges: Mapping[str, Range], base: Scenario, budget: int
) -> dict[str, LabelledMethod]:
    """Return the sets to compare: that of the method, and others drawn with the scenario's seed.

    A larger budget adds sets to those of a smaller one.

    Raises:
        BadInputError: no set within the ranges is allowed in the scenario.
    """
    if not 2 <= budget <= MAX_BUDGET:
        raise BadInputError("--budget", budget, f"[2, {MAX_BUDGET}]")
    # Equal seeds draw equal sets.
    generator = random.Random(f"{base.seed}/tuning/{label}")  # noqa: S311 (no secrets)
    drawn = {
        f"{SET_PREFIX}{number:04}": _drawn(label, ranges, base, generator)
        for number in range(1, budget)
    }
    return {DEFAULT_SET: labelled(label), **drawn}


def _drawn(
    label: str, ranges: Mapping[str, Range], base: Scenario, generator: random.Random
) -> LabelledMethod:
    known, problem = labelled(label), ""
    for _ in range(MAX_TRIES):
        values = {name: one.draw(generator) for name, one in ranges.items()}
        method = known.with_overrides(values)
        try:
            checked_settings(method, base)
        except BadInputError as error:
            problem = str(error)
        else:
            return method
    texts = (f"{name}={one.low:g}:{one.high:g}" for name, one in ranges.items())
    raise BadInputError("--range", " ".join(texts), f"ranges with an allowed set ({problem})")


@frozen
class Score:
    """Result of a set, over volumes and seeds."""

    label: str
    score_s: float
    """Mean travel time, plus `OTHER_LANE_S` for each percent of vehicles that leave neither in
    their lane nor at their exit; infinite: the set is not eligible."""
    travel_time_s: float | None
    """Mean travel time from the demanded arrival."""
    arrived_percent: float | None
    """Share of the departed vehicles that left in their lane, or at their exit."""
    overlaps: int
    hard_brakes: int
    min_ttc_s: float | None
    failed: int
    """Number of runs in which vehicles have not left, or formation control has failed."""


def score_of(label: str, runs: Sequence[Run]) -> Score:
    """Return the score of a set; see `Score`.

    A set is not eligible if vehicles have not left the road. Overlaps make formation control
    ineligible, but not reference methods, whose bodies may overlap while they change lanes at once.
    """
    done = [one.summary for one in runs if one.summary is not None and _is_complete(one)]
    times_s = [one.travel_time_s.mean for one in done if one.travel_time_s.mean is not None]
    shares = [share for one in done if (share := one.preferred_percent) is not None]
    score_s = math.inf
    if len(done) == len(times_s) == len(shares) == len(runs):
        score_s = fmean(times_s) + OTHER_LANE_S * (100.0 - fmean(shares))
    known = [one.summary for one in runs if one.summary is not None]
    ttcs_s = [one.safety.min_ttc_s for one in known if one.safety.min_ttc_s is not None]
    return Score(
        label=label,
        score_s=score_s,
        travel_time_s=fmean(times_s) if times_s else None,
        arrived_percent=fmean(shares) if shares else None,
        overlaps=sum(one.safety.overlaps for one in known),
        hard_brakes=sum(one.safety.hard_brakes or 0 for one in known),
        min_ttc_s=min(ttcs_s, default=None),
        failed=len(runs) - len(done),
    )


def _is_complete(run: Run) -> bool:
    of_sumo = bool(run.scenario.sumo.config)
    if run.summary is None or run.summary.not_left(of_sumo=of_sumo):
        return False
    return not (run.method == FORMATION and run.reason)
