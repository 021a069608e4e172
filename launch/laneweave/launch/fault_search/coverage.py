"""Coverage of rules and guards, and the choice of profiles that reach what is rarely reached.

A *feature* is a rule that was applied, or a guard of a rule that was false, for example
`V6 tick (move): not is_released`.
"""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

from attrs import define, evolve, field, frozen

from laneweave.coordinator.formations.leader import LEADER_RULES
from laneweave.coordinator.rolling.transfer import TRANSFER_RULES
from laneweave.protocol.state_machine import Function, RuleBook, Transition
from laneweave.protocol.vehicle.execution_rules import VEHICLE_RULES

ADOPTION = "leader L2 STATE to in force"
"""Feature of a leader that adopts a plan."""
PLANNING = "leader L5 promised to planning"
"""Feature of a leader that has received all promises."""
UNIFORM_SHARE = 0.3
"""Share of the runs whose profiles are equally likely."""

OnReached = Callable[[str, Any], None]
"""Called with each feature that is reached, and the state machine, after the transition."""


@frozen
class Rules:
    """Rule books of a run, which tests replace with faulty ones."""

    vehicle: RuleBook = VEHICLE_RULES
    leader: RuleBook = LEADER_RULES
    """Rules of leaders of formations."""
    transfer: RuleBook = TRANSFER_RULES
    """Rules of leaders of cell transfers (rolling operation)."""

    def observed(self, on_reached: OnReached) -> Rules:
        """Return the same rules, which report what they reach."""
        return Rules(
            _observed("vehicle", self.vehicle, on_reached),
            _observed("leader", self.leader, on_reached),
            _observed("transfer", self.transfer, on_reached),
        )


def all_features() -> Iterator[str]:
    """Yield all features of the rule books in use."""
    rules = Rules()
    for name, book in (
        ("vehicle", rules.vehicle),
        ("leader", rules.leader),
        ("transfer", rules.transfer),
    ):
        for row in book.table:
            yield _feature(name, row)
            yield from (f"{_feature(name, row)}: not {guard.__name__}" for guard in row.guards)


def _feature(book: str, row: Transition) -> str:
    phases = "" if row.target is None else f" to {row.target.value}"
    return f"{book} {row.rule} {row.event}{phases}"


def _observed(name: str, book: RuleBook, on_reached: OnReached) -> RuleBook:
    return RuleBook(_observed_row(_feature(name, row), row, on_reached) for row in book.table)


def _observed_row(feature: str, row: Transition, on_reached: OnReached) -> Transition:
    def applied(machine: object, message: object) -> None:
        del message
        on_reached(feature, machine)

    def observed(guard: Function) -> Function:
        refused = f"{feature}: not {guard.__name__}"

        def recorded(machine: object, message: object) -> bool:
            holds = bool(guard(machine, message))
            if not holds:
                on_reached(refused, machine)
            return holds

        return recorded

    guards = tuple(observed(guard) for guard in row.guards)
    return evolve(row, guards=guards, actions=(*row.actions, applied))


@define
class Coverage:
    """How many runs have reached each feature, and what the runs of each profile have reached."""

    runs: Counter[str] = field(factory=Counter)
    """Number of runs by feature."""
    _by_profile: dict[str, Counter[str]] = field(factory=dict)
    _costs: Counter[str] = field(factory=Counter)
    """Number of delivered messages by profile."""

    def add(self, profile: str, features: Iterable[str], cost: int) -> None:
        """Add a run with a profile, the features that it reached, and its delivered messages."""
        reached = list(features)
        self.runs.update(reached)
        self._by_profile.setdefault(profile, Counter()).update(reached)
        self._costs[profile] += cost

    @property
    def never_reached(self) -> list[str]:
        """Features that no run has reached."""
        return [feature for feature in dict.fromkeys(all_features()) if not self.runs[feature]]

    def weight(self, profile: str) -> float:
        """Return how much runs of a profile contribute to rarely reached features, per message."""
        reached = self._by_profile.get(profile, Counter[str]())
        rarity = sum(count / self.runs[feature] for feature, count in reached.items())
        return rarity / max(self._costs[profile], 1)

    def choose(self, profiles: Sequence[str], count: int, seed: int) -> list[str]:
        """Choose the profiles of the next runs; those that reach rare features are more likely.

        The first runs use all profiles in turn.
        """
        rng = random.Random(f"profiles/{seed}")  # noqa: S311 (simulation, no secrets)
        if not self._by_profile:
            return [profiles[number % len(profiles)] for number in range(count)]
        weights = [self.weight(name) for name in profiles]
        mean = sum(weights) / len(weights)
        mixed = [UNIFORM_SHARE * mean + (1.0 - UNIFORM_SHARE) * weight for weight in weights]
        return rng.choices(profiles, mixed, k=count)
