"""A run with a reference method in this process, without agents, coordinators or messages."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

from attrs import define

from laneweave.launch.observe.road_view import RoadView
from laneweave.launch.run.outcome import Outcome, complete_summary
from laneweave.launch.run.progress import RunProgress
from laneweave.launch.run_methods import REFERENCE_METHODS
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.scenario.fields import Scenario
from laneweave.sim_bridge.baselines.reference_method import ReferenceMethod
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

    def run(self) -> Outcome:
        """Run the scenario and return its outcome."""
        self.folder.mkdir(parents=True, exist_ok=True)
        with (
            tempfile.TemporaryDirectory(prefix="laneweave-sumo-") as folder,
            reference_method(self.method).open(self.scenario, Path(folder)) as traffic,
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


def reference_method(name: str, field_name: str = "method") -> ReferenceMethod:
    """Return a reference method.

    Raises:
        BadInputError: there is no such method, or a plug-in cannot be loaded.
    """
    found = REFERENCE_METHODS.load(name, field_name)
    if not isinstance(found, ReferenceMethod):
        allowed = f"a ReferenceMethod; that of {REFERENCE_METHODS.origin(name)} is none"
        raise BadInputError(field_name, name, allowed)
    return found
