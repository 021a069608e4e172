"""An observer of a realm for tests: what it receives, and what it concludes."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from attrs import define, field

from laneweave.launch.observe.findings import Finding, Findings
from laneweave.launch.observe.observed import NOTHING, Expected
from laneweave.launch.observe.road_view import RoadView
from laneweave.launch.observe.status import Status, status_of
from laneweave.protocol.runtime.node import Arrived, PeerDown, PeerUp
from laneweave.protocol.runtime.settings_check import Process
from laneweave.protocol.wire import topics
from laneweave.protocol.wire.common_settings import CommonSettings
from laneweave.protocol.wire.identities import Identity
from laneweave.protocol.wire.messages import (
    Census,
    CensusEntry,
    ClosedFormation,
    Heartbeat,
    Name,
    RoadClock,
)
from laneweave.protocol.wire.process_messages import ProcessSettings, RoadStatus
from laneweave.protocol.wire.topics import Party
from support.states import holding

WALL_S = 1.8e9
"""Wall-clock time of the observer at second 0."""
BRIDGE = int(WALL_S * 1e9)
"""Incarnation of the bridge: its start time."""
ELECTION_S = 0.7


@define
class Listener:
    """Listens to a realm from second 0 on."""

    view: RoadView = field(factory=RoadView)

    def heartbeat(
        self, name: str, term: int, now_s: float, *, leading: bool = False, incarnation: int = 1
    ) -> None:
        message = Heartbeat(Name(name), incarnation, term, leading=leading, plans=2)
        self.view.update(Arrived(topics.HEARTBEAT, {"coordinator": name}, message), now_s)

    def coordinator(self, name: str, *, up: bool = True) -> None:
        kind = PeerUp if up else PeerDown
        self.view.update(
            kind(topics.COORDINATOR_ALIVE, {"coordinator": name, "incarnation": "1"}), 0.0
        )

    def bridge(self, *, up: bool = True, incarnation: int = BRIDGE) -> None:
        kind = PeerUp if up else PeerDown
        self.view.update(kind(topics.BRIDGE_ALIVE, {"incarnation": str(incarnation)}), 0.0)

    def process(
        self,
        identity: Identity,
        incarnation: int,
        settings: CommonSettings,
        drives: str = "none",
        *,
        up: bool = True,
    ) -> None:
        token = Process.of(identity, incarnation, drives).token(settings)
        parameters = {name: str(value) for name, value in token.items()}
        kind = PeerUp if up else PeerDown
        self.view.update(kind(topics.PROCESS_ALIVE, parameters), 0.0)

    def fleet(self, name: str, drives: str, settings: CommonSettings, *, up: bool = True) -> None:
        self.process(Identity(Party.FLEET, name), BRIDGE - 1, settings, drives, up=up)

    def settings(self, role: str, name: str, incarnation: int, settings: CommonSettings) -> None:
        values = dict(settings.values)
        message = ProcessSettings(Name(role), Name(name), incarnation, values)
        self.view.update(Arrived(topics.SETTINGS, {"role": role, "name": name}, message), 0.0)

    def road_status(self, now_s: float, bridge: int = BRIDGE, **fields: Any) -> None:  # noqa: ANN401
        message = RoadStatus(bridge, **{"clock_s": WALL_S + now_s} | fields)
        self.view.update(Arrived(topics.ROAD_STATUS, {}, message), now_s)

    def agent(self, vehicle: str) -> None:
        self.view.update(PeerUp(topics.VEHICLE_ALIVE, {"process": "p", "vehicle": vehicle}), 0.0)

    def clock(
        self,
        tick: int,
        *,
        ended: bool = False,
        bridge: int = BRIDGE,
        on_road: int = 1,
        at_s: float | None = None,
    ) -> None:
        message = RoadClock(
            tick, tick / 10, demanded=9, entered=5, on_road=on_road, left=4, ended=ended,
            bridge=bridge,
        )  # fmt: skip
        self.view.update(Arrived(topics.CLOCK, {}, message), tick / 10 if at_s is None else at_s)

    def census(
        self, tick: int, closed: tuple[ClosedFormation, ...] = (), **entered_s: float
    ) -> None:
        entries = tuple(CensusEntry(Name(one), (0, 0), 0, at) for one, at in entered_s.items())
        message = Census(tick / 10, entries, (), closed, bridge=BRIDGE)
        self.view.update(Arrived(topics.CENSUS, {}, message), tick / 10)

    def states(self, vehicle: str, ticks: Iterable[int], **changes: object) -> None:
        for tick in ticks:
            values: dict[str, Any] = {"promised": None, "speed_mps": 15.0, "t_s": tick / 10}
            state = holding(Name(vehicle), **values | changes)
            self.view.update(Arrived(topics.STATE, {"vehicle": vehicle}, state), tick / 10)

    def look(
        self,
        now_s: float = 2.0,
        expected: Expected = NOTHING,
        process: str | None = None,
        wall_s: float = WALL_S,
    ) -> list[Finding]:
        """Return what a single look finds."""
        findings = Findings(expected, 0.0, ELECTION_S, process)
        return findings.look(self.view, now_s, wall_s + now_s, last=True)

    def status(self, now_s: float = 2.0) -> Status:
        return status_of(self.view, self.look(now_s), 0.0, now_s, ELECTION_S)
