"""Whole runs: what they leave behind, and that all ways of running agree."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest

from laneweave.protocol.summary import RunSummary
from laneweave.protocol.wire.events import COMMON_FIELDS, FIELDS
from laneweave.sim_bridge.recording.columns import TRAJECTORIES
from support.harness import (
    DEMAND,
    Ended,
    Lab,
    check_safe_and_complete,
    events,
    final_lanes,
    log_lines,
    mean_travel_time_s,
    plans,
    summary,
    trips,
)
from system.conftest import FinishedRun


@pytest.mark.parametrize(
    "name", ["zenoh", pytest.param("packed", marks=pytest.mark.more), "simulated"]
)
def test_a_run_keeps_its_promises(finished_run: FinishedRun, name: str) -> None:
    folder = finished_run(name)

    check_safe_and_complete(folder)
    found = summary(folder)
    assert found["vehicles"]["on_preferred_lane"] == found["vehicles"]["left"]
    assert found["safety"]["min_accel_mps2"] >= -10
    assert found["safety"]["max_accel_mps2"] <= 5
    assert found["safety"]["min_gap_m"] > 0
    assert found["planning"]["plans"] > 1
    assert sum(found["planning"]["by_solver"].values()) == found["planning"]["plans"]
    assert found["ending"] == "complete"
    assert found["tracking"]["unusable"] == 0
    assert found["messages"]["rejected"] == 0
    assert [line for line in log_lines(folder) if line["level"] == "error"] == []


@pytest.mark.parametrize("name", ["zenoh", "simulated"])
def test_a_run_leaves_all_its_files(finished_run: FinishedRun, name: str) -> None:
    folder = finished_run(name)

    found = summary(folder)
    assert RunSummary.from_json(found).to_json() == found
    assert found["schema"] == "laneweave.summary/1"
    vehicles = trips(folder)
    assert len(vehicles) == found["vehicles"]["demanded"]
    assert all(trip["on_preferred_lane"] for trip in vehicles.values())
    rows = pq.read_table(folder / "trajectories.parquet")
    assert rows.column_names == TRAJECTORIES.names
    # A move reserves its target while the body is still in the old lane.
    assert not rows["lane"].equals(rows["reserved_lane"])
    assert set(rows["vehicle"].unique().to_pylist()) == set(vehicles)
    assert {event["vehicle"] for event in events(folder, "left")} == set(vehicles)
    for event in events(folder):
        assert {"t_s", "kind", "role"} <= event.keys()
        assert event.keys() <= {*COMMON_FIELDS, *FIELDS[event["kind"]]}
    assert len(plans(folder)) == found["planning"]["plans"]
    for picture in ("speed", "road") if name == "zenoh" else ():  # the other one has no report
        assert (folder / f"{picture}.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"


def test_a_run_prints_a_table_and_nothing_else(finished_run: FinishedRun) -> None:
    folder = finished_run("zenoh")

    out = (folder / "stdout.txt").read_text(encoding="utf-8")
    assert "in their preferred lane" in out
    assert "100.00 % of" in out
    assert "FAILED" not in out
    err = (folder / "stderr.txt").read_text(encoding="utf-8")
    assert Ended(0, out, err).complaints == []


@pytest.mark.more
def test_the_number_of_processes_is_as_asked(finished_run: FinishedRun) -> None:
    single, packed = summary(finished_run("zenoh")), summary(finished_run("packed"))

    # Router, bridge and three coordinators, and at least as many agents as were on the road.
    assert single["runtime"]["processes"] >= 5 + single["vehicles"]["peak"]
    assert single["runtime"]["vehicles_per_process"] == 1
    assert packed["runtime"]["processes"] <= 5 + packed["vehicles"]["demanded"] // 2
    assert packed["runtime"]["vehicles_per_process"] == 8


@pytest.mark.more
def test_messages_are_counted_once_however_vehicles_are_packed(finished_run: FinishedRun) -> None:
    single, packed = summary(finished_run("zenoh")), summary(finished_run("packed"))

    def per_vehicle(found: dict[str, Any]) -> float:
        published: int = found["messages"]["published"]
        entered: int = found["vehicles"]["entered"]
        return published / entered

    # Some messages are repeated by wall time; if each vehicle counted those of its whole process,
    # it would be several times as many.
    assert per_vehicle(packed) == pytest.approx(per_vehicle(single), rel=0.5)


@pytest.mark.parametrize("name", ["zenoh", pytest.param("packed", marks=pytest.mark.more)])
def test_processes_and_simulation_agree(finished_run: FinishedRun, name: str) -> None:
    real, simulated = finished_run(name), finished_run("simulated")

    assert final_lanes(real) == final_lanes(simulated)
    assert mean_travel_time_s(real) == pytest.approx(mean_travel_time_s(simulated), rel=0.01)


@pytest.mark.more
def test_a_simulated_run_repeats_itself(finished_run: FinishedRun, lab: Lab, road: Path) -> None:
    first, second = finished_run("simulated"), lab.folder / "second"

    ended = lab.run("run", road, *DEMAND, "--transport", "simulated", "--out", second)

    assert ended.status == 0
    for file in ("trajectories.parquet", "trips.parquet"):
        assert pq.read_table(first / file).equals(pq.read_table(second / file))
