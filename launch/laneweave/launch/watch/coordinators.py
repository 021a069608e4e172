"""Who stands for leader, and who leads, as heartbeats say."""

from __future__ import annotations

from attrs import define, field, frozen

from laneweave.protocol.wire.messages import Heartbeat, Name

REMEMBERED_S = 60.0
"""A candidate that has fallen silent is shown as such for this long (wall clock)."""
MOST = 32
"""Candidates that are shown; there are 9 at most."""


@frozen
class Candidate:
    """One candidate, as it was last heard."""

    name: Name
    term: int
    leading: bool
    silent: bool
    """Not heard for longer than an election takes."""


@define
class Candidates:
    """The candidates that have been heard."""

    election_s: float
    """A candidate that is not heard for this long is none (wall clock)."""
    _heard: dict[Name, tuple[Heartbeat, float]] = field(factory=dict)

    def on_heartbeat(self, heartbeat: Heartbeat, now_s: float) -> None:
        """Take a heartbeat; those of an earlier process of the same name are ignored."""
        known = self._heard.get(heartbeat.coordinator)
        if known is None or heartbeat.incarnation >= known[0].incarnation:
            self._heard[heartbeat.coordinator] = (heartbeat, now_s)

    def now(self, now_s: float) -> list[Candidate]:
        """Return the candidates by name, those that fell silent a short time ago among them."""
        self._heard = {
            name: (heartbeat, heard_s)
            for name, (heartbeat, heard_s) in self._heard.items()
            if now_s - heard_s <= REMEMBERED_S
        }
        return [
            Candidate(
                name,
                heartbeat.term,
                leading=heartbeat.leading and not silent,
                silent=silent,
            )
            for name, (heartbeat, heard_s) in sorted(self._heard.items())[:MOST]
            for silent in (now_s - heard_s > self.election_s,)
        ]


def leader_of(candidates: list[Candidate]) -> Candidate | None:
    """Return who leads: of several, the one with the highest term."""
    return max((one for one in candidates if one.leading), key=lambda one: one.term, default=None)
