"""What an observer has received at one moment, and which processes should be there."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from attrs import field, frozen

from laneweave.launch.observe.process_view import ProcessToken
from laneweave.launch.observe.road_view import Coordinator, RoadView
from laneweave.protocol.config.participants import coordinator_names
from laneweave.protocol.scenario.deployment_fields import Shard, parse_shard
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.road_geometry import first_moves_m
from laneweave.protocol.wire.process_messages import RoadStatus
from laneweave.protocol.wire.topics import ROLES, Party

BRIDGE, COORDINATOR, FLEET, AGENT = (
    ROLES[party] for party in (Party.BRIDGE, Party.COORDINATOR, Party.FLEET, Party.VEHICLE)
)


UNPLANNED_S = 20.0
"""Road time for which a closed formation, or a vehicle that may move, may be without a plan."""


@frozen
class Expected:
    """Processes that should be there, and their settings."""

    bridge: bool = False
    coordinators: tuple[str, ...] = ()
    """Names of the candidates; empty: any."""
    fleets: Mapping[str, Shard] = field(factory=dict)
    """Shards of the fleets by name."""
    vehicles: tuple[str, ...] = ()
    """Vehicles whose agents should be there."""

    @classmethod
    def of(cls, scenario: Scenario, *, bridge: bool, default: bool = False) -> Expected:
        """Return what a scenario expects.

        Args:
            scenario: settings of the deployment.
            bridge: whether its road should be there.
            default: whether they are only default settings, which name no coordinators.
        """
        fleets = {
            name: parse_shard(members, "security.fleets")
            for name, members in scenario.security.fleets.items()
            if isinstance(members, str)
        }
        return cls(bridge, () if default else coordinator_names(scenario), fleets)


NOTHING = Expected()
"""Nothing is expected."""


@frozen
class Observed:
    """What an observer knows at one moment."""

    view: RoadView
    expected: Expected
    began_s: float
    """When observation began, on the clock of the observer."""
    now_s: float
    wall_s: float
    """Wall-clock time of the observer [s since 1970]."""
    election_s: float

    @property
    def ended(self) -> bool:
        """Whether the road has ended in good order."""
        return self.view.clock is not None and self.view.clock.ended

    @property
    def status(self) -> RoadStatus | None:
        """Status of the newest bridge; None: none was received, as from an earlier release."""
        return self.view.processes.road_statuses.get(self.view.bridge)

    @property
    def candidates(self) -> list[Coordinator]:
        """Coordinators with a token or a recent heartbeat."""
        return self.view.candidates(self.now_s, self.election_s)

    @property
    def fleets(self) -> dict[str, Shard]:
        """Shards that should have a process, by name: of the file, and those of the tokens."""
        if self.expected.fleets:
            return dict(self.expected.fleets)
        counts = {shard.count for shard in self.shards_present().values()}
        return {
            shard.name: shard
            for count in counts
            for shard in (Shard(index, count) for index in range(count))
        }

    def shards_present(self) -> dict[ProcessToken, Shard]:
        """Return the shards of the fleets with tokens."""
        fleets = (one for one in self.view.processes.tokens if one.role == FLEET)
        shards = ((one, Shard.named(one.drives)) for one in fleets)
        return {one: shard for one, shard in shards if shard is not None}

    def unattended(self) -> dict[str, float]:
        """Return for how long each vehicle on the road has been without an agent [s]."""
        status, view = self.status, self.view
        if status is not None:
            return {str(vehicle): for_s for vehicle, for_s in status.unattended.items()}
        # A bridge of the release before: its caretakers say so in the states of the vehicles.
        listed = {one.vehicle for one in view.census.on_road} if view.census is not None else ()
        return {
            vehicle: self.now_s - self.began_s
            for vehicle, state in view.states.items()
            if vehicle in listed and not state.attended
        }

    @property
    def planned_from_m(self) -> float | None:
        """Position at which a vehicle of the rolling operation has been able to move for 20 s [m].

        From the settings of the bridge. None: they are unknown, formations are planned, or the road
        has exits: vehicles that prefer an exit's lane wait until it opens.
        """
        settings = self.view.processes.settings.get((BRIDGE, BRIDGE, self.view.bridge))
        if settings is None:
            return None

        def value(name: str) -> Any:  # noqa: ANN401 (any JSON)
            return json.loads(settings.values[name])

        try:
            if value("formation.operation") != "rolling" or value("exit"):
                return None
            speed_mps = float(value("formation.speed_mps"))
            begin_m = first_moves_m(
                float(value("road.s1_m")),
                float(value("road.s2_m")),
                speed_mps,
                float(value("formation.settle_s")),
                in_s2=bool(value("formation.sort_in_s2")),
            )
        except (KeyError, OverflowError, TypeError, ValueError):
            return None  # of another release
        return begin_m + UNPLANNED_S * speed_mps

    def unheard_s(self, bridge: int) -> float:
        """Return the time since a bridge was heard last, or since observation began."""
        return self.now_s - self.view.processes.bridges_heard_s.get(bridge, self.began_s)
