"""Types of vehicles, with ramps and exits or in formations: all reach their destinations."""

from __future__ import annotations

import pytest

from laneweave.protocol.config.scenario_files import load_scenario
from support.harness import Lab, check_safe_and_complete, summary, trips

ROAD = """schema = "laneweave.scenario/1"
seed = 5
[road]
s1_m = 50.0
s2_m = 50.0
s3_m = 500.0
lanes = 3
closures = [{ lane = 0, to_m = 50.0 }, { lane = 0, from_m = 500.0 }]
[[entrance]]
name = "on"
lane = 0
at_m = 50.0
merge_m = 220.0
volume_veh_per_h = 900.0
vehicle_types = [{ type = "truck", share = 0.5 }]
destinations = [{ exit = "off", share = 0.3 }]
[[exit]]
name = "off"
lanes = [0]
at_m = 500.0
[demand]
volume_veh_per_lane_h = 900.0
duration_s = 16.0
destinations = [{ exit = "off", share = 0.3 }]
[[vehicle_type]]
name = "truck"
share = 0.2
length_m = 12.0
width_m = 2.5
max_accel_mps2 = 2.0
[formation]
operation = "rolling"
gap_m = 20.0
[runtime]
vehicles_per_process = 1
"""


@pytest.mark.more
def test_cars_and_trucks_enter_by_a_ramp_and_leave_by_their_exits(lab: Lab) -> None:
    folder = lab.folder / "run"
    ended = lab.run("run", lab.path("road.toml", ROAD), "--out", folder)
    assert (ended.status, ended.complaints) == (0, []), ended
    check_safe_and_complete(folder)
    found, driven = summary(folder)["vehicles"], list(trips(folder).values())
    assert found["at_destination"] == found["left"] == found["demanded"] == len(driven)
    assert {trip["entrance"] for trip in driven} == {"main", "on"}
    assert {trip["exit"] for trip in driven} == {"end", "off"}
    assert {trip["vehicle_type"] for trip in driven} == {"car", "truck"}
    assert summary(folder)["tracking"]["emergency_ticks"] == 0


MIXED = """schema = "laneweave.scenario/1"
[demand]
volume_veh_per_lane_h = 1000.0
duration_s = 20.0
arrival_shares = [1, 2, 1]
[[vehicle_type]]
name = "van"
share = 0.4
length_m = 7.0
max_accel_mps2 = 3.5
[[vehicle_type]]
name = "truck"
share = 0.3
length_m = 12.0
width_m = 2.5
max_accel_mps2 = 1.3
min_accel_mps2 = -7.0
[formation]
cycle_s = 6.0
gap_m = 20.0
"""


@pytest.mark.more
def test_cars_vans_and_trucks_sort_in_formations(lab: Lab) -> None:
    """Vans drive all moves; trucks change lanes only, and others make room."""
    folder = lab.folder / "run"
    scenario = lab.path("mixed.toml", MIXED)
    types = load_scenario(scenario).types
    assert [name for name, one in types.items() if one.changes_columns] == ["car", "van"]
    ended = lab.run("run", scenario, "--transport", "simulated", "--out", folder)
    assert (ended.status, ended.complaints) == (0, []), ended
    check_safe_and_complete(folder)
    found, driven = summary(folder), list(trips(folder).values())
    assert found["vehicles"]["on_preferred_lane"] == len(driven) >= 10
    assert {trip["vehicle_type"] for trip in driven} == {"car", "van", "truck"}
    assert found["tracking"]["emergency_ticks"] == 0
