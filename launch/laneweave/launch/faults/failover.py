"""Measures what a fault of the leader costs: until somebody leads again, until the next plan.

The next plan is that of the first formation whose plan comes into force after the fault. When that
formation closed only after the fault, the time counts from its closing: before it there was nothing
to plan.
"""

from __future__ import annotations

import math
from bisect import bisect_left

from attrs import define, field

from laneweave.launch.observe.road_view import RoadView
from laneweave.protocol.wire.messages import LogEvent

IN_FORCE = "plan-in-force"
IN_FLIGHT_S = 0.05
"""What a stopped leader had sent before is seen within this time."""


@define
class Failover:
    """Follows faults, leaders and plans; all times are those of one clock, in seconds."""

    lease_s: float
    recovery_s: list[float] = field(factory=list)
    """For each leader that was killed, or paused for longer than its lease: until another one."""
    plan_recovery_s: list[float] = field(factory=list)
    """For each leader that was killed or paused: until the next plan was in force."""
    _struck: tuple[str | None, int] | None = None
    _struck_s: float = 0.0
    _awake_s: float = math.inf
    _target: str | None = None
    """Who was struck last and has not been followed by a plan."""
    _target_s: float = 0.0
    _lasting: bool = False
    _led_again: bool = False
    _road_s: list[float] = field(factory=list)
    _seen_s: list[float] = field(factory=list)
    """When the road clock showed each of these times first."""

    def on_struck(self, view: RoadView, now_s: float, for_s: float | None) -> None:
        """The leader was killed (`for_s` is None), or paused for some time."""
        self._target, self._target_s = view.leader, now_s
        self._lasting, self._led_again = for_s is None, False
        if for_s is not None and for_s <= self.lease_s:
            return
        if self._struck is None:
            self._struck = (view.leader, view.incarnation)
            self._struck_s = now_s
            self._awake_s = math.inf if for_s is None else now_s + for_s
        view.leader = None

    def look(self, view: RoadView, now_s: float) -> None:
        """Look at what is known by now: who leads, which plans are in force."""
        if not self._road_s or view.t_s > self._road_s[-1]:
            self._road_s.append(view.t_s)
            self._seen_s.append(now_s)
        self._look_for_leader(view, now_s)
        for event in view.take_events():
            self._on_event(event, now_s)

    def _look_for_leader(self, view: RoadView, now_s: float) -> None:
        if view.leader not in (None, self._target):
            self._led_again = True
        if self._struck is None or view.leader is None:
            return
        if (view.leader, view.incarnation) != self._struck:
            self.recovery_s.append(round(now_s - self._struck_s, 4))
            self._struck = None
            self._led_again = True
        elif now_s >= self._awake_s:
            self._struck = None  # it woke before anybody took over
        else:
            view.leader = None  # a heartbeat that was still under way

    def _on_event(self, event: LogEvent, now_s: float) -> None:
        if self._target is None or event.kind != IN_FORCE:
            return
        by_itself = event.name == self._target and not self._led_again
        if by_itself and (self._lasting or now_s < self._target_s + IN_FLIGHT_S):
            return  # of a dead leader, or of one that had sent it before it was stopped
        self._target = None
        closed_s = event.data.get("closed_s")
        since_s = self._target_s
        if isinstance(closed_s, float):
            since_s = max(since_s, self._seen_at(closed_s))
        self.plan_recovery_s.append(round(max(0.0, now_s - since_s), 4))

    def _seen_at(self, road_s: float) -> float:
        index = bisect_left(self._road_s, road_s)
        return self._seen_s[index] if index < len(self._seen_s) else 0.0
