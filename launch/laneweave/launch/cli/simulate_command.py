"""`laneweave simulate`: search for violations of the guarantees under faults."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer

from laneweave.launch.cli.options import (
    Jobs,
    NoProgress,
    Seeds,
    check_jobs,
    parse_seeds,
    reject_unused_options,
    shows_progress,
)
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.files import write_atomically

if TYPE_CHECKING:
    from laneweave.launch.fault_search.story import Story


def simulate(
    seeds: Seeds = "0:100",
    profile: Annotated[
        str,
        typer.Option(
            "--profile",
            metavar="NAME",
            help="Kinds of faults; guided: those that reach rarely reached rules. An unknown name "
            "lists all profiles.",
        ),
    ] = "guided",
    jobs: Jobs = None,
    digest: Annotated[
        bool, typer.Option("--digest", help="Print a digest of all delivered messages.")
    ] = False,
    verbose: Annotated[
        bool,
        typer.Option("--verbose", help="Print the timeline of the first failed, or only, seed."),
    ] = False,
    shrink: Annotated[
        Path | None,
        typer.Option(
            "--shrink",
            metavar="FILE",
            help="Shrink the run of the first failed seed, or the story, and write its story.",
        ),
    ] = None,
    story: Annotated[
        Path | None,
        typer.Option("--story", metavar="FILE", help="Run a story instead of seeds."),
    ] = None,
    no_progress: NoProgress = False,
) -> None:
    """Simulate and check runs with far more faults than occur in practice."""
    from laneweave.launch.fault_search import profiles, search
    from laneweave.launch.fault_search.story import Story

    if shrink is not None and (shrink.is_dir() or not shrink.parent.is_dir()):
        raise BadInputError("--shrink", str(shrink), "a file in an existing folder")
    if story is not None:
        reject_unused_options("with --story", digest=digest or None)
        _run_story(Story.read(story), shrink, verbose=verbose)
    chosen = profiles.profiles_named(profile)
    numbers, count = parse_seeds(seeds), check_jobs(jobs)
    search.silence_logs()
    show = shows_progress(no_progress)
    result = search.search(numbers, chosen, count, digest=digest, show=show)
    first = next(iter(result.failed), None)
    if verbose and (first is not None or len(numbers) == 1):
        seed, name = (numbers[0], chosen[0].name) if first is None else (first.seed, first.profile)
        for line in search.timeline_of(Story.drawn(seed, profiles.PROFILES[name])):
            typer.echo(line)
    if shrink is not None and first is not None:
        smaller = search.shrunk(Story.drawn(first.seed, profiles.PROFILES[first.profile]))
        write_atomically(shrink, smaller.text())
        typer.echo(f"story of seed {first.seed}: {shrink}")
    if digest:
        typer.echo(f"digest {result.digest}")
    for line in search.describe(result):
        typer.echo(line)
    raise typer.Exit(1 if result.failed else 0)


def _run_story(story: Story, shrink: Path | None, *, verbose: bool) -> NoReturn:
    """Run one story, shrink it if it fails and a file is given, and exit."""
    from laneweave.launch.fault_search.search import run_story, shrunk, silence_logs, timeline_of

    silence_logs()
    for line in timeline_of(story) if verbose else ():
        typer.echo(line)
    violations = run_story(story).violations
    for violation in violations:
        typer.echo(str(violation))
    if shrink is not None and violations:
        write_atomically(shrink, shrunk(story).text())
        typer.echo(f"smaller story: {shrink}")
    typer.echo("failed" if violations else "passed")
    raise typer.Exit(1 if violations else 0)
