"""What a status is made of: tallies of what was heard, losses, verdicts."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable

import pytest
from attrs import define, evolve, field

from laneweave.launch.observe.role_health import AGENT, BRIDGE, COORDINATOR, RoleHealth
from laneweave.launch.observe.status import Plans, Status, status_of
from laneweave.launch.observe.tally import HEARD, Tally
from laneweave.protocol.runtime.node import Arrived, PeerDown, PeerUp
from laneweave.protocol.runtime.transport import LinkDown
from laneweave.protocol.wire.messages import (
    Ballot,
    Census,
    CensusEntry,
    ClosedFormation,
    Heartbeat,
    Name,
    RoadClock,
    VehicleState,
)
from laneweave.protocol.wire.topics import (
    BRIDGE_ALIVE,
    CENSUS,
    CLOCK,
    COORDINATOR_ALIVE,
    HEARTBEAT,
    STATE,
    VEHICLE_ALIVE,
    Quality,
)

ELECTION_S = 0.7
STATE_OF_A = VehicleState(
    vehicle=Name("a"),
    incarnation=1,
    formation=0,
    joined=(0,),
    promised=None,
    accepted=False,
    ready=False,
    completed=0,
    hold_cell=(0, 0),
    moving=False,
    go=False,
    done=False,
    overdue=False,
    attended=True,
    s_m=0.0,
    y_m=0.0,
    speed_mps=15.0,
    t_s=0.0,
)


@define
class Ear:
    """Hears a realm from second 0 on."""

    tally: Tally = field(factory=lambda: Tally(0.0))

    def heartbeat(
        self, name: str, term: int, now_s: float, *, leading: bool = False, incarnation: int = 1
    ) -> None:
        message = Heartbeat(Name(name), incarnation, term, leading=leading, formations=2)
        self.tally.take(Arrived(HEARTBEAT, {"coordinator": name}, message), now_s)

    def coordinator(self, name: str, *, up: bool = True) -> None:
        kind = PeerUp if up else PeerDown
        self.tally.take(kind(COORDINATOR_ALIVE, {"coordinator": name, "incarnation": "1"}), 0.0)

    def bridge(self, *, up: bool = True) -> None:
        kind = PeerUp if up else PeerDown
        self.tally.take(kind(BRIDGE_ALIVE, {"incarnation": "7"}), 0.0)

    def agent(self, vehicle: str) -> None:
        self.tally.take(PeerUp(VEHICLE_ALIVE, {"vehicle": vehicle}), 0.0)

    def clock(self, tick: int, *, ended: bool = False, bridge: int = 7, on_road: int = 1) -> None:
        message = RoadClock(
            tick, tick / 10, demanded=9, entered=5, on_road=on_road, left=4, ended=ended,
            bridge=bridge,
        )  # fmt: skip
        self.tally.take(Arrived(CLOCK, {}, message), tick / 10)

    def census(
        self, tick: int, closed: tuple[ClosedFormation, ...] = (), **entered_s: float
    ) -> None:
        entries = tuple(CensusEntry(Name(one), (0, 0), 0, at) for one, at in entered_s.items())
        message = Census(tick / 10, entries, (), closed, bridge=7)
        self.tally.take(Arrived(CENSUS, {}, message), tick / 10)

    def states(self, vehicle: str, ticks: Iterable[int], **changes: object) -> None:
        for tick in ticks:
            state = evolve(STATE_OF_A, vehicle=Name(vehicle), t_s=tick / 10)
            state = evolve(state, **changes)  # type: ignore[arg-type]
            self.tally.take(Arrived(STATE, {"vehicle": vehicle}, state), tick / 10)

    def status(self, now_s: float = 2.0) -> Status:
        return status_of(self.tally, now_s, ELECTION_S)


@pytest.fixture
def ear() -> Ear:
    return Ear()


@pytest.fixture
def well(ear: Ear) -> Ear:
    """A deployment that is well: c1 leads, and one vehicle drives."""
    ear.coordinator("c1")
    ear.heartbeat("c1", 3, 1.9, leading=True)
    ear.bridge()
    ear.agent("a")
    for tick in range(100, 121):
        ear.clock(tick)
    ear.census(110, a=1.0)
    ear.states("a", range(100, 121))
    return ear


def test_one_who_only_looks_holds_nobody_up() -> None:
    assert {topic.quality for topic in HEARD} == {Quality.LATEST}
    assert {STATE, CLOCK, CENSUS, HEARTBEAT} <= set(HEARD)


def test_all_is_well(well: Ear) -> None:
    found = well.status()
    assert (found.healthy, found.problem) == (True, None)
    assert (found.leader, found.term, found.claims) == ("c1", 3, ("c1",))
    assert found.road is not None
    assert (found.road.t_s, found.road.advanced_s, found.road.pace) == (12.0, 2.0, 1.0)
    assert (found.vehicles.attended, found.vehicles.agents) == (1, 1)
    assert (found.loss.clock, found.loss.state) == (0.0, 0.0)
    assert found.messages_per_s["clock"] == 10.5
    told = json.loads(json.dumps(found.to_dict()))
    assert told["schema"] == "laneweave.status/1"
    assert told["plans"] == {
        "in_force": 2, "operation": "formations", "formations": 0, "formations_with_plan": 0,
    }  # fmt: skip


def test_nothing_was_heard(ear: Ear) -> None:
    found = ear.status()
    assert found.problem == "nobody leads: no coordinator is there"
    assert (found.road, found.loss.clock, found.loss.state) == (None, None, None)


def test_coordinators_without_a_leader(ear: Ear) -> None:
    for name in ("c1", "c2"):
        ear.coordinator(name)
    ear.heartbeat("c1", 3, 1.0, leading=True)  # too long ago
    ear.heartbeat("c2", 3, 1.9)
    assert ear.status().problem == "nobody leads: 2 coordinators are there"


def test_two_who_claim_to_lead_are_shown(ear: Ear) -> None:
    ear.heartbeat("c1", 3, 1.9, leading=True)
    ear.heartbeat("c2", 4, 1.9, leading=True)
    found = ear.status()
    assert (found.leader, found.term, found.claims) == ("c2", 4, ("c2", "c1"))
    assert found.healthy
    assert not any(one.token for one in found.candidates)


def test_two_of_one_name_are_a_problem(ear: Ear) -> None:
    ear.heartbeat("c1", 3, 1.9, leading=True)
    ear.heartbeat("c1", 3, 1.9, leading=True, incarnation=2)
    assert ear.status().problem == "2 coordinators are called c1: names must differ"


def test_one_that_was_killed_and_started_again_is_none(ear: Ear) -> None:
    ear.heartbeat("c1", 3, 0.9)
    ear.heartbeat("c1", 3, 1.9, leading=True, incarnation=2)
    assert ear.status().healthy


def test_who_is_gone_is_no_candidate(ear: Ear) -> None:
    ear.coordinator("c1")
    ear.heartbeat("c1", 3, 1.9, leading=True)
    ear.coordinator("c1", up=False)
    assert ear.status().candidates == ()
    ear.coordinator("c1")
    assert ear.status().leader == "c1"


def _standing(ear: Ear) -> None:
    ear.clock(5)
    ear.bridge()


def _gone(ear: Ear) -> None:
    for tick in (5, 6):
        ear.clock(tick)


@pytest.mark.parametrize(
    ("happens", "problem"),
    [
        (Ear.bridge, "a bridge is there, but its clock was not heard for 2.0 s"),
        (_standing, "the road stands still at 0.5 s for 2.0 s"),
        (_gone, "the bridge has gone at 0.6 s, before its road had ended"),
        (lambda ear: ear.tally.take(LinkDown(), 1.0), "the connection to the router was lost"),
    ],
)
def test_what_is_wrong(ear: Ear, happens: Callable[[Ear], None], problem: str) -> None:
    ear.heartbeat("c1", 3, 1.9, leading=True)
    assert ear.status().healthy
    happens(ear)
    assert ear.status().problem == problem


def test_a_road_that_has_ended_is_well(ear: Ear) -> None:
    ear.heartbeat("c1", 3, 1.9, leading=True)
    ear.clock(5, ended=True)
    assert ear.status().healthy


def test_another_bridge_is_another_road(well: Ear) -> None:
    for tick in (3, 4):
        well.clock(tick, bridge=8)
    found = well.status()
    assert found.road is not None
    assert found.road.t_s == 0.4
    assert found.vehicles.attended == 0


def test_who_speaks_for_vehicles(well: Ear) -> None:
    well.census(112, a=1.0, b=1.0, c=1.0)
    well.states("b", [112], attended=False, accepted=True, promised=Ballot(1, Name("c"), 1, 1))
    vehicles = well.status().vehicles
    assert (vehicles.attended, vehicles.unattended, vehicles.unheard) == (1, 1, 1)
    well.states("b", [113], estate=((0, 0),))
    assert well.status().plans.operation == "rolling"


def test_formations_are_counted_not_their_columns(well: Ear) -> None:
    assert well.status().plans == Plans(2, "formations", 0, 0)
    closed = (ClosedFormation(0, 2, 3.0), ClosedFormation(3, 7, 9.0))
    vehicles = dict.fromkeys("abcd", 1.0)
    well.census(112, closed, **vehicles)
    # Vehicles show the column in which they entered; the last one's formation is still open.
    for name, column in zip(vehicles, (0, 2, 5, 8), strict=True):
        well.states(name, [112], formation=column)
    assert well.status().plans == Plans(2, "formations", 2, 0)
    promised = Ballot(1, Name("c"), 1, 1)
    for name, column in (("a", 0), ("b", 2), ("d", 8)):
        well.states(name, [113], formation=column, accepted=True, promised=promised)
    assert well.status().plans == Plans(2, "formations", 2, 1)
    well.states("c", [113], formation=5, accepted=True, promised=promised)
    assert well.status().plans == Plans(2, "formations", 2, 2)


# --- loss ----------------------------------------------------------------------------------------


def road(ear: Ear, ticks: Iterable[int] = range(100, 121)) -> Ear:
    for tick in ticks:
        ear.clock(tick)
    return ear


def test_loss_of_clocks(ear: Ear) -> None:
    road(ear, [100, 101, 104, 104, 109])
    assert ear.status().loss.clock == pytest.approx(0.6)


@pytest.mark.parametrize(
    ("shown", "lost"),
    [
        (range(100, 121), 0),
        (range(101, 120), 0),  # neither the first nor the last tick counts
        ([*range(100, 121), *range(100, 121)], 0),
        ([tick for tick in range(100, 121) if tick % 4], 4 / 19),
        (range(100, 111), 0 / 10),  # from its last state on the census says nothing newer
        (range(108, 121), 7 / 19),
        ([], 1.0),
    ],
)
def test_loss_of_states(ear: Ear, shown: Iterable[int], lost: float) -> None:
    road(ear).census(110, a=1.0)
    ear.states("a", shown)
    assert ear.status().loss.state == pytest.approx(lost, abs=1e-5)


def test_who_enters_counts_from_its_first_state_on(ear: Ear) -> None:
    road(ear).census(115, a=10.5)
    ear.states("a", [108, 109, 111, 112, 113, 114, 115])
    assert ear.status().loss.state == pytest.approx(1 / 8)


def test_who_leaves_counts_up_to_its_last_state(ear: Ear) -> None:
    road(ear).census(115)
    ear.states("a", [100, 101, 102, 104])
    # It is in no census, so nobody knows since when it has been there.
    assert ear.status().loss.state == pytest.approx(1 / 4)


# --- one role ------------------------------------------------------------------------------------


def problem(ear: Ear, health: RoleHealth) -> str | None:
    return health.problem(ear.tally, 2.0, ELECTION_S)


def test_health_of_a_coordinator(ear: Ear) -> None:
    health = RoleHealth(COORDINATOR, "c2")
    ear.heartbeat("c1", 1, 1.9, leading=True)
    assert problem(ear, health) == "coordinator c2 is not there"
    ear.coordinator("c2")
    ear.heartbeat("c2", 1, 1.2)
    assert problem(ear, health) == "coordinator c2 is there, but was not heard for 0.7 s"
    ear.heartbeat("c2", 1, 1.4)
    assert problem(ear, health) is None


def test_health_of_a_bridge(ear: Ear) -> None:
    health = RoleHealth(BRIDGE)
    assert problem(ear, health) == "no bridge is there"
    ear.bridge()
    ear.clock(5)
    assert problem(ear, health) is not None
    ear.clock(6)
    assert problem(ear, health) is None


def test_health_of_agents(ear: Ear) -> None:
    alone = RoleHealth(AGENT, "a")
    assert problem(ear, alone) == "a: its agent is not there"
    shard = RoleHealth(AGENT, "0/2", lambda vehicle: vehicle in "ab", is_shard=True)
    assert problem(ear, shard) is None
    assert not shard.may_end_early(ear.tally)
    ear.census(10, a=0.0, b=0.0, c=0.0)
    assert shard.may_end_early(ear.tally)
    assert problem(ear, shard) == "shard 0/2: 2 vehicles are unattended, a among them"
    ear.agent("a")
    ear.agent("b")
    assert problem(ear, alone) is None
    assert problem(ear, shard) is None
    ear.states("b", [10], attended=False)
    assert problem(ear, shard) == "shard 0/2: 1 vehicles are unattended, b among them"
