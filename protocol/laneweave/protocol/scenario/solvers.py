"""Names of the solvers for one formation, as scenarios, requests and the command line have them.

What they do is in the coordinator: `planning.facade`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

SOLVERS: Final = ("tappa", "branching")
"""`tappa`: the paper's algorithm. `branching`: branch and bound, for large formations."""
DEFAULT_SOLVER: Final = "tappa"
ROLLING: Final = "rolling"
"""What plans in the rolling operation, where plans are counted by solver."""
STREAM_PLANNED: Final = "stream-planned"
"""Event that tells of a plan of the rolling operation; those of formations name their solver."""


def solver_of_event(kind: str, data: Mapping[str, Any]) -> str | None:
    """Return what made the plan that an event tells of; None: the event does not say."""
    if kind == STREAM_PLANNED:
        return ROLLING
    solver = data.get("solver")
    return str(solver) if solver in SOLVERS else None
