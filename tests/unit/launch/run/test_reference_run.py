"""Whole runs of the reference methods, in SUMO, on a short road."""

from __future__ import annotations

import importlib
import re
from itertools import combinations
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from laneweave.launch.run import reference_run
from laneweave.launch.run.outcome import Outcome
from laneweave.launch.run.reference_run import ReferenceRun, Standstill
from laneweave.launch.run_methods import LC2013, RULE, reference_method
from laneweave.protocol.config.scenario_files import parse_scenario, to_tables
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.summary import Ending
from laneweave.sim_bridge import road_sources
from laneweave.sim_bridge.baselines import reference_road as road
from laneweave.sim_bridge.baselines.reference_method import ReferenceMethod
from laneweave.sim_bridge.baselines.reference_road import ReferenceVehicle
from laneweave.sim_bridge.baselines.rule_based import RuleMethod
from laneweave.sim_bridge.baselines.rules import Rules
from laneweave.sim_bridge.bodies.overlaps_and_gaps import Bodies
from laneweave.sim_bridge.recording.run_record import RunRecord
from laneweave.sim_bridge.road.demand import Arrival
from support.bridge_bench import read_events, read_summary
from support.commands import Here
from support.variants import variants

EXAMPLE = Path(__file__).resolve().parents[4] / "examples" / "method-plugin"
METHODS = (RULE, LC2013)
each_method = pytest.mark.parametrize("method", METHODS)


def scenario(volume: float = 600.0, seed: int = 1, **tables: dict[str, Any]) -> Scenario:
    return parse_scenario(
        {
            "seed": seed,
            "road": {"s1_m": 20.0, "s2_m": 30.0, "s3_m": 350.0},
            "demand": {"volume_veh_per_lane_h": volume, "duration_s": 30.0},
        }
        | tables
    )


def finished(settings: Scenario, folder: Path, method: str) -> Outcome:
    reference_method(method).check(settings)
    return ReferenceRun(settings, folder, method, show_progress=False).run()


def columns(folder: Path, name: str) -> dict[str, list[Any]]:
    table: dict[str, list[Any]] = pq.read_table(folder / f"{name}.parquet").to_pydict()
    return table


def keys(value: Any, prefix: str = "") -> set[str]:  # noqa: ANN401 (JSON)
    """Return the paths of all values in a summary."""
    if not isinstance(value, dict):
        return {prefix}
    return {path for key, inner in value.items() for path in keys(inner, f"{prefix}.{key}")}


@each_method
@pytest.mark.parametrize("lane_change_s", [0.0, 4.0])
def test_at_low_volume_all_vehicles_leave_on_their_preferred_lanes(
    tmp_path: Path, method: str, lane_change_s: float
) -> None:
    settings = parse_scenario(to_tables(scenario()) | {method: {"lane_change_s": lane_change_s}})
    outcome = finished(settings, tmp_path, method)
    assert outcome.exit_status == 0
    found = read_summary(tmp_path)
    vehicles = found["vehicles"]
    assert vehicles["demanded"] == vehicles["left"] == vehicles["on_preferred_lane"] > 5
    assert found["method"] == method
    assert found["safety"]["overlaps"] == 0
    assert found["planning"]["plans"] == found["tracking"]["solves"] == 0
    assert found["runtime"]["processes"] == 1
    record = RunRecord(tmp_path / "formation", Scenario(), "formation", lambda: 0.0)
    record.close(1.0, Ending.COMPLETE)
    more = keys(found) - keys(read_summary(tmp_path / "formation"))
    assert not keys(read_summary(tmp_path / "formation")) - keys(found)
    # Without vehicles there is nothing to measure.
    assert all(re.match(r"\.(comfort|energy|safety\.min_(ttc|pet)_s)", path) for path in more)
    assert found["safety"]["min_accel_mps2"] >= -10.0
    assert found["safety"]["max_accel_mps2"] <= 5.0
    trips = columns(tmp_path, "trips")
    assert trips["final_lane"] == trips["preferred_lane"]
    assert set(trips["formation"]) == {None}
    # Some changed lanes, and only in S3.
    rows = columns(tmp_path, "trajectories")
    arrived = dict(zip(trips["vehicle"], trips["arrival_lane"], strict=True))
    changed = {
        s_m
        for s_m, lane, name in zip(rows["s_m"], rows["lane"], rows["vehicle"], strict=True)
        if lane != arrived[name]
    }
    assert min(changed) >= 50.0
    assert set(rows["column"]) == {None}


@pytest.mark.slow
@each_method
def test_equal_seeds_give_equal_runs(tmp_path: Path, method: str) -> None:
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        finished(scenario(1500.0, seed), tmp_path / name, method)
    assert columns(tmp_path / "a", "trajectories") == columns(tmp_path / "b", "trajectories")
    assert columns(tmp_path / "a", "trips") != columns(tmp_path / "c", "trips")


@each_method
def test_a_lone_vehicle_takes_as_long_as_the_road_is(
    tmp_path: Path, method: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    lone = Arrival("v0001", 0, 2, 61.234)
    monkeypatch.setattr(road_sources, "arrivals", lambda _: (lone,))
    finished(Scenario(), tmp_path, method)
    travel_time_s = read_summary(tmp_path)["travel_time_s"]
    assert travel_time_s["mean"] == pytest.approx(1000.0 / 15.0, abs=1e-3)
    (entered,) = read_events(tmp_path, "entered")
    assert entered["t_s"] == pytest.approx(61.234)


def test_a_run_that_does_not_end_is_ended(tmp_path: Path) -> None:
    outcome = finished(scenario(runtime={"max_road_s": 15.0}), tmp_path, RULE)
    assert outcome.exit_status == 1
    assert read_summary(tmp_path)["ending"] == Ending.LIMIT.value


class Standing(Rules):
    """Rules of vehicles that stop before S3."""

    def approach_speed_mps(self, vehicle: ReferenceVehicle) -> float:
        return 0.0 if vehicle.s_m > 40.0 else super().approach_speed_mps(vehicle)


class StandingMethod(RuleMethod):
    """A method whose vehicles never leave."""

    def rules(self, scenario: Scenario) -> Rules:
        return Standing(scenario)


def use_methods(monkeypatch: pytest.MonkeyPatch, **methods: ReferenceMethod) -> None:
    """Let runs find methods that are not installed."""
    monkeypatch.setattr(reference_run, "reference_method", methods.__getitem__)


def test_a_run_whose_vehicles_stand_forever_has_failed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    use_methods(monkeypatch, rule=StandingMethod())
    outcome = ReferenceRun(scenario(), tmp_path, RULE, show_progress=False).run()
    assert outcome.exit_status == 1
    assert not outcome.interrupted
    assert re.fullmatch(
        r"\d+ vehicles have stood still since \d+ s of road time", outcome.problems[0]
    )
    found = read_summary(tmp_path)
    assert found["ending"] == Ending.STANDSTILL.value
    assert found["vehicles"]["entered"] > 0
    assert 300.0 <= found["simulated_s"] < 400.0
    assert columns(tmp_path, "trajectories")["vehicle"]


def test_an_empty_road_and_slow_vehicles_are_no_standstill() -> None:
    standstill = Standstill()
    assert standstill.problem(1000.0, ()) is None
    slow = ReferenceVehicle(Arrival("v0001", 0, 2, 0.0), 0.0, 10.0, 0.0, 1.5, 0)
    for t_s in range(1000, 2000, 100):
        slow.s_m += 0.06
        assert standstill.problem(float(t_s), (slow,)) is None
    assert standstill.problem(2500.0, (slow,)) is not None


def trajectories_of_example(
    settings: Scenario, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> dict[str, pa.Table]:
    """Run the methods of examples/method-plugin and the built-in rules."""
    monkeypatch.syspath_prepend(EXAMPLE)
    example = importlib.import_module("laneweave_mobil")
    methods = {"mobil": example.Mobil(), "polite": example.POLITE, RULE: RuleMethod()}
    found = {}
    for name, method in methods.items():
        use_methods(monkeypatch, rule=method)
        outcome = ReferenceRun(settings, folder / name, RULE, show_progress=False).run()
        assert outcome.problems == ()
        found[name] = pq.read_table(folder / name / "trajectories.parquet")
    return found


def test_the_example_decides_on_lane_changes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = trajectories_of_example(scenario(1500.0), tmp_path, monkeypatch)
    for one, other in combinations(found.values(), 2):
        assert not one.equals(other)


def test_bodies_that_overlap_break_a_promise(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Bodies, "overlapping_pairs", lambda _: [("v0001", "v0002")])
    outcome = finished(scenario(), tmp_path, RULE)
    assert outcome.exit_status == 1
    assert "1 pairs of vehicles overlapped" in outcome.problems


def test_an_interrupted_run_leaves_its_summary(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(road.ReferenceRoad, "advance", interrupt)
    with pytest.raises(KeyboardInterrupt):
        finished(scenario(), tmp_path, LC2013)
    assert read_summary(tmp_path)["ending"] == Ending.INTERRUPTED.value


# --- the command ------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("method", variants(METHODS))
def test_the_command_leaves_all_files(laneweave: Here, tmp_path: Path, method: str) -> None:
    out = tmp_path / "run"
    options = ("--duration", 5, "--volume", 600, "--out", out)
    assert laneweave("run", "--method", method, *options)[0] == 0
    assert {path.name for path in out.iterdir()} == {
        *("events.jsonl", "log.jsonl", "summary.json"),
        *("ticks.parquet", "trajectories.parquet", "trips.parquet"),
        *("road.png", "speed.png"),  # too short for counted vehicles
        *("comfort.png", "spacing.png", "report.html"),
    }
