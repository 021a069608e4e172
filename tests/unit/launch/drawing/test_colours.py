"""Colours of lanes: readers with a colour vision deficiency can tell them apart."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from laneweave.launch.drawing.colours import lane_colours, text_colour
from support.tables import for_each

DICHROMATS = {
    "none": np.eye(3),
    "protanopia": np.array(
        [[0.152, 1.053, -0.205], [0.115, 0.786, 0.099], [-0.004, -0.048, 1.052]]
    ),
    "deuteranopia": np.array(
        [[0.367, 0.861, -0.228], [0.280, 0.673, 0.047], [-0.012, 0.043, 0.969]]
    ),
    "tritanopia": np.array(
        [[1.256, -0.077, -0.179], [-0.078, 0.931, 0.148], [0.005, 0.691, 0.304]]
    ),
}
"""Machado, Oliveira and Fernandes (2009): what linear RGB looks like."""
TO_XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
WHITE = np.array([0.9505, 1.0, 1.089])


def lab(colour: str, deficiency: str) -> NDArray[np.float64]:
    """Return CIELAB coordinates of a colour as it appears to a reader."""
    parts = np.array([int(colour[place : place + 2], 16) for place in (1, 3, 5)]) / 255.0
    linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
    seen = np.clip(DICHROMATS[deficiency] @ linear, 0.0, 1.0)
    share = TO_XYZ @ seen / WHITE
    root = np.where(share > 0.008856, np.cbrt(share), 7.787 * share + 16.0 / 116.0)
    return np.array(
        [116.0 * root[1] - 16.0, 500.0 * (root[0] - root[1]), 200.0 * (root[1] - root[2])]
    )


@for_each("deficiency", DICHROMATS)
@for_each("lanes", [2, 3])
def test_lanes_differ_for_all_readers(deficiency: str, lanes: int) -> None:
    for one, other in combinations(lane_colours(lanes), 2):
        distance = np.linalg.norm(lab(one, deficiency) - lab(other, deficiency))
        assert distance > 30.0, (one, other)


def test_two_lanes_have_the_colours_of_the_outer_ones() -> None:
    right, middle, left = lane_colours(3)
    assert (lane_colours(1), lane_colours(2)) == ((right,), (right, left))
    assert middle not in lane_colours(2)
    assert len(set(lane_colours(8))) == 8


@for_each("colour", [*lane_colours(3), *lane_colours(8)])
def test_text_on_a_colour_is_legible(colour: str) -> None:
    lightness = lab(colour, "none")[0]
    assert abs(lightness - (0.0 if text_colour(colour) == "#000000" else 100.0)) > 38.0
