"""The lanes on which SUMO drives vehicles to the entrances of a corridor."""

from __future__ import annotations

from pathlib import Path

import pytest

from laneweave.sim_bridge.corridors.corridor_reading import read_corridor
from laneweave.sim_bridge.corridors.ways_in import ways_to_ramp, ways_to_start
from support.interchange import CORRIDOR, RAMP_SPEED_MPS, TRUCKS, stream, write_interchange


def test_the_way_in_with_its_limits(tmp_path: Path) -> None:
    found = read_corridor(write_interchange(tmp_path, stream(10), types=TRUCKS), CORRIDOR)
    (ramp,) = found.corridor.ramps
    ways = ways_to_ramp(found.simulation.network, found.corridor, ramp)
    lanes = {name: way for name, way in ways.items() if not name.startswith(":")}
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
    assert not any(name.startswith("main") for name in lanes)


def test_the_ways_to_the_start_are_parallel(tmp_path: Path) -> None:
    found = read_corridor(write_interchange(tmp_path, stream(10), types=TRUCKS), CORRIDOR)
    lanes = ways_to_start(found.simulation.network, found.corridor)
    assert [*lanes] == [1, 2, 3]
    for lane, ways in lanes.items():
        named = {name: way.from_m for name, way in ways.items() if not name.startswith(":")}
        assert named == {f"main1_{lane - 1}": 0.0, f"start_{lane - 1}": -400.0}
