"""The steps of TAPPA as text, for `laneweave plan --explain`."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Final

from laneweave.coordinator.planning.paper.explanation import (
    MAX_LITERAL_NODES,
    ExplainedAssignment,
    ExplainedNode,
    Explanation,
)

MAX_NODES_PRINTED: Final = 40
"""Maximum number of nodes printed per tree."""
MAX_TREES_PRINTED: Final = 12

LITERAL = "the paper's constraint trees: one child for each entry of a node's conflict list"
IMPROVED = (
    f"the improved constraint trees (the paper's took more than {MAX_LITERAL_NODES} nodes): "
    "two children for one conflict, CBSA ends at C'*"
)

_COUNTING = (
    "Targets and nodes count from 1 as in the paper, cells (column, lane) from 0 as in requests. "
    "Step 0 is the start, step 1 the end of the first move."
)


def explanation_text(explanation: Explanation) -> str:
    """Return the table of assignments, the stop reason, and the constraint trees."""
    lines = [
        f"TAPPA with {trees_shown(explanation)}.",
        _COUNTING,
        "",
        *_assignments(explanation.assignments),
        "",
        f"Ended: {explanation.stop_reason}",
    ]
    for k, assignment in enumerate(explanation.assignments[:MAX_TREES_PRINTED], start=1):
        lines += ["", *_tree(k, assignment)]
    more = len(explanation.assignments) - MAX_TREES_PRINTED
    if more > 0:
        lines += ["", f"... and the trees of {more} more assignments"]
    return "\n".join(lines) + "\n"


def trees_shown(explanation: Explanation) -> str:
    """Return a description of the constraint trees: literal or improved."""
    return LITERAL if explanation.literal else IMPROVED


def vector(targets: Sequence[int]) -> str:
    """Return the assignment vector a_k as the paper writes it."""
    return "[" + ", ".join(str(j + 1) for j in targets) + "]"


def number(cost: float | None) -> str:
    """Return a cost as text, or a dash if there is no cost."""
    return "-" if cost is None or math.isinf(cost) else f"{cost:g}"


def _assignments(assignments: Sequence[ExplainedAssignment]) -> list[str]:
    rows = [("k", "assignment A_k", "C_k", "C'_k", "C'*", "nodes")]
    rows += [
        (
            str(k),
            vector(one.targets),
            str(one.cost),
            number(one.best_cost),
            number(one.best_so_far),
            str(len(one.nodes)),
        )
        for k, one in enumerate(assignments, start=1)
    ]
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    return [
        "  ".join(
            text.ljust(width) if i == 1 else text.rjust(width)
            for i, (text, width) in enumerate(zip(row, widths, strict=True))
        )
        for row in rows
    ]


def _tree(k: int, assignment: ExplainedAssignment) -> Iterator[str]:
    """Yield the lines of the constraint tree of A_k, up to `MAX_NODES_PRINTED` nodes."""
    ending = "no path set below C'*" if assignment.best_cost is None else "solution"
    yield f"Constraint tree of A_{k}: {len(assignment.nodes)} nodes, {ending}"
    shown = assignment.nodes[:MAX_NODES_PRINTED]
    if shown:
        yield from _branch(shown, shown[0], "", "")
    if len(assignment.nodes) > len(shown):
        yield f"... and {len(assignment.nodes) - len(shown)} more nodes"
    best = next((node for node in assignment.nodes if node.status == "solution"), None)
    if best is not None:
        yield f"Relative path map of P_{k} (N_{best.number}):"
        yield from (f"    {line}" for line in str(best.path_map).splitlines())


def _branch(
    nodes: Sequence[ExplainedNode], node: ExplainedNode, lead: str, below: str
) -> Iterator[str]:
    """Yield the lines of a node and of its descendants, indented by depth."""
    added = f"  {node.constraint}" if node.constraint else ""
    conflicts = "; ".join(node.conflicts) if node.conflicts else "no conflicts"
    solution = ", solution" if node.status == "solution" else ""
    yield f"{lead}N_{node.number}{added}  L = {node.cost}{solution}: {conflicts}"
    children = [child for child in nodes if child.parent == node.number]
    for child in children:
        last = child is children[-1]
        yield from _branch(
            nodes, child, below + ("└─ " if last else "├─ "), below + ("   " if last else "│  ")
        )
