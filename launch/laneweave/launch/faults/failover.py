"""Failover times: from a leader fault to the next leader and to the next plan.

The next plan is the first formation plan that comes into force after the fault. If its formation
closed after the fault, the time is measured from when it closed, because there was nothing to plan
earlier.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import deque

from attrs import define, field

from laneweave.launch.observe.road_view import RoadView
from laneweave.protocol.wire.process_messages import LogEvent

IN_FORCE = "plan-in-force"
IN_FLIGHT_S = 0.05
"""Maximum delay of messages sent by a leader before it was paused."""
MAX_ROAD_TIMES = 10_000
"""Number of road times that are stored; formations close less than this number of ticks ago."""


@define
class Failover:
    """Measurement of recovery from leader faults; all times are from one clock, in seconds."""

    lease_s: float
    recovery_s: list[float] = field(factory=list)
    """Time to the next leader, for each leader killed, or paused for longer than the lease."""
    plan_recovery_s: list[float] = field(factory=list)
    """Time to the next plan in force, for each leader killed or paused."""
    _lost: tuple[str | None, int] | None = None
    """Name and incarnation of the failed leader; None: no failover in progress."""
    _lost_s: float = 0.0
    _awake_s: float = math.inf
    """Time at which the failed leader resumes; infinite: it was killed."""
    _target: str | None = None
    """Target of the newest fault until the next plan; then None."""
    _target_s: float = 0.0
    _killed: bool = False
    _led_again: bool = False
    """Whether another process has led since the newest fault."""
    _road_s: deque[float] = field(factory=lambda: deque(maxlen=MAX_ROAD_TIMES))
    """Observed road times, in ascending order."""
    _seen_s: deque[float] = field(factory=lambda: deque(maxlen=MAX_ROAD_TIMES))
    """Time at which each road time of `_road_s` was first observed."""

    def on_leader_fault(self, view: RoadView, now_s: float, for_s: float | None) -> None:
        """Record that the leader was killed (`for_s` is None) or paused."""
        self._target, self._target_s = view.leader, now_s
        self._killed, self._led_again = for_s is None, False
        if for_s is not None and for_s <= self.lease_s:
            return
        if self._lost is None:
            self._lost = (view.leader, view.incarnation)
            self._lost_s = now_s
            self._awake_s = math.inf if for_s is None else now_s + for_s
        view.leader = None

    def update(self, view: RoadView, now_s: float) -> None:
        """Update the recovery times from the observed state, and clear a failed leader in it."""
        if not self._road_s or view.t_s > self._road_s[-1]:
            self._road_s.append(view.t_s)
            self._seen_s.append(now_s)
        self._update_leader(view, now_s)
        for event in view.take_events():
            self._on_event(event, now_s)

    def _update_leader(self, view: RoadView, now_s: float) -> None:
        if view.leader not in (None, self._target):
            self._led_again = True
        if self._lost is None or view.leader is None:
            return
        if (view.leader, view.incarnation) != self._lost:
            self.recovery_s.append(round(now_s - self._lost_s, 4))
            self._lost = None
            self._led_again = True
        elif now_s >= self._awake_s:
            self._lost = None  # the leader resumed before another coordinator took over
        else:
            view.leader = None  # a heartbeat that was in flight

    def _on_event(self, event: LogEvent, now_s: float) -> None:
        if self._target is None or event.kind != IN_FORCE:
            return
        by_target = event.name == self._target and not self._led_again
        if by_target and (self._killed or now_s < self._target_s + IN_FLIGHT_S):
            return  # sent before the fault
        self._target = None
        closed_s = event.data.get("closed_s")
        since_s = self._target_s
        if isinstance(closed_s, float):
            since_s = max(since_s, self._seen_at(closed_s))
        self.plan_recovery_s.append(round(max(0.0, now_s - since_s), 4))

    def _seen_at(self, road_s: float) -> float:
        index = bisect_left(self._road_s, road_s)
        return self._seen_s[index] if index < len(self._seen_s) else 0.0
