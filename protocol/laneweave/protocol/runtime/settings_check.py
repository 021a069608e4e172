"""A core that acts only on roads whose settings it shares.

Every process declares a token with the digests of its settings (`wire.common_settings`). A
process whose digests differ from those of a bridge does not fit: `CheckedCore` hides this bridge
from the wrapped core, as if it were not there, withdraws the core's tokens, and sends none of its
messages. The process keeps running, since the next bridge may fit. It logs which settings differ,
and publishes its own, so that the bridge and observers can tell.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

import structlog
from attrs import frozen

from laneweave.protocol.runtime.metrics import MetricsSnapshot, metric
from laneweave.protocol.runtime.node import (
    Announce,
    Arrived,
    Core,
    Effect,
    Event,
    Listen,
    PeerDown,
    PeerUp,
    Send,
    Started,
    Unlisten,
    Wakeup,
    Watch,
    Withdraw,
    core_metrics,
)
from laneweave.protocol.runtime.transport import LinkDown, LinkUp
from laneweave.protocol.wire.common_settings import (
    CommonSettings,
    different_groups,
    groups_of,
)
from laneweave.protocol.wire.identities import Identity
from laneweave.protocol.wire.messages import Name
from laneweave.protocol.wire.process_messages import ProcessSettings
from laneweave.protocol.wire.topics import (
    BRIDGE_ALIVE,
    PROCESS_ALIVE,
    ROLES,
    SETTINGS,
    Party,
    Topic,
    incarnation_of,
)

log = structlog.get_logger(__name__)

BRIDGE = ROLES[Party.BRIDGE]
WAIT_S = 0.5
"""Time for which a process waits for a bridge's digests; the release before declares none."""
PERIOD_S = 1.0
"""Period at which settings are published."""
MAX_BRIDGES = 100
"""Maximum number of bridges that a process remembers."""
_OF_BRIDGE = {"role": BRIDGE}


@frozen
class Process:
    """A process that acts on a road, as its token describes it."""

    role: Name
    name: Name
    incarnation: int
    """Start time of the process [ns]."""
    drives: str = "none"
    """Vehicles whose agents it starts: the shard `I-of-N`, `named` ones, or `none`."""

    @classmethod
    def of(cls, identity: Identity, incarnation: int, drives: str = "none") -> Process:
        """Return the process with an identity."""
        role = ROLES[identity.party]
        return cls(Name(role), Name(identity.name or role), incarnation, drives)

    def token(self, settings: CommonSettings) -> dict[str, object]:
        """Return the parameters of its token."""
        return {
            "role": self.role,
            "name": self.name,
            "incarnation": self.incarnation,
            "drives": self.drives,
            "digests": settings.digests,
        }

    def settings_effect(self, settings: CommonSettings) -> Effect:
        """Return the effect that publishes its settings."""
        values = dict(settings.values)
        message = ProcessSettings(self.role, self.name, self.incarnation, values)
        return Send(SETTINGS, message, {"role": self.role, "name": self.name})


@frozen
class SettingsMetrics:
    """Comparison of settings."""

    ABOUT: ClassVar[str] = "settings"

    fit: bool = metric("1 unless the settings differ from those of a bridge, else 0")


class CheckedCore:
    """A `Core` from which roads with other settings are hidden."""

    def __init__(
        self, core: Core, process: Process, settings: CommonSettings, acts_on: Topic
    ) -> None:
        """Wrap a core.

        Args:
            core: the core of an agent process or a coordinator.
            process: the process in which it runs.
            settings: settings of the process.
            acts_on: topic of the bridge's messages on which the core acts; it receives none from a
                bridge until the settings have been compared.
        """
        self.core = core
        self._process = process
        self._settings = settings
        self._acts_on = acts_on
        self._fits: dict[int, bool] = {}
        """Whether the settings of each known bridge fit, by incarnation."""
        self._heard_s: dict[int, float] = {}
        """When bridges without known settings were first heard of."""
        self._tokens: set[int] = set()
        """Bridges that do not fit and have tokens."""
        self._bridges: set[int] = set()
        """Bridges whose tokens the core has seen."""
        self._announced: dict[tuple[str, str], Announce] = {}
        """Tokens of the core."""
        self._link_up = True
        self._hides = False
        """Whether there is a bridge that does not fit, and none that does."""
        self._reported: set[int] = set()
        """Bridges with which differences have been logged."""
        self._next_s = 0.0
        """When the settings are published next, while they do not fit."""

    @property
    def metrics(self) -> tuple[MetricsSnapshot, ...]:
        """Metrics of the wrapped core and of the comparison."""
        return (*core_metrics(self.core), SettingsMetrics(fit=not self._hides))

    @property
    def wakeup_s(self) -> float | None:
        """Time of the core's wakeup, or when the settings are published next."""
        wakeup_s = self.core.wakeup_s
        if not self._hides:
            return wakeup_s
        return self._next_s if wakeup_s is None else min(wakeup_s, self._next_s)

    def handle(self, event: Event, now_s: float) -> Iterator[Effect]:
        """Handle an event; see `Core`."""
        match event:
            case Arrived(topic, _, message):
                if isinstance(message, ProcessSettings):
                    self._on_settings(message)
                elif self._may_see(topic, getattr(message, "bridge", 0), now_s):
                    yield from self._pass(event, now_s)
                return
            case PeerUp(topic) | PeerDown(topic) if topic is PROCESS_ALIVE:
                yield from self._on_process(event, now_s)
            case PeerUp(topic) | PeerDown(topic) if topic is BRIDGE_ALIVE:
                yield from self._on_bridge(event, now_s)
            case LinkUp() | LinkDown():
                self._link_up = isinstance(event, LinkUp)
                if not self._hides:
                    yield from self._pass(event, now_s)
            case Wakeup():
                core_s = self.core.wakeup_s
                if core_s is not None and core_s <= now_s:
                    yield from self._pass(event, now_s)
            case Started():
                yield Announce(PROCESS_ALIVE, self._process.token(self._settings))
                yield Watch(PROCESS_ALIVE, _OF_BRIDGE)
                yield from self._pass(event, now_s)
            case _:
                yield from self._pass(event, now_s)
        if self._hides and now_s >= self._next_s:
            self._next_s = now_s + PERIOD_S
            yield self._process.settings_effect(self._settings)

    def _may_see(self, topic: Topic, bridge: int, now_s: float) -> bool:
        """Return whether the core receives a message of a bridge; at most 0: of no bridge."""
        if bridge <= 0:
            return True
        known = self._fits.get(bridge)
        if known is not None or topic is not self._acts_on:
            return known is not False
        return now_s >= self._heard(bridge, now_s) + WAIT_S

    def _heard(self, bridge: int, now_s: float) -> float:
        """Return when a bridge was first heard of."""
        if bridge not in self._heard_s:
            _make_room(self._heard_s)
            self._heard_s[bridge] = now_s
        return self._heard_s[bridge]

    def _pass(self, event: Event, now_s: float) -> Iterator[Effect]:
        """Pass an event to the core; while it is hidden from others, it sends nothing."""
        for effect in self.core.handle(event, now_s):
            match effect:
                case Announce():
                    self._announced[_key(effect)] = effect
                case Withdraw():
                    self._announced.pop(_key(effect), None)
                case _:
                    pass
            if not (self._hides and isinstance(effect, (Send, Announce, Withdraw))):
                yield effect

    def _on_bridge(self, event: PeerUp | PeerDown, now_s: float) -> Iterator[Effect]:
        """Pass the token of a bridge to the core, unless the bridge is known not to fit."""
        bridge = incarnation_of(event.parameters)
        if isinstance(event, PeerUp):
            if not self._fits.get(bridge, True):
                return
            self._heard(bridge, now_s)
            self._bridges.add(bridge)
        elif bridge in self._bridges:
            self._bridges.discard(bridge)
        else:
            return
        yield from self._pass(event, now_s)
        yield from self._compare(now_s)

    def _on_process(self, event: PeerUp | PeerDown, now_s: float) -> Iterator[Effect]:
        """Compare the settings of a bridge, or forget its token."""
        bridge = incarnation_of(event.parameters)
        if event.parameters["role"] != BRIDGE or bridge <= 0:
            return
        if isinstance(event, PeerDown):
            self._tokens.discard(bridge)
        else:
            digests = self._settings.digests, event.parameters["digests"]
            # A forged token of the same bridge must not exclude a process that fits.
            fits = not different_groups(*digests, self._process.role) or self._fits.get(
                bridge, False
            )
            _make_room(self._fits)
            self._fits[bridge] = fits
            (self._tokens.discard if fits else self._tokens.add)(bridge)
            if not fits and bridge in self._bridges:
                # The core has learned of this bridge before its settings were known.
                self._bridges.discard(bridge)
                down = PeerDown(BRIDGE_ALIVE, {"incarnation": str(bridge)})
                yield from self._pass(down, now_s)
        yield from self._compare(now_s)

    def _compare(self, now_s: float) -> Iterator[Effect]:
        """Hide the core from others, or show it again, if the bridges have changed."""
        hides = bool(self._tokens) and not self._bridges
        if hides == self._hides:
            return
        if hides:
            yield Listen(SETTINGS, _OF_BRIDGE)
            if self._link_up:
                yield from self._pass(LinkDown(), now_s)
            self._hides = True
            for one in self._announced.values():
                yield Withdraw(one.topic, one.parameters)
            return
        self._hides = False
        yield Unlisten(SETTINGS, _OF_BRIDGE)
        yield from self._announced.values()
        if self._link_up:
            yield from self._pass(LinkUp(), now_s)

    def _on_settings(self, other: ProcessSettings) -> None:
        """Log how the settings of a bridge differ, once."""
        bridge = other.incarnation
        if other.role != BRIDGE or bridge not in self._tokens or bridge in self._reported:
            return
        differences = self._settings.differences(other.values, groups_of(self._process.role))
        if differences:
            self._reported.add(bridge)
            log.error(
                "settings differ from those of the bridge: this process does not act on its road",
                process=f"{self._process.role} {self._process.name}",
                bridge=f"{other.name} {bridge}",
                differences=[str(one) for one in differences],
            )


def _key(token: Announce | Withdraw) -> tuple[str, str]:
    return token.topic.name, repr(sorted(token.parameters.items()))


def _make_room(bridges: dict[int, bool] | dict[int, float]) -> None:
    while len(bridges) >= MAX_BRIDGES:
        del bridges[next(iter(bridges))]
