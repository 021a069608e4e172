"""The progress of a run: a bar, the pace, and an estimate of the time left."""

from __future__ import annotations

import time
from collections import deque

from attrs import define, field
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from laneweave.launch.observe.road_view import RoadView
from laneweave.protocol.scenario.fields import Scenario

WINDOW_S = 20.0
"""Wall-clock time over which the pace is measured: it falls while the road fills."""
MIN_WINDOW_S = 5.0
"""Shortest measurement of the pace."""
SAMPLE_S = 0.5
"""Wall-clock time between the measurements that are kept."""
MAX_SAMPLES = int(WINDOW_S / SAMPLE_S) + 3
EARLY_S, WAITED_S = 3.0, 15.0
"""Road time or wall-clock time after which a run may be reported as slow."""
SLOW = 0.9
"""Share of the wanted pace below which a run is reported as slow."""


@define
class PaceMeter:
    """Pace of a run over the last `WINDOW_S`, in road seconds per wall-clock second."""

    total_s: float
    """Expected road time of the whole run."""
    began: tuple[float, float] | None = None
    """First measurement; None: none yet."""
    _measured: deque[tuple[float, float]] = field(factory=lambda: deque(maxlen=MAX_SAMPLES))
    """(wall-clock time, road time)."""

    def add(self, now_s: float, road_s: float) -> None:
        """Add a measurement; road time must not decrease."""
        if len(self._measured) > 1 and now_s - self._measured[-2][0] < SAMPLE_S:
            self._measured.pop()
        self._measured.append((now_s, road_s))
        self.began = self.began or self._measured[0]
        while now_s - self._measured[0][0] > WINDOW_S:
            self._measured.popleft()

    @property
    def pace(self) -> float | None:
        """Pace; None before `MIN_WINDOW_S`."""
        if not self._measured:
            return None
        (first_s, from_s), (last_s, to_s) = self._measured[0], self._measured[-1]
        return (to_s - from_s) / (last_s - first_s) if last_s - first_s >= MIN_WINDOW_S else None

    @property
    def left_s(self) -> float | None:
        """Wall-clock time that the run still takes at this pace; None: unknown."""
        pace = self.pace
        return max(0.0, self.total_s - self._measured[-1][1]) / pace if pace else None

    def slowness(self, wanted_pace: float) -> str:
        """Return a line that reports a pace well below the wanted one; empty: it is not."""
        pace, left_s = self.pace, self.left_s
        if pace is None or left_s is None or self.began is None or pace >= SLOW * wanted_pace:
            return ""
        now_s, road_s = self._measured[-1]
        if road_s - self.began[1] < EARLY_S and now_s - self.began[0] < WAITED_S:
            return ""
        return (
            f"slower than real time: x{pace:.2f} at {road_s:.0f} s of road time, "
            f"about {duration(left_s)} left for {self.total_s - road_s:.0f} s"
        )


class RunProgress(Progress):
    """Progress bar with road time, vehicles on the road, leader, pace and time left."""

    def __init__(self, scenario: Scenario, *, show: bool) -> None:
        """Create a bar, full when the last vehicle leaves in free flow; hidden unless `show`."""
        super().__init__(
            TextColumn("{task.fields[now]}"),
            BarColumn(bar_width=None),
            TextColumn("{task.fields[road]}"),
            TextColumn("{task.fields[leader]}"),
            TextColumn("{task.fields[rate]}"),
            TimeElapsedColumn(),
            TextColumn("{task.fields[left]}"),
            console=Console(stderr=True),
            disable=not show,
            transient=True,
        )
        self.meter = PaceMeter(scenario.demand.duration_s + scenario.geometry.free_flow_s)
        self._task: TaskID = self.add_task(
            "run",
            total=self.meter.total_s,
            now="starting",
            road="",
            leader="no leader",
            rate="",
            left="",
        )

    def show(self, view: RoadView) -> None:
        """Show the current state of the run."""
        clock = view.clock
        if clock is None:
            return
        meter = self.meter
        meter.add(time.monotonic(), clock.t_s)
        pace, left_s = meter.pace, meter.left_s
        self.update(
            self._task,
            completed=min(clock.t_s, meter.total_s),
            now=f"{clock.t_s:6.1f} s",
            road=f"{clock.on_road:3d} on the road, {clock.left}/{clock.demanded} left",
            leader=f"leader {view.leader}, term {view.term}" if view.leader else "no leader",
            rate=f"x{pace:.2f} real time" if pace is not None else "",
            left=f"about {duration(left_s)} to go" if left_s is not None else "",
        )


def duration(seconds: float) -> str:
    """Return a time in words, in minutes from two minutes on."""
    return f"{seconds / 60:.0f} min" if seconds >= 120 else f"{seconds:.0f} s"
