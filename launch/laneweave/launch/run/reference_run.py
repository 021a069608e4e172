"""A run with a reference method in this process, without agents, coordinators or messages."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from attrs import define

from laneweave.launch.observe.road_view import RoadView
from laneweave.launch.run.outcome import Outcome, complete_summary
from laneweave.launch.run.progress import RunProgress
from laneweave.launch.run_methods import RULE
from laneweave.protocol.runtime.processes import stop_signals
from laneweave.protocol.runtime.temporary_folders import temporary_folder
from laneweave.protocol.scenario.fields import Scenario
from laneweave.sim_bridge.baselines.lc2013 import Lc2013Traffic, check_lc2013
from laneweave.sim_bridge.baselines.reference_road import ReferenceRoad, Traffic
from laneweave.sim_bridge.baselines.rule_based import RuleTraffic, check_rule
from laneweave.sim_bridge.recording.run_record import Ending, RunRecord
from laneweave.sim_bridge.sumo.sumo_world import SumoWorld
from laneweave.sim_bridge.sumo.traffic import SumoTraffic

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
            self._traffic() as traffic,
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

    @contextmanager
    def _traffic(self) -> Iterator[Traffic]:
        with temporary_folder("sumo") as folder:
            if self.method == RULE:
                with SumoWorld(self.scenario, folder) as world:
                    yield RuleTraffic(self.scenario, world)
            else:
                with SumoTraffic(self.scenario, folder) as sumo:
                    yield Lc2013Traffic(self.scenario, sumo)


def check_reference(scenario: Scenario, method: str) -> None:
    """Check that a reference method supports a scenario.

    Raises:
        BadInputError: the method does not support the value of a field.
    """
    if method == RULE:
        check_rule(scenario)
    else:
        check_lc2013(scenario)
