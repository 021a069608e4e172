"""Stop lines limit references in the lanes that end, and nowhere else."""

from __future__ import annotations

import math

import numpy as np
import pytest
from attrs import evolve

from laneweave.agents.driving.reference import Reference
from laneweave.agents.driving.stop_lines import StopLines
from laneweave.agents.driving.tracking_problem import NO_GAPS
from laneweave.protocol.lattice import Cell
from laneweave.protocol.vehicle.lane_ends import dead_ends, early_start_m
from support.closed_lanes import BLOCKED

KEEPING = evolve(BLOCKED, formation=evolve(BLOCKED.formation, change_columns=False))
"""Lane 1 is closed from 600 to 700 m; vehicles keep their columns."""
LATTICE, TICK_S = KEEPING.lattice, KEEPING.runtime.tick_s
COLUMN = -10


def tick_at(s_m: float) -> int:
    return math.ceil(LATTICE.passing_time_s(COLUMN, s_m) / TICK_S)


def test_a_reference_that_stays_in_a_lane_is_limited_to_its_line() -> None:
    (end,) = dead_ends(KEEPING)
    tick = tick_at(end.line_m - 10.0)
    states = Reference.hold(KEEPING, KEEPING.vehicle, (COLUMN, 1)).window(tick).states
    limited = StopLines(KEEPING, KEEPING.vehicle).limit(NO_GAPS, states, tuple(states[0]))
    assert limited.latest is not None
    assert np.all(limited.latest < end.line_m)


@pytest.mark.parametrize("s_m", [0.0, 15.0])
@pytest.mark.parametrize(("origin", "target"), [(0, 1), (2, 1)])
def test_a_reference_into_a_lane_that_opens_again_is_not_limited(
    origin: int, target: int, s_m: float
) -> None:
    """Neither before the lane opens nor behind that."""
    begins_m = 700.0 + KEEPING.types.longest_body_m - early_start_m(KEEPING)
    cells: tuple[Cell, Cell] = (COLUMN, origin), (COLUMN, target)
    begin_tick = tick_at(begins_m)
    ticks = KEEPING.timing.move_ticks(KEEPING.timing.cycles_s[0])
    reference = Reference.move(KEEPING, KEEPING.vehicle, *cells, begin_tick, ticks)
    states = reference.window(begin_tick + round(s_m / LATTICE.speed_mps / TICK_S)).states
    assert StopLines(KEEPING, KEEPING.vehicle).limit(NO_GAPS, states, tuple(states[0])) is NO_GAPS
