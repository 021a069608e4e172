"""All planted bugs: of the protocol, and of roads whose lanes end, with ramps and exits.

Tests that plant a bug and fail unless it is noticed carry the marker `catches` with its name;
`tests/simulation/kill_matrix.py` lists them, and other tests that the bug makes fail.
"""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType

import pytest

from support import (
    broken_formations_on_roads,
    broken_lane_end_control,
    broken_lane_ends,
    broken_roads,
)
from support.planted_bugs import BUGS, Bug
from support.unseen_bugs import UNSEEN

Plant = Callable[[pytest.MonkeyPatch], None]


def _of(module: ModuleType, rule: str) -> tuple[Bug, ...]:
    """Return the bugs that the public functions of a module plant."""
    plants = [
        function
        for name, function in vars(module).items()
        if not name.startswith("_") and getattr(function, "__module__", "") == module.__name__
    ]
    return tuple(
        Bug(name_of(plant), rule, str(plant.__doc__).splitlines()[0], plant=plant)
        for plant in plants
    )


def name_of(plant: Plant) -> str:
    """Return the name of the bug that a function plants."""
    return plant.__name__.replace("_", "-")


ROAD_BUGS: tuple[Bug, ...] = (
    *_of(broken_lane_ends, "lane ends"),
    *_of(broken_lane_end_control, "lane ends"),
    *_of(broken_roads, "ramps, exits"),
    *_of(broken_formations_on_roads, "formations on roads"),
)
"""Bugs of roads whose lanes end, with ramps and exits."""

EVERY_BUG: dict[str, Bug] = {bug.name: bug for bug in (*BUGS, *UNSEEN, *ROAD_BUGS)}
"""All planted bugs by name."""


def catches(*bugs: Bug | Plant) -> pytest.MarkDecorator:
    """Return the mark of a test that fails unless it notices these bugs, which it plants."""
    return pytest.mark.catches(*(b.name if isinstance(b, Bug) else name_of(b) for b in bugs))
