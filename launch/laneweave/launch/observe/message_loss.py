"""Message loss measured by an observer: clocks and states that did not arrive.

In each tick, the bridge publishes its clock, and every vehicle on the road its state; a census
lists the vehicles on the road, so the expected messages of a tick are known. The states of a
vehicle are expected from the first one received, but no later than `CONNECT_S` after its entry,
because its agent may connect late.
"""

from __future__ import annotations

from collections import deque

from attrs import define, field

from laneweave.protocol.wire.messages import Census, CensusEntry, Name, RoadClock, VehicleState

GRACE_TICKS = 5
"""Number of ticks by which a message may be late without counting as lost."""
CONNECT_S = 1.0
TOLERANCE_S = 1e-6


@define
class LossMeter:
    """Counter of the expected and lost messages of one road."""

    window_ticks: int
    """Number of ticks over which loss is measured; 0: no measurement."""
    _received: dict[int, set[Name]] = field(factory=dict)
    """Vehicles whose states were received, by open tick."""
    _clocks: set[int] = field(factory=set)
    """Open ticks whose clock messages were received."""
    _first_tick: dict[Name, int] = field(factory=dict)
    """Tick of the first received state of each vehicle."""
    _censuses: deque[Census] = field(factory=lambda: deque(maxlen=4 * GRACE_TICKS))
    """Newest censuses, oldest first."""
    _tick_s: float = 0.0
    """Length of a tick; 0: unknown."""
    _next_tick: int = 0
    """Next tick to close."""
    _closed: deque[tuple[int, int, bool]] = field(init=False)
    """Expected and lost states of each closed tick, and whether its clock message arrived."""

    @_closed.default
    def _empty_window(self) -> deque[tuple[int, int, bool]]:
        return deque(maxlen=self.window_ticks)

    def on_state(self, state: VehicleState) -> None:
        """Count a state; ignore duplicates for the same vehicle and tick."""
        if self._tick_s == 0.0:
            return
        tick = self._tick(state.t_s)
        if tick >= self._next_tick:
            self._received.setdefault(tick, set()).add(state.vehicle)
            self._first_tick.setdefault(state.vehicle, tick)

    def on_census(self, census: Census) -> None:
        """Process a census that is not older than any previous one."""
        if not self.window_ticks:
            return
        self._censuses.append(census)
        listed = {entry.vehicle for entry in census.on_road}
        for name in self._first_tick.keys() - listed:
            # Keep vehicles that have just entered and will be listed soon; remove those that left.
            if self._first_tick[name] < self._tick(census.t_s) - GRACE_TICKS:
                del self._first_tick[name]

    def on_clock(self, clock: RoadClock) -> None:
        """Count a clock message; close ticks past their grace period."""
        if not self.window_ticks or not clock.tick:
            return
        if self._tick_s == 0.0:
            # Messages published before this observer started did not reach it.
            self._tick_s, self._next_tick = clock.t_s / clock.tick, clock.tick + 1
        self._clocks.add(clock.tick)
        # Close no more ticks than the window can hold.
        last = clock.tick - GRACE_TICKS
        self._next_tick = max(self._next_tick, last - self.window_ticks)
        while self._next_tick <= last:
            self._close(self._next_tick)
            self._next_tick += 1
        self._clocks = {tick for tick in self._clocks if tick >= self._next_tick}
        for tick in [tick for tick in self._received if tick < self._next_tick]:
            del self._received[tick]

    @property
    def expected(self) -> int:
        """Number of states expected in the window."""
        return sum(expected for expected, _, _ in self._closed)

    @property
    def lost(self) -> int:
        """Number of expected states that did not arrive."""
        return sum(lost for _, lost, _ in self._closed)

    @property
    def state_loss(self) -> float | None:
        """Share of expected states that did not arrive; None: no states were expected."""
        return self.lost / self.expected if self.expected else None

    @property
    def clock_loss(self) -> float | None:
        """Share of expected clock messages that did not arrive; None: none were expected."""
        if not self._closed:
            return None
        return sum(not arrived for _, _, arrived in self._closed) / len(self._closed)

    def _close(self, tick: int) -> None:
        t_s = tick * self._tick_s
        received = self._received.pop(tick, set())
        expected = {
            entry.vehicle
            for entry in self._census_at(t_s)
            if self._first_tick.get(entry.vehicle, tick + 1) <= tick
            or entry.entered_s <= t_s - CONNECT_S
        }
        self._closed.append((len(expected), len(expected - received), tick in self._clocks))

    def _census_at(self, t_s: float) -> tuple[CensusEntry, ...]:
        """Return the vehicles of the newest census at a time, or of the first census after it."""
        before = [census for census in self._censuses if census.t_s <= t_s + TOLERANCE_S]
        return (before[-1:] or list(self._censuses)[:1] or [_EMPTY_CENSUS])[0].on_road

    def _tick(self, t_s: float) -> int:
        return round(t_s / self._tick_s) if self._tick_s else 0


_EMPTY_CENSUS = Census(0.0, (), ())
