"""`laneweave sensitivity`: how much results depend on single settings."""

from __future__ import annotations

import json
from typing import Annotated

import attrs
import typer

from laneweave.launch.cli.options import (
    ContinuedFolder,
    Duration,
    Jobs,
    NoProgress,
    ScenarioArgument,
    Seeds,
    check_jobs,
    parse_seeds,
)
from laneweave.launch.run.run_folder import timestamped_folder
from laneweave.launch.run_methods import METHODS, KeepTrajectories, labelled
from laneweave.protocol.config.scenario_files import load_scenario
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.files import write_atomically

SCHEMA = "laneweave.sensitivity/1"
RESULTS_FILE = "sensitivity.json"


def sensitivity(
    scenario: ScenarioArgument = None,
    method: Annotated[
        str,
        typer.Option(
            "--method", metavar="NAME", help=f"One of {', '.join(METHODS)}, or a plug-in."
        ),
    ] = "formation",
    volume: Annotated[
        float | None, typer.Option("--volume", help="Vehicles per lane per hour.")
    ] = None,
    seeds: Seeds = "1:4",
    duration: Duration = None,
    jobs: Jobs = None,
    out: ContinuedFolder = None,
    no_progress: NoProgress = False,
) -> None:
    """Change one setting at a time, in virtual time, and write a page with a tornado chart."""
    from laneweave.launch.studies.sensitivity import BASE, by_effect, factors_of, result_of
    from laneweave.launch.studies.sensitivity_page import write_sensitivity
    from laneweave.launch.studies.study_runs import checked_label, finished_runs
    from laneweave.launch.sweep.points import points_of

    base = load_scenario(
        scenario, demand__duration_s=duration, demand__volume_veh_per_lane_h=volume
    )
    checked_label(method, "--method", base)
    if base.sumo.config:
        raise BadInputError("sumo.config", base.sumo.config, "none: a road of the scenario's own")
    factors = factors_of(method, base)
    levels = {level.label: level.method for factor in factors for level in factor.levels}
    own, used = base.demand.volume_veh_per_lane_h, parse_seeds(seeds)
    methods = {BASE: labelled(method), **levels}
    points = points_of(base, methods, [own], used, KeepTrajectories.none)
    folder, workers = out or timestamped_folder("sensitivity"), check_jobs(jobs)
    with finished_runs(points, folder, workers, show=not no_progress) as found:
        results = {label: result_of(runs) for label, runs in found.items()}
        ordered = by_effect(factors, results)
        record = {
            "schema": SCHEMA,
            "method": method,
            "volume_veh_per_lane_h": own,
            "seeds": list(used),
            "duration_s": base.demand.duration_s,
            BASE: attrs.asdict(results[BASE]),
            "factors": [
                {
                    "name": factor.name,
                    "refused": list(factor.refused),
                    "levels": [
                        {
                            "text": level.text,
                            "settings": dict(level.method.overrides),
                            **attrs.asdict(results[level.label]),
                        }
                        for level in factor.levels
                    ],
                }
                for factor in ordered
            ],
        }
        write_atomically(folder / RESULTS_FILE, json.dumps(record, indent=1) + "\n")
        seeds_text = f"seeds {seeds}" if len(used) > 1 else f"seed {used[0]} alone"
        lead = (
            f"{method} at {own:g} veh/(lane h), {base.demand.duration_s:g} s of arrivals, "
            f"{seeds_text}. One setting is changed at a time."
        )
        page = write_sensitivity(folder, lead, ordered, results)
        failed = any(run.reason for runs in found.values() for run in runs)
    typer.echo(f"{page}: written")
    raise typer.Exit(1 if failed else 0)
