"""The live road: what an observer knows of a deployment, and the frames made of it.

A pure core: messages and times go in, frames come out. It listens to what roadside, vehicles and
coordinators publish anyway, and says nothing. Every vehicle shows its state in each tick;
between two of them, and while single ones are lost, it is drawn where its speed has taken it.
Whoever is not heard for `UNHEARD_S` is drawn in its cell and marked: that is where a vehicle holds
of which nothing new is known, but nobody has seen it there.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from attrs import define, field

from laneweave.launch.observe.column_owners import Formations
from laneweave.launch.watch.coordinators import Candidates, leader_of
from laneweave.launch.watch.event_feed import Newest, plan_facts
from laneweave.launch.watch.frames import MOVING, OVERDUE, UNATTENDED, UNHEARD, Row
from laneweave.launch.watch.message_loss import LossMeter
from laneweave.protocol.lattice import Cell
from laneweave.protocol.runtime.transport import LinkDown, LinkUp
from laneweave.protocol.scenario.tables import Scenario
from laneweave.protocol.wire.messages import (
    Ballot,
    Census,
    CensusEntry,
    Heartbeat,
    LogEvent,
    Name,
    Plan,
    RoadClock,
    VehicleState,
)
from laneweave.protocol.wire.topics import CENSUS, CLOCK, EVENT, HEARTBEAT, PLAN, STATE

TOPICS = (STATE, CLOCK, CENSUS, HEARTBEAT, PLAN, EVENT)
"""What is subscribed to; the most frequent one first."""
UNHEARD_S = 1.0
"""Road time after which a vehicle counts as not heard."""
STILL_S = 2.0
"""Wall-clock time after which a clock that says nothing stands still."""
FORGET_S = 5.0
"""States further from the clock than this are those of an earlier road."""
MOST_PLANS = 500


@define
class _Road:
    """What is known of one run of the road."""

    loss: LossMeter
    clock: RoadClock | None = None
    clock_s: float = 0.0
    """When it was heard, wall clock."""
    census: Census | None = None
    states: dict[Name, VehicleState] = field(factory=dict)


class LiveRoad:
    """What is known of a deployment, from nothing on."""

    def __init__(self, scenario: Scenario, wall_s: float) -> None:
        """Begin to watch at a wall-clock time, connected."""
        self.scenario = scenario
        self.connected = True
        self.run = 0
        """Number of the road, from 1 on when the first one is heard of."""
        self._bridge = -1
        self._road = self._new_road()
        self._candidates = Candidates(scenario.network.election_s)
        self._targets: dict[Ballot, dict[Name, Cell]] = {}
        """Of each plan the last cells of those who move."""
        self._news = Newest()
        self._plan: list[Any] | None = None
        self._status, self._since_s = "waiting", wall_s
        self._shown: tuple[int, str, int] | None = None
        """Run, status and tick of the last frame."""

    def _new_road(self) -> _Road:
        return _Road(LossMeter(self.scenario.runtime.tick_s))

    # --- what is heard ------------------------------------------------------------------------

    def take(self, news: object, wall_s: float) -> None:
        """Take a message or a change of the link, at a wall-clock time."""
        match news:
            case VehicleState():
                self._on_state(news)
            case RoadClock() if self._is_of_this_road(news.bridge):
                self._on_clock(news, wall_s)
            case Census() if self._is_of_this_road(news.bridge):
                if self._road.census is None or news.t_s >= self._road.census.t_s:
                    self._road.census = news
                    self._road.loss.on_census(news)
            case Heartbeat():
                self._candidates.on_heartbeat(news, wall_s)
            case Plan():
                self._on_plan(news)
            case LogEvent():
                self._plan = plan_facts(news.t_s, news.kind, news.data) or self._plan
                self._news.add(news.t_s, news.name, news.kind, news.data)
            case LinkUp() | LinkDown():
                self.connected = isinstance(news, LinkUp)
            case _:
                pass

    def _is_of_this_road(self, bridge: int) -> bool:
        """Tell whether news are not those of an earlier road; a newer one begins anew."""
        if bridge > self._bridge:
            self._bridge, self._road = bridge, self._new_road()
            self._plan = None
            if self.run:  # what was heard before the first road is about it, too
                self._news = Newest()
            self._targets.clear()
            self.run += 1
        return bridge == self._bridge

    def _on_clock(self, clock: RoadClock, wall_s: float) -> None:
        road = self._road
        if road.clock is None or clock.tick >= road.clock.tick:
            road.clock, road.clock_s = clock, wall_s
            road.loss.on_clock(clock)

    def _on_state(self, state: VehicleState) -> None:
        road = self._road
        if road.clock is None or abs(state.t_s - road.clock.t_s) > FORGET_S:
            return
        road.loss.on_state(state)
        known = road.states.get(state.vehicle)
        if known is None or state.t_s >= known.t_s:
            road.states[state.vehicle] = state

    def _on_plan(self, plan: Plan) -> None:
        self._targets[plan.ballot] = {
            vehicle: moves[-1][2] for vehicle, moves in plan.moves.items() if moves
        }
        while len(self._targets) > MOST_PLANS:
            del self._targets[next(iter(self._targets))]

    # --- what is shown ------------------------------------------------------------------------

    def changed(self, wall_s: float) -> bool:
        """Tell whether there is a tick or a status that the last frame has not shown."""
        return self._shown != self._identity(wall_s)

    def frame(self, number: int, wall_s: float) -> dict[str, Any]:
        """Return what is known as a frame; see `frames`."""
        self._shown = self._identity(wall_s)
        self._note_status(wall_s)
        road, candidates = self._road, self._candidates.now(wall_s)
        leader, clock = leader_of(candidates), road.clock
        self._forget_who_left()
        formations = self._formations()
        rows = self._rows(clock.t_s, formations) if clock is not None else ()
        return {
            "n": number,
            "run": self.run,
            "t": round(clock.t_s, 3) if clock is not None else None,
            "w": round(wall_s, 3),
            "status": self._status,
            "since": round(self._since_s, 3),
            "leader": [leader.name, leader.term] if leader is not None else None,
            "candidates": [[c.name, c.term, c.leading, c.silent] for c in candidates],
            "counts": [clock.demanded, clock.entered, clock.on_road, clock.left] if clock else None,
            "loss": [road.loss.expected, road.loss.lost] if road.loss.expected else None,
            "plan": self._plan,
            "news": self._news.rows,
            "formations": [[one.number, one.rear, one.front] for one in formations.listed],
            "joined": formations.joined(
                {state.joined for state in road.states.values()}, self.scenario.lattice
            ),
            "vehicles": [row.compact() for row in rows],
        }

    def _identity(self, wall_s: float) -> tuple[int, str, int]:
        clock = self._road.clock
        return self.run, self._status_now(wall_s), clock.tick if clock is not None else -1

    def _status_now(self, wall_s: float) -> str:
        road = self._road
        if not self.connected:
            return "lost"
        if road.clock is None:
            return "waiting"
        if road.clock.ended:
            return "ended"
        return "still" if wall_s - road.clock_s > STILL_S else "live"

    def _note_status(self, wall_s: float) -> None:
        status = self._status_now(wall_s)
        if status != self._status:
            self._status = status
            self._since_s = self._road.clock_s if status == "still" else wall_s

    def _forget_who_left(self) -> None:
        road = self._road
        if road.census is None:
            return
        listed = {entry.vehicle for entry in road.census.on_road}
        road.states = {
            name: state
            for name, state in road.states.items()
            # Who was heard after the census may have entered after it.
            if name in listed or state.t_s > road.census.t_s
        }

    def _formations(self) -> Formations:
        """Return the closed formations on the road; none in the rolling operation."""
        census = self._road.census
        if census is None or self.scenario.formation.rolling:
            return Formations(())
        return Formations.of_census(census.formations, self.scenario.lattice)

    def _rows(self, t_s: float, formations: Formations) -> Iterator[Row]:
        census, states = self._road.census, self._road.states
        listed = {entry.vehicle: entry for entry in census.on_road} if census is not None else {}
        for name, entry in listed.items():
            yield self._row(name, t_s, entry, states.get(name), formations)
        for name, state in states.items():
            if name not in listed:
                yield self._row(name, t_s, None, state, formations)

    def _row(
        self,
        name: Name,
        t_s: float,
        entry: CensusEntry | None,
        state: VehicleState | None,
        formations: Formations,
    ) -> Row:
        lattice, owner = self.scenario.lattice, None
        if entry is not None:
            owner = formations.at(entry.cell[0])
        elif state is not None:
            owner = formations.at(lattice.block_range(state.formation).start)
        formation = -1 if owner is None else owner.number
        preferred = entry.preferred_lane if entry is not None else -1
        if state is not None and abs(t_s - state.t_s) <= UNHEARD_S:
            flags = MOVING * state.moving | UNATTENDED * (not state.attended)
            return Row(
                name=name,
                s_m=state.s_m + (t_s - state.t_s) * state.speed_mps,
                y_m=state.y_m,
                speed_mps=state.speed_mps,
                preferred_lane=preferred,
                formation=formation,
                hold=state.hold_cell,
                target=self._target_of(state),
                flags=flags | OVERDUE * state.overdue,
                estate=[cell for cell in state.estate if cell != state.hold_cell],
            )
        cell = state.hold_cell if state is not None else entry.cell if entry is not None else (0, 0)
        return Row(
            name=name,
            s_m=lattice.cell_s_m(cell[0], t_s),
            y_m=lattice.cell_y_m(cell[1]),
            speed_mps=lattice.speed_mps,
            preferred_lane=preferred,
            formation=formation,
            hold=cell,
            target=None,
            flags=UNHEARD,
        )

    def _target_of(self, state: VehicleState) -> Cell | None:
        """Return where the vehicle's plan leads, None if it has none or it was not heard."""
        if state.promised is None or not state.accepted or state.done:
            return None
        return self._targets.get(state.promised, {}).get(state.vehicle)
