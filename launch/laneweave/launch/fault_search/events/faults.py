"""Fault events of a run: applied to its processes, network and messages, and counted.

Each event has its own seed, so that removing one event does not change the others.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable, Mapping

from attrs import define, field, frozen

from laneweave.launch.fault_search.events.fault_context import ROAD, FaultContext
from laneweave.launch.fault_search.events.forgeries import Harm
from laneweave.launch.fault_search.events.injected_messages import InjectedMessages
from laneweave.launch.fault_search.events.lasting_faults import HEALTHY, LastingFaults
from laneweave.launch.fault_search.events.network_faults import NetworkFaults
from laneweave.launch.fault_search.events.process_faults import Processes, ProcessFaults
from laneweave.launch.fault_search.profiles import Profile
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.runtime.node import Send
from laneweave.protocol.transports.simulated.network import SimulatedNetwork
from laneweave.protocol.wire.messages import Ballot, Command, Plan, Prepare, VehicleState
from laneweave.protocol.wire.topics import Keys

FIRST_S = 0.3
"""Earliest time of a fault event."""
LAST_S = 0.3
"""Time before the end of the fault phase after which no fault event begins."""
MAX_SKIPPED = 4
"""Maximum number of messages that a triggered fault ignores."""
TRIGGER_DELAY_S = (0.0, 0.0, 0.002, 0.05, 0.3)
"""Possible delays between a trigger and its fault."""
TRIGGERED_KINDS = ("kill", "pause", "cut", "twin", "mute")
_TARGETED = ("leader", "coordinator", "agent", "cut")
"""Prefixes of the event kinds that have a target."""


@frozen
class FaultEvent:
    """One fault of a run."""

    t_s: float
    kind: str = field()
    seed: int

    @kind.validator
    def _is_known(self, _: object, kind: str) -> None:
        if kind not in ACTIONS:
            raise BadInputError("kind", kind, ", ".join(ACTIONS))


def draw_events(profile: Profile, fault_s: float, rng: random.Random) -> tuple[FaultEvent, ...]:
    """Draw the fault events of a run from a profile."""
    events = [
        FaultEvent(
            rng.uniform(FIRST_S, fault_s - LAST_S),
            rng.choice(profile.event_kinds),
            rng.randrange(2**32),
        )
        for _ in range(rng.randint(*profile.events))
    ]
    return tuple(sorted(events, key=lambda event: event.t_s))


def _is_promise(message: object) -> bool:
    return (
        isinstance(message, VehicleState)
        and message.record.promised is not None
        and not message.accepted
    )


def _is_acceptance(message: object) -> bool:
    return isinstance(message, VehicleState) and message.accepted and not message.go


def _is_opening(message: object) -> bool:
    return isinstance(message, VehicleState) and message.go and not message.moving


def _is_motion(message: object) -> bool:
    return isinstance(message, VehicleState) and message.moving


def _is_transfer(message: object) -> bool:
    return (
        isinstance(message, Command)
        and message.record.transfer is not None
        and message.record.transfer.open == (message.tick % 2 == 0)
    )


def _is_prepare(message: object) -> bool:
    return isinstance(message, Prepare)


def _is_plan(message: object) -> bool:
    return isinstance(message, Plan)


_TRIGGERS: tuple[Callable[[object], bool], ...] = (
    _is_promise,
    _is_acceptance,
    _is_opening,
    _is_motion,
    _is_transfer,
    _is_prepare,
    _is_plan,
)


@define
class _TriggeredFault:
    """A fault that happens when a message of some kind is sent."""

    trigger: Callable[[object], bool]
    skip: int
    """Number of such messages to ignore first."""
    kind: str
    delay_s: float
    rng: random.Random


class RandomFaults:
    """Fault events of a run."""

    def __init__(
        self,
        network: SimulatedNetwork,
        processes: Processes,
        lasting: LastingFaults,
        realm: str,
        harmed: dict[Ballot, Harm],
        log: Callable[[str], None],
    ) -> None:
        """Prepare the faults of a run; `harmed` receives the plans that were changed."""
        self.counts = lasting.kinds()
        """Number of applied faults of each kind."""
        self._context = FaultContext(network, log)
        keys = Keys(realm)
        self.network = NetworkFaults(self._context, lasting.conditions, keys)
        self.processes = ProcessFaults(self._context, processes, self.network.hinder)
        self.messages = InjectedMessages(self._context, keys, harmed, self._count_changed_plan)
        self._all_processes = processes
        self._waiting: list[_TriggeredFault] = []

    @property
    def healed(self) -> bool:
        """Whether all faults have ended."""
        return self._context.healed

    def plan(self, events: Iterable[FaultEvent]) -> None:
        """Schedule the fault events."""
        for event in events:
            self._context.network.at(event.t_s, self.apply, event)

    def heal(self) -> None:
        """End all faults except wrong clocks; clocks no longer jump."""
        network = self._context.network
        self._context.healed = True
        self._context.log("--- all faults end")
        network.conditions = HEALTHY
        network.hinder(None)
        network.restore_router()
        self._waiting.clear()
        self.messages.heal()
        self.processes.heal()

    def on_sent(self, sender: str, effect: Send) -> None:
        """Keep some messages, and apply a fault that this one triggers."""
        if self.healed:
            return
        self.messages.keep(effect)
        for fault in self._waiting:
            if not fault.trigger(effect.message):
                continue
            fault.skip -= 1
            if fault.skip >= 0:
                continue
            self._waiting.remove(fault)
            victim = self._victim(sender, effect.parameters, fault.rng)
            at_s = self._context.network.now_s + fault.delay_s
            self._context.network.at(at_s, self._apply_triggered, fault, victim)
            return

    def apply(self, event: FaultEvent) -> None:
        """Apply a fault event now."""
        kind = event.kind
        self._context.rng = random.Random(event.seed)  # noqa: S311 (simulation, no secrets)
        target = self._target(kind)
        of = f" of {target}" if kind.startswith(_TARGETED) else ""
        self._context.log(f"--- fault: {kind}{of}")
        self.counts[kind] += ACTIONS[kind](self)(target)

    def _target(self, kind: str) -> str:
        rng, processes = self._context.rng, self._all_processes
        if kind.startswith("leader"):
            return rng.choice(processes.leaders or processes.coordinators)
        if kind.startswith("agent"):
            return rng.choice(processes.agents or ("none",))
        if kind == "cut":
            return rng.choice(self._context.network.names)
        return rng.choice(processes.coordinators)

    def wait_for_trigger(self, _: str) -> bool:
        """Let a process fail when a message of some kind is sent."""
        rng = self._context.rng
        self._waiting.append(
            _TriggeredFault(
                rng.choice(_TRIGGERS),
                rng.randint(0, MAX_SKIPPED),
                rng.choice(TRIGGERED_KINDS),
                rng.choice(TRIGGER_DELAY_S),
                self._context.new_rng(),
            )
        )
        return True

    def _victim(self, sender: str, parameters: Mapping[str, object], rng: random.Random) -> str:
        """Return the sender of a message or the vehicle that it is about."""
        names = sorted({sender, str(parameters.get("vehicle", sender))} - {ROAD})
        return rng.choice(names or [sender])

    def _apply_triggered(self, fault: _TriggeredFault, victim: str) -> None:
        if self._context.healed:
            return
        self._context.rng = fault.rng
        self._context.log(f"--- triggered: {fault.kind} of {victim}")
        match fault.kind:
            case "kill":
                self.processes.kill(victim)
            case "pause":
                self.processes.pause(victim)
            case "cut":
                self.processes.disconnect(victim)
            case "twin":
                self.processes.start_twin(victim)
            case _:
                self.network.mute(victim)

    def _count_changed_plan(self) -> None:
        self.counts["harmful-plan"] += 1


ACTIONS: Mapping[str, Callable[[RandomFaults], Callable[[str], bool]]] = {
    "leader-kill": lambda faults: faults.processes.kill,
    "coordinator-kill": lambda faults: faults.processes.kill,
    "all-coordinators-kill": lambda faults: faults.processes.kill_coordinators,
    "agent-kill": lambda faults: faults.processes.kill_agent,
    "agent-twin": lambda faults: faults.processes.start_twin,
    "leader-pause": lambda faults: faults.processes.pause,
    "coordinator-pause": lambda faults: faults.processes.pause,
    "agent-pause": lambda faults: faults.processes.pause,
    "agent-refused": lambda faults: faults.processes.refuse,
    "agent-clock-jump": lambda faults: faults.processes.jump_clock,
    "coordinator-clock-jump": lambda faults: faults.processes.jump_clock,
    "cut": lambda faults: faults.processes.disconnect,
    "road-restart": lambda faults: faults.processes.restart_road,
    "triggered": lambda faults: faults.wait_for_trigger,
    "harmful-plan": lambda faults: faults.messages.change_next_plan,
    "partition": lambda faults: faults.network.partition,
    "blackout": lambda faults: faults.network.blackout,
    "router-loss": lambda faults: faults.network.lose_router,
    "mute": lambda faults: faults.network.mute,
    "garbage": lambda faults: faults.messages.garbage,
    "absurd": lambda faults: faults.messages.absurd,
    "replay": lambda faults: faults.messages.replay,
    "late-census": lambda faults: faults.messages.repeat_census,
    "late-clock": lambda faults: faults.messages.repeat_clock,
    "late-states": lambda faults: faults.messages.repeat_states,
}
"""Action of each kind of event, which takes the target and returns whether it had an effect."""
