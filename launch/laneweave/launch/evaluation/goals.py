"""The goals, each with what was measured and whether it is met."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

from laneweave.launch.evaluation.evidence import Evidence
from laneweave.launch.evaluation.markdown import HOLDS, MISSED, MISSING, markdown, number
from laneweave.launch.evaluation.points import PointRow
from laneweave.launch.evaluation.programme import (
    FORMATIONS,
    GOALS,
    LEAST_FACTORS,
    MOST_COST_RATIO,
    SEEDS,
)

_PAPER: Final = "paper-12"
_ROLLING: Final = "rolling"


def goals_table(evidence: Evidence) -> str:
    """Return the table of all goals."""
    rows = [*_traffic(evidence), *_safety(evidence), *_runtime(evidence)]
    return markdown(["goal", "asked for", "measured", ""], rows)


def _traffic(evidence: Evidence) -> Iterator[tuple[str, str, str, str]]:
    """Yield the goals for travel times and lanes."""
    found = evidence.by_key
    for goal in GOALS:
        asked_for = ((_PAPER, goal.paper_s), (_ROLLING, goal.rolling_s))
        for label, most_s in asked_for:
            if most_s is None:
                continue
            volume = goal.volume_veh_per_lane_h
            row = found.get((label, volume))
            share = goal.on_lane_percent
            at_least = "" if share == 100.0 else "at least "
            yield (
                f"`{label}`, {volume:g} veh/(lane h)",
                f"at most {most_s:g} s, {at_least}{share:g} % on their lane",
                MISSING if row is None else _measured(row),
                "" if row is None else _verdict(meets(row, most_s, share)),
            )


def meets(row: PointRow, most_s: float, share_percent: float) -> bool:
    """Tell whether a point meets a goal.

    Args:
        row: the point.
        most_s: greatest mean travel time.
        share_percent: of all vehicles, that leave on their preferred lane.
    """
    on_time = row.travel_s is not None and row.travel_s <= most_s
    return on_time and 100.0 * row.on_preferred_lane >= share_percent * row.demanded > 0.0


def _measured(row: PointRow) -> str:
    off = row.demanded - row.on_preferred_lane
    lanes = f"{off} of {row.demanded:,} not on their lane" if off else "100 %"
    few = "" if len(row.seeds) >= len(SEEDS) else f" ({len(row.seeds)} of {len(SEEDS)} seeds)"
    return f"{number(row.travel_s, 2)} s, {lanes}{few}"


def _safety(evidence: Evidence) -> Iterator[tuple[str, str, str, str]]:
    """Yield what every run of formation control has promised."""
    rows = [row for row in evidence.points if row.label in FORMATIONS and row.seeds]
    runs = f"{sum(len(row.seeds) for row in rows)} runs of formation control"
    yield _one(
        "overlaps", "none", f"{sum(row.overlaps for row in rows)} in {runs}",
        [not row.overlaps for row in rows],
    )  # fmt: skip
    low = min((row.min_accel_mps2 for row in rows if row.min_accel_mps2 is not None), default=None)
    high = max((row.max_accel_mps2 for row in rows if row.max_accel_mps2 is not None), default=None)
    setting = evidence.setting
    limits = (
        f"{setting.min_accel_mps2:g} to {setting.max_accel_mps2:g} m/s2" if setting else "limits"
    )
    yield _one(
        "accelerations", limits, f"{number(low, 2)} to {number(high, 2)} m/s2",
        [row.within_limits for row in rows],
    )  # fmt: skip
    traced = [row.traced for row in rows if row.traced is not None]
    least = [one.lattice_least_m for one in traced if one.lattice_least_m is not None]
    looked_at = f"{sum(one.lattice_pairs for one in traced):,} in {sum(one.runs for one in traced)}"
    yield _one(
        "spacing at lattice points", "never below d_F",
        f"{number(min(least, default=None), 2)} m, least of {looked_at} runs",
        [one.lattice_kept for one in traced],
    )  # fmt: skip


def _runtime(evidence: Evidence) -> Iterator[tuple[str, str, str, str]]:
    """Yield the goals for the network and for speed."""
    agreements = evidence.agreements
    differ = sum(not row.agreement.holds for row in agreements)
    yield _one(
        "three points over Zenoh, one process per vehicle", "as simulated: lanes, travel times",
        f"{differ} of {len(agreements)} differ", [row.agreement.holds for row in agreements],
    )  # fmt: skip
    factors = {row.trial: row.real_time_factor for row in evidence.factors}
    names = {
        "zenoh": "one process per vehicle",
        "zenoh-50": "50 vehicles per process",
        "simulated": "one process, simulated network",
    }
    for trial, least in LEAST_FACTORS.items():
        factor = factors.get(trial)
        yield _one(
            f"real-time factor at 1600, {names[trial]}", f"at least {least:g}",
            number(factor, 2), [] if factor is None else [factor >= least],
        )  # fmt: skip
    cost_ms = {row.trial: row.cost_ms for row in evidence.costs}
    known = "short" in cost_ms and "long" in cost_ms
    ratio = cost_ms["long"] / cost_ms["short"] if known else 1.0
    yield _one(
        "cost of a vehicle on 10 km, 1,000 vehicles, against 1 km",
        f"at most {MOST_COST_RATIO:g} times", f"{ratio:.2f} times",
        [ratio <= MOST_COST_RATIO] if known else [],
    )  # fmt: skip


def _one(what: str, asked: str, measured: str, kept: Sequence[bool]) -> tuple[str, str, str, str]:
    """Return a row; without anything that was looked at, one that says so."""
    if not kept:
        return what, asked, MISSING, ""
    return what, asked, measured, _verdict(all(kept))


def _verdict(met: bool) -> str:
    return HOLDS if met else MISSED
