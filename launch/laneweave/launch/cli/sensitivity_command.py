"""`laneweave sensitivity`: how much results depend on single settings."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import attrs
import typer

from laneweave.launch.cli.options import (
    Duration,
    Jobs,
    NoProgress,
    ScenarioArgument,
    Seeds,
    check_jobs,
    parse_seeds,
)
from laneweave.launch.run.run_folder import timestamped_folder
from laneweave.launch.run_methods import METHODS
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
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            metavar="DIR",
            help="Default: a new folder in runs/. An existing study is continued.",
        ),
    ] = None,
    no_progress: NoProgress = False,
) -> None:
    """Change one setting at a time, in virtual time, and write a page with a tornado chart."""
    from laneweave.launch.run_methods import parse_methods
    from laneweave.launch.studies.sensitivity import BASE, by_effect, factors_of, result_of
    from laneweave.launch.studies.sensitivity_page import write_sensitivity
    from laneweave.launch.studies.variants import (
        Variant,
        check_recorded,
        runs_by_label,
        variant_points,
    )
    from laneweave.launch.sweep.execution import run_locally
    from laneweave.launch.sweep.folder import SweepFolder
    from laneweave.launch.sweep.points import sweep_volumes, volume_text
    from laneweave.launch.sweep.sweep import run_sweep

    base = load_scenario(
        scenario, demand__duration_s=duration, demand__volume_veh_per_lane_h=volume
    )
    if len(parse_methods(method)) != 1:
        raise BadInputError("--method", method, "one method")
    if base.sumo.config:
        raise BadInputError("sumo.config", base.sumo.config, "none: a road of the scenario's own")
    factors = factors_of(method, base)
    variants = [
        Variant(BASE, {}),
        *(level.variant for factor in factors for level in factor.levels),
    ]
    own = base.demand.volume_veh_per_lane_h
    sweep_volumes(volume_text(own), base)
    points = tuple(
        point
        for one in variants
        for point in variant_points([one], method, base, [_volume(one, own)], parse_seeds(seeds))
    )
    workers = check_jobs(jobs)
    with SweepFolder(out or timestamped_folder("sensitivity")) as folder:
        check_recorded(folder, points)
        failed = run_sweep(
            points,
            folder,
            lambda waiting, unfinished: run_locally(waiting, unfinished, workers),
            show=not no_progress,
        )
        results = {label: result_of(runs) for label, runs in runs_by_label(folder, points).items()}
        ordered = by_effect(factors, results, results[BASE])
        record = {
            "schema": SCHEMA,
            "method": method,
            "volume_veh_per_lane_h": own,
            "seeds": list(parse_seeds(seeds)),
            "duration_s": base.demand.duration_s,
            BASE: attrs.asdict(results[BASE]),
            "factors": [
                {
                    "name": factor.name,
                    "refused": list(factor.refused),
                    "levels": [
                        {
                            "text": level.text,
                            "settings": dict(level.variant.settings),
                            **attrs.asdict(results[level.variant.label]),
                        }
                        for level in factor.levels
                    ],
                }
                for factor in ordered
            ],
        }
        write_atomically(folder.out / RESULTS_FILE, json.dumps(record, indent=1) + "\n")
        lead = (
            f"{method} at {own:g} veh/(lane h), {base.demand.duration_s:g} s of arrivals, "
            f"seeds {seeds}. One setting is changed at a time."
        )
        page = write_sensitivity(
            folder.out, "laneweave: sensitivity", lead, ordered, results, results[BASE]
        )
    typer.echo(f"{page}: written")
    raise typer.Exit(1 if failed else 0)


def _volume(variant: object, own: float) -> float:
    """Return the volume of a variant: its own, or that of the base."""
    settings = getattr(variant, "settings", {})
    return float(settings.get("demand.volume_veh_per_lane_h", own))
