"""Observed processes of a deployment: tokens, settings, and what the bridge says about its road.

For observers; `road_view` has the road and its coordinators.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from attrs import define, field, frozen

from laneweave.protocol.runtime.node import PeerDown, PeerUp
from laneweave.protocol.wire.messages import Census, RoadClock
from laneweave.protocol.wire.process_messages import ProcessSettings, RoadStatus
from laneweave.protocol.wire.topics import PROCESS_ALIVE, incarnation_of

MAX_SENDERS = 1000
"""Maximum number of senders that are remembered, so that a forger cannot fill the memory."""


@frozen
class OtherVersion:
    """A message of another version arrived, which this release cannot read."""

    sender: str
    """Role and name of its sender, as far as its key tells."""
    version: object


@frozen
class ProcessToken:
    """Token of a process that acts on a road, with what it says about the process."""

    role: str
    name: str
    incarnation: int
    """Start time of the process [ns]."""
    drives: str
    """Vehicles whose agents it starts: the shard `I-of-N`, `named` ones, or `none`."""
    digests: str
    """Digests of its settings; see `wire.common_settings`."""

    @classmethod
    def of(cls, parameters: Mapping[str, str]) -> ProcessToken:
        """Return the token with these parameters of its key."""
        return cls(
            parameters["role"],
            parameters["name"],
            incarnation_of(parameters),
            parameters["drives"],
            parameters["digests"],
        )

    @property
    def label(self) -> str:
        """Role and name."""
        return label_of(self.role, self.name)


def label_of(role: str, name: str) -> str:
    """Return the words for a process: its role and name, for a bridge its role."""
    return role if role == name else f"{role} {name}"


@define
class ProcessView:
    """The processes of a deployment according to their tokens and messages."""

    tokens: set[ProcessToken] = field(factory=set)
    settings: dict[tuple[str, str, int], ProcessSettings] = field(factory=dict)
    """Newest settings of each process (role, name, incarnation) that publishes them: of bridges,
    and of processes that do not fit."""
    road_statuses: dict[int, RoadStatus] = field(factory=dict)
    """Newest status of each bridge."""
    bridges_heard_s: dict[int, float] = field(factory=dict)
    """When each bridge was heard last."""
    other_versions: dict[str, object] = field(factory=dict)
    """Senders of messages that this release cannot read, and their versions."""

    def update(self, event: object, now_s: float) -> None:
        """Process a message or an event; ignore those that are not about processes."""
        match event:
            case RoadClock() | Census():
                _put(self.bridges_heard_s, event.bridge, now_s)
            case RoadStatus():
                _put(self.bridges_heard_s, event.bridge, now_s)
                _put(self.road_statuses, event.bridge, event)
            case ProcessSettings():
                _put(self.settings, (event.role, event.name, event.incarnation), event)
            case OtherVersion():
                _put(self.other_versions, event.sender, event.version)
            case PeerUp(topic, parameters) if topic is PROCESS_ALIVE:
                if len(self.tokens) < MAX_SENDERS:
                    self.tokens.add(ProcessToken.of(parameters))
            case PeerDown(topic, parameters) if topic is PROCESS_ALIVE:
                self.tokens.discard(ProcessToken.of(parameters))
            case _:
                pass


def _put(known: dict[Any, Any], key: object, value: object) -> None:
    if key in known or len(known) < MAX_SENDERS:
        known[key] = value
