"""Message loss, as an observer can measure it: clocks and states that did not arrive.

A bridge publishes its clock once in each tick of road time; every vehicle on the road publishes
its state once in each tick; a census lists the vehicles on the road. So when a tick is over, the
messages that should have arrived are known. A vehicle counts from the tick at which it was first
heard, at the latest `CONNECT_S` after it entered: until then its agent may not have connected.
"""

from __future__ import annotations

from collections import deque

from attrs import define, field

from laneweave.protocol.wire.messages import Census, CensusEntry, Name, RoadClock, VehicleState

GRACE_TICKS = 5
"""A message may arrive this many ticks after its own and is not lost."""
CONNECT_S = 1.0
TOLERANCE_S = 1e-6


@define
class LossMeter:
    """Counts messages of one road; a new road takes a new meter."""

    window_ticks: int
    """Loss is that of the last `window_ticks` ticks; 0: nothing is measured."""
    _heard: dict[int, set[Name]] = field(factory=dict)
    """Vehicles heard in each tick that is not closed."""
    _clocks: set[int] = field(factory=set)
    """Ticks of clock messages that are not closed."""
    _first_heard: dict[Name, int] = field(factory=dict)
    _censuses: deque[Census] = field(factory=lambda: deque(maxlen=4 * GRACE_TICKS))
    """The newest ones, oldest first."""
    _tick_s: float = 0.0
    """Length of a tick; 0: not known yet."""
    _next_tick: int = 0
    """The next one to close."""
    _closed: deque[tuple[int, int, bool]] = field(init=False)
    """Expected and lost states of each closed tick, and whether its clock arrived."""

    @_closed.default
    def _empty_window(self) -> deque[tuple[int, int, bool]]:
        return deque(maxlen=self.window_ticks)

    def on_state(self, state: VehicleState) -> None:
        """Count a state; a second one of the same vehicle and tick is ignored."""
        if self._tick_s == 0.0:
            return
        tick = self._tick(state.t_s)
        if tick >= self._next_tick:
            self._heard.setdefault(tick, set()).add(state.vehicle)
            self._first_heard.setdefault(state.vehicle, tick)

    def on_census(self, census: Census) -> None:
        """Take in a census that is newer than all before."""
        if not self.window_ticks:
            return
        self._censuses.append(census)
        listed = {entry.vehicle for entry in census.on_road}
        for name in self._first_heard.keys() - listed:
            # A vehicle that has left is not heard again; one that has just entered is listed soon.
            if self._first_heard[name] < self._tick(census.t_s) - GRACE_TICKS:
                del self._first_heard[name]

    def on_clock(self, clock: RoadClock) -> None:
        """Count a clock message, and close the ticks that are long over."""
        if not self.window_ticks or not clock.tick:
            return
        if self._tick_s == 0.0:
            # What was published before this observer came did not reach it.
            self._tick_s, self._next_tick = clock.t_s / clock.tick, clock.tick + 1
        self._clocks.add(clock.tick)
        # More ticks than the window holds would be forgotten again.
        last = clock.tick - GRACE_TICKS
        self._next_tick = max(self._next_tick, last - self.window_ticks)
        while self._next_tick <= last:
            self._close(self._next_tick)
            self._next_tick += 1
        self._clocks = {tick for tick in self._clocks if tick >= self._next_tick}
        for tick in [tick for tick in self._heard if tick < self._next_tick]:
            del self._heard[tick]

    @property
    def expected(self) -> int:
        """States that were expected in the window."""
        return sum(expected for expected, _, _ in self._closed)

    @property
    def lost(self) -> int:
        """States of them that did not arrive."""
        return sum(lost for _, lost, _ in self._closed)

    @property
    def state_loss(self) -> float | None:
        """Share of the expected states that did not arrive; None: none was expected."""
        return self.lost / self.expected if self.expected else None

    @property
    def clock_loss(self) -> float | None:
        """Share of the clock messages that did not arrive; None: none was expected."""
        if not self._closed:
            return None
        return sum(not arrived for _, _, arrived in self._closed) / len(self._closed)

    def _close(self, tick: int) -> None:
        t_s = tick * self._tick_s
        heard = self._heard.pop(tick, set())
        expected = {
            entry.vehicle
            for entry in self._census_at(t_s)
            if self._first_heard.get(entry.vehicle, tick + 1) <= tick
            or entry.entered_s <= t_s - CONNECT_S
        }
        self._closed.append((len(expected), len(expected - heard), tick in self._clocks))

    def _census_at(self, t_s: float) -> tuple[CensusEntry, ...]:
        """Return the vehicles on the road at a time: of the newest census up to then, else later.

        Before the first census the vehicles that it lists count, as far as they were on the road.
        """
        before = [census for census in self._censuses if census.t_s <= t_s + TOLERANCE_S]
        return (before[-1:] or list(self._censuses)[:1] or [_EMPTY_CENSUS])[0].on_road

    def _tick(self, t_s: float) -> int:
        return round(t_s / self._tick_s) if self._tick_s else 0


_EMPTY_CENSUS = Census(0.0, (), ())
