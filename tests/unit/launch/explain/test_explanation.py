"""What explanations say about runs that are unfinished, old, or have events of other kinds."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import pytest

from laneweave.launch.explain.explanation import Explanation, Fate, explain
from laneweave.launch.explain.reasons import Reason
from laneweave.protocol.errors import BadInputError

Event = Mapping[str, Any]
V, W = "v0001", "v0002"


def at(t_s: float, kind: str, **data: object) -> Event:
    return {"t_s": t_s, "kind": kind, "role": "bridge", **data}


ENTERED = at(2.0, "entered", vehicle=V, lane=0, preferred_lane=2, destination="end", formation=None)
CLOSED = at(5.0, "formation-closed", formation=1, vehicles=[V, W], columns=[-7, -1])
LEADER = at(0.8, "leader", coordinator="c1", term=1, leader_until_s=None)
PLAN = at(5.1, "plan-made", formation=1, vehicles=2, steps=3, t0_s=20.0, slot_s=5.0)
IN_FORCE = at(5.2, "plan-in-force", formation=1, closed_s=5.0)


def left(lane: int = 0, **data: object) -> list[Event]:
    """Return the events of a vehicle that leaves, with the given data of `left-off-lane`."""
    gone = at(60.0, "left", vehicle=V, lane=lane, exit="end", on_preferred_lane=lane == 2)
    where = {"vehicle": V, "lane": lane, "exit": "end", "preferred_lane": 2, "destination": "end"}
    return [gone] if lane == 2 else [gone, at(60.0, "left-off-lane", **where, **data)]


OFF = left(attended=True, reason="planned", unattended_since_s=None, leader_until_s=59.9)
OLD_OFF = left(attended=True)


def explained(folder: Path, events: Iterable[Event], tail: str = "") -> Explanation:
    """Write events, and return the explanation of a vehicle."""
    text = "".join(json.dumps(event) + "\n" for event in events)
    (folder / "events.jsonl").write_text(text + tail, encoding="utf-8")
    return explain(folder, V)


def out_of_reach(reason: str, **blocked_by: list[str]) -> Event:
    data = {"vehicles": [V], "reasons": {V: reason}, "blocked_by": blocked_by}
    return at(5.1, "lane-out-of-reach", formation=1, **data)


# --- fates ------------------------------------------------------------------------------------


def test_a_vehicle_that_reached_its_lane(tmp_path: Path) -> None:
    found = explained(tmp_path, [LEADER, ENTERED, CLOSED, PLAN, IN_FORCE, *left(2)])
    assert (found.fate, found.reason) == (Fate.REACHED, "")
    assert found.text == "v0001 reached its goal (lane 2) at 60.0 s"
    assert [line.text for line in found.story] == [
        "c1 leads",
        "entered in lane 0; wants lane 2",
        "formation 1 closed: v0001, v0002",
        "plan made for 2 vehicles: 3 steps, from 20.0 s on",
        "plan in force: all vehicles have accepted it",
        "left in lane 2",
    ]


def test_an_unfinished_run_says_until_when(tmp_path: Path) -> None:
    found = explained(tmp_path, [LEADER, ENTERED, CLOSED, PLAN], '{"t_s": 5.2, "ki')
    assert (found.fate, found.reason) == (Fate.ON_ROAD, "")
    assert found.text == "v0001 was on the road at 5.1 s, on its way to lane 2"


def test_a_vehicle_that_stands_at_the_end_of_a_lane_has_a_reason(tmp_path: Path) -> None:
    stops = at(30.0, "left-lattice", vehicle=V, lane=0)
    found = explained(tmp_path, [LEADER, ENTERED, stops])
    assert (found.fate, found.reason) == (Fate.ON_ROAD, Reason.STOPPED)
    back = at(40.0, "entered-lattice", vehicle=V, lane=1)
    assert explained(tmp_path, [LEADER, ENTERED, stops, back]).reason == ""


def test_unknown_vehicles_and_folders_are_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match=r"^RUN: got .*events.jsonl"):
        explain(tmp_path, V)
    explained(tmp_path, [ENTERED])
    with pytest.raises(BadInputError, match=r"^VEHICLE: got 'v1'; allowed: a vehicle of the run"):
        explain(tmp_path, "v1")
    (tmp_path / "events.jsonl").write_text("[1]\n[2]\n")
    with pytest.raises(BadInputError, match="not an event"):
        explain(tmp_path, V)


# --- reasons ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("event", "reason", "words"),
    [
        (out_of_reach("no-room"), Reason.NO_ROOM, "too many vehicles want this lane"),
        (out_of_reach("closed-lane"), Reason.CLOSED_LANE, "no lane change was possible"),
        (out_of_reach("too-late"), Reason.TOO_LATE, "too late for its lane change"),
        (out_of_reach("blocked", v0001=[W]), Reason.BLOCKED, "blocked by v0002 in the plan"),
        (out_of_reach("no-agent"), Reason.NO_AGENT, "no agent drove it"),
    ],
)
def test_the_plan_says_why_a_lane_is_out_of_reach(
    event: Event, reason: Reason, words: str, tmp_path: Path
) -> None:
    # The coordinator's messages may be recorded in any order.
    found = explained(tmp_path, [LEADER, ENTERED, CLOSED, event, PLAN, IN_FORCE, *OFF])
    assert found.reason == reason
    assert words in found.text


def test_a_later_plan_replaces_the_reason(tmp_path: Path) -> None:
    again = {**PLAN, "t_s": 9.0}
    found = explained(
        tmp_path, [LEADER, ENTERED, CLOSED, PLAN, out_of_reach("no-room"), IN_FORCE, again, *OFF]
    )
    assert found.reason == Reason.NOT_COMPLETED


def test_plans_of_the_rolling_operation(tmp_path: Path) -> None:
    slots = [
        at(t_s, "stream-planned", slot=slot, out_of_reach=out)
        for slot, (t_s, out) in enumerate([(6.6, []), (12.6, []), (18.6, [V])])
    ]
    off = left(attended=True, reason="no-plan", unattended_since_s=None, leader_until_s=60.0)
    start = [LEADER, ENTERED, *slots[:2]]
    assert explained(tmp_path, [*start, slots[2], *off]).reason == Reason.NO_ROOM
    lost = at(15.0, "caretaker-took-over", vehicle=W, reason="absent")
    found = explained(tmp_path, [*start, lost, slots[2], *off])
    assert found.reason == Reason.BLOCKED
    assert "perhaps on its way: v0002 (no agent since 15.0 s)" in found.text

    def given_up(t_s: float, unanswered: list[str]) -> Event:
        why = "its slot has begun"
        return at(t_s, "handover-given-up", roster=[V, W], why=why, unanswered=unanswered)

    found = explained(tmp_path, [*start, given_up(13.0, [V]), slots[2], *off])
    assert found.reason == Reason.NO_ANSWER
    assert "accepted none of the plans" in found.text
    # Another vehicle did not answer, or it was an earlier ballot that was aborted.
    for event in (given_up(13.0, [W]), given_up(12.0, [V])):
        found = explained(tmp_path, [*start, event, slots[2], *off])
        assert found.reason == Reason.NO_ROOM


@pytest.mark.parametrize("process", ["coordinator c1", "fleet east"])
def test_a_process_with_other_settings(process: str, tmp_path: Path) -> None:
    different = {"road.lanes": [3, 4]}
    refused = at(0.1, "settings-refused", process=process, incarnation=1, settings=different)
    absent = [
        at(2.0, "agent-missing", vehicle=V),
        at(2.0, "caretaker-took-over", vehicle=V, reason="absent"),
    ]
    rest = [LEADER, ENTERED, *absent, CLOSED] if "fleet" in process else [ENTERED, CLOSED]
    found = explained(tmp_path, [refused, *rest, *OFF])
    assert found.reason == Reason.SETTINGS_REFUSED
    assert f"{process} has other settings than the bridge (road.lanes)" in found.text


def test_a_plan_that_waits_for_a_member_without_an_agent(tmp_path: Path) -> None:
    lost = at(25.0, "caretaker-took-over", vehicle=W, reason="silent")
    found = explained(tmp_path, [LEADER, ENTERED, CLOSED, PLAN, IN_FORCE, lost, *OFF])
    assert found.reason == Reason.BLOCKED
    assert "its plan waited for v0002 (no agent since 25.0 s)" in found.text
    gone = left(attended=True, reason="planned", unattended_since_s=None, leader_until_s=30.0)
    found = explained(tmp_path, [LEADER, ENTERED, CLOSED, PLAN, IN_FORCE, lost, *gone])
    assert found.reason == Reason.NO_LEADER
    assert "from 30.0 s on, and its plan waited for v0002" in found.text


def test_an_agent_that_was_gone_for_a_while(tmp_path: Path) -> None:
    lost = at(19.0, "caretaker-took-over", vehicle=V, reason="late")
    back = at(50.0, "agent-took-over", vehicle=V, previous="caretaker")
    found = explained(tmp_path, [LEADER, ENTERED, CLOSED, PLAN, IN_FORCE, lost, back, *OFF])
    assert found.reason == Reason.AGENT_LATE
    assert "from 19.0 s to 50.0 s" in found.text


# --- closed parts -----------------------------------------------------------------------------

SLOT = at(8.0, "stream-planned", slot=3, out_of_reach=[V])
STOPS = at(30.0, "left-lattice", vehicle=V, lane=1)


def part(kind: str, t_s: float, **data: object) -> Event:
    """Return an event about a part of lane 1 that is closed around a vehicle that stands."""
    where = {"lane": 1, "from_m": 500.4, "to_m": 520.4, "cause": "breakdown", "vehicle": W}
    return at(t_s, f"part-{kind}", **{**where, "speed_mps": 0.0, **data})


OPERATOR = {"cause": "closed", "vehicle": None}
TRACTOR = {"cause": "passing", "vehicle": "other-1", "speed_mps": 5.0}


@pytest.mark.parametrize(
    ("data", "words", "story"),
    [
        (
            {},
            "lane 1, closed from 500 to 520 m (v0002 had broken down)",
            [
                "v0002 breaks down in lane 1, which is closed at 500 m",
                "lane 1 open again from 500 m on",
            ],
        ),
        (
            OPERATOR,
            "lane 1, closed from 500 to 520 m",
            ["lane 1 closed from 500 to 520 m", "lane 1 open again from 500 m on"],
        ),
        (
            TRACTOR,
            "other-1, a vehicle of another system, in lane 1",
            [
                "other-1, a vehicle of another system, enters lane 1 at 5.0 m/s",
                "other-1 has left lane 1",
            ],
        ),
    ],
)
def test_a_closed_part_is_the_reason_while_it_is_closed(
    data: dict[str, object], words: str, story: list[str], tmp_path: Path
) -> None:
    begins, ends = part("closed", 1.0, **data), part("opened", 9.0, **data)
    found = explained(tmp_path, [LEADER, begins, ENTERED, SLOT, ends, *OLD_OFF])
    assert found.reason == Reason.CLOSED_PART
    assert found.text.endswith(f"the plan of 8.0 s had no path to its lane because of {words}")
    told = [line.text for line in found.story if line.kind.startswith("part-")]
    assert told == story

    earlier = explained(tmp_path, [LEADER, begins, part("opened", 1.5, **data), ENTERED, SLOT])
    assert all(not line.kind.startswith("part-") for line in earlier.story)
    other_lane = [
        part(kind, t_s, **data, lane=3) for kind, t_s in (("closed", 1.0), ("opened", 9.0))
    ]
    for parts in ([begins, part("opened", 7.0, **data)], other_lane):
        found = explained(tmp_path, [LEADER, ENTERED, SLOT, *parts, *OLD_OFF])
        assert found.reason == Reason.NO_ROOM


def test_a_vehicle_that_stops_before_a_closed_part(tmp_path: Path) -> None:
    grown = part("closed", 27.0, to_m=560.0)
    parts = [part("closed", 20.0), grown, part("opened", 40.0, to_m=560.0)]
    found = explained(tmp_path, [LEADER, ENTERED, STOPS, *parts, *OLD_OFF])
    where = "lane 1, closed from 500 to 560 m (v0002 had broken down)"
    assert found.reason == Reason.CLOSED_PART
    assert found.text == f"v0001 missed its goal (lane 2): it stopped at 30.0 s before {where}"
    assert f"stops before {where}" in [line.text for line in found.story]
    # It stopped when the part was open again.
    found = explained(
        tmp_path, [LEADER, ENTERED, STOPS, part("closed", 10.0), part("opened", 20.0)]
    )
    assert found.reason == Reason.STOPPED


def test_a_vehicle_that_has_broken_down(tmp_path: Path) -> None:
    parts = [part("closed", 30.0, vehicle=V), part("opened", 40.0, vehicle=V)]
    found = explained(tmp_path, [LEADER, ENTERED, STOPS, *parts, *OLD_OFF])
    assert found.reason == Reason.BROKE_DOWN
    assert found.text.endswith("it broke down at 30.0 s, in lane 1")
    again = at(45.0, "entered-lattice", vehicle=V, lane=1)
    later = at(50.0, "missed-exit", vehicle=V, lane=1)
    other = [part("closed", 5.0, from_m=50.0, to_m=70.0, **OPERATOR), *parts]
    driving = explained(tmp_path, [LEADER, ENTERED, STOPS, *other, again, later, *OLD_OFF])
    assert driving.reason == Reason.MISSED_EXIT
    assert not [line for line in driving.story if line.text.startswith("stops")]
    told = [line.text for line in found.story if 20.0 < line.t_s < 50.0]
    assert told == ["breaks down in lane 1", "lane 1 open again from 500 m on"]


def test_a_plan_that_a_closed_part_kept_from_being_completed(tmp_path: Path) -> None:
    planned = [LEADER, ENTERED, CLOSED, PLAN, IN_FORCE]
    found = explained(tmp_path, [*planned, part("closed", 20.0), *OFF])
    assert found.reason == Reason.CLOSED_PART
    assert "not completed it in the time of lane 1, closed" in found.text
    assert explained(tmp_path, [*planned, *OFF]).reason == Reason.NOT_COMPLETED


def test_a_reference_method_makes_no_plans(tmp_path: Path) -> None:
    found = explained(tmp_path, [ENTERED, *OLD_OFF])
    assert found.reason == Reason.METHOD


# --- earlier versions -------------------------------------------------------------------------


def test_events_of_earlier_versions_say_less(tmp_path: Path) -> None:
    leader = {key: value for key, value in LEADER.items() if key != "leader_until_s"}
    start = [leader, ENTERED, CLOSED]
    late = at(50.0, "formation-too-late", formation=1)
    assert explained(tmp_path, [*start, late, *OLD_OFF]).reason == Reason.TOO_LATE
    reach = at(5.1, "lane-out-of-reach", formation=1, vehicles=[V])
    assert explained(tmp_path, [*start, PLAN, reach, IN_FORCE, *OLD_OFF]).reason == Reason.NO_ROOM
    assert explained(tmp_path, [*start, *OLD_OFF]).reason == Reason.NO_PLAN
    assert explained(tmp_path, [*start, PLAN, IN_FORCE, *OLD_OFF]).reason == Reason.NOT_COMPLETED
    lost = at(9.0, "caretaker-took-over", vehicle=V, reason="absent")
    found = explained(tmp_path, [*start, lost, *left(attended=False)])
    assert found.reason == Reason.NO_AGENT


# --- the story --------------------------------------------------------------------------------


def test_equal_lines_are_merged_and_members_are_named_together(tmp_path: Path) -> None:
    failed = [at(t_s, "planning-failed", formation=1, error="x") for t_s in (6.0, 7.0, 9.0)]
    others = [at(8.0, "caretaker-took-over", vehicle=W, reason="absent")]
    closed = {**CLOSED, "vehicles": [V, W, "v0003"]}
    others.append({**others[0], "vehicle": "v0003"})
    found = explained(tmp_path, [ENTERED, closed, *failed[:2], *others, failed[2], *OFF])
    texts = [line.text for line in found.story]
    assert "planning failed: x (1 more until 7.0 s)" in texts
    assert "no agent for v0002, v0003 of its formation: its agent is gone" in texts
    assert texts[-1] == "left in lane 0"
