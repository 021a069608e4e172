"""A figure of TAPPA's steps on a request, in the style of the paper's case study.

From top to bottom: the sequence of assignments with C_k and C'_k, the constraint tree of the
assignment with the best path set, and relative path maps of some nodes. This module needs
matplotlib.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from laneweave.coordinator.planning.paper.explanation import (
    ExplainedAssignment,
    ExplainedNode,
    Explanation,
)
from laneweave.launch.drawing.figures import DPI, FAINT_INK, INK, new_figure, save, write
from laneweave.launch.drawing.tappa_text import number, trees_shown, vector

MAX_ASSIGNMENTS: Final = 6
MAX_LAYERS, MAX_PER_LAYER, MAX_ENTRIES = 3, 5, 4
MAX_MAPS: Final = 3

_WIDTH_IN, _MARGIN_IN, _TITLE_IN, _CHAIN_IN, _HEADING_IN = 12.0, 0.25, 0.75, 1.75, 0.4
_LAYER_GAP_IN, _LINE_IN, _PAD_IN = 0.45, 0.165, 0.09
_RADIUS_IN = 0.34
_SUBSCRIPTS: Final = str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉")
_KEY: Final = (
    "circles: assignments A_k and their costs C_k; rectangles: their best path sets P_k and the "
    "costs C'_k of these, with a thick edge for the best one; in brackets: the target of each "
    "vehicle; white: no longer needed"
)
_SPACING: Final = 1.5
"""Line spacing that makes lines `_LINE_IN` high."""
_COLOURS: Final = {"expanded": "#f1f2f4", "solution": "#cdebd9", "open": "#fbf3dc"}
_ASSIGNMENT, _PATHS, _BEST = "#f3c9c4", "#d9d2ec", "#8b74c9"
_SMALL, _NORMAL = 7.5, 9.0
_ARROW: Final[dict[str, Any]] = {
    "arrowstyle": "-|>",
    "color": FAINT_INK,
    "shrinkA": 0,
    "shrinkB": 1,
}

Layer = tuple[list[ExplainedNode], int]
"""Nodes drawn at one depth of a tree, and the number of nodes left out."""


def draw_explanation(explanation: Explanation, out: Path) -> None:
    """Draw an explanation and write the figure to a file."""
    save(explanation_figure(explanation), out, DPI)


def explanation_figure(explanation: Explanation) -> Figure:
    """Return the figure; its axes are in inches, from the upper left corner."""
    best = _best_assignment(explanation.assignments)
    layers = [] if best is None else _layers(best[1].nodes)
    maps = [] if best is None else _chosen_maps(best[1].nodes, layers)
    tree_in = sum(_layer_height_in(layer) + _LAYER_GAP_IN for layer in layers)
    maps_in = max((_LINE_IN * (len(_map_lines(node)) + 1.5) for node in maps), default=0.0)
    height_in = _TITLE_IN + _CHAIN_IN + tree_in + maps_in + 2 * _HEADING_IN + 2 * _MARGIN_IN
    figure = new_figure(_WIDTH_IN, height_in)
    figure.set_layout_engine("none")
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set_axis_off()
    axes.set_xlim(0, _WIDTH_IN)
    axes.set_ylim(height_in, 0)
    write(axes, (_MARGIN_IN, 0.25), f"Ended: {_formula(explanation.stop_reason)}", 11)
    write(axes, (_MARGIN_IN, 0.5), _formula(_KEY), _SMALL, color=FAINT_INK)
    _draw_chain(axes, explanation, best, _TITLE_IN)
    if best is None:
        return figure
    top_in = _TITLE_IN + _CHAIN_IN
    k, assignment = best
    heading = _formula(f"Constraint tree of A_{k}, {len(assignment.nodes)} nodes")
    write(axes, (_MARGIN_IN, top_in), heading, _NORMAL)
    colours = "grey: expanded, green: solution, yellow: still in the queue T at the end"
    shown = f"{trees_shown(explanation)}; {colours}"
    write(axes, (_MARGIN_IN, top_in + 0.18), shown, _SMALL, color=FAINT_INK)
    _draw_tree(axes, assignment, layers, top_in + _HEADING_IN)
    count = f"{len(maps)} of {len(assignment.nodes)} nodes" if maps else ""
    _draw_maps(axes, maps, count, top_in + tree_in + 1.5 * _HEADING_IN)
    return figure


def _formula(text: str) -> str:
    """Return text with the indices, primes and relations of formulas."""
    shown = re.sub(r"_(\d+)", lambda found: found[1].translate(_SUBSCRIPTS), text)
    return shown.replace("_k", "ₖ").replace("'", "\u2032").replace(">=", "≥")


def _best_assignment(
    assignments: Sequence[ExplainedAssignment],
) -> tuple[int, ExplainedAssignment] | None:
    """Return k and A_k for the best path set or, if there is none, for the first tree."""
    found = [(k, one) for k, one in enumerate(assignments, start=1) if one.best_cost is not None]
    if not found:
        return (1, assignments[0]) if assignments and assignments[0].nodes else None
    return min(found, key=lambda item: (item[1].best_cost, item[0]))


def _draw_chain(
    axes: Axes,
    explanation: Explanation,
    best: tuple[int, ExplainedAssignment] | None,
    top_in: float,
) -> None:
    """Draw a circle for each assignment, and below it a rectangle for its path set."""
    shown = explanation.assignments[:MAX_ASSIGNMENTS]
    pitch_in = min(2.6, (_WIDTH_IN - 1.6) / (len(shown) + 1))
    y = top_in + _RADIUS_IN + 0.1
    for k, one in enumerate(shown, start=1):
        x = 0.9 + pitch_in * (k - 1)
        _draw_circle(axes, (x, y), _formula(f"A_{k}\nC_{k} = {one.cost}"), mfc=_ASSIGNMENT)
        axes.annotate("", (x + pitch_in - _RADIUS_IN, y), (x + _RADIUS_IN, y), arrowprops=_ARROW)
        below = y + _RADIUS_IN
        axes.annotate("", (x, below + 0.3), (x, below), arrowprops=_ARROW)
        found = one.best_cost is not None
        label = f"P_{k}: C'_{k} = {number(one.best_cost)}" if found else "none below C'*"
        label = _formula(label)
        is_best = found and best is not None and best[0] == k
        box = _box(_PATHS, edge=_BEST if is_best else INK, bold=is_best)
        write(axes, (x, below + 0.4), label, _SMALL, ha="center", bbox=box)
        write(axes, (x, below + 0.75), vector(one.targets), 6.5, color=FAINT_INK, ha="center")
    k, left_out = len(explanation.assignments) + 1, len(explanation.assignments) - len(shown)
    if left_out:
        text = f"{left_out} more"
    elif explanation.next_cost is None:
        text = "end"
    else:
        text = _formula(f"A_{k}\nC_{k} = {explanation.next_cost:g}")
    _draw_circle(axes, (0.9 + pitch_in * len(shown), y), text, mfc="white")


def _draw_circle(axes: Axes, centre: tuple[float, float], text: str, mfc: str) -> None:
    axes.plot(*centre, "o", ms=2 * 72 * _RADIUS_IN, mfc=mfc, mec=INK, clip_on=False)
    write(axes, centre, text, _SMALL, ha="center", linespacing=_SPACING)


def _layers(nodes: Sequence[ExplainedNode]) -> list[Layer]:
    """Return the first layers of a tree; in each, the solution or its ancestor is always shown."""
    parents = {node.number: node.parent for node in nodes}
    ancestor = next((node.number for node in nodes if node.status == "solution"), 0)
    kept = set()
    while ancestor:
        kept.add(ancestor)
        ancestor = parents[ancestor]
    layers: list[Layer] = []
    above = {0}
    while len(layers) < MAX_LAYERS:
        layer = [node for node in nodes if node.parent in above]
        if not layer:
            break
        ranked = sorted(layer, key=lambda node: (node.number not in kept, node.number))
        shown = sorted(ranked[:MAX_PER_LAYER], key=lambda node: (node.parent, node.number))
        layers.append((shown, len(layer) - len(shown)))
        above = {node.number for node in shown}
    return layers


def _node_lines(node: ExplainedNode) -> list[str]:
    lines = [_formula(f"N_{node.number}    L_{node.number} = {node.cost}")]
    lines.append(f"constraint {_short(node.constraint)}" if node.constraint else "no constraints")
    lines.append("conflicts" if node.conflicts else "no conflicts")
    lines += map(_short, node.conflicts[:MAX_ENTRIES])
    if len(node.conflicts) > MAX_ENTRIES:
        lines.append(f"and {len(node.conflicts) - MAX_ENTRIES} more")
    return lines


def _short(entry: str) -> str:
    """Return an entry, shortened to fit into a box."""
    return entry if len(entry) <= 30 else entry[:14] + "…" + entry[-14:]


def _height_in(node: ExplainedNode) -> float:
    return len(_node_lines(node)) * _LINE_IN + 2 * _PAD_IN


def _layer_height_in(layer: Layer) -> float:
    return max(map(_height_in, layer[0]))


def _draw_tree(
    axes: Axes, assignment: ExplainedAssignment, layers: Sequence[Layer], top_in: float
) -> None:
    bottoms: dict[int, tuple[float, float]] = {}
    right_in, drawn = _WIDTH_IN - _MARGIN_IN, 0
    for nodes, left_out in layers:
        pitch_in = (_WIDTH_IN - 2 * _MARGIN_IN) / len(nodes)
        for i, node in enumerate(nodes):
            x = _MARGIN_IN + (i + 0.5) * pitch_in
            text = "\n".join(_node_lines(node))
            box = _box(_COLOURS[node.status], bold=node.status == "solution")
            node_text = write(axes, (x, top_in + _PAD_IN), text, _SMALL, bbox=box)
            node_text.set(ha="center", va="top", linespacing=_SPACING, multialignment="left")
            if node.parent in bottoms:
                axes.annotate("", (x, top_in), bottoms[node.parent], arrowprops=_ARROW)
            bottoms[node.number] = (x, top_in + _height_in(node))
        if left_out:
            text = f"… and {left_out} more children"
            write(axes, (right_in, top_in - 0.12), text, _SMALL, color=FAINT_INK, ha="right")
        drawn += len(nodes) + left_out
        top_in += _layer_height_in((nodes, left_out)) + _LAYER_GAP_IN
    if len(assignment.nodes) > drawn:
        text = f"{len(assignment.nodes) - drawn} more nodes are not drawn"
        write(axes, (right_in, top_in - 0.25), text, _SMALL, color=FAINT_INK, ha="right")


def _chosen_maps(nodes: Sequence[ExplainedNode], layers: Sequence[Layer]) -> list[ExplainedNode]:
    """Return up to `MAX_MAPS` nodes: the root, the solution, then other drawn nodes."""
    drawn = [node for layer, _ in layers for node in layer]
    solutions = [node for node in nodes if node.status == "solution"]
    others = [node for node in drawn[1:] if node not in solutions]
    return [*drawn[:1], *(one for one in solutions if one not in drawn[:1]), *others][:MAX_MAPS]


def _map_lines(node: ExplainedNode) -> list[str]:
    return str(node.path_map).splitlines()


def _draw_maps(axes: Axes, nodes: Sequence[ExplainedNode], count: str, top_in: float) -> None:
    """Draw relative path maps side by side, in a size that fits; `count` says of how many nodes."""
    pitch_in = (_WIDTH_IN - 2 * _MARGIN_IN) / max(1, len(nodes))
    for i, node in enumerate(nodes):
        left = _MARGIN_IN + i * pitch_in
        shown = f" ({count})" if i == 0 else ""
        heading = _formula(f"Relative path map of N_{node.number}") + shown
        write(axes, (left, top_in), heading, _NORMAL)
        lines = _map_lines(node)
        size_pt = min(_SMALL, 72 * (pitch_in - 0.3) / (0.62 * max(map(len, lines))))
        table = write(axes, (left, top_in + 0.14), "\n".join(lines), size_pt, va="top")
        table.set(family="monospace", linespacing=_SPACING)


def _box(colour: str, *, edge: str = INK, bold: bool = False) -> dict[str, Any]:
    return {"boxstyle": "round,pad=0.4", "fc": colour, "ec": edge, "lw": 2.0 if bold else 0.8}
