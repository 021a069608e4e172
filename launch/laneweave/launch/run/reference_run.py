"""A run with a reference method in this process, without agents, coordinators or messages."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from attrs import define

from laneweave.launch.observe.road_view import RoadView
from laneweave.launch.run.outcome import Outcome, complete_summary
from laneweave.launch.run.progress import RunProgress
from laneweave.launch.run_methods import RULE
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

    def run(self) -> Outcome:
        """Run the scenario and return its outcome."""
        self.folder.mkdir(parents=True, exist_ok=True)
        with (
            self._traffic() as traffic,
            RunProgress(self.scenario, show=self.show_progress) as progress,
        ):
            record = RunRecord(self.folder, self.scenario, self.method, time.perf_counter)
            road = ReferenceRoad(self.scenario, traffic, record)
            try:
                while road.ending is None:
                    road.advance()
                    if road.tick % PROGRESS_EVERY_TICKS == 0:
                        progress.show(RoadView(clock=road.clock))
            finally:
                record.close(road.t_s, road.ending or Ending.INTERRUPTED)
        return complete_summary(self.folder, problems=(), processes=1)

    @contextmanager
    def _traffic(self) -> Iterator[Traffic]:
        with tempfile.TemporaryDirectory(prefix="laneweave-sumo-") as folder:
            if self.method == RULE:
                with SumoWorld(self.scenario, Path(folder)) as world:
                    yield RuleTraffic(self.scenario, world)
            else:
                with SumoTraffic(self.scenario, Path(folder)) as sumo:
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
