"""Formation control against reference methods, by confidence intervals over the seeds."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping
from typing import Final

from evaluation.evidence import Evidence
from evaluation.intervals import MIN_SEEDS, Difference, Verdict, difference
from evaluation.markdown import MISSING, NOT_RUN, markdown, number
from evaluation.points import PointRow
from evaluation.programme import FORMATIONS, LABELS, TUNED_FIGURES, VOLUMES, planned

OWN: Final = ("formations", "rolling")
"""Labels of the two operations with their default settings."""
COMPARED: Final = (*OWN, *(label for label in FORMATIONS if label not in OWN))
"""Labels whose travel times are compared with those of the references."""
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
    return "\n\n".join(_of_one(evidence, label) for label in COMPARED)


def _of_one(evidence: Evidence, label: str) -> str:
    rows, sentences, without = [], [], []
    for volume in (volume for volume in VOLUMES if planned(label, volume)):
        cells = {
            other: difference_of(evidence, label, other, volume, "travel_s") for other in OPPONENTS
        }
        rows.append([f"{volume:g}", *(_cell(cells[other], other, volume) for other in OPPONENTS)])
        found = {other: one for other, one in cells.items() if one is not None}
        if any(one.bounds is not None for one in found.values()):
            sentences.append(f"- At {volume:g}, `{label}` is {'; '.join(_words(found))}.")
        elif found:
            without.append(volume)
    sentences += _without_intervals(without)
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
        "CO2, petrol [g/km]", "time beyond comfort [%]",
    )  # fmt: skip
    sentences, judged = [], dict[float, bool]()
    for volume, own, other in itertools.product(TUNED_VOLUMES, OWN, TUNED):
        found = {
            figure: one
            for figure in TUNED_FIGURES
            if (one := difference_of(evidence, own, other, volume, figure.field)) is not None
        }
        words = [
            f"{figure.name} {_COMPARED_WORDS[one.verdict]} ({one.mean:+.2f} {figure.unit}, "
            f"{one.bounds.low:+.2f} to {one.bounds.high:+.2f}){_pairs(one)}"
            for figure, one in found.items()
            if one.bounds is not None
        ]
        if found:
            judged[volume] = judged.get(volume, False) or bool(words)
        if words:
            sentences.append(f"- At {volume:g}, `{own}` against `{other}`: {', '.join(words)}.")
    sentences += _without_intervals(volume for volume, known in judged.items() if not known)
    return "\n\n".join([markdown(headings, rows), "\n".join(sentences) or MISSING])


def _figures(row: PointRow) -> list[str]:
    """Return the row of a method at a volume in the comparison with tuned drivers."""
    return [
        f"{row.volume_veh_per_lane_h:g}",
        f"`{row.label}`",
        f"{len(row.runs)}" + (f", {row.unfinished} not finished" if row.unfinished else ""),
        number(row.mean("travel_s"), 2),
        number(row.mean("ttc_below_3_s"), 1),
        number(row.lowest("min_ttc_s"), 2),
        number(row.mean("hard_brakes"), 1),
        number(row.mean("co2_g_per_km"), 1),
        number(row.mean("uncomfortable_percent"), 1),
    ]


def difference_of(
    evidence: Evidence, own: str, other: str, volume: float, figure: str
) -> Difference | None:
    """Return the difference of a figure between two methods at a volume, paired by seed.

    None: there is no seed with which both methods have a complete run there.

    Args:
        evidence: the runs.
        own: label of one method.
        other: label of the method whose figures are subtracted.
        volume: in vehicles/(lane h).
        figure: name of a field of the runs.
    """
    found = [_by_seed(evidence, label, volume, figure) for label in (own, other)]
    return difference(*found)


def _by_seed(
    evidence: Evidence, label: str, volume: float, figure: str
) -> Mapping[int, float | None]:
    row = evidence.by_key.get((label, volume))
    runs = () if row is None else row.runs
    return {run.seed: getattr(run, figure) if run.complete else None for run in runs}


def _cell(found: Difference | None, other: str, volume: float) -> str:
    if found is None:
        return MISSING if planned(other, volume) else NOT_RUN
    known = "" if found.bounds is None else f" [{found.bounds.low:+.2f}, {found.bounds.high:+.2f}]"
    return f"{found.mean:+.2f}{known}{_pairs(found)}"


def _pairs(found: Difference) -> str:
    """Return as text how many of the common seeds have both values; empty: all of them."""
    if not found.incomplete_pairs:
        return ""
    return f" ({found.seeds} of {found.seeds + found.incomplete_pairs} seeds)"


def _without_intervals(volumes: Iterable[float]) -> Iterator[str]:
    """Yield a sentence that names the volumes without intervals, if there are any."""
    if names := ", ".join(f"{volume:g}" for volume in volumes):
        yield f"- Without intervals, for which {MIN_SEEDS} seeds are necessary: {names}."


def _words(found: Mapping[str, Difference]) -> Iterator[str]:
    """Yield the opponents with each verdict."""
    for verdict, words in WORDS.items():
        names = [f"`{other}`" for other, one in found.items() if one.verdict is verdict]
        if names:
            yield f"{words} {', '.join(names)}"
