"""The light road: bodies, the real motion controller's rules, caretakers, clocks, census."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import count, pairwise

import pytest

from laneweave.launch.fault_search.checks.checker import Checker
from laneweave.launch.fault_search.checks.geometry import Geometry
from laneweave.launch.fault_search.road.drawn_entrance import DrawnTraffic, drawn_roadside
from laneweave.launch.fault_search.road.light_road import LightRoad, Reception
from laneweave.launch.fault_search.road.light_vehicle import Visit
from laneweave.launch.fault_search.road_setup import RoadSetup
from laneweave.protocol.lattice import Cell
from laneweave.protocol.runtime.node import Arrived, Effect, PeerDown, PeerUp, Send, Started, Wakeup
from laneweave.protocol.vehicle.motion import at_rest_in_cell
from laneweave.protocol.wire.messages import (
    Ballot,
    Census,
    Command,
    CurrentMotion,
    Name,
    Sense,
    VehicleRecord,
)
from laneweave.protocol.wire.topics import COMMAND, VEHICLE_ALIVE

SCENARIO = RoadSetup(lanes=3).make_scenario()
A = Name("a")
OWN = {"process": "a", "vehicle": "a"}


class Bench:
    """A road with one vehicle, driven by hand."""

    def __init__(self, **visit: float | None) -> None:
        """Open the road."""
        self.log: list[tuple[float, str]] = []
        checker = Checker(Geometry(15.0, 3.5, 5.0, 1.8), lambda *event: self.log.append(event))
        given = {"enters_s": 0.0, "leaves_s": None} | visit
        guest = Visit(A, (4, 1), **given)  # type: ignore[arg-type]
        self.reception = Reception.IN_TIME
        self.road = LightRoad(
            SCENARIO,
            drawn_roadside(SCENARIO, DrawnTraffic([guest], {A: 2})),
            {A: guest},
            checker,
            count(100).__next__,
            lambda: 0.8,
            lambda _: self.reception,
        )
        self.now_s = 0.0
        self.first = messages(self.road.handle(Started(), 0.0))

    def tick(self) -> list[object]:
        """Let the next tick happen and return the messages sent."""
        self.now_s = self.road.wakeup_s
        return messages(self.road.handle(Wakeup(), self.now_s))

    def sense(self) -> Sense:
        return next(message for message in self.tick() if isinstance(message, Sense))

    def command(
        self, incarnation: int, cell: Cell, tick: int | None = None, accepted: Ballot | None = None
    ) -> list[object]:
        tick = self.road.tick if tick is None else tick
        record = VehicleRecord(incarnation=incarnation, accepted=accepted)
        command = Command(A, record, tick, cell, CurrentMotion((4, 1), tick + 8), b"")
        return messages(self.road.handle(Arrived(COMMAND, OWN, command), self.now_s))

    def agent(self, *, up: bool) -> None:
        event = PeerUp if up else PeerDown
        list(self.road.handle(event(VEHICLE_ALIVE, OWN), self.now_s))


def messages(effects: Iterator[Effect]) -> list[object]:
    return [effect.message for effect in effects if isinstance(effect, Send)]


@pytest.fixture
def bench() -> Bench:
    """A road in its first tick, its vehicle driven by process 7."""
    bench = Bench()
    bench.agent(up=True)
    bench.command(7, (4, 1))
    return bench


def test_the_process_in_charge_moves_the_body(bench: Bench) -> None:
    bench.tick()
    bench.command(7, (4, 2))
    assert bench.log == [
        (0.0, "*** a enters in (4, 1)"),
        (0.1, "*** a moves from (4, 1) to (4, 2) in 0.80 s"),
    ]
    lateral = [bench.sense().measured[3] for _ in range(9)]
    assert lateral[3] == pytest.approx(1.5 * 3.5 + 3.5 * 0.5)
    assert lateral[7] == lateral[8] == 2.5 * 3.5


def test_a_lost_command_changes_nothing(bench: Bench) -> None:
    bench.tick()
    bench.reception = Reception.LOST
    bench.command(7, (4, 2))
    assert len(bench.log) == 1


def test_a_late_command_is_stored_but_not_executed(bench: Bench) -> None:
    bench.tick()
    bench.reception = Reception.LATE
    promised = Ballot(1, Name("c1"), 1, 1)
    bench.command(7, (4, 2), accepted=promised)
    assert len(bench.log) == 1
    assert bench.road.vehicles[A].controller.record.accepted == promised


def test_a_late_command_counts_unless_a_newer_one_was_there(bench: Bench) -> None:
    for _ in range(3):
        bench.tick()
    bench.command(7, (4, 2), tick=2)
    bench.command(7, (4, 1), tick=1)
    bench.command(6, (4, 1))  # an earlier process
    assert len(bench.log) == 2


def test_a_wrong_clock_shifts_no_cell() -> None:
    bench = Bench(clock_offset_s=0.04, clock_drift=-0.05)
    senses = [bench.sense() for _ in range(30)]
    assert {round(sense.t_s - sense.tick * 0.1, 4) for sense in senses} != {0.0}
    for sense in senses:
        assert abs(sense.t_s - sense.tick * 0.1) <= 0.1
        assert at_rest_in_cell(sense.measured, SCENARIO.lattice, (4, 1), sense.t_s)
    assert all(one.t_s < other.t_s for one, other in pairwise(senses))


def test_a_leaving_vehicle_is_notified_and_in_no_census(bench: Bench) -> None:
    bench = Bench(leaves_s=0.25)
    bench.agent(up=True)
    sent = [bench.first, *(bench.tick() for _ in range(3))]
    census = [message for message in sent[3] if isinstance(message, Census)]
    assert [len(each.on_road) for each in census] == [0]
    assert [message.left for message in sent[3] if isinstance(message, Sense)] == [True]
    assert bench.log[-1][1] == "*** a leaves the road"
    bench.agent(up=False)
    bench.tick()
    assert not [message for message in bench.tick() if isinstance(message, Sense)]


def test_new_preferred_lanes_are_in_the_next_census(bench: Bench) -> None:
    bench.road.prefer({A: 0})
    sent = [message for _ in range(10) for message in bench.tick()]
    (census,) = [message for message in sent if isinstance(message, Census)]
    assert census.on_road[0].preferred_lane == 0
