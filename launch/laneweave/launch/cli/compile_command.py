"""`laneweave compile`: compile the solvers in advance."""

from __future__ import annotations

import typer

from laneweave.coordinator.planning.kernels import KERNELS


def compile_solvers() -> None:
    """Compile the solvers that need it, which otherwise happens when they are first used."""
    for solver, kernels in KERNELS.items():
        kernels.load()
        typer.echo(f"{solver}: compiled")
