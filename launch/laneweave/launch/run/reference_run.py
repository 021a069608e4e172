"""A run with a reference method in this process, without agents, coordinators or messages."""

from __future__ import annotations

import time
from pathlib import Path

from attrs import define

from laneweave.launch.observe.road_view import RoadView
from laneweave.launch.run.outcome import Outcome, complete_summary
from laneweave.launch.run.progress import RunProgress
from laneweave.launch.run_methods import reference_method
from laneweave.protocol.runtime.processes import stop_signals
from laneweave.protocol.runtime.temporary_folders import temporary_folder
from laneweave.protocol.scenario.fields import Scenario
from laneweave.sim_bridge.baselines.reference_road import ReferenceRoad
from laneweave.sim_bridge.recording.run_record import Ending, RunRecord

PROGRESS_EVERY_TICKS = 50


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
        with (
            stop_signals(self._request_stop),
            temporary_folder("sumo") as folder,
            reference_method(self.method).open(self.scenario, folder) as traffic,
            RunProgress(self.scenario, show=self.show_progress) as progress,
        ):
            record = RunRecord(self.folder, self.scenario, self.method, time.perf_counter)
            road = ReferenceRoad(self.scenario, traffic, record)
            try:
                while road.ending is None and not self._stop:
                    road.advance()
                    if road.tick % PROGRESS_EVERY_TICKS == 0:
                        progress.show(RoadView(clock=road.clock))
            finally:
                record.close(road.t_s, road.ending or Ending.INTERRUPTED)
        return complete_summary(self.folder, problems=(), interrupted=self._stop, processes=1)

    def _request_stop(self) -> None:
        self._stop = True
