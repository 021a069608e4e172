"""Cores that record what they are handed, on a simulated network."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

from attrs import define, field

from laneweave.protocol.runtime import node
from laneweave.protocol.transports.simulated.network import SimulatedNetwork
from laneweave.protocol.transports.simulated.virtual_time import Conditions, Trace
from laneweave.protocol.wire.messages import Heartbeat, Name
from laneweave.protocol.wire.topics import HEARTBEAT, VEHICLE_ALIVE

REALM = "r"
CALM = Conditions(delay_s=0.002, jitter_s=0.0)
STORM = Conditions(
    jitter_s=0.05, loss=0.3, duplication=0.2, compute_jitter_s=0.1, compute_failure=0.3
)
Handler = Callable[[node.Event, float], Iterable[node.Effect]]


def no_effects(_: node.Event, __: float) -> Iterable[node.Effect]:
    return ()


@define
class Recorder:
    """A core that records every event and answers with what `on_event` says."""

    on_event: Handler = no_effects
    events: list[tuple[float, node.Event]] = field(factory=list)
    wakeup_s: float | None = None

    def handle(self, event: node.Event, now_s: float) -> Iterable[node.Effect]:
        self.events.append((now_s, event))
        return self.on_event(event, now_s)

    def of(self, *kinds: type) -> list[node.Event]:
        return [event for _, event in self.events if isinstance(event, kinds)]

    def times(self, kind: type) -> list[float]:
        return [now_s for now_s, event in self.events if isinstance(event, kind)]

    @property
    def numbers(self) -> list[int]:
        """Which beats arrived, in order."""
        return [event.message.term for _, event in self.events if isinstance(event, node.Arrived)]

    @property
    def tokens(self) -> list[str]:
        """`+name` and `-name` of each token that appeared or vanished."""
        signs = {node.PeerUp: "+", node.PeerDown: "-"}
        return [
            signs[type(event)] + event.parameters["vehicle"]
            for _, event in self.events
            if isinstance(event, (node.PeerUp, node.PeerDown))
        ]


def beat(number: int, sender: str = "a") -> node.Send:
    message = Heartbeat(Name(sender), 1, number, leading=False, plans=0)
    return node.Send(HEARTBEAT, message, {"coordinator": sender})


def at_start(*effects: node.Effect) -> Handler:
    return lambda event, _: effects if isinstance(event, node.Started) else ()


def token(name: str) -> node.Announce:
    return node.Announce(VEHICLE_ALIVE, {"process": name, "vehicle": name})


def listener() -> Recorder:
    return Recorder(at_start(node.Listen(HEARTBEAT), node.Watch(VEHICLE_ALIVE)))


def network_of(
    conditions: Conditions = CALM,
    seed: int = 1,
    more: Mapping[str, Recorder] | None = None,
    **cores: Recorder,
) -> SimulatedNetwork:
    """Return a network in which the cores have started."""
    network = SimulatedNetwork(seed, conditions)
    for name, core in (cores | dict(more or {})).items():
        network.add(name, core, REALM)
    network.run(0.1)
    return network


def send(network: SimulatedNetwork, name: str, *numbers: int) -> None:
    """Have a node send beats now."""
    perform(network, name, *(beat(number, name) for number in numbers))


def perform(network: SimulatedNetwork, name: str, *effects: node.Effect) -> None:
    """Have a node carry out effects now."""
    core = network.node(name).core
    assert isinstance(core, Recorder)
    before, core.on_event = core.on_event, lambda *_: effects
    network.node(name).dispatch(node.Wakeup(), network.now_s)
    core.on_event = before


def chatter(
    seed: int, conditions: Conditions, trace: Trace | None = None, *, skip_codec: bool = False
) -> tuple[list[list[tuple[float, node.Event]]], tuple[int, int]]:
    """Run nodes that talk, with all faults, and return what each saw."""

    def make(name: str) -> Recorder:
        core = Recorder()
        sent = 0

        def talk(event: node.Event, now_s: float) -> Iterable[node.Effect]:
            nonlocal sent
            if isinstance(event, node.Started):
                core.wakeup_s = now_s + 0.01
                return [node.Listen(HEARTBEAT), node.Watch(VEHICLE_ALIVE), token(name)]
            if isinstance(event, node.Wakeup):
                core.wakeup_s = now_s + 0.01
                sent += 1
                return [
                    beat(sent, name),
                    *([node.Compute(sent, lambda _: 1)] if sent % 10 == 0 else []),
                ]
            return ()

        core.on_event = talk
        return core

    cores = {name: make(name) for name in ("a", "b", "c")}
    network = SimulatedNetwork(seed, conditions, skip_codec=skip_codec)
    network.trace = trace
    for name, core in cores.items():
        network.add(name, core, REALM)
    network.at(0.1, network.set_clock, "c", 0.05, 0.95)
    network.at(0.2, network.pause, "a")
    network.at(0.5, network.disconnect, "b")
    network.at(0.7, network.reconnect, "b")
    network.at(0.9, network.resume, "a")
    network.at(1.0, network.lose_router)
    network.at(1.1, network.restore_router)
    network.at(2.2, network.kill, "c")
    network.run(2.6)
    return [core.events for core in cores.values()], (network.dropped, network.delivered)
