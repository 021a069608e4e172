"""Faults of the network: partitions, hindered messages, blackouts, loss of the router."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import attrs

from laneweave.launch.fault_search.events.fault_context import LONG_S, FaultContext
from laneweave.protocol.transports.simulated.virtual_time import Conditions
from laneweave.protocol.wire.topics import (
    CENSUS,
    CLOCK,
    COMMAND,
    HEARTBEAT,
    PLAN,
    PREPARE,
    SENSE,
    STATE,
    Keys,
    Topic,
)

ONE_WAY = 0.3
"""Share of partitions that block messages in one direction only."""
ALL_LOST = 0.6
"""Share of hindrances in which all messages are lost."""
HINDRANCE_S = (0.1, 4.0)
"""Range of the additional delays otherwise."""
THE_TARGET = 0.3
"""Share of hindrances that concern the target of the event, rather than any process."""
_HINDERED = (CENSUS, CLOCK, COMMAND, HEARTBEAT, PLAN, PREPARE, SENSE, STATE)


class NetworkFaults:
    """Faults of the network of one run; each returns whether it had an effect."""

    def __init__(self, context: FaultContext, conditions: Conditions, keys: Keys) -> None:
        """Prepare faults of a network with lasting conditions, and keys of a realm."""
        self._context = context
        self._conditions = conditions
        self._keys = keys
        self._hindrances: list[Callable[[str, str, str], float]] = []
        self._blackouts = 0

    def partition(self, _: str) -> bool:
        """Block messages between two groups of nodes, in one direction or both."""
        rng = self._context.rng
        names = self._context.network.names
        inside = frozenset(rng.sample(names, rng.randint(1, len(names) - 1)))
        one_way = rng.random() < ONE_WAY

        def delay_s(sender: str, receiver: str, _: str) -> float:
            leaves, arrives = sender in inside, receiver in inside
            blocked = leaves and not arrives if one_way else leaves != arrives
            return math.inf if blocked else 0.0

        relation = "cannot send to" if one_way else "separated from"
        self._context.log(f"--- {' '.join(sorted(inside))}: {relation} the others")
        self.hinder(delay_s, "a partition ends")
        return True

    def mute(self, target: str) -> bool:
        """Delay or drop the messages of one kind from or to a process."""
        rng = self._context.rng
        name = target if rng.random() < THE_TARGET else rng.choice(self._context.network.names)
        topic = rng.choice(_HINDERED)
        extra_s = math.inf if rng.random() < ALL_LOST else rng.uniform(*HINDRANCE_S)
        sends = rng.random() < 0.5

        def delay_s(sender: str, receiver: str, key: str) -> float:
            concerned = (sender if sends else receiver) == name
            return extra_s if concerned and self._is_about(key, topic) else 0.0

        self._context.log(
            f"--- {topic.name} {'from' if sends else 'to'} {name}: {extra_s:.2f} s late"
        )
        self.hinder(delay_s, f"{topic.name} is no longer hindered")
        return True

    def _is_about(self, key: str, topic: Topic) -> bool:
        known = self._keys.read(key)
        return known is not None and known[0] is topic

    def hinder(self, delay_s: Callable[[str, str, str], float], what: str) -> None:
        """Delay messages for some time; `what` describes the end."""
        self._hindrances.append(delay_s)
        self._apply_hindrances()
        self._context.later(LONG_S, partial(self._end_hindrance, delay_s), what)

    def _end_hindrance(self, delay_s: Callable[[str, str, str], float]) -> None:
        self._hindrances.remove(delay_s)
        self._apply_hindrances()

    def _apply_hindrances(self) -> None:
        all_of_them = tuple(self._hindrances)

        def delay_s(sender: str, receiver: str, key: str) -> float:
            return max(each(sender, receiver, key) for each in all_of_them)

        self._context.network.hinder(delay_s if all_of_them else None)

    def blackout(self, _: str) -> bool:
        """Drop all messages for some time."""
        self._blackouts += 1
        self._context.network.conditions = attrs.evolve(self._conditions, loss=1.0)
        self._context.later(LONG_S, self._end_blackout, "a blackout ends")
        return True

    def _end_blackout(self) -> None:
        self._blackouts -= 1
        if not self._blackouts:
            self._context.network.conditions = self._conditions

    def lose_router(self, _: str) -> bool:
        """Disconnect all processes for some time."""
        self._context.network.lose_router()
        self._context.later(LONG_S, self._context.network.restore_router, "the router returns")
        return True
