"""An agent that receives numbers that no correct sender has, or has them no longer."""

from __future__ import annotations

from typing import Any

import pytest
from msgspec.structs import replace

from laneweave.agents.core import AgentCore
from laneweave.agents.host import AgentHost
from laneweave.launch.fault_search.road.stand_ins import LightDriver
from laneweave.protocol.runtime.node import (
    Announce,
    Arrived,
    Effect,
    PeerDown,
    PeerUp,
    Refuse,
    Started,
)
from laneweave.protocol.scenario.deployment_fields import Shard
from laneweave.protocol.wire.bounds import CLAIM_AHEAD_NS, DAY_NS, max_term
from laneweave.protocol.wire.identities import above
from laneweave.protocol.wire.messages import (
    Ballot,
    Census,
    CensusEntry,
    Command,
    Name,
    PendingTransfer,
    Prepare,
    Sense,
    VehicleState,
)
from laneweave.protocol.wire.newest import FORGET_S
from laneweave.protocol.wire.obstacle_messages import Obstacle, Obstacles
from laneweave.protocol.wire.topics import (
    BRIDGE_ALIVE,
    CENSUS,
    OBSTACLES,
    PLAN,
    PREPARE,
    SENSE,
    VEHICLE_ALIVE,
)
from support.paper import PAPER
from support.states import BALLOT, make_plan, sense_in, sent

HUGE = 2**63 - 1
ME = Name("me")
HOME = (-1, 1)
TICK_S = PAPER.runtime.tick_s
HIGH = Ballot(HUGE, Name("zz"), HUGE, HUGE)
BRIDGE = 1000


class Seat:
    """An agent in charge of a vehicle, and the motion controller's side of the claim."""

    def __init__(self) -> None:
        """Let the agent claim its vehicle; incarnations are 1001, 1002, ..."""
        self.given = BRIDGE
        self.agent = AgentCore(ME, self._next, PAPER, LightDriver)
        self.tick = 50
        self.in_charge = 0
        self.caretaker = False
        self.drive(3)
        assert self.agent.in_charge

    def _next(self) -> int:
        self.given += 1
        return self.given

    @property
    def now_s(self) -> float:
        return self.tick * TICK_S

    def sense(self, **changes: Any) -> Sense:  # noqa: ANN401 (fields)
        values = {"incarnation": self.in_charge, "caretaker": self.caretaker, "bridge": BRIDGE}
        return sense_in(HOME, **({"tick": self.tick} | values | changes))

    def feel(self, **changes: Any) -> list[Effect]:  # noqa: ANN401 (fields)
        return self.agent.handle(Arrived(SENSE, {"vehicle": ME}, self.sense(**changes)), self.now_s)

    def drive(self, ticks: int) -> None:
        """Let the road show ticks; the controller takes claims that are not absurd."""
        for _ in range(ticks):
            self.tick += 1
            for command in sent(self.feel(), Command):
                right = command.tick == self.tick and command.record.incarnation > self.in_charge
                if right and command.record.incarnation <= CLAIM_AHEAD_NS:
                    self.in_charge, self.caretaker = command.record.incarnation, False

    def prepare(self, ballot: Ballot) -> list[Effect]:
        message = Prepare(ballot, (0,), (ME,))
        return self.agent.handle(Arrived(PREPARE, {"vehicle": ME}, message), self.now_s)


def refused(effects: list[Effect]) -> bool:
    return [each for each in effects if isinstance(each, Refuse)] != []


@pytest.mark.parametrize(
    "changes",
    [
        {"incarnation": HUGE},
        {"incarnation": HUGE, "caretaker": True},
        {"bridge": HUGE},
        {"tick": HUGE},
        {"tick": 900_000},
        {"t_s": 1e12},
        {"promised": HIGH},
        {"accepted": HIGH},
        {"transfer": PendingTransfer(HIGH)},
        {"left": True, "bridge": HUGE},
    ],
)
def test_impossible_numbers_change_nothing(changes: dict[str, Any]) -> None:
    seat = Seat()
    seat.prepare(BALLOT)
    seat.tick += 1
    assert refused(seat.feel(**changes))
    seat.drive(1)
    assert seat.agent.in_charge
    assert not seat.agent.ended
    assert seat.agent.execution is not None
    assert seat.agent.execution.promised == BALLOT


@pytest.mark.parametrize(
    "changes",
    [
        {"bridge": DAY_NS},
        {"tick": 100},
        {"incarnation": DAY_NS // 2},
        {"incarnation": DAY_NS // 2, "caretaker": True},
        {"incarnation": 3 * DAY_NS // 2, "caretaker": True},
    ],
)
def test_what_the_road_does_not_show_is_forgotten(changes: dict[str, Any]) -> None:
    """Afterwards the agent acts like a new process: it has promised nothing."""
    seat = Seat()
    seat.prepare(BALLOT)
    before = seat.agent._claim.incarnation
    for _ in range(10):
        seat.feel(**changes)
        seat.drive(1)
    seat.drive(round(FORGET_S / TICK_S) + 4)
    assert seat.agent.in_charge
    execution = seat.agent.execution
    assert execution is not None
    assert execution.promised is None or execution.incarnation == before


def test_a_claim_above_a_wrong_process_in_charge_is_taken_back() -> None:
    seat = Seat()
    seat.tick += 1
    seat.feel(incarnation=DAY_NS // 2, caretaker=True)
    assert seat.agent._claim.incarnation > DAY_NS // 2
    seat.drive(3)
    assert seat.agent.in_charge
    assert seat.agent._claim.incarnation == seat.given < DAY_NS // 2


def test_it_takes_charge_of_a_vehicle_whose_process_in_charge_is_nearly_a_day_ahead() -> None:
    """Such as after a forged COMMAND, from which the caretaker took over."""
    seat = Seat()
    seat.in_charge, seat.caretaker = DAY_NS - 10**9, True
    seat.drive(3)
    assert seat.agent.in_charge
    assert seat.agent._claim.incarnation == above(seat.given, DAY_NS - 10**9)


def test_a_ballot_of_an_impossible_term_is_not_promised() -> None:
    seat = Seat()
    limit = max_term(seat.now_s)
    assert refused(seat.prepare(HIGH))
    assert refused(seat.prepare(BALLOT._replace(term=limit + 1)))
    (state,) = sent(seat.prepare(BALLOT._replace(term=limit)), VehicleState)
    assert state.record.promised is not None
    assert state.record.promised.term == limit
    seat.drive(1)
    assert sent(seat.prepare(BALLOT._replace(term=limit + 1)), VehicleState)


# --- shards -----------------------------------------------------------------------------------

PROCESS = Name("p")


class Fleet:
    """An agent process with a shard, on the road of bridge 1000."""

    def __init__(self) -> None:
        """Host the agent of one vehicle."""
        self.host = AgentHost(
            PROCESS,
            lambda name: AgentCore(name, lambda: 1, PAPER, LightDriver),
            BRIDGE,
            PAPER.runtime,
            shard=Shard(0, 1),
        )
        self.now_s = 0.0
        self.token(BRIDGE)
        assert Announce(VEHICLE_ALIVE, {"process": PROCESS, "vehicle": ME}) in self.census()

    def token(self, incarnation: object, *, up: bool = True) -> list[Effect]:
        kind = PeerUp if up else PeerDown
        return self.host.handle(kind(BRIDGE_ALIVE, {"incarnation": str(incarnation)}), self.now_s)

    def census(self, **changes: Any) -> list[Effect]:  # noqa: ANN401 (fields)
        self.now_s += 1.0
        entries = (CensusEntry(ME, HOME, 0, 0.0),)
        made = replace(Census(self.now_s, entries, (), bridge=BRIDGE), **changes)
        return self.host.handle(Arrived(CENSUS, {}, made), self.now_s)


@pytest.mark.parametrize("changes", [{"bridge": HUGE}, {"t_s": 1e12}, {"t_s": 9e6}])
def test_a_shard_keeps_its_agents_whatever_census_is_forged(changes: dict[str, Any]) -> None:
    fleet = Fleet()
    assert all(isinstance(each, Refuse) for each in fleet.census(on_road=(), **changes))
    assert fleet.census() == []  # it still has the vehicle, and reads the census


def test_a_shard_ignores_the_token_of_an_impossible_bridge() -> None:
    fleet = Fleet()
    assert refused(fleet.token(HUGE))
    assert fleet.census() == []


def test_a_shard_returns_to_the_bridge_whose_token_is_left() -> None:
    fleet = Fleet()
    fleet.token(DAY_NS)
    assert fleet.census() == []
    fleet.token(DAY_NS, up=False)
    assert Announce(VEHICLE_ALIVE, {"process": PROCESS, "vehicle": ME}) in fleet.census()


@pytest.mark.parametrize("slot_s", [0.3, 60.0, 1e6])
def test_slots_of_no_scenario_are_refused(slot_s: float) -> None:
    """No trajectory fits into the first one, and one of the last one would take hours to make."""
    seat = Seat()
    seat.agent.handle(Arrived(PREPARE, {}, Prepare(BALLOT, (0,), (ME,))), seat.now_s)
    plan = make_plan(
        {ME: HOME},
        {ME: ((0, HOME, (-1, 2)),)},
        incarnations={ME: seat.in_charge},
        slot_s=slot_s,
        t0_s=0.0,
    )
    (refused,) = seat.agent.handle(Arrived(PLAN, {}, plan), seat.now_s)
    assert isinstance(refused, Refuse)
    assert refused.error.field == "slot_s"
    seat.drive(3)


@pytest.mark.parametrize(
    "parts",
    [
        Obstacles(1e12, (Obstacle(0, 0.1, 999.0),), BRIDGE),
        Obstacles(1.0, (Obstacle(0, 1.0, 8.0, late_m=-1000.0),), BRIDGE),
        Obstacles(1.0, (), 2**62),
    ],
)
def test_absurd_parts_of_lanes_are_refused(parts: Obstacles) -> None:
    given = iter(range(BRIDGE + 1, BRIDGE + 100))
    host = AgentHost(
        ME, lambda name: AgentCore(name, given.__next__, PAPER), BRIDGE, PAPER.runtime, [ME]
    )
    host.handle(Started(), 0.0)
    host.handle(PeerUp(BRIDGE_ALIVE, {"incarnation": str(BRIDGE)}), 0.0)
    (refused,) = host.handle(Arrived(OBSTACLES, {}, parts), 1.0)
    assert isinstance(refused, Refuse)
    correct = Obstacles(1.0, (Obstacle(2, 600.0, 700.0),), BRIDGE)
    assert not host.handle(Arrived(OBSTACLES, {}, correct), 1.1)
    assert host._obstacles == correct
