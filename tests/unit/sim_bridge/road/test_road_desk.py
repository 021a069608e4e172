"""Requests of operators, on a road that no agent drives."""

from __future__ import annotations

import json
from collections.abc import Iterable
from typing import Any

import msgpack
import pytest
from attrs import evolve

from laneweave.protocol.runtime.node import QueryArrived, Reply
from laneweave.protocol.scenario.road_tables import Demand
from laneweave.protocol.wire.obstacle_messages import BREAKDOWN
from laneweave.protocol.wire.topics import ROAD_REQUEST
from laneweave.sim_bridge.road.obstacles import Breakdown
from laneweave.sim_bridge.road.road_desk import MAX_WAITING, RoadDesk
from support.closed_lanes import LonelyRoad, road_with

ROAD = road_with(s3_m=850.0)


class Desk:
    """A road with an operators' desk."""

    def __init__(self, *breakdowns: Breakdown, volume: float = 1000.0, at_s: float = 0.0) -> None:
        """Let vehicles drive until a road time."""
        demand = Demand(volume_veh_per_lane_h=volume, duration_s=100.0)
        self.road = LonelyRoad(evolve(ROAD, demand=demand), breakdowns)
        self.desk = RoadDesk(self.road.scenario, self.road.roadside.obstacles)
        self.answers: dict[int, Reply] = {}
        self.tokens = 0
        self.run(at_s)

    def run(self, until_s: float) -> None:
        while self.road.t_s < until_s - 1e-9:
            self.road.step()
            self.note(self.desk.update(self.road.vehicles, self.road.t_s))
            assert self.road.overlaps == []

    def ask(self, data: object, *, packed: bool = False) -> int:
        self.tokens += 1
        payload = msgpack.packb(data) if packed else json.dumps(data).encode()
        query = QueryArrived(self.tokens, payload, topic=ROAD_REQUEST)
        self.note(self.desk.take(query, self.road.t_s))
        return self.tokens

    def note(self, replies: Iterable[Reply]) -> None:
        for reply in replies:
            assert reply.token not in self.answers
            self.answers[reply.token] = reply

    def answer(self, token: int) -> dict[str, Any]:
        content: dict[str, Any] = json.loads(self.answers[token].payload)
        return content


def close(**fields: object) -> dict[str, object]:
    data = {"schema": "laneweave.road.request/1", "action": "close", "lane": 1}
    return data | {"from_m": 500.0, "to_m": 600.0} | fields


def test_a_part_is_closed_and_opened_again_after_its_time() -> None:
    desk = Desk(at_s=10.0)
    token = desk.ask(close(for_s=30.0))
    assert not desk.answers
    desk.run(11.0)
    answer = desk.answer(token)
    assert desk.answers[token].ok
    (part,) = answer["parts"]
    assert (part["lane"], part["from_m"], part["to_m"]) == (1, 500.0, 600.0)
    assert part["until_s"] == pytest.approx(answer["t_s"] + 30.0, abs=0.2)
    assert answer["leave_m"] > 100.0
    (closed,) = desk.road.roadside.obstacles.active
    assert closed.part.from_m == 500.0
    desk.run(200.0)
    assert desk.road.roadside.obstacles.active == []


def test_a_part_is_cleared_first_or_the_request_is_refused_in_words() -> None:
    desk = Desk(at_s=60.0, volume=1500.0)
    inside = [
        name
        for name, vehicle in desk.road.vehicles.items()
        if vehicle.cell[1] == 1 and 500.0 <= vehicle.state[0] < 605.0
    ]
    assert inside
    at_once = desk.ask(close(clear_s=0.0))
    desk.run(60.1)
    later = desk.ask(close(clear_s=15.0))
    refused = desk.answer(at_once)
    assert not desk.answers[at_once].ok
    assert refused["code"] == "refused"
    assert f"lane 1 stays open: {len(inside)} vehicle" in refused["message"]
    assert inside[0] in refused["message"]
    assert later not in desk.answers
    desk.run(60.2)
    # Meanwhile the part is cleared; nobody plans here, so that vehicles go on to come.
    (cleared,) = desk.road.roadside.obstacles.cleared
    assert (cleared.lane, cleared.to_m) == (1, 600.0)
    assert cleared.from_m < 450.0
    desk.run(80.0)
    assert later in desk.answers
    desk.run(80.2)
    assert desk.road.roadside.obstacles.cleared == ()


def test_an_operator_opens_what_is_closed_or_still_to_be_closed() -> None:
    desk = Desk(at_s=10.0)
    desk.ask(close())
    desk.run(11.0)
    elsewhere = desk.ask(close(action="open", from_m=600.0, to_m=700.0))
    assert desk.answer(elsewhere)["message"] == "no part of lane 1 is closed there"
    opened = desk.ask({"schema": "laneweave.road.request/1", "action": "open", "lane": 1})
    (part,) = desk.answer(opened)["parts"]
    assert part["from_m"] == 500.0
    desk.run(60.0)
    assert desk.road.roadside.obstacles.active == []
    waiting = desk.ask(close(clear_s=300.0, from_m=300.0, to_m=600.0))
    desk.run(60.2)
    opened = desk.ask(close(action="open"))
    assert desk.answers[opened].ok
    desk.run(60.4)
    assert "opened again before" in desk.answer(waiting)["message"]
    assert not desk.road.roadside.obstacles


def test_a_part_with_a_vehicle_that_has_broken_down_stays_closed() -> None:
    desk = Desk(Breakdown(20.0, lane=1, at_m=300.0), at_s=40.0)
    opened = desk.ask(close(action="open", from_m=0.0, to_m=1000.0))
    assert "broken down" in desk.answer(opened)["message"]
    (obstacle,) = desk.road.roadside.obstacles.active
    assert obstacle.kind == BREAKDOWN
    again = desk.ask(close(from_m=obstacle.part.from_m - 20.0, to_m=obstacle.part.to_m + 20.0))
    assert "breakdown" in desk.answer(again)["message"]


@pytest.mark.parametrize(
    ("fields", "named"),
    [
        ({"lane": 3}, "lane"),
        ({"lane": -1}, "lane"),
        ({"lane": "1"}, "lane"),
        ({"from_m": 20.0}, "from_m"),
        ({"from_m": 600.0}, "to_m"),
        ({"to_m": 1e9}, "to_m"),
        ({"to_m": 1000.0}, "from_m"),
        ({"clear_s": -1.0}, "clear_s"),
        ({"for_s": float("nan")}, "for_s"),
        ({"action": "remove"}, "action"),
        ({"schema": "laneweave.road.request/2"}, "schema"),
        ({"speed_mps": 5.0}, "speed_mps"),
    ],
    ids=str,
)
def test_a_wrong_request_is_refused_with_the_name_of_the_field(
    fields: dict[str, object], named: str
) -> None:
    desk = Desk()
    for packed in (False, True):
        token = desk.ask(close(**fields), packed=packed)
        assert not desk.answers[token].ok
        payload = desk.answers[token].payload
        data = msgpack.unpackb(payload) if packed else json.loads(payload)
        assert (data["code"], data["field"]) == ("invalid", named)
    assert not desk.road.roadside.obstacles


@pytest.mark.parametrize("payload", [b"", b"\xff", b"[]", b"null", b"{" * 2000, bytes(5000)])
def test_any_bytes_are_answered(payload: bytes) -> None:
    desk = Desk()
    desk.note(desk.desk.take(QueryArrived(1, payload, topic=ROAD_REQUEST), 0.0))
    assert not desk.answers[1].ok


def test_requests_that_wait_are_bounded_and_answered_when_the_road_ends() -> None:
    desk = Desk(at_s=60.0, volume=1500.0)
    places = [300.0 + 20.0 * number for number in range(MAX_WAITING)]
    first = [desk.ask(close(clear_s=300.0, from_m=at_m, to_m=at_m + 20.0)) for at_m in places]
    again = desk.ask(close(from_m=310.0, to_m=320.0))
    assert "to be closed" in desk.answer(again)["message"]
    overloaded = desk.ask(close(lane=2))
    assert desk.answer(overloaded)["code"] == "overloaded"
    desk.note(desk.desk.close())
    assert {desk.answer(token)["message"] for token in first} == {"the road has ended"}
