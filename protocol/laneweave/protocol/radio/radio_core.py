"""A core wrapper that simulates radio channels: the receiver decides which messages it hears.

| from | to | messages | channel |
|---|---|---|---|
| vehicle | vehicle | STATE, MOTION | sidelink |
| vehicle | coordinator | STATE | cellular |
| coordinator | vehicle, or its caretaker in the bridge | PREPARE, PLAN | cellular |
| bridge | vehicle | OBSTACLES | cellular |

All other messages are lossless: SENSE and COMMAND, because a vehicle and its motion controller are
one machine; those between the bridge and coordinators, because they are wired; those that only
supervise processes.

The sidelink (`reception`) depends on the distance between the vehicles and on how many send around
the receiver. A receiver knows its own position from SENSE and that of the sender from the message.
A message that takes several packets arrives if all of them do. With C-V2X, a message waits for the
next resource that its sender has reserved; with IEEE 802.11p, it is sent almost at once.
"""

from __future__ import annotations

import math
import random
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import lru_cache
from typing import ClassVar, Final

from attrs import frozen
from msgspec.structs import replace

from laneweave.protocol.radio.burst_losses import BurstLosses
from laneweave.protocol.radio.reception import (
    DENSITY_STEP_PER_KM,
    DISTANCE_STEP_M,
    MAX_DENSITY_PER_KM,
    MESSAGE_BYTES,
    sidelink_of,
)
from laneweave.protocol.runtime.delaying_core import DelayingCore
from laneweave.protocol.runtime.metrics import MetricsSnapshot, metric
from laneweave.protocol.runtime.node import Arrived, Core, Effect, Send
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.radio_table import C_V2X, Radio
from laneweave.protocol.wire.codec import encode
from laneweave.protocol.wire.messages import Motion, Name, Sense, VehicleState
from laneweave.protocol.wire.process_messages import Report
from laneweave.protocol.wire.topics import MOTION, OBSTACLES, PLAN, PREPARE, SENSE, STATE, Party

DSRC_DELAY_S: Final = 0.002
"""Maximum channel access delay of IEEE 802.11p."""
_CELLULAR: Final = {
    Party.VEHICLE: (PREPARE, PLAN, OBSTACLES),
    Party.COORDINATOR: (STATE,),
    Party.BRIDGE: (PREPARE, PLAN),
}
"""Topics whose messages arrive by the cellular network, for each kind of receiver."""

Listeners = Callable[[Motion | VehicleState], Iterable[Name]]
"""Returns the vehicles of an agent process that need a message of another vehicle now."""


@frozen
class RadioMetrics:
    """Messages by radio."""

    ABOUT: ClassVar[str] = "radio"

    messages_total: Mapping[str, int] = metric(
        "Messages by radio, lost ones included", label="channel"
    )
    lost_total: Mapping[str, int] = metric("Messages that the radio has lost", label="channel")


@frozen
class _Situation:
    """Position and speed of a vehicle at a road time, and density of senders around it."""

    s_m: float
    speed_mps: float
    t_s: float
    senders_per_km: float

    def position_m(self, t_s: float) -> float:
        """Return where the vehicle is at a road time, at constant speed."""
        return self.s_m + self.speed_mps * (t_s - self.t_s)


class RadioCore(DelayingCore):
    """A `Core` whose messages arrive by radio."""

    def __init__(
        self, core: Core, scenario: Scenario, party: Party, name: str, listeners: Listeners
    ) -> None:
        """Wrap a core.

        Args:
            core: core of an agent process, a coordinator or the bridge.
            scenario: scenario with a radio.
            party: kind of the process.
            name: name of the process; with the scenario's seed, it determines the draws.
            listeners: which vehicles of an agent process hear a message of another vehicle.
        """
        super().__init__(core)
        radio = scenario.radio
        self._radio = radio
        self._party = party
        self._name = name
        self._listeners = listeners
        self._lattice = scenario.lattice
        self._tick_s = scenario.runtime.tick_s
        # Text seeds are hashed with SHA-512, identically in all processes.
        self._random = random.Random(f"{scenario.seed}/radio/{name}")  # noqa: S311 (no secrets)
        self._bursts = BurstLosses(radio.burst_share, radio.burst_s, self._random)
        self._situations: dict[str, _Situation] = {}
        """Of each vehicle of this process that is on the road."""
        self._curves = _Curves(radio)
        by_reservation = radio.technology == C_V2X
        self._sidelink_delay_s = 1.0 / radio.rate_hz if by_reservation else DSRC_DELAY_S
        self._counts: defaultdict[str, Counter[str]] = defaultdict(Counter)
        """Counters for reports, by the sender of the report."""
        self._sent, self._lost = Counter[str](), Counter[str]()

    @property
    def metrics(self) -> Iterable[MetricsSnapshot]:
        """Metrics of the wrapped core and of the radio."""
        return (*super().metrics, RadioMetrics(self._sent.copy(), self._lost.copy()))

    def _on_overflow(self, arrived: Arrived) -> None:
        if arrived.vehicles is None:
            self._count_lost("cellular", self._reporter(arrived))
        else:
            for vehicle in arrived.vehicles:
                self._count_lost("sidelink", vehicle)

    def _passed(self, effect: Effect) -> Effect:
        """Add the counters of the radio to reports."""
        if isinstance(effect, Send) and isinstance(effect.message, Report):
            name = effect.message.name
            report = replace(effect.message, **self._counts.get(name, Counter[str]()))
            if self._party is Party.VEHICLE and name not in self._situations:
                self._counts.pop(name, None)  # it has left the road
            return Send(effect.topic, report, effect.parameters)
        return effect

    def _copies(self, arrived: Arrived, now_s: float) -> Iterable[tuple[float, Arrived]]:
        topic, message = arrived.topic, arrived.message
        if self._party is Party.VEHICLE:
            if topic is SENSE:
                self._on_sense(message)
            elif topic in (STATE, MOTION):
                return self._by_sidelink(arrived, message, now_s)
        if topic not in _CELLULAR[self._party]:
            return ((0.0, arrived),)
        return self._by_cellular(arrived, now_s)

    def _on_sense(self, sense: Sense) -> None:
        if sense.left:
            self._situations.pop(sense.vehicle, None)
            return
        s_m, speed_mps = sense.measured[:2]
        self._situations[sense.vehicle] = _Situation(
            s_m, speed_mps, sense.t_s, sense.senders_per_km
        )

    def _by_sidelink(
        self, arrived: Arrived, message: Motion | VehicleState, now_s: float
    ) -> Iterable[tuple[float, Arrived]]:
        """Return the message for the vehicles that hear it, which all hear it at the same time."""
        if isinstance(message, VehicleState):
            s_m, t_s, packets = message.s_m, message.t_s, -(-len(encode(message)) // MESSAGE_BYTES)
        else:
            t_s, packets = message.tick * self._tick_s, 1
            s_m = self._lattice.cell_s_m(message.origin[0], t_s)
        heard = list[Name]()
        for vehicle in self._listeners(message):
            situation = self._situations.get(vehicle)
            if situation is None:
                continue  # not on the road
            distance_m = abs(situation.position_m(t_s) - s_m)
            chance = self._curves.arrival(distance_m, situation.senders_per_km)
            bad = self._bursts.is_bad((message.vehicle, vehicle), now_s)
            self._count("sidelink", vehicle)
            if bad or self._random.random() >= chance**packets:
                self._count_lost("sidelink", vehicle)
            else:
                heard.append(vehicle)
        if not heard:
            return ()
        delay_s = self._sidelink_delay_s * self._random.random()
        received = Arrived(arrived.topic, arrived.parameters, message, frozenset(heard))
        return ((delay_s, received),)

    def _by_cellular(self, arrived: Arrived, now_s: float) -> Iterable[tuple[float, Arrived]]:
        """Return the message unless the network loses it on its way to or from a vehicle."""
        radio, draw, reporter = self._radio, self._random.random, self._reporter(arrived)
        bad = self._bursts.is_bad(arrived.parameters.get("vehicle", self._name), now_s)
        self._count("cellular", reporter)
        if draw() < radio.cellular_loss or bad:
            self._count_lost("cellular", reporter)
            return ()
        return ((radio.cellular_delay_s + radio.cellular_jitter_s * draw(), arrived),)

    def _reporter(self, arrived: Arrived) -> str:
        """Return who reports a message by the cellular network.

        A message to all vehicles of a process is reported by one of those on the road.
        """
        if self._party is not Party.VEHICLE:
            return self._name
        vehicle = arrived.parameters.get("vehicle")
        return vehicle or next(iter(self._situations), "")

    def _count(self, channel: str, reporter: str) -> None:
        """Count a message for the report of a vehicle, a coordinator or the bridge."""
        self._sent[channel] += 1
        if self._party is not Party.VEHICLE or reporter in self._situations:
            self._counts[reporter][channel] += 1

    def _count_lost(self, channel: str, reporter: str) -> None:
        """Count the loss of a message that has been counted."""
        self._lost[channel] += 1
        if reporter in self._counts:
            self._counts[reporter][f"{channel}_lost"] += 1


class _Curves:
    """Share of messages that arrive by sidelink."""

    def __init__(self, radio: Radio) -> None:
        """Create without curves; each is computed when it is first needed."""
        self._radio = radio
        self._by_density: dict[int, Sequence[float]] = {}
        """Share at each of `DISTANCES_M`, by the number of density steps."""

    def arrival(self, distance_m: float, senders_per_km: float) -> float:
        """Return the share at a distance, interpolated between `DISTANCES_M`; 0 beyond them."""
        density_per_km = senders_per_km + self._radio.other_senders_per_km
        steps = max(1, round(min(density_per_km, MAX_DENSITY_PER_KM) / DENSITY_STEP_PER_KM))
        shares = self._by_density.get(steps)
        if shares is None:
            shares = self._by_density[steps] = _shares(self._radio, steps)
        rest, index = math.modf(distance_m / DISTANCE_STEP_M)
        if index >= len(shares) - 1:
            return 0.0
        before, after = shares[int(index) : int(index) + 2]
        return before + rest * (after - before)


@lru_cache(maxsize=256)
def _shares(radio: Radio, steps: int) -> tuple[float, ...]:
    """Return the share that arrives at each of `DISTANCES_M`, for all receivers in a process."""
    sidelink = sidelink_of(radio.technology, radio.power_dbm, radio.rate_hz)
    return tuple(sidelink.arrival(steps * DENSITY_STEP_PER_KM).tolist())


def _no_listeners(_: Motion | VehicleState) -> Iterable[Name]:
    return ()


def over_radio(
    core: Core, scenario: Scenario, party: Party, name: str, listeners: Listeners = _no_listeners
) -> Core:
    """Return the core of a process, wrapped if the scenario has a radio; see `RadioCore`."""
    if not scenario.radio.enabled:
        return core
    return RadioCore(core, scenario, party, name, listeners)
