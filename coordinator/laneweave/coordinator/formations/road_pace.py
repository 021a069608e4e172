"""Ratio of road time to the clock of this process, for deadlines of planning."""

from __future__ import annotations

from attrs import define, field

EVERY_S = 2.0
"""Measurement window (node clock)."""
SLOWEST = 0.1
"""Lowest pace returned, so that deadlines stay finite while the road stands still."""


@define
class RoadPace:
    """Measures the pace of the road from the arrival times of its clock messages."""

    pace: float = field(default=1.0, init=False)
    """Road seconds per second of the node's clock, as measured last."""
    _since: tuple[float, float] | None = field(default=None, init=False)
    """Road time and node clock when the measurement under way began."""

    def on_clock(self, t_s: float, now_s: float) -> None:
        """Process a clock message.

        Args:
            t_s: road time; a smaller one than before restarts the measurement.
            now_s: node clock.
        """
        if self._since is None or t_s < self._since[0]:
            self._since = t_s, now_s
            return
        road_s, node_s = t_s - self._since[0], now_s - self._since[1]
        if node_s >= EVERY_S:
            self.pace = max(road_s / node_s, SLOWEST)
            self._since = t_s, now_s

    def node_s(self, road_s: float) -> float:
        """Convert a duration in road time to one of the node's clock, in seconds."""
        return road_s / self.pace
