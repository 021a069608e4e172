"""The generated parts of docs/EVALUATION_*.md as Markdown."""

from __future__ import annotations

from collections.abc import Callable

from evaluation.comparisons import comparison, tuned_comparison
from evaluation.evidence import Evidence
from evaluation.goals import goals_table
from evaluation.markdown import MISSING, NOT_RUN, counted, markdown, number
from evaluation.points import PointRow
from evaluation.programme import FORMATIONS, LABELS, SEEDS, VOLUMES, planned
from evaluation.statements import statements_table


def document_parts(evidence: Evidence) -> dict[str, str]:
    """Return each generated part of the document by its name."""
    return {
        "evaluation runs": _runs_table(evidence),
        "evaluation travel times": _by_volume(evidence, _travel_time),
        "evaluation lanes": _by_volume(evidence, _lanes),
        "evaluation margins": _by_volume(evidence, _margins),
        "evaluation brakes": _by_volume(evidence, _brakes),
        "evaluation safety": _by_volume(evidence, _safety),
        "evaluation comfort": _by_volume(evidence, _comfort),
        "evaluation comparison": comparison(evidence),
        "evaluation tuned": tuned_comparison(evidence),
        "evaluation throughput": _by_volume(evidence, _throughput),
        "evaluation planning": _planning(evidence),
        "evaluation lattice": _lattice(evidence),
        "evaluation statements": statements_table(evidence),
        "evaluation goals": goals_table(evidence),
        "evaluation agreement": _agreement(evidence),
        "evaluation factors": _factors(evidence),
        "evaluation costs": _costs(evidence),
        "evaluation pictures": _pictures(evidence),
    }


def _by_volume(evidence: Evidence, text: Callable[[PointRow], str]) -> str:
    """Return a table with a row for each volume and a column for each label."""
    found = evidence.by_key
    rows = [
        [
            f"{volume:g}",
            *(_cell(label, volume, found.get((label, volume)), text) for label in LABELS),
        ]
        for volume in VOLUMES
    ]
    return markdown(["veh/(lane h)", *(f"`{label}`" for label in LABELS)], rows)


def _runs_table(evidence: Evidence) -> str:
    """Return the numbers of runs, and the duration of their arrivals."""
    setting = evidence.setting
    arrivals = MISSING if setting is None else f"{setting.duration_s:g} s"
    return f"{_by_volume(evidence, _runs)}\n\nArrivals in each run: {arrivals}."


def _cell(label: str, volume: float, row: PointRow | None, text: Callable[[PointRow], str]) -> str:
    if row is None:
        return MISSING if planned(label, volume) else NOT_RUN
    if text is not _runs and not row.seeds:
        return "not finished"
    return text(row)


def _runs(row: PointRow) -> str:
    count = f"{len(row.runs)}"
    if len(row.runs) < len(SEEDS):
        count += f" of {len(SEEDS)}"
    with_overlaps = sum((run.overlaps or 0) > 0 for run in row.runs)
    parts = [count]
    if row.unfinished:
        parts.append(f"{row.unfinished} not finished")
    if with_overlaps:
        parts.append(f"{with_overlaps} with overlaps")
    return ", ".join(parts)


def _travel_time(row: PointRow) -> str:
    bounds = row.interval("travel_s")
    known = "" if bounds is None else f" [{bounds.low:.2f}, {bounds.high:.2f}]"
    return f"{number(row.mean('travel_s'), 2)}{known} ({number(row.mean('travel_p95_s'), 1)})"


def _lanes(row: PointRow) -> str:
    off = row.total("left") - row.total("on_preferred_lane")
    share = "100" if not off else number(row.on_lane_percent, 3)
    return f"{share} %" + (f" ({off} off)" if off else "")


def _margins(row: PointRow) -> str:
    figures = (
        number(row.lowest("min_gap_m"), 2),
        number(row.lowest("min_headway_s"), 2),
        number(row.lowest("min_accel_mps2"), 1),
    )
    text = " / ".join(figures)
    return text + (f", **{counted(row.overlaps, 'overlap')}**" if row.overlaps else "")


def _brakes(row: PointRow) -> str:
    demanded = row.total("demanded")
    return number(100.0 * row.total("emergency_brakes") / demanded, 1) if demanded else "-"


def _safety(row: PointRow) -> str:
    runs = [run for run in row.complete if run.ttc_below_3_s is not None]
    left = sum(run.left for run in runs)
    if not left:
        return NOT_RUN
    exposed_s = sum(run.ttc_below_3_s or 0.0 for run in runs) / left
    hard = 100.0 * sum(run.hard_brakes or 0 for run in runs) / left
    closest = (number(row.lowest("min_ttc_s"), 2), f"{exposed_s:.3f}")
    text = " / ".join((*closest, number(row.lowest("min_pet_s"), 2), f"{hard:.1f} %"))
    return text + _of_runs(row, "ttc_below_3_s")


def _comfort(row: PointRow) -> str:
    share, co2 = row.mean("uncomfortable_percent"), row.mean("co2_g_per_km")
    if share is None:
        return NOT_RUN
    return f"{number(share, 1)} % / {number(co2, 1)}{_of_runs(row, 'co2_g_per_km')}"


def _of_runs(row: PointRow, figure: str) -> str:
    """Return how many of the runs have a figure, if not all have it."""
    known, count = len(row.values(figure)), len(row.complete)
    return f" ({known} of {counted(count, 'run')})" if known < count else ""


def _throughput(row: PointRow) -> str:
    return number(row.mean("throughput_veh_per_lane_h"), 0)


def _planning(evidence: Evidence) -> str:
    """Return the table of planning times by label, volume and solver."""
    rows = [
        [
            f"`{row.label}`",
            f"{row.volume_veh_per_lane_h:g}",
            f"`{one.solver}`",
            f"{one.plans:,}",
            *(number(value, 1) for value in (one.p50_ms, one.p95_ms, one.max_ms)),
            f"{row.total('fallbacks')} of {row.total('plans'):,}",
        ]
        for row in evidence.points
        if row.label in FORMATIONS
        for one in row.planning
    ]
    headings = [
        "", "veh/(lane h)", "solver", "plans", "p50 (ms)", "p95 (ms)", "max (ms)", "fallbacks",
    ]  # fmt: skip
    return markdown(headings, rows)


def _lattice(evidence: Evidence) -> str:
    """Return the table of spacings at lattice points and of accelerations."""
    rows = []
    for row in evidence.points:
        if row.traced is None or row.traced.lattice_least_m is None:
            continue
        traced = row.traced
        rows.append(
            [
                f"`{row.label}`",
                f"{row.volume_veh_per_lane_h:g}",
                f"{traced.runs}",
                f"{traced.lattice_pairs:,}",
                f"{number(traced.lattice_least_m, 2)} m",
                f"{number(traced.lattice_worst_off_m, 2)} m",
                "holds" if traced.lattice_kept else "**broken**",
                _accels(row),
                "holds" if row.within_limits else "**broken**",
            ]
        )
    headings = [
        "", "veh/(lane h)", "runs examined", "spacings", "minimum", "max. error in a cell", "d_F",
        "accelerations of all runs", "limits",
    ]  # fmt: skip
    return markdown(headings, rows)


def _accels(row: PointRow) -> str:
    low, high = row.lowest("min_accel_mps2"), row.highest("max_accel_mps2")
    return f"{number(low, 2)} to {number(high, 2)} m/s2"


def _agreement(evidence: Evidence) -> str:
    rows = [
        [
            f"{row.volume_veh_per_lane_h:g}",
            f"{row.duration_s:g} s",
            "-" if row.processes is None else f"{row.processes}",
            f"{row.agreement.vehicles}",
            f"{row.agreement.missing}",
            f"{row.agreement.other_lane}",
            f"{row.agreement.worst_s:.3f} s",
            f"{row.overlaps}",
            "agrees" if row.agreement.holds else "**differs**",
        ]
        for row in evidence.agreements
    ]
    headings = [
        "veh/(lane h)", "arrivals", "processes", "vehicles", "in one run only", "in another lane",
        "max. difference of travel times", "overlaps", "",
    ]  # fmt: skip
    return markdown(headings, rows)


def _factors(evidence: Evidence) -> str:
    rows = [
        [
            f"`{row.command}`",
            "-" if row.processes is None else f"{row.processes}",
            f"{row.vehicles_peak}",
            f"{row.real_time_factor:.2f}",
            f"{number(row.tick_p50_ms, 1)} / {number(row.tick_p99_ms, 1)} ms",
        ]
        for row in evidence.factors
    ]
    headings = ["", "processes", "peak vehicles", "real-time factor", "tick p50 / p99"]
    return markdown(headings, rows)


def _costs(evidence: Evidence) -> str:
    rows = [
        [
            f"{row.road_m / 1000:g} km",
            f"`{row.command}`",
            f"{row.vehicles_peak}",
            f"{row.cost_ms:.3f} ms",
        ]
        for row in evidence.costs
    ]
    headings = ["road", "", "peak vehicles", "per vehicle and tick"]
    return markdown(headings, rows)


def _pictures(evidence: Evidence) -> str:
    parts = [f"![{one.alt}](images/{one.name})\n\n{one.caption}" for one in evidence.pictures]
    return "\n\n".join(parts) or "No figures have been drawn yet."
