"""The progress bar of a run."""

from __future__ import annotations

import time

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from laneweave.launch.observe.road_view import RoadView
from laneweave.protocol.scenario.fields import Scenario


class RunProgress(Progress):
    """Progress bar with road time, vehicles on the road, leader and real-time factor."""

    def __init__(self, scenario: Scenario, *, show: bool) -> None:
        """Create a bar, full when the last vehicle leaves in free flow; hidden unless `show`."""
        super().__init__(
            TextColumn("{task.fields[now]}"),
            BarColumn(bar_width=None),
            TextColumn("{task.fields[road]}"),
            TextColumn("{task.fields[leader]}"),
            TextColumn("{task.fields[rate]}"),
            TimeElapsedColumn(),
            console=Console(stderr=True),
            disable=not show,
            transient=True,
        )
        self._total_s = scenario.demand.duration_s + scenario.free_flow_s
        self._task: TaskID = self.add_task(
            "run", total=self._total_s, now="starting", road="", leader="no leader", rate=""
        )
        self._began: tuple[float, float] | None = None

    def show(self, view: RoadView) -> None:
        """Show the current state of the run."""
        clock = view.clock
        if clock is None:
            return
        now = time.monotonic()
        if self._began is None:
            self._began = (now, clock.t_s)
        wall_s, road_s = now - self._began[0], clock.t_s - self._began[1]
        self.update(
            self._task,
            completed=min(clock.t_s, self._total_s),
            now=f"{clock.t_s:6.1f} s",
            road=f"{clock.on_road:3d} on the road, {clock.left}/{clock.demanded} left",
            leader=f"leader {view.leader}, term {view.term}" if view.leader else "no leader",
            rate=f"x{road_s / wall_s:.2f} real time" if wall_s > 1 else "",
        )
