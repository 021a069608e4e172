"""A figure of the steps of TAPPA on a request, in the style of the paper's case study.

From top to bottom: the sequence of assignments with C_k and C'_k, the constraint tree of the
assignment with the best path set, and relative path maps of some nodes. This module needs
matplotlib.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Final

import attrs
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyArrowPatch, FancyBboxPatch

from laneweave.coordinator.planning.paper.explanation import (
    ExplainedAssignment,
    ExplainedNode,
    Explanation,
)
from laneweave.launch.drawing.figures import DPI, FAINT_INK, INK, new_figure, save
from laneweave.launch.drawing.tappa_text import number, trees_shown, vector

MAX_ASSIGNMENTS: Final = 6
MAX_LAYERS, MAX_ACROSS, MAX_ENTRIES = 3, 5, 4
MAX_MAPS: Final = 3

_WIDTH_IN, _MARGIN_IN, _TITLE_IN, _CHAIN_IN, _HEADING_IN = 12.0, 0.25, 0.55, 1.75, 0.4
_BOX_IN, _LAYER_GAP_IN, _LINE_IN, _PAD_IN = 2.15, 0.45, 0.165, 0.09
_RADIUS_IN = 0.34
_COLOURS: Final = {"expanded": "#f1f2f4", "solution": "#cdebd9", "open": "#fbf3dc"}
_ASSIGNMENT, _PATHS, _BEST = "#f3c9c4", "#d9d2ec", "#8b74c9"
_SMALL, _NORMAL = 7.5, 9.0


def draw_explanation(explanation: Explanation, out: Path) -> None:
    """Write the figure."""
    save(explanation_figure(explanation), out, DPI)


def explanation_figure(explanation: Explanation) -> Figure:
    """Return the figure; its axes are in inches."""
    best = _best(explanation.assignments)
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
    _write(axes, _MARGIN_IN, 0.25, f"Ended: {explanation.why_it_ended}", size=11)
    _draw_chain(axes, explanation, best, _TITLE_IN)
    if best is None:
        return figure
    top_in = _TITLE_IN + _CHAIN_IN
    k, assignment = best
    _write(axes, _MARGIN_IN, top_in, f"Constraint tree of A_{k}, {len(assignment.nodes)} nodes")
    shown = f"{trees_shown(explanation)}; green: solution, yellow: still in T at the end"
    _write(axes, _MARGIN_IN, top_in + 0.18, shown, size=_SMALL, colour=FAINT_INK)
    _draw_tree(axes, assignment, layers, top_in + _HEADING_IN)
    _draw_maps(axes, maps, top_in + tree_in + 1.5 * _HEADING_IN)
    return figure


def _best(assignments: Sequence[ExplainedAssignment]) -> tuple[int, ExplainedAssignment] | None:
    """Return k and A_k of the best path set, else of the first tree."""
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
    left_out = len(explanation.assignments) - len(shown)
    pitch_in = min(2.6, (_WIDTH_IN - 1.6) / max(1, len(shown) + 1))
    centres = [0.9 + pitch_in * i for i in range(len(shown) + 1)]
    y = top_in + _RADIUS_IN + 0.1
    for left, right in pairwise(centres):
        _arrow(axes, (left + _RADIUS_IN, y), (right - _RADIUS_IN, y))
    for k, (x, one) in enumerate(zip(centres, shown, strict=False), start=1):
        axes.add_patch(Circle((x, y), _RADIUS_IN, facecolor=_ASSIGNMENT, edgecolor=INK))
        _write(axes, x, y - 0.08, f"A_{k}", centred=True)
        _write(axes, x, y + 0.12, f"C_{k} = {one.cost}", size=_SMALL, centred=True)
        _arrow(axes, (x, y + _RADIUS_IN), (x, y + _RADIUS_IN + 0.3))
        is_best = best is not None and best[0] == k and one.best_cost is not None
        cost = number(one.best_cost)
        label = f"P_{k}: C'_{k} = {cost}" if one.best_cost is not None else "none below C'*"
        box = (x - 0.62, y + _RADIUS_IN + 0.3)
        _box(axes, box, 1.24, 0.3, _PATHS, edge=_BEST if is_best else INK, bold=is_best)
        _write(axes, x, box[1] + 0.16, label, size=_SMALL, centred=True)
        _write(
            axes, x, box[1] + 0.45, vector(one.targets), size=6.5, colour=FAINT_INK, centred=True
        )
    last = centres[-1]
    axes.add_patch(Circle((last, y), _RADIUS_IN, facecolor="white", edgecolor=INK, linestyle="--"))
    k = len(explanation.assignments) + 1
    if left_out:
        _write(axes, last, y, f"{left_out} more", size=_SMALL, centred=True)
    elif explanation.next_cost is None:
        _write(axes, last, y, "end", size=_SMALL, centred=True)
    else:
        _write(axes, last, y - 0.08, f"A_{k}", centred=True)
        _write(
            axes, last, y + 0.12, f"C_{k} = {explanation.next_cost:g}", size=_SMALL, centred=True
        )


@attrs.frozen
class _Layer:
    """Nodes of one depth, and how many are left out."""

    nodes: tuple[ExplainedNode, ...]
    left_out: int


def _layers(nodes: Sequence[ExplainedNode]) -> list[_Layer]:
    """Return the first layers of a tree; solutions and their ancestors are not left out."""
    parents = {node.number: node.parent for node in nodes}
    wanted = next((node.number for node in nodes if node.status == "solution"), 0)
    on_the_way = set()
    while wanted:
        on_the_way.add(wanted)
        wanted = parents[wanted]
    layers: list[_Layer] = []
    above = {0}
    while len(layers) < MAX_LAYERS:
        layer = [node for node in nodes if node.parent in above]
        if not layer:
            break
        ranked = sorted(layer, key=lambda node: (node.number not in on_the_way, node.number))
        shown = sorted(ranked[:MAX_ACROSS], key=lambda node: (node.parent, node.number))
        layers.append(_Layer(tuple(shown), len(layer) - len(shown)))
        above = {node.number for node in shown}
    return layers


def _node_lines(node: ExplainedNode) -> list[str]:
    lines = [f"N_{node.number}    L_{node.number} = {node.cost}"]
    lines.append(f"constraint {_short(node.constraint)}" if node.constraint else "no constraints")
    if not node.conflicts:
        lines.append("no conflicts")
    else:
        lines.append("conflicts")
        lines += map(_short, node.conflicts[:MAX_ENTRIES])
        if len(node.conflicts) > MAX_ENTRIES:
            lines.append(f"and {len(node.conflicts) - MAX_ENTRIES} more")
    return lines


def _short(entry: str) -> str:
    """Return an entry that fits into a box."""
    return entry if len(entry) <= 30 else entry[:14] + "…" + entry[-14:]


def _layer_height_in(layer: _Layer) -> float:
    return max(len(_node_lines(node)) for node in layer.nodes) * _LINE_IN + 2 * _PAD_IN


def _draw_tree(
    axes: Axes, assignment: ExplainedAssignment, layers: Sequence[_Layer], top_in: float
) -> None:
    bottoms: dict[int, tuple[float, float]] = {}
    for layer in layers:
        height_in = _layer_height_in(layer)
        pitch_in = (_WIDTH_IN - 2 * _MARGIN_IN) / max(len(layer.nodes), 1)
        for i, node in enumerate(layer.nodes):
            x = _MARGIN_IN + (i + 0.5) * pitch_in
            lines = _node_lines(node)
            own_in = len(lines) * _LINE_IN + 2 * _PAD_IN
            solved = node.status == "solution"
            corner = (x - _BOX_IN / 2, top_in)
            _box(axes, corner, _BOX_IN, own_in, _COLOURS[node.status], bold=solved)
            for row, line in enumerate(lines):
                y = top_in + _PAD_IN + (row + 0.5) * _LINE_IN
                _write(axes, corner[0] + _PAD_IN, y, line, size=_NORMAL if row == 0 else _SMALL)
            if node.parent in bottoms:
                _arrow(axes, bottoms[node.parent], (x, top_in))
            bottoms[node.number] = (x, top_in + own_in)
        if layer.left_out:
            text = f"… and {layer.left_out} more children"
            x = _WIDTH_IN - _MARGIN_IN
            _write(axes, x, top_in - 0.12, text, size=_SMALL, colour=FAINT_INK, right=True)
        top_in += height_in + _LAYER_GAP_IN
    deeper = len(assignment.nodes) - sum(len(layer.nodes) + layer.left_out for layer in layers)
    if deeper:
        text = f"{deeper} more nodes are not drawn"
        y = top_in - 0.25
        _write(axes, _WIDTH_IN - _MARGIN_IN, y, text, size=_SMALL, colour=FAINT_INK, right=True)


def _chosen_maps(nodes: Sequence[ExplainedNode], layers: Sequence[_Layer]) -> list[ExplainedNode]:
    """Return the root, the solution, and one more node that is drawn."""
    drawn = [node for layer in layers for node in layer.nodes]
    solutions = [node for node in nodes if node.status == "solution"]
    others = [node for node in drawn[1:] if node not in solutions]
    return [*drawn[:1], *(one for one in solutions if one not in drawn[:1]), *others][:MAX_MAPS]


def _map_lines(node: ExplainedNode) -> list[str]:
    return str(node.path_map).splitlines()


def _draw_maps(axes: Axes, nodes: Sequence[ExplainedNode], top_in: float) -> None:
    """Draw relative path maps side by side, as many columns of them as there is room for."""
    pitch_in = (_WIDTH_IN - 2 * _MARGIN_IN) / max(1, len(nodes))
    for i, node in enumerate(nodes):
        left = _MARGIN_IN + i * pitch_in
        _write(axes, left, top_in, f"Relative path map of N_{node.number}")
        lines = _map_lines(node)
        widest = max(map(len, lines))
        size = min(7.5, 72 * (pitch_in - 0.3) / (0.62 * widest))
        for row, line in enumerate(lines, start=1):
            y = top_in + 0.06 + row * _LINE_IN
            axes.text(
                left,
                y,
                line,
                size=size,
                family="monospace",
                va="center",
                color=INK,
                parse_math=False,
            )


def _box(
    axes: Axes,
    corner: tuple[float, float],
    width: float,
    height: float,
    colour: str,
    *,
    edge: str = INK,
    bold: bool = False,
) -> None:
    style = "round,pad=0,rounding_size=0.06"
    axes.add_patch(
        FancyBboxPatch(
            corner, width, height, boxstyle=style, fc=colour, ec=edge, lw=2.0 if bold else 0.8
        )
    )


def _arrow(axes: Axes, start: tuple[float, float], end: tuple[float, float]) -> None:
    arrow = FancyArrowPatch(start, end, arrowstyle="-|>", mutation_scale=9, shrinkA=0, shrinkB=1)
    arrow.set(color=FAINT_INK, linewidth=0.9)
    axes.add_patch(arrow)


def _write(
    axes: Axes,
    x: float,
    y: float,
    text: str,
    *,
    size: float = _NORMAL,
    colour: str = INK,
    centred: bool = False,
    right: bool = False,
) -> None:
    where = "center" if centred else "right" if right else "left"
    # Names may contain dollar signs, which must not start formulas.
    axes.text(x, y, text, size=size, color=colour, ha=where, va="center", parse_math=False)
