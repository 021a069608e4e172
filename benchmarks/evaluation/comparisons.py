"""Formation control against reference methods, by confidence intervals over the seeds."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from typing import Final

from evaluation.evidence import Evidence
from evaluation.intervals import MIN_SEEDS, Difference, Verdict, difference
from evaluation.markdown import MISSING, NOT_RUN, markdown, number
from evaluation.points import PointRow
from evaluation.programme import FORMATIONS, LABELS, TUNED_GOALS, VOLUMES, planned

OWN: Final = ("formations", "rolling")
"""Labels that are compared: the two operations with their default settings."""
OPPONENTS: Final = tuple(label for label in LABELS if label not in FORMATIONS)
TUNED: Final = ("lc2013-tuned", "sl2015-tuned")
"""Drivers with the best sets that `laneweave tune` has found for this road."""
TUNED_VOLUMES: Final = tuple(volume for volume in VOLUMES if volume >= 1000.0)
"""Volumes of the comparison with tuned drivers, in vehicles/(lane h)."""
WORDS: Final = {
    Verdict.LESS: "faster than",
    Verdict.MORE: "**slower than**",
    Verdict.NONE: "not different from",
    Verdict.UNKNOWN: "not compared with",
}
"""What a difference of travel times means, in the order of the sentences."""
_COMPARED_WORDS: Final = {
    Verdict.LESS: "less",
    Verdict.MORE: "**more**",
    Verdict.NONE: "not different",
}


def comparison(evidence: Evidence) -> str:
    """Return tables of differences of travel times, and a sentence for each volume."""
    return "\n\n".join(_of_one(evidence, label) for label in OWN)


def _of_one(evidence: Evidence, label: str) -> str:
    rows = []
    sentences = []
    for volume in (volume for volume in VOLUMES if planned(label, volume)):
        found = {
            other: difference_of(evidence, label, other, volume, "travel_s") for other in OPPONENTS
        }
        rows.append([f"{volume:g}", *(_cell(found[other], other, volume) for other in OPPONENTS)])
        words = "; ".join(_words(found))
        if words:
            sentences.append(f"- At {volume:g}, `{label}` is {words}.")
    headings = ["veh/(lane h)", *(f"`{label}` minus `{other}`" for other in OPPONENTS)]
    return "\n\n".join([markdown(headings, rows), "\n".join(sentences) or MISSING])


def tuned_comparison(evidence: Evidence) -> str:
    """Return the figures of both operations beside tuned drivers, and a sentence for each pair."""
    rows = [
        _figures(evidence.by_key[label, volume])
        for volume in TUNED_VOLUMES
        for label in (*OWN, *TUNED)
        if (label, volume) in evidence.by_key
    ]
    headings = (
        "veh/(lane h)", "method", "runs", "travel time [s]", "below 3 s to collision [s per run]",
        "minimum time to collision [s]", "vehicles that brake harder than 5 m/s2, per run",
        "CO2, petrol [g/km]",
    )  # fmt: skip
    sentences, without = [], dict[str, None]()
    for volume, own, other in itertools.product(TUNED_VOLUMES, OWN, TUNED):
        found = {
            goal: one
            for goal in TUNED_GOALS
            if (one := difference_of(evidence, own, other, volume, goal.figure)) is not None
        }
        words = [
            f"{goal.name} {_COMPARED_WORDS[one.verdict]} ({one.mean:+.2f} {goal.unit}, "
            f"{one.bounds.low:+.2f} to {one.bounds.high:+.2f})"
            for goal, one in found.items()
            if one.bounds is not None
        ]
        if words:
            sentences.append(f"- At {volume:g}, `{own}` against `{other}`: {', '.join(words)}.")
        elif found:
            without[f"{volume:g}"] = None
    if without:
        sentences.append(
            f"- Without intervals, for which {MIN_SEEDS} seeds are necessary: {', '.join(without)}."
        )
    return "\n\n".join([markdown(headings, rows), "\n".join(sentences) or MISSING])


def _figures(row: PointRow) -> list[str]:
    """Return the row of a method at a volume in the comparison with tuned drivers."""
    return [
        f"{row.volume_veh_per_lane_h:g}",
        f"`{row.label}`",
        f"{len(row.seeds)}",
        number(row.mean("travel_s"), 2),
        number(row.mean("ttc_below_3_s"), 1),
        number(row.lowest("min_ttc_s"), 2),
        number(row.mean("hard_brakes"), 1),
        number(row.mean("co2_g_per_km"), 1),
    ]


def difference_of(
    evidence: Evidence, own: str, other: str, volume: float, figure: str
) -> Difference | None:
    """Return the difference of a figure between two methods at a volume, paired by seed.

    None: a method has no complete run there, or they have no seed in common.

    Args:
        evidence: the runs.
        own: label of one method.
        other: label of the method whose figures are subtracted.
        volume: in vehicles/(lane h).
        figure: name of a field of the runs.
    """
    found = [_by_seed(evidence, label, volume, figure) for label in (own, other)]
    return difference(*found)


def _by_seed(evidence: Evidence, label: str, volume: float, figure: str) -> Mapping[int, float]:
    row = evidence.by_key.get((label, volume))
    runs = () if row is None else row.complete
    values = {run.seed: getattr(run, figure) for run in runs}
    return {seed: value for seed, value in values.items() if value is not None}


def _cell(found: Difference | None, other: str, volume: float) -> str:
    if found is None:
        return MISSING if planned(other, volume) else NOT_RUN
    if found.bounds is None:
        return f"{found.mean:+.2f}"
    return f"{found.mean:+.2f} [{found.bounds.low:+.2f}, {found.bounds.high:+.2f}]"


def _words(found: Mapping[str, Difference | None]) -> Iterator[str]:
    """Yield the opponents with each verdict."""
    for verdict, words in WORDS.items():
        names = [
            f"`{other}`"
            for other, one in found.items()
            if one is not None and one.verdict is verdict
        ]
        if names:
            yield f"{words} {', '.join(names)}"
