"""`laneweave simulate`: search for violations of the guarantees under faults."""

from __future__ import annotations

from typing import Annotated

import typer

from laneweave.launch.cli.options import (
    Jobs,
    NoProgress,
    Seeds,
    check_jobs,
    parse_seeds,
    shows_progress,
)


def simulate(
    seeds: Seeds = "0:100",
    profile: Annotated[
        str,
        typer.Option(
            "--profile", metavar="NAME", help="Kinds of faults; an unknown name lists all profiles."
        ),
    ] = "mixed",
    jobs: Jobs = None,
    digest: Annotated[
        bool, typer.Option("--digest", help="Print a digest of all delivered messages.")
    ] = False,
    verbose: Annotated[
        bool,
        typer.Option("--verbose", help="Print the timeline of the first failed, or only, seed."),
    ] = False,
    no_progress: NoProgress = False,
) -> None:
    """Simulate and check runs with far more faults than occur in practice."""
    from laneweave.launch.fault_search import profiles, search

    chosen = profiles.profile_named(profile)
    numbers, count = parse_seeds(seeds), check_jobs(jobs)
    search.silence_logs()
    show = shows_progress(no_progress)
    result = search.search(numbers, chosen, count, digest=digest, show=show)
    if verbose and (result.failed or len(numbers) == 1):
        seed = result.failed[0].seed if result.failed else numbers[0]
        for line in search.timeline_of(seed, chosen):
            typer.echo(line)
    if digest:
        typer.echo(f"digest {result.digest}")
    for line in search.describe(result, chosen):
        typer.echo(line)
    raise typer.Exit(1 if result.failed else 0)
