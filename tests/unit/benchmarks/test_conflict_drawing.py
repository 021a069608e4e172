"""The drawing of the conflict table agrees with the computed tables."""

from __future__ import annotations

from collections import Counter
from itertools import product
from pathlib import Path

import pytest
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from PIL import Image

from conflict_drawing import (
    PANELS,
    ConflictTables,
    Severity,
    conflict_figure,
    counts,
    draw_conflicts,
)
from laneweave.coordinator.planning.conflict_kinds import Pair
from laneweave.coordinator.planning.geometry.conflict_table import conflict_table
from laneweave.coordinator.planning.geometry.swept_bodies import BodyGeometry
from laneweave.protocol.lattice import Cell, displacements
from support.variants import variants

NEAR = range(-2, 3)
OFFSETS = [offset for offset in product(NEAR, NEAR) if offset != (0, 0)]


def pairs_of(a: Cell) -> list[Pair]:
    return [(offset, a, b) for offset in OFFSETS for b in displacements(2)]


def drawn(axes: Axes) -> Counter[str]:
    names = [severity.name for severity in Severity]
    marks = [patch for patch in axes.patches if patch.get_label() in names]
    for mark in marks:
        colour = Severity[str(mark.get_label())].value
        assert to_hex(mark.get_facecolor()) == colour
    return Counter(str(mark.get_label()) for mark in marks)


@pytest.mark.slow
@pytest.mark.parametrize(
    "geometry", variants([BodyGeometry(), BodyGeometry(clearance_along_m=7.0)])
)
def test_each_pair_is_drawn_once_in_the_colour_of_its_severity(geometry: BodyGeometry) -> None:
    tables = ConflictTables.of(geometry)
    panels = conflict_figure(geometry).axes
    assert [axes.get_title() for axes in panels] == list(PANELS)
    for axes, a in zip(panels, PANELS.values(), strict=True):
        expected = Counter(tables.severity(pair).name for pair in pairs_of(a))
        assert drawn(axes) == expected
        assert sum(expected.values()) == 24 * 9


def test_verdicts() -> None:
    tables = ConflictTables.of(BodyGeometry())
    found = {
        tables.severity(((1, 0), (1, 0), (-1, 0))): Severity.ON_TIME,
        tables.severity(((0, 1), (0, 1), (0, 1))): Severity.LATE,
        tables.severity(((1, 0), (1, 0), (1, 0))): Severity.LATER,
        tables.severity(((-1, 1), (1, 1), (1, 1))): Severity.FOOTPRINT,
        tables.severity(((0, 1), (1, 0), (1, 0))): Severity.NEVER,
    }
    assert list(found) == list(found.values())


def test_counts_are_those_of_the_tables() -> None:
    rows = {name: (one, two) for name, one, two in counts()}
    different = [pair for pair in conflict_table(BodyGeometry()) if pair[0] != (0, 0)]
    assert rows["geometric with `geometry`, any delay"][1] == len(different) == 344
    assert rows["geometric: footprints"] == (48, 360)
    assert rows["node, edge, special-1 to special-4"] == (48, 280)
    ordered = list(rows.values())[2:]
    assert ordered == sorted(ordered, reverse=True)


@pytest.mark.slow
@pytest.mark.more
def test_a_picture_is_written(tmp_path: Path) -> None:
    out = tmp_path / "images" / "conflicts.png"
    draw_conflicts(out, dpi=40)
    with Image.open(out) as image:
        assert image.width == 400
        assert len(image.convert("RGB").getcolors(1 << 20) or []) > 50
