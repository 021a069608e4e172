"""The lanes on which SUMO drives vehicles to the entrances of a corridor."""

from __future__ import annotations

import pytest

from laneweave.protocol.scenario.road_tables import MAIN_ENTRANCE
from laneweave.sim_bridge.corridors.sumo_corridor import SumoCorridor
from support.interchange import RAMP_SPEED_MPS


def test_the_ways_to_the_ramp_and_parallel_ones_to_the_start(interchange: SumoCorridor) -> None:
    *to_start, to_ramp = interchange.ways_in
    (ramp,) = interchange.corridor.ramps
    assert (to_ramp.entrance, to_ramp.lane) == (ramp.name, ramp.lane)
    lanes = to_ramp.lanes
    assert [*lanes] == ["on_0", "before_0"]
    assert lanes["on_0"].from_m == pytest.approx(ramp.merge_m - 300.0, abs=15.0)
    assert lanes["before_0"].from_m == pytest.approx(ramp.merge_m - 600.0, abs=30.0)
    for way in lanes.values():
        *_, (end_m, _) = way.limits
        assert end_m == ramp.merge_m
        assert min(limit for _, limit in way.limits) <= RAMP_SPEED_MPS
        assert way.limits[0][1] == RAMP_SPEED_MPS
        ends_m = [to_m for to_m, _ in way.limits]
        assert ends_m == sorted(ends_m)
        assert not way.upstream
    assert [(one.entrance, one.lane) for one in to_start] == [(MAIN_ENTRANCE, n) for n in (1, 2, 3)]
    for one in to_start:
        named = {name: way.from_m for name, way in one.lanes.items()}
        assert named == {f"main1_{one.lane - 1}": 0.0, f"start_{one.lane - 1}": -400.0}
