"""Results on roads with lane drops, ramps, exits, weaving sections and trucks.

    python benchmarks/roads.py [--only TEXT ...] [--seeds N] [--again]

Each run drives a file of `scenarios/` with the volumes of a point, 600 s of arrivals over the
simulated network, where results repeat exactly. The results are in docs/evidence/roads.json;
finished runs are not repeated unless `--again` is given.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import attrs
import numpy as np
from attrs import field, frozen

from evaluation.lattice_points import lattice_spacing
from experiments import Job, run_points, silence
from laneweave.launch.faults.fault_file import FaultSpec, load_faults
from laneweave.launch.recordings.trajectories import Tracks, read_tracks, read_trips
from laneweave.launch.run.reference_run import ReferenceRun
from laneweave.launch.run.simulated_run import SimulatedRun
from laneweave.launch.run_methods import FORMATION, METHODS
from laneweave.protocol.config.participants import coordinator_names
from laneweave.protocol.config.scenario_files import load_scenario
from laneweave.protocol.config.source_files import read_toml_source
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.road_tables import MAIN_ENTRANCE
from laneweave.protocol.summary import read_summary

HERE: Final = Path(__file__).resolve().parent
SCENARIOS: Final = HERE.parent / "scenarios"
TIMEOUT_S: Final = 1800.0
OUT: Final = HERE.parent / "docs" / "evidence"
RECORD: Final = "roads.json"
DURATION_S: Final = 600.0
FILES: Final = (
    "lane-drop",
    "blocked-lane",
    "on-ramp",
    "off-ramp",
    "weaving",
    "motorway",
    "trucks",
)
STOPPED_MPS: Final = 0.5
"""A vehicle slower than this has stopped."""
REFERENCES: Final = (
    "rule",
    "lc2013-human",
    "lc2013-ideal",
    "lc2013-cooperative",
    "lc2013-cooperative-4s",
    "sl2015-cooperative",
)


@frozen(eq=False)
class Point:
    """A road with a demand, a method, and faults."""

    scenario: str
    """Name of a file in `scenarios/`."""
    volume: int
    """Vehicles/(lane h) on the main road."""
    label: str = "rolling"
    """Key of `METHODS`."""
    overrides: Mapping[str, object] = field(factory=dict)
    """See `load_scenario`."""
    faults: str | None = None
    """A preset, or a file in `benchmarks/faults` or `scenarios/faults`."""
    goal: float | None = None
    """Permitted ratio of the mean travel time to the time at v_F, from the start of the road."""
    ramp_goal_s: float | None = None
    """Permitted mean delay of vehicles from ramps."""
    reached_goal: float = 1.0
    """Required share of vehicles at their destinations, in all undisturbed runs together."""
    seeds: int = 5
    duration_s: float = DURATION_S
    processes: bool = False
    """Whether real processes drive the file as it is, one for each vehicle, over Zenoh."""

    @property
    def name(self) -> str:
        """Name of the point in the record."""
        zenoh = "zenoh" if self.processes else ""
        words = (self.scenario, f"{self.volume}", self.label, zenoh, self.faults or "")
        return " ".join(filter(None, words))

    def settings(self, seed: int) -> Scenario:
        """Return the scenario of a run."""
        base = load_scenario(
            SCENARIOS / f"{self.scenario}.toml",
            seed=seed,
            demand__volume_veh_per_lane_h=float(self.volume),
            demand__duration_s=self.duration_s,
            **self.overrides,
        )
        return METHODS[self.label].settings(base)


def _leaving(share: float) -> dict[str, object]:
    """Return the overrides for the share of vehicles that leave by the off-ramp."""
    return {"demand__destinations": [{"exit": "off-ramp", "share": share}]}


def _weaving(ramp_veh_per_h: float, volume: int) -> dict[str, object]:
    """Return the overrides for equal flows from the on-ramp and to the off-ramp of weaving.toml."""
    (ramp,) = read_toml_source(SCENARIOS / "weaving.toml").tables["entrance"]
    return {
        "entrance": [ramp | {"volume_veh_per_h": ramp_veh_per_h}],
        **_leaving(ramp_veh_per_h / (3 * volume)),
    }


def _lane_ends() -> Iterator[Point]:
    """Yield the points of roads whose lanes end."""
    for volume, goal in ((1000, 1.01), (1500, 1.02), (2000, 1.03), (2200, 1.05)):
        yield Point("lane-drop", volume, goal=goal)
        yield from _with_references(Point("lane-drop", volume))
    for volume in (1000, 1500, 1700):
        yield Point("lane-drop", volume, "formations", goal=1.05)
    for volume in (1000, 1450):
        yield Point("blocked-lane", volume, goal=1.03)
        yield Point("blocked-lane", volume, "formations", goal=1.03)


def _ramps() -> Iterator[Point]:
    """Yield the points of roads with ramps and exits."""
    for volume, goal, ramp_goal_s in ((1600, 1.01, 3.0), (2000, 1.02, 5.0), (2300, 1.03, 8.0)):
        yield Point("on-ramp", volume, goal=goal, ramp_goal_s=ramp_goal_s)
        yield from _with_references(Point("on-ramp", volume))
    yield Point("on-ramp", 1300, "formations", goal=1.05)
    leaving = _leaving(0.2)
    yield Point("off-ramp", 2000, overrides=leaving, goal=1.02)
    yield from _with_references(Point("off-ramp", 2000, overrides=leaving))
    yield Point("off-ramp", 1700, "formations", overrides=leaving, goal=1.05)
    for ramp, volume, goal in ((600, 1600, 1.02), (600, 2000, 1.03), (800, 2400, 1.05)):
        flows = _weaving(ramp, volume)
        yield Point("weaving", volume, overrides=flows, goal=goal)
        yield from _with_references(Point("weaving", volume, overrides=flows))
    flows = _weaving(600, 1300)
    yield Point("weaving", 1300, "formations", flows, goal=1.05, reached_goal=0.998)


def _faulty() -> Iterator[Point]:
    """Yield the points with faults."""
    for faults in ("loss-30.toml", "lossy50", "agents-killed.toml", "leader-killed.toml"):
        for volume, label in ((1600, "rolling"), (1200, "formations")):
            for scenario in ("lane-drop", "on-ramp"):
                yield Point(scenario, volume, label, faults=faults, seeds=1, duration_s=300.0)


def _with_references(point: Point) -> Iterator[Point]:
    """Yield the reference methods at the same point."""
    for label in REFERENCES:
        yield attrs.evolve(point, label=label, seeds=1)


def _with_processes() -> Iterator[Point]:
    """Yield a point of each road over Zenoh."""
    for scenario in FILES:
        volume = load_scenario(SCENARIOS / f"{scenario}.toml").demand.volume_veh_per_lane_h
        yield Point(scenario, round(volume), seeds=1, duration_s=120.0, processes=True)


POINTS: Final = (
    *_lane_ends(),
    *_ramps(),
    Point("motorway", 1600, goal=1.03),
    Point("motorway", 2400, goal=1.03, reached_goal=0.999),
    Point("trucks", 1450, goal=1.03),
    Point("trucks", 1000, "formations", goal=1.03),
    Point("trucks", 1200, "formations", goal=1.03),
    *_faulty(),
    *_with_processes(),
)


def drive(job: Job[Point]) -> dict[str, Any]:
    """Drive one run, and return its results."""
    scenario, method = job.point.settings(job.seed), METHODS[job.point.label].method
    with tempfile.TemporaryDirectory(prefix="laneweave-roads-") as name, silence():
        folder, began_s = Path(name), time.process_time()
        if job.point.processes:
            problems: Sequence[str] = _run_processes(job, folder)
        elif method == FORMATION:
            faults = _faults(job.point.faults, scenario)
            run = SimulatedRun(scenario, folder, faults, show_progress=False)
            problems = run.run().or_interrupt().problems
        else:
            reference = ReferenceRun(scenario, folder, method, show_progress=False)
            problems = reference.run().or_interrupt().problems
        cpu_s = time.process_time() - began_s
        return metrics(folder, scenario, method) | {
            "point": job.point.name,
            "seed": job.seed,
            "cpu_s": round(cpu_s, 1),
            "problems": list(problems),
        }


def _run_processes(job: Job[Point], folder: Path) -> list[str]:
    """Run a scenario file with real processes; return the errors of the command."""
    command = [str(Path(sys.executable).parent / "laneweave"), "run", "--no-progress"]
    command += [str(SCENARIOS / f"{job.point.scenario}.toml"), "--vehicles-per-process", "1"]
    command += ["--seed", f"{job.seed}", "--duration", f"{job.point.duration_s}"]
    command += ["--operation", job.point.label, "--out", str(folder / "run")]
    ended = subprocess.run(  # noqa: S603 (the command consists of constants)
        command, capture_output=True, text=True, timeout=TIMEOUT_S, check=False
    )
    for file in (folder / "run").iterdir():
        file.rename(folder / file.name)
    return [] if ended.returncode == 0 else ended.stderr.splitlines()[-5:]


def metrics(folder: Path, scenario: Scenario, method: str) -> dict[str, Any]:
    """Return the results of a finished run."""
    summary, trips = read_summary(folder), read_trips(folder)
    if summary is None:
        raise RuntimeError(f"{folder}: no summary")
    tracks = read_tracks(folder)
    counted = [trip for trip in trips.values() if trip["counted"]]
    vehicles, safety, tracking = summary.vehicles, summary.safety, summary.tracking
    result = {
        "ending": summary.ending,
        "demanded": vehicles.demanded,
        "left": vehicles.left,
        "at_destination": vehicles.at_destination,
        "travel_s": summary.travel_time_s.mean,
        "ratio": _ratio([trip for trip in counted if trip["entrance"] == MAIN_ENTRANCE]),
        "delay_by_entrance_s": _delays(summary.travel_time_s.by_entrance),
        "delay_by_destination_s": _delays(summary.travel_time_s.by_destination),
        "throughput_veh_per_lane_h": summary.throughput_veh_per_lane_h,
        "overlaps": safety.overlaps,
        "min_gap_m": safety.min_gap_m,
        "accel_mps2": _extremes(tracks, trips),
        "beyond_limits": _beyond_limits(tracks, trips, scenario),
        "stopped": _stopped(tracks),
        "emergency_brakes": safety.emergency_brakes,
        "emergency_ticks": tracking.emergency_ticks,
        "caretakers": tracking.caretaker_takeovers,
        "plans": summary.planning.plans,
        "optimal": summary.planning.optimal,
        "processes": summary.runtime.processes,
        "real_time_factor": summary.runtime.real_time_factor,
    }
    if method == FORMATION:
        spacing = lattice_spacing(tracks, scenario)
        result["min_spacing_m"] = spacing.least_m
        result["keeps_pitch"] = spacing.keeps(scenario.lattice.pitch_m)
    return result


def _ratio(trips: Sequence[Mapping[str, Any]]) -> float | None:
    """Return the mean travel time divided by the mean time at v_F."""
    if not trips:
        return None
    free_s = sum(trip["free_flow_s"] for trip in trips)
    return round(float(sum(trip["travel_time_s"] for trip in trips) / free_s), 4)


def _delays(groups: Mapping[str, Any] | None) -> dict[str, float]:
    return {name: times.delay for name, times in (groups or {}).items()}


def _by_type(tracks: Tracks, trips: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Yield the accelerations of all vehicles of each type."""
    types = np.array([trips[name]["vehicle_type"] for name in tracks.names])[tracks.vehicle]
    for one in np.unique(types):
        yield str(one), tracks.accel_mps2[types == one]


def _extremes(tracks: Tracks, trips: Mapping[str, Any]) -> dict[str, list[float]]:
    """Return the lowest and the highest acceleration of each type [m/s^2]."""
    return {
        name: [round(float(accel.min()), 2), round(float(accel.max()), 2)]
        for name, accel in _by_type(tracks, trips)
    }


def _beyond_limits(tracks: Tracks, trips: Mapping[str, Any], scenario: Scenario) -> int:
    """Return the number of rows in which a vehicle exceeds the limits of its type."""
    count = 0
    for name, accel in _by_type(tracks, trips):
        vehicle = scenario.types[name].limits
        low, high = vehicle.min_accel_mps2 - 1e-3, vehicle.max_accel_mps2 + 1e-3
        count += int(np.sum((accel < low) | (accel > high)))
    return count


def _stopped(tracks: Tracks) -> int:
    """Return the number of vehicles that have stopped."""
    return len(np.unique(tracks.vehicle[tracks.speed_mps < STOPPED_MPS]))


def _faults(name: str | None, scenario: Scenario) -> FaultSpec:
    """Return the faults of a preset or of a file in one of the two folders."""
    files = [folder / str(name) for folder in (HERE / "faults", SCENARIOS / "faults")]
    choice = next((file for file in files if name and file.is_file()), name)
    return load_faults(choice, coordinator_names(scenario))


def main() -> int:
    """Run the missing points and record their results."""
    hidden = ("ending", "delay_by_destination_s", "throughput_veh_per_lane_h")
    return run_points(
        POINTS,
        drive,
        OUT / RECORD,
        __doc__,
        hidden=hidden,
        alone=lambda point: point.processes,
    )


if __name__ == "__main__":
    sys.exit(main())
