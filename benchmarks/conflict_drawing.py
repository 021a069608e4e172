"""Draw the conflict table: moves of a vehicle B that conflict with a move of a vehicle A.

Each panel has one kind of move of A; the others follow by symmetry. Around A are the cells from
which B may start, with an arrow for each of its moves and a dot for waiting. The colour shows how
late one of the two must be to come too close to the other.

Used by docs/generate.py and geometry.py; not part of the installed package.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from enum import Enum
from itertools import product
from pathlib import Path
from typing import Final

import attrs
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, FancyArrowPatch, FancyBboxPatch, Rectangle
from matplotlib.patheffects import withStroke

from laneweave.coordinator.planning.conflict_kinds import (
    MAX_OFFSET,
    PAPER_KINDS,
    ConflictModel,
    ConflictTable,
    Pair,
)
from laneweave.coordinator.planning.geometry.conflict_table import conflict_table
from laneweave.coordinator.planning.geometry.swept_bodies import BodyGeometry
from laneweave.launch.drawing.figures import FAINT_INK, INK, new_figure, save
from laneweave.protocol.lattice import Cell, displacements, footprint

LATENESS_S: Final = 0.5
"""Lateness used in the figure and in the table of counts."""

PANELS: Final[dict[str, Cell]] = {
    "A waits": (0, 0),
    "A moves ahead": (1, 0),
    "A moves to the left": (0, 1),
    "A moves ahead and to the left": (1, 1),
}

_NEAR: Final = range(-MAX_OFFSET, MAX_OFFSET + 1)
_OFFSETS: Final = tuple(offset for offset in product(_NEAR, _NEAR) if offset != (0, 0))


class Severity(Enum):
    """Lateness at which two moves come too close; values are colours (Okabe and Ito)."""

    ON_TIME = "#d55e00"
    LATE = "#e69f00"
    LATER = "#0072b2"
    FOOTPRINT = "#cc79a7"
    NEVER = "#c3c7cd"


_MEANING: Final = {
    Severity.ON_TIME: "even if both are on time",
    Severity.LATE: f"if one is {LATENESS_S:g} s late",
    Severity.LATER: f"only if one is more than {LATENESS_S:g} s late",
    Severity.FOOTPRINT: "never, though footprints meet",
    Severity.NEVER: "never",
}
_CELL, _BORDER, _OWN_CELL = "#f6f7f8", "#d3d6db", "#e4e7eb"
_WIDTH_IN, _ACROSS = 10.0, 2
_MARGIN_IN, _TITLE_IN, _LEGEND_IN = 0.12, 0.28, 0.5
_LANE_HEIGHT, _BODY = 0.68, (0.5, 0.22)
"""In lengths of a cell."""
_ARROW, _DOT, _PATH = (0.14, 0.4), 0.045, 0.56
"""Start and end of an arrow, radius of a dot, and end of A's arrow, from the middle of a cell."""


def draw_conflicts(out: Path, dpi: int = 110) -> None:
    """Draw the table of the default geometry in mode 2 and write it to a file."""
    save(conflict_figure(BodyGeometry()), out, dpi)


def conflict_figure(geometry: BodyGeometry) -> Figure:
    """Return the figure."""
    tables = ConflictTables.of(geometry)
    figure = new_figure(_WIDTH_IN, _LEGEND_IN + len(PANELS) // _ACROSS * _pitch_in()[1])
    figure.set_layout_engine("none")
    for number, (name, displacement) in enumerate(PANELS.items()):
        axes = _new_panel(figure, *divmod(number, _ACROSS))
        axes.set_title(name, fontsize=10, pad=4, color=INK)
        _draw_panel(axes, displacement, tables)
    handles = [
        Line2D([], [], color=severity.value, linewidth=3, label=text)
        for severity, text in _MEANING.items()
    ]
    figure.legend(
        handles=handles,
        loc="lower center",
        bbox_to_anchor=(0.5, 0.022),
        ncols=len(handles),
        frameon=False,
        fontsize=8.5,
        labelcolor=INK,
        handlelength=1.2,
    )
    figure.text(
        0.5,
        0.012,
        "Where B may start, and where it moves (a dot: it waits); the colour shows when B comes "
        "too close to A; front to the right, left lane on top",
        ha="center",
        fontsize=7.5,
        color=FAINT_INK,
    )
    return figure


@attrs.frozen
class ConflictTables:
    """The conflict tables of one geometry, for three values of lateness."""

    on_time: ConflictTable
    late: ConflictTable
    any_delay: ConflictTable

    @classmethod
    def of(cls, geometry: BodyGeometry) -> ConflictTables:
        """Compute the tables."""
        tables = (
            conflict_table(attrs.evolve(geometry, lateness_s=late_s))
            for late_s in (0.0, LATENESS_S, None)
        )
        return cls(*tables)

    def severity(self, pair: Pair) -> Severity:
        """Return the lateness at which two moves come too close."""
        for severity, table in (
            (Severity.ON_TIME, self.on_time),
            (Severity.LATE, self.late),
            (Severity.LATER, self.any_delay),
        ):
            if pair in table:
                return severity
        return Severity.FOOTPRINT if conflict(pair, "geometric") else Severity.NEVER


def conflict(pair: Pair, *kinds: str) -> bool:
    """Return whether two moves conflict by one of these kinds, without a geometry."""
    offset, a, b = pair
    other = offset, (offset[0] + b[0], offset[1] + b[1])
    return ConflictModel(kinds).kind(((0, 0), a), other) is not None


def counts() -> list[tuple[str, int, int]]:
    """Return the number of pairs of moves that each model forbids in mode 1 and in mode 2.

    Only vehicles in different cells count; each pair counts twice, once from either vehicle.
    """
    tables = ConflictTables.of(BodyGeometry())
    steps = displacements(2)
    pairs = list(product(_OFFSETS, steps, steps))

    def row(name: str, table: Iterable[Pair]) -> tuple[str, int, int]:
        known = frozenset(table)
        one, two = (
            len(known.intersection(product(_OFFSETS, displacements(mode), displacements(mode))))
            for mode in (1, 2)
        )
        return name, one, two

    def of_kinds(*kinds: str) -> Iterator[Pair]:
        return (pair for pair in pairs if conflict(pair, *kinds))

    return [
        row("node, edge, special-1", of_kinds("node", "edge", "special-1")),
        row("node, edge, special-1 to special-4", of_kinds(*PAPER_KINDS)),
        row("geometric: footprints", of_kinds("geometric")),
        row("geometric with `geometry`, any delay", tables.any_delay),
        row(f"geometric with `geometry`, at most {LATENESS_S:g} s late", tables.late),
        row("geometric with `geometry`, on time", tables.on_time),
    ]


def _pitch_in() -> tuple[float, float]:
    """Return the horizontal and the vertical distance between panels."""
    across_in = (_WIDTH_IN - _MARGIN_IN) / _ACROSS
    return across_in, (across_in - _MARGIN_IN) * _LANE_HEIGHT + _TITLE_IN


def _new_panel(figure: Figure, row: int, column: int) -> Axes:
    """Return empty axes whose unit is the length of a cell."""
    (across_in, down_in), (width_in, height_in) = _pitch_in(), map(float, figure.get_size_inches())
    left_in, bottom_in = _MARGIN_IN + column * across_in, height_in - (row + 1) * down_in
    size_in = across_in - _MARGIN_IN, down_in - _TITLE_IN
    return figure.add_axes(
        (left_in / width_in, bottom_in / height_in, size_in[0] / width_in, size_in[1] / height_in)
    )


def _draw_panel(axes: Axes, a: Cell, tables: ConflictTables) -> None:
    reach = MAX_OFFSET + 0.5
    axes.set_xlim(-reach, reach)
    axes.set_ylim(-reach * _LANE_HEIGHT, reach * _LANE_HEIGHT)
    axes.set_facecolor(_CELL)
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set(color=_BORDER, linewidth=0.8)
    lines = [number - 0.5 for number in range(-MAX_OFFSET + 1, MAX_OFFSET + 1)]
    axes.vlines(lines, -reach * _LANE_HEIGHT, reach * _LANE_HEIGHT, colors=_BORDER, linewidth=0.6)
    axes.hlines(
        [line * _LANE_HEIGHT for line in lines], -reach, reach, colors=_BORDER, linewidth=0.6
    )
    for offset in _OFFSETS:
        # The most severe move is drawn last, on top.
        severities = [(tables.severity((offset, a, b)), b) for b in displacements(2)]
        order = list(Severity)
        for severity, b in sorted(severities, key=lambda item: -order.index(item[0])):
            _draw_move(axes, offset, b, severity)
    _draw_a(axes, a)


def _draw_move(axes: Axes, cell: Cell, step: Cell, severity: Severity) -> None:
    x, y = cell[0], cell[1] * _LANE_HEIGHT
    plain = severity is Severity.NEVER
    if step == (0, 0):
        patch: Circle | FancyArrowPatch = Circle(
            (x, y), _DOT, facecolor=severity.value, linewidth=0
        )
    else:
        ends = [(x + share * step[0], y + share * step[1] * _LANE_HEIGHT) for share in _ARROW]
        patch = FancyArrowPatch(
            *ends,
            arrowstyle="-|>",
            mutation_scale=6 if plain else 8,
            shrinkA=0,
            shrinkB=0,
            color=severity.value,
            linewidth=0.8 if plain else 1.7,
        )
    patch.set(label=severity.name, zorder=2 if plain else 3)
    axes.add_patch(patch)


def _draw_a(axes: Axes, step: Cell) -> None:
    """Draw A in the middle, the cells of its footprint, and its path."""
    for column, lane in footprint((0, 0), step):
        corner = (column - 0.5, (lane - 0.5) * _LANE_HEIGHT)
        axes.add_patch(
            Rectangle(corner, 1.0, _LANE_HEIGHT, facecolor=_OWN_CELL, linewidth=0, zorder=0.5)
        )
    length, width = _BODY
    body = FancyBboxPatch(
        (-length / 2, -width / 2),
        length,
        width,
        boxstyle="round,pad=0,rounding_size=0.07",
        facecolor=INK,
        linewidth=0,
        zorder=6,
    )
    axes.add_patch(body)
    axes.text(0, 0, "A", color="white", size=10, ha="center", va="center_baseline", zorder=7)
    if step != (0, 0):
        ends = [(0.0, 0.0), (_PATH * step[0], _PATH * step[1] * _LANE_HEIGHT)]
        path = FancyArrowPatch(*ends, arrowstyle="-|>", mutation_scale=15, shrinkA=0, shrinkB=0)
        path.set(color=INK, linewidth=2.6, zorder=5)
        path.set_path_effects([withStroke(linewidth=4.5, foreground="white")])
        axes.add_patch(path)
