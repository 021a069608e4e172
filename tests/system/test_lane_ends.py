"""A lane that ends, with real processes: agents are killed, and their vehicles get on alone."""

from __future__ import annotations

import pytest

from laneweave.protocol.wire.events import DRIVES_OUT, LEFT_LATTICE
from support.harness import Lab, check_safe_and_complete, events, summary, trips

ROAD = """schema = "laneweave.scenario/1"
seed = 4
[road]
s1_m = 50.0
s2_m = 50.0
s3_m = 400.0
closures = [{ lane = 0, from_m = 400.0 }]
[demand]
volume_veh_per_lane_h = 1200.0
duration_s = 30.0
[formation]
operation = "OPERATION"
cycle_s = 4.0
[runtime]
vehicles_per_process = 1
"""
KILLS = """[[kill]]
target = "agent"
count = 20
between_s = [8.0, 20.0]
"""


@pytest.mark.parametrize("operation", ["rolling", "formations"])
@pytest.mark.more
def test_vehicles_without_agents_stop_wait_and_get_on(lab: Lab, operation: str) -> None:
    road = lab.path("road.toml", ROAD.replace("OPERATION", operation))
    faults = lab.path("faults.toml", KILLS)
    folder = lab.folder / "run"
    ended = lab.run("run", road, "--faults", faults, "--out", folder)
    assert (ended.status, ended.complaints) == (0, []), ended
    check_safe_and_complete(folder)
    stopped = {event["vehicle"] for event in events(folder, LEFT_LATTICE)}
    assert len(stopped) >= 2
    assert {event["vehicle"] for event in events(folder, DRIVES_OUT)} == stopped
    found = summary(folder)
    assert found["vehicles"]["left"] == found["vehicles"]["demanded"]
    # No vehicle leaves in the lane that ends; those without a preference are in the right lane.
    assert {trip["final_lane"] for trip in trips(folder).values()} <= {1, 2}
    assert {trip["preferred_lane"] for trip in trips(folder).values()} == {-1}
    assert found["vehicles"]["on_preferred_lane"] == found["vehicles"]["left"]
