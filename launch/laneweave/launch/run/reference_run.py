"""A run with a reference method in this process, without agents, coordinators or messages."""

from __future__ import annotations

import time
from collections.abc import Collection
from pathlib import Path

from attrs import define, field

from laneweave.launch.observe.road_view import RoadView
from laneweave.launch.run.outcome import Outcome, complete_summary
from laneweave.launch.run.progress import RunProgress
from laneweave.launch.run_methods import reference_method
from laneweave.protocol.runtime.processes import stop_signals
from laneweave.protocol.runtime.temporary_folders import temporary_folder
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.summary import Ending
from laneweave.sim_bridge.baselines.reference_road import ReferenceRoad, ReferenceVehicle
from laneweave.sim_bridge.recording.run_record import RunRecord
from laneweave.sim_bridge.road_sources import demand_of

PROGRESS_EVERY_TICKS = 50
STANDSTILL_S = 300.0
"""Road time without any movement after which a run has failed."""
STANDSTILL_M = 0.1
"""Distance within which a vehicle counts as standing."""


@define
class Standstill:
    """Detector of traffic that stands forever."""

    since_s: float = 0.0
    """Road time of the last movement, entry or exit."""
    _positions: dict[str, tuple[float, float]] = field(factory=dict)

    def problem(self, t_s: float, vehicles: Collection[ReferenceVehicle]) -> str | None:
        """Return a line if all vehicles have stood still for `STANDSTILL_S`, otherwise None.

        An empty road is not a standstill: it may wait for the next arrival.
        """
        positions = {one.name: (one.s_m, one.y_m) for one in vehicles}
        if not positions or self._have_moved(positions):
            self.since_s, self._positions = t_s, positions
        if t_s - self.since_s < STANDSTILL_S:
            return None
        return f"{len(positions)} vehicles have stood still since {self.since_s:.0f} s of road time"

    def _have_moved(self, positions: dict[str, tuple[float, float]]) -> bool:
        """Return whether a vehicle has entered, left or moved since `since_s`."""
        return positions.keys() != self._positions.keys() or any(
            max(abs(s_m - self._positions[name][0]), abs(y_m - self._positions[name][1]))
            > STANDSTILL_M
            for name, (s_m, y_m) in positions.items()
        )


@define
class ReferenceRun:
    """A run with a reference method, as fast as possible; call `run` once."""

    scenario: Scenario
    folder: Path
    method: str
    show_progress: bool = True
    _stop: bool = False

    def run(self) -> Outcome:
        """Run the scenario and return its outcome.

        Raises:
            KeyboardInterrupt: a signal has stopped the run before it began.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        with stop_signals(self._request_stop):
            problem = self._drive()
            return complete_summary(
                self.folder,
                problems=() if problem is None else (problem,),
                interrupted=self._stop,
                processes=1,
            )

    def _drive(self) -> str | None:
        """Drive until the end; return a line if the run has failed."""
        with (
            temporary_folder("sumo") as folder,
            reference_method(self.method).open(self.scenario, folder) as traffic,
            RunProgress(self.scenario, show=self.show_progress) as progress,
        ):
            record = RunRecord(self.folder, self.scenario, self.method, time.perf_counter)
            stream = demand_of(self.scenario).arrivals
            road = ReferenceRoad(self.scenario, stream, traffic, record)
            standstill, problem = Standstill(), None
            try:
                while road.ending is None and problem is None and not self._stop:
                    road.advance()
                    if road.tick % PROGRESS_EVERY_TICKS == 0:
                        progress.show(RoadView(clock=road.clock))
                        problem = standstill.problem(road.t_s, traffic.vehicles)
            finally:
                stopped = Ending.INTERRUPTED if problem is None else Ending.STANDSTILL
                record.close(road.t_s, road.ending or stopped)
        return problem

    def _request_stop(self) -> None:
        self._stop = True
