"""`laneweave export`: a recorded run in an open format."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from laneweave.launch.export.formats import Format


def export(
    run: Annotated[
        Path, typer.Argument(metavar="RUN", help="Folder of a run.", show_default=False)
    ],
    chosen: Annotated[
        Format,
        typer.Option("--format", help="SUMO's FCD, CSV, MCAP for Foxglove, or CommonRoad."),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            metavar="PATH",
            help="File (*.xml, *.xml.gz, *.mcap), or folder of CSV files; default: in RUN/export.",
        ),
    ] = None,
    from_s: Annotated[
        float | None, typer.Option("--from", metavar="S", help="First road time.")
    ] = None,
    to_s: Annotated[float | None, typer.Option("--to", metavar="S", help="Last road time.")] = None,
) -> None:
    """Write a recorded run in an open format, and print the names of the files.

    The run may be unfinished, or from an earlier version.
    """
    from laneweave.launch.export.formats import export as write

    for path in write(run, chosen, out, from_s, to_s):
        typer.echo(path)
