"""Messages that no process sends now: malformed, absurd, old or changed ones."""

from __future__ import annotations

import random
from collections import Counter, deque
from collections.abc import Callable

import attrs
from attrs import define, field

from laneweave.launch.fault_search.events.fault_context import FaultContext
from laneweave.launch.fault_search.events.forgeries import Harm, absurd, harmful, malformed
from laneweave.protocol.runtime.node import Send
from laneweave.protocol.wire.codec import encode
from laneweave.protocol.wire.messages import (
    Ballot,
    Census,
    Name,
    Plan,
    Prepare,
    RoadClock,
    VehicleState,
)
from laneweave.protocol.wire.topics import TOPICS, Keys

GARBAGE = 20
"""Number of malformed or absurd messages per event."""
REPLAYED = 20
"""Number of old messages per event."""
REPEATS, REPEAT_S = 10, 0.1
"""Number of times, and interval, in which late messages of one kind arrive."""
OLD_MESSAGES = 60
"""Maximum number of old messages of each kind to keep for replay or corruption."""
KEEP_EVERY = 7
"""One in this many sent messages of each kind is kept."""


@define
class _OldMessages:
    """Some of the messages sent so far, by kind."""

    _counts: Counter[type] = field(factory=Counter)
    _kept: dict[type, deque[Send]] = field(factory=dict)

    def add(self, effect: Send) -> None:
        kind = type(effect.message)
        self._counts[kind] += 1
        if self._counts[kind] % KEEP_EVERY == 0 or isinstance(effect.message, (Plan, Prepare)):
            self._kept.setdefault(kind, deque(maxlen=OLD_MESSAGES)).append(effect)

    def drawn(self, rng: random.Random, kind: type | None = None) -> Send | None:
        """Return an old message of a kind, or of any kind."""
        if kind is None:
            if not self._kept:
                return None
            kind = rng.choice(list(self._kept))
        kept = self._kept.get(kind)
        return rng.choice(kept) if kept else None

    def of_earlier_processes(self) -> list[Send]:
        """Return the kept states of processes that are not the newest of their vehicles."""
        newest: dict[Name, int] = {}
        states = [
            (effect, effect.message)
            for effect in self._kept.get(VehicleState, ())
            if isinstance(effect.message, VehicleState)
        ]
        for _, state in states:
            newest[state.vehicle] = max(newest.get(state.vehicle, 0), state.record.incarnation)
        return [
            effect for effect, state in states if state.record.incarnation < newest[state.vehicle]
        ]


class InjectedMessages:
    """Injected and changed messages of one run; each event returns whether it had an effect."""

    def __init__(
        self,
        context: FaultContext,
        keys: Keys,
        harmed: dict[Ballot, Harm],
        on_changed: Callable[[], None],
    ) -> None:
        """Prepare the messages of a run.

        Args:
            context: network and generator.
            keys: keys of the realm.
            harmed: receives the plans that were changed.
            on_changed: called when a plan is changed.
        """
        self._context = context
        self._keys = keys
        self._harmed = harmed
        self._on_changed = on_changed
        self._old = _OldMessages()
        self._harm_next: list[random.Random] = []
        """Generators of events that change the next plan."""
        self._forged: dict[Ballot, Plan] = {}
        """Changed plans."""
        self._issued: set[Ballot] = set()
        """Ballots of the plans sent so far."""

    def keep(self, effect: Send) -> None:
        """Keep some of the sent messages."""
        self._old.add(effect)

    def heal(self) -> None:
        """Change no more plans; plans that were changed stay so."""
        self._harm_next.clear()

    def garbage(self, _: str) -> bool:
        """Publish payloads that are not valid messages for their keys."""
        for _number in range(GARBAGE):
            self._context.network.inject(*self._malformed())
        return True

    def _malformed(self) -> tuple[str, bytes]:
        """Return random bytes, or a real message that has been made invalid, with a key."""
        rng = self._context.rng
        old = self._old.drawn(rng)
        if old is None or rng.random() < 0.3:
            return self._random_key(), rng.randbytes(rng.randint(0, 60))
        key, payload = self._encoded(old)
        if rng.random() < 0.3:
            return self._random_key(), payload[: rng.randrange(len(payload))]
        return key, malformed(payload, rng)

    def _random_key(self) -> str:
        rng = self._context.rng
        parts = [
            rng.choice(self._context.network.names) if part.startswith("{") else part
            for part in rng.choice(TOPICS).pattern.split("/")
        ]
        return "/".join(("laneweave", self._keys.realm, *parts))

    def _encoded(self, effect: Send) -> tuple[str, bytes]:
        return self._keys.key(effect.topic, **effect.parameters), encode(effect.message)

    def absurd(self, _: str) -> bool:
        """Publish well-formed messages with numbers that no correct sender has."""
        done = False
        for _number in range(GARBAGE):
            old = self._old.drawn(self._context.rng)
            message = None if old is None else absurd(old.message, self._context.rng)
            if old is not None and message is not None:
                self._context.network.inject(*self._encoded(attrs.evolve(old, message=message)))
                done = True
        return done

    def replay(self, _: str) -> bool:
        """Deliver old messages again, as very late duplicates."""
        for _number in range(REPLAYED):
            self._inject(self._old.drawn(self._context.rng))
        return self._old.drawn(self._context.rng) is not None

    def repeat_census(self, _: str) -> bool:
        """Deliver an old census again and again."""
        return self._repeat_old(Census)

    def repeat_clock(self, _: str) -> bool:
        """Deliver an old clock message again and again."""
        return self._repeat_old(RoadClock)

    def _repeat_old(self, kind: type) -> bool:
        """Deliver one old message of a kind again and again."""
        old = self._old.drawn(self._context.rng, kind)
        for number in range(REPEATS):
            self._context.network.at(
                self._context.network.now_s + number * REPEAT_S, self._inject, old
            )
        return old is not None

    def repeat_states(self, _: str) -> bool:
        """Deliver states of earlier processes again and again."""
        late = self._old.of_earlier_processes()
        for number in range(REPEATS if late else 0):
            at_s = self._context.network.now_s + number * REPEAT_S
            self._context.network.at(at_s, self._inject, self._context.rng.choice(late))
        return bool(late)

    def _inject(self, effect: Send | None) -> None:
        if effect is not None and not self._context.healed:
            self._context.network.inject(*self._encoded(effect))

    def change_next_plan(self, _: str) -> bool:
        """Change the next plan in one respect, so that vehicles must refuse it."""
        self._harm_next.append(self._context.new_rng())
        return False  # counted when the plan is sent

    def changed(self, effect: Send) -> Send:
        """Return a sent message, which is another one if it is a plan that was changed."""
        plan = effect.message
        if not isinstance(plan, Plan):
            return effect
        if self._harm_next and plan.ballot not in self._issued:
            change = harmful(plan, self._harm_next[0])
            if change is not None:
                del self._harm_next[0]
                self._forged[plan.ballot], self._harmed[plan.ballot] = change
                self._context.log(f"--- a plan is changed: {change[1].text}")
                self._on_changed()
        self._issued.add(plan.ballot)
        forged = self._forged.get(plan.ballot)
        return effect if forged is None else attrs.evolve(effect, message=forged)
