"""Leadership as reported by heartbeats."""

from __future__ import annotations

from attrs import define, field

from laneweave.protocol.wire.messages import Heartbeat, Name


@define
class Leadership:
    """The leader, and the changes of leaders."""

    election_s: float
    """Silence after which another process may lead [s, on the node's clock]."""
    leader: tuple[Name, int] | None = None
    """Name and incarnation."""
    until_s: float | None = None
    """Road time of the newest heartbeat of a leader; None: there was none."""
    changes: int = 0
    recovery_s: list[float] = field(factory=list)
    """Periods without a leader [s, on the node's clock]."""
    _term: int = 0
    _heartbeat_s: float = 0.0

    def on_heartbeat(
        self, heartbeat: Heartbeat, t_s: float, now_s: float
    ) -> dict[str, object] | None:
        """Register a heartbeat; return the data of the event `leader` if it is from a new one.

        A leader that was paused claims to lead until it hears of its successor, which has a higher
        term: this is no change.

        Args:
            heartbeat: a heartbeat of any coordinator.
            t_s: road time.
            now_s: the node's clock.
        """
        if not heartbeat.leading:
            return None
        sender = (heartbeat.coordinator, heartbeat.incarnation)
        silence_s = now_s - self._heartbeat_s
        if self.leader is not None and sender != self.leader:
            outdated = heartbeat.term <= self._term
            if outdated and silence_s < self.election_s:
                return None
            self.changes += 1
            self.recovery_s.append(round(silence_s, 4))
        data: dict[str, object] | None = None
        if sender != self.leader:
            self.leader = sender
            data = {"coordinator": heartbeat.coordinator, "term": heartbeat.term}
            data["leader_until_s"] = self.until_s
        self._term, self._heartbeat_s, self.until_s = heartbeat.term, now_s, t_s
        return data
