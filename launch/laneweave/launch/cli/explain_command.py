"""`laneweave explain`: what happened to a vehicle in a run, and why it missed its lane."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table


def explain(
    run: Annotated[
        Path, typer.Argument(metavar="RUN", help="Folder of a run.", show_default=False)
    ],
    vehicle: Annotated[
        str, typer.Argument(metavar="VEHICLE", help="Such as v0039.", show_default=False)
    ],
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Tell what happened to a vehicle in a run, and why it missed its lane.

    The run may be unfinished, or from an earlier version: then the events say less.
    """
    from laneweave.launch.explain.explanation import explain as explanation_of

    found = explanation_of(run, vehicle)
    if as_json:
        typer.echo(json.dumps(found.to_dict(), indent=2))
        return
    table = Table(box=None, show_header=False, pad_edge=False)
    table.add_column(justify="right", no_wrap=True)
    table.add_column(overflow="fold")
    for line in found.story:
        table.add_row(f"{line.t_s:.1f} s", escape(line.text))
    Console().print(table)
    typer.echo(found.text)
