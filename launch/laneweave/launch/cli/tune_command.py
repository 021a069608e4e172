"""`laneweave tune`: find the best settings of a method for a road."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Annotated

import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from laneweave.launch.cli.options import (
    ContinuedFolder,
    Duration,
    Jobs,
    NoProgress,
    check_jobs,
    parse_seeds,
)
from laneweave.launch.run.run_folder import timestamped_folder
from laneweave.launch.run_methods import METHODS
from laneweave.launch.studies.tuning import DEFAULT_SET, Score
from laneweave.launch.sweep.points import Variant
from laneweave.protocol.config.scenario_files import load_scenario
from laneweave.protocol.errors import BadInputError, CommandFailedError
from laneweave.protocol.files import write_atomically

SCHEMA = "laneweave.tuning/1"
TUNING_FILE = "tuning.json"
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
    margin: Annotated[
        list[str] | None,
        typer.Option(
            "--margin",
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
    from laneweave.launch.run_methods import parse_methods
    from laneweave.launch.studies.study_runs import finished_runs
    from laneweave.launch.studies.tuning import draw_sets, margins_of, score_of
    from laneweave.launch.sweep.points import sweep_volumes, variant_points, volume_text

    base = load_scenario(scenario, demand__duration_s=duration)
    try:
        parse_methods(method)
    except BadInputError as error:
        raise BadInputError("METHOD", method, error.allowed) from error
    own = None if base.sumo.config else volume_text(base.demand.volume_veh_per_lane_h)
    chosen = sweep_volumes(volumes or own, base)
    margins = margins_of(method, margin or (), base)
    sets = draw_sets(method, margins, base, budget)
    used = parse_seeds(seeds)
    points = variant_points(sets, method, base, chosen, used)
    folder = out or timestamped_folder("tune")
    with finished_runs(points, folder, check_jobs(jobs), show=not no_progress) as runs:
        wanted = len(chosen) * len(used)
        scores = sorted(
            (score_of(one.label, runs[one.label], wanted) for one in sets),
            key=lambda score: score.score_s,
        )
        settings = {one.label: one for one in sets}
        result = {
            "schema": SCHEMA,
            "method": method,
            "volumes_veh_per_lane_h": list(chosen),
            "seeds": list(used),
            "margins": {name: [one.low, one.high] for name, one in margins.items()},
            "sets": [_record(score, settings[score.label]) for score in scores],
        }
        write_atomically(folder / TUNING_FILE, json.dumps(result, indent=1) + "\n")
        _print(Console(), folder, scores, settings)
    if math.isinf(scores[0].score_s):
        raise CommandFailedError(f"no set let all vehicles leave: see {folder}")


def _record(score: Score, variant: Variant) -> dict[str, object]:
    return {
        "label": score.label,
        "settings": dict(variant.settings),
        "score_s": score.score_s if math.isfinite(score.score_s) else None,
        "travel_time_s": score.travel_time_s,
        "in_lane_percent": score.in_lane_percent,
        "overlaps": score.overlaps,
        "hard_brakes": score.hard_brakes,
        "min_ttc_s": score.min_ttc_s,
        "failed_runs": score.failed,
    }


def _print(console: Console, out: Path, scores: list[Score], settings: dict[str, Variant]) -> None:
    """Print the best sets and the default, and the best one as a part of a scenario file."""
    table = Table(box=SIMPLE_HEAD, show_edge=False, pad_edge=False, collapse_padding=True)
    table.add_column("set", no_wrap=True)
    headings = (
        "score\n(s)",
        "travel\ntime (s)",
        "in lane\n(%)",
        "overlaps",
        "hard\nbrakes",
        "TTC\n(s)",
    )
    for heading in headings:
        table.add_column(heading, justify="right", no_wrap=True)
    best = scores[0]
    for score in [*scores[:SHOWN], *(one for one in scores[SHOWN:] if one.label == DEFAULT_SET)]:
        figures = (score.score_s, score.travel_time_s, score.in_lane_percent)
        table.add_row(
            score.label,
            *("-" if one is None or math.isinf(one) else f"{one:.2f}" for one in figures),
            f"{score.overlaps}",
            f"{score.hard_brakes}",
            "-" if score.min_ttc_s is None else f"{score.min_ttc_s:.2f}",
        )
    console.print(f"laneweave tune: {escape(str(out))}", highlight=False, soft_wrap=True)
    console.print(table)
    console.print(
        "score: mean travel time plus a second for each percent in other lanes; TTC: smallest time "
        "to collision",
        style="dim",
        highlight=False,
    )
    console.print(f"best: {best.label}", highlight=False)
    by_table: dict[str, list[str]] = {}
    for name, value in settings[best.label].settings.items():
        section, _, key = name.partition(".")
        by_table.setdefault(section, []).append(f"{key} = {json.dumps(value)}")
    for section, lines in by_table.items():
        console.print(f"[{section}]", markup=False, highlight=False)
        for line in lines:
            console.print(line, markup=False, highlight=False)
