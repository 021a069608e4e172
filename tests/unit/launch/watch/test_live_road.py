"""The live road: frames from messages."""

from __future__ import annotations

import json
import math
from typing import Any

import pytest
from msgspec.structs import replace

from laneweave.launch.observe.observed import Expected
from laneweave.launch.watch.frames import UNATTENDED, UNHEARD, compact
from laneweave.launch.watch.live_road import STILL_S, LiveRoad
from laneweave.protocol.config.scenario_files import parse_scenario
from laneweave.protocol.runtime.node import Arrived, PeerUp
from laneweave.protocol.runtime.transport import LinkDown, LinkUp
from laneweave.protocol.scenario.fields import Scenario
from laneweave.protocol.vehicle.lane_ends import dead_ends
from laneweave.protocol.wire.codec import decode, encode
from laneweave.protocol.wire.messages import ClosedFormation, Heartbeat, Name, RoadClock
from laneweave.protocol.wire.obstacle_messages import PASSING, Cleared, Obstacle, Obstacles
from laneweave.protocol.wire.process_messages import LogEvent, RoadStatus
from laneweave.protocol.wire.topics import BRIDGE_ALIVE, OBSTACLES
from support.closed_lanes import DROP
from support.convoy import BALLOT, ROLLING, Convoy
from support.states import changed
from support.tables import for_each

FORMATIONS: Scenario = parse_scenario({})
BLOCKS: Scenario = parse_scenario({"formation": {"operation": "paper"}})
CONVOY = Convoy(9, scenario=ROLLING)
START = CONVOY.first_tick


def watched(ticks: int = 21, convoy: Convoy = CONVOY) -> LiveRoad:
    """Return a road that has been watched for some ticks, from wall-clock time 0 on."""
    road = LiveRoad(convoy.scenario, wall_s=0.0)
    for tick in range(START, START + ticks):
        hear(road, convoy, tick)
    return road


def hear(road: LiveRoad, convoy: Convoy, tick: int) -> None:
    if tick == START:
        road.update(convoy.clock(tick), 0.0)
        road.update(convoy.census(tick), 0.0)
        road.update(convoy.plan(tick), 0.0)
    for send in convoy.messages(tick):
        road.update(decode(encode(send.message)), (tick - START) / 10)


def shown(road: LiveRoad, wall_s: float = 2.0) -> dict[str, Any]:
    frame: dict[str, Any] = json.loads(compact(road.frame(7, wall_s)))
    return frame


def test_before_the_first_message() -> None:
    road = LiveRoad(ROLLING, wall_s=5.0)
    frame = shown(road, 6.0)
    assert (frame["n"], frame["run"], frame["t"], frame["w"]) == (7, 0, None, 6.0)
    assert (frame["status"], frame["since"]) == ("waiting", 5.0)
    assert (frame["vehicles"], frame["leader"], frame["candidates"]) == ([], None, [])
    assert (frame["counts"], frame["plan"]) == (None, None)


def test_vehicles_are_shown_at_their_published_positions() -> None:
    frame = shown(watched())
    assert (frame["status"], frame["t"]) == ("live", round((START + 20) / 10, 3))
    assert frame["counts"] == [9, 9, 9, 0]
    assert len(frame["vehicles"]) == 9
    for number, row in enumerate(frame["vehicles"]):
        state, (column, lane) = CONVOY.state(number, START + 20), CONVOY.cell(number)
        assert row[:4] == [f"v{number:04}", *(round(x, 2) for x in (state.s_m, state.y_m, 15.0))]
        assert row[4:7] == [number % 3, -1, [column, lane]]
        assert row[8:] == [0, [column - 100, lane]]


def test_targets_are_those_of_accepted_plans() -> None:
    road = watched()
    targets = [row[7] for row in shown(road)["vehicles"]]
    assert targets == [[1, 0], *[0] * 8]
    done = CONVOY.state(0, START + 20)
    changes: tuple[dict[str, Any], ...] = (
        {"done": True},
        {"accepted": False},
        {"promised": BALLOT._replace(seq=6)},
    )
    for change in changes:
        hear(road, CONVOY, START + 20)
        road.update(changed(done, **change), 2.0)
        assert shown(road)["vehicles"][0][7] == 0


def test_a_vehicle_whose_cell_has_passed_a_stop_line_is_shown_without_a_cell() -> None:
    convoy = Convoy(9, scenario=DROP)
    (end,) = dead_ends(DROP)
    t_s = (START + 20) / 10
    for beyond_m, held in ((-1.0, True), (1.0, False)):
        road = watched(convoy=convoy)
        column = math.floor((end.line_m - DROP.lattice.cell_s_m(0, t_s)) / DROP.lattice.pitch_m)
        cell = (column + (beyond_m > 0.0), 0)
        standing = replace(convoy.state(0, START + 20), s_m=end.line_m - 2.0, hold_cell=cell)
        road.update(standing, 2.0)
        row = shown(road)["vehicles"][0]
        assert (row[1], row[4]) == (end.line_m - 2.0, 0)
        assert row[6] == (list(cell) if held else 0)
        # Without a state, it is expected in its cell, or at the line.
        road.update(convoy.clock(START + 60), 6.0)
        if not held:
            row = shown(road, 6.0)["vehicles"][0]
            assert (row[1], row[6], row[8]) == (end.line_m, 0, UNHEARD)


def test_positions_are_extrapolated_between_states() -> None:
    road = watched()
    before = shown(road)["vehicles"][0][1]
    road.update(CONVOY.clock(START + 22), 2.0)
    assert shown(road)["vehicles"][0][1] == pytest.approx(before + 0.2 * 15.0)


def test_a_vehicle_that_is_not_heard_is_shown_in_its_cell_and_marked() -> None:
    road = watched()
    for tick in range(START + 21, START + 50):
        road.update(CONVOY.clock(tick), 2.0)
        for number in range(1, 9):
            road.update(CONVOY.state(number, tick), 2.0)
    rows = shown(road)["vehicles"]
    assert [row[8] for row in rows] == [UNHEARD, *[0] * 8]
    assert rows[0][1] == pytest.approx(CONVOY.state(0, START + 49).s_m, abs=0.01)
    assert rows[0][7] == 0
    # Never heard at all: the cell in which it entered is all that is known.
    silent = LiveRoad(ROLLING, wall_s=0.0)
    silent.update(CONVOY.clock(START), 0.0)
    silent.update(CONVOY.census(START), 0.0)
    assert {row[8] for row in shown(silent)["vehicles"]} == {UNHEARD}


def test_a_vehicle_without_an_agent_is_marked() -> None:
    road = watched()
    road.update(replace(CONVOY.state(3, START + 20), attended=False), 2.0)
    assert [row[8] for row in shown(road)["vehicles"]] == [0, 0, 0, UNATTENDED, 0, 0, 0, 0, 0]


def test_vehicles_that_have_left_are_not_shown() -> None:
    road = watched()
    road.update(CONVOY.clock(START + 21), 2.0)
    road.update(CONVOY.census(START + 21, without=frozenset(CONVOY.names[:4])), 2.0)
    assert [row[0] for row in shown(road)["vehicles"]] == CONVOY.names[4:]


def test_a_vehicle_that_is_not_listed_yet_is_shown_without_a_lane() -> None:
    road, more = watched(), Convoy(10, scenario=ROLLING)
    road.update(CONVOY.clock(START + 21), 2.0)
    road.update(more.state(9, START + 21), 2.0)
    assert shown(road)["vehicles"][-1][:1] == ["v0009"]
    assert shown(road)["vehicles"][-1][4] == -1


def test_vehicles_in_lanes_that_the_page_lacks_are_reported() -> None:
    """As on a road with more lanes than the page's scenario, or by a forged state."""
    road = watched()
    state = CONVOY.state(3, START + 20)
    road.update(replace(state, hold_cell=(state.hold_cell[0], 99)), 2.0)
    census = CONVOY.census(START + 21)
    first = replace(census.on_road[0], cell=(census.on_road[0].cell[0], 3))
    road.update(replace(census, on_road=(first, *census.on_road[1:])), 2.0)
    frame = shown(road)
    assert [row[0] for row in frame["vehicles"]] == [
        name for number, name in enumerate(CONVOY.names) if number not in {0, 3}
    ]
    assert ["watch", "the page shows 3 lanes; vehicles in other lanes, not shown: 2"] in [
        row[:2] for row in frame["findings"]
    ]


def with_formations(
    scenario: Scenario, count: int, *closed: ClosedFormation
) -> tuple[LiveRoad, Convoy]:
    """Return a road with a convoy, and the formations that its census lists."""
    convoy = Convoy(count, scenario=scenario)
    road = watched(convoy=convoy)
    census = convoy.census(START + 21)
    road.update(convoy.clock(START + 21), 2.0)
    road.update(replace(census, formations=closed, closed_to=closed[-1].last_block), 2.0)
    return road, convoy


def test_formations_of_different_lengths() -> None:
    """27 vehicles, three in a column: columns 0 to -2 and -3 to -7 are closed, -8 is not."""
    closed = (ClosedFormation(0, 2, 5.0), ClosedFormation(3, 7, 9.0))
    road, convoy = with_formations(FORMATIONS, 27, *closed)
    frame = shown(road)
    assert frame["formations"] == [[3, -7, -3], [0, -2, 0]]
    assert [row[5] for row in frame["vehicles"]] == [0] * 9 + [3] * 15 + [-1] * 3
    # All blocks of one formation are one; only several formations are joined.
    for number, blocks in ((0, (0, 1, 2)), (9, (3, 4, 5, 6, 7)), (24, (8,))):
        road.update(changed(convoy.state(number, START + 21), joined=blocks), 2.0)
    assert shown(road)["joined"] == []
    road.update(changed(convoy.state(1, START + 21), joined=tuple(range(8))), 2.0)
    assert shown(road)["joined"] == [[0, 3]]


def test_formations_of_equal_length_and_those_that_are_joined() -> None:
    closed = tuple(ClosedFormation(block, block, 5.0) for block in range(7))
    road, convoy = with_formations(BLOCKS, 24, *closed)
    frame = shown(road)
    assert frame["formations"][-2:] == [[1, -7, -4], [0, -3, 0]]
    assert [row[5] for row in frame["vehicles"]] == [0] * 12 + [1] * 12
    for number, joined in ((0, (0, 1)), (1, (1, 2)), (2, (5, 6)), (3, (4,)), (4, (6, 9))):
        road.update(changed(convoy.state(number, START + 21), joined=joined), 2.0)
    assert shown(road)["joined"] == [[0, 1, 2], [5, 6]]


def test_a_vehicle_that_is_not_listed_yet_is_in_the_formation_of_its_block() -> None:
    road, _ = with_formations(FORMATIONS, 9, ClosedFormation(0, 2, 5.0))
    entering = Convoy(10, scenario=FORMATIONS).state(9, START + 22)
    for block, formation in ((2, 0), (3, -1)):
        road.update(replace(entering, block=block), 2.0)
        row = shown(road)["vehicles"][-1]
        assert (row[0], row[5]) == ("v0009", formation)


def test_the_rolling_operation_has_no_formations() -> None:
    frame = shown(watched())
    assert (frame["formations"], frame["joined"]) == ([], [])
    assert {row[5] for row in frame["vehicles"]} == {-1}


def test_leader_and_candidates() -> None:
    road = watched()
    frame = shown(road)
    followers = [["c2", 3, False, False], ["c3", 3, False, False]]
    assert frame["leader"] == ["c1", 3]
    assert frame["candidates"] == [["c1", 3, True, False], *followers]
    # A new leader; the others are silent.
    road.update(Heartbeat(Name("c2"), 18, 4, True, 0), 10.0)
    frame = shown(road, 10.1)
    assert frame["leader"] == ["c2", 4]
    assert frame["candidates"] == [
        ["c1", 3, False, True],
        ["c2", 4, True, False],
        ["c3", 3, False, True],
    ]
    # Later all are silent, and after a while they are forgotten.
    assert shown(road, 30.0)["leader"] is None
    assert shown(road, 100.0)["candidates"] == []


def test_a_newer_bridge_begins_a_new_road() -> None:
    road, later = watched(), Convoy(4, bridge=2, scenario=ROLLING)
    road.update(later.clock(1), 3.0)
    road.update(later.census(1), 3.0)
    # Late messages of the earlier road are ignored.
    road.update(CONVOY.clock(START + 21), 3.0)
    road.update(CONVOY.census(START + 21), 3.0)
    road.update(CONVOY.state(0, START + 100), 3.0)
    frame = shown(road, 3.0)
    assert (frame["run"], frame["t"]) == (2, 0.1)
    assert [row[0] for row in frame["vehicles"]] == later.names
    assert {row[8] for row in frame["vehicles"]} == {UNHEARD}


def test_the_status_and_its_beginning() -> None:
    road = watched()

    def status(wall_s: float) -> list[Any]:
        frame = shown(road, wall_s)
        return [frame["status"], frame["since"]]

    assert status(2.0) == ["live", 2.0]
    assert status(2.5) == ["live", 2.0]
    assert status(2.1 + STILL_S) == ["still", 2.0]
    road.update(LinkDown(), 5.0)
    assert status(5.0) == ["lost", 5.0]
    assert status(9.0) == ["lost", 5.0]
    road.update(LinkUp(), 10.0)
    road.update(CONVOY.clock(START + 30), 10.0)
    assert status(10.0) == ["live", 10.0]
    road.update(CONVOY.clock(START + 31, ended=True), 11.0)
    assert status(20.0) == ["ended", 20.0]
    # The router ends with the run.
    road.update(LinkDown(), 21.0)
    assert status(22.0) == ["ended", 20.0]


def test_frames_are_made_after_changes() -> None:
    road = watched()
    assert road.changed(2.0)
    road.frame(0, 2.0)
    assert not road.changed(2.0)
    assert road.changed(2.1 + STILL_S)
    road.update(CONVOY.state(0, START + 20), 2.0)
    assert not road.changed(2.0)
    road.update(CONVOY.clock(START + 21), 2.1)
    assert road.changed(2.1)


def test_events_and_plans() -> None:
    road = watched()
    data = {"slot": 3, "vehicles": 9, "moves": 2, "solve_ms": 4.25, "status": "feasible"}
    for kind, more in (
        ("stream-planned", data),
        ("formations-joined", {"formations": [1, 2], "why": "x" * 500}),
        ("plan-in-force", {"slot": 3}),
    ):
        road.update(LogEvent(Name("coordinator"), Name("c1"), 12.0, Name(kind), dict(more)), 2.0)
    frame = shown(road)
    assert frame["plan"] == [12.0, 9, 4.25, "rolling", False]
    made = {"vehicles": 6, "solve_ms": 2.5, "solver": "branching", "fallback": True}
    road.update(LogEvent(Name("coordinator"), Name("c1"), 13.0, Name("plan-made"), made), 2.0)
    assert shown(road)["plan"] == [13.0, 6, 2.5, "branching", True]
    ((t_s, who, what, details),) = frame["news"]
    assert (t_s, who, what) == (12.0, "c1", "formations-joined")
    assert details.startswith("formations 1 2, why xxx")
    assert len(details) <= 90


@for_each("value", ["a", None, [1], {"b": 2}, True, -(2**63), 10**400])
def test_malformed_events_do_no_harm(value: object) -> None:
    road = watched()
    data = {"vehicles": value, "solve_ms": value, "solver": value, "fallback": value}
    for kind in ("plan-made", "odd"):
        road.update(LogEvent(Name("x"), Name("y"), 1.0, Name(kind), dict(data)), 2.0)
    shown(road)


def test_a_frame_of_90_vehicles_is_small() -> None:
    convoy = Convoy(90)
    road = LiveRoad(convoy.scenario, 0.0)
    for tick in range(400, 411):
        for send in convoy.messages(tick):
            road.update(send.message, 1.0)
    assert len(compact(road.frame(0, 1.0))) < 9000


def test_what_is_wrong_is_in_the_frame() -> None:
    road = LiveRoad(ROLLING, wall_s=100.0, expected=Expected(bridge=True))
    assert road.frame(0, 100.0)["findings"] == []  # it may come at any moment
    finding = ["bridge", "no bridge found", "start the bridge"]
    assert finding in road.frame(1, 101.5)["findings"]
    road.update(PeerUp(BRIDGE_ALIVE, {"incarnation": "5"}), 101.6)
    road.update(RoadStatus(5, clock_s=101.6, unattended={Name("v1"): 12.0}), 101.6)
    road.update(RoadClock(1, 0.1, 1, 1, 1, 0, ended=False, bridge=5), 101.6)
    whats = [what for _, what, _ in road.frame(2, 102.0)["findings"]]
    assert whats == [
        "there is no leader: no coordinators found",
        "1 vehicle has no agent, such as v1 for 12 s",
    ]


def test_closed_and_cleared_parts_and_vehicles_of_other_systems_are_shown_where_they_are() -> None:
    road = watched()
    t_s = shown(road)["t"]
    assert (shown(road)["parts"], shown(road)["others"]) == ([], [])
    cleared = Cleared(2, 100.0, 300.0, 25.0, t_s - 1.0, PASSING, Name("other-1"), 120.0, 7.0)
    message = Obstacles(t_s, (Obstacle(1, 600.0, 650.0),), cleared=(cleared,))
    road.update(Arrived(OBSTACLES, {}, message), 2.0)
    frame = shown(road)
    assert frame["parts"] == [[1, 600.0, 650.0, 1], [2, 125.0, 325.0, 2]]
    assert frame["others"] == [["other-1", 2, 145.0, 7.0]]
    road.update(Arrived(OBSTACLES, {}, Obstacles(t_s - 5.0)), 2.0)  # an older one
    assert len(shown(road)["parts"]) == 2
    road.update(Arrived(OBSTACLES, {}, Obstacles(t_s + 0.1)), 2.0)
    assert (shown(road)["parts"], shown(road)["others"]) == ([], [])
