"""Message loss, as an observer can tell it: states that were expected and did not arrive.

Every vehicle on the road shows its state once in each tick of road time; a census says who is on
the road. So after a tick it is known whose states should have come. A vehicle counts from the tick
at which it was first heard, at the latest `MEETING_S` after it entered: before that somebody has
yet to take charge of it.
"""

from __future__ import annotations

from collections import deque

from attrs import define, field

from laneweave.protocol.wire.messages import Census, CensusEntry, Name, RoadClock, VehicleState

GRACE_TICKS = 5
"""A state may arrive this many ticks after its own and is not lost."""
WINDOW_TICKS = 100
"""Loss is that of the last so many ticks."""
MEETING_S = 1.0
TOLERANCE_S = 1e-6


@define
class LossMeter:
    """Counts states of one road; a new road takes a new meter."""

    tick_s: float
    _heard: dict[int, set[Name]] = field(factory=dict)
    """Who was heard in each tick that is not closed."""
    _first_heard: dict[Name, int] = field(factory=dict)
    _censuses: deque[Census] = field(factory=lambda: deque(maxlen=4 * GRACE_TICKS))
    """The newest ones, oldest first."""
    _next_tick: int | None = None
    """The next one to close."""
    _closed: deque[tuple[int, int]] = field(factory=lambda: deque(maxlen=WINDOW_TICKS))
    """Expected and lost states of each closed tick."""

    def on_state(self, state: VehicleState) -> None:
        """A state has arrived; a tick's second one of a vehicle says nothing new."""
        tick = self._tick(state.t_s)
        if self._next_tick is None or tick < self._next_tick:
            return
        self._heard.setdefault(tick, set()).add(state.vehicle)
        self._first_heard.setdefault(state.vehicle, tick)

    def on_census(self, census: Census) -> None:
        """A census has arrived, newer than all before."""
        self._censuses.append(census)
        listed = {entry.vehicle for entry in census.on_road}
        for name in self._first_heard.keys() - listed:
            # Who has left is not heard again. Who has just entered is listed soon.
            if self._first_heard[name] < self._tick(census.t_s) - GRACE_TICKS:
                del self._first_heard[name]

    def on_clock(self, clock: RoadClock) -> None:
        """A tick has begun: those that are long over are closed."""
        if self._next_tick is None:
            # What was shown before this observer came was not shown to it.
            self._next_tick = clock.tick + 1
        # More ticks than the window holds would be forgotten again.
        last = clock.tick - GRACE_TICKS
        self._next_tick = max(self._next_tick, last - WINDOW_TICKS)
        while self._next_tick <= last:
            self._close(self._next_tick)
            self._next_tick += 1
        for tick in [tick for tick in self._heard if tick < self._next_tick]:
            del self._heard[tick]

    @property
    def expected(self) -> int:
        """States that were expected in the window."""
        return sum(expected for expected, _ in self._closed)

    @property
    def lost(self) -> int:
        """Those of them that did not arrive."""
        return sum(lost for _, lost in self._closed)

    def _close(self, tick: int) -> None:
        t_s = tick * self.tick_s
        heard = self._heard.pop(tick, set())
        expected = {
            entry.vehicle
            for entry in self._census_at(t_s)
            if self._first_heard.get(entry.vehicle, tick + 1) <= tick
            or entry.entered_s <= t_s - MEETING_S
        }
        self._closed.append((len(expected), len(expected - heard)))

    def _census_at(self, t_s: float) -> tuple[CensusEntry, ...]:
        """Return who was on the road at a time, as the newest census up to then says."""
        before = [census for census in self._censuses if census.t_s <= t_s + TOLERANCE_S]
        return before[-1].on_road if before else ()

    def _tick(self, t_s: float) -> int:
        return round(t_s / self.tick_s)
