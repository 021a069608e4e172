"""Several vehicle agents in one process (`--vehicles-per-process`), and agents on announcement."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterable, Iterator

from attrs import frozen

from laneweave.agents.core import AgentCore
from laneweave.protocol.messages import Census, Name, VehicleState
from laneweave.protocol.node import (
    Arrived,
    Effect,
    End,
    Event,
    Listen,
    Started,
    Stopping,
    Unlisten,
    Wakeup,
)
from laneweave.protocol.topics import CENSUS, STATE

IDLE_S = 60.0
"""An agent whose vehicle says nothing for this long (node clock) ends."""


@frozen
class Shard:
    """Which of the announced vehicles a host takes: those whose name falls to `index`."""

    index: int
    count: int

    def takes(self, vehicle: str) -> bool:
        """Tell whether a vehicle belongs to this shard, alike in every process."""
        return zlib.crc32(vehicle.encode()) % self.count == self.index


class AgentHost:
    """The core of an agent process: hands events to the vehicles that they concern."""

    def __init__(
        self,
        make_agent: Callable[[Name], AgentCore],
        vehicles: Iterable[Name] = (),
        shard: Shard | None = None,
    ) -> None:
        """Host named vehicles, or with a `shard` every announced vehicle that falls to it."""
        self._make_agent = make_agent
        self._shard = shard
        self._agents: dict[Name, AgentCore] = {name: make_agent(name) for name in vehicles}
        self._seen: set[Name] = set(self._agents)
        self._formations: set[int] = set()
        self._heard_s = 0.0

    @property
    def wakeup_s(self) -> float | None:
        """When to give up for want of news."""
        return None if self._shard is not None else self._heard_s + IDLE_S

    def handle(self, event: Event, now_s: float) -> Iterator[Effect]:
        """Take an event; see `Core`."""
        hosted = bool(self._agents)
        yield from self._on_event(event, now_s)
        yield from self._listen_to_formations()
        if hosted and not self._agents and self._shard is None:
            yield End()  # last: nothing can be undone on a network that the node has left

    def _on_event(self, event: Event, now_s: float) -> Iterator[Effect]:
        match event:
            case Started():
                self._heard_s = now_s
                if self._shard is not None:
                    yield Listen(CENSUS)
                for agent in self._agents.values():
                    yield from agent.handle(event, now_s)
            case Arrived(_, _, Census() as census):
                yield from self._on_census(census, now_s)
            case Arrived(_, _, VehicleState() as state):
                for agent in self._agents.values():
                    if agent.formation == state.formation:
                        yield from agent.handle(event, now_s)
            case Arrived(_, parameters, _) if parameters.get("vehicle") in self._agents:
                self._heard_s = now_s
                yield from self._hand_on(event, Name(parameters["vehicle"]), now_s)
            case Wakeup() if self._shard is None and now_s >= self._heard_s + IDLE_S:
                yield End()
            case Stopping():
                for agent in self._agents.values():
                    yield from agent.handle(event, now_s)
            case _:
                pass

    def _hand_on(self, event: Event, name: Name, now_s: float) -> Iterator[Effect]:
        yield from self._agents[name].handle(event, now_s)
        if self._agents[name].ended:
            del self._agents[name]

    def _on_census(self, census: Census, now_s: float) -> Iterator[Effect]:
        shard = self._shard
        if shard is None:
            return
        announced = [entry.vehicle for entry in census.announced]
        for name in announced + [entry.vehicle for entry in census.on_road]:
            if name not in self._seen and shard.takes(name):
                self._seen.add(name)
                self._agents[name] = self._make_agent(name)
                yield from self._agents[name].handle(Started(), now_s)

    def _listen_to_formations(self) -> Iterator[Effect]:
        """Subscribe to the states that matter now, and only to those.

        They are most of the traffic, and most of the time nobody waits for anybody.
        """
        wanted = {
            agent.formation
            for agent in self._agents.values()
            if agent.formation is not None and agent.needs_states
        }
        for number in sorted(self._formations - wanted):
            yield Unlisten(STATE, {"formation": number})
        for number in sorted(wanted - self._formations):
            yield Listen(STATE, {"formation": number})
        self._formations = wanted
