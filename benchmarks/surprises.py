"""Cost of a road with surprises: breakdowns, lanes that an operator closes, passing vehicles.

    python benchmarks/surprises.py [--only TEXT ...] [--seeds N] [--again]

Each run drives the paper's road with 330 s of arrivals over the simulated network, where results
repeat exactly. In the runs with SUMO's drivers, SUMO stops a vehicle in the same lane. The results
are in docs/evidence/surprises.json; finished runs are not repeated unless `--again` is given.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from attrs import field, frozen

from experiments import Job, run_points, silence
from laneweave.launch.faults.fault_file import load_faults
from laneweave.launch.recordings.trajectories import Tracks, read_tracks
from laneweave.launch.run.simulated_run import SimulatedRun
from laneweave.launch.run_methods import FORMATION, METHODS
from laneweave.protocol.config.participants import coordinator_names
from laneweave.protocol.config.scenario_files import load_scenario
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.road_tables import MAIN_ENTRANCE
from laneweave.protocol.summary import Ending, ObstacleFigures, read_summary
from laneweave.protocol.wire.obstacle_messages import BREAKDOWN, CLOSED
from laneweave.sim_bridge.baselines.lc2013 import Lc2013Traffic
from laneweave.sim_bridge.baselines.reference_road import (
    Entrance,
    ReferenceRoad,
    ReferenceVehicle,
)
from laneweave.sim_bridge.recording.run_record import RunRecord
from laneweave.sim_bridge.road_sources import demand_of
from laneweave.sim_bridge.sumo.traffic import SumoTraffic

OUT: Final = Path(__file__).resolve().parents[1] / "docs" / "evidence"
RECORD: Final = "surprises.json"
DURATION_S: Final = 330.0
LANE: Final = 1
"""The middle lane, in which all surprises happen."""
BROKEN: Final = {"at_s": 100.0, "lane": LANE, "at_m": 600.0, "decel_mps2": 3.0, "for_s": 120.0}
"""The first vehicle beyond 600 m stands for two minutes."""
CLOSING: Final = {"lane": LANE, "from_m": 600.0, "to_m": 700.0, "at_s": 100.0, "for_s": 60.0}
PASSING: Final = {"lane": LANE, "at_s": 80.0}
BODY_M: Final = 7.0
"""Length of a passing vehicle."""
STOPPED_MPS: Final = 0.5
"""A vehicle slower than this has stopped."""
FREE_SHARE: Final = 0.98
"""Traffic flows freely if its mean speed is at least this share of v_F."""
WINDOW_S: Final = 10.0
"""Interval of mean speeds."""
REFERENCES: Final = ("lc2013-human", "lc2013-cooperative-4s")
"""SUMO's human drivers, and tuned ideal ones whose lane changes take 4 s."""
OPERATIONS: Final = ("rolling", "formations")


@frozen
class Point:
    """A surprise, a method, and a demand."""

    surprise: str
    label: str
    """Key of `METHODS`."""
    volume: int
    """Vehicles/(lane h)."""
    loss: float = 0.0
    """Share of lost messages."""
    breakdown: Mapping[str, Any] | None = None
    event: Mapping[str, Any] | None = None
    """Element of `road.events`."""
    seeds: int = 5
    until_s: float = field(default=DURATION_S)
    """Duration of the arrivals."""

    @property
    def name(self) -> str:
        """Name of the point in the record."""
        lossy = f"{100 * self.loss:g} % loss" if self.loss else ""
        return " ".join(filter(None, (self.surprise, self.label, f"{self.volume}", lossy)))

    def settings(self, seed: int) -> Scenario:
        """Return the scenario of a run."""
        base = load_scenario(
            None,
            seed=seed,
            demand__volume_veh_per_lane_h=float(self.volume),
            demand__duration_s=self.until_s,
            road__events=[self.event] if self.event else [],
            tracking__shortcut=True,
        )
        return METHODS[self.label].settings(base)


def _points() -> Iterator[Point]:
    """Yield all points."""
    for volume in (1000, 1450, 1800):
        for label in OPERATIONS if volume < 1800 else OPERATIONS[:1]:
            yield Point("none", label, volume, seeds=1)
            for loss in (0.0, 0.3):
                yield Point("breakdown", label, volume, loss, breakdown=BROKEN)
        for label in REFERENCES:
            yield Point("none", label, volume, seeds=1)
            yield Point("breakdown", label, volume, breakdown=BROKEN)
    for label in OPERATIONS:
        for ahead_m, clear_s in ((300, 20.0), (50, 10.0 / 3.0)):
            event = {**CLOSING, "clear_s": clear_s}
            yield Point(f"closed {ahead_m} m ahead", label, 1450, event=event, seeds=3)
        for speed_mps in (5.0, 10.0):
            event = {**PASSING, **_body(500.0), "speed_mps": speed_mps}
            yield Point(f"slow {speed_mps:g} m/s", label, 1450, event=event, seeds=3)
        event = {**PASSING, **_body(0.0), "speed_mps": 25.0}
        yield Point("emergency 25 m/s", label, 1450, event=event)


def _body(from_m: float) -> dict[str, float]:
    """Return the fields of an event for the place where a passing vehicle enters."""
    return {"from_m": from_m, "to_m": from_m + BODY_M}


POINTS: Final = tuple(_points())


class StoppingTraffic(Lc2013Traffic):
    """SUMO's traffic, in which the first vehicle beyond a position stops for a time."""

    def __init__(self, scenario: Scenario, sumo: SumoTraffic, broken: Mapping[str, Any]) -> None:
        """Begin with an empty road; `broken` is a table `[[breakdown]]`."""
        super().__init__(scenario, sumo)
        self._sumo, self._broken = sumo, broken
        self.stopped: ReferenceVehicle | None = None

    def step(self, t_s: float, entrance: Entrance) -> list[ReferenceVehicle]:
        """Advance, and stop a vehicle as soon as one is there."""
        entered = super().step(t_s, entrance)
        if self.stopped is None and t_s >= self._broken["at_s"]:
            beyond = [one for one in self.vehicles if self._breaks_down(one)]
            if beyond:
                self._stop(min(beyond, key=lambda one: one.s_m))
        return entered

    def _breaks_down(self, one: ReferenceVehicle) -> bool:
        beyond = one.s_m >= float(self._broken["at_m"])
        return beyond and one.lane == self._broken["lane"]

    def _stop(self, one: ReferenceVehicle) -> None:
        self.stopped, api = one, self._sumo.vehicle
        # SUMO rejects a stop nearer than the braking distance; a second of driving is spare.
        distance_m = one.speed_mps**2 / (2.0 * self._broken["decel_mps2"]) + one.speed_mps
        api.setStop(
            one.name,
            api.getRoadID(one.name),
            api.getLanePosition(one.name) + distance_m,
            api.getLaneIndex(one.name),
            self._broken["for_s"],
        )


def drive(job: Job[Point]) -> dict[str, Any]:
    """Drive one run, and return its results."""
    point, scenario = job.point, job.point.settings(job.seed)
    with tempfile.TemporaryDirectory(prefix="laneweave-surprises-") as name, silence():
        folder, began_s = Path(name), time.process_time()
        problems: Sequence[str] = ()
        if METHODS[point.label].method == FORMATION:
            faults = load_faults(_faults(point), coordinator_names(scenario))
            run = SimulatedRun(scenario, folder, faults, show_progress=False)
            problems = run.run().or_interrupt().problems
        else:
            _let_sumo_drive(scenario, folder, METHODS[point.label].method, point.breakdown)
        cpu_s = time.process_time() - began_s
        return metrics(folder, scenario, point) | {
            "point": point.name,
            "seed": job.seed,
            "cpu_s": round(cpu_s, 1),
            "problems": list(problems),
        }


def _faults(point: Point) -> dict[str, Any]:
    """Return the tables of a fault file."""
    return {
        "breakdown": [point.breakdown] if point.breakdown else [],
        "messages": [{"loss": point.loss}] if point.loss else [],
    }


def _let_sumo_drive(
    scenario: Scenario, folder: Path, method: str, broken: Mapping[str, Any] | None
) -> None:
    """Record a run in which SUMO drives all vehicles, and stops one if there is a breakdown."""
    with tempfile.TemporaryDirectory() as files, SumoTraffic(scenario, Path(files)) as sumo:
        traffic = (
            StoppingTraffic(scenario, sumo, broken) if broken else Lc2013Traffic(scenario, sumo)
        )
        record = RunRecord(folder, scenario, method, time.perf_counter)
        road = ReferenceRoad(scenario, demand_of(scenario).arrivals, traffic, record)
        try:
            while road.ending is None:
                road.advance()
        finally:
            record.close(road.t_s, road.ending or Ending.INTERRUPTED)


def metrics(folder: Path, scenario: Scenario, point: Point) -> dict[str, Any]:
    """Return the results of a finished run."""
    summary, tracks = read_summary(folder), read_tracks(folder)
    if summary is None:
        raise RuntimeError(f"{folder}: no summary")
    obstacles = summary.obstacles or []
    end_s = _end_s(point, obstacles)
    vehicles = summary.vehicles
    broken = {one.vehicle for one in obstacles if one.cause == BREAKDOWN}
    driving = [number for number, name in enumerate(tracks.names) if name not in broken]
    others = np.isin(tracks.vehicle, driving)
    return {
        "demanded": vehicles.demanded,
        "left": vehicles.left,
        "in_another_lane": vehicles.left - (vehicles.on_preferred_lane or 0),
        "overlaps": summary.safety.overlaps,
        "min_gap_m": summary.safety.min_gap_m,
        "delay_s": round((summary.travel_time_s.by_entrance or {})[MAIN_ENTRANCE].delay, 2),
        "stopped": len(np.unique(tracks.vehicle[others & (tracks.speed_mps < STOPPED_MPS)])),
        "min_accel_mps2": round(float(tracks.accel_mps2[others].min()), 2),
        "emergency_brakes": summary.safety.emergency_brakes,
        "waited_s": round(sum(one.waited_s for one in obstacles), 1),
        "lowest_speed_mps": [
            one.lowest_speed_mps for one in obstacles if one.lowest_speed_mps is not None
        ],
        "begins_after_s": [round(one.since_s - _begins_s(point), 1) for one in obstacles[:1]],
        "used_again_s": _used_again_s(tracks, scenario, obstacles),
        "free_again_s": None if end_s is None else _free_again_s(tracks, scenario, point, end_s),
    }


def _begins_s(point: Point) -> float:
    """Return the road time from which a surprise may begin: `at_s` of its table."""
    return float((point.breakdown or point.event or {}).get("at_s", 0.0))


def _end_s(point: Point, obstacles: Sequence[ObstacleFigures]) -> float | None:
    """Return when the last surprise is over, if there was one.

    For a breakdown this is its duration after the vehicle has begun to brake: the vehicle stands
    for some seconds more.
    """
    if point.breakdown is not None:
        return float(point.breakdown["at_s"] + point.breakdown["for_s"])
    return max((one.opened_s for one in obstacles if one.opened_s is not None), default=None)


def _used_again_s(
    tracks: Tracks, scenario: Scenario, obstacles: Sequence[ObstacleFigures]
) -> float | None:
    """Return the time until a vehicle was in the middle of a part that had been opened."""
    for one in obstacles:
        if one.cause == CLOSED and one.opened_s is not None:
            there = np.floor(tracks.y_m / scenario.road.lane_width_m) == one.lane
            there &= np.abs(tracks.s_m - 0.5 * (one.from_m + one.to_m)) < 5.0
            there &= tracks.t_s >= one.opened_s
            used_s = tracks.t_s[there]
            return round(float(used_s.min() - one.opened_s), 1) if len(used_s) else None
    return None


def _free_again_s(tracks: Tracks, scenario: Scenario, point: Point, end_s: float) -> float | None:
    """Return the time after `end_s` from which traffic flows freely until the arrivals end.

    Vehicles that wait at the entrance are not part of the traffic. None: it does not flow freely
    when the arrivals end.
    """
    begins_s = np.arange(end_s, point.until_s - WINDOW_S + 1e-6, WINDOW_S)
    window = ((tracks.t_s - end_s) // WINDOW_S).astype(int)
    speeds = [float(tracks.speed_mps[window == number].mean()) for number in range(len(begins_s))]
    free = np.array(speeds) >= FREE_SHARE * scenario.formation.speed_mps
    if not free.any() or not free[-1]:
        return None
    return float(WINDOW_S * (len(free) - np.argmin(free[::-1]))) if not free.all() else 0.0


if __name__ == "__main__":
    sys.exit(run_points(POINTS, drive, OUT / RECORD, __doc__))
