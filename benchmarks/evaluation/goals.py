"""The table of goals, measured values and verdicts."""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Iterator, Sequence

from evaluation.comparisons import OWN, TUNED, TUNED_VOLUMES, difference_of
from evaluation.evidence import Evidence
from evaluation.intervals import Difference
from evaluation.markdown import HOLDS, MISSED, MISSING, counted, markdown, number
from evaluation.points import PointRow
from evaluation.programme import (
    FORMATIONS,
    GOALS,
    MAX_COST_RATIO,
    MIN_FACTORS,
    SEEDS,
    TUNED_FIGURES,
    Goal,
    TunedFigure,
    planned,
)


def goals_table(evidence: Evidence) -> str:
    """Return the table of all goals."""
    rows = [
        *_traffic(evidence),
        *(row for label in OWN for row in _against_tuned(evidence, label)),
        *_safety(evidence),
        *_runtime(evidence),
    ]
    return markdown(["goal", "required", "measured", ""], rows)


def _traffic(evidence: Evidence) -> Iterator[tuple[str, str, str, str]]:
    """Yield the goals for travel times and lanes, accelerations and planning."""
    for goal in GOALS:
        row = evidence.by_key.get((goal.label, goal.volume_veh_per_lane_h))
        yield (
            f"`{goal.label}`, {goal.volume_veh_per_lane_h:g} veh/(lane h)",
            ", ".join(_requirements(goal)),
            MISSING if row is None else _measured(row, goal),
            "" if row is None else _verdict(meets(row, goal)),
        )


def _requirements(goal: Goal) -> Iterator[str]:
    at_least = "" if goal.on_lane_percent == 100.0 else "at least "
    yield f"at most {goal.travel_s:g} s"
    yield f"{at_least}{goal.on_lane_percent:g} % in their lane"
    if goal.accel_mps2 is not None:
        yield f"within {goal.accel_mps2:g} m/s2"
    if goal.fallback_percent is not None:
        yield f"at most {goal.fallback_percent:g} % fallbacks"


def meets(row: PointRow, goal: Goal) -> bool:
    """Return whether a point meets a goal for its label and volume."""
    travel_s, demanded = row.mean("travel_s"), row.total("demanded")
    kept = [
        not row.unfinished,
        travel_s is not None and travel_s <= goal.travel_s,
        100.0 * row.total("on_preferred_lane") >= goal.on_lane_percent * demanded > 0.0,
    ]
    if goal.accel_mps2 is not None:
        # Rounded as in the tables.
        found = (row.lowest("min_accel_mps2"), row.highest("max_accel_mps2"))
        kept += [a is not None and round(abs(a), 2) <= goal.accel_mps2 for a in found]
    if goal.fallback_percent is not None:
        fallbacks, plans = row.total("fallbacks"), row.total("plans")
        kept.append(100.0 * fallbacks <= goal.fallback_percent * plans)
    return all(kept)


def _measured(row: PointRow, goal: Goal) -> str:
    if not row.complete:
        return f"none of {counted(len(row.runs), 'run')} finished"
    demanded = row.total("demanded")
    off = demanded - row.total("on_preferred_lane")
    parts = [
        f"{number(row.mean('travel_s'), 2)} s",
        f"{off} of {demanded:,} not in their lane" if off else "100 %",
    ]
    if goal.accel_mps2 is not None:
        low, high = row.lowest("min_accel_mps2"), row.highest("max_accel_mps2")
        parts.append(f"{number(low, 2)} to {number(high, 2)} m/s2")
    if goal.fallback_percent is not None:
        parts.append(f"{row.total('fallbacks')} of {row.total('plans'):,} plans")
    if row.unfinished:
        parts.append(f"{counted(row.unfinished, 'run')} not finished")
    few = "" if len(row.runs) >= len(SEEDS) else f" ({len(row.runs)} of {len(SEEDS)} seeds)"
    return ", ".join(parts) + few


def _against_tuned(evidence: Evidence, label: str) -> Iterator[tuple[str, ...]]:
    """Yield the goals for an operation at all volumes of the comparison with tuned drivers."""
    volumes = [volume for volume in TUNED_VOLUMES if planned(label, volume)]
    name = f"`{label}`, {volumes[0]:g} to {volumes[-1]:g} veh/(lane h): "
    rows = [evidence.by_key.get((label, volume)) for volume in volumes]
    yield f"{name}below 3 s to collision", *_never("ttc_below_3_s", rows)
    yield f"{name}vehicles that brake harder than 5 m/s2", *_never("hard_brakes", rows)
    for figure in TUNED_FIGURES:
        if figure.max_percent is not None:
            found = _against(evidence, label, figure, figure.max_percent)
            yield f"{name}{figure.name} against tuned drivers", figure.requirement, *found


def _never(figure: str, rows: Sequence[PointRow | None]) -> tuple[str, str, str]:
    """Return requirement, measured value and verdict for a figure that must be 0 in every run.

    Runs that did not finish count as runs in which it is not 0.
    """
    listed = [row.runs for row in rows if row is not None]
    values = [getattr(run, figure) if run.complete else math.inf for runs in listed for run in runs]
    if len(listed) < len(rows) or None in values:
        return "never", MISSING, ""
    happened = sum(value > 0.0 for value in values)
    return "never", f"in {happened} of {len(values)} runs", _verdict(not happened)


def _against(
    evidence: Evidence, label: str, figure: TunedFigure, max_percent: float
) -> tuple[str, str]:
    """Return measured value and verdict of a comparison with all tuned drivers.

    Methods with unfinished runs are named; where no run of a driver has finished, it is not
    compared. The goal is missed if a run of the operation itself did not finish.
    """
    found: dict[tuple[str, float], Difference] = {}
    unfinished: dict[str, None] = {}
    kept = True
    for volume, other in itertools.product(TUNED_VOLUMES, TUNED):
        if not (planned(label, volume) and planned(other, volume)):
            continue
        rows = [evidence.by_key.get((name, volume)) for name in (label, other)]
        for row in rows:
            if row is not None and row.unfinished:
                count = f"{row.unfinished} of {len(row.runs)}"
                unfinished[f"{count} of `{row.label}` at {volume:g}"] = None
                kept &= row.label != label
        one = difference_of(evidence, label, other, volume, figure.field)
        if one is not None:
            found[other, volume] = one
        elif all(row is None or row.complete for row in rows):
            return MISSING, ""
    if not found:
        return MISSING, ""
    percent = {key: round(one.percent, 2) for key, one in found.items()}
    worst, volume = max(percent, key=lambda key: percent[key])
    low, high, seeds = min(percent.values()), max(percent.values()), _seeds(found.values())
    text = f"{low:+z.2f} to {high:+z.2f} % (highest: `{worst}` at {volume:g}), {seeds}"
    if unfinished:
        text += f"; runs not finished: {', '.join(unfinished)}"
    return text, _verdict(kept and high <= max_percent)


def _seeds(differences: Collection[Difference]) -> str:
    """Return how many seeds differences are means of."""
    counts = [one.seeds for one in differences]
    few, many = min(counts), max(counts)
    return counted(few, "seed") if few == many else f"{few} to {many} seeds"


def _safety(evidence: Evidence) -> Iterator[tuple[str, ...]]:
    """Yield the guarantees of all runs of formation control."""
    rows = [row for row in evidence.points if row.label in FORMATIONS]
    count = sum(len(row.runs) for row in rows)
    known = [run.overlaps for row in rows for run in row.runs if run.overlaps is not None]
    yield _row(
        "overlaps", "none", f"{sum(known)} in {counted(len(known), 'run')} of formation control",
        [not overlaps for overlaps in known],
    )  # fmt: skip
    unfinished = sum(row.unfinished for row in rows)
    yield _row(
        "runs of formation control in which all vehicles leave", "all",
        f"{count - unfinished} of {count}", [not row.unfinished for row in rows],
    )  # fmt: skip
    low = min((one for row in rows for one in row.values("min_accel_mps2")), default=None)
    high = max((one for row in rows for one in row.values("max_accel_mps2")), default=None)
    setting = evidence.setting
    limits = (
        f"{setting.min_accel_mps2:g} to {setting.max_accel_mps2:g} m/s2" if setting else "limits"
    )
    yield _row(
        "accelerations", limits, f"{number(low, 2)} to {number(high, 2)} m/s2",
        [row.within_limits for row in rows if row.complete],
    )  # fmt: skip
    traced = [row.traced for row in rows if row.traced is not None]
    minimum = [one.lattice_least_m for one in traced if one.lattice_least_m is not None]
    examined = f"{sum(one.lattice_pairs for one in traced):,} in {sum(one.runs for one in traced)}"
    yield _row(
        "spacing at lattice points", "never below d_F",
        f"{number(min(minimum, default=None), 2)} m, minimum of {examined} runs",
        [one.lattice_kept for one in traced],
    )  # fmt: skip


def _runtime(evidence: Evidence) -> Iterator[tuple[str, ...]]:
    """Yield the goals for runs over Zenoh and for execution speed."""
    agreements = evidence.agreements
    differ = sum(not row.agreement.holds for row in agreements)
    yield _row(
        "three points over Zenoh, one process per vehicle", "as simulated: lanes, travel times",
        f"{differ} of {len(agreements)} differ", [row.agreement.holds for row in agreements],
    )  # fmt: skip
    factors = {row.trial: row.real_time_factor for row in evidence.factors}
    names = {
        "zenoh": "one process per vehicle",
        "zenoh-50": "50 vehicles per process",
        "simulated": "one process, simulated network",
    }
    for trial, minimum in MIN_FACTORS.items():
        factor = factors.get(trial)
        yield _row(
            f"real-time factor at 1600, {names[trial]}", f"at least {minimum:g}",
            number(factor, 2), [] if factor is None else [factor >= minimum],
        )  # fmt: skip
    cost_ms = {row.trial: row.cost_ms for row in evidence.costs}
    known = "short" in cost_ms and "long" in cost_ms
    ratio = cost_ms["long"] / cost_ms["short"] if known else 1.0
    yield _row(
        "cost of a vehicle on 10 km, 1,000 vehicles, against 1 km",
        f"at most {MAX_COST_RATIO:g} times", f"{ratio:.2f} times",
        [ratio <= MAX_COST_RATIO] if known else [],
    )  # fmt: skip


def _row(goal: str, required: str, measured: str, kept: Sequence[bool]) -> tuple[str, ...]:
    """Return a row of the table; `MISSING` stands for missing measurements."""
    if not kept:
        return goal, required, MISSING, ""
    return goal, required, measured, _verdict(all(kept))


def _verdict(met: bool) -> str:
    return HOLDS if met else MISSED
