"""Vehicles that miss their lanes for different reasons, in whole runs: the reason is right."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from attrs import field, frozen

from laneweave.coordinator.formations import formation_planner
from laneweave.launch.explain.explanation import Explanation, Fate, explain
from laneweave.launch.explain.reasons import Reason
from laneweave.launch.library.runs import load_scenario, perform_run
from laneweave.protocol.vehicle.motion import State
from laneweave.sim_bridge.bodies.motion_controller import MotionController
from support.bridge_bench import Street, arrival, make_scenario
from support.variants import variants

COORDINATORS = ("c1", "c2", "c3")
ROLLING = {"operation": "rolling"}
ROAD = {
    "schema": "laneweave.scenario/1",
    "road": {"s1_m": 50.0, "s2_m": 100.0, "s3_m": 450.0},
    "demand": {"volume_veh_per_lane_h": 1200.0, "duration_s": 15.0},
}
"""Without faults, all vehicles reach their lanes; v0004 changes from lane 0 to lane 2."""
SHORT = ROAD | {"road": {"s1_m": 1.0, "s2_m": 1.0, "s3_m": 160.0}}
"""One step fits behind the longest formation."""
TRUCKS = ROAD | {
    "demand": {"volume_veh_per_lane_h": 1450.0, "duration_s": 12.0},
    "formation": {"gap_m": 20.0},
    "vehicle_type": [
        {
            "name": "truck",
            "share": 1.0,
            "length_m": 12.0,
            "width_m": 2.5,
            "max_accel_mps2": 1.3,
            "min_accel_mps2": -7.0,
        }
    ],
}
"""Vehicles that do not change columns: one beside another cannot pass it."""
LANE_DROP = {
    "schema": "laneweave.scenario/1",
    "road": {
        "s1_m": 50.0,
        "s2_m": 100.0,
        "s3_m": 550.0,
        "closures": [{"lane": 0, "from_m": 500.0}],
    },
    "demand": {"volume_veh_per_lane_h": 1500.0, "duration_s": 6.0},
    "formation": ROLLING,
    "runtime": {"max_road_s": 60.0},
}
OFF_RAMP = {
    "schema": "laneweave.scenario/1",
    "road": {
        "lanes": 4,
        "s1_m": 50.0,
        "s2_m": 100.0,
        "s3_m": 650.0,
        "closures": [{"lane": 0, "to_m": 300.0}, {"lane": 0, "from_m": 600.0}],
    },
    "exit": [{"name": "off", "lanes": [0], "at_m": 600.0}],
    "demand": {
        "volume_veh_per_lane_h": 2000.0,
        "duration_s": 6.0,
        "destinations": [{"exit": "off", "share": 0.3}],
    },
    "formation": ROLLING,
}


def killed(at_s: float, *names: str, **more: float) -> dict[str, Any]:
    """Return faults that kill processes."""
    return {"kill": [{"target": name, "at_s": at_s, **more} for name in names]}


def planning_fails(patch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise ValueError("no solver today")

    patch.setattr(formation_planner, "sort_lanes", fail)


def moves_to_the_exit_begin_late(patch: pytest.MonkeyPatch) -> None:
    """Let motion controllers find that each move into the exit lane has begun too late."""

    def late(controller: MotionController, t_s: float) -> bool:
        del t_s
        state: State = controller.plant.state
        body_lane = int(state[3] // controller.lattice.lane_width_m)
        return controller.hold_cell[1] == 0 != body_lane

    patch.setattr(MotionController, "has_missed_exit", late)


@frozen
class Case:
    """A run, a vehicle, and what the explanation of the vehicle must say."""

    reason: Reason
    words: tuple[str, ...]
    """Parts of the sentence."""
    faults: Mapping[str, Any] | None = None
    tables: Mapping[str, Any] = field(factory=partial(dict, ROAD))
    vehicle: str = "v0004"
    patch: Callable[[pytest.MonkeyPatch], None] = lambda _: None
    complete: bool = True
    """Whether all vehicles leave the road."""


LEADERS_GONE, LATE_LEADER = killed(0.1, *COORDINATORS), killed(0.1, "c1", "c2")
LATE_LEADER["kill"] += killed(0.1, "c3", restart_after_s=44.0)["kill"]
PLANS_LOST = {"messages": [{"topics": ["plan"], "loss": 1.0}]}

CASES = {
    "no coordinator ever leads": Case(
        Reason.NO_LEADER, ("no coordinator led before it left",), LEADERS_GONE
    ),
    "all coordinators die before the formation closes": Case(
        Reason.NO_LEADER, ("no coordinator led from 10.9 s on",), killed(11.0, *COORDINATORS)
    ),
    "a coordinator leads too late": Case(
        Reason.LATE_LEADER, ("no leader until 45.1 s", "at 45.3 s it was too late"), LATE_LEADER
    ),
    "the agent dies": Case(
        Reason.NO_AGENT, ("no agent since 20.1 s: its agent is gone",), killed(20.0, "v0004")
    ),
    "agents do not answer": Case(
        Reason.AGENT_SILENT,
        ("no agent since 10.2 s", "does not answer"),
        {"messages": [{"topics": ["command"], "loss": 1.0, "from_s": 8.0}]},
    ),
    "a vehicle without an agent is in the way": Case(
        Reason.BLOCKED,
        ("blocked by v0008 (no agent since ", "in the plan of 15.1 s"),
        killed(9.0, "v0002", "v0005", "v0008", "v0011"),
        TRUCKS,
        "v0006",
    ),
    "plans are lost": Case(
        Reason.NO_ANSWER, ("v0004, v0005, v0006", "did not answer the leader"), PLANS_LOST
    ),
    "the road is too short": Case(
        Reason.ROAD_TOO_SHORT, ("too short for its plan of 2 steps until 20.9 s",), None, SHORT
    ),
    "it stops before the end of its lane": Case(
        Reason.STOPPED,
        ("stopped before the end of lane 0", "no coordinator led from "),
        killed(1.0, *COORDINATORS),
        LANE_DROP,
        "v0001",
        complete=False,
    ),
    "it misses its exit": Case(
        Reason.MISSED_EXIT,
        ("goal (exit off)", "began its move to or from the exit lane too late"),
        None,
        OFF_RAMP,
        "v0007",
        moves_to_the_exit_begin_late,
    ),
    "planning fails": Case(
        Reason.PLANNING_FAILED, ("no solver today",), patch=planning_fails, vehicle="v0006"
    ),
    "the agent is paused": Case(
        Reason.NO_AGENT,
        ("no agent since ",),
        {"pause": [{"target": "v0004", "at_s": 10.0, "for_s": 100.0}]},
    ),
    "no coordinator leads, in the rolling operation": Case(
        Reason.NO_LEADER,
        ("no coordinator led from ",),
        killed(12.0, *COORDINATORS),
        ROAD | {"formation": ROLLING},
    ),
    "the agent dies, in the rolling operation": Case(
        Reason.NO_AGENT,
        ("no agent since 9.1 s",),
        killed(9.0, "v0004"),
        ROAD | {"formation": ROLLING},
    ),
    "plans are lost, in the rolling operation": Case(
        Reason.NO_ANSWER,
        ("accepted none of the plans",),
        PLANS_LOST,
        ROAD | {"formation": ROLLING},
    ),
    "no coordinator leads on the way to an exit": Case(
        Reason.NO_LEADER,
        ("goal (exit off)", "no coordinator led from "),
        killed(1.0, *COORDINATORS),
        OFF_RAMP,
        "v0007",
    ),
}


def explained(folder: Path, case: Case) -> Explanation:
    """Run a case, and return the explanation of its vehicle."""
    scenario = load_scenario(case.tables)
    outcome = perform_run(scenario, out=folder, transport="simulated", faults=case.faults)
    assert outcome.summary is not None
    assert outcome.summary.ending == ("complete" if case.complete else "limit")
    return explain(folder, case.vehicle)


@pytest.mark.slow
@pytest.mark.parametrize(
    "case", variants((pytest.param(case, id=name) for name, case in CASES.items()), 11)
)
def test_the_reason_is_right(case: Case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    case.patch(monkeypatch)
    found = explained(tmp_path, case)
    assert found.reason == case.reason, found.text
    assert [words for words in case.words if words not in found.text] == [], found.text
    assert found.fate is (Fate.MISSED if case.complete else Fate.ON_ROAD)
    times = [line.t_s for line in found.story]
    assert times == sorted(times)
    json.dumps(found.to_dict())


@pytest.mark.slow
def test_a_fleet_with_other_settings(tmp_path: Path) -> None:
    road = {"lanes": 2, "s1_m": 20.0, "s2_m": 20.0, "s3_m": 240.0}
    demand = [arrival("v0", 1.0, lane=0, preferred_lane=1)]
    street = Street(make_scenario(road=road), tmp_path, demand, pace=2.0)
    street.start_coordinators()
    street.start_shard(scenario=make_scenario(road=road | {"lane_width_m": 5.0}))
    street.run()
    found = explain(tmp_path, "v0")
    assert found.reason == Reason.SETTINGS_REFUSED
    assert "fleet 0-of-1 has other settings than the bridge (road.lane_width_m)" in found.text


@pytest.mark.slow
@pytest.mark.parametrize(
    ("tables", "vehicle"), variants([(ROAD, "v0004"), (TRUCKS, "v0006"), (OFF_RAMP, "v0007")])
)
def test_without_faults_the_same_vehicles_reach_their_goals(
    tables: Mapping[str, Any], vehicle: str, tmp_path: Path
) -> None:
    found = explained(tmp_path, Case(Reason.NO_PLAN, (), None, tables, vehicle))
    assert (found.fate, found.reason) == (Fate.REACHED, "")
    assert "reached its goal" in found.text
