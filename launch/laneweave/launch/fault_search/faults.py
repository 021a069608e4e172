"""Random faults of a run: drawn from its seed, applied to its network, and counted."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from typing import Protocol

import attrs
from attrs import frozen

from laneweave.launch.fault_search.profiles import Profile
from laneweave.protocol.errors import BadInputError
from laneweave.protocol.transports.simulated.network import SimulatedNetwork
from laneweave.protocol.transports.simulated.virtual_time import Conditions
from laneweave.protocol.wire.codec import decode
from laneweave.protocol.wire.topics import TOPICS

ROAD = "road"
"""Name of the road's node."""
FIRST_S = 0.3
"""Earliest time of a fault event."""
SHORT_S = (0.05, 2.5)
"""Range of times for which a process is dead, paused or disconnected."""
LONG_S = (0.3, 4.0)
"""Range of durations of network faults."""
NO_RESTART = 0.25
"""Share of killed agents that are restarted only after the fault phase."""
LEASE_S = 0.5
COMPUTE_S = 0.05
GARBAGE = 20
"""Number of malformed payloads per event."""
REPLAYED = 20
"""Number of old messages per event."""
_TARGETED = ("leader", "coordinator", "agent", "cut")
"""Prefixes of the event kinds that have a target."""
CLOCK_OFFSET_S = 0.05
CLOCK_DRIFT = 0.05


@frozen
class FaultMix:
    """Faults throughout the fault phase of a run, and the number of its fault events."""

    conditions: Conditions
    command_loss: float
    slow_moves: float
    wrong_clocks: bool
    events: int
    fault_s: float

    @classmethod
    def drawn(cls, profile: Profile, rng: random.Random) -> FaultMix:
        """Draw a mix from a profile."""
        return cls(
            conditions=Conditions(
                loss=rng.choice(profile.loss),
                duplication=rng.choice(profile.duplication),
                jitter_s=rng.choice(profile.jitter_s),
                lease_s=LEASE_S,
                compute_s=COMPUTE_S,
                compute_jitter_s=rng.choice(profile.compute_jitter_s),
                compute_failure=rng.choice(profile.compute_failure),
            ),
            command_loss=rng.choice(profile.command_loss),
            slow_moves=rng.choice(profile.slow_moves),
            wrong_clocks=rng.random() < profile.wrong_clocks,
            events=rng.randint(*profile.events),
            fault_s=rng.uniform(*profile.fault_s),
        )

    def kinds(self) -> Counter[str]:
        """Return the kinds of faults that are present, each with count 1."""
        conditions = self.conditions
        present = {
            "loss": conditions.loss,
            "duplication": conditions.duplication,
            "reordering": conditions.jitter_s > 0.01,
            "late-planning": conditions.compute_jitter_s,
            "failing-planning": conditions.compute_failure,
            "lost-commands": self.command_loss,
            "slow-moves": self.slow_moves,
            "wrong-clocks": self.wrong_clocks,
        }
        return Counter(kind for kind, is_present in present.items() if is_present)


HEALTHY = Conditions(lease_s=LEASE_S, compute_s=COMPUTE_S)
"""Conditions after the fault phase."""


class Processes(Protocol):
    """Process operations needed by fault events."""

    coordinators: tuple[str, ...]

    @property
    def agents(self) -> tuple[str, ...]:
        """Agents of the vehicles that have not left the road."""

    @property
    def leaders(self) -> tuple[str, ...]:
        """Coordinators that consider themselves the leader."""

    def start(self, name: str) -> None:
        """Start a process unless it is running."""

    def start_twin(self, name: str) -> str:
        """Start a second process for the vehicle of an agent, and return its name."""

    def old_payload(self, rng: random.Random) -> tuple[str, bytes] | None:
        """Return the key and payload of a random old message, or None."""


class RandomFaults:
    """Fault events of a run, applied to the network and its nodes."""

    def __init__(
        self,
        network: SimulatedNetwork,
        processes: Processes,
        mix: FaultMix,
        rng: random.Random,
        realm: str,
        log: Callable[[str], None],
    ) -> None:
        """Prepare the faults of a run."""
        self.counts = mix.kinds()
        """Number of applied faults of each kind."""
        self.healed = False
        self._network = network
        self._processes = processes
        self._mix = mix
        self._rng = rng
        self._realm = realm
        self._log = log
        self._cuts: list[Callable[[str, str], bool]] = []
        self._blackouts = 0
        self._twins: list[str] = []

    def plan(self, kinds: Sequence[str]) -> None:
        """Draw the kinds and times of the fault events."""
        for _ in range(self._mix.events):
            time_s = self._rng.uniform(FIRST_S, self._mix.fault_s - 0.3)
            self._network.at(time_s, self._apply, self._rng.choice(kinds))

    def heal(self) -> None:
        """End all faults except wrong clocks."""
        self.healed = True
        self._log("--- all faults end")
        network = self._network
        network.conditions = HEALTHY
        network.cut(None)
        network.restore_router()
        for name in self._twins:
            network.kill(name)
        for name in network.names:
            # A resumed node processes its queued messages, and may exit.
            network.resume(name)
            self._if_present(name, network.reconnect)
        for name in (*self._processes.coordinators, *self._processes.agents):
            self._processes.start(name)

    def _apply(self, kind: str) -> None:
        target = self._target(kind)
        of = f" of {target}" if kind.startswith(_TARGETED) else ""
        self._log(f"--- fault: {kind}{of}")
        match kind:
            case "leader-kill" | "coordinator-kill" | "agent-kill":
                done = self._kill(target, may_stay_dead=kind == "agent-kill")
            case "agent-twin":
                done = self._start_twin(target)
            case "leader-pause" | "coordinator-pause" | "agent-pause":
                done = self._pause(target)
            case "cut":
                done = self._disconnect(target)
            case "partition":
                done = self._partition()
            case "blackout":
                done = self._blackout()
            case "router-loss":
                done = self._lose_router()
            case "garbage":
                done = self._garbage()
            case "replay":
                done = self._replay()
            case _:
                raise ValueError(f"unknown fault: {kind}")
        self.counts[kind] += done

    def _target(self, kind: str) -> str:
        rng, processes = self._rng, self._processes
        if kind.startswith("leader"):
            return rng.choice(processes.leaders or processes.coordinators)
        if kind.startswith("agent"):
            return rng.choice(processes.agents or ("none",))
        if kind == "cut":
            return rng.choice(self._network.names)
        return rng.choice(processes.coordinators)

    def _later(self, span_s: tuple[float, float], action: Callable[[], None], what: str) -> None:
        """Schedule the end of a fault; skipped if all faults have already ended."""
        time_s = self._network.now_s + self._rng.uniform(*span_s)
        self._network.at(time_s, self._undo, action, what)

    def _undo(self, action: Callable[[], None], what: str) -> None:
        if not self.healed:
            self._log(f"--- {what}")
            action()

    # --- processes ----------------------------------------------------------------------------

    def _kill(self, name: str, *, may_stay_dead: bool) -> bool:
        if name not in self._network:
            return False
        self._network.kill(name)
        if not (may_stay_dead and self._rng.random() < NO_RESTART):
            self._later(SHORT_S, partial(self._processes.start, name), f"{name} is restarted")
        return True

    def _pause(self, name: str) -> bool:
        if name not in self._network:
            return False
        self._network.pause(name)
        resume = partial(self._if_present, name, self._network.resume)
        self._later(SHORT_S, resume, f"{name} resumes")
        return True

    def _start_twin(self, name: str) -> bool:
        """Start a second process for a vehicle; for some time, the first one receives no SENSE."""
        if name not in self._network:
            return False
        twin = self._processes.start_twin(name)
        if twin in self._twins:
            return False
        self._twins.append(twin)

        def blocked(sender: str, receiver: str) -> bool:
            return sender == ROAD and receiver == name

        self._cuts.append(blocked)
        self._apply_cuts()
        self._later(LONG_S, partial(self._join, blocked), f"{name} receives SENSE again")
        victim = self._rng.choice((name, twin))
        kill = partial(self._if_present, victim, self._network.kill)
        self._later(LONG_S, kill, f"{victim} is killed")
        return True

    def _disconnect(self, name: str) -> bool:
        self._network.disconnect(name)
        reconnect = partial(self._if_present, name, self._network.reconnect)
        self._later(SHORT_S, reconnect, f"{name} is connected again")
        return True

    def _if_present(self, name: str, action: Callable[[str], None]) -> None:
        if name in self._network:
            action(name)

    # --- the network --------------------------------------------------------------------------

    def _partition(self) -> bool:
        """Block messages between two groups of nodes, in one direction or both."""
        rng = self._rng
        names = self._network.names
        inside = frozenset(rng.sample(names, rng.randint(1, len(names) - 1)))
        one_way = rng.random() < 0.3

        def blocked(sender: str, receiver: str) -> bool:
            if one_way:
                return sender in inside and receiver not in inside
            return (sender in inside) != (receiver in inside)

        self._cuts.append(blocked)
        self._apply_cuts()
        relation = "cannot send to" if one_way else "separated from"
        self._log(f"--- {' '.join(sorted(inside))}: {relation} the others")
        self._later(LONG_S, partial(self._join, blocked), "a partition ends")
        return True

    def _join(self, blocked: Callable[[str, str], bool]) -> None:
        self._cuts.remove(blocked)
        self._apply_cuts()

    def _apply_cuts(self) -> None:
        cuts = self._cuts
        self._network.cut(
            (lambda sender, receiver: any(cut(sender, receiver) for cut in cuts)) if cuts else None
        )

    def _blackout(self) -> bool:
        """Drop all messages for some time."""
        self._blackouts += 1
        self._network.conditions = attrs.evolve(self._mix.conditions, loss=1.0)
        self._later(LONG_S, self._end_blackout, "a blackout ends")
        return True

    def _end_blackout(self) -> None:
        self._blackouts -= 1
        if not self._blackouts:
            self._network.conditions = self._mix.conditions

    def _lose_router(self) -> bool:
        self._network.lose_router()
        self._later(LONG_S, self._network.restore_router, "the router returns")
        return True

    def _garbage(self) -> bool:
        """Publish payloads that are not valid messages for their keys."""
        for _ in range(GARBAGE):
            self._network.inject(*self._malformed())
        return True

    def _malformed(self) -> tuple[str, bytes]:
        """Return random bytes, or a real message that has been made invalid.

        A modified message that is still valid would be a forgery, which the protocol does not
        tolerate, because it trusts its senders (docs/SAFETY.md).
        """
        rng = self._rng
        old = self._processes.old_payload(rng)
        if old is None or rng.random() < 0.3:
            return self._random_key(), rng.randbytes(rng.randint(0, 60))
        key, payload = old
        if rng.random() < 0.3:
            return self._random_key(), payload[: rng.randrange(len(payload))]
        damaged = bytearray(payload)
        for _ in range(rng.randint(1, 4)):
            damaged[rng.randrange(len(damaged))] = rng.randrange(256)
        try:
            decode(bytes(damaged))
        except BadInputError:
            return key, bytes(damaged)
        return key, payload[:-1]

    def _random_key(self) -> str:
        rng = self._rng
        pattern = rng.choice(TOPICS).pattern
        parts = [
            rng.choice(self._network.names) if part.startswith("{") else part
            for part in pattern.split("/")
        ]
        return "/".join(("laneweave", self._realm, *parts))

    def _replay(self) -> bool:
        """Deliver old messages again, as very late duplicates."""
        done = False
        for _ in range(REPLAYED):
            old = self._processes.old_payload(self._rng)
            if old is not None:
                self._network.inject(*old)
                done = True
        return done
