"""A road full of vehicles as its messages: what an observer of a real one gets to hear."""

from __future__ import annotations

from collections.abc import Iterator

from attrs import frozen

from laneweave.protocol.lattice import Cell, PlannedMove
from laneweave.protocol.runtime.node import Announce, Send
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.scenario.formation_table import FormationSettings
from laneweave.protocol.wire.messages import (
    Ballot,
    Census,
    CensusEntry,
    Heartbeat,
    Name,
    PendingTransfer,
    Plan,
    RoadClock,
    VehicleState,
)
from laneweave.protocol.wire.topics import (
    BRIDGE_ALIVE,
    CENSUS,
    CLOCK,
    COORDINATOR_ALIVE,
    HEARTBEAT,
    PLAN,
    STATE,
)
from support.states import holding, make_plan

BALLOT = Ballot(3, Name("c1"), 17, 5)
COORDINATORS = (
    Heartbeat(Name("c1"), 17, 3, leading=True, plans=1),
    Heartbeat(Name("c2"), 18, 3, leading=False, plans=0),
    Heartbeat(Name("c3"), 19, 3, leading=False, plans=0),
)
ROLLING = Scenario(formation=FormationSettings(operation="rolling"))


@frozen
class Convoy:
    """Vehicles side by side, column behind column, that hold their cells; every tenth one moves."""

    count: int
    bridge: int = 1
    scenario: Scenario = ROLLING
    coordinators: tuple[Heartbeat, ...] = COORDINATORS

    @property
    def names(self) -> list[Name]:
        """All vehicles, foremost first."""
        return [Name(f"v{number:04}") for number in range(self.count)]

    @property
    def first_tick(self) -> int:
        """The first tick at which all are on the road."""
        column = -self.cell(self.count - 1)[0]
        lattice = self.scenario.lattice
        return round(lattice.passing_time_s(-column) / self.scenario.runtime.tick_s) + 1

    def cell(self, number: int) -> Cell:
        """Return the cell in which a vehicle entered."""
        return -(number // self.scenario.road.lanes), number % self.scenario.road.lanes

    def messages(self, tick: int) -> Iterator[Send]:
        """Yield what is published in a tick."""
        yield Send(CLOCK, self.clock(tick))
        if tick % 10 == 0:
            yield Send(CENSUS, self.census(tick))
        if tick % 40 == 0:
            yield Send(PLAN, self.plan(tick), {"process": "p", "vehicle": self.names[0]})
        for one in self.coordinators:
            yield Send(HEARTBEAT, one, {"coordinator": one.coordinator})
        for number in range(self.count):
            state = self.state(number, tick)
            yield Send(STATE, state, {"block": 0, "vehicle": state.vehicle})

    def tokens(self) -> Iterator[Announce]:
        """Yield the tokens of the road's processes."""
        yield Announce(BRIDGE_ALIVE, {"incarnation": self.bridge})
        for one in self.coordinators:
            parameters = {"coordinator": one.coordinator, "incarnation": one.incarnation}
            yield Announce(COORDINATOR_ALIVE, parameters)

    def clock(self, tick: int, *, ended: bool = False) -> RoadClock:
        """Return the clock of a tick."""
        return RoadClock(
            tick=tick,
            t_s=tick * self.scenario.runtime.tick_s,
            demanded=self.count,
            entered=self.count,
            on_road=self.count,
            left=0,
            ended=ended,
            bridge=self.bridge,
        )

    def census(self, tick: int, *, without: frozenset[Name] = frozenset()) -> Census:
        """Return a census: all are there but those without whom it is."""
        entries = tuple(
            CensusEntry(name, self.cell(number), number % 3, entered_s=0.0)
            for number, name in enumerate(self.names)
            if name not in without
        )
        return Census(tick * self.scenario.runtime.tick_s, entries, (), bridge=self.bridge)

    def state(self, number: int, tick: int) -> VehicleState:
        """Return what a vehicle shows in a tick."""
        lattice, t_s = self.scenario.lattice, tick * self.scenario.runtime.tick_s
        cell = self.cell(number)
        owned = (cell, (cell[0] - 100, cell[1]))
        return holding(
            self.names[number],
            BALLOT,
            cell,
            accepted=number % 10 == 0,
            s_m=lattice.cell_s_m(cell[0], t_s),
            y_m=lattice.cell_y_m(cell[1]),
            speed_mps=lattice.speed_mps,
            t_s=t_s,
            owned=owned,
            transfer=PendingTransfer(BALLOT, owned, owned, (self.names[number],)),
        )

    def plan(self, tick: int) -> Plan:
        """Return a plan in which every tenth vehicle moves a column ahead."""
        cells = {name: self.cell(number) for number, name in enumerate(self.names)}
        moves: dict[Name, tuple[PlannedMove, ...]] = {
            name: ((0, cell, (cell[0] + 1, cell[1])),) for name, cell in list(cells.items())[::10]
        }
        t0_s = tick * self.scenario.runtime.tick_s
        return make_plan(cells, moves, ballot=BALLOT, t0_s=t0_s, territory=())
