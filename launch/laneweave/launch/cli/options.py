"""Options that several commands share, with their checks."""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path
from typing import Annotated

import typer

from laneweave.launch.run.logs import LogFormat, LogLevel
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.formation_table import SOLVERS

MAX_SEEDS = 10_000_000
MAX_JOBS = 256
SOLVER_NAMES = ", ".join(SOLVERS) + " or a plug-in"

ScenarioArgument = Annotated[
    Path | None, typer.Argument(metavar="SCENARIO.toml", help="Default: the paper's road.")
]
Duration = Annotated[
    float | None,
    typer.Option(
        "--duration",
        help="Seconds during which vehicles arrive. Travel times leave out the first 60 s.",
    ),
]
Seeds = Annotated[
    str,
    typer.Option(
        "--seeds",
        metavar="A:B",
        help="Seeds from A to B - 1: 1:4 means 1, 2 and 3; 7:8 means 7 alone.",
    ),
]
Jobs = Annotated[
    int | None, typer.Option("--jobs", metavar="N", help="Processes; default: one per core.")
]
NoProgress = Annotated[bool, typer.Option("--no-progress", help="Show no progress bar.")]
ContinuedFolder = Annotated[
    Path | None,
    typer.Option(
        "--out",
        metavar="DIR",
        help="Default: a new folder in runs/. What was stopped in an existing one is continued.",
    ),
]
RunFolder = Annotated[
    Path | None, typer.Option("--out", metavar="DIR", help="Default: a new folder in runs/.")
]
Solver = Annotated[
    str | None,
    typer.Option("--solver", metavar="NAME", help=f"{SOLVER_NAMES}; default: formation.solver."),
]
Config = Annotated[
    Path | None, typer.Option("--config", metavar="DEPLOYMENT.toml", help="Scenario and network.")
]
Endpoint = Annotated[
    str | None, typer.Option("--endpoint", help="Zenoh endpoint; overrides the configuration.")
]
Metrics = Annotated[
    str | None,
    typer.Option(
        "--metrics",
        metavar="HOST:PORT",
        help="Serve metrics over HTTP at this address; overrides the configuration.",
    ),
]
Log = Annotated[
    LogFormat, typer.Option("--log", envvar="LANEWEAVE_LOG", help="Log format on stderr.")
]
Level = Annotated[
    LogLevel | None,
    typer.Option(
        "--log-level",
        envvar="LANEWEAVE_LOG_LEVEL",
        help="Lowest level to log; default: warning as text, info as JSON.",
    ),
]


def load_deployment(config: Path | None, endpoint: str | None, **overrides: object) -> Scenario:
    """Return the configuration of a deployment.

    Args:
        config: path of a DEPLOYMENT.toml; None: the default configuration.
        endpoint: endpoint of the router; overrides the one in the file.
        **overrides: see `load_scenario`.

    Raises:
        BadInputError: the file is invalid, or no endpoint is given.
    """
    from laneweave.protocol.config.scenario_files import load_scenario

    settings = load_scenario(config, network__endpoint=endpoint, **overrides)
    if not settings.network.endpoint:
        raise BadInputError(
            "network.endpoint", "", "an endpoint, in the configuration or with --endpoint"
        )
    return settings


def parse_seeds(text: str) -> range:
    """Return the range of seeds `A:B`, B excluded.

    Raises:
        BadInputError: the text is malformed, or the range is empty or too long.
    """
    match = re.fullmatch(r"(\d{1,12}):(\d{1,12})", text)
    seeds = range(int(match[1]), int(match[2])) if match else range(0)
    if not 0 < len(seeds) <= MAX_SEEDS:
        raise BadInputError(
            "--seeds", text, f"A:B with A < B, seeds A to B - 1, at most {MAX_SEEDS}"
        )
    return seeds


def check_jobs(jobs: int | None) -> int:
    """Return the number of processes to use; default: the number of cores.

    Raises:
        BadInputError: the number is out of range.
    """
    if jobs is None:
        return len(os.sched_getaffinity(0))
    if not 1 <= jobs <= MAX_JOBS:
        raise BadInputError("--jobs", jobs, f"[1, {MAX_JOBS}]")
    return jobs


def reject_unused_options(where: str, **options: object) -> None:
    """Reject options that would have no effect.

    Args:
        where: case in which they have no effect, such as `with --method rule`.
        **options: option values by name (with underscores); None: not given.

    Raises:
        BadInputError: one of the options is given.
    """
    for name, value in options.items():
        if value is not None:
            raise BadInputError(f"--{name.replace('_', '-')}", str(value), f"none {where}")


def shows_progress(no_progress: bool) -> bool:
    """Return whether to show a progress bar."""
    return not no_progress and sys.stderr.isatty()
