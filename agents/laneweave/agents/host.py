"""Core of an agent process, for named vehicles or for a shard of the announced vehicles."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import ClassVar

from attrs import frozen

from laneweave.agents.core import AgentCore
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.road_layout import NO_PARTS
from laneweave.protocol.runtime.metrics import MetricsSnapshot, metric
from laneweave.protocol.runtime.node import (
    Announce,
    Arrived,
    Effect,
    End,
    Event,
    Listen,
    PeerDown,
    PeerUp,
    Refuse,
    Started,
    Stopping,
    Unlisten,
    Wakeup,
    Watch,
    Withdraw,
)
from laneweave.protocol.scenario.deployment_fields import Runtime, Shard
from laneweave.protocol.wire.messages import Census, Motion, Name, Sense, VehicleState
from laneweave.protocol.wire.newest import NewestRoad
from laneweave.protocol.wire.obstacle_messages import Obstacles
from laneweave.protocol.wire.topics import (
    BRIDGE_ALIVE,
    CENSUS,
    MOTION,
    OBSTACLES,
    PLAN,
    PREPARE,
    SENSE,
    STATE,
    VEHICLE_ALIVE,
    Topic,
    incarnation_of,
)

NO_BRIDGE_S = 60.0
"""Time without a bridge after which a process for named vehicles exits (node clock)."""
RETURN_S = 1.0
"""Time after a SENSE that reports that a vehicle has left (node clock). Within it, a newer SENSE
shows that the vehicle is still there; later, a census does."""


@frozen
class AgentMetrics:
    """Counters for the vehicles of one process."""

    ABOUT: ClassVar[str] = "agent"

    vehicles: int = metric("Vehicles that this process has agents for")
    vehicles_in_charge: int = metric("Vehicles on the road that this process is in charge of")
    solves_total: int = metric("Tracker solves, one for each SENSE")
    unusable_total: int = metric("Tracker solves without a usable result")


class AgentHost:
    """Core of an agent process: dispatches each event to the agents that it concerns."""

    def __init__(
        self,
        process: Name,
        make_agent: Callable[[Name], AgentCore],
        incarnation: int,
        runtime: Runtime,
        vehicles: Iterable[Name] = (),
        shard: Shard | None = None,
    ) -> None:
        """Host the named vehicles, or all announced vehicles of a shard.

        Args:
            process: name of this process, to which messages to its vehicles are addressed.
            make_agent: returns the agent of a vehicle.
            incarnation: of this process; bounds those that it receives.
            runtime: tick, and limits of road time.
            vehicles: names of the vehicles; empty with a shard.
            shard: share of the announced vehicles.
        """
        self._process = process
        self._make_agent = make_agent
        self._shard = shard
        self._agents: dict[Name, AgentCore] = {name: make_agent(name) for name in vehicles}
        self._seen: set[Name] = set(self._agents)
        self._subscribed: dict[Topic, set[int]] = {MOTION: set(), STATE: set()}
        """Stretches and blocks subscribed to."""
        self._motions: list[tuple[int, ...]] = []
        """Stretches whose motions each vehicle needed at the last update."""
        self._states: list[tuple[int, ...]] = []
        """Blocks whose states each vehicle needed at the last update."""
        self._bounds = runtime.bounds(incarnation)
        self._road = NewestRoad(runtime.max_pace)
        self._no_bridge_since_s: float | None = 0.0
        """Time at which the bridge was lost; None: a bridge is up."""
        self._left: dict[Name, tuple[float, int]] = {}
        """When it was reported that vehicles have left (node clock), and in which tick."""
        self._obstacles: Obstacles | None = None
        self._solves = self._unusable = 0
        """Counters of agents that have been removed."""

    @property
    def metrics(self) -> tuple[MetricsSnapshot, ...]:
        """Counters summed over all agents."""
        agents = self._agents.values()
        stats = [agent.solver_stats for agent in agents]
        return (
            AgentMetrics(
                vehicles=len(agents),
                vehicles_in_charge=sum(agent.in_charge for agent in agents),
                solves_total=self._solves + sum(each.solves for each in stats),
                unusable_total=self._unusable + sum(each.unusable for each in stats),
            ),
        )

    @property
    def wakeup_s(self) -> float | None:
        """Time at which a process for named vehicles exits, as far as known; None for a shard."""
        if self._shard is not None:
            return None
        if not self._agents and self._left:
            return max(at_s for at_s, _ in self._left.values()) + RETURN_S
        if self._no_bridge_since_s is None:
            return None
        return self._no_bridge_since_s + NO_BRIDGE_S

    def handle(self, event: Event, now_s: float) -> list[Effect]:
        """Handle an event; see `Core`."""
        if isinstance(event, Arrived) and isinstance(event.message, Motion):
            for agent in self._receivers(event):  # changes no subscription
                agent.on_motion(event.message)
            return []
        try:
            if isinstance(event, Arrived):
                effects = self._on_message(event, now_s)
            else:
                effects = self._on_event(event, now_s)
                self._update_subscriptions(effects)
        except BadInputError as error:
            return [Refuse(error)]
        return effects

    def listeners(self, message: Motion | VehicleState) -> list[Name]:
        """Return the other vehicles of this process that need a message of a vehicle now."""
        if isinstance(message, Motion):
            needing = (
                name
                for name, agent in self._agents.items()
                if message.stretch in agent.wanted_motions
            )
        else:
            needing = (
                name for name, agent in self._agents.items() if message.block in agent.wanted_states
            )
        return [name for name in needing if name != message.vehicle]

    def _receivers(self, event: Arrived) -> list[AgentCore]:
        """Return the agents that need a message of another vehicle and have received it."""
        return [
            self._agents[name]
            for name in self.listeners(event.message)
            if event.vehicles is None or name in event.vehicles
        ]

    def _on_event(self, event: Event, now_s: float) -> list[Effect]:
        match event:
            case Started():
                self._no_bridge_since_s = now_s
                effects: list[Effect] = [Watch(BRIDGE_ALIVE), Listen(OBSTACLES)]
                if self._shard is not None:
                    effects.append(Listen(CENSUS))
                own = {"process": self._process}
                effects += [Listen(topic, own) for topic in (SENSE, PREPARE, PLAN)]
                # Last: a process that sees a token may rely on the subscriptions.
                return effects + [
                    Announce(VEHICLE_ALIVE, self._token(name)) for name in self._agents
                ]
            case PeerUp(topic, parameters) if topic is BRIDGE_ALIVE:
                incarnation = incarnation_of(parameters)
                self._bounds.check_incarnation(incarnation, now_s)
                return self._on_bridge(incarnation, now_s) if incarnation >= 0 else []
            case PeerDown(topic, parameters) if topic is BRIDGE_ALIVE:
                return self._on_bridge_down(incarnation_of(parameters), now_s)
            case Wakeup() if self.wakeup_s is not None and now_s >= self.wakeup_s:
                return [End()]
            case Stopping():
                return self._dispatch_to_all(event, now_s)
            case _:
                pass
        return []

    def _on_message(self, event: Arrived, now_s: float) -> list[Effect]:
        message = event.message
        if isinstance(message, VehicleState):
            effects, changed = [], False
            for agent in self._receivers(event):
                wanted = agent.wanted_states
                effects += agent.handle(event, now_s)
                changed = changed or agent.wanted_states != wanted
            if changed:
                self._update_subscriptions(effects)
            return effects
        if isinstance(message, Obstacles):
            self._on_obstacles(message, now_s)
            return []
        if isinstance(message, Census):
            effects = self._on_census(message, now_s)
            self._update_subscriptions(effects)
            return effects
        name = Name(event.parameters.get("vehicle", ""))
        if name in self._agents:
            return self._dispatch(event, name, now_s)
        if isinstance(message, Sense) and name in self._left and not message.left:
            _, tick = self._left[name]
            if message.tick > tick:
                return [self._start(name), *self._dispatch(event, name, now_s)]
        return []

    def _dispatch_to_all(self, event: Event, now_s: float) -> list[Effect]:
        effects: list[Effect] = []
        for agent in self._agents.values():
            effects += agent.handle(event, now_s)
        return effects

    def _on_bridge(self, incarnation: int, now_s: float) -> list[Effect]:
        """Handle a bridge's token; agents of named vehicles detect a new bridge by its SENSE."""
        known = self._road.bridge
        self._road.on_token_up(incarnation, now_s)
        if self._road.bridge == incarnation:
            self._no_bridge_since_s = None
        return [] if self._road.bridge == known or known < 0 else self._leave_road()

    def _on_bridge_down(self, incarnation: int, now_s: float) -> list[Effect]:
        known = self._road.bridge
        self._road.on_token_down(incarnation, now_s)
        if self._road.bridge != known:
            return self._leave_road()  # an earlier bridge still has its token
        if incarnation == known:
            self._no_bridge_since_s = now_s
        return []

    def _leave_road(self) -> list[Effect]:
        """End all agents of a shard, because its road is another one."""
        effects: list[Effect] = []
        self._obstacles = None
        for agent in self._agents.values():
            agent.on_obstacles(NO_PARTS)
        if self._shard is not None:
            for name in list(self._agents):
                effects += self._remove(name)
            self._seen.clear()
        return effects

    def _token(self, name: Name) -> dict[str, Name]:
        """Return the parameters of the token of a vehicle's agent."""
        return {"process": self._process, "vehicle": name}

    def _remove(self, name: Name) -> list[Effect]:
        """Remove an agent, let it leave, and keep its counters."""
        agent = self._agents.pop(name)
        stats = agent.solver_stats
        self._solves += stats.solves
        self._unusable += stats.unusable
        return [*agent.leave(), Withdraw(VEHICLE_ALIVE, self._token(name))]

    def _dispatch(self, event: Arrived, name: Name, now_s: float) -> list[Effect]:
        agent = self._agents[name]
        wanted = agent.wanted_motions, agent.wanted_states
        effects = agent.handle(event, now_s)
        if agent.ended:
            effects += self._remove(name)
            self._left[name] = now_s, event.message.tick
        # Not after every message, since an update iterates over all agents.
        if agent.ended or wanted != (agent.wanted_motions, agent.wanted_states):
            self._update_subscriptions(effects)
        return effects

    def _start(self, name: Name) -> Effect:
        """Start the agent of a vehicle, perhaps of one that was reported to have left."""
        self._left.pop(name, None)
        self._agents[name] = self._make_agent(name)
        if self._obstacles is not None:
            self._agents[name].on_obstacles(self._obstacles.temporary)
        return Announce(VEHICLE_ALIVE, self._token(name))

    def _on_obstacles(self, message: Obstacles, now_s: float) -> None:
        """Pass the parts of lanes that are closed now to all agents."""
        self._bounds.check(message, self._road.latest_s(now_s), now_s)
        newest = self._obstacles
        if message.bridge not in (0, self._road.bridge) and self._road.bridge > 0:
            return
        if newest is None or message.bridge != newest.bridge or message.t_s >= newest.t_s:
            self._obstacles = message
            for agent in self._agents.values():
                agent.on_obstacles(message.temporary)

    def _on_census(self, census: Census, now_s: float) -> list[Effect]:
        effects: list[Effect] = []
        shard, road = self._shard, self._road
        if shard is None or census.bridge not in (0, road.bridge):
            return effects
        self._bounds.check(census, road.latest_s(now_s), now_s)
        road.on_message(census.bridge, census.t_s, now_s)
        if census.t_s < road.t_s:
            return effects  # late
        listed = dict.fromkeys(entry.vehicle for entry in census.announced)
        listed |= dict.fromkeys(entry.vehicle for entry in census.on_road)
        for name in listed:
            is_back = name in self._left and now_s >= self._left[name][0] + RETURN_S
            if is_back or (name not in self._seen and shard.contains(name)):
                effects.append(self._start(name))
        for name in sorted(set(self._agents) - set(listed)):
            # The vehicle has left, and the SENSE that reports it was lost.
            effects += self._remove(name)
        self._seen = set(listed)
        self._left = {name: when for name, when in self._left.items() if name in listed}
        return effects

    def _update_subscriptions(self, effects: list[Effect]) -> None:
        """Subscribe only to the motions and states that are needed now.

        States make up most of the traffic, and vehicles rarely need each other's.
        """
        motions = [agent.wanted_motions for agent in self._agents.values()]
        states = [agent.wanted_states for agent in self._agents.values()]
        if motions != self._motions:
            self._motions = motions
            effects += self._subscribe(MOTION, motions)
        if states != self._states:
            self._states = states
            effects += self._subscribe(STATE, states)

    def _subscribe(self, topic: Topic, numbers: Iterable[Iterable[int]]) -> list[Effect]:
        before, wanted = self._subscribed[topic], {one for each in numbers for one in each}
        self._subscribed[topic] = wanted
        parameter = topic.parameters[0]
        return [
            *(Unlisten(topic, {parameter: number}) for number in sorted(before - wanted)),
            *(Listen(topic, {parameter: number}) for number in sorted(wanted - before)),
        ]
