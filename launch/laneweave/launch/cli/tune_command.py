"""`laneweave tune`: find the best settings of a method for a road."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Annotated

import attrs
import typer
from rich.console import Console

from laneweave.launch.cli.options import (
    ContinuedFolder,
    Duration,
    Jobs,
    NoProgress,
    check_jobs,
    parse_seeds,
)
from laneweave.launch.run.run_folder import timestamped_folder
from laneweave.launch.run_methods import METHODS, KeepTrajectories, LabelledMethod
from laneweave.launch.studies.tuning import DEFAULT_SET, Score
from laneweave.protocol.config.scenario_files import load_scenario
from laneweave.protocol.errors import CommandFailedError
from laneweave.protocol.files import write_atomically

SCHEMA = "laneweave.tuning/1"
TUNING_FILE = "tuning.json"
HEADINGS = (
    "score\n(s)", "travel\ntime (s)", "arrived\n(%)", "overlaps", "hard\nbrakes", "TTC\n(s)",
    "failed\nruns",
)  # fmt: skip
"""Headings of the printed table, after that of the labels."""
CAPTION = (
    "arrived: share that leaves in its lane or at its exit; score: mean travel time plus a second "
    "for each percent that does not; TTC: smallest time to collision"
)
SHOWN = 5
"""Number of sets in the printed table, besides the default."""


def tune(
    method: Annotated[
        str,
        typer.Argument(metavar="METHOD", help=f"One of {', '.join(METHODS)}, or a plug-in."),
    ],
    scenario: Annotated[
        Path | None, typer.Argument(metavar="SCENARIO.toml", help="Default: the paper's road.")
    ] = None,
    volumes: Annotated[
        str | None,
        typer.Option(
            "--volumes",
            metavar="LIST",
            help="Vehicles per lane per hour; default: that of the scenario.",
        ),
    ] = None,
    budget: Annotated[
        int, typer.Option("--budget", metavar="N", help="Number of sets, the default included.")
    ] = 40,
    ranges: Annotated[
        list[str] | None,
        typer.Option(
            "--range",
            metavar="FIELD=LOW:HIGH",
            help="Range of a field of the scenario; replaces that of the method, or adds to them.",
        ),
    ] = None,
    seeds: Annotated[
        str,
        typer.Option(
            "--seeds",
            metavar="A:B",
            help="Seeds from A to B - 1; compare the methods with other seeds afterwards.",
        ),
    ] = "1001:1003",
    duration: Duration = None,
    jobs: Jobs = None,
    out: ContinuedFolder = None,
    no_progress: NoProgress = False,
) -> None:
    """Find a method's best settings for a road by random search, in virtual time."""
    from laneweave.launch.studies.study_runs import checked_label, finished_runs
    from laneweave.launch.studies.tuning import SET_PREFIX, draw_sets, ranges_of, score_of
    from laneweave.launch.sweep.points import points_of, sweep_volumes, volume_text

    base = load_scenario(scenario, demand__duration_s=duration)
    checked_label(method, "METHOD", base)
    own = None if base.sumo.config else volume_text(base.demand.volume_veh_per_lane_h)
    chosen = sweep_volumes(volumes or own, base)
    given = ranges_of(method, ranges or (), base)
    sets = draw_sets(method, given, base, budget)
    used = parse_seeds(seeds)
    points = points_of(base, sets, chosen, used, KeepTrajectories.none)
    folder, workers = out or timestamped_folder("tune"), check_jobs(jobs)
    with finished_runs(points, folder, workers, show=not no_progress, prefix=SET_PREFIX) as found:
        scores = sorted(
            (score_of(label, runs) for label, runs in found.items()),
            key=lambda score: score.score_s,
        )
        result = {
            "schema": SCHEMA,
            "method": method,
            "volumes_veh_per_lane_h": list(chosen),
            "seeds": list(used),
            "ranges": {name: [one.low, one.high] for name, one in given.items()},
            "sets": [_record(score, sets[score.label]) for score in scores],
        }
        write_atomically(folder / TUNING_FILE, json.dumps(result, indent=1) + "\n")
        _print(Console(), folder, scores, sets[scores[0].label])
    if math.isinf(scores[0].score_s):
        why = "runs fail, vehicles stay on the road, or no vehicle is counted"
        raise CommandFailedError(f"with every set {why}: see {folder}")


def _record(score: Score, method: LabelledMethod) -> dict[str, object]:
    return {
        "settings": dict(method.overrides),
        **attrs.asdict(score),
        "score_s": score.score_s if math.isfinite(score.score_s) else None,
    }


def _print(console: Console, out: Path, scores: list[Score], best: LabelledMethod) -> None:
    """Print the best sets and the default, and the best one as a part of a scenario file."""
    from laneweave.launch.sweep.sweep import console_table, print_table

    table = console_table("set", HEADINGS)
    for score in [*scores[:SHOWN], *(one for one in scores[SHOWN:] if one.label == DEFAULT_SET)]:
        figures = (score.score_s, score.travel_time_s, score.arrived_percent)
        table.add_row(
            score.label,
            *("-" if one is None or math.isinf(one) else f"{one:.2f}" for one in figures),
            f"{score.overlaps}",
            f"{score.hard_brakes}",
            "-" if score.min_ttc_s is None else f"{score.min_ttc_s:.2f}",
            f"{score.failed}",
        )
    print_table(console, f"laneweave tune: {out}", table, CAPTION)
    console.print(f"best: {scores[0].label}, with --method {best.method}", highlight=False)
    by_table: dict[str, list[str]] = {}
    for name, value in best.overrides.items():
        section, _, key = name.partition(".")
        if value is not None:
            by_table.setdefault(section, []).append(f"{key} = {json.dumps(value)}")
    for section, lines in by_table.items():
        for line in (f"[{section}]", *lines):
            console.print(line, markup=False, highlight=False)
