"""Formation control against each reference method, by confidence intervals over the seeds."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Final

from evaluation.evidence import Evidence
from evaluation.intervals import Difference, Verdict, difference
from evaluation.markdown import MISSING, NOT_RUN, markdown
from evaluation.programme import FORMATIONS, LABELS, VOLUMES, planned

OWN: Final = ("formations", "rolling")
"""Labels that are compared: the two operations with their default settings."""
OPPONENTS: Final = tuple(label for label in LABELS if label not in FORMATIONS)
WORDS: Final = {
    Verdict.LESS: "faster than",
    Verdict.MORE: "**slower than**",
    Verdict.NONE: "not different from",
    Verdict.UNKNOWN: "not compared with",
}
"""What a difference of travel times means, in the order of the sentences."""


def comparison(evidence: Evidence) -> str:
    """Return tables of differences of travel times, and a sentence for each volume."""
    return "\n\n".join(_of_one(evidence, label) for label in OWN)


def _of_one(evidence: Evidence, label: str) -> str:
    rows = []
    sentences = []
    for volume in (volume for volume in VOLUMES if planned(label, volume)):
        found = {other: _travel(evidence, label, other, volume) for other in OPPONENTS}
        rows.append([f"{volume:g}", *(_cell(found[other], other, volume) for other in OPPONENTS)])
        words = "; ".join(_words(found))
        if words:
            sentences.append(f"- At {volume:g}, `{label}` is {words}.")
    headings = ["veh/(lane h)", *(f"`{label}` minus `{other}`" for other in OPPONENTS)]
    return "\n\n".join([markdown(headings, rows), "\n".join(sentences) or MISSING])


def _travel(evidence: Evidence, own: str, other: str, volume: float) -> Difference | None:
    """Return the difference of mean travel times [s]; None: a method has no run there."""
    found = [_by_seed(evidence, label, volume) for label in (own, other)]
    return difference(*found)


def _by_seed(evidence: Evidence, label: str, volume: float) -> Mapping[int, float]:
    row = evidence.by_key.get((label, volume))
    runs = () if row is None else row.complete
    return {run.seed: run.travel_s for run in runs if run.travel_s is not None}


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
