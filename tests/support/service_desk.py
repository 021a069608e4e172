"""A coordinator under test: its inputs, its effects, and the vehicles on its road."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import Any

from msgspec.structs import replace

from laneweave.coordinator.core import CoordinatorCore
from laneweave.coordinator.formations.leader import FormationLeader
from laneweave.coordinator.formations.operation import FormationsOperation
from laneweave.protocol.lattice import Cell
from laneweave.protocol.runtime.node import Arrived, Compute, Effect, Send, Started, Wakeup
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.wire.messages import Ballot, Census, CensusEntry, Name, VehicleState
from laneweave.protocol.wire.process_messages import LogEvent
from laneweave.protocol.wire.topics import CENSUS, STATE
from support.paper import PAPER, closed_blocks
from support.states import holding

T_S = 20.0
"""Road time: block 0 has closed and is on the way to S3."""
Cells = dict[Name, Cell]


class Desk:
    """A coordinator under test, its clock and its effects."""

    def __init__(self, name: str = "c1", incarnation: int = 1, scenario: Scenario = PAPER) -> None:
        """Start a coordinator."""
        self.core = CoordinatorCore(Name(name), incarnation, scenario)
        self.now_s = 0.0
        self.effects = list(self.core.handle(Started(), 0.0))

    def give(self, *events: object) -> list[Effect]:
        effects: list[Effect] = []
        for event in events:
            effects += self.core.handle(event, self.now_s)  # type: ignore[arg-type]
            assert self.core.wakeup_s is not None
            assert self.core.wakeup_s > self.now_s
        self.effects += effects
        return effects

    def wait(self, seconds: float) -> list[Effect]:
        self.now_s += seconds
        return self.give(Wakeup())

    def lead(self) -> list[Effect]:
        return self.wait(PAPER.network.election_s)

    def watch(self, seconds: float) -> None:
        """Let time pass without a pause."""
        for _ in range(round(seconds / 0.1)):
            self.wait(0.1)

    def tell(self, message: object) -> list[Effect]:
        return self.give(Arrived(CENSUS, {}, message))

    @property
    def leaders(self) -> dict[int, FormationLeader]:
        operation = self.core.operation
        assert isinstance(operation, FormationsOperation)
        return operation.leaders

    @property
    def ballot(self) -> Ballot:
        ballot = self.leaders[0].ballot
        assert ballot is not None
        return ballot

    def collect_promises(self, cells: Cells, lanes: dict[Name, int]) -> list[Effect]:
        """Lead a formation up to the order of its plan."""
        self.lead()
        self.tell(census(cells, lanes))
        self.observe(cells)
        return self.promise(cells)

    def observe(self, cells: Cells, t_s: float = 0.0) -> list[Effect]:
        """Let all vehicles show that they hold their cells and have promised nothing."""
        return self.give(*(Arrived(STATE, {}, state(*item, t_s=t_s)) for item in cells.items()))

    def accept(self, cells: Cells, t_s: float = 2.0, **more: Any) -> list[Effect]:  # noqa: ANN401
        """Let all vehicles accept the plan of formation 0, or of its group."""
        effects: list[Effect] = []
        for name, cell in cells.items():
            effects += self.tell(state(name, cell, self.ballot, accepted=True, t_s=t_s, **more))
        return effects

    def promise(
        self, cells: Cells, joined: tuple[int, ...] = (0,), unattended: Collection[Name] = ()
    ) -> list[Effect]:
        """Let all of a roster promise the ballot of formation 0, or of its group."""
        effects: list[Effect] = []
        for name, cell in cells.items():
            shown = state(name, cell, self.ballot, t_s=1.0, joined=joined)
            effects += self.tell(replace(shown, attended=name not in unattended))
        return effects


def leading(
    cells: Cells,
    lanes: dict[Name, int] | None = None,
    t_s: float = T_S,
    scenario: Scenario = PAPER,
) -> Desk:
    """Return a coordinator that leads and has received a census."""
    desk = Desk(scenario=scenario)
    desk.lead()
    desk.tell(census(cells, lanes, t_s))
    return desk


def census(cells: Cells, lanes: dict[Name, int] | None = None, t_s: float = T_S) -> Census:
    entries = tuple(
        CensusEntry(name, cell, (lanes or {}).get(name, 0), 0.0) for name, cell in cells.items()
    )
    return Census(t_s, entries, (), *closed_blocks(entries, t_s))


def state(
    name: Name,
    cell: Cell = (0, 0),
    promised: Ballot | None = None,
    *,
    accepted: bool = False,
    t_s: float = 0.0,
    joined: tuple[int, ...] | None = None,
) -> VehicleState:
    block = PAPER.lattice.block_of(cell[0]) if -8 < cell[0] <= 0 else 0
    return holding(
        name,
        promised,
        cell,
        block=block,
        joined=(block,) if joined is None else joined,
        accepted=accepted,
        ready=accepted,
        t_s=t_s,
    )


def messages(effects: Iterable[Effect], kind: type) -> list[Send]:
    return [e for e in effects if isinstance(e, Send) and isinstance(e.message, kind)]


def jobs(effects: Iterable[Effect]) -> list[Compute]:
    return [e for e in effects if isinstance(e, Compute)]


def logged(effects: Iterable[Effect]) -> list[str]:
    return [e.message.kind for e in messages(effects, LogEvent)]
