"""The solvers by name, and the interface of planners that users add."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, Protocol

from attrs import frozen

from laneweave.coordinator.planning.request import PlanRequest
from laneweave.protocol.lattice import Cell
from laneweave.protocol.plug_ins import PlugIns
from laneweave.protocol.scenario.operations import ROLLING_SOLVER

Paths = Sequence[Sequence[Cell]]
"""For each vehicle of a request, in its order: the cells (column, lane) from its start to a target.

Each entry is the cell at one time point, so a repeated cell is a step of waiting. A vehicle whose
path is shorter than that of others waits in its last cell.
"""


PlainPaths = tuple[tuple[Cell, ...], ...]
"""Paths as tuples of integers."""


class PlannerFailedError(Exception):
    """A planner returned no valid paths; the message says why."""


@frozen
class PlanLimits:
    """How long a planner may take."""

    deadline_s: float
    """Time until the plan is needed [s]. Built-in solvers need the rest of the request's deadline,
    in case there is no valid plan then."""
    max_nodes: int
    """Maximum number of search nodes, or of what takes as long. Unlike the time, it is the same in
    each run, so runs in virtual time are repeatable with planners that only count nodes."""


class Planner(Protocol):
    """A planner of a user: a function, or an object with this method.

    An entry point of the group `laneweave.planners` names it, or a class without arguments, of
    which laneweave makes one instance per process. It is called in a process of its own, for one
    request at a time, and may keep data between calls. What it prints goes to stderr.
    """

    def __call__(self, request: PlanRequest, limits: PlanLimits) -> Paths | None:
        """Return a path for each vehicle, or None if none were found.

        Every vehicle has to end in another target among those it is eligible for
        (`request.choices`), only use free cells (`request.grid`) and moves of the mode that it can
        drive, and no two vehicles may make conflicting moves (`request.conflict_model`). laneweave
        checks this. It plans with a built-in solver if the paths are not valid, or come too late,
        or the planner raises an exception, exits or returns None.

        Args:
            request: what to plan. It always lists its targets.
            limits: how long this may take.
        """


PLANNERS: Final = PlugIns(
    kind="planner",
    group="laneweave.planners",
    built_in={
        "tappa": "laneweave.coordinator.planning.paper.tappa:new_search",
        "branching": "laneweave.coordinator.planning.exact.branching:new_search",
    },
    reserved=frozenset({ROLLING_SOLVER}),
)
"""All solvers; built-in ones are functions that return a `Search` for a request."""


def check_solver(name: str | None, field: str = "solver") -> None:
    """Check that a solver is built in, or a plug-in that is installed; None: none is named.

    Raises:
        BadInputError: no solver has this name.
    """
    if name is not None:
        PLANNERS.checked(name, field)
