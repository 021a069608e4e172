"""Faults of a simulated run: drawn from its seed, done to its network, and counted."""

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
"""No single event before this time."""
SHORT_S = (0.05, 2.5)
"""How long a process is away, or a node cut off."""
LONG_S = (0.3, 4.0)
"""How long nobody is heard."""
NEVER_AGAIN = 0.25
"""Share of killed agents that are not restarted before everything is made whole."""
LEASE_S = 0.5
COMPUTE_S = 0.05
GARBAGE = 20
"""Malformed payloads in one event."""
REPLAYED = 20
"""Old messages in one event."""
_CONCERNS_ONE = ("leader", "coordinator", "agent", "cut")
"""How the kinds begin that strike one process."""
CLOCK_OFFSET_S = 0.05
CLOCK_DRIFT = 0.05


@frozen
class Mix:
    """How hard one run is, all the time; single events come on top."""

    conditions: Conditions
    command_loss: float
    slow_moves: float
    wrong_clocks: bool
    events: int
    fault_s: float

    @classmethod
    def drawn(cls, profile: Profile, rng: random.Random) -> Mix:
        """Draw from a profile."""
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
        """Return which kinds of lasting faults it has."""
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
        return Counter(kind for kind, is_there in present.items() if is_there)


WHOLE = Conditions(lease_s=LEASE_S, compute_s=COMPUTE_S)
"""Conditions once everything is whole again."""


class Processes(Protocol):
    """What faults need to know of the processes of a world."""

    coordinators: tuple[str, ...]

    @property
    def agents(self) -> tuple[str, ...]:
        """Processes of the vehicles that have not left."""

    @property
    def leaders(self) -> tuple[str, ...]:
        """Coordinators that take themselves for the leader."""

    def start(self, name: str) -> None:
        """Start a process, unless it runs."""

    def start_twin(self, name: str) -> str:
        """Start a second process for an agent's vehicle, and return the name of its node."""

    def old_payload(self, rng: random.Random) -> tuple[str, bytes] | None:
        """Return a message that was sent some time ago, with its key."""


class Injector:
    """Does harm to the network and its nodes, and makes all of it good again."""

    def __init__(
        self,
        network: SimulatedNetwork,
        processes: Processes,
        mix: Mix,
        rng: random.Random,
        realm: str,
        note: Callable[[str], None],
    ) -> None:
        """Prepare the lasting faults; nothing happens to a process yet."""
        self.counts = mix.kinds()
        """How often each kind of fault was done."""
        self.healed = False
        self._network = network
        self._processes = processes
        self._mix = mix
        self._rng = rng
        self._realm = realm
        self._note = note
        self._cuts: list[Callable[[str, str], bool]] = []
        self._blackouts = 0
        self._twins: list[str] = []

    def plan(self, kinds: Sequence[str]) -> None:
        """Draw the single events of a run and when they happen."""
        for _ in range(self._mix.events):
            time_s = self._rng.uniform(FIRST_S, self._mix.fault_s - 0.3)
            self._network.at(time_s, self._harm, self._rng.choice(kinds))

    def heal(self) -> None:
        """Make everything whole: only clocks stay wrong."""
        self.healed = True
        self._note("--- everything is made whole")
        network = self._network
        network.conditions = WHOLE
        network.cut(None)
        network.restore_router()
        for name in self._twins:
            network.kill(name)
        for name in network.names:
            # Who wakes handles what has come meanwhile, and may leave for good.
            network.resume(name)
            self._if_there(name, network.reconnect)
        for name in (*self._processes.coordinators, *self._processes.agents):
            self._processes.start(name)

    def _harm(self, kind: str) -> None:
        target = self._target(kind)
        whom = f" of {target}" if kind.startswith(_CONCERNS_ONE) else ""
        self._note(f"--- fault: {kind}{whom}")
        match kind:
            case "leader-kill" | "coordinator-kill" | "agent-kill":
                done = self._kill(target, for_ever=kind == "agent-kill")
            case "agent-twin":
                done = self._double(target)
            case "leader-pause" | "coordinator-pause" | "agent-pause":
                done = self._pause(target)
            case "cut":
                done = self._unplug(target)
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
                raise ValueError(f"no such fault: {kind}")
        self.counts[kind] += done

    def _target(self, kind: str) -> str:
        rng, processes = self._rng, self._processes
        if kind.startswith("leader"):
            return rng.choice(processes.leaders or processes.coordinators)
        if kind.startswith("agent"):
            return rng.choice(processes.agents or ("nobody",))
        if kind == "cut":
            return rng.choice(self._network.names)
        return rng.choice(processes.coordinators)

    def _later(self, span_s: tuple[float, float], action: Callable[[], None], what: str) -> None:
        """Do something more after a while, unless everything has been made whole before."""
        time_s = self._network.now_s + self._rng.uniform(*span_s)
        self._network.at(time_s, self._undo, action, what)

    def _undo(self, action: Callable[[], None], what: str) -> None:
        if not self.healed:
            self._note(f"--- {what}")
            action()

    # --- processes ----------------------------------------------------------------------------

    def _kill(self, name: str, *, for_ever: bool) -> bool:
        if name not in self._network:
            return False
        self._network.kill(name)
        if not (for_ever and self._rng.random() < NEVER_AGAIN):
            self._later(SHORT_S, partial(self._processes.start, name), f"{name} is restarted")
        return True

    def _pause(self, name: str) -> bool:
        if name not in self._network:
            return False
        self._network.pause(name)
        resume = partial(self._if_there, name, self._network.resume)
        self._later(SHORT_S, resume, f"{name} wakes")
        return True

    def _double(self, name: str) -> bool:
        """Start a second process for a vehicle; the first one goes on, and may not sense that."""
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
        self._later(LONG_S, partial(self._join, blocked), f"{name} senses its vehicle again")
        victim = self._rng.choice((name, twin))
        kill = partial(self._if_there, victim, self._network.kill)
        self._later(LONG_S, kill, f"{victim} is killed")
        return True

    def _unplug(self, name: str) -> bool:
        self._network.disconnect(name)
        reconnect = partial(self._if_there, name, self._network.reconnect)
        self._later(SHORT_S, reconnect, f"{name} is on the network again")
        return True

    def _if_there(self, name: str, action: Callable[[str], None]) -> None:
        if name in self._network:
            action(name)

    # --- the network --------------------------------------------------------------------------

    def _partition(self) -> bool:
        """Part the nodes in two groups that do not hear each other, or only one way."""
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
        heard = "not heard by" if one_way else "apart from"
        self._note(f"--- {heard} the others: {' '.join(sorted(inside))}")
        self._later(LONG_S, partial(self._join, blocked), "a partition is over")
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
        """Lose every message for a while."""
        self._blackouts += 1
        self._network.conditions = attrs.evolve(self._mix.conditions, loss=1.0)
        self._later(LONG_S, self._end_blackout, "a blackout is over")
        return True

    def _end_blackout(self) -> None:
        self._blackouts -= 1
        if not self._blackouts:
            self._network.conditions = self._mix.conditions

    def _lose_router(self) -> bool:
        self._network.lose_router()
        self._later(LONG_S, self._network.restore_router, "the router is back")
        return True

    def _garbage(self) -> bool:
        """Put bytes on keys that are no messages, or not on these keys."""
        for _ in range(GARBAGE):
            self._network.inject(*self._malformed())
        return True

    def _malformed(self) -> tuple[str, bytes]:
        """Return random bytes, or a real message that was damaged so that it is none any more.

        A damaged message that still is well formed would be a lie: the protocol does not promise
        to survive those, and senders are trusted (docs/SAFETY.md).
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
        """Deliver old messages once more: a network that keeps duplicates for very long."""
        done = False
        for _ in range(REPLAYED):
            old = self._processes.old_payload(self._rng)
            if old is not None:
                self._network.inject(*old)
                done = True
        return done
