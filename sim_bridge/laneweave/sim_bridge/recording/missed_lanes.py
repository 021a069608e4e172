"""Why vehicles leave the road in other lanes than their preferred ones, as far as a bridge knows.

The bridge knows which process is in charge of a vehicle, whether a coordinator leads, and what
happens at the ends of lanes. Coordinators write in their own events why plans leave vehicles off
their lanes.
"""

from __future__ import annotations

from attrs import define, field

from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.wire import events, reasons
from laneweave.protocol.wire.messages import Name

MIN_LEADERLESS_S = 3.0
"""Minimum road time without a heartbeat of a leader after which there is none."""


def leaderless_after_s(scenario: Scenario) -> float:
    """Return the road time without a heartbeat after which no coordinator leads, at any pace."""
    pace = scenario.runtime.max_pace
    return max(MIN_LEADERLESS_S, scenario.network.election_s * pace)


@define
class MissedLanes:
    """Circumstances of the vehicles on the road."""

    leaderless_after_s: float
    """See the function `leaderless_after_s`."""
    _unattended_since_s: dict[Name, float] = field(factory=dict)
    """Road time since which caretakers are in charge of vehicles."""
    _lane_ends: dict[Name, str] = field(factory=dict)
    """Reason of each vehicle that has stopped before the end of a lane, or missed its exit."""

    def on_caretaker(self, t_s: float, vehicle: Name) -> None:
        """Register that a caretaker has taken charge."""
        self._unattended_since_s.setdefault(vehicle, t_s)

    def on_agent(self, vehicle: Name) -> None:
        """Register that an agent has taken charge."""
        self._unattended_since_s.pop(vehicle, None)

    def on_lane_end(self, vehicle: Name, kind: str) -> None:
        """Register an event at the end of a lane."""
        if kind == events.LEFT_LATTICE:
            self._lane_ends[vehicle] = reasons.STOPPED
        elif kind == events.MISSED_EXIT:
            self._lane_ends[vehicle] = reasons.MISSED_EXIT

    def pop(
        self, vehicle: Name, t_s: float, *, planned: bool | None, leader_until_s: float | None
    ) -> dict[str, object]:
        """Forget a vehicle that has left; return the reasons for the event `left-off-lane`.

        Args:
            vehicle: its name.
            t_s: road time.
            planned: whether the process in charge has accepted a plan; None: the method makes none.
            leader_until_s: road time of the newest heartbeat of a leader; None: there was none.
        """
        since_s = self._unattended_since_s.pop(vehicle, None)
        lane_end = self._lane_ends.pop(vehicle, None)
        if planned is None:
            return {}
        leaderless = leader_until_s is None or t_s > leader_until_s + self.leaderless_after_s
        if lane_end is not None:
            reason = lane_end
        elif since_s is not None:
            reason = reasons.NO_AGENT
        elif not planned:
            reason = reasons.NO_LEADER if leaderless else reasons.NO_PLAN
        else:
            reason = reasons.PLANNED
        return {
            "reason": reason,
            "unattended_since_s": since_s,
            "leader_until_s": leader_until_s,
        }
