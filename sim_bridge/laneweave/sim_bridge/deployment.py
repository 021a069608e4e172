"""The deployment as its bridge sees it: processes that do not fit, fleets that can answer.

The bridge declares its settings (`wire.common_settings`), with which other processes compare
theirs. At the entrance it waits for an agent only if a process is there that can start it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping

from laneweave.protocol.runtime.node import (
    Announce,
    Arrived,
    Effect,
    Event,
    Listen,
    PeerDown,
    PeerUp,
    Send,
    Watch,
)
from laneweave.protocol.runtime.settings_check import PERIOD_S, Process
from laneweave.protocol.runtime.transport import LinkUp
from laneweave.protocol.scenario.common_settings import settings_of
from laneweave.protocol.scenario.deployment_fields import Shard
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.wire.common_settings import different_groups, groups_of
from laneweave.protocol.wire.events import SETTINGS_REFUSED
from laneweave.protocol.wire.identities import Identity
from laneweave.protocol.wire.messages import Name
from laneweave.protocol.wire.process_messages import ProcessSettings, RoadStatus
from laneweave.protocol.wire.topics import (
    PROCESS_ALIVE,
    ROAD_STATUS,
    ROLES,
    SETTINGS,
    VEHICLE_ALIVE,
    Party,
)
from laneweave.sim_bridge.recording.record_interface import Record

FLEET = ROLES[Party.FLEET]
MAX_PROCESSES = 1000
"""Maximum number of fleets that are remembered, and of processes that do not fit for which an event
is recorded."""

Key = tuple[str, str, str]
"""Role, name and incarnation of a process."""


class Deployment:
    """Other processes of a deployment."""

    def __init__(self, scenario: Scenario, incarnation: int, record: Record) -> None:
        """Begin without processes; `incarnation` is that of the bridge."""
        self._process = Process.of(Identity(Party.BRIDGE), incarnation)
        self._settings = settings_of(scenario)
        self._record = record
        self._start_s = scenario.runtime.agent_start_s
        self._short_s = scenario.network.resend_s
        self._lease_s = scenario.network.lease_s
        self._fleets: dict[Key, Shard] = {}
        """Shards of the fleets with tokens."""
        self._known_shards: dict[str, Shard] = {}
        """Shards of all fleets that have been there, by name."""
        self._has_fleets = False
        """Whether a fleet has ever been there: then all agents are started by fleets."""
        self._absence_counts_s = math.inf
        """Time from which a fleet without a token counts as absent."""
        self._failed: set[Key | None] = set()
        """Fleets that have not started an agent in time, until they start another one; None: the
        processes of single vehicles."""
        self._refused: set[Key] = set()
        self._unattended_since_s: dict[Name, float] = {}
        """When each vehicle was first seen without an agent."""
        self._publish_s = 0.0 if incarnation > 0 else math.inf

    # --- settings -----------------------------------------------------------------------------

    def start(self, now_s: float) -> Iterator[Effect]:
        """Declare the bridge, and watch others; nothing in simulated runs (incarnation 0)."""
        if self._process.incarnation > 0:
            self._absence_counts_s = now_s + self._lease_s
            yield Listen(SETTINGS)
            yield Watch(PROCESS_ALIVE, {"role": FLEET})
            yield Announce(PROCESS_ALIVE, self._process.token(self._settings))

    @property
    def wakeup_s(self) -> float:
        """When settings and status are published next."""
        return self._publish_s

    def publish(self, now_s: float, status: RoadStatus) -> Iterator[Effect]:
        """Publish the settings and a status."""
        self._publish_s = now_s + PERIOD_S
        yield self._process.settings_effect(self._settings)
        yield Send(ROAD_STATUS, status)

    def unattended(self, without: Iterable[Name], now_s: float) -> dict[Name, float]:
        """Return for how long each of the vehicles without agents has been without one [s]."""
        since_s = self._unattended_since_s
        self._unattended_since_s = {name: since_s.get(name, now_s) for name in without}
        return {name: now_s - at_s for name, at_s in self._unattended_since_s.items()}

    def on_event(self, event: Event, t_s: float, now_s: float) -> None:
        """Handle an event; ignore those that are not about other processes."""
        match event:
            case Arrived(_, _, ProcessSettings() as other):
                self._compare(other, t_s)
            case PeerUp(topic, parameters) if topic is PROCESS_ALIVE:
                self._on_fleet(parameters)
            case PeerDown(topic, parameters) if topic is PROCESS_ALIVE:
                self._fleets.pop(_key(parameters), None)
            case PeerUp(topic, parameters) if topic is VEHICLE_ALIVE:
                self._failed.difference_update(self._starters(parameters["vehicle"]))
            case LinkUp():
                # Other processes reconnect at about the same time.
                self._absence_counts_s = now_s + self._lease_s
            case _:
                pass

    def _compare(self, other: ProcessSettings, t_s: float) -> None:
        """Record the first settings of each process that differ from those of the bridge."""
        key = other.role, other.name, str(other.incarnation)
        if other.role == self._process.role or key in self._refused:
            return
        differences = self._settings.differences(other.values, groups_of(other.role))
        if differences and len(self._refused) < MAX_PROCESSES:
            self._refused.add(key)
            self._record.event(
                t_s,
                SETTINGS_REFUSED,
                process=f"{other.role} {other.name}",
                incarnation=other.incarnation,
                settings={one.name: [one.own, one.other] for one in differences},
            )

    # --- fleets -------------------------------------------------------------------------------

    def _on_fleet(self, parameters: Mapping[str, str]) -> None:
        shard, name = Shard.named(parameters["drives"]), parameters["name"]
        if shard is None or different_groups(self._settings.digests, parameters["digests"], FLEET):
            return
        self._has_fleets = True
        if len(self._fleets) < MAX_PROCESSES:
            self._fleets[_key(parameters)] = shard
        if len(self._known_shards) < MAX_PROCESSES or name in self._known_shards:
            self._known_shards[name] = shard

    def _starters(self, vehicle: str) -> list[Key | None]:
        """Return the processes that can start a vehicle's agent; None: one that is not known."""
        return [key for key, shard in self._fleets.items() if shard.contains(vehicle)] or [None]

    def fleet_of(self, vehicle: str) -> str:
        """Return the fleet that drives a vehicle, or last drove it; empty: none is known."""
        known = (name for name, shard in self._known_shards.items() if shard.contains(vehicle))
        return next(known, "")

    def wait_s(self, vehicle: Name, now_s: float) -> float:
        """Return how long the road waits for the agent of a vehicle at the entrance.

        After a process has not started an agent in time, the road waits only briefly for its
        others, until it starts one.
        """
        starters = self._starters(vehicle)
        if starters == [None] and self._has_fleets and now_s >= self._absence_counts_s:
            return 0.0
        if all(one in self._failed for one in starters):
            return self._short_s
        return self._start_s

    def on_missing(self, vehicle: Name) -> None:
        """Register that a vehicle's agent has not been started in time."""
        self._failed.update(self._starters(vehicle))


def _key(parameters: Mapping[str, str]) -> Key:
    return parameters["role"], parameters["name"], parameters["incarnation"]
