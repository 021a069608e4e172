"""Summaries of runs for tests."""

from __future__ import annotations

from typing import Any

from laneweave.protocol.summary import RunSummary


def make_summary(**changed: Any) -> RunSummary:  # noqa: ANN401 (any JSON)
    """Return the summary of a complete run; keys of `changed` replace values, tables in part."""
    data: dict[str, Any] = {
        "schema": "laneweave.summary/1",
        "method": "formation",
        "seed": 7,
        "volume_veh_per_lane_h": 1600.0,
        "lanes": 3,
        "road_m": 1000.0,
        "simulated_s": 100.0,
        "vehicles": {
            "demanded": 100, "entered": 100, "left": 100, "on_preferred_lane": 100, "peak": 90,
        },
        "travel_time_s": {"mean": 70.0, "p50": 70.0, "p95": 71.0, "max": 72.0},
        "throughput_veh_per_lane_h": 990.0,
        "safety": {
            "overlaps": 0, "sumo_collisions": 0, "min_gap_m": 9.8, "min_headway_s": 0.86,
            "emergency_brakes": 0, "max_accel_mps2": 4.8, "min_accel_mps2": -6.8,
            "max_jerk_mps3": 9.0,
        },
        "ending": "complete",
        "planning": {
            "plans": 1, "optimal": 1, "largest_formation": 6,
            "solve_ms": {"p50": 5.0, "p95": 10.0, "max": 12.0},
        },
        "tracking": {"solves": 50_400, "unusable": 0, "solve_ms": {"p50": 0.1, "p99": 0.2}},
        "runtime": {
            "real_time_factor": 2.0, "wall_s": 50.0, "processes": 1, "vehicles_per_process": 1,
            "tick_ms": {"p50": 5.0, "p99": 9.0},
        },
        "messages": {"published": 7, "dropped_by_faults": 0},
        "failover": {"leader_changes": 0, "recovery_s": []},
    }  # fmt: skip
    for key, value in changed.items():
        data[key] = data[key] | value if isinstance(value, dict) and key in data else value
    return RunSummary.from_json(data)
