"""Lane changes behind a vehicle that is about to stop."""

from __future__ import annotations

import pytest

from laneweave.protocol.wire.messages import Neighbour
from laneweave.sim_bridge.bodies.command_checks import LaneGaps
from support.paper import PAPER

GAPS = LaneGaps(PAPER)
OWN, OTHER = 1, 2
V_F = PAPER.lattice.speed_mps


@pytest.mark.parametrize(
    ("gap_m", "speed_mps", "accel_mps2", "allowed"),
    [
        (10.0, V_F, 0.0, True),
        (10.0, V_F, -2.6, True),  # as in a move to the column behind
        (10.0, V_F - 2.0, 0.0, True),
        (10.0, V_F, -5.0, False),
        (10.0, 8.0, 0.0, False),
        (10.0, 8.0, -4.0, False),
        (60.0, 8.0, -4.0, True),
        (60.0, 0.0, 0.0, True),
        (30.0, 0.0, 0.0, False),
    ],
)
def test_no_lane_change_begins_that_a_vehicle_ahead_would_stop(
    gap_m: float, speed_mps: float, accel_mps2: float, *, allowed: bool
) -> None:
    """It would end in both lanes, and nobody could pass."""
    ahead = Neighbour(OWN, gap_m, speed_mps, accel_mps2)
    assert GAPS.allow(OWN, OTHER, ([ahead], []), V_F) is allowed


def test_a_vehicle_that_stops_in_a_third_lane_does_not_matter() -> None:
    assert GAPS.allow(OWN, OTHER, ([Neighbour(0, 5.0, 0.0, 0.0)], []), V_F)
